//! A cell at full load: every frame that a wire delivered is accounted for, on both sides.
//!
//! `HOST_SIM_LOAD_SECONDS` is its length (default 5).

use std::io::Write;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use serde_json::Value;

use recipe_test_kit::until;

use super::case::{Case, Scenario};
use super::environment::Link;
use super::field::slcan;
use super::robot::reserved_ports;

pub(crate) fn all() -> Vec<Scenario> {
    vec![Scenario::new("a_cell_at_full_load", full_load).alone().lasting(duration())]
}

fn duration() -> Duration {
    let seconds = std::env::var("HOST_SIM_LOAD_SECONDS");
    Duration::from_secs_f64(seconds.map_or(5.0, |text| text.parse().expect("HOST_SIM_LOAD_SECONDS")))
}

/// Frames per second of the force sensor.
const SENSOR_RATE: u32 = 960;
/// Frames per second that come on CAN.
const CAN_RATE: u32 = 500;
/// Ids that are sent on CAN each cycle.
const CAN_OUT: [u16; 3] = [2, 3, 4];

/// A force sensor; a panel that receives words and a count each cycle; a CAN bus with a count in, and three
/// frames out each cycle. Words use Modbus: one write per CAN frame, and one poll per cycle.
const CELL: &str = r#"
[controller]
address = "127.0.0.1"
recipe_link = { udp = 2011, recipe = "up" }

[[recipe]]
name = "up"
kind = "stream"
mode = "realtime"
[recipe.input]
head = [255, 255]
tail = [238, 238]
fields = ["ForceEnd[1..6]"]
[recipe.output]
head = [255, 255]
tail = [254, 254]
fields = ["RobotState[14..19]"]

[[recipe]]
name = "force"
kind = "stream"
mode = "realtime"
[recipe.input]
head = [0x48, 0xAA]
tail = [0x0D, 0x0A]
fields = ["ForceEnd[1..6]"]

[[recipe]]
name = "panel"
kind = "stream"
mode = "user"
[recipe.output]
head = [255, 255]
tail = [254, 254]
on_stale = "stop"
fields = [
    { name = "number", type = "dword", from = "counter" },
    { name = "words", type = "word", from = "WordOutputReg[1]" },
    { name = "more", type = "word", from = "WordOutputReg[2]" },
    { name = "x", type = "float", from = "RobotState[8]" },
]

[[recipe]]
name = "bus"
kind = "can"
mode = "user"
[[recipe.input.frame]]
id = 1
fields = [
    { name = "low", type = "word", to = "WordInputReg[1]" },
    { name = "high", type = "word", to = "WordInputReg[2]" },
    { name = "rest", type = "dword" },
]
[recipe.output]
on_stale = "stop"
[[recipe.output.frame]]
id = 2
fields = [{ name = "number2", type = "dword", from = "counter" }, { name = "word2", type = "dword", from = "WordOutputReg[3]" }]
[[recipe.output.frame]]
id = 3
fields = [{ name = "number3", type = "dword", from = "counter" }, { name = "word3", type = "dword", from = "WordOutputReg[4]" }]
[[recipe.output.frame]]
id = 4
fields = [{ name = "number4", type = "dword", from = "counter" }, { name = "word4", type = "dword", from = "WordOutputReg[5]" }]

[[port]]
name = "force"
bus = "rs485"
baud = 460800
recipe = "force"
idle_gap_ms = 5
timeout_ms = 1000

[[port]]
name = "panel"
bus = "rs485"
baud = 115200
recipe = "panel"

[[port]]
name = "bus"
bus = "can"
bitrate = 1000000
recipe = "bus"
timeout_ms = 1000
"#;

