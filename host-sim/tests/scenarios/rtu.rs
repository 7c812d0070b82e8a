//! Modbus RTU: the gateway as the master of a drive, and as the slave of a PLC.

use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, MutexGuard};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use proto_core::modbus::rtu::{Adu, Echo, MAX_ADU, Slave, Timing};
use proto_core::modbus::server::RegisterBank;
use proto_core::modbus::{Coils, Exception, Registers};
use proto_core::time;
use recipe_test_kit::until;

use super::case::{Case, Scenario};
use super::environment::{Gateway, Link};
use super::field::LineClient;
use super::robot::Robot;

pub(crate) fn all() -> Vec<Scenario> {
    vec![
        Scenario::new("a_drive_on_modbus_rtu_is_asked_and_written", drive),
        Scenario::new("a_plc_on_modbus_rtu_writes_and_reads_blocks", plc),
    ]
}

/// The gateway writes the robot's speed when it changes, and reads the actual one.
const DRIVE: &str = r#"
[controller]
address = "127.0.0.1"

[[recipe]]
name = "drive"
kind = "modbus-rtu"

[[recipe.exchange]]
slave = 3
function = "write-registers"
address = 32
on = ["start", "change"]
timeout_ms = 300
write = [{ name = "speed", type = "word", from = "WordOutputReg[1]" }, { name = "run", type = "word", value = 1 }]

[[recipe.exchange]]
slave = 3
function = "read-holding-registers"
address = 16
every_ms = 50
timeout_ms = 300
read = [{ name = "actual", type = "word", to = "WordInputReg[1]" }]

[[port]]
name = "drive"
bus = "modbus-rtu"
baud = 115200
recipe = "drive"
timeout_ms = 1000
# It has forgotten everything after half a second without power.
absent_ms = 500
on_timeout = { "WordInputReg[1]" = 65000 }
"#;
const SPEED: usize = 32;
const ACTUAL: usize = 16;
const SAFE: f64 = 65_000.0;

/// A robot whose program changes the speed.
const ROBOT: &str = r#"
[initial]
"WordOutputReg[1]" = 1200

[[program]]
name = "faster.jspf"
script = 'set("WordOutputReg[1]", 1500);'
"#;

fn drive(case: &Case) {
    let robot = case.robot_of(ROBOT).start();
    let mut gateway = case.gateway_of(DRIVE).robot(&robot).start();
    let drive = Drive::on(gateway.line("drive"), 3);
    drive.set(ACTUAL, 900);
    gateway.until_up(Link::Modbus, 1);
    robot.until("WordInputReg[1]", 900.0);
    until_drive_has(&mut *gateway, &drive, [1200, 1]);
    robot.command("run(faster.jspf)", "run start");
    until_drive_has(&mut *gateway, &drive, [1500, 1]);
    drive.set(ACTUAL, 901);
    robot.until("WordInputReg[1]", 901.0);

    // Damaged replies: their value never arrives, and after the port's timeout the safe value does.
    drive.answers(Answers::WithWrongCrc);
    drive.set(ACTUAL, 666);
    let mut has_been = |wanted: f64, damaged: u32| {
        until(&format!("WordInputReg[1] = {wanted} after {damaged} damaged replies"), || {
            gateway.must_run();
            let value = robot.newest("WordInputReg[1]");
            assert!([901.0, SAFE, 902.0].contains(&value), "{value} came in a damaged reply");
            (value == wanted && drive.damaged() >= damaged).then_some(())
        });
    };
    has_been(SAFE, 3);
    drive.set(ACTUAL, 902);
    drive.answers(Answers::Well);
    has_been(902.0, 3);

    // It loses its power, and has forgotten the speed when it is back.
    drive.answers(Answers::Nothing);
    robot.until("WordInputReg[1]", SAFE);
    // It was away for its time once two more questions were not answered in time, which the third one tells.
    drive.until_unanswered(3);
    drive.set(SPEED, 0);
    drive.set(SPEED + 1, 0);
    drive.set(ACTUAL, 903);
    drive.answers(Answers::Well);
    robot.until("WordInputReg[1]", 903.0);
    until_drive_has(&mut *gateway, &drive, [1500, 1]);
}

#[track_caller]
fn until_drive_has(gateway: &mut dyn Gateway, drive: &Drive, wanted: [u16; 2]) {
    until(&format!("{wanted:?} in the drive"), || {
        gateway.must_run();
        (drive.registers()[SPEED..SPEED + 2] == wanted).then_some(())
    });
}

/// The gateway answers a PLC.
const PLC: &str = r#"
[controller]
address = "127.0.0.1"

[[recipe]]
name = "plc"
kind = "modbus-rtu-slave"
address = 5

[[recipe.block]]
table = "holding-registers"
address = 100
fields = [
    { name = "job", type = "word", to = "WordInputReg[1]" },
    { name = "place", type = "int", to = "WordInputReg[2]", scale = 0.1 },
]

