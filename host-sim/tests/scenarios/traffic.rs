//! What a cell at full load gets, and what its devices hear of it: all numbered, so that none is missed.

use std::io::Write;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use super::field::slcan;

/// Frames per second of the force sensor.
pub(crate) const SENSOR_RATE: u32 = 960;
/// Frames per second that come on CAN.
pub(crate) const CAN_RATE: u32 = 500;
/// Ids that are sent on CAN each cycle.
const CAN_OUT: [u16; 3] = [2, 3, 4];

/// A force sensor; a panel that receives words and a count each cycle; a CAN bus with a count in, and three
/// frames out each cycle. Words use Modbus: one write per CAN frame, and one poll per cycle.
pub(crate) const CELL: &str = r#"
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

pub(crate) fn sensor_frame(number: u32, frame: &mut Vec<u8>) {
    frame.extend([0x48, 0xAA]);
    for axis in 0_u8..6 {
        frame.extend((number as f32 + f32::from(axis) / 8.0).to_le_bytes());
    }
    frame.extend([0x0D, 0x0A]);
}

pub(crate) fn can_frame(number: u32, line: &mut Vec<u8>) {
    let [a, b, c, d] = number.to_le_bytes();
    line.extend(slcan(1, &[a, b, c, d, a, b, c, d]).bytes());
}

/// Sends numbered frames at a rate, on an absolute grid. Frames that are late leave together.
pub(crate) struct Generator {
    done: Arc<AtomicBool>,
    thread: JoinHandle<Sent>,
}

#[derive(Debug, Default)]
pub(crate) struct Sent {
    pub(crate) frames: u32,
    pub(crate) bytes: u64,
    /// Number of frames that were due before the previous one had left.
    pub(crate) together: u32,
}

impl Generator {
    pub(crate) fn start(rate: u32, mut writer: Box<dyn Write + Send>, frame: fn(u32, &mut Vec<u8>)) -> Self {
        let done = Arc::<AtomicBool>::default();
        let is_done = Arc::clone(&done);
        let thread = std::thread::spawn(move || {
            let begin = Instant::now();
            let mut sent = Sent::default();
            let mut bytes = Vec::new();
            while !is_done.load(Ordering::Relaxed) {
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
        });
        Self { done, thread }
    }

    pub(crate) fn end(self) -> Sent {
        self.done.store(true, Ordering::Relaxed);
        self.thread.join().unwrap()
    }
}

/// Receives numbered frames, and checks that none is missing.
#[derive(Debug, Default)]
pub(crate) struct Panel {
    rest: Vec<u8>,
    pub(crate) frames: u64,
}

impl Panel {
    const FRAME: usize = 16;

    #[track_caller]
    pub(crate) fn take(&mut self, bytes: &[u8]) {
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
pub(crate) struct Bus {
    rest: Vec<u8>,
    pub(crate) frames: u64,
}

impl Bus {
    #[track_caller]
    pub(crate) fn take(&mut self, bytes: &[u8]) {
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
