//! Counts the instructions of engine passes on a Cortex-M7: `counts IMAGE`, named as a semihosting
//! argument; IMAGE is the configuration image of `counts.toml` (docs/performance.md section 2).
//!
//! `counts IMAGE NAME` runs only the measurement with this name, ten times, for a profile (`firmware/shares.py`). Write
//! blanks in the name as underscores, because an argument ends at a blank.
//!
//! With `-icount shift=6` an instruction takes 64 ns of QEMU's time, which is 1.6 ticks of a 25 MHz timer: counts are
//! exact and reproducible. Each printed line has the mean and maximum of many passes, and the name of the measurement.
#![no_std]
#![no_main]

mod bare;

use core::hint::black_box;

use firmware::tasks::gateway::SizedEngine as Engine;
use proto_core::config::image::{self, MAX_IMAGE};
use proto_core::config::{GatewayConfig, Port};
use proto_core::engine::{Handled, Input, LinkId, OUTPUT_BUFFER, Output, PortId};
use proto_core::time::{Duration, Instant};
use proto_core::wire::can::{CanFrame, CanId};
use static_cell::ConstStaticCell;

/// In the order of counts.toml.
const PLC: PortId = PortId(0);
const SENSOR: PortId = PortId(1);
const DEVICES: PortId = PortId(2);
const DISPLAY: PortId = PortId(3);
const UDP: LinkId = LinkId::RECIPE_UDP;

/// Passes per measurement: enough for rare events to count in the mean.
const PASSES: u32 = 1000;
/// Passes for a profile; few, because each instruction of it is a line.
const PROFILED: u32 = 10;
/// Time between two passes.
const STEP: Duration = Duration::from_micros(50);
const CYCLE: Duration = Duration::from_millis(4);
/// Number of cycles between two state packets: often enough that their values are fresh for frames to the field.
const STATE_EACH: u32 = 16;

/// Runs one pass and returns its ticks.
type Measurement = fn(&mut EngineBench) -> u32;

/// The measurements: name, ports that send each cycle, function of a pass.
const MEASUREMENTS: [(&str, &[PortId], Measurement); 14] = [
    ("28-byte stream frame to its frame over UDP", &[], EngineBench::sensor_frame),
    ("the same frame in four chunks", &[], |bench| bench.sensor_chunks(7)),
    ("the same frame byte by byte", &[], |bench| bench.sensor_chunks(1)),
    ("28-byte stream frame to its Modbus request", &[], |bench| bench.plc_frame().0),
    ("the answer to that request", &[], |bench| bench.plc_frame().1[1]),
    ("Modbus write: frame to request, transport's report, answer", &[], |bench| {
        let (request, [report, answer]) = bench.plc_frame();
        request + report + answer - 2 * timer::overhead()
    }),
    ("CAN frame to its Modbus request", &[], |bench| bench.can_frame(0x50D)),
    ("CAN frame of an id that no recipe has", &[], |bench| bench.can_frame(0x50E)),
    ("state packet of 1468 bytes", &[], EngineBench::state_packet),
    ("state packet in three segments", &[], EngineBench::state_segments),
    ("idle cycle, nothing due", &[], EngineBench::idle),
    ("transport took what was sent", &[], EngineBench::taken),
    ("output cycle of an RS-485 port, 28 bytes", &[DISPLAY], |bench| bench.cycle(DISPLAY)),
    ("output cycle of a CAN port, 3 frames", &[DEVICES], |bench| bench.cycle(DEVICES)),
];

/// A state packet, all zeros except the state codes: remote, enabled, stopped, running.
const STATE_PACKET: [u8; 1468] = {
    let mut packet = [0; 1468];
    (packet[1448], packet[1449], packet[1451]) = (2, 6, 5);
    packet
};

struct EngineBench {
    engine: &'static mut Engine,
    out: [u8; OUTPUT_BUFFER],
    packet: [u8; 1468],
    now: Instant,
    sent: usize,
    passes: u32,
}

