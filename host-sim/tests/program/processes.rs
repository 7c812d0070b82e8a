//! The program as a person or a script runs it: real processes, real signals.

use std::io::{BufRead, BufReader, Read};
use std::os::fd::OwnedFd;
use std::os::unix::ffi::OsStrExt;
use std::os::unix::process::ExitStatusExt;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Output, Stdio};
use std::time::{Duration, Instant};

use rustix::pty::OpenptFlags;
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
        send(signal, &self.child);
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
        send(signal, &self.child);
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
    shows_all_examples(&host_sim().output().unwrap());
}

#[test]
fn demos_do_not_disturb_each_other() {
    let demos: Vec<Child> = (0..4).map(|_| host_sim().arg("demo").spawn().unwrap()).collect();
    for demo in demos {
        shows_all_examples(&demo.wait_with_output().unwrap());
    }
}

#[track_caller]
fn shows_all_examples(output: &Output) {
    let (out, err) = text(output);
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

/// `gateway` with a pseudoterminal at `line`; its controller is nowhere.
fn gateway(line: &Path) -> Command {
    gateway_of(&example("rs485-system.toml"), line)
}

fn gateway_of(file: &Path, line: &Path) -> Command {
    let mut command = host_sim();
    command.args(["gateway", "-c"]).arg(file);
    command.arg(format!("--bind=rs485-1=pty:{}", line.display()));
    command
}

/// Exit code 2 and one line on stderr, which is returned.
#[track_caller]
fn refused(command: &mut Command) -> String {
    let mut child = command.spawn().unwrap();
    let deadline = Instant::now() + PATIENCE;
    while child.try_wait().unwrap().is_none() {
        if Instant::now() > deadline {
            child.kill().unwrap();
            panic!("{command:?} was started");
        }
        std::thread::sleep(Duration::from_millis(1));
    }
    let output = child.wait_with_output().unwrap();
    let (out, err) = text(&output);
    assert_eq!((output.status.code(), out.as_str(), err.lines().count()), (Some(2), "", 1), "{err}");
    err
}

fn names(folder: &Path) -> Vec<String> {
    let names = std::fs::read_dir(folder).unwrap();
    let mut names: Vec<_> = names.map(|entry| entry.unwrap().file_name().into_string().unwrap()).collect();
    names.sort();
    names
}

#[test]
fn a_ready_file_costs_nobody_anything() {
    let folder = tempfile::tempdir().unwrap();
    let at = |name: &str| folder.path().join(name);
    let (line, file, ready) = (at("line"), at("cell.toml"), at("ready.json"));
    std::fs::copy(example("rs485-system.toml"), &file).unwrap();
    let toml = std::fs::read(&file).unwrap();
    std::fs::create_dir(at("folder")).unwrap();
    for (place, why) in
        [(&file, "there is a file already, and it is none that a run left"), (&at("folder"), "a folder")]
    {
        let message = refused(gateway_of(&file, &line).arg("--ready").arg(place));
        assert!(message.starts_with(&format!("--ready {}: {why}; give ", place.display())), "{message}");
    }
    assert_eq!(std::fs::read(&file).unwrap(), toml);
    assert_eq!(names(folder.path()), ["cell.toml", "folder"], "nothing was started");

    // What a killed run left is replaced; what somebody put there since is not removed.
    let mut first = Running::start(gateway(&line).arg("--ready").arg(&ready));
    first.child.kill().unwrap();
    first.child.wait().unwrap();
    assert!(ready.exists());
    let second = Running::start(gateway(&line).arg("--ready").arg(&ready));
    let said: Value = serde_json::from_str(&std::fs::read_to_string(&ready).unwrap()).unwrap();
    assert_eq!(said, second.ready);
    std::fs::write(&ready, "somebody's").unwrap();
    second.end("TERM");
    assert_eq!(std::fs::read_to_string(&ready).unwrap(), "somebody's");
    assert_eq!(names(folder.path()), ["cell.toml", "folder", "ready.json"]);
}

/// The same program, started with or without hearing SIGHUP, whatever the tests were started with.
fn under(hang_up: &str, command: &Command) -> Command {
    let mut env = Command::new("env");
    env.args(["--default-signal=INT", &format!("--{hang_up}-signal=HUP")]).arg(command.get_program());
    env.args(command.get_args()).stdin(Stdio::null()).stdout(Stdio::piped()).stderr(Stdio::piped());
    env
}

fn send(name: &str, child: &Child) {
    let pid = child.id().to_string();
    assert!(Command::new("kill").args(["-s", name, &pid]).status().unwrap().success());
}

#[test]
fn a_line_that_another_program_uses_is_not_taken_away() {
    let folder = tempfile::tempdir().unwrap();
    let line = folder.path().join("line");
    let mut first = Running::start(&mut gateway(&line));
    let leads_to = std::fs::read_link(&line).unwrap();
    let message = refused(&mut gateway(&line));
    let holder =
        format!("line: another run of host-sim has it, process {}; end that one or give", first.child.id());
    assert!(message.starts_with(&format!("--bind rs485-1=pty:{}: ", line.display())), "{message}");
    assert!(message.contains(&holder), "{message}");
    assert_eq!(std::fs::read_link(&line).unwrap(), leads_to);

    // Killed, it leaves a link to a terminal whose number the next program may get, here this test.
    first.child.kill().unwrap();
    first.child.wait().unwrap();
    assert_eq!(std::fs::read_link(&line).unwrap(), leads_to);
    let (number, foreign) = terminal_called(&leads_to);
    assert!(leads_to.exists());
    Running::start(&mut gateway(&line)).end("TERM");
    assert_eq!(names(folder.path()), [""; 0]);

    // The same link made by that program is in use.
    std::os::unix::fs::symlink(&leads_to, &line).unwrap();
    let message = refused(&mut gateway(&line));
    assert!(
        message.contains(&format!("a link to {}, which a program has open", leads_to.display())),
        "{message}"
    );
    assert_eq!(std::fs::read_link(&line).unwrap(), leads_to);
    drop((number, foreign));
    std::fs::remove_file(&line).unwrap();
    std::os::unix::fs::symlink("/dev/pts/4000000", &line).unwrap();
    Running::start(&mut gateway(&line)).end("TERM");
    assert_eq!(names(folder.path()), [""; 0]);
}

/// A pseudoterminal that is called so, and others that were in its way.
fn terminal_called(name: &Path) -> (OwnedFd, Vec<OwnedFd>) {
    let deadline = Instant::now() + PATIENCE;
    loop {
        let mut others = Vec::new();
        // The system gives away the lowest number that is free. Another test may have this one for a while.
        for _ in 0..64 {
            let master = rustix::pty::openpt(OpenptFlags::RDWR | OpenptFlags::NOCTTY | OpenptFlags::CLOEXEC);
            let master = master.unwrap();
            let own = rustix::pty::ptsname(&master, Vec::new()).unwrap();
            if own.as_bytes() == name.as_os_str().as_bytes() {
                return (master, others);
            }
            others.push(master);
        }
        assert!(Instant::now() < deadline, "{}", name.display());
        drop(others);
        std::thread::sleep(Duration::from_millis(10));
    }
}

#[test]
fn a_terminal_that_is_closed_ends_a_run_cleanly_unless_it_is_to_outlive_it() {
    let folder = tempfile::tempdir().unwrap();
    let (line, ready) = (folder.path().join("line"), folder.path().join("ready.json"));
    let mut robot = host_sim();
    robot.args(["controller", "-c"]).arg(example("rs485-system-controller.toml"));
    robot.args(["command", "state", "modbus", "udp2011"].map(|port| format!("--set=listen.{port}=0")));
    robot.arg(format!("--bind=rs485=pty:{}", line.display()));
    for mut command in [gateway(&line), robot] {
        command.args(["--stats", "20ms", "--ready"]).arg(&ready);
        Running::start(&mut under("default", &command)).end("HUP");
        assert_eq!(names(folder.path()), [""; 0], "{command:?}");
        let mut under_nohup = Running::start(&mut under("ignore", &command));
        send("HUP", &under_nohup.child);
        while under_nohup.lines.try_recv().is_ok() {}
        // More than it could say while it ended.
        (0..20).for_each(|_| drop(under_nohup.line()));
        assert!(line.exists() && ready.exists(), "{command:?}");
        under_nohup.end("TERM");
        assert_eq!(names(folder.path()), [""; 0], "{command:?}");
    }
}

#[test]
fn a_demo_that_is_interrupted_leaves_nothing_behind() {
    for (name, code) in [("HUP", 129), ("INT", 130), ("TERM", 143)] {
        let folder = tempfile::tempdir().unwrap();
        let deadline = Instant::now() + PATIENCE;
        // It may be over before anybody looks; then another one is.
        while interrupted_demo(folder.path(), name) != Some(code) {
            assert!(Instant::now() < deadline, "{name}");
        }
        assert_eq!(names(folder.path()), [""; 0], "{name}");
    }
}

/// Sends a demo the signal as soon as its first device is there; how it ended.
fn interrupted_demo(folder: &Path, name: &str) -> Option<i32> {
    let mut command = host_sim();
    command.arg("demo");
    let mut demo = under("default", &command).env("TMPDIR", folder).spawn().unwrap();
    let has_device = || {
        let folders = std::fs::read_dir(folder).unwrap().flatten();
        folders.filter_map(|folder| std::fs::read_dir(folder.path()).ok()).flatten().count() > 0
    };
    while !has_device() {
        if let Some(status) = demo.try_wait().unwrap() {
            return status.code();
        }
        std::thread::sleep(Duration::from_millis(1));
    }
    send(name, &demo);
    let code = demo.wait().unwrap().code();
    assert!(code.is_some_and(|code| code == 0 || code > 128), "{name}: {code:?}");
    code
}

#[test]
fn what_runs_long_and_leaves_nothing_ends_when_it_is_interrupted() {
    let mut command = host_sim();
    command.args(["soak", "--hours", "1000", "--cell", "rs485-system"]);
    let soak = under("default", &command).spawn().unwrap();
    // Before it listens for the signal, the signal ends it without a word.
    until(|| has_signal(&soak, "SigCgt:", 2));
    send("INT", &soak);
    let output = soak.wait_with_output().unwrap();
    let (out, err) = text(&output);
    assert_eq!(output.status.code(), Some(0), "{err}");
    assert!(out.contains("virtual hours") && out.contains("\ninterrupted: "), "{out}");

    let mut command = host_sim();
    command.args(["decode", "--part", "input"]).arg(example("rs485-system.toml"));
    let mut decode = under("default", &command).stdin(Stdio::piped()).spawn().unwrap();
    // What started the tests may ignore it, and so does a child until its disposition is set.
    until(|| !has_signal(&decode, "SigIgn:", 2));
    send("INT", &decode);
    assert_eq!(decode.wait().unwrap().signal(), Some(2));
}

#[track_caller]
fn until(condition: impl Fn() -> bool) {
    let deadline = Instant::now() + PATIENCE;
    while !condition() {
        assert!(Instant::now() < deadline, "it never comes about");
        std::thread::sleep(Duration::from_millis(1));
    }
}

/// Whether a process has the signal of this number in a set of `/proc/PID/status`: those it catches,
/// those it ignores.
fn has_signal(child: &Child, set: &str, signal: u32) -> bool {
    let status = std::fs::read_to_string(format!("/proc/{}/status", child.id())).unwrap();
    let set = status.lines().find_map(|line| line.strip_prefix(set)).unwrap();
    u64::from_str_radix(set.trim(), 16).unwrap() & 1 << (signal - 1) != 0
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
