//! `edge`: settings are kept and waited for; what a board says of its node is shown.

use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering::Relaxed};

use recipe_ctl::{Verdict, edge};
use serde_json::{Value, json};

use crate::server::*;

/// A board that says these, one after the other, when its node is asked for, and the last one again and again.
fn board(says: Vec<Value>) -> Server {
    let asked = Arc::new(AtomicUsize::new(0));
    Server::start(move |request| match (request.method.as_str(), request.path.as_str()) {
        ("PUT", "edge") if request.body == b"settings" => ok(&json!({ "state": "off", "next": "other" })),
        ("PUT", "edge?restart=yes") if request.body == b"settings" => {
            document(202, "", &json!({ "state": "off", "next": "other" }))
        }
        ("GET", "edge") => {
            let nth = asked.fetch_add(1, Relaxed).min(says.len() - 1);
            ok(&says[nth])
        }
        ("GET", "nonce") => ok(&json!({ "nonce": "0".repeat(48) })),
        _ => not_found(),
    })
}

fn online() -> Value {
    json!({
        "state": "online", "broker": "10.0.0.5:1883", "group": "hall", "node": "press", "utc": true, "bd_seq": 7,
        "metrics": 61, "counters": { "births": 3, "data": 5120, "lost": 0 }
    })
}

#[test]
fn how_a_node_does_is_shown() {
    let answer = edge::shown(&board(vec![online()]).client(true)).unwrap();
    let text = answer.text(WIDE);
    for words in ["online", "10.0.0.5:1883", "press", "5120"] {
        assert!(text.contains(words), "{text}");
    }
    assert_eq!(answer.verdict(), Verdict::Well);
    let lost = json!({ "state": "offline", "why": "no\u{1b} connection" });
    let answer = edge::shown(&board(vec![lost]).client(true)).unwrap();
    assert_eq!(answer.verdict(), Verdict::Trouble);
    let text = answer.text(WIDE);
    assert!(text.contains("\\u{1b} connection"), "{text}");
    let off = edge::shown(&board(vec![json!({ "state": "off" })]).client(true)).unwrap();
    assert_eq!(off.verdict(), Verdict::Well);
}

#[test]
fn settings_wait_for_the_next_start() {
    let server = board(vec![online()]);
    let answer = edge::set(&server.client(true), b"settings", edge::From::NextStart).unwrap();
    assert!(answer.text(WIDE).contains("with other settings"), "{}", answer.text(WIDE));
    assert!(!server.paths().contains(&"GET edge".to_owned()), "{:?}", server.paths());
}

#[test]
fn a_board_is_waited_for_until_it_has_started_and_knows_whether_it_is_online() {
    let before = json!({ "state": "off", "next": "other" });
    let trying = json!({ "state": "offline" });
    let server = board(vec![before, trying, online()]);
    let answer = edge::set(&server.client(true), b"settings", edge::From::Now).unwrap();
    assert!(answer.text(WIDE).contains("online"), "{}", answer.text(WIDE));
    let failed = json!({ "state": "offline", "why": "no connection" });
    let answer = edge::set(&board(vec![failed]).client(true), b"settings", edge::From::Now).unwrap();
    assert_eq!(answer.verdict(), Verdict::Trouble);
}