[[recipe.block]]
table = "input-registers"
address = 0
fields = [{ name = "part", type = "word", from = "WordOutputReg[1]" }]

[[port]]
name = "plc"
bus = "modbus-rtu-slave"
baud = 115200
recipe = "plc"
timeout_ms = 2000
on_timeout = { "WordInputReg[1]" = 0 }
"#;
/// The end of a frame. An emulated UART gets a frame in pieces, and one that is cut is asked again.
const SILENCE_MS: u32 = 20;

fn plc(case: &Case) {
    let robot = case.robot_of(ROBOT).start();
    let plan = case.gateway_of(PLC).set("port.plc.idle_gap_ms", SILENCE_MS);
    let mut gateway = plan.robot(&robot).start();
    gateway.until_up(Link::Modbus, 1);
    let mut plc = Plc::on(gateway.line("plc"));
    plc.block = [7, 0, 1230];
    plc.until(&mut *gateway, &robot, "the block at the robot", |robot, _| {
        robot.newest("WordInputReg[1]") == 7.0 && robot.newest("WordInputReg[2]") == 123.0
    });
    plc.until(&mut *gateway, &robot, "the robot's output at the PLC", |_, read| read == [1200]);
    robot.command("run(faster.jspf)", "run start");
    plc.until(&mut *gateway, &robot, "the new output at the PLC", |_, read| read == [1500]);
    // Its line gives a false byte before each request and one behind it.
    plc.is_noisy = true;
    plc.block = [8, 0, 1240];
    plc.until(&mut *gateway, &robot, "the second block at the robot", |robot, _| {
        robot.newest("WordInputReg[1]") == 8.0 && robot.newest("WordInputReg[2]") == 124.0
    });
    // A request with a wrong CRC is not carried out, and a silent PLC is noticed.
    plc.line.send(&[5, 16, 0, 100, 0, 3, 6, 0, 9, 0, 0, 0, 0, 0, 0]);
    until("the safe value", || {
        gateway.must_run();
        let value = robot.newest("WordInputReg[1]");
        assert!(value != 9.0, "a damaged request was carried out");
        (value == 0.0).then_some(())
    });
}

fn timing() -> Timing {
    Timing::new(115_200, 10).with_silence(time::Duration::from_millis(SILENCE_MS.into()))
}

/// The time of the other end of a line.
struct Clock(std::time::Instant);

impl Clock {
    fn now(&self) -> time::Instant {
        time::Instant::ZERO + time::Duration::from(self.0.elapsed())
    }
}

/// How a drive answers.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Answers {
    Well,
    WithWrongCrc,
    Nothing,
}

/// What the thread of a drive and its scenario share.
struct Inside {
    registers: [u16; 64],
    answers: Answers,
    damaged: u32,
    /// What was asked and written while it answered nothing.
    unanswered: u32,
}

/// A drive with registers on a line.
struct Drive {
    inside: Arc<Mutex<Inside>>,
    is_over: Arc<AtomicBool>,
    thread: Option<JoinHandle<()>>,
}

impl Drive {
    fn on(mut line: LineClient, address: u8) -> Self {
        let inside = Inside { registers: [0; 64], answers: Answers::Well, damaged: 0, unanswered: 0 };
        let (inside, is_over) = (Arc::new(Mutex::new(inside)), Arc::<AtomicBool>::default());
        let (own, ends) = (Arc::clone(&inside), Arc::clone(&is_over));
        let mut slave = Slave::new(timing(), Echo::Absent, address).unwrap();
        let thread = std::thread::spawn(move || {
            let (clock, mut out) = (Clock(std::time::Instant::now()), [0; MAX_ADU]);
            while !ends.load(Ordering::SeqCst) {
                slave.received(&line.take_some(PIECE), clock.now());
                let mut inside = own.lock().unwrap();
                let Some(len) = slave.poll(clock.now(), &mut *inside, &mut out) else { continue };
                match inside.answers {
                    Answers::Well => line.send(&out[..len]),
                    Answers::WithWrongCrc => {
                        inside.damaged += 1;
                        out[len - 1] ^= 0x10;
                        line.send(&out[..len]);
                    }
                    Answers::Nothing => inside.unanswered += 1,
                }
            }
        });
        Self { inside, is_over, thread: Some(thread) }
    }

    fn inside(&self) -> MutexGuard<'_, Inside> {
        self.inside.lock().unwrap()
    }

    fn set(&self, register: usize, value: u16) {
        self.inside().registers[register] = value;
    }

    fn registers(&self) -> [u16; 64] {
        self.inside().registers
    }

    fn answers(&self, answers: Answers) {
        self.inside().answers = answers;
    }

    /// Waits until so many more requests came that it does not answer.
    #[track_caller]
    fn until_unanswered(&self, count: u32) {
        let wanted = self.inside().unanswered + count;
        until("requests without an answer", || (self.inside().unanswered >= wanted).then_some(()));
    }

    /// Replies with a wrong CRC so far.
    fn damaged(&self) -> u32 {
        self.inside().damaged
    }
}

