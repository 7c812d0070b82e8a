//! Every command with output that cannot be written: to a full disk, or to a reader that closes the pipe.

use std::fs::File;
use std::io::{BufRead, BufReader, Read, Write};
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::sync::OnceLock;
use std::sync::mpsc::channel;
use std::time::Duration;

use clap::CommandFactory;
use host_sim::cli::Cli;
use proto_core::config::image;
use proto_core::record;
use recipe_test_kit::{ended, example, free_servers};
use rustix::process::{Pid, Signal, kill_process};

use super::BINARY;

/// A command line for each command; everything it makes is in `folder`.
fn command_lines(folder: &Path) -> Vec<Vec<String>> {
    let config = |name: &str| example(name).to_str().unwrap().to_owned();
    let at = |name: &str| folder.join(name).to_str().unwrap().to_owned();
    let (gateway, robot) = (config("rs485-system.toml"), config("rs485-system-controller.toml"));
    let servers = free_servers();
    let run = [format!("--ready={}", at("ready.json")), "--stats=20ms".into()];
    let line = |words: &[&str]| words.iter().map(|&word| word.to_owned()).collect::<Vec<_>>();
    let soak = ["soak", "--cell", "rs485-system"];
    vec![
        line(&[]),
        line(&["demo"]),
        [
            line(&["controller", "-c", &robot, "--bind", &format!("rs485=pty:{}", at("line"))]),
            servers.into(),
            run.clone().into(),
        ]
        .concat(),
        [line(&["gateway", "-c", &gateway, "--bind", &format!("rs485-1=pty:{}", at("line"))]), run.into()]
            .concat(),
        // Over UDP nothing is tried, and in so short a time nothing is missed.
        line(&["doctor", "--for", "10ms", "-c", &config("force-sensor.toml")])
            .into_iter()
            .chain([format!("--bind=force=pty:{}", at("line"))])
            .collect(),
        line(&["check", &gateway]),
        line(&["new"]),
        line(&["new", "--device", "robotiq-ft300"]),
        line(&["check", &gateway, "--json"]),
        line(&["export", "schema"]),
        line(&["image", &gateway, "-o", &at("cell.img")]),
        line(&[&soak[..], &["--hours", "0.001"]].concat()),
        line(&[&soak[..], &["--hours", "0.001", "--json"]].concat()),
        line(&["soak", "merge", &soaked()]),
        line(&[&soak[..], &["--replay", "9@2.5", "--trace"]].concat()),
        line(&["encode", &gateway, "--part", "input", "1"]),
        line(&["decode", &gateway, "--part", "input", "FFFF01EEEE", "FFFF01EEEE"]),
        line(&["pendant", "--to", &control_socket(), "programs"]),
        line(&["ctl", "--to", &console(), "revisions"]),
        line(&["export", "map", &gateway]),
        line(&["export", "dbc", &config("can-hand.toml")]),
        line(&["export", "lua", &gateway]),
        line(&["extcap", "--extcap-interfaces"]),
        line(&["replay", &recording(&gateway)]),
        // Its exit code is that of a broker, which is not here (tests/fleet).
        line(&["fleet", "--help"]),
        line(&["completions", "bash"]),
        line(&["help"]),
        line(&["--help"]),
        line(&["check", "--help"]),
        line(&["--version"]),
    ]
}

/// What a soak has printed.
fn soaked() -> String {
    static MADE: OnceLock<String> = OnceLock::new();
    let make = || {
        let args = ["soak", "--cell", "rs485-system", "--hours", "0.001", "--json"];
        let output = BINARY.command().args(args).output().unwrap();
        let path = Path::new(env!("CARGO_TARGET_TMPDIR")).join("soaked.json");
        std::fs::write(&path, output.stdout).unwrap();
        path.to_str().unwrap().to_owned()
    };
    MADE.get_or_init(make).clone()
}

/// A plain recording of a gateway that has begun.
fn recording(gateway: &str) -> String {
    static MADE: OnceLock<String> = OnceLock::new();
    MADE.get_or_init(|| make_recording(gateway)).clone()
}

