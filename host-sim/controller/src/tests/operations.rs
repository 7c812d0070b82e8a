//! Operations at run time, conditions, events, and how programs ended (docs/control.md).

use super::*;
use crate::operations::{Operation, Refused};
use serde_json::{Value, json};

/// A controller that records its events.
fn recording(config: &SimConfig) -> TestController {
    let mut cell = robot(config);
    cell.controller.record_events();
    cell.run_ms(0);
    cell
}

fn with_waiting_program() -> SimConfig {
    with_program(SimConfig::default(), "wait.jspf", "while !get(\"DI[3]\") { wait_ms(10); }")
}

fn both_ways() -> SimRecipe {
    stream_recipe(Mode::Realtime, system(&["WordInputReg[2]"]), system(&["DigitalSignalStatus[1]"]))
}

#[track_caller]
fn does(cell: &mut TestController, operation: Value) -> Value {
    cell.operate(&operation.to_string()).unwrap_or_else(|error| panic!("{operation}: {error}"))
}

/// Why the operation is refused; nothing else changes.
#[track_caller]
fn refusal(cell: &mut TestController, operation: &Value) -> String {
    let before = (state(cell), cell.controller.newest_event());
    let Err(Refused(why)) = cell.operate(&operation.to_string()) else { panic!("{operation} was done") };
    let mut after = state(cell);
    // A refused button is an error that `getlasterror` shows.
    after["error"] = before.0["error"].clone();
    assert_eq!(after, before.0, "{operation}");
    why
}

fn state(cell: &TestController) -> Value {
    cell.controller.state(cell.now)
}

/// The events of these kinds since `number`, without number and time.
fn events(cell: &TestController, since: u64, kinds: &[&str]) -> Vec<Value> {
    let all = cell.controller.events_since(since);
    let wanted = all.filter(|event| kinds.contains(&event.what.kind()));
    let bare = wanted.map(|event| {
        let mut event = json!(event);
        for key in ["n", "time_s"] {
            event.as_object_mut().unwrap().remove(key).unwrap();
        }
        event
    });
    bare.collect()
}

#[track_caller]
fn holds(cell: &TestController, condition: Value, since: u64) -> bool {
    let condition = serde_json::from_value(condition).unwrap();
    cell.controller.holds(&condition, since).unwrap()
}

#[test]
fn an_input_changes_while_a_program_runs_and_it_finishes() {
    let mut cell = recording(&with_waiting_program());
    does(&mut cell, json!({ "do": "run", "program": "wait.jspf" }));
    cell.run_ms(500);
    assert_eq!(state(&cell)["program"], "wait.jspf");
    assert_eq!(state(&cell)["last_run"], Value::Null);
    does(&mut cell, json!({ "do": "set", "items": { "DI[3]": true } }));
    cell.run_ms(20);
    let run = state(&cell)["last_run"].clone();
    assert_eq!(
        run,
        json!({
            "run": 1, "program": "wait.jspf", "outcome": "finished", "started_s": 0.0, "ended_s": 0.51
        })
    );
    assert_eq!(
        events(&cell, 1, &["program_started", "write", "program_state", "program_ended"]),
        [
            json!({ "event": "program_started", "run": 1, "program": "wait.jspf", "by": "pendant" }),
            json!({ "event": "program_state", "state": "running", "was": "stopped" }),
            json!({ "event": "write", "item": "DI[3]", "value": 1.0, "was": 0.0, "by": "control" }),
            json!({ "event": "program_ended", "run": 1, "program": "wait.jspf", "outcome": "finished",
                "started_s": 0.0, "ended_s": 0.51 }),
            json!({ "event": "program_state", "state": "stopped", "was": "running" }),
        ]
    );
}

#[test]
fn a_program_tells_why_and_where_it_failed() {
    let config = with_program(SimConfig::default(), "bad", "wait_ms(5);\n\n  throw \"no part\";");
    let mut cell = recording(&config);
    does(&mut cell, json!({ "do": "run", "program": "bad" }));
    cell.run_ms(10);
    let run = cell.controller.last_run().unwrap();
    assert_eq!((run.outcome, run.line, run.column), (RunOutcome::Failed, Some(3), Some(3)));
    assert!(run.reason.as_ref().unwrap().contains("no part"), "{run:?}");
    let run = state(&cell)["last_run"].clone();
    assert_eq!((&run["outcome"], &run["line"], &run["column"]), (&json!("failed"), &json!(3), &json!(3)));
    assert_eq!(events(&cell, 1, &["error"])[0]["code"], 0x1002);
}

