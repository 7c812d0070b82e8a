//! The program as users and scripts run it: real processes, real signals.

use std::os::fd::OwnedFd;
use std::os::unix::ffi::OsStrExt;
use std::os::unix::process::ExitStatusExt;
use std::path::Path;
use std::process::{Child, Command, Output, Stdio};
use std::time::{Duration, Instant};

use recipe_test_kit::{HostSim, PATIENCE, SERVERS, ended, example, free_servers, names, repository, until};
use rustix::process::{Pid, Signal};
use rustix::pty::OpenptFlags;
use serde_json::Value;

use super::BINARY;

fn text(output: &Output) -> (String, String) {
    let text = |bytes: &[u8]| String::from_utf8_lossy(bytes).into_owned();
    (text(&output.stdout), text(&output.stderr))
}

#[test]
fn without_arguments_the_demo_passes() {
    shows_all_examples(&BINARY.command().output().unwrap());
}

#[test]
fn demos_do_not_disturb_each_other() {
    let demos: Vec<Child> = (0..4).map(|_| BINARY.command().arg("demo").spawn().unwrap()).collect();
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
fn what_the_demo_suggests_works() {
    let (out, _) = text(&BINARY.command().output().unwrap());
    // Two blanks separate the command line from what it is for.
    let hints =
        out.lines().filter_map(|line| line.trim_start().strip_prefix("cargo run -- ")?.split("  ").next());
    let hints: Vec<&str> = hints.collect();
    assert_eq!(hints.len(), 3, "{out}");
    for hint in hints {
        let output = BINARY.command().args(hint.split(' ')).current_dir(repository()).output().unwrap();
        assert!(output.status.success(), "{hint}: {:?}", text(&output));
    }
}

#[test]
fn a_gateway_and_a_controller_find_each_other_and_end_cleanly() {
    let folder = tempfile::tempdir().unwrap();
    let robot_ready = folder.path().join("robot.json");
    let line = folder.path().join("rs485-1");
    let robot = HostSim::start(
        BINARY
            .command()
            .args(["controller", "--stats", "50ms", "-c"])
            .arg(example("udp-server-controller.toml"))
            .args(free_servers())
            .arg("--ready")
            .arg(&robot_ready),
    );
    let file: Value = serde_json::from_str(&std::fs::read_to_string(&robot_ready).unwrap()).unwrap();
    assert_eq!(file, robot.ready, "the file says what the line says");
    let gateway = HostSim::start(
        BINARY
            .command()
            .args(["gateway", "--stats", "50ms", "-c"])
            .arg(example("rs485-system.toml"))
            .args(robot.links(&["state", "modbus"]))
            .arg(format!("--bind=rs485-1=pty:{}", line.display())),
    );
    assert_eq!(gateway.ready["ports"]["rs485-1"], line.to_str().unwrap());
    gateway.next_stats(|stats| {
        stats["links"]["modbus"]["state"] == "up" && stats["links"]["state"]["received"] != 0
    });

    let mut device = std::fs::File::options().read(true).write(true).open(&line).unwrap();
    std::io::Write::write_all(&mut device, &[0x12, 0xFF, 0xFF, 0x05, 0xEE, 0xEE]).unwrap();
    let stats = gateway.next_stats(|stats| stats["ports"]["rs485-1"]["frames_in"] == 1);
    assert_eq!(stats["ports"]["rs485-1"]["resync_bytes"], 1);
    robot.next_stats(|stats| stats["registers"]["DigitalOutputCommand[1]"].as_f64() == Some(5.0));

    // The controller ends and is started again on the same ports.
    let ports = SERVERS.map(|name| format!("--set=listen.{name}={}", robot.at(name).port()));
    robot.ended_by(Signal::TERM);
    assert!(!robot_ready.exists(), "nothing says ready that is not");
    gateway.next_stats(|stats| stats["links"]["modbus"]["state"] != "up");
    let robot = HostSim::start(
        BINARY
            .command()
            .args(["controller", "--stats", "50ms", "-c"])
            .arg(example("udp-server-controller.toml"))
            .args(ports),
    );
    gateway.next_stats(|stats| {
        stats["links"]["modbus"]["state"] == "up" && stats["links"]["modbus"]["reconnects"] != 0
    });
    std::io::Write::write_all(&mut device, &[0xFF, 0xFF, 0x80, 0xEE, 0xEE]).unwrap();
    robot.next_stats(|stats| stats["registers"]["DigitalOutputCommand[1]"].as_f64() == Some(128.0));

    gateway.ended_by(Signal::INT);
    assert!(line.symlink_metadata().is_err(), "the link is removed");
    robot.ended_by(Signal::INT);
}

/// `gateway` with a pseudoterminal at `line`, without a controller.
fn gateway(line: &Path) -> Command {
    gateway_of(&example("rs485-system.toml"), line)
}

fn gateway_of(file: &Path, line: &Path) -> Command {
    let mut command = BINARY.command();
    command.args(["gateway", "-c"]).arg(file);
    command.arg(format!("--bind=rs485-1=pty:{}", line.display()));
    command
}

/// Checks for exit code 2 and one line on stderr, and returns the line.
#[track_caller]
pub(crate) fn refused(command: &mut Command) -> String {
    let mut child = command.spawn().unwrap();
    ended(&mut child, PATIENCE);
    let output = child.wait_with_output().unwrap();
    let (out, err) = text(&output);
    assert_eq!((output.status.code(), out.as_str(), err.lines().count()), (Some(2), "", 1), "{err}");
    err
}

#[test]
fn a_ready_file_costs_nobody_anything() {
    let folder = tempfile::tempdir().unwrap();
    let at = |name: &str| folder.path().join(name);
    let (line, file, ready) = (at("line"), at("cell.toml"), at("ready.json"));
    std::fs::copy(example("rs485-system.toml"), &file).unwrap();
    let toml = std::fs::read(&file).unwrap();
    std::fs::create_dir(at("folder")).unwrap();
    for (place, why) in [(&file, "this file exists and was not left by a run"), (&at("folder"), "a folder")] {
        let message = refused(gateway_of(&file, &line).arg("--ready").arg(place));
        assert!(message.starts_with(&format!("--ready {}: {why}; give ", place.display())), "{message}");
    }
    assert_eq!(std::fs::read(&file).unwrap(), toml);
    assert_eq!(names(folder.path()), ["cell.toml", "folder"], "nothing was started");

    // A link that a killed run has left is replaced; another file in its place is not removed.
    let mut first = HostSim::start(gateway(&line).arg("--ready").arg(&ready));
    first.kill();
    assert!(ready.exists());
    let second = HostSim::start(gateway(&line).arg("--ready").arg(&ready));
    let output: Value = serde_json::from_str(&std::fs::read_to_string(&ready).unwrap()).unwrap();
    assert_eq!(output, second.ready);
    std::fs::write(&ready, "somebody's").unwrap();
    second.ended_by(Signal::TERM);
    assert_eq!(std::fs::read_to_string(&ready).unwrap(), "somebody's");
    assert_eq!(names(folder.path()), ["cell.toml", "folder", "ready.json"]);
}

/// The same command, started with SIGHUP ignored or not, however the tests were started.
fn under(hang_up: &str, command: &Command) -> Command {
    let mut env = Command::new("env");
    env.args(["--default-signal=INT", &format!("--{hang_up}-signal=HUP")]).arg(command.get_program());
    env.args(command.get_args()).stdin(Stdio::null()).stdout(Stdio::piped()).stderr(Stdio::piped());
    env
}

fn send(signal: Signal, child: &Child) {
    rustix::process::kill_process(Pid::from_child(child), signal).unwrap();
}

#[test]
fn a_line_that_another_program_uses_is_not_taken_away() {
    let folder = tempfile::tempdir().unwrap();
    let line = folder.path().join("line");
    let mut first = HostSim::start(&mut gateway(&line));
    let leads_to = std::fs::read_link(&line).unwrap();
    let message = refused(&mut gateway(&line));
    let holder = format!(
        "line: another run of host-sim uses this path, process {}; end it or give",
        first.pid().as_raw_pid()
    );
    assert!(message.starts_with(&format!("--bind rs485-1=pty:{}: ", line.display())), "{message}");
    assert!(message.contains(&holder), "{message}");
    assert_eq!(std::fs::read_link(&line).unwrap(), leads_to);

    // A killed process leaves a link to a terminal whose number another process may get; here this test.
    first.kill();
    assert_eq!(std::fs::read_link(&line).unwrap(), leads_to);
    let (number, foreign) = terminal_called(&leads_to);
    assert!(leads_to.exists());
    HostSim::start(&mut gateway(&line)).ended_by(Signal::TERM);
    assert_eq!(names(folder.path()), [""; 0]);

    // The same link is in use if that process made it.
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
    HostSim::start(&mut gateway(&line)).ended_by(Signal::TERM);
    assert_eq!(names(folder.path()), [""; 0]);
}

/// A pseudoterminal with this name, and others that were opened to get it.
fn terminal_called(name: &Path) -> (OwnedFd, Vec<OwnedFd>) {
    let deadline = Instant::now() + PATIENCE;
    loop {
        let mut others = Vec::new();
        // The kernel assigns the lowest free number. Another test may have this one for a while.
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
    let mut robot = BINARY.command();
    robot.args(["controller", "-c"]).arg(example("rs485-system-controller.toml"));
    robot.args(free_servers());
    robot.arg(format!("--bind=rs485=pty:{}", line.display()));
    for mut command in [gateway(&line), robot] {
        command.args(["--stats", "20ms", "--ready"]).arg(&ready);
        HostSim::start(&mut under("default", &command)).ended_by(Signal::HUP);
        assert_eq!(names(folder.path()), [""; 0], "{command:?}");
        let under_nohup = HostSim::start(&mut under("ignore", &command));
        under_nohup.signal(Signal::HUP);
        under_nohup.skip_lines();
        // More than it could write while ending.
        (0..20).for_each(|_| drop(under_nohup.line()));
        assert!(line.exists() && ready.exists(), "{command:?}");
        under_nohup.ended_by(Signal::TERM);
        assert_eq!(names(folder.path()), [""; 0], "{command:?}");
    }
}

#[test]
fn a_demo_that_is_interrupted_leaves_nothing_behind() {
    for (signal, code) in [(Signal::HUP, 129), (Signal::INT, 130), (Signal::TERM, 143)] {
        let folder = tempfile::tempdir().unwrap();
        let deadline = Instant::now() + PATIENCE;
        // It may have ended already; then another one is tried.
        while interrupted_demo(folder.path(), signal) != Some(code) {
            assert!(Instant::now() < deadline, "{signal:?}");
        }
        assert_eq!(names(folder.path()), [""; 0], "{signal:?}");
    }
}

/// Sends a demo the signal as soon as its first device exists; returns how it ended.
fn interrupted_demo(folder: &Path, signal: Signal) -> Option<i32> {
    let mut command = BINARY.command();
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
    send(signal, &demo);
    let code = demo.wait().unwrap().code();
    assert!(code.is_some_and(|code| code == 0 || code > 128), "{signal:?}: {code:?}");
    code
}

#[test]
fn what_runs_long_and_leaves_nothing_ends_when_it_is_interrupted() {
    let mut command = BINARY.command();
    command.args(["soak", "--hours", "1000", "--cell", "rs485-system"]);
    let soak = under("default", &command).spawn().unwrap();
    // Before it handles the signal, the signal ends it without a message.
    until("a signal that is caught", || has_signal(&soak, "SigCgt:", 2).then_some(()));
    send(Signal::INT, &soak);
    let output = soak.wait_with_output().unwrap();
    let (out, err) = text(&output);
    assert_eq!(output.status.code(), Some(0), "{err}");
    assert!(out.contains("virtual hours") && out.contains("\ninterrupted: "), "{out}");

    let mut command = BINARY.command();
    command.args(["decode", "--part", "input"]).arg(example("rs485-system.toml"));
    let mut decode = under("default", &command).stdin(Stdio::piped()).spawn().unwrap();
    // The tests may have been started with the signal ignored, and a child inherits that until it sets a handler.
    until("a signal that is heard", || (!has_signal(&decode, "SigIgn:", 2)).then_some(()));
    send(Signal::INT, &decode);
    assert_eq!(decode.wait().unwrap().signal(), Some(2));
}

/// Whether a signal is in a set of `/proc/PID/status`, such as those caught or ignored.
fn has_signal(child: &Child, set: &str, signal: u32) -> bool {
    let status = std::fs::read_to_string(format!("/proc/{}/status", child.id())).unwrap();
    let set = status.lines().find_map(|line| line.strip_prefix(set)).unwrap();
    u64::from_str_radix(set.trim(), 16).unwrap() & 1 << (signal - 1) != 0
}

#[test]
fn what_a_device_said_while_the_gateway_was_stopped_never_reaches_the_controller() {
    let folder = tempfile::tempdir().unwrap();
    let line = folder.path().join("rs485-1");
    let robot = HostSim::start(
        BINARY
            .command()
            .args(["controller", "--stats", "10ms", "-c"])
            .arg(example("udp-server-controller.toml"))
            .args(free_servers()),
    );
    let gateway = HostSim::start(
        BINARY
            .command()
            .args(["gateway", "--stats", "50ms", "-c"])
            .arg(example("rs485-system.toml"))
            .args(robot.links(&["state", "modbus"]))
            .arg(format!("--bind=rs485-1=pty:{}", line.display())),
    );
    let is_up = |stats: &Value| stats["links"]["modbus"]["state"] == "up";
    let output = |stats: &Value| stats["registers"]["DigitalOutputCommand[1]"].as_f64();
    gateway.next_stats(is_up);
    let mut device = std::fs::File::options().read(true).write(true).open(&line).unwrap();
    let mut say = |value: u8| {
        std::io::Write::write_all(&mut device, &[0xFF, 0xFF, value, 0xEE, 0xEE]).unwrap();
    };
    say(1);
    robot.next_stats(|stats| output(stats) == Some(1.0));
    // A busy machine may let it sleep by itself.
    let sleeps = |stats: &Value| stats["sleeps"].as_u64().unwrap();
    let before = sleeps(&gateway.fresh());
    gateway.freeze();
    for _ in 0..100 {
        say(2);
    }
    std::thread::sleep(STOPPED);
    gateway.signal(Signal::CONT);
    let woken = gateway.next_stats(|stats| sleeps(stats) > before);
    assert_eq!(woken["ports"]["rs485-1"]["frames_in"], 1, "{woken}");
    assert_ne!(woken["ports"]["rs485-1"]["asleep"], 0, "{woken}");
    gateway.next_stats(|stats| is_up(stats) && stats["links"]["modbus"]["reconnects"] != 0);
    say(4);
    robot.next_stats(|stats| {
        assert_ne!(output(stats), Some(2.0));
        output(stats) == Some(4.0)
    });
    gateway.ended_by(Signal::TERM);
    robot.ended_by(Signal::TERM);
}

/// Longer than a stall that does not count as sleep.
const STOPPED: Duration = Duration::from_millis(800);

#[test]
fn what_cannot_start_says_why_and_exits_with_2() {
    let file = example("rs485-system.toml");
    for (arguments, message) in [
        (vec![], "port rs485-1 needs exactly one device: --bind rs485-1=DEVICE"),
        (vec!["--bind=rs485-2=pty:/tmp/x"], "there is no such port; there are rs485-1"),
        (vec!["--bind=rs485-1=socketcan:vcan0"], "socketcan"),
        (vec!["--bind=rs485-1=serial:/dev/does-not-exist"], "/dev/does-not-exist"),
        (vec!["--bind=rs485-1"], "NAME=DEVICE"),
    ] {
        let output = BINARY.command().args(["gateway", "-c"]).arg(&file).args(&arguments).output().unwrap();
        let (out, err) = text(&output);
        assert_eq!(output.status.code(), Some(2), "{arguments:?}: {err}");
        assert!(err.contains(message), "{arguments:?}: {err}");
        assert_eq!(out, "", "nothing was started");
    }
}
