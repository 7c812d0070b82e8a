//! The program as a person or a script runs it: real processes, real signals.

use std::io::{BufRead, BufReader, Read};
use std::os::unix::process::ExitStatusExt;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Output, Stdio};
use std::time::{Duration, Instant};

use serde_json::Value;

fn host_sim() -> Command {
    let mut command = Command::new(env!("CARGO_BIN_EXE_host-sim"));
    command.stdin(Stdio::null()).stdout(Stdio::piped()).stderr(Stdio::piped());
    command
}

fn example(name: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("configs").join(name)
}

/// A running process that is killed when a test fails.
struct Running {
    child: Child,
    lines: std::sync::mpsc::Receiver<String>,
    ready: Value,
}

const PATIENCE: Duration = Duration::from_secs(20);

impl Running {
    #[track_caller]
    fn start(command: &mut Command) -> Self {
        let mut child = command.spawn().unwrap();
        let out = BufReader::new(child.stdout.take().unwrap());
        let (sender, lines) = std::sync::mpsc::channel();
        std::thread::spawn(move || {
            for line in out.lines() {
                let Ok(line) = line else { return };
                if sender.send(line).is_err() {
                    return;
                }
            }
        });
        let mut running = Self { child, lines, ready: Value::Null };
        let line = running.line();
        let json = line.strip_prefix("ready ").unwrap_or_else(|| panic!("not ready: {line}"));
        running.ready = serde_json::from_str(json).unwrap();
        running
    }

    #[track_caller]
    fn line(&mut self) -> String {
        self.lines.recv_timeout(PATIENCE).unwrap_or_else(|_| {
            let mut said = String::new();
            let _ = self.child.kill();
            let _ = self.child.stderr.take().unwrap().read_to_string(&mut said);
            panic!("no line in time; stderr: {said}")
        })
    }

    /// A line of statistics that satisfies `found`.
    #[track_caller]
    fn stats(&mut self, found: impl Fn(&Value) -> bool) -> Value {
        let deadline = Instant::now() + PATIENCE;
        loop {
            let stats: Value = serde_json::from_str(&self.line()).unwrap();
            if found(&stats) {
                return stats;
            }
            assert!(Instant::now() < deadline, "it never became so: {stats}");
        }
    }

    #[track_caller]
    fn signal(&self, signal: &str) {
        let pid = self.child.id().to_string();
        assert!(Command::new("kill").args(["-s", signal, &pid]).status().unwrap().success());
    }

    /// Stops the process, and returns once none of its threads runs.
    fn stop(&self) {
        self.signal("STOP");
        let tasks = format!("/proc/{}/task", self.child.id());
        let is_stopped = |task: std::io::Result<std::fs::DirEntry>| {
            let stat = std::fs::read_to_string(task.unwrap().path().join("stat")).unwrap();
            stat.rsplit_once(") ").unwrap().1.starts_with('T')
        };
        let deadline = Instant::now() + PATIENCE;
        while !std::fs::read_dir(&tasks).unwrap().all(is_stopped) {
            assert!(Instant::now() < deadline, "it does not stop");
            std::thread::yield_now();
        }
    }

    #[track_caller]
    fn end(mut self, signal: &str) {
        self.signal(signal);
        let status = self.child.wait().unwrap();
        assert_eq!((status.code(), status.signal()), (Some(0), None), "{signal}");
    }
}