fn make_recording(gateway: &str) -> String {
    let config = recipe_test_kit::toml::gateway(&std::fs::read_to_string(gateway).unwrap());
    let mut image = vec![0; image::MAX_IMAGE];
    let len = image::encode(&*config, &mut image).unwrap();
    let mut bytes = record::MAGIC.to_vec();
    record::Entry::Start { image: &image[..len] }.encode(|piece| bytes.extend_from_slice(piece));
    let path = Path::new(env!("CARGO_TARGET_TMPDIR")).join("began.rgr");
    std::fs::write(&path, bytes).unwrap();
    path.to_str().unwrap().to_owned()
}

/// A control socket that answers every client once; it serves until the tests end.
fn control_socket() -> String {
    let listener = std::net::TcpListener::bind("127.0.0.1:0").unwrap();
    let address = listener.local_addr().unwrap().to_string();
    std::thread::spawn(move || {
        for stream in listener.incoming().map_while(Result::ok) {
            let mut read = BufReader::new(stream);
            let asked = read.read_line(&mut String::new());
            if asked.is_ok() {
                // The client may be gone.
                let _ =
                    read.get_mut().write_all(b"{\"ok\":true,\"time_s\":0.0,\"result\":[\"pick.jspf\"]}\n");
            }
        }
    });
    address
}

/// A console that answers every client once; it serves until the tests end.
fn console() -> String {
    let listener = std::net::TcpListener::bind("127.0.0.1:0").unwrap();
    let address = listener.local_addr().unwrap().to_string();
    std::thread::spawn(move || {
        for stream in listener.incoming().map_while(Result::ok) {
            let mut read = BufReader::new(stream);
            let mut line = String::new();
            while read.read_line(&mut line).is_ok_and(|len| len > 2) {
                line.clear();
            }
            // The client may be gone.
            let _ = read.get_mut().write_all(b"HTTP/1.1 200 OK\r\nContent-Length: 2\r\n\r\n{}");
        }
    });
    address
}

/// Whether it prints `ready` and statistics until a signal ends it.
fn runs_on(line: &[String]) -> bool {
    line.first().is_some_and(|command| command == "controller" || command == "gateway")
}

/// Where its output goes.
#[derive(Debug, Clone, Copy, PartialEq)]
enum To {
    FullDisk,
    /// A pipe without a reader.
    Nobody,
    /// `head -1`.
    Head,
}

/// The exit code, and stderr.
#[track_caller]
fn outcome(line: &[String], to: To, folder: &Path) -> (Option<i32>, String) {
    let mut command = Command::new(BINARY.0);
    command.args(line).env("TMPDIR", folder).stdin(Stdio::null()).stderr(Stdio::piped());
    let reader = match to {
        To::FullDisk => {
            command.stdout(File::options().write(true).open("/dev/full").unwrap());
            None
        }
        To::Nobody | To::Head => {
            let (reader, writer) = std::io::pipe().unwrap();
            command.stdout(writer);
            (to == To::Head).then_some(reader)
        }
    };
    let mut child = command.spawn().unwrap();
    // Only the child keeps the other end of the pipe.
    drop(command);
    if let Some(reader) = reader {
        let mut first = String::new();
        BufReader::new(reader).read_line(&mut first).unwrap();
        assert!(!first.is_empty(), "{line:?} says something");
    }
    let status = ended(&mut child, PATIENCE);
    let mut output = String::new();
    child.stderr.take().unwrap().read_to_string(&mut output).unwrap();
    (status.code(), output.split_inclusive('\n').filter(|line| !line.contains(NO_CONTROLLER)).collect())
}

const PATIENCE: Duration = Duration::from_secs(60);

/// The folder's content, without the output of `image`.
fn left_behind(folder: &Path) -> Vec<PathBuf> {
    let names = std::fs::read_dir(folder).unwrap().map(|entry| entry.unwrap().path());
    names.filter(|path| path.file_name().unwrap() != "cell.img").collect()
}

/// What a gateway says beside, because there is none.
const NO_CONTROLLER: &str = "no connection to the controller";

