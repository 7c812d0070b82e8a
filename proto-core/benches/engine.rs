//! Whole engine passes: one input, then everything drained until the engine sleeps, in a cell of
//! four ports with all links up. Beside the bare limit: finding the head of the same frame and
//! copying its bytes. `-- instructions` counts instructions instead of measuring time.

mod instructions;
#[path = "../tests/rig/mod.rs"]
mod rig;

use std::hint::black_box;
use std::process::ExitCode;

use divan::Bencher;
use instructions::Work;
use proto_core::engine::{Engine, Handled, Input, LinkId, OUTPUT_BUFFER, Output, PortId};
use proto_core::time::{Duration, Instant};
use proto_core::wire::can::{CanFrame, CanId};
use rig::{Cell, MS};

/// Whole passes may take 1.3 times as long as the engine that had a fast path for each of them.
const MODBUS: u64 = 1_614 * 13 / 10;
const UDP_PASS: u64 = 945 * 13 / 10;
const BYTES: u64 = 3_375 * 13 / 10;
const CAN: u64 = 1_511 * 13 / 10;
const STATE: u64 = 764 * 13 / 10;
/// What is for another node.
const FOREIGN: u64 = 200;
/// A state packet in segments.
const SEGMENTS: u64 = 1_700;

type Pass = fn(&mut Bench);

/// Longer than any run: only one work is about the cycle.
const NO_CYCLE: Duration = Duration::from_secs(3_600);

/// Name, limit and work.
const WORKS: [(&str, Option<u64>, Pass); 13] = [
    ("field frame, bare", None, Bench::bare),
    ("field frame to Modbus request, answer", Some(MODBUS), Bench::modbus),
    ("field frame to two requests, answers", None, Bench::modbus_twice),
    ("field frame to recipe frame over UDP", Some(UDP_PASS), Bench::udp),
    ("field frame byte by byte to UDP", Some(BYTES), Bench::udp_bytes),
    ("CAN frame applied", Some(CAN), Bench::can),
    ("state packet", Some(STATE), Bench::state),
    ("state packet of a starting controller", None, Bench::state_of_starting),
    ("idle tick", None, Bench::idle),
    ("cycle of one port", None, Bench::cycle),
    ("field frame to request, acknowledged", None, Bench::modbus_acknowledged),
    ("CAN frame of another node", Some(FOREIGN), Bench::foreign),
    ("state packet in three segments", Some(SEGMENTS), Bench::state_segments),
];

fn main() -> ExitCode {
    macro_rules! work {
        ($nth:literal) => {
            Work {
                name: WORKS[$nth].0,
                limit: WORKS[$nth].1,
                run: |n| repeat(n, WORKS[$nth].0, WORKS[$nth].2),
            }
        };
    }
    let works = [
        work!(0),
        work!(1),
        work!(2),
        work!(3),
        work!(4),
        work!(5),
        work!(6),
        work!(7),
        work!(8),
        work!(9),
        work!(10),
        work!(11),
        work!(12),
    ];
    instructions::main(&works).unwrap_or_else(|| {
        divan::main();
        ExitCode::SUCCESS
    })
}

#[divan::bench(args = WORKS.map(|work| work.0))]
fn pass(bencher: Bencher<'_, '_>, name: &str) {
    let (_, _, pass) = WORKS.into_iter().find(|work| work.0 == name).expect("one of the works");
    let mut bench = Bench::for_work(name);
    bencher.bench_local(|| pass(&mut bench));
}

fn repeat(iterations: u64, name: &str, pass: Pass) {
    let mut bench = Bench::for_work(name);
    for _ in 0..iterations {
        pass(black_box(&mut bench));
    }
}

/// Four ports: a PLC (28-byte frames, to Modbus), a force sensor (28-byte frames, to UDP 2011), a
/// CAN bus with 14 ids, a display that is shown the pose each cycle. A second cell has a PLC whose
/// frame needs two Modbus requests, coils and registers.
struct Bench {
    engine: Box<Engine<4, 1, 128>>,
    now: Instant,
    out: [u8; OUTPUT_BUFFER],
    plc: Vec<u8>,
    sensor: Vec<u8>,
    packet: Vec<u8>,
    sent: usize,
    passes: u32,
}

