//! Lines, answers and clients.

use std::io::Write;

use serde_json::json;

use super::kit::{Control, config, connect, start};
use recipe_runtime::controller::Pace;
use recipe_test_kit::until;

const FILE: &str = "udp-server-controller.toml";

#[test]
fn each_line_gets_its_answer_in_order() {
    let handle = start(config(FILE), Pace::Real);
    assert!(handle.place("control").starts_with("127.0.0.1:"));
    let mut control = Control::of(&handle);
    // Several lines in one segment; ids of any kind come back unchanged.
    control.send(concat!(
        "{\"id\": 1, \"do\": \"set\", \"items\": {\"DI[3]\": 1}}\n",
        "{\"do\": \"get\", \"items\": [\"DI[3]\"], \"id\": {\"a\": [null]}}\n",
        "{\"do\": \"estp\"}\n",
        "{\"id\": null, \"do\": \"state\"}",
    ));
    let first = control.text();
    assert!(first.starts_with("{\"id\":1,\"ok\":true,\"time_s\":"), "{first}");
    assert!(first.ends_with(",\"result\":null}"), "{first}");
    let second = control.line();
    assert_eq!((&second["id"], &second["result"]), (&json!({ "a": [null] }), &json!({ "DI[3]": 1 })));
    let third = control.text();
    assert!(third.starts_with("{\"ok\":false,\"time_s\":"), "{third}");
    assert!(third.contains("unknown variant `estp`, expected one of `state`, `get`, "), "{third}");
    let fourth = control.line();
    assert!(fourth["id"].is_null() && fourth.get("id").is_some());
    assert_eq!(fourth["result"]["robot"], "enable");
    // The last line needs no end.
    let stream = connect(&handle, "control");
    (&stream).write_all(b"{\"do\":\"programs\"}").unwrap();
    stream.shutdown(std::net::Shutdown::Write).unwrap();
    let text = std::io::read_to_string(&stream).unwrap();
    assert!(text.ends_with("\"result\":[]}\n"), "{text}");
}

#[test]
fn whoever_speaks_something_else_is_not_listened_to() {
    let handle = start(config(FILE), Pace::Real);
    let long = format!("{{\"do\":\"get\",\"items\":[\"{}\"]}}", "x".repeat(1 << 20));
    let http = "POST / HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n{\"do\":\"emergency_stop\"}";
    for (text, why) in [
        (http, "not a JSON object: "),
        ("[1]", "not a JSON object; "),
        ("\u{7f}", "not a JSON object: "),
        ("", "not a JSON object: "),
        ("{\"do\":\"state\"", "not a JSON object: "),
        (&long, "the line is longer than 1048576 bytes"),
    ] {
        let mut control = Control::of(&handle);
        let text = format!("{text}\n{{\"do\":\"emergency_stop\"}}\n");
        control.try_send(&text).unwrap();
        let first = control.text();
        assert!(first.contains(why), "{first}");
        assert_eq!(control.rest(), "");
    }
    assert_eq!(Control::of(&handle).done(json!({ "do": "state" }))["safety"], "run");
}

impl Control {
    fn try_send(&mut self, text: &str) -> std::io::Result<()> {
        self.stream().write_all(text.as_bytes())
    }
}

#[test]
fn sixteen_clients_are_served_and_another_is_told_so() {
    let handle = start(config(FILE), Pace::Real);
    let mut clients: Vec<Control> = (0..16).map(|_| Control::of(&handle)).collect();
    for client in &mut clients {
        client.done(json!({ "do": "programs" }));
    }
    let mut another = Control::of(&handle);
    assert_eq!(another.line()["error"], "there are 16 clients already");
    assert_eq!(another.rest(), "");
    clients.pop();
    until("there is room again", || {
        let mut control = Control::of(&handle);
        let _ = control.try_send("{\"do\":\"programs\"}\n");
        control.line()["ok"].as_bool().filter(|ok| *ok)
    });
}

