//! A clock that runs faster, and one that only moves when it is told to.

use std::fs::OpenOptions;
use std::io::{Read, Write};
use std::net::TcpStream;
use std::os::unix::fs::OpenOptionsExt;

use proto_core::wire::state;
use serde_json::{Value, json};

use super::kit::{Control, config, connect, start};
use recipe_config::SimProgram;
use recipe_controller::timeline::Timeline;
use recipe_runtime::controller::{ControllerOptions, Pace, start_with};
use recipe_runtime::{Handle, RunOptions};
use recipe_test_kit::until;

const FILE: &str = "udp-server-controller.toml";
const PROGRAM: &str = r#"
    set("DO[2]", true);
    for nth in 0..5 { wait_ms(43); log(`round ${nth}`); }
    set("DO[2]", false);
"#;

#[test]
fn a_stepped_clock_stands_until_somebody_waits() {
    let handle = start(config(FILE), Pace::Stepped);
    let mut control = Control::of(&handle);
    assert_eq!(control.time_s(), 0.0);
    control.done(json!({ "do": "emergency_stop" }));
    control.done(json!({ "do": "clear" }));
    assert_eq!(control.time_s(), 0.0);
    control.done(json!({ "do": "advance", "seconds": 0.1 }));
    assert_eq!(control.time_s(), 0.1);
    control.done(json!({ "do": "advance", "seconds": 0 }));
    // It stops as soon as the condition holds: the robot is ready again after 200 ms.
    control.done(json!({ "do": "wait", "until": { "safety": "run" }, "timeout_s": 3600 }));
    assert_eq!(control.time_s(), 0.2);
    // A minute passes at once.
    let error = control.refused(json!({ "do": "wait", "until": { "robot": "enable" }, "timeout_s": 60 }));
    assert_eq!(error, "not within 60 s: robot is disable, not enable");
    assert_eq!(control.time_s(), 60.2);
    assert!(control.refused(json!({ "do": "advance", "seconds": -1 })).contains("not within 0 to 86400"));
}

#[test]
fn the_clock_moves_for_all_who_wait_and_answers_each_at_its_time() {
    let handle = start(config(FILE), Pace::Stepped);
    let mut clients: Vec<Control> = (0..3).map(|_| Control::of(&handle)).collect();
    let mut times: Vec<f64> = Vec::new();
    for (client, seconds) in clients.iter_mut().zip([0.3, 0.1, 0.2]) {
        client.send(&json!({ "do": "advance", "seconds": seconds }).to_string());
    }
    for client in &mut clients {
        times.push(client.line()["time_s"].as_f64().unwrap());
    }
    // The clock moves from the first request on, and stands when the last one is answered.
    let now = clients[0].time_s();
    assert!((0.3..=0.6).contains(&now) && times.iter().all(|time| *time <= now), "{times:?} {now}");
}

#[test]
fn a_command_that_only_silence_ends_is_answered_when_the_clock_is_there() {
    let handle = start(config(FILE), Pace::Stepped);
    let (mut control, mut command) = (Control::of(&handle), connect(&handle, "command"));
    command.write_all(b"state").unwrap();
    control.done(json!({ "do": "wait", "until": { "event": { "event": "reply" } }, "timeout_s": 1 }));
    let mut reply = [0; 7];
    command.read_exact(&mut reply).unwrap();
    assert_eq!(&reply, b"6:0:5:2");
    let now = control.time_s();
    assert!(0.0 < now && now < 0.5, "{now}");
}

#[test]
fn a_factor_makes_the_clock_faster() {
    let handle = start(config(FILE), Pace::Factor(50.0));
    let mut control = Control::of(&handle);
    let (began, at) = (std::time::Instant::now(), control.time_s());
    let wait = json!({ "do": "wait", "until": { "mode": "auto" }, "timeout_s": 10 });
    assert_eq!(control.refused(wait), "not within 10 s: mode is remote, not auto");
    let (passed, took) = (control.time_s() - at, began.elapsed().as_secs_f64());
    assert!(passed >= 10.0 && took >= 10.0 / 50.0, "{passed} s of the controller in {took} s");
    assert!(passed <= took * 50.0 + 0.001, "{passed} s of the controller in {took} s");
}