const PLC: PortId = PortId(0);
const SENSOR: PortId = PortId(1);
const BUS: PortId = PortId(2);
const DISPLAY: PortId = PortId(3);
const UDP: LinkId = LinkId::RECIPE_UDP;

impl Bench {
    fn for_work(name: &str) -> Self {
        let cycle = if name == "cycle of one port" { MS(4) } else { NO_CYCLE };
        let two = name == "field frame to two requests, answers";
        let plc: &[&str] = match two {
            true => &["DigitalOutputCommand[1..2]", "WordInputReg[1..11]"],
            false => &["WordInputReg[1..12]"],
        };
        Self::new(plc, cycle)
    }

    fn new(plc: &[&str], cycle: Duration) -> Self {
        let mut cell = Cell::new();
        let up = cell.stream(&["ForceEnd[1..6]"], &[]);
        cell.recipe_link(up);
        let recipe = cell.stream(plc, &[]);
        assert_eq!(cell.rs485(recipe), PLC);
        let recipe = cell.stream(&["ForceEnd[1..6]"], &[]);
        assert_eq!(cell.rs485(recipe), SENSOR);
        let words: Vec<[String; 1]> = (13..27).map(|nth| [format!("WordInputReg[{nth}]")]).collect();
        let words: Vec<[&str; 1]> = words.iter().map(|[name]| [name.as_str()]).collect();
        let frames: Vec<(u16, &[&str])> = (0x500..).zip(words.iter().map(|name| &name[..])).collect();
        let recipe = cell.can(&frames, &[]);
        assert_eq!(cell.can_port(recipe), BUS);
        let recipe = cell.stream(&[], &["RobotState[8..13]"]);
        assert_eq!(cell.rs485(recipe), DISPLAY);
        for port in &mut cell.0.ports {
            port.timeout = NO_CYCLE;
        }
        cell.last_port().cycle = cycle;
        let frame = |fill: u8| [&[255, 255][..], &[fill; 24], &[238, 238]].concat();
        let mut bench = Self {
            engine: Box::new(Engine::new(&cell.0).expect("a right configuration")),
            now: Instant::from_millis(1_000),
            out: [0; OUTPUT_BUFFER],
            plc: frame(0x11),
            sensor: frame(0x22),
            packet: started_packet(),
            sent: 0,
            passes: 0,
        };
        bench.pass(Input::Tick);
        for nth in 0..4 {
            bench.pass(Input::PortUp { port: PortId(nth) });
        }
        for link in [LinkId::STATE, LinkId::MODBUS, UDP] {
            bench.pass(Input::LinkUp { link });
        }
        bench.state();
        bench
    }

    /// One input and all that comes of it; the length of what went to the controller stands in
    /// `sent`.
    #[inline(always)]
    fn pass(&mut self, input: Input<'_>) {
        self.now += Duration::from_micros(50);
        drain(&mut self.engine, self.now, input, &mut self.out, &mut self.sent);
    }

    fn bare(&mut self) {
        let frame = black_box(&self.plc[..]);
        let at = frame.windows(2).position(|two| two == [255, 255]).unwrap_or(0);
        let mut image = [0; 24];
        image.copy_from_slice(&frame[at + 2..][..24]);
        self.out[2..26].copy_from_slice(black_box(&image));
        black_box(&mut self.out);
    }

    fn modbus(&mut self) {
        self.plc_frame(1);
    }

    fn modbus_twice(&mut self) {
        self.plc_frame(2);
    }

    fn plc_frame(&mut self, requests: usize) {
        let frame = std::mem::take(&mut self.plc);
        self.sent = 0;
        self.pass(Input::PortBytes { port: PLC, bytes: black_box(&frame) });
        self.plc = frame;
        for _ in 0..requests {
            assert!(std::mem::take(&mut self.sent) > 12);
            self.answer();
        }
        assert_eq!(self.sent, 0);
    }

