//! The program of this crate in real time: its sockets, its pace, and that it leaves nothing behind. Whole cells
//! are in `host-sim/tests/scenarios`.

use std::fs::File;
use std::io::{BufRead, BufReader, Read, Write};
use std::os::unix::net::UnixStream;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};

use rustix::process::{Pid, Signal, kill_process};
use serde_json::Value;
use tempfile::TempDir;

use crate::bench::image_of;

/// Sends without a controller: `FF 01` on a line at 9600 baud, a counter on CAN.
const TALKER: &str = r#"
[controller]
address = "10.0.2.2"

[[recipe]]
name = "shown"
kind = "stream"
mode = "user"
[recipe.input]
head = [255]
tail = [238]
fields = [{ name = "value", type = "word", to = "WordInputReg[1]" }]
[recipe.output]
head = [255]
fields = [{ name = "always", type = "byte", value = 1 }]

[[recipe]]
name = "counted"
kind = "can"
mode = "user"
[[recipe.output.frame]]
id = 2
fields = [{ name = "number", type = "dword", from = "counter" }]

[[port]]
name = "line"
bus = "rs485"
baud = 9600
recipe = "shown"
cycle_ms = 20

[[port]]
name = "bus"
bus = "can"
bitrate = 500000
recipe = "counted"
cycle_ms = 20
"#;
const PATIENCE: Duration = Duration::from_secs(30);

#[track_caller]
fn until<T>(what: &str, mut look: impl FnMut() -> Option<T>) -> T {
    let deadline = Instant::now() + PATIENCE;
    loop {
        if let Some(found) = look() {
            return found;
        }
        assert!(Instant::now() < deadline, "not within {PATIENCE:?}: {what}");
        std::thread::sleep(Duration::from_millis(5));
    }
}

/// The running program; killed if it has not ended.
struct RealtimeProcess {
    child: Child,
    folder: TempDir,
}

impl RealtimeProcess {
    fn start() -> Self {
        let folder = tempfile::tempdir().unwrap();
        let place = |name: &str| folder.path().join(name);
        std::fs::write(place("image"), image_of(TALKER)).unwrap();
        let mut command = Command::new(env!("CARGO_BIN_EXE_chip-model"));
        command.arg(std::env::var_os("CHIP_ELF").unwrap()).arg(place("image")).arg("--realtime");
        command.arg("--rs485").arg(place("line")).arg("--can").arg(place("bus"));
        command.args(["--network", "", "--qmp"]).arg(place("qmp")).arg("--control").arg(place("control"));
        command.stdout(File::create(place("log")).unwrap()).stderr(Stdio::null());
        Self { child: command.spawn().unwrap(), folder }
    }

    fn place(&self, name: &str) -> PathBuf {
        self.folder.path().join(name)
    }

    fn log(&self) -> String {
        std::fs::read_to_string(self.place("log")).unwrap()
    }

    #[track_caller]
    fn connect(&self, name: &str) -> UnixStream {
        let stream = until(name, || UnixStream::connect(self.place(name)).ok());
        stream.set_read_timeout(Some(PATIENCE)).unwrap();
        stream
    }

    #[track_caller]
    fn until_log(&self, text: &str) {
        until(text, || self.log().contains(text).then_some(()));
    }

    #[track_caller]
    fn ask(&self, words: &str) -> String {
        let mut stream = self.connect("control");
        stream.write_all(format!("{words}\n").as_bytes()).unwrap();
        let mut line = String::new();
        BufReader::new(stream).read_line(&mut line).unwrap();
        line.trim_end().to_owned()
    }

    #[track_caller]
    fn figures(&self) -> Value {
        serde_json::from_str(&self.ask("figures")).unwrap()
    }

    /// QEMU's process, once it runs.
    #[track_caller]
    fn qemu(&self) -> PathBuf {
        let pid = self.child.id();
        until("QEMU", || {
            let children = std::fs::read_to_string(format!("/proc/{pid}/task/{pid}/children")).ok()?;
            let child = Path::new("/proc").join(children.split_whitespace().next()?);
            let name = std::fs::read_to_string(child.join("comm")).ok()?;
            name.starts_with("qemu").then_some(child)
        })
    }

    fn signal(&self, signal: Signal) {
        kill_process(Pid::from_child(&self.child), signal).unwrap();
    }
}