fn full_load(case: &Case) {
    let ports = reserved_ports();
    let mut plan = case.gateway_of(CELL).set("controller.recipe_link.udp", ports[3]);
    plan.set_servers(ports);
    let mut gateway = plan.start();
    // The devices are connected before the first frame can be sent to them.
    let mut sensor = gateway.line("force");
    let mut panel = Panel::default();
    let mut panel_line = gateway.line("panel");
    let mut bus = Bus::default();
    let mut bus_line = gateway.can("bus").into_line();
    let robot = case.robot("force-sensor-controller.toml").on(ports).start();
    for link in [Link::Modbus, Link::Udp2011, Link::State] {
        gateway.until_up(link, 1);
    }

    let duration = duration();
    let done = Arc::new(AtomicBool::new(false));
    let sensor = Generator::start(&done, SENSOR_RATE, sensor.take_writer(), sensor_frame);
    let can = Generator::start(&done, CAN_RATE, bus_line.take_writer(), can_frame);
    let (begin, spent, figures) = (Instant::now(), gateway.processor_time(), gateway.figures());
    panel.take(&panel_line.take_all());
    bus.take(&bus_line.take_all());
    let out_before = [panel.frames, bus.frames];
    let settled = duration / 5;
    let mut memory = None;
    while begin.elapsed() < duration {
        std::thread::sleep(Duration::from_millis(20));
        panel.take(&panel_line.take_all());
        bus.take(&bus_line.take_all());
        gateway.must_run();
        if memory.is_none() && begin.elapsed() > settled {
            memory = Some(gateway.memory());
        }
    }
    let spent = gateway.processor_time() - spent;
    let elapsed = begin.elapsed();
    let figures = growth(&figures, &gateway.figures(), elapsed);
    let out = [panel.frames - out_before[0], bus.frames - out_before[1]];
    done.store(true, Ordering::Relaxed);
    let (sensor, can) = (sensor.end(), can.end());
    let (before, after) = (memory.unwrap_or_default(), gateway.memory());

    // In: all that was sent was accepted, and the newest value has reached the controller.
    let force_port = gateway.until_bytes_in("force", sensor.bytes);
    robot.until("WordInputReg[1]", f64::from((can.frames - 1) as u16));
    robot.until("WordInputReg[2]", f64::from(((can.frames - 1) >> 16) as u16));
    robot.until("ForceEnd[1]", f64::from((sensor.frames - 1) as f32));
    let requests = robot.count("/modbus/requests");
    let datagrams = robot.count("/ports/udp2011/frames_in");
    // Out: it ends without the controller; then all that was sent was received.
    robot.end();
    gateway.until_down(Link::State);
    let heard = |gateway: &dyn super::environment::Gateway, panel: &Panel, bus: &Bus| {
        let status = ["panel", "bus"].map(|port| gateway.port(port));
        (status[0].frames_out == panel.frames && status[1].frames_out == bus.frames).then_some(status)
    };
    let [panel_port, bus_port] = until("all that was sent is heard", || {
        panel.take(&panel_line.take_all());
        bus.take(&bus_line.take_all());
        heard(&*gateway, &panel, &bus)
    });
    let seconds = elapsed.as_secs_f64();
    let rate = |count: u64| count as f64 / seconds;
    println!(
        "{}: {seconds:.1} s\n  force sensor: {} frames sent ({:.0}/s, {} late together with others), {} in\n  \
         CAN: {} frames sent ({:.0}/s, {} late together with others), {} in; {} out ({:.0}/s), {} cycles skipped\n  \
         panel: {} frames out ({:.0}/s), {} cycles skipped\n  controller: {requests} Modbus requests ({:.0}/s), \
         {datagrams} datagrams of forces ({:.0}/s)\n  processor {:.0} %, memory {before} bytes, at the end {after}{figures}",
        case.environment.name(),
        sensor.frames,
        rate(sensor.frames.into()),
        sensor.together,
        force_port.frames_in,
        can.frames,
        rate(can.frames.into()),
        can.together,
        bus_port.frames_in,
        bus_port.frames_out,
        rate(out[1]),
        bus_port.skipped_cycles,
        panel_port.frames_out,
        rate(out[0]),
        panel_port.skipped_cycles,
        rate(requests),
        rate(datagrams),
        100.0 * spent.as_secs_f64() / seconds,
    );
    assert_eq!((force_port.frames_in, force_port.skipped_bytes), (sensor.frames.into(), 0), "{force_port:?}");
    assert_eq!(bus_port.frames_in, u64::from(can.frames), "{bus_port:?}");
    assert!(panel.frames > 0 && bus.frames > 0, "{panel_port:?} {bus_port:?}");
    assert!(after <= before + MEMORY_NOISE, "memory grew from {before} to {after} bytes");
}

/// The difference of an emulator's counters, with rates per second.
fn growth(before: &Value, after: &Value, elapsed: Duration) -> String {
    let mut text = String::new();
    for (name, after) in after.as_object().into_iter().flatten() {
        let (Some(before), Some(after)) = (before[name].as_f64(), after.as_f64()) else { continue };
        let count = if name.starts_with("most") { after } else { after - before };
        text += &format!("\n  {name} {count} ({:.1}/s)", count / elapsed.as_secs_f64());
    }
    text
}