#[test]
fn what_has_stopped_a_program_is_told() {
    let causes = [
        (json!({ "do": "stop" }), "stop"),
        (json!({ "do": "disable" }), "disable"),
        (json!({ "do": "power_off" }), "power_off"),
        (json!({ "do": "emergency_stop" }), "emergency_stop"),
        (json!({ "do": "protective_stop" }), "protective_stop"),
        (json!({ "do": "hold", "safety": "config" }), "safety"),
    ];
    for (cause, reason) in causes {
        let mut cell = recording(&with_waiting_program());
        does(&mut cell, json!({ "do": "run", "program": "wait.jspf" }));
        cell.run_ms(50);
        does(&mut cell, cause.clone());
        cell.run_ms(500);
        let run = cell.controller.last_run().unwrap();
        assert_eq!((run.outcome, run.reason.as_deref()), (RunOutcome::Stopped, Some(reason)), "{cause}");
        assert_eq!(events(&cell, 1, &["program_ended"]).len(), 1);
    }
    // A restart forgets it, and tells of it.
    let mut cell = recording(&with_waiting_program());
    does(&mut cell, json!({ "do": "run", "program": "wait.jspf" }));
    does(&mut cell, json!({ "do": "restart" }));
    assert_eq!(cell.controller.last_run(), None);
    let ended = events(&cell, 1, &["program_ended", "started"]);
    assert_eq!((&ended[0]["event"], &ended[1]["reason"]), (&json!("started"), &json!("restart")));
    assert_eq!(ended.len(), 3, "it has started again: {ended:?}");
    // A command of a client.
    let mut cell = recording(&with_waiting_program());
    let c = cell.command_client();
    cell.ask(c, "run(wait.jspf)");
    assert_eq!(cell.order(c, "stop"), "stop success");
    assert_eq!(cell.controller.last_run().unwrap().reason.as_deref(), Some("stop"));
    assert_eq!(events(&cell, 1, &["program_started"])[0]["by"], "command");
}

#[test]
fn an_emergency_stop_stays_until_it_is_cleared() {
    let mut cell = recording(&with_waiting_program());
    let c = cell.command_client();
    let before = cell.controller.newest_event() + 1;
    does(&mut cell, json!({ "do": "emergency_stop" }));
    cell.run_ms(500);
    assert_eq!((&state(&cell)["safety"], &state(&cell)["robot"]), (&json!("stop0"), &json!("disable")));
    assert_eq!(cell.order(c, "enable"), "enable fail");
    assert!(refusal(&mut cell, &json!({ "do": "enable" })).contains("a safety stop is active"));
    does(&mut cell, json!({ "do": "clear" }));
    cell.run_ms(300);
    does(&mut cell, json!({ "do": "enable" }));
    cell.run_ms(300);
    assert_eq!((&state(&cell)["safety"], &state(&cell)["robot"]), (&json!("run"), &json!("enable")));
    let safety: Vec<_> =
        events(&cell, before, &["safety"]).iter().map(|event| event["state"].clone()).collect();
    assert_eq!(safety, ["stop0", "recovery", "run"]);
}

#[test]
fn errors_are_raised_and_cleared() {
    let mut cell = recording(&SimConfig::default());
    let c = cell.command_client();
    does(&mut cell, json!({ "do": "raise_error", "code": 0x4711, "text": "drive 3: too hot" }));
    assert_eq!(state(&cell)["error"], json!({ "code": 0x4711, "text": "drive 3: too hot" }));
    assert!(cell.ask(c, "getlasterror").contains("drive 3: too hot"));
    assert_eq!(cell.controller.registers().status().error, 0x4711);
    does(&mut cell, json!({ "do": "clear_error" }));
    assert_eq!(state(&cell)["error"], Value::Null);
    assert_eq!(cell.controller.registers().status().error, 0);
    let found = events(&cell, 1, &["error", "error_cleared"]);
    let error = json!({ "event": "error", "code": 0x4711, "text": "drive 3: too hot" });
    assert_eq!(found, [error, json!({ "event": "error_cleared" })]);
    assert!(refusal(&mut cell, &json!({ "do": "raise_error", "code": 0 })).contains("no error"));
}

