//! What people see.

use proto_core::engine::PortCounters;
use recipe_ctl::{Failure, TableView, Verdict};
use serde_json::json;

use crate::server::*;

fn host() -> Server {
    let status = json!({
        "time_us": 7_000_000, "sleeps": 0, "health": "port-silent",
        "ports": {
            "force": {
                "bus": "rs485", "recipe": 0, "state": "working", "age_ms": 3, "overdue": 0, "reply": "none",
                "counters": { "frames_in": 218_590, "frames_out": 0, "rejected_id": 5 },
            },
            "panel": {
                "bus": "rs485", "recipe": 1, "state": "silent", "age_ms": 61_000, "overdue": 1, "reply": "none",
                "last_rejection": { "why": "no_frame", "text": "no frame found", "age_ms": 40, "len": 2, "bytes": "AA 48" },
                "counters": { "frames_in": 7, "frames_out": 23_194, "tail_mismatches": 2, "rejected_checksum": 1, "resync_bytes": 2,
                    "skipped_cycles": 5, "stale_cycles": 1 },
            },
        },
        "links": {
            "modbus": { "kind": "modbus", "state": "up", "history": { "connects": 1 },
                "counters": { "sent": 10, "received": 9, "timeouts": 1, "refused": 0 } },
            "state": { "kind": "state", "state": "down", "history": { "connects": 0 }, "counters": {} },
        },
        "controller": { "mode": { "code": 2, "name": "Remote" }, "robot": { "code": 6, "name": "Enable" },
            "program": { "code": 0, "name": "Stopped" }, "safety": { "code": 5, "name": "Run" }, "age_ms": 80 },
        "latency": { "modbus": { "count": 9, "p50_us": 512, "p99_us": 1_024, "max_us": 8_600 }, "arrived": { "count": 0 } },
    });
    let info = json!({
        "name": "cell-3", "role": "gateway", "version": "0.2.0", "uptime_s": 3_725, "can_be_changed": true, "revision": 2,
        "places": { "ports": { "force": "/dev/ttyUSB0", "panel": "run/panel" } },
    });
    let values = json!({ "time_us": 7, "values": {
        "ForceEnd[1]": { "value": -9.990_103_f32, "age_ms": 3, "owner": "force" },
        "WordInputReg[1]": { "value": 179, "age_ms": 1_250, "owner": "panel" },
        "RobotState[8]": { "value": 0.5, "age_ms": 80 },
    } });
    let revisions = json!({
        "running": 3, "live": 2, "previous": 1, "waiting": 4, "base": "\"4-00000000\"",
        "trial": { "revision": 3, "left_s": 41.3 }, "last": { "revision": 2, "ended": "confirmed" },
        "kept": [
            { "revision": 1, "etag": "\"1-0\"", "from": "cell.toml", "stored_at": 1_795_392_619 },
            { "revision": 2, "etag": "\"2-0\"", "from": "192.168.0.5", "stored_at": 1_795_393_619 },
            { "revision": 3, "etag": "\"3-0\"", "from": "192.168.0.5", "stored_at": 1_795_394_619 },
            { "revision": 4, "etag": "\"4-0\"", "from": "192.168.0.6", "stored_at": 1_795_395_619 },
        ],
    });
    let doctor = json!({ "findings": [
        { "severity": "fault", "place": "port", "name": "panel", "cause": "head_swapped",
          "seen": "175 bytes, 0 frames; first seen AA 48", "expected": "the head 48 AA",
          "likely": "The bytes of the head are swapped", "remedy": "Write head = [0xAA, 0x48] in the recipe",
          "text": "port panel: 175 bytes" },
        { "severity": "note", "place": "controller", "cause": "one_way", "seen": "nothing came", "expected": "",
          "likely": "It has nothing to say", "remedy": "None", "text": "controller: nothing came" },
    ] });
    Server::start(move |asked| match asked.path.as_str() {
        "info" => ok(&info),
        "status" => ok(&status),
        "values" => ok(&values),
        "revisions" => ok(&revisions),
        "doctor" => ok(&doctor),
        "log?lines=2" => bytes(200, "text/plain", "", b"one\ntwo\n"),
        _ => not_found(),
    })
}

