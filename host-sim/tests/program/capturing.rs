//! Captures and recordings of running gateways: signals, full disks, readers that go away.

use std::io::Read;
use std::net::TcpStream;
use std::path::{Path, PathBuf};
use std::process::{Command, Output, Stdio};

use recipe_test_kit::{HostSim, example, free_servers, until};
use serde_json::Value;

use super::BINARY;

/// A gateway without a controller, its device a TCP client.
fn gateway(extra: &[&str]) -> Command {
    let mut command = BINARY.run("gateway", &example("can-hand.toml"));
    command.args(["--bind", "hand=slcan-tcp:127.0.0.1:0"]).args(extra);
    command
}

/// Sends frames of the hand until the gateway has accepted so many.
#[track_caller]
fn frames(gateway: &HostSim, count: u64) -> TcpStream {
    use std::io::Write;
    let mut bus = TcpStream::connect(gateway.at("ports/hand")).unwrap();
    bus.write_all(b"S8\rO\r").unwrap();
    for nth in 0..count {
        bus.write_all(format!("t50240{}001027\r", nth % 3).as_bytes()).unwrap();
    }
    gateway.stats("frames", |stats: &Value| stats["ports"]["hand"]["frames_in"].as_u64() >= Some(count));
    bus
}

fn replay(recording: &Path) -> (Option<i32>, String) {
    let Output { status, stdout, stderr } = BINARY.command().arg("replay").arg(recording).output().unwrap();
    (status.code(), String::from_utf8(stdout).unwrap() + String::from_utf8(stderr).unwrap().as_str())
}

fn files(folder: &Path) -> Vec<PathBuf> {
    let entries = std::fs::read_dir(folder).into_iter().flatten();
    let mut files: Vec<_> = entries.map(|entry| entry.unwrap().path()).collect();
    files.sort();
    files
}

/// Number of packets of a capture, which must end with a whole block.
#[track_caller]
fn packets(path: &Path) -> usize {
    let bytes = std::fs::read(path).unwrap();
    let mut rest = &bytes[..];
    let mut packets = 0;
    while !rest.is_empty() {
        let word = |at: usize| u32::from_le_bytes(rest[at..at + 4].try_into().unwrap());
        let len = word(4) as usize;
        assert!(len <= rest.len(), "{} ends within a block", path.display());
        assert_eq!(word(len - 4) as usize, len);
        packets += usize::from(word(0) == 6);
        rest = &rest[len..];
    }
    packets
}

#[test]
fn ctrl_c_leaves_a_whole_capture_and_a_whole_recording() {
    let folder = tempfile::tempdir().unwrap();
    let (capture, record) = (folder.path().join("c.pcapng"), folder.path().join("rec"));
    let gateway = HostSim::start(&mut gateway(&[
        "--capture",
        capture.to_str().unwrap(),
        "--record",
        record.to_str().unwrap(),
    ]));
    let bus = frames(&gateway, 300);
    gateway.end();
    drop(bus);
    assert!(packets(&capture) >= 300);
    let (code, text) = replay(&record);
    assert_eq!(code, Some(0), "{text}");
    assert!(text.contains("the same to the end") && !text.contains("killed"), "{text}");
}

#[test]
fn a_recording_with_a_controller_is_replayed_with_all_that_its_links_carried() {
    let folder = tempfile::tempdir().unwrap();
    let record = folder.path().to_str().unwrap();
    let mut robot = BINARY.run("controller", &example("can-user-controller.toml"));
    let robot = HostSim::start(robot.args(free_servers()).args(["--bind", "can=slcan-tcp:127.0.0.1:0"]));
    let extra = ["--bind", "can-1=slcan-tcp:127.0.0.1:0", "--record", record];
    let gateway = BINARY.gateway(&example("can-user.toml"), &robot, &extra);
    let mut bus = TcpStream::connect(gateway.at("ports/can-1")).unwrap();
    std::io::Write::write_all(&mut bus, b"S6\rO\rt00130C2238\r").unwrap();
    gateway.stats("a register", |stats| stats["links"]["modbus"]["received"].as_u64() >= Some(1));
    gateway.end();
    let (code, text) = replay(folder.path());
    assert_eq!(code, Some(0), "{text}");
    // As if another engine had sent another value to the robot.
    let [path] = &files(folder.path())[..] else { panic!("one file") };
    let mut bytes = std::fs::read(path).unwrap();
    let sent = b"\x06\x00\x0C\x00\x22\x00\x38";
    let at = bytes.windows(sent.len()).position(|window| window == sent).unwrap();
    bytes[at + 2] = 0x0D;
    std::fs::write(path, bytes).unwrap();
    let (code, text) = replay(folder.path());
    assert_eq!(code, Some(1), "{text}");
    assert!(text.contains("differs, ") && text.contains("recorded: LinkSend"), "{text}");
}