#[test]
fn requests_of_one_client_wait_for_each_other_and_others_are_served() {
    let handle = start(config(FILE), Pace::Real);
    let (mut one, mut other) = (Control::of(&handle), Control::of(&handle));
    one.send(r#"{"id":1,"do":"wait","until":{"items":{"DI[1]":1}},"timeout_s":20}"#);
    one.send(r#"{"id":2,"do":"get","items":["DI[2]"]}"#);
    // It is not answered before the first one is.
    other.done(json!({ "do": "set", "items": { "DI[2]": 1 } }));
    other.done(json!({ "do": "set", "items": { "DI[1]": 1 } }));
    other.done(json!({ "do": "set", "items": { "DI[1]": 0 } }));
    assert_eq!(one.line()["id"], 1);
    let second = one.line();
    assert_eq!((&second["id"], &second["result"]), (&json!(2), &json!({ "DI[2]": 1 })));
}

#[test]
fn a_wait_in_vain_says_what_is_the_case() {
    let handle = start(config(FILE), Pace::Real);
    let mut control = Control::of(&handle);
    let until = json!({ "robot": "disable", "mode": "remote", "program": "pick.jspf",
        "items": { "DI[1]": 1, "DI[2]": 0 }, "coil": { "192": 1 }, "register": { "1": 5 },
        "event": { "event": "log" } });
    let error = control.refused(json!({ "do": "wait", "until": until, "timeout_s": 0.02 }));
    assert_eq!(
        error,
        "not within 0.02 s: coil 192 is 0, not 1; there was no event {\"event\":\"log\"}; DI[1] is 0, not 1; \
         program is none, not pick.jspf; register 1 is 6, not 5; robot is enable, not disable"
    );
    let error = control.refused(json!({ "do": "wait", "until": { "robot": "off" } }));
    assert!(error.starts_with("robot: there is no state off; there are start, "), "{error}");
    let error = control.refused(json!({ "do": "wait", "until": {}, "timeout_s": 1 }));
    assert_eq!(error, "the condition is empty: it names nothing to wait for");
    let error = control.refused(json!({ "do": "wait", "until": { "mode": "auto" }, "timeout_s": -1 }));
    assert_eq!(error, "timeout_s: -1 is not within 0 to 86400");
    let error = control.refused(json!({ "do": "advance", "seconds": 1 }));
    assert_eq!(error, "the clock runs by itself; `advance` needs --time stepped, `wait` does not");
}

#[test]
fn followed_events_come_before_the_answer_of_what_caused_them() {
    let handle = start(config(FILE), Pace::Real);
    let mut control = Control::of(&handle);
    assert!(control.refused(json!({ "do": "follow", "kinds": ["wrong"] })).contains("there are no events"));
    control.done(json!({ "do": "follow", "kinds": ["safety", "write"] }));
    control.send(r#"{"id":5,"do":"emergency_stop"}"#);
    let event = control.line();
    assert_eq!((&event["event"]["event"], &event["event"]["state"]), (&json!("safety"), &json!("stop0")));
    assert_eq!(control.line()["id"], 5);
    // Another client's operation is told as well.
    Control::of(&handle).done(json!({ "do": "set", "items": { "DI[3]": 1 } }));
    let event = control.line();
    assert_eq!((&event["event"]["item"], &event["event"]["by"]), (&json!("DI[3]"), &json!("control")));
}

#[test]
fn a_follower_that_does_not_read_loses_events_and_is_told_how_many() {
    let handle = start(config(FILE), Pace::Real);
    let (mut slow, mut other) = (Control::of(&handle), Control::of(&handle));
    slow.done(json!({ "do": "follow" }));
    // More than the buffers on both sides and the controller keep.
    const OPERATIONS: usize = 60_000;
    let lines = "{\"do\":\"clear_error\"}\n".repeat(100);
    for _ in 0..OPERATIONS / 100 {
        other.try_send(&lines).unwrap();
        for _ in 0..100 {
            assert_eq!(other.line()["ok"], true);
        }
    }
    let newest = other.done(json!({ "do": "events", "since": OPERATIONS * 2, "max": 0 }))["next"].clone();
    let newest = newest.as_u64().unwrap() - 1;
    let (mut seen, mut lost, mut last) = (0, 0, 0);
    while last < newest {
        let line = slow.line();
        match line["lost"].as_u64() {
            Some(count) => lost += count,
            None => {
                seen += 1;
                last = line["event"]["n"].as_u64().unwrap();
            }
        }
    }
    // It has followed from the second event on.
    assert!(lost > 0 && seen + lost == newest - 1, "{seen} seen, {lost} lost of {newest}");
    // It is served as before.
    assert_eq!(slow.ask(json!({ "do": "programs" }))["ok"], true);
}
