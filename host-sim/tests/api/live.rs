//! Frames as they come and go: in streams, captures and recordings.

use std::io::{BufRead, BufReader, Read, Write};
use std::net::{SocketAddr, TcpStream};
use std::process::Command;

use recipe_test_kit::{HostSim, PATIENCE, until};
use serde_json::{Value, json};

use crate::kit::*;

/// Events of a stream with this query until `found` is satisfied.
pub(crate) fn follow(cell: &Cell, query: &str, mut found: impl FnMut(&str, &Value) -> bool) {
    let mut stream = TcpStream::connect(cell.console).unwrap();
    stream.set_read_timeout(Some(PATIENCE)).unwrap();
    write!(stream, "GET /api/v1/stream{query} HTTP/1.1\r\nHost: {}\r\n\r\n", cell.console).unwrap();
    let mut lines = BufReader::new(stream).lines().map(Result::unwrap);
    assert_eq!(lines.next().as_deref(), Some("HTTP/1.1 200 OK"));
    assert!(
        lines
            .by_ref()
            .take_while(|line| !line.is_empty())
            .any(|line| line == "Content-Type: text/event-stream")
    );
    let mut event = String::new();
    for line in lines {
        if let Some(name) = line.strip_prefix("event: ") {
            event = name.to_owned();
        } else if let Some(data) = line.strip_prefix("data: ")
            && found(&event, &serde_json::from_str(data).unwrap())
        {
            return;
        }
    }
    panic!("the stream ended");
}

/// The data of the first event `frames` of a stream with a frame that `found` is satisfied with. `send` is called
/// with each event, also before.
pub(crate) fn frames_of(
    cell: &Cell,
    more: &str,
    mut found: impl FnMut(&Value) -> bool,
    mut send: impl FnMut(),
) -> Value {
    let mut event = Value::Null;
    follow(cell, &format!("?frames=1{more}"), |name, data| {
        if name == "frames" && data["frames"].as_array().unwrap().iter().any(&mut found) {
            event = data.clone();
            return true;
        }
        send();
        false
    });
    event
}

pub(crate) fn send_frame(panel: &mut TcpStream) {
    panel.write_all(&frame(5)).unwrap();
}

/// The first frame of an event that came in.
fn first(event: &Value) -> &Value {
    event["frames"].as_array().unwrap().iter().find(|frame| frame["direction"] == "in").unwrap()
}

/// The same panel, which switches another variable.
fn renamed() -> String {
    config(500)
        .replace("DigitalOutputCommand[1]", "DigitalOutputCommand[2]")
        .replace("\"outputs\"", "\"lamps\"")
}

#[test]
fn a_stream_has_frames_by_name_for_who_asks() {
    let cell = Cell::new();
    let mut panel = cell.panel();
    let taken = |frame: &Value| frame["verdict"] == "frame" && frame["direction"] == "in";
    let event = frames_of(&cell, "", taken, || send_frame(&mut panel));
    let frame = first(&event);
    assert_eq!((&frame["port"], &frame["bytes"]), (&json!("device"), &json!("ffff0005eeee")));
    assert_eq!(
        (&frame["name"], &frame["values"]),
        (&json!("/device/input"), &json!({"order": 0, "outputs": 5}))
    );
    assert_eq!(event["lost"], 0);
    // On the clock of the status.
    let status = get(cell.console, "status").json();
    let apart = status["time_us"].as_u64().unwrap().abs_diff(frame["time_us"].as_u64().unwrap());
    assert!(apart < 60_000_000, "{apart}");
    // Why a frame was rejected is said as in the status.
    let mut wrong = || panel.write_all(&[1, 2, 3, 255, 255, 0, 5, 238, 238]).unwrap();
    let event = frames_of(&cell, "&port=device", |frame| frame["verdict"] != "frame", &mut wrong);
    let rejected =
        event["frames"].as_array().unwrap().iter().find(|frame| frame["verdict"] != "frame").unwrap();
    // A status may be as old as 100 ms.
    let last = until("the rejection in the status", || {
        let last = get(cell.console, "status").json()["ports"]["device"]["last_rejection"].clone();
        last.is_object().then_some(last)
    });
    assert_eq!((&rejected["verdict"], &rejected["text"]), (&last["why"], &last["text"]), "{rejected} {last}");
    assert_eq!(rejected.get("values"), None);
    // Others do not get any.
    let mut statuses = 0;
    follow(&cell, "", |event, _| {
        assert_ne!(event, "frames");
        wrong();
        statuses += usize::from(event == "status");
        statuses == 3
    });
    for (query, status) in [
        ("?frames=1&port=none", 404),
        ("?frames=2", 400),
        ("?port=device", 400),
        ("?frames=1&x=1", 400),
        ("?frames=1&port=%", 400),
    ] {
        get(cell.console, &format!("stream{query}")).must_be(status);
    }
    get(cell.console, "capture.pcapng?port=none").must_be(404);
    request(cell.console, "HEAD /api/v1/capture.pcapng", "", "").must_be(405);
    until("nobody is left", || (get(cell.console, "info").json()["console"]["streams"] == 0).then_some(()));
}