impl Drop for Drive {
    fn drop(&mut self) {
        self.is_over.store(true, Ordering::SeqCst);
        let _ = self.thread.take().map(JoinHandle::join);
    }
}

/// A drive without power hears nothing, so it does not write either.
impl RegisterBank for Inside {
    fn read_coils(&self, _: u16, _: u16, _: &mut [u8]) -> Result<(), Exception> {
        Err(Exception::IllegalDataAddress)
    }

    fn write_coils(&mut self, _: u16, _: Coils<'_>) -> Result<(), Exception> {
        Err(Exception::IllegalDataAddress)
    }

    fn read_holding(&self, address: u16, words: &mut [[u8; 2]]) -> Result<(), Exception> {
        let values = self.registers.get(usize::from(address)..).unwrap_or(&[]);
        let values = values.get(..words.len()).ok_or(Exception::IllegalDataAddress)?;
        words.iter_mut().zip(values).for_each(|(word, value)| *word = value.to_be_bytes());
        Ok(())
    }

    fn write_holding(&mut self, address: u16, registers: Registers<'_>) -> Result<(), Exception> {
        if self.answers == Answers::Nothing {
            return Err(Exception::DeviceFailure);
        }
        let places = self.registers.get_mut(usize::from(address)..).unwrap_or(&mut []);
        let places = places.get_mut(..usize::from(registers.count())).ok_or(Exception::IllegalDataAddress)?;
        places.iter_mut().zip(registers.iter()).for_each(|(place, value)| *place = value);
        Ok(())
    }
}

/// A PLC that writes a block and reads another, in turn. It repeats a request that has no reply.
struct Plc {
    line: LineClient,
    block: [u16; 3],
    read: Vec<u16>,
    request: Option<Request>,
    /// The newest request was a write.
    has_written: bool,
    /// The line gives a byte when its direction changes.
    is_noisy: bool,
}

/// A request without a reply yet.
struct Request {
    frame: Vec<u8>,
    at: Instant,
    received: Vec<u8>,
}

impl Plc {
    const TIMEOUT: Duration = Duration::from_millis(500);

    fn on(line: LineClient) -> Self {
        Self { line, block: [0; 3], read: Vec::new(), request: None, has_written: false, is_noisy: false }
    }

    /// Asks until the robot, and what was read last, are as wanted. Then the line is silent.
    #[track_caller]
    fn until(
        &mut self,
        gateway: &mut dyn Gateway,
        robot: &Robot,
        what: &str,
        found: impl Fn(&Robot, &[u16]) -> bool,
    ) {
        until(what, || {
            gateway.must_run();
            self.turn();
            (self.request.is_none() && found(robot, &self.read)).then_some(())
        });
    }

    /// Sends a request, or looks for the reply to it.
    fn turn(&mut self) {
        let bytes = self.line.take_some(PIECE);
        let Some(request) = &mut self.request else {
            self.has_written = !self.has_written;
            let pdu = if self.has_written {
                let values = self.block.iter().flat_map(|word| word.to_be_bytes());
                [16, 0, 100, 0, 3, 6].into_iter().chain(values).collect()
            } else {
                vec![4, 0, 0, 0, 1]
            };
            return self.send(&framed(&pdu));
        };
        request.received.extend(bytes);
        let (len, words) = if self.has_written { (8, None) } else { (7, Some(3..5)) };
        let reply =
            request.received.windows(len).find(|bytes| bytes[0] == SLAVE && Adu::parse(bytes).is_ok());
        if let Some(reply) = reply {
            if let Some(words) = words {
                self.read =
                    reply[words].chunks(2).map(|word| u16::from_be_bytes([word[0], word[1]])).collect();
            }
            self.request = None;
        } else if request.at.elapsed() > Self::TIMEOUT {
            let frame = std::mem::take(&mut request.frame);
            self.send(&frame);
        }
    }

    fn send(&mut self, frame: &[u8]) {
        if self.is_noisy {
            self.line.send(&[&[0], frame, &[0xFF]].concat());
        } else {
            self.line.send(frame);
        }
        self.request = Some(Request { frame: frame.to_vec(), at: Instant::now(), received: Vec::new() });
    }
}

/// The gateway's address.
const SLAVE: u8 = 5;

/// A request to the gateway.
fn framed(pdu: &[u8]) -> Vec<u8> {
    let mut frame = [0; MAX_ADU];
    let len = Adu { address: SLAVE, pdu }.encode(&mut frame).unwrap();
    frame[..len].to_vec()
}

/// Longest wait for bytes, so that silences are noticed.
const PIECE: Duration = Duration::from_millis(2);