impl Drop for Running {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

fn text(output: &Output) -> (String, String) {
    let text = |bytes: &[u8]| String::from_utf8_lossy(bytes).into_owned();
    (text(&output.stdout), text(&output.stderr))
}

#[test]
fn without_arguments_the_demo_passes() {
    let output = host_sim().output().unwrap();
    let (out, err) = text(&output);
    assert_eq!(output.status.code(), Some(0), "{out}\n{err}");
    let verdicts = |word: &str| out.lines().filter(|line| line.trim_start().starts_with(word)).count();
    assert_eq!((verdicts("PASS"), verdicts("FAIL")), (13, 0), "six examples twice, and the sum:\n{out}");
    for bytes in [
        "FF FF 01 02 03 EE EE",
        "FF FF 7D 7D 7D FE FE",
        "EF 54 EF 3E A7 E7 D1 3E",
        "FF FF 39 2F 0B BF 86 87 13 3F BF BD 9D 3F 37 FC C8 BF 17 A0 1B BF 59 FC EA BE FE FE",
    ] {
        assert!(out.matches(bytes).count() >= 2, "{bytes}:\n{out}");
    }
    assert!(!out.contains('\u{1b}'), "no colours off a terminal");
}

#[test]
fn a_gateway_and_a_controller_find_each_other_and_end_cleanly() {
    let folder = tempfile::tempdir().unwrap();
    let robot_ready = folder.path().join("robot.json");
    let line = folder.path().join("rs485-1");
    let mut robot = Running::start(
        host_sim()
            .args(["controller", "--stats", "50ms", "-c"])
            .arg(example("udp-server-controller.toml"))
            .args(["command", "state", "modbus", "udp2011"].map(|port| format!("--set=listen.{port}=0")))
            .arg("--ready")
            .arg(&robot_ready),
    );
    let file: Value = serde_json::from_str(&std::fs::read_to_string(&robot_ready).unwrap()).unwrap();
    assert_eq!(file, robot.ready, "the file says what the line says");
    let ready = robot.ready.clone();
    let port = |name: &str| ready[name].as_str().unwrap().rsplit_once(':').unwrap().1.to_owned();
    let mut gateway = Running::start(
        host_sim()
            .args(["gateway", "--stats", "50ms", "-c"])
            .arg(example("rs485-system.toml"))
            .args(["state", "modbus"].map(|name| format!("--set=controller.ports.{name}={}", port(name))))
            .arg(format!("--bind=rs485-1=pty:{}", line.display())),
    );
    assert_eq!(gateway.ready["ports"]["rs485-1"], line.to_str().unwrap());
    gateway
        .stats(|stats| stats["links"]["modbus"]["state"] == "up" && stats["links"]["state"]["received"] != 0);

    let mut device = std::fs::File::options().read(true).write(true).open(&line).unwrap();
    std::io::Write::write_all(&mut device, &[0x12, 0xFF, 0xFF, 0x05, 0xEE, 0xEE]).unwrap();
    let stats = gateway.stats(|stats| stats["ports"]["rs485-1"]["frames_in"] == 1);
    assert_eq!(stats["ports"]["rs485-1"]["resync_bytes"], 1);
    robot.stats(|stats| stats["registers"]["DigitalOutputCommand[1]"].as_f64() == Some(5.0));

    // The controller goes away and comes back on the same ports.
    let ports =
        ["command", "state", "modbus", "udp2011"].map(|name| format!("--set=listen.{name}={}", port(name)));
    robot.end("TERM");
    assert!(!robot_ready.exists(), "nothing says ready that is not");
    gateway.stats(|stats| stats["links"]["modbus"]["state"] != "up");
    let mut robot = Running::start(
        host_sim()
            .args(["controller", "--stats", "50ms", "-c"])
            .arg(example("udp-server-controller.toml"))
            .args(ports),
    );
    gateway.stats(|stats| {
        stats["links"]["modbus"]["state"] == "up" && stats["links"]["modbus"]["reconnects"] != 0
    });
    std::io::Write::write_all(&mut device, &[0xFF, 0xFF, 0x80, 0xEE, 0xEE]).unwrap();
    robot.stats(|stats| stats["registers"]["DigitalOutputCommand[1]"].as_f64() == Some(128.0));

    gateway.end("INT");
    assert!(line.symlink_metadata().is_err(), "the link is removed");
    robot.end("INT");
}

#[test]
fn what_a_device_said_while_the_gateway_was_stopped_never_reaches_the_controller() {
    let folder = tempfile::tempdir().unwrap();
    let line = folder.path().join("rs485-1");
    let mut robot = Running::start(
        host_sim()
            .args(["controller", "--stats", "10ms", "-c"])
            .arg(example("udp-server-controller.toml"))
            .args(["command", "state", "modbus", "udp2011"].map(|port| format!("--set=listen.{port}=0"))),
    );
    let ready = robot.ready.clone();
    let port = |name: &str| ready[name].as_str().unwrap().rsplit_once(':').unwrap().1.to_owned();
    let mut gateway = Running::start(
        host_sim()
            .args(["gateway", "--stats", "50ms", "-c"])
            .arg(example("rs485-system.toml"))
            .args(["state", "modbus"].map(|name| format!("--set=controller.ports.{name}={}", port(name))))
            .arg(format!("--bind=rs485-1=pty:{}", line.display())),
    );
    let is_up = |stats: &Value| stats["links"]["modbus"]["state"] == "up";
    let output = |stats: &Value| stats["registers"]["DigitalOutputCommand[1]"].as_f64();
    gateway.stats(is_up);
    let mut device = std::fs::File::options().read(true).write(true).open(&line).unwrap();
    let mut say = |value: u8| {
        std::io::Write::write_all(&mut device, &[0xFF, 0xFF, value, 0xEE, 0xEE]).unwrap();
    };
    say(1);
    robot.stats(|stats| output(stats) == Some(1.0));
    gateway.stop();
    for _ in 0..100 {
        say(2);
    }
    std::thread::sleep(STOPPED);
    gateway.signal("CONT");
    let woken = gateway.stats(|stats| stats["sleeps"] == 1);
    assert_eq!(woken["ports"]["rs485-1"]["frames_in"], 1, "{woken}");
    assert_ne!(woken["ports"]["rs485-1"]["asleep"], 0, "{woken}");
    gateway.stats(|stats| is_up(stats) && stats["links"]["modbus"]["reconnects"] != 0);
    say(4);
    robot.stats(|stats| {
        assert_ne!(output(stats), Some(2.0));
        output(stats) == Some(4.0)
    });
    gateway.end("TERM");
    robot.end("TERM");
}

/// Longer than a gateway may be away without having slept.
const STOPPED: Duration = Duration::from_millis(800);

#[test]
fn what_cannot_start_says_why_and_exits_with_2() {
    let file = example("rs485-system.toml");
    for (arguments, message) in [
        (vec![], "port rs485-1 needs exactly one device: --bind rs485-1=DEVICE"),
        (vec!["--bind=rs485-2=pty:/tmp/x"], "no such port; there are: rs485-1"),
        (vec!["--bind=rs485-1=socketcan:vcan0"], "socketcan"),
        (vec!["--bind=rs485-1=serial:/dev/does-not-exist"], "/dev/does-not-exist"),
        (vec!["--bind=rs485-1"], "NAME=DEVICE"),
    ] {
        let output = host_sim().args(["gateway", "-c"]).arg(&file).args(&arguments).output().unwrap();
        let (out, err) = text(&output);
        assert_eq!(output.status.code(), Some(2), "{arguments:?}: {err}");
        assert!(err.contains(message), "{arguments:?}: {err}");
        assert_eq!(out, "", "nothing was started");
    }
}