#[test]
fn what_a_killed_gateway_has_recorded_can_be_replayed() {
    let folder = tempfile::tempdir().unwrap();
    let mut gateway = HostSim::start(&mut gateway(&["--record", folder.path().to_str().unwrap()]));
    let _bus = frames(&gateway, 500);
    until("frames on the disk", || {
        let len: u64 = files(folder.path()).iter().map(|path| path.metadata().unwrap().len()).sum();
        (len > 30_000).then_some(())
    });
    gateway.kill();
    let (code, text) = replay(folder.path());
    assert_eq!(code, Some(0), "{text}");
    assert!(text.contains("the same to the end"), "{text}");
}

/// As on a full disk: no file may have more than 512 KiB. The signal that would end the process is ignored.
fn in_little_room(command: &Command) -> Command {
    let mut shell = Command::new("sh");
    shell.args(["-c", "trap '' XFSZ; ulimit -f 1024; exec \"$@\"", "sh"]).arg(command.get_program());
    shell.args(command.get_args()).stdin(Stdio::null()).stdout(Stdio::piped()).stderr(Stdio::piped());
    shell
}

#[test]
fn a_full_disk_stops_neither_the_gateway_nor_what_was_recorded_before() {
    let folder = tempfile::tempdir().unwrap();
    let (capture, record) = (folder.path().join("c.pcapng"), folder.path().join("rec"));
    let command = gateway(&["--capture", capture.to_str().unwrap(), "--record", record.to_str().unwrap()]);
    let gateway = HostSim::start(&mut in_little_room(&command));
    let bus = frames(&gateway, 12_000);
    until("both have failed", || {
        let capture = !gateway.log("the capture ends: it cannot be written").is_empty();
        (capture && !gateway.log("cannot record; trying again").is_empty()).then_some(())
    });
    drop(bus);
    let _bus = frames(&gateway, 12_100);
    gateway.end();
    assert!(packets(&capture) > 1_000);
    let (code, text) = replay(&record);
    // The calls that found no room are a gap.
    assert!(code == Some(1) && text.contains("the same up to a gap") || code == Some(0), "{code:?} {text}");
}

#[test]
fn a_capture_on_stdout_is_for_a_viewer_that_may_go_away() {
    let folder = tempfile::tempdir().unwrap();
    let ready = folder.path().join("ready.json");
    let mut command = BINARY.command();
    command.args(["gateway", "--capture", "-", "-c"]).arg(example("can-hand.toml"));
    command.args(["--bind", "hand=slcan-tcp:127.0.0.1:0", "--ready"]).arg(&ready);
    let mut child = command.spawn().unwrap();
    let place = until("the ready file", || {
        let value: Value = serde_json::from_str(&std::fs::read_to_string(&ready).ok()?).ok()?;
        value["ports"]["hand"].as_str().map(str::to_owned)
    });
    let mut stdout = child.stdout.take().unwrap();
    let mut first = [0; 4];
    stdout.read_exact(&mut first).unwrap();
    assert_eq!(first, [0x0A, 0x0D, 0x0D, 0x0A], "nothing but the capture");
    drop(stdout);
    let mut bus = TcpStream::connect(place).unwrap();
    std::io::Write::write_all(&mut bus, b"S8\rO\rt502401001027\rt502402001027\r").unwrap();
    // The frames of the gateway go on.
    let mut answer = [0; 64];
    bus.set_read_timeout(Some(recipe_test_kit::PATIENCE)).unwrap();
    assert!(bus.read(&mut answer).unwrap() > 0);
    assert_eq!(child.try_wait().unwrap(), None, "the gateway goes on");
    rustix::process::kill_process(rustix::process::Pid::from_child(&child), rustix::process::Signal::INT)
        .unwrap();
    assert_eq!(child.wait().unwrap().code(), Some(0));
    let mut errors = String::new();
    child.stderr.take().unwrap().read_to_string(&mut errors).unwrap();
    assert!(errors.lines().any(|line| line.starts_with("ready {")), "{errors}");
}

#[test]
fn what_cannot_be_captured_or_recorded_is_said_before_anything_starts() {
    let folder = tempfile::tempdir().unwrap();
    let notes = folder.path().join("notes");
    std::fs::write(&notes, "dear diary").unwrap();
    let notes = notes.to_str().unwrap();
    for (extra, words) in [
        (&["--capture", notes][..], "is no capture"),
        (&["--capture", "/nowhere/c.pcapng"], "No such file"),
        (&["--record", notes], "--record"),
        (&["--record", "/proc/nowhere"], "--record /proc/nowhere"),
        (&["--record", notes, "--record-file", "1MiB"], "a file has"),
        (&["--record", notes, "--record-budget", "100MiB"], "twice that of a file"),
        (&["--record", notes, "--record-budget", "1GB"], "is not a size"),
        (&["--capture", "-"], "--stats is for stdout"),
        (&["--capture-links"], "--capture"),
    ] {
        let Output { status, stderr, .. } = gateway(extra).output().unwrap();
        let text = String::from_utf8(stderr).unwrap();
        assert!(status.code() == Some(2) && text.contains(words), "{extra:?}: {text}");
    }
    assert_eq!(std::fs::read_to_string(notes).unwrap(), "dear diary");
}