#[test]
fn the_key_decides_who_starts_programs() {
    let mut cell = recording(&with_waiting_program());
    let c = cell.command_client();
    does(&mut cell, json!({ "do": "mode", "mode": "manual" }));
    assert_eq!(cell.ask(c, "run(wait.jspf)"), "run fail");
    does(&mut cell, json!({ "do": "run", "program": "wait.jspf", "speed_percent": 25 }));
    assert_eq!(state(&cell)["speed_percent"], 25.0);
    let found = events(&cell, 1, &["mode", "speed"]);
    assert_eq!(found[0], json!({ "event": "mode", "mode": "manual", "was": "remote" }));
    assert_eq!(found[1], json!({ "event": "speed", "percent": 25.0, "was": 100.0 }));
}

#[test]
fn all_items_are_set_or_none() {
    let mut cell = recording(&SimConfig::default());
    let before = cell.controller.newest_event();
    let why = refusal(&mut cell, &json!({ "do": "set", "items": { "DI[1]": 1, "WordInputReg[2]": 65_536 } }));
    assert_eq!(why, "WordInputReg[2]: cannot be 65536");
    let why = refusal(&mut cell, &json!({ "do": "set", "items": { "AI_V[1]": 1, "DI[99]": 1 } }));
    assert_eq!(why, "DI[99]: there is only DI[1..16]");
    assert_eq!((cell.value("DI[1]"), cell.value("AI_V[1]")), (0.0, 0.0));
    assert_eq!(cell.controller.newest_event(), before, "nothing has happened");
    let items = json!({ "DI[1]": true, "AI_V[1]": 2.5, "BitInputReg[3].4": 1, "ToolButton[1]": 1 });
    does(&mut cell, json!({ "do": "set", "items": items }));
    let values = does(&mut cell, json!({ "do": "get", "items": ["DI[1]", "AI_V[1]", "BitInputReg[3]"] }));
    assert_eq!(values, json!({ "DI[1]": 1, "AI_V[1]": 2.5, "BitInputReg[3]": 16 }));
}

#[test]
fn wrong_operations_are_refused_with_what_is_allowed() {
    let mut cell = recording(&with_waiting_program());
    for (wrong, words) in [
        (json!({ "do": "estp" }), "expected one of `state`, `get`"),
        (json!({ "set": {} }), "`do` is missing"),
        (json!({ "do": "state", "of": 1 }), "unknown field `of`"),
        (json!({ "do": "set" }), "missing field `items`"),
        (json!({ "do": "set", "items": { "DI[1]": "on" } }), "a number, true or false"),
        (json!({ "do": "mode", "mode": "remot" }), "expected one of `manual`, `auto`, `remote`"),
        (json!({ "do": "collide", "axis": 7 }), "7 is no place of a collision; there are 1 to 6"),
        (json!({ "do": "run", "program": "nothing" }), "there is no program nothing; there are wait.jspf"),
        (json!({ "do": "run", "program": "wait.jspf", "speed_percent": 0 }), "not within (0, 100]"),
        (json!({ "do": "upload", "program": "a", "script": "let x = ;" }), "(line 1, position 9)"),
        (json!({ "do": "upload", "program": "a(b)", "script": "" }), "is no name"),
        (json!({ "do": "remove", "program": "nothing" }), "there is no program nothing"),
        (json!({ "do": "recipe", "port": "p", "recipe": "r" }), "there is no port p"),
        (json!({ "do": "fault" }), "a fault is on one of server, port and item"),
        (
            json!({ "do": "fault", "server": "state", "kind": "delay", "seconds": 1 }),
            "state has no fault delay",
        ),
        (json!({ "do": "fault", "server": "command", "kind": "delay" }), "seconds are missing"),
        (
            json!({ "do": "fault", "server": "command", "kind": "mute", "seconds": 1 }),
            "belongs to the kind delay",
        ),
        (json!({ "do": "fault", "server": "modbus", "kind": "exception", "code": 12 }), "not within 1 to 11"),
        (json!({ "do": "fault", "item": "DI[1]", "kind": "spoil", "value": "nan" }), "is not a float"),
        (json!({ "do": "fault", "transitions": -1 }), "not within 0 to"),
        (json!({ "do": "heal", "port": "p" }), "there is no port p"),
        (json!({ "do": "events", "kinds": ["writes"] }), "there are no events writes"),
        (json!({ "do": "advance", "seconds": 1 }), "not possible here"),
        (json!({ "do": "power_on" }), "the robot is not powered off"),
    ] {
        let why = refusal(&mut cell, &wrong);
        assert!(why.contains(words), "{wrong}: {why}");
    }
}