#[test]
fn what_is_read_is_laid_out_in_tables() {
    let server = host();
    let client = server.client(false);
    insta::assert_snapshot!("info", recipe_ctl::info(&client).unwrap().text(WIDE));
    let status = recipe_ctl::status(&client, WIDE).unwrap();
    assert_eq!(status.verdict(), Verdict::Trouble);
    insta::assert_snapshot!("status", plain(status.text(WIDE)));
    let narrow = TableView { width: Some(90), is_terminal: true };
    let text = plain(recipe_ctl::status(&client, narrow).unwrap().text(narrow));
    assert!(text.lines().all(|line| line.chars().count() <= 90), "{text}");
    insta::assert_snapshot!("values", recipe_ctl::values(&client, &[], WIDE).unwrap().text(WIDE));
    let some = recipe_ctl::values(&client, &["force".into()], WIDE).unwrap();
    assert_eq!(some.text(WIDE).lines().count(), 2);
    insta::assert_snapshot!("revisions", recipe_ctl::revisions(&client).unwrap().text(WIDE));
    let doctor = recipe_ctl::doctor(&client, std::time::Duration::ZERO).unwrap();
    assert_eq!(doctor.verdict(), Verdict::Trouble);
    insta::assert_snapshot!("doctor", plain(doctor.text(WIDE)));
    assert_eq!(recipe_ctl::log(&client, 2).unwrap().text(WIDE), "one\ntwo\n");
}

fn plain(text: String) -> String {
    ["\u{1b}[31m", "\u{1b}[32m", "\u{1b}[33m", "\u{1b}[0m"]
        .iter()
        .fold(text, |text, code| text.replace(code, ""))
}

/// The table sums what a gateway of any version counts, by the names of its counters.
#[test]
fn frames_are_rejected_for_the_same_reasons_as_in_the_engine() {
    let mut counters = serde_json::to_value(PortCounters::default()).unwrap();
    counters.as_object_mut().unwrap().values_mut().for_each(|count| *count = 1.into());
    let rejected = serde_json::from_value::<PortCounters>(counters.clone()).unwrap().rejected();
    let port = json!({ "state": "working", "counters": counters });
    let status = json!({ "health": "running", "ports": { "all": port }, "links": {} });
    let server = Server::start(move |_| ok(&status));
    let text = plain(recipe_ctl::status(&server.client(false), WIDE).unwrap().text(WIDE));
    assert!(text.contains(&format!(" {rejected}, 2 bytes ")), "{rejected}: {text}");
}

#[test]
fn documents_are_those_of_the_gateway() {
    let server = host();
    let answer = recipe_ctl::status(&server.client(false), WIDE).unwrap();
    let document: serde_json::Value = serde_json::from_str(&answer.json()).unwrap();
    assert_eq!(document["ports"]["panel"]["last_rejection"]["bytes"], "AA 48");
    assert_eq!(answer.json().lines().count(), 1);
}

#[test]
fn refusals_are_told_in_the_gateways_words() {
    let server = Server::start(|asked| match asked.path.as_str() {
        "info" => document(429, "Retry-After: 42\r\n", &json!({ "error": "too many wrong keys; wait" })),
        "values" => document(503, "", &json!({ "error": "nothing runs at the moment; try again" })),
        "revisions" => document(
            422,
            "",
            &json!({ "error": "1 is out of range", "key": "port.a.baud", "line": 33, "column": 14 }),
        ),
        _ => document(500, "", &json!({})),
    });
    let client = server.client(false);
    let message = |failure: Failure| failure.message().split_once(": ").unwrap().1.to_owned();
    assert_eq!(message(recipe_ctl::info(&client).unwrap_err()), "too many wrong keys; wait 42 s");
    let error = recipe_ctl::values(&client, &[], WIDE).unwrap_err();
    assert_eq!(message(error), "nothing runs at the moment; try again");
    let error = recipe_ctl::revisions(&client).unwrap_err();
    assert!(matches!(error, Failure::Wrong(_)), "{error:?}");
    assert_eq!(message(error), "the configuration is refused: 33:14: port.a.baud: 1 is out of range");
    let error = recipe_ctl::status(&client, WIDE).unwrap_err();
    assert_eq!(message(error), "it answers with status 500; is this a gateway?");
    drop(server);
    let forwarded = Server::start(|asked| match asked.field("Host") {
        Some("10.0.2.15") => ok(&json!({ "role": "board", "has": { "rs485": 2, "can": 1 } })),
        _ => document(421, "", &json!({ "error": "this server is not that host" })),
    });
    let error = recipe_ctl::info(&forwarded.client(false)).unwrap_err();
    assert!(error.message().ends_with("with --host, or as `host` in the inventory"), "{error:?}");
    let info = recipe_ctl::info(&forwarded.client(false).known_as("10.0.2.15".parse().ok())).unwrap();
    assert!(info.text(WIDE).contains("has      2 RS-485 ports, 1 CAN ports\n"), "{}", info.text(WIDE));
    let nobody: recipe_ctl::Address = "127.0.0.1:1".parse().unwrap();
    let client =
        recipe_ctl::Client::new(nobody, None, std::time::Duration::from_secs(5), recipe_ctl::Stop::new());
    let error = recipe_ctl::info(&client.unwrap()).unwrap_err();
    assert_eq!(error.message(), "127.0.0.1:1: nobody is there: 127.0.0.1:1: Connection refused");
}