#[test]
fn every_command_is_tried() {
    let lines = command_lines(Path::new("folder"));
    let command = Cli::command();
    for command in command.get_subcommands().map(clap::Command::get_name) {
        assert!(lines.iter().any(|line| line.first().is_some_and(|first| first == command)), "{command}");
    }
}

#[test]
fn what_cannot_be_written_is_one_message_and_exit_code_1() {
    let folder = tempfile::tempdir().unwrap();
    for line in command_lines(folder.path()) {
        let (code, output) = outcome(&line, To::FullDisk, folder.path());
        assert_eq!(
            (code, output.as_str()),
            (Some(1), "stdout: No space left on device (os error 28)\n"),
            "{line:?}"
        );
        assert_eq!(left_behind(folder.path()), [""; 0].map(PathBuf::from), "{line:?}");
    }
}

#[test]
fn a_reader_that_had_enough_ends_a_command_quietly() {
    let folder = tempfile::tempdir().unwrap();
    for line in command_lines(folder.path()) {
        for to in [To::Nobody, To::Head] {
            let (code, output) = outcome(&line, to, folder.path());
            let why = if runs_on(&line) {
                "stdout was closed; ended, because nobody reads the statistics\n"
            } else {
                ""
            };
            assert_eq!((code, output.as_str()), (Some(0), why), "{line:?} to {to:?}");
            assert_eq!(left_behind(folder.path()), [""; 0].map(PathBuf::from), "{line:?} to {to:?}");
        }
    }
}

#[test]
fn nobody_need_read_stderr_either() {
    let full = || File::options().write(true).open("/dev/full").unwrap();
    let folder = tempfile::tempdir().unwrap();
    let wrong = vec![vec!["check".to_owned(), "no-such-file.toml".to_owned()], vec!["nonsense".to_owned()]];
    for (lines, expected) in [(command_lines(folder.path()), 1), (wrong, 2)] {
        for line in lines {
            let mut command = Command::new(BINARY.0);
            command.args(&line).env("TMPDIR", folder.path()).stdin(Stdio::null());
            let status = command.stdout(full()).stderr(full()).status().unwrap();
            assert_eq!(status.code(), Some(expected), "{line:?}");
        }
    }
}

#[test]
fn a_disk_that_fills_up_later_costs_statistics_and_does_not_end_a_gateway() {
    let folder = tempfile::tempdir().unwrap();
    let lines = command_lines(folder.path());
    let gateway = lines.iter().find(|line| line.first().is_some_and(|command| command == "gateway")).unwrap();
    // A file size limit of a few kilobytes: room for the ready line, but not for many others.
    let limited = ["--ignore-signal=XFSZ", "sh", "-c", "ulimit -f 8; exec \"$0\" \"$@\""];
    let mut command = Command::new("env");
    command.args(limited).arg(BINARY.0).args(gateway).stdin(Stdio::null());
    let log = folder.path().join("log");
    let mut child = command.stdout(File::create(&log).unwrap()).stderr(Stdio::piped()).spawn().unwrap();
    let stderr = BufReader::new(child.stderr.take().unwrap());
    let (sender, lines) = channel();
    std::thread::spawn(move || stderr.lines().map_while(Result::ok).try_for_each(|line| sender.send(line)));
    let output = loop {
        let line = lines.recv_timeout(PATIENCE).unwrap_or_else(|_| {
            child.kill().unwrap();
            panic!("nothing is said")
        });
        // There is no controller.
        if !line.contains(NO_CONTROLLER) {
            break line;
        }
    };
    assert!(output.contains("cannot write statistics to stdout"), "{output}");
    assert!(std::fs::read_to_string(&log).unwrap().starts_with("ready {"));
    // It keeps running, and reports the error once.
    assert!(folder.path().join("ready.json").exists() && folder.path().join("line").exists());
    kill_process(Pid::from_child(&child), Signal::TERM).unwrap();
    assert_eq!(child.wait().unwrap().code(), Some(0));
    let others: Vec<_> = lines.iter().filter(|line| !line.contains(NO_CONTROLLER)).collect();
    assert_eq!(others, [""; 0]);
    assert_eq!(left_behind(folder.path()), [log]);
}