#[test]
fn programs_come_and_go() {
    let mut cell = recording(&SimConfig::default());
    assert_eq!(does(&mut cell, json!({ "do": "programs" })), json!([]));
    does(&mut cell, json!({ "do": "upload", "program": "a", "script": "set(\"DO[1]\", 1); wait_ms(50);" }));
    assert_eq!(does(&mut cell, json!({ "do": "programs" })), json!(["a"]));
    let c = cell.command_client();
    assert_eq!(cell.ask(c, "run(a)"), "run start");
    assert!(refusal(&mut cell, &json!({ "do": "upload", "program": "a", "script": "" })).contains("a runs"));
    assert!(refusal(&mut cell, &json!({ "do": "remove", "program": "a" })).contains("a runs"));
    cell.run_ms(60);
    assert_eq!(cell.value("DO[1]"), 1.0);
    does(&mut cell, json!({ "do": "upload", "program": "a", "script": "set(\"DO[1]\", 0);" }));
    assert_eq!(cell.ask(c, "run(a)"), "run start");
    cell.run_ms(1);
    assert_eq!(cell.value("DO[1]"), 0.0);
    let by = events(&cell, 1, &["write"]);
    assert_eq!(
        by[0],
        json!({ "event": "write", "item": "DO[1]", "value": 1.0, "was": 0.0, "by": "program" })
    );
    assert_eq!(by.len(), 2, "the status that follows is not told: {by:?}");
    does(&mut cell, json!({ "do": "remove", "program": "a" }));
    assert_eq!(cell.ask(c, "run(a)"), "run fail");
}

#[test]
fn commands_and_replies_are_told_in_words() {
    let mut cell = recording(&with_power(SimConfig::default(), Power::Off));
    let c = cell.command_client();
    assert_eq!(cell.order(c, "poweron"), "poweron success");
    cell.ask(c, "hello");
    cell.close(c);
    let client = c.0;
    assert_eq!(
        events(&cell, 1, &["connected", "disconnected", "command", "reply"]),
        [
            json!({ "event": "connected", "server": "command", "client": client }),
            json!({ "event": "command", "client": client, "text": "poweron" }),
            json!({ "event": "reply", "client": client, "text": "poweron success", "to": "poweron" }),
            json!({ "event": "command", "client": client, "text": "hello" }),
            json!({ "event": "reply", "client": client, "text": "unknown command", "to": "hello" }),
            json!({ "event": "disconnected", "server": "command", "client": client }),
        ]
    );
    let words: Vec<_> = cell.controller.events_since(1).map(|event| event.what.to_string()).collect();
    assert!(words.contains(&format!("client {client} asks: poweron")), "{words:?}");
    assert!(words.contains(&"robot: power_off -> disable".to_owned()), "{words:?}");
}

