//! Every command makes a request that the controller understands.

use clap::Parser;
use recipe_controller::operations::Operation;

use super::*;

#[derive(Debug, Parser)]
struct Line {
    #[command(subcommand)]
    act: Act,
}

fn request(line: &str) -> Result<Value, String> {
    let words = std::iter::once("pendant").chain(line.split(' '));
    Line::try_parse_from(words).map_err(|error| error.to_string())?.act.request()
}

#[track_caller]
fn assert_asks(line: &str, expected: Value) {
    let made = request(line).unwrap_or_else(|error| panic!("{line}: {error}"));
    assert_eq!(made, expected, "{line}");
    let Value::Object(object) = made else { panic!("{line}") };
    Operation::from_json(object).unwrap_or_else(|error| panic!("{line}: {error}"));
}

#[test]
fn commands_make_requests() {
    for name in [
        "state",
        "counters",
        "programs",
        "emergency-stop",
        "protective-stop",
        "clear",
        "clear-error",
        "power-on",
        "power-off",
        "enable",
        "disable",
        "stop",
        "pause",
        "resume",
        "heal",
    ] {
        assert_asks(name, json!({ "do": name.replace('-', "_") }));
    }
    assert_asks("state --watch=1s", bare("state"));
    assert_asks("get DI[3] DO[1]", json!({ "do": "get", "items": ["DI[3]", "DO[1]"] }));
    assert_asks(
        "set DI[3]=1 DI[4]=off AI_V[1]=2.5",
        json!({ "do": "set", "items": { "DI[3]": 1.0, "DI[4]": false, "AI_V[1]": 2.5 } }),
    );
    assert_asks("mode auto", json!({ "do": "mode", "mode": "auto" }));
    assert_asks("collide 3", json!({ "do": "collide", "axis": 3 }));
    assert_asks("reduced on", json!({ "do": "reduced", "on": true }));
    assert_asks("raise-error 0x1002 hot", json!({ "do": "raise_error", "code": 4098, "text": "hot" }));
    assert_asks("run p --speed 50", json!({ "do": "run", "program": "p", "speed_percent": 50.0 }));
    assert_asks("remove p", json!({ "do": "remove", "program": "p" }));
    assert_asks("recipe rs485 status", json!({ "do": "recipe", "port": "rs485", "recipe": "status" }));
    assert_asks("recipe rs485", json!({ "do": "recipe", "port": "rs485", "recipe": null }));
    assert_asks("cycle rs485 20", json!({ "do": "cycle", "port": "rs485", "ms": 20.0 }));
    assert_asks("restart --cleared", json!({ "do": "restart", "registers": "cleared" }));
    assert_asks("advance 0.4", json!({ "do": "advance", "seconds": 0.4 }));
    assert_asks(
        "wait robot=enable --timeout 2",
        json!({ "do": "wait", "until": { "robot": "enable" }, "timeout_s": 2.0 }),
    );
    assert_asks(
        "events --kind log,error",
        json!({ "do": "events", "since": 0, "kinds": ["log", "error"], "max": 1000 }),
    );
    assert_asks("events -f", json!({ "do": "follow", "kinds": [] }));
    assert_asks("do {\"do\":\"state\"}", bare("state"));
}

#[test]
fn faults_are_on_servers_ports_items_and_transitions() {
    let fault = |rest: Value| {
        let mut fault = bare("fault");
        fault.as_object_mut().unwrap().extend(rest.as_object().unwrap().clone());
        fault
    };
    assert_asks("fault command mute", fault(json!({ "server": "command", "kind": "mute" })));
    assert_asks(
        "fault command delay 0.5",
        fault(json!({ "server": "command", "kind": "delay", "seconds": 0.5 })),
    );
    assert_asks(
        "fault modbus exception 4",
        fault(json!({ "server": "modbus", "kind": "exception", "code": 4 })),
    );
    assert_asks("fault state cut 100", fault(json!({ "server": "state", "kind": "cut", "bytes": 100 })));
    assert_asks("fault port rs485 mute", fault(json!({ "port": "rs485", "kind": "mute" })));
    for (given, value) in [("nan", json!("nan")), ("-inf", json!("-inf")), ("-1.5", json!(-1.5))] {
        assert_asks(
            &format!("fault item RobotState[8] {given}"),
            fault(json!({ "item": "RobotState[8]", "kind": "spoil", "value": value })),
        );
    }
    assert_asks("fault transitions 2", fault(json!({ "transitions": 2.0 })));
    assert_asks("heal modbus", json!({ "do": "heal", "server": "modbus" }));
    assert_asks("heal port rs485", json!({ "do": "heal", "port": "rs485" }));
    assert_asks("heal item RobotState[8]", json!({ "do": "heal", "item": "RobotState[8]" }));
    assert_asks("heal transitions", json!({ "do": "heal", "transitions": true }));
}

#[test]
fn wrong_arguments_make_none() {
    for wrong in [
        "set",
        "set DI[1]",
        "set DI[1]=x",
        "mode fast",
        "fault command delay",
        "fault command mute 3",
        "fault modbus exception 1.5",
        "fault item RobotState[8] x",
        "wait",
        "wait x",
        "raise-error x",
        "do 1",
        "upload /nowhere/at/all",
        "events --follow --since 3",
    ] {
        assert!(request(wrong).is_err(), "{wrong}");
    }
}