#[cortex_m_rt::entry]
fn main() -> ! {
    static IMAGE: ConstStaticCell<[u8; MAX_IMAGE]> = ConstStaticCell::new([0; MAX_IMAGE]);
    static ENGINE: ConstStaticCell<Engine> = ConstStaticCell::new(Engine::idle());
    static CONFIG: ConstStaticCell<GatewayConfig> = ConstStaticCell::new(GatewayConfig::empty());

    timer::start();
    calibrate();
    let image = bare::read_file(1, IMAGE.take());
    let config = CONFIG.take();
    let mut bench = EngineBench {
        engine: ENGINE.take(),
        out: [0; OUTPUT_BUFFER],
        packet: STATE_PACKET,
        now: Instant::from_millis(1_000),
        sent: 0,
        passes: 0,
    };
    let is_profile = bare::is_argument(2, |_| true);
    let passes = if is_profile { PROFILED } else { PASSES };
    for (name, cycles, work) in MEASUREMENTS {
        if is_profile && !bare::is_argument(2, |wanted| is_called(name, wanted)) {
            continue;
        }
        bench.set_up(image, config, cycles);
        let (mut sum, mut most) = (0_u64, 0);
        for _ in 0..passes {
            let ticks = work(&mut bench);
            sum += u64::from(ticks);
            most = most.max(ticks);
            bench.passes += 1;
        }
        bench.look(name);
        print(name, sum / u64::from(passes), u64::from(most));
    }
    if !is_profile {
        let begin = timer::ticks();
        bench.set_up(image, config, &[]);
        let ticks = u64::from(timer::since(begin));
        print("configuration image to an engine whose links are up", ticks, ticks);
    }
    semihosting::process::exit(0)
}

fn is_called(name: &str, wanted: &str) -> bool {
    name.bytes().map(|byte| if byte == b' ' { b'_' } else { byte }).eq(wanted.bytes())
}

fn print(name: &str, mean: u64, most: u64) {
    let instructions = |ticks: u64| (ticks - u64::from(timer::overhead())) * 5 / 8;
    semihosting::println!("{}\t{}\t{name}", instructions(mean), instructions(most));
}

impl EngineBench {
    /// An engine before any event; `ports` send each cycle.
    fn set_up(&mut self, image: &[u8], config: &mut GatewayConfig, cycles: &[PortId]) {
        if let Err(error) = image::decode_into(image, config) {
            bare::fail("configuration", &error);
        }
        for port in cycles {
            let port: Option<&mut Port> = config.ports.get_mut(usize::from(port.0));
            port.expect("counts.toml has four ports").cycle = CYCLE;
        }
        if let Err(error) = self.engine.configure(&*config) {
            bare::fail("configuration", &error);
        }
        self.connect();
    }

    /// Brings up all links and ports.
    fn connect(&mut self) {
        self.pass(Input::Tick);
        for nth in 0..4 {
            self.pass(Input::PortUp { port: PortId(nth) });
        }
        for link in [LinkId::STATE, LinkId::MODBUS, UDP] {
            self.pass(Input::LinkUp { link });
        }
        self.pass(Input::LinkSent { link: UDP });
        self.state_packet();
    }

    /// Ticks of one input and all its outputs.
    fn pass(&mut self, input: Input<'_>) -> u32 {
        self.now += STEP;
        self.sent = 0;
        let begin = timer::ticks();
        pass(self.engine, self.now, input, &mut self.out, &mut self.sent);
        timer::since(begin)
    }

    fn sensor_frame(&mut self) -> u32 {
        self.sensor_chunks(28)
    }

    /// Ticks of a frame in chunks of `size` bytes.
    fn sensor_chunks(&mut self, len: usize) -> u32 {
        let frame: [u8; 28] = black_box(*b"\x48\xAA............floats......\x0D\x0A");
        let ticks = frame.chunks(len).map(|chunk| self.pass(Input::PortBytes { port: SENSOR, bytes: chunk }));
        let ticks = ticks.sum::<u32>() - (frame.len().div_ceil(len) as u32 - 1) * timer::overhead();
        assert_eq!(self.sent, 28);
        self.pass(Input::LinkSent { link: UDP });
        ticks
    }

    /// Ticks of a frame and the completion of its request.
    fn plc_frame(&mut self) -> (u32, [u32; 2]) {
        let frame: [u8; 28] = black_box(*b"\xFF\xFF........twelve words....\xEE\xEE");
        let request = self.pass(Input::PortBytes { port: PLC, bytes: &frame });
        assert_eq!(self.sent, 13 + 24);
        (request, self.answer())
    }

    fn can_frame(&mut self, id: u16) -> u32 {
        let frame = CanFrame::new(CanId::Standard(black_box(id)), &[1, 2]).expect("a right frame");
        let request = self.pass(Input::PortCan { port: DEVICES, frame });
        if self.sent > 0 {
            self.answer();
        }
        request
    }

    /// Reports that the request was sent, and then the controller's confirmation; returns the ticks of both passes.
    fn answer(&mut self) -> [u32; 2] {
        let report = self.pass(Input::LinkSent { link: LinkId::MODBUS });
        let mut answer = [0; 12];
        answer.copy_from_slice(&self.out[..12]);
        answer[5] = 6;
        [report, self.pass(Input::LinkBytes { link: LinkId::MODBUS, bytes: &answer })]
    }

    fn state_packet(&mut self) -> u32 {
        let packet = black_box(self.packet);
        self.pass(Input::LinkBytes { link: LinkId::STATE, bytes: &packet })
    }