#[test]
fn frames_have_the_names_of_the_configuration_that_runs() {
    let cell = Cell::new();
    put(cell.console, &cell.base(), &renamed()).must_be(201);
    let mut panel = cell.panel();
    let (mut is_applied, mut names) = (false, Vec::new());
    // One stream sees both.
    follow(&cell, "?frames=1", |event, data| {
        let frames = data["frames"].as_array().into_iter().flatten();
        let values = frames.filter_map(|frame| frame.get("values")).filter_map(Value::as_object);
        names.extend(values.flat_map(|values| values.keys().cloned()));
        if event == "status" && names.iter().any(|name| name == "outputs") && !is_applied {
            is_applied = true;
            post(cell.console, "apply", "").must_be(200);
            panel = cell.panel();
        }
        send_frame(&mut panel);
        is_applied && names.iter().any(|name| name == "lamps")
    });
    let place = |name: &str| (names.iter().position(|n| n == name), names.iter().rposition(|n| n == name));
    assert!(place("outputs").1 < place("lamps").0, "{names:?}");
}

#[test]
fn a_recording_has_the_names_of_the_configuration_that_runs() {
    let mut cell = Cell::new();
    let record = cell.folder.path().join("rec");
    cell.restart_with(&["--record", record.to_str().unwrap()]);
    cell.switch(&mut cell.panel(), 5);
    put(cell.console, &cell.base(), &renamed()).must_be(201);
    post(cell.console, "apply", "").must_be(200);
    let mut panel = cell.panel();
    until("another frame", || {
        send_frame(&mut panel);
        let status = get(cell.console, "status").json();
        (status["ports"]["device"]["counters"]["frames_in"].as_u64() >= Some(1)).then_some(())
    });
    cell.gateway.end_by(rustix::process::Signal::TERM);
    let mut parts: Vec<_> = std::fs::read_dir(&record).unwrap().map(|entry| entry.unwrap().path()).collect();
    parts.sort();
    let has = |path: &std::path::PathBuf, text: &str| {
        std::fs::read(path).unwrap().windows(text.len()).any(|window| window == text.as_bytes())
    };
    let seen: Vec<_> = parts
        .iter()
        .map(|path| [r#"{"order":0,"outputs":5}"#, r#"{"lamps":5,"order":0}"#].map(|text| has(path, text)))
        .collect();
    assert_eq!(seen, [[true, false], [false, true]]);
    let replay = BINARY.command().arg("replay").arg(&record).output().unwrap();
    assert_eq!(replay.status.code(), Some(0), "{}", String::from_utf8_lossy(&replay.stdout));
}

/// A capture of a console, read until it has a packet with these bytes.
#[track_caller]
fn captured(console: SocketAddr, query: &str, wanted: &[u8], mut send: impl FnMut()) -> Vec<u8> {
    let mut stream = TcpStream::connect(console).unwrap();
    stream.set_read_timeout(Some(PATIENCE)).unwrap();
    write!(stream, "GET /api/v1/capture.pcapng{query} HTTP/1.1\r\nHost: {console}\r\n\r\n").unwrap();
    let (mut bytes, mut chunk) = (Vec::new(), [0; 4_096]);
    until("a packet", || {
        send();
        let count = stream.read(&mut chunk).unwrap();
        assert!(count > 0, "the capture ended");
        bytes.extend_from_slice(&chunk[..count]);
        bytes.windows(wanted.len()).any(|window| window == wanted).then_some(())
    });
    let head = bytes.windows(4).position(|window| window == b"\r\n\r\n").unwrap();
    assert!(bytes.starts_with(b"HTTP/1.1 200 OK\r\nContent-Type: application/x-pcapng\r\n"));
    bytes.split_off(head + 4)
}

#[test]
fn a_capture_goes_on_over_configurations() {
    let cell = Cell::new();
    let mut panel = cell.panel();
    let capture = captured(cell.console, "?port=device", &frame(5), || send_frame(&mut panel));
    assert_eq!(capture[..4], [0x0A, 0x0D, 0x0D, 0x0A]);
    assert!(capture.windows(6).any(|window| window == b"device"), "the interface has its name");
    put(cell.console, &cell.base(), &config(400)).must_be(201);
    let mut outputs = 1;
    let mut step = || {
        if outputs == 1 {
            post(cell.console, "apply", "").must_be(200);
            panel = cell.panel();
        }
        outputs = 9;
        panel.write_all(&frame(outputs)).unwrap();
    };
    captured(cell.console, "", &frame(9), &mut step);
}

#[test]
fn wireshark_gets_the_frames_of_a_running_gateway() {
    let cell = Cell::new();
    let (ready, pipe) = (cell.folder.path().join("ready.json"), cell.folder.path().join("pipe"));
    std::fs::write(&ready, cell.gateway.ready.to_string()).unwrap();
    std::fs::write(&pipe, "").unwrap();
    let mut command = BINARY.command();
    command.args(["extcap", "--capture", "--extcap-interface", "rgw", "--port", "device", "--ready"]);
    command.arg(&ready).arg("--fifo").arg(&pipe);
    let mut extcap = command.spawn().unwrap();
    let mut panel = cell.panel();
    until("a packet", || {
        send_frame(&mut panel);
        let bytes = std::fs::read(&pipe).unwrap();
        assert!(bytes.is_empty() || bytes.starts_with(&[0x0A, 0x0D, 0x0D, 0x0A]));
        bytes.windows(6).any(|window| window == frame(5)).then_some(())
    });
    // It ends with the gateway.
    let Cell { mut gateway, .. } = cell;
    gateway.end_by(rustix::process::Signal::TERM);
    assert_eq!(recipe_test_kit::ended(&mut extcap, PATIENCE).code(), Some(0));
}

/// A gateway with a CAN port, for what only CAN has.
fn hand() -> HostSim {
    let mut command: Command = BINARY.run("gateway", &recipe_test_kit::example("can-hand.toml"));
    command.args(["--bind", "hand=slcan-tcp:127.0.0.1:0", "--console", "127.0.0.1:0"]);
    HostSim::start(&mut command)
}

#[test]
fn frames_on_can_have_their_id() {
    let gateway = hand();
    let console = gateway.at("console");
    let mut bus = TcpStream::connect(gateway.at("ports/hand")).unwrap();
    bus.write_all(b"S8\rO\r").unwrap();
    let mut stream = TcpStream::connect(console).unwrap();
    stream.set_read_timeout(Some(PATIENCE)).unwrap();
    write!(stream, "GET /api/v1/stream?frames=1 HTTP/1.1\r\nHost: {console}\r\n\r\n").unwrap();
    let found = BufReader::new(stream).lines().map(Result::unwrap).find_map(|line| {
        bus.write_all(b"t502401021027\r").unwrap();
        let data: Value = serde_json::from_str(line.strip_prefix("data: ")?).unwrap();
        data["frames"].as_array()?.iter().find(|frame| frame["direction"] == "in").cloned()
    });
    let frame = found.unwrap();
    assert_eq!((&frame["id"], &frame["name"]), (&json!(0x502), &json!("/hand/input/502")));
    assert_eq!(frame["values"], json!({"state": 1, "error": 2, "grip": 10000}));
    let dbc = get(console, "export/dbc?port=hand").must_be(200).body;
    assert!(dbc.contains("BO_ 1282 "), "{dbc}");
    gateway.end();
}