/// Memory that the allocator of a host's process may take later.
const MEMORY_NOISE: u64 = 256 << 10;

fn sensor_frame(number: u32, frame: &mut Vec<u8>) {
    frame.extend([0x48, 0xAA]);
    for axis in 0_u8..6 {
        frame.extend((number as f32 + f32::from(axis) / 8.0).to_le_bytes());
    }
    frame.extend([0x0D, 0x0A]);
}

fn can_frame(number: u32, line: &mut Vec<u8>) {
    let [a, b, c, d] = number.to_le_bytes();
    line.extend(slcan(1, &[a, b, c, d, a, b, c, d]).bytes());
}

/// Sends numbered frames at a rate, on an absolute grid. Frames that are late leave together.
struct Generator(JoinHandle<Sent>);

#[derive(Debug, Default)]
struct Sent {
    frames: u32,
    bytes: u64,
    /// Number of frames that were due before the previous one had left.
    together: u32,
}

impl Generator {
    fn start(
        done: &Arc<AtomicBool>,
        rate: u32,
        mut writer: Box<dyn Write + Send>,
        frame: fn(u32, &mut Vec<u8>),
    ) -> Self {
        let done = Arc::clone(done);
        Self(std::thread::spawn(move || {
            let begin = Instant::now();
            let mut sent = Sent::default();
            let mut bytes = Vec::new();
            while !done.load(Ordering::Relaxed) {
                let due = (begin.elapsed().as_secs_f64() * f64::from(rate)) as u32 + 1;
                bytes.clear();
                for number in sent.frames..due {
                    frame(number, &mut bytes);
                }
                sent.together += due.saturating_sub(sent.frames + 1);
                sent.frames = sent.frames.max(due);
                sent.bytes += bytes.len() as u64;
                writer.write_all(&bytes).unwrap();
                let next = Duration::from_secs_f64(f64::from(due) / f64::from(rate));
                std::thread::sleep(next.saturating_sub(begin.elapsed()));
            }
            sent
        }))
    }

    fn end(self) -> Sent {
        self.0.join().unwrap()
    }
}

/// Receives numbered frames, and checks that none is missing.
#[derive(Debug, Default)]
struct Panel {
    rest: Vec<u8>,
    frames: u64,
}

impl Panel {
    const FRAME: usize = 16;

    #[track_caller]
    fn take(&mut self, bytes: &[u8]) {
        self.rest.extend_from_slice(bytes);
        let whole = self.rest.len() / Self::FRAME * Self::FRAME;
        for frame in self.rest[..whole].chunks_exact(Self::FRAME) {
            assert_eq!((&frame[..2], &frame[14..]), (&[0xFF, 0xFF][..], &[0xFE, 0xFE][..]), "{frame:02X?}");
            let number = u32::from_le_bytes(frame[2..6].try_into().unwrap());
            assert_eq!(u64::from(number), self.frames, "a frame of the panel is missing, or comes twice");
            self.frames += 1;
        }
        self.rest.drain(..whole);
    }
}

/// Same on CAN, for all ids in turn.
#[derive(Debug, Default)]
struct Bus {
    rest: Vec<u8>,
    frames: u64,
}

impl Bus {
    #[track_caller]
    fn take(&mut self, bytes: &[u8]) {
        self.rest.extend_from_slice(bytes);
        let whole = self.rest.iter().rposition(|&byte| byte == b'\r').map_or(0, |at| at + 1);
        for line in self.rest[..whole].split(|&byte| byte == b'\r') {
            // A `z` confirms a frame that was sent.
            let line = line.trim_ascii();
            let Some(at) = line.iter().position(|&byte| byte == b't') else { continue };
            let text = std::str::from_utf8(&line[at..]).unwrap();
            let (cycle, nth) = (self.frames / CAN_OUT.len() as u64, self.frames as usize % CAN_OUT.len());
            let id = u16::from_str_radix(&text[1..4], 16).unwrap();
            let number = u32::from_str_radix(&text[5..13], 16).unwrap().swap_bytes();
            assert_eq!(
                (id, u64::from(number)),
                (CAN_OUT[nth], cycle),
                "a CAN frame is missing, or comes twice"
            );
            self.frames += 1;
        }
        self.rest.drain(..whole);
    }
}