impl Drop for RealtimeProcess {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

/// Waits until a process has ended, or is a zombie.
#[track_caller]
fn until_gone(process: &Path) {
    until("QEMU's end", || match std::fs::read_to_string(process.join("stat")) {
        Ok(stat) => stat.contains(") Z ").then_some(()),
        Err(_) => Some(()),
    });
}

#[test]
#[ignore = "needs CHIP_UNICORN and CHIP_ELF"]
fn a_line_has_its_speed_and_virtual_time_is_never_ahead() {
    let board = RealtimeProcess::start();
    board.until_log("configuration: ");
    let mut line = board.connect("line");
    // The connection may begin in the middle of a frame.
    let mut bytes = [0; 40];
    line.read_exact(&mut bytes[..1]).unwrap();
    let whole = usize::from(bytes[0] == 0xFF);
    line.read_exact(&mut bytes[whole..]).unwrap();
    assert_eq!(bytes, [0xFF, 1].repeat(20)[..]);
    let before = board.figures();
    line.write_all(&[0xFF, 7, 0, 0xEE].repeat(120)).unwrap();
    let after = until("all bytes are on the line", || {
        let figures = board.figures();
        (figures["serial_in"] == 480).then_some(figures)
    });
    let seconds = |figures: &Value, name: &str| figures[name].as_f64().unwrap();
    // The characters of the last two milliseconds are scheduled ahead.
    let taken = seconds(&after, "virtual_s") - seconds(&before, "virtual_s");
    assert!(taken > 0.49, "480 characters at 9600 baud in {taken} s");
    for figures in [before, after] {
        assert!(seconds(&figures, "virtual_s") <= seconds(&figures, "wall_s"), "{figures}");
    }
    board.until_log(": in 120 frames, 480 bytes");
}

#[test]
#[ignore = "needs CHIP_UNICORN and CHIP_ELF"]
fn clients_acknowledge_and_hear_each_other() {
    let board = RealtimeProcess::start();
    board.until_log("frames are not acknowledged by any node");
    let mut clients = [board.connect("bus"), board.connect("bus")];
    for client in &mut clients {
        client.write_all(b"O\r").unwrap();
        let mut answer = [0];
        client.read_exact(&mut answer).unwrap();
        assert_eq!(answer, *b"\r");
    }
    let [mut first, second] = clients;
    let mut second = BufReader::new(second);
    let mut next = || {
        let mut line = Vec::new();
        second.read_until(b'\r', &mut line).unwrap();
        String::from_utf8(line).unwrap()
    };
    // Earlier frames may come first.
    let number = |line: &str| u32::from_str_radix(&line[5..13], 16).unwrap().swap_bytes();
    let mut before = number(&next());
    until("two frames without a gap", || {
        let now = number(&next());
        (now == std::mem::replace(&mut before, now) + 1).then_some(())
    });
    first.write_all(b"t1232BEEF\r").unwrap();
    until("the other's frame", || (next() == "t1232BEEF\r").then_some(()));
    // A sender gets the answer to its command, and all frames but its own.
    let mut heard = BufReader::new(first);
    let mut lines = std::iter::from_fn(|| {
        let mut line = Vec::new();
        heard.read_until(b'\r', &mut line).unwrap();
        Some(String::from_utf8(line).unwrap())
    });
    let answer = lines.find(|line| !line.starts_with("t002")).unwrap();
    assert_eq!(answer, "z\r");
    let later = lines.next().unwrap();
    assert!(later.starts_with("t0024"), "{later}");
    assert_eq!(board.figures()["can_in"], 1);
}

#[test]
#[ignore = "needs CHIP_UNICORN and CHIP_ELF"]
fn time_can_be_stopped() {
    let board = RealtimeProcess::start();
    board.until_log("configuration: ");
    let now = || board.figures()["virtual_s"].as_f64().unwrap();
    assert_eq!(board.ask("stop"), "done");
    // It may have to catch up first.
    let still = until("time to stand still", || {
        let before = now();
        let begin = Instant::now();
        while begin.elapsed() < Duration::from_millis(300) {
            board.ask("figures");
        }
        (now() == before).then_some(before)
    });
    let going = Instant::now();
    assert_eq!(board.ask("go"), "done");
    let after = until("time to go on", || Some(now()).filter(|now| *now > still + 0.2));
    // The pause does not count as lag.
    assert!(after - still <= going.elapsed().as_secs_f64(), "{still} s, then {after} s");
    assert_eq!(board.ask("sto"), "unknown: sto");
}

#[test]
#[ignore = "needs CHIP_UNICORN and CHIP_ELF"]
fn the_button_can_be_pressed_and_the_leds_seen() {
    let board = RealtimeProcess::start();
    board.until_log("configuration: ");
    assert_eq!(board.ask("press 200"), "done");
    assert_eq!(board.ask("press long"), "a number of milliseconds is needed: press long");
    // The status LED blinks.
    let leds = until("four changes of LD1", || {
        let leds: Value = serde_json::from_str(&board.ask("leds")).unwrap();
        (leds["LD1"].as_array()?.len() >= 4).then_some(leds)
    });
    let changes = leds["LD1"].as_array().unwrap();
    assert!(changes.windows(2).all(|pair| pair[0][1] != pair[1][1]), "{leds}");
    assert!(changes.is_sorted_by_key(|change| change[0].as_f64().map(|ms| ms as u64)), "{leds}");
    assert_eq!(leds["LD3"], Value::Array(Vec::new()));
}

#[test]
#[ignore = "needs CHIP_UNICORN and CHIP_ELF"]
fn ctrl_c_ends_it_and_leaves_nothing() {
    let mut board = RealtimeProcess::start();
    board.until_log(" address 10.0.2.15");
    let qemu = board.qemu();
    board.signal(Signal::INT);
    let status = until("its end", || board.child.try_wait().unwrap());
    assert_eq!(status.code(), Some(0));
    until_gone(&qemu);
    let figures: Value = serde_json::from_str(board.log().lines().last().unwrap()).unwrap();
    assert_eq!((&figures["resets"], &figures["restarts"]), (&Value::from(0), &Value::from(0)));
    for socket in ["line", "bus", "qmp", "control"] {
        assert!(!board.place(socket).exists(), "{socket}");
    }
}

#[test]
#[ignore = "needs CHIP_UNICORN and CHIP_ELF"]
fn killed_it_takes_qemu_with_it() {
    let mut board = RealtimeProcess::start();
    board.until_log(" address 10.0.2.15");
    let qemu = board.qemu();
    board.signal(Signal::KILL);
    board.child.wait().unwrap();
    until_gone(&qemu);
}