#[test]
fn a_write_is_told_with_its_writer() {
    let recipe = both_ways();
    let mut cell = recording(&one_port(rs485(), recipe));
    cell.port_bytes(0, &[0xFF, 0xFF, 5, 0, 0xEE, 0xEE]);
    cell.port_bytes(0, &[0xFF, 0xFF, 5, 0, 0xEE, 0xEE]);
    let m = cell.modbus_client();
    cell.modbus(m, &[6, 0, 81, 0, 77]);
    cell.modbus(m, &[5, 0, 193, 0xFF, 0]);
    assert_eq!(
        events(&cell, 1, &["write"]),
        [
            json!({ "event": "write", "item": "WordInputReg[2]", "value": 5.0, "was": 0.0, "by": "p" }),
            json!({ "event": "write", "item": "AO[2]", "value": 77.0, "was": 0.0, "by": "modbus" }),
            json!({ "event": "write", "item": "DO[2]", "value": 1.0, "was": 0.0, "by": "modbus" }),
        ]
    );
}

#[test]
fn the_newest_events_are_kept_and_writes_displace_only_writes() {
    const MAX: usize = 100;
    let mut cell = robot(&SimConfig::default());
    cell.controller.record_newest_events(MAX);
    let c = cell.command_client();
    cell.ask(c, "state");
    for n in 0..MAX + 10 {
        does(&mut cell, json!({ "do": "set", "items": { "WordInputReg[1]": n % 2 + 1 } }));
    }
    let writes = events(&cell, 1, &["write"]).len();
    assert_eq!(writes, MAX);
    assert!(cell.controller.dropped_events() > 0);
    assert_eq!(events(&cell, 1, &["operation"]).len(), MAX);
    let found = does(&mut cell, json!({ "do": "events", "kinds": ["write"], "max": 2 }));
    assert_eq!(found["events"].as_array().unwrap().len(), 2);
    assert!(found["lost"].as_u64().unwrap() > 0);
    let next = found["next"].as_u64().unwrap();
    let more = does(&mut cell, json!({ "do": "events", "kinds": ["write"], "max": 1, "since": next }));
    assert!(more["events"][0]["n"].as_u64().unwrap() >= next);
    let numbers: Vec<_> = cell.controller.events_since(1).map(|event| event.number).collect();
    assert!(numbers.is_sorted());
    let after = cell.controller.newest_event() + 1;
    let none = does(&mut cell, json!({ "do": "events", "since": after }));
    assert_eq!(none["events"], json!([]));
}

#[test]
fn faults_are_shown_and_healed() {
    let mut cell = recording(&one_port(rs485(), both_ways()));
    let faults = [
        json!({ "server": "command", "kind": "mute" }),
        json!({ "server": "command", "kind": "delay", "seconds": 0.5 }),
        json!({ "server": "state", "kind": "freeze" }),
        json!({ "server": "modbus", "kind": "garbage" }),
        json!({ "server": "modbus", "kind": "exception", "code": 4 }),
        json!({ "port": "p", "kind": "mute" }),
        json!({ "item": "RobotState[8]", "kind": "spoil", "value": "nan" }),
        json!({ "transitions": 1.5 }),
    ];
    for fault in &faults {
        let mut operation = fault.clone();
        operation["do"] = json!("fault");
        does(&mut cell, operation);
    }
    assert_eq!(state(&cell)["faults"], json!(faults));
    does(&mut cell, json!({ "do": "heal", "server": "command" }));
    does(&mut cell, json!({ "do": "heal", "item": "RobotState[8]", "port": "p" }));
    does(&mut cell, json!({ "do": "heal", "transitions": true }));
    assert_eq!(state(&cell)["faults"], json!(faults[2..5]));
    does(&mut cell, json!({ "do": "heal" }));
    assert_eq!(state(&cell)["faults"], json!([]));
}