    /// The controller did what it was asked to; written by hand, so that only the engine is counted.
    fn answer(&mut self) {
        let mut answer = [0; 12];
        answer.copy_from_slice(&self.out[..12]);
        answer[5] = 6;
        self.pass(Input::LinkSent { link: LinkId::MODBUS });
        self.pass(Input::LinkBytes { link: LinkId::MODBUS, bytes: black_box(&answer) });
    }

    /// The same with a driver that tells what the controller's transport has acknowledged.
    fn modbus_acknowledged(&mut self) {
        let frame = std::mem::take(&mut self.plc);
        self.pass(Input::PortBytes { port: PLC, bytes: black_box(&frame) });
        self.plc = frame;
        let answer = self.out[..12].first_chunk::<12>().copied();
        let mut answer = answer.expect("a request is longer");
        answer[5] = 6;
        self.pass(Input::LinkSent { link: LinkId::MODBUS });
        self.pass(Input::LinkAcked { link: LinkId::MODBUS, left: 0 });
        self.pass(Input::LinkBytes { link: LinkId::MODBUS, bytes: black_box(&answer) });
        assert!(std::mem::take(&mut self.sent) > 12);
    }

    fn udp(&mut self) {
        let frame = std::mem::take(&mut self.sensor);
        self.sent = 0;
        self.pass(Input::PortBytes { port: SENSOR, bytes: black_box(&frame) });
        self.sensor = frame;
        assert_eq!(self.sent, 28);
        self.pass(Input::LinkSent { link: UDP });
    }

    fn udp_bytes(&mut self) {
        let frame = std::mem::take(&mut self.sensor);
        self.sent = 0;
        for byte in frame.chunks(1) {
            self.pass(Input::PortBytes { port: SENSOR, bytes: black_box(byte) });
        }
        self.sensor = frame;
        assert_eq!(self.sent, 28);
        self.pass(Input::LinkSent { link: UDP });
    }

    fn can(&mut self) {
        let frame = CanFrame::new(CanId::Standard(0x50D), &[1, 2]).expect("a right frame");
        self.pass(Input::PortCan { port: BUS, frame: black_box(frame) });
        self.answer();
    }

    fn state(&mut self) {
        let packet = std::mem::take(&mut self.packet);
        self.pass(Input::LinkBytes { link: LinkId::STATE, bytes: black_box(&packet) });
        self.packet = packet;
    }

    fn foreign(&mut self) {
        let frame = CanFrame::new(CanId::Standard(0x50E), &[1, 2]).expect("a right frame");
        self.pass(Input::PortCan { port: BUS, frame: black_box(frame) });
    }

    fn state_segments(&mut self) {
        let packet = std::mem::take(&mut self.packet);
        for piece in packet.chunks(536) {
            self.pass(Input::LinkBytes { link: LinkId::STATE, bytes: black_box(piece) });
        }
        self.packet = packet;
    }

    fn state_of_starting(&mut self) {
        self.pass(Input::LinkBytes { link: LinkId::STATE, bytes: black_box(&[0; 1468]) });
    }

    fn idle(&mut self) {
        self.pass(black_box(Input::Tick));
    }

    fn cycle(&mut self) {
        self.now += Duration::from_micros(3_900);
        self.pass(Input::Tick);
        self.pass(Input::PortSent { port: DISPLAY });
        if self.passes.is_multiple_of(256) {
            self.state();
        }
        self.passes += 1;
    }
}

/// All zeros but the state codes: remote, enabled, stopped, running.
fn started_packet() -> Vec<u8> {
    let mut packet = vec![0; 1468];
    packet[1448..1452].copy_from_slice(&[2, 6, 0, 5]);
    packet
}

fn drain(
    engine: &mut Engine<4, 1, 128>,
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
            // As a driver does: the tick that is due comes behind what has arrived.
            Output::Sleep { until } if until <= now => {
                engine.handle(now, Input::Tick);
            }
            Output::Sleep { .. } => return,
            Output::LinkSend { bytes, .. } => *sent = bytes.len(),
            other => {
                black_box(other);
            }
        }
    }
}