#[test]
fn what_is_no_recording_is_refused() {
    let folder = tempfile::tempdir().unwrap();
    let notes = folder.path().join("notes");
    std::fs::write(&notes, "dear diary").unwrap();
    for (path, words) in [
        (notes.as_path(), "not a recording"),
        (folder.path(), "there is no recording in this folder"),
        (Path::new("/nowhere"), "/nowhere: "),
    ] {
        let (code, text) = replay(path);
        assert!(code == Some(2) && text.contains(words), "{}: {text}", path.display());
    }
}

/// A gateway's API that answers once with a capture, in chunks.
fn api(answer: &'static str) -> (std::net::SocketAddr, std::thread::JoinHandle<String>) {
    use std::io::Write;
    let listener = std::net::TcpListener::bind("127.0.0.1:0").unwrap();
    let at = listener.local_addr().unwrap();
    let served = std::thread::spawn(move || {
        let (mut stream, _) = listener.accept().unwrap();
        let mut request = Vec::new();
        while !request.ends_with(b"\r\n\r\n") {
            let mut byte = [0];
            stream.read_exact(&mut byte).unwrap();
            request.push(byte[0]);
        }
        stream.write_all(answer.as_bytes()).unwrap();
        String::from_utf8(request).unwrap()
    });
    (at, served)
}

#[test]
fn wireshark_captures_from_a_running_gateway() {
    let folder = tempfile::tempdir().unwrap();
    // As Wireshark calls it: by a link, without the word extcap.
    let program = folder.path().join("host-sim-extcap");
    std::os::unix::fs::symlink(BINARY.0, &program).unwrap();
    let asked = |arguments: &[&str]| {
        let Output { status, stdout, stderr } = Command::new(&program).args(arguments).output().unwrap();
        (status.code(), String::from_utf8(stdout).unwrap() + String::from_utf8(stderr).unwrap().as_str())
    };
    let (code, text) = asked(&["--extcap-interfaces", "--extcap-version=4.0"]);
    assert!(code == Some(0) && text.contains("interface {value=rgw}"), "{text}");
    let (code, text) = asked(&["--extcap-dlts", "--extcap-interface", "rgw"]);
    assert!(code == Some(0) && text.starts_with("dlt {number=147}{name=USER0}"), "{text}");
    let (code, text) = asked(&["--extcap-config", "--extcap-interface", "rgw"]);
    assert!(code == Some(0) && text.contains("{call=--ready}"), "{text}");

    let (ready, fifo) = (folder.path().join("ready.json"), folder.path().join("fifo"));
    std::fs::write(&fifo, "").unwrap();
    let (ready, fifo) = (ready.to_str().unwrap(), fifo.to_str().unwrap());
    let capture =
        ["--capture", "--extcap-interface", "rgw", "--fifo", fifo, "--ready", ready, "--port", "hand"];
    for (content, words) in [
        ("{\"ports\":{}}", "start it with --console"),
        ("dear diary", "not a ready file"),
        ("{\"console\":\"127.0.0.1:1\"}", "the gateway at 127.0.0.1:1"),
    ] {
        std::fs::write(ready, content).unwrap();
        let (code, text) = asked(&capture);
        assert!(code == Some(2) && text.contains(words), "{text}");
    }
    let (at, served) =
        api("HTTP/1.1 200 OK\r\nTransfer-Encoding: chunked\r\n\r\n4\r\nabcd\r\n2\r\nef\r\n0\r\n\r\n");
    std::fs::write(ready, format!("{{\"console\":\"{at}\"}}")).unwrap();
    let (code, text) = asked(&capture);
    assert_eq!((code, text.as_str()), (Some(0), ""));
    assert_eq!(std::fs::read_to_string(fifo).unwrap(), "abcdef");
    assert!(served.join().unwrap().starts_with("GET /api/v1/capture.pcapng?port=hand HTTP/1.1\r\n"));
    let (at, served) = api("HTTP/1.1 503 Service Unavailable\r\n\r\n");
    std::fs::write(ready, format!("{{\"console\":\"{at}\"}}")).unwrap();
    let (code, text) = asked(&capture);
    assert!(code == Some(2) && text.contains("503"), "{text}");
    served.join().unwrap();
}