#[test]
fn garbage_and_frozen_packets_reach_the_client() {
    let mut cell = recording(&SimConfig::default());
    let (c, s, m) = (cell.command_client(), cell.state_client(), cell.modbus_client());
    cell.run_ms(100);
    let before = cell.take(s);
    does(&mut cell, json!({ "do": "fault", "server": "state", "kind": "freeze" }));
    cell.run_ms(100);
    let frozen = cell.take(s);
    does(&mut cell, json!({ "do": "set", "items": { "DI[1]": 1 } }));
    cell.run_ms(200);
    assert_eq!(cell.take(s), [frozen.clone(), frozen.clone()].concat());
    assert_eq!(before, frozen, "nothing has changed in between");
    does(&mut cell, json!({ "do": "fault", "server": "state", "kind": "garbage" }));
    does(&mut cell, json!({ "do": "fault", "server": "command", "kind": "garbage" }));
    does(&mut cell, json!({ "do": "fault", "server": "modbus", "kind": "garbage" }));
    cell.run_ms(100);
    let garbage = cell.take(s);
    assert_eq!(garbage.len(), 1_468);
    assert_ne!(garbage, frozen);
    cell.send(c, b"state\r\n");
    let reply = cell.take(c);
    assert_eq!(reply.len(), "6:0:5:2".len());
    assert_ne!(reply, b"6:0:5:2");
    cell.send(m, &[0, 1, 0, 0, 0, 6, 1, 3, 0, 0, 0, 1]);
    let answer = cell.take(m);
    assert_eq!(answer.len(), 11);
    assert_ne!(answer[..6], [0, 1, 0, 0, 0, 5]);
    does(&mut cell, json!({ "do": "heal" }));
    cell.run_ms(100);
    let packet = cell.take(s);
    assert_eq!(packet.len(), 1_468);
    assert_ne!(packet, frozen, "DI[1]");
    assert_eq!(cell.ask(c, "state"), "6:0:5:2");
}

#[test]
fn a_port_gets_another_recipe_and_another_cycle() {
    let output = both_ways();
    let mut cell = recording(&one_port(rs485(), output));
    cell.run_ms(100);
    let at_4_ms = cell.take_sent().len();
    does(&mut cell, json!({ "do": "cycle", "port": "p", "ms": 20 }));
    cell.run_ms(100);
    assert_eq!((at_4_ms, cell.take_sent().len()), (25, 5));
    assert_eq!(state(&cell)["ports"]["p"]["cycle_ms"], 20.0);
    does(&mut cell, json!({ "do": "recipe", "port": "p", "recipe": null }));
    cell.run_ms(100);
    assert_eq!(cell.take_sent().len(), 0);
    assert_eq!(state(&cell)["ports"]["p"]["recipe"], Value::Null);
    does(&mut cell, json!({ "do": "recipe", "port": "p", "recipe": "r" }));
    cell.run_ms(100);
    assert_eq!(cell.take_sent().len(), 5);
    assert!(refusal(&mut cell, &json!({ "do": "cycle", "port": "p", "ms": 3 })).contains("not within 4 to"));
    let why = refusal(&mut cell, &json!({ "do": "recipe", "port": "p", "recipe": "x" }));
    assert_eq!(why, "recipe: there is no recipe x; there are r");
}

#[test]
fn a_restart_boots() {
    let mut cell = recording(&with_initial(SimConfig::default(), &[("WordInputReg[1]", 7.0)]));
    let c = cell.command_client();
    does(&mut cell, json!({ "do": "set", "items": { "WordInputReg[1]": 9 } }));
    let before = cell.controller.newest_event() + 1;
    does(&mut cell, json!({ "do": "restart" }));
    assert!(cell.is_closed(c));
    assert_eq!(cell.value("WordInputReg[1]"), 7.0);
    cell.run_ms(1_000);
    let states: Vec<_> =
        events(&cell, before, &["robot"]).iter().map(|event| event["state"].clone()).collect();
    assert_eq!(states, ["start", "initialize", "logout", "login", "power_off"]);
    does(&mut cell, json!({ "do": "restart", "registers": "cleared" }));
    assert_eq!(cell.value("WordInputReg[1]"), 0.0);
}