    /// Ticks of a state packet in segments, as TCP delivers them if a window is not a multiple of a packet.
    fn state_segments(&mut self) -> u32 {
        let packet = black_box(self.packet);
        let ticks =
            packet.chunks(536).map(|part| self.pass(Input::LinkBytes { link: LinkId::STATE, bytes: part }));
        ticks.sum::<u32>() - 2 * timer::overhead()
    }

    fn idle(&mut self) -> u32 {
        self.pass(Input::Tick)
    }

    fn taken(&mut self) -> u32 {
        self.pass(Input::LinkSent { link: UDP })
    }

    /// Ticks of a timer event alone.
    fn cycle(&mut self, port: PortId) -> u32 {
        if self.passes.is_multiple_of(STATE_EACH) {
            self.state_packet();
        }
        let due = self.engine.deadline();
        self.now = due - STEP;
        let ticks = self.pass(Input::Tick);
        assert!(self.sent > 0);
        self.pass(Input::PortSent { port });
        ticks
    }

    /// Checks that the pass did what its name says.
    fn look(&self, name: &str) {
        for link in self.engine.links() {
            let counters = link.counters;
            assert_eq!((counters.malformed, counters.timeouts, counters.refused), (0, 0, 0), "{name}");
        }
        for port in self.engine.field_ports() {
            let Some(counters) = self.engine.port_counters(port) else { continue };
            let lost = [
                counters.resync_bytes,
                counters.undelivered,
                counters.skipped_cycles,
                counters.values_expired,
            ];
            assert_eq!(lost, [0; 4], "{name}");
        }
    }
}

/// Runs a pass like the firmware's gateway. Not inlined, so that the compiler does not specialise it for an input.
#[inline(never)]
fn pass(
    engine: &mut Engine,
    now: Instant,
    input: Input<'_>,
    out: &mut [u8; OUTPUT_BUFFER],
    sent: &mut usize,
) {
    if engine.handle(now, input) == Handled::Asleep {
        return;
    }
    loop {
        match engine.poll_output(now, out) {
            // Like the firmware: a due tick comes after received input.
            Output::Sleep { until } if until <= now => {
                engine.handle(now, Input::Tick);
            }
            Output::Sleep { .. } => return,
            Output::LinkSend { bytes, .. } | Output::PortSend { bytes, .. } => *sent += bytes.len(),
            Output::PortSendCan { frame, .. } => *sent += frame.data().len(),
            other => {
                black_box(other);
            }
        }
    }
}

/// Ends the program if the timer does not count instructions.
fn calibrate() {
    // Unrolled, so that the number of instructions is known.
    macro_rules! ten_of {
        ($text:expr) => {
            concat!($text, $text, $text, $text, $text, $text, $text, $text, $text, $text)
        };
    }
    // SAFETY: a thousand NOPs. They access no memory, and change neither registers nor flags.
    let thousand = || unsafe {
        core::arch::asm!(ten_of!(ten_of!(ten_of!("nop\n"))), options(nomem, nostack, preserves_flags))
    };
    let begin = timer::ticks();
    thousand();
    let once = timer::since(begin);
    let begin = timer::ticks();
    thousand();
    thousand();
    let ticks = timer::since(begin) - once;
    // 1600 ticks, with a tolerance of about two jumps: the compiler places constants between that many instructions,
    // and jumps over them.
    if !(1596..=1604).contains(&ticks) {
        bare::fail(
            "a thousand instructions",
            &format_args!("took {ticks} ticks; QEMU needs -icount shift=6"),
        );
    }
}

/// TIMER1, which counts down at 25 MHz.
mod timer {
    const TIMER1: usize = 0x4000_1000;
    const CTRL: usize = TIMER1;
    const VALUE: usize = TIMER1 + 0x4;
    const RELOAD: usize = TIMER1 + 0x8;

    pub(super) fn start() {
        for (register, value) in [(RELOAD, u32::MAX), (VALUE, u32::MAX), (CTRL, 1)] {
            // SAFETY: callers pass aligned 32-bit registers of TIMER1, which nothing else uses and which accesses no
            // memory.
            unsafe { core::ptr::with_exposed_provenance_mut::<u32>(register).write_volatile(value) }
        }
    }

    #[inline(always)]
    pub(super) fn ticks() -> u32 {
        // SAFETY: an aligned 32-bit register of TIMER1, which nothing else uses. Reading it has no side effects.
        unsafe { core::ptr::with_exposed_provenance::<u32>(VALUE).read_volatile() }
    }

    #[inline(always)]
    pub(super) fn since(begin: u32) -> u32 {
        begin.wrapping_sub(ticks())
    }

    /// Ticks between two readings with nothing between them.
    #[inline(never)]
    pub(super) fn overhead() -> u32 {
        let begin = ticks();
        since(begin)
    }
}