/// A client that the controller has accepted: without it, the order of clients that connect at the same
/// instant would be the system's.
#[track_caller]
fn accepted(handle: &Handle, control: &mut Control, server: &str) -> TcpStream {
    let stream = connect(handle, server);
    until("the client is accepted", || {
        let state = control.done(json!({ "do": "state" }));
        (state["clients"][server] == 1).then_some(())
    });
    stream
}

/// What clients of a stepped controller get to see.
#[derive(PartialEq)]
struct Seen {
    events: String,
    states: Vec<u8>,
    line: Vec<u8>,
    /// The number of frames that had left on the line at some instants.
    frames: Vec<u64>,
    state: Value,
}

/// A Modbus client, a command client, a state client and a device on a serial line, with a seed.
fn scenario(seed: Option<u64>) -> Seen {
    let folder = tempfile::tempdir().unwrap();
    let link = folder.path().join("rs485");
    let mut robot = config("rs485-system-controller.toml");
    robot.programs.push(SimProgram { name: "p".to_owned(), script: PROGRAM.to_owned() });
    let binds = vec![format!("rs485=pty:{}", link.display()).parse().unwrap()];
    let run = RunOptions { binds, ..RunOptions::default() };
    let options = ControllerOptions { pace: Pace::Stepped, seed, run, ..ControllerOptions::default() };
    let handle = start_with(robot, options).unwrap();
    let mut control = Control::of(&handle);
    let mut line =
        OpenOptions::new().read(true).write(true).custom_flags(libc::O_NOCTTY).open(&link).unwrap();
    let mut states = accepted(&handle, &mut control, "state");
    let mut command = accepted(&handle, &mut control, "command");
    let mut modbus = accepted(&handle, &mut control, "modbus");
    let mut got = [0; 64];
    let mut answer = |stream: &mut TcpStream, request: &[u8], len: usize| {
        stream.write_all(request).unwrap();
        stream.read_exact(&mut got[..len]).unwrap();
    };
    control.done(json!({ "do": "advance", "seconds": 0.0503 }));
    // Coil 193 on: DO2.
    answer(&mut modbus, &[0, 1, 0, 0, 0, 6, 1, 5, 0, 193, 0xFF, 0], 12);
    answer(&mut command, b"run(p)\n", 9);
    let mut frames = Vec::new();
    for round in 0..8_u8 {
        // Not waited for: it must be taken at this instant all the same.
        line.write_all(&[0xFF, 0xFF, round, 0xEE, 0xEE]).unwrap();
        control.done(json!({ "do": "advance", "seconds": 0.0137 }));
        modbus.write_all(&[0, round, 0, 0, 0, 6, 1, 3, 0, 0, 0, 2]).unwrap();
        command.write_all(b"state\n").unwrap();
        frames.push(
            control.done(json!({ "do": "counters" }))["ports"]["rs485"]["frames_out"].as_u64().unwrap(),
        );
    }
    control.done(json!({ "do": "fault", "server": "state", "kind": "garbage" }));
    let ended = json!({ "event": { "event": "program_ended" } });
    control.done(json!({ "do": "wait", "until": ended, "timeout_s": 10 }));
    control.done(json!({ "do": "advance", "seconds": 0.25 }));
    control.send(r#"{"do":"events","max":100000}"#);
    let events = control.text();
    let state = control.done(json!({ "do": "state" }));
    let all = state["ports"]["rs485"]["frames_out"].as_u64().unwrap() as usize;
    let mut sent = vec![0; all * 20];
    line.read_exact(&mut sent).unwrap();
    let packets = handle.stats().unwrap()["state"]["requests"].as_u64().unwrap() as usize;
    let mut streamed = vec![0; packets * state::LEN];
    states.read_exact(&mut streamed).unwrap();
    Seen { events, states: streamed, line: sent, frames, state }
}

#[test]
fn runs_with_the_same_seed_are_the_same_byte_for_byte_and_others_are_not() {
    let runs: usize = std::env::var("RUNS").ok().and_then(|runs| runs.parse().ok()).unwrap_or(50);
    let first = scenario(Some(7));
    for kind in ["reply", "log", "program_ended", "operation", "connected"] {
        assert!(first.events.contains(&format!("\"event\":\"{kind}\"")), "{kind}: {}", first.events);
    }
    for by in ["modbus", "rs485", "program"] {
        assert!(first.events.contains(&format!("\"by\":\"{by}\"")), "{by}: {}", first.events);
    }
    assert!(first.line.len() > 20 * 30 && first.states.len() > 3 * state::LEN);
    for nth in 1..runs {
        let again = scenario(Some(7));
        assert!(again.events == first.events, "run {nth}:\n{}\nnot\n{}", again.events, first.events);
        assert_eq!(again.state, first.state, "run {nth}");
        assert_eq!(again.frames, first.frames, "run {nth}");
        assert!(again.states == first.states && again.line == first.line, "run {nth}: streams differ");
    }
    let other = scenario(Some(12_345));
    assert!(other.states != first.states && other.frames != first.frames, "the phases are others");
}

#[test]
fn a_client_that_reads_nothing_does_not_stop_the_clock() {
    let handle = start(config(FILE), Pace::Stepped);
    let mut control = Control::of(&handle);
    let _deaf = accepted(&handle, &mut control, "state");
    control.done(json!({ "do": "advance", "seconds": 60 }));
    assert_eq!(control.time_s(), 60.0);
}

#[test]
fn a_timeline_steps_with_the_clock() {
    let robot = config(FILE);
    let steps = "[[step]]\nat_s = 0.1234\ndo = \"set\"\nitems = { \"DI[1]\" = 1 }\n\
                 [[step]]\nwhen = { items = { \"DI[1]\" = 1 } }\nafter_s = 0.25\nrepeat = true\n\
                 do = \"set\"\nitems = { \"DI[1]\" = 0, \"DI[2]\" = 1 }\n";
    let timeline = Some(Timeline::parse("steps.toml", steps, &robot).unwrap());
    let options = ControllerOptions { pace: Pace::Stepped, timeline, ..ControllerOptions::default() };
    let handle = start_with(robot, options).unwrap();
    let mut control = Control::of(&handle);
    control.done(json!({ "do": "wait", "until": { "items": { "DI[1]": 1 } }, "timeout_s": 10 }));
    assert_eq!(control.time_s(), 0.1234);
    control.done(json!({ "do": "wait", "until": { "items": { "DI[2]": 1 } }, "timeout_s": 10 }));
    assert_eq!(control.time_s(), 0.3734);
    control.done(json!({ "do": "advance", "seconds": 1 }));
    control.done(json!({ "do": "set", "items": { "DI[1]": 1 } }));
    control.done(json!({ "do": "wait", "until": { "items": { "DI[1]": 0 } }, "timeout_s": 10 }));
    assert_eq!(control.time_s(), 1.6234);
}

#[test]
fn frames_on_a_bus_take_their_time_on_the_stepped_clock() {
    let run =
        RunOptions { binds: vec!["can=slcan-tcp:127.0.0.1:0".parse().unwrap()], ..RunOptions::default() };
    let options = ControllerOptions { pace: Pace::Stepped, run, ..ControllerOptions::default() };
    let handle = start_with(config("can-system-controller.toml"), options).unwrap();
    let (mut control, mut bus) = (Control::of(&handle), connect(&handle, "ports/can"));
    bus.write_all(b"S6\rO\r").unwrap();
    bus.read_exact(&mut [0; 2]).unwrap();
    let sent = |control: &mut Control, seconds: f64| {
        let frames = |control: &mut Control| {
            let counters = control.done(json!({ "do": "counters" }));
            counters["ports"]["can"]["frames_out"].as_u64().unwrap()
        };
        let before = frames(control);
        control.done(json!({ "do": "advance", "seconds": seconds }));
        frames(control) - before
    };
    sent(&mut control, 0.001);

    let each = sent(&mut control, 0.004);
    assert!(each > 0);
    assert_eq!(sent(&mut control, 0.4), 100 * each);
    // A frame of 1 byte takes 0.11 to 0.13 ms at 500 kbit/s.
    bus.write_all(b"t001101\r").unwrap();
    let begin = control.time_s();
    let on = json!({ "items": { "DO[1]": 1 } });
    control.done(json!({ "do": "wait", "until": on, "timeout_s": 1 }));
    let took = control.time_s() - begin;
    assert!((0.000_1..0.001).contains(&took), "{took}");
}