#[test]
fn conditions_hold_when_all_that_they_name_is_so() {
    let mut cell = recording(&with_waiting_program());
    let enabled = json!({ "robot": "enable", "program": null, "mode": "remote", "safety": "run" });
    assert!(holds(&cell, enabled.clone(), 1));
    does(&mut cell, json!({ "do": "run", "program": "wait.jspf" }));
    assert!(!holds(&cell, enabled, 1));
    assert!(holds(&cell, json!({ "program": "wait.jspf", "program_state": "running" }), 1));
    does(&mut cell, json!({ "do": "set", "items": { "DO[1]": 1, "WordOutputReg[1]": 513 } }));
    assert!(holds(&cell, json!({ "items": { "DO[1]": true, "WordOutputReg[1]": 513 } }), 1));
    assert!(!holds(&cell, json!({ "items": { "DO[1]": 0 } }), 1));
    assert!(holds(&cell, json!({ "coil": { "192": 1, "193": 0 } }), 1));
    assert!(!holds(&cell, json!({ "register": { "1": 5 } }), 1));
    assert!(holds(&cell, json!({ "register": { "1": 6 } }), 1), "the robot's state");
    let started = json!({ "event": { "event": "program_started", "program": "wait.jspf", "run": 1.0 } });
    assert!(holds(&cell, started.clone(), 1));
    assert!(!holds(&cell, started, cell.controller.newest_event() + 1), "not since");
    assert!(!holds(&cell, json!({ "event": { "event": "program_started", "program": "b" } }), 1));
    for (wrong, words) in [
        (json!({}), "is empty"),
        (json!({ "robot": "enabled" }), "there is no state enabled; there are start, "),
        (json!({ "coil": { "x": 1 } }), "x is no address; allowed: 0..="),
        (json!({ "register": { "9999": 1 } }), "9999 is no address"),
        (json!({ "items": { "DQ[1]": 1 } }), "DQ[1]: no such system variable"),
        (json!({ "event": {} }), "its key `event` is missing"),
        (json!({ "event": { "event": "start" } }), "there are no events start"),
    ] {
        let condition: Condition = serde_json::from_value(wrong.clone()).unwrap();
        let why = cell.controller.holds(&condition, 1).unwrap_err().to_string();
        assert!(why.contains(words), "{wrong}: {why}");
    }
}

#[test]
fn names_of_states_are_those_of_the_wire() {
    use proto_core::wire::state::{ProgramState, RobotState, SafetyState};
    let all = |name: fn(u8) -> &'static str| {
        let names = (0..=255).map(name).filter(|name| *name != "Unknown");
        names.map(crate::common::snake).collect::<std::collections::BTreeSet<_>>()
    };
    let known = |key: &str, names: std::collections::BTreeSet<String>| {
        for name in names {
            let condition: Condition = serde_json::from_value(json!({ key: name })).unwrap();
            condition.check().unwrap_or_else(|error| panic!("{error}"));
        }
    };
    known("robot", all(|code| RobotState::from_code(code).name()));
    known("program_state", all(|code| ProgramState::from_code(code).name()));
    known("safety", all(|code| SafetyState::from_code(code).name()));
}

#[test]
fn a_seed_chooses_the_phases_and_a_run_repeats() {
    let config = one_port(rs485(), both_ways());
    let first_sent = |seed: Option<u64>| {
        let mut controller = Controller::new(&config).unwrap();
        if let Some(seed) = seed {
            controller.seed(seed);
        }
        let start = Instant::from_millis(1_000);
        let mut now = start;
        controller.handle(now, ControllerInput::PortUp { port: 0 });
        loop {
            match controller.poll_output(now) {
                ControllerOutput::PortSend { .. } => return now.saturating_since(start),
                ControllerOutput::Sleep { until } => now = until,
                _ => {}
            }
        }
    };
    assert_eq!(first_sent(None), Duration::from_millis(4));
    let phases: Vec<_> = (0..20).map(|seed| first_sent(Some(seed))).collect();
    assert!(phases.iter().all(|phase| *phase <= Duration::from_millis(4)), "{phases:?}");
    assert!(phases.iter().any(|phase| *phase != phases[0]), "{phases:?}");
    assert_eq!(first_sent(Some(7)), first_sent(Some(7)));
}

#[test]
fn operations_survive_json() {
    let all = [
        json!({ "do": "wait", "until": { "program": null }, "timeout_s": 5.0 }),
        json!({ "do": "fault", "server": "modbus", "kind": "exception", "code": 4 }),
        json!({ "do": "set", "items": { "DI[1]": true, "DI[2]": 0.0 } }),
        json!({ "do": "restart", "registers": "cleared" }),
        json!({ "do": "emergency_stop" }),
    ];
    for operation in all {
        let read = Operation::from_json(operation.as_object().unwrap().clone()).unwrap();
        assert_eq!(json!(read), operation);
    }
}
