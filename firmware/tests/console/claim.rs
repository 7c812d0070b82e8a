//! A board without a key, and how it gets one.

use recipe_api::key::Key;

use crate::board::{KEY, QemuBoard, panel};

const JSON: &str = "Content-Type: application/json";

#[test]
#[ignore = "needs QEMU and the firmware"]
fn a_board_takes_a_key_once_and_only_after_a_press_of_its_button() {
    let mut board = QemuBoard::new(&panel(500));
    let info = board.client.request("GET /api/v1/info", "", b"").must_be(200).json();
    assert_eq!((&info["role"], &info["name"]), (&"board".into(), &"rgw-123456".into()));
    assert_eq!((&info["claimed"], &info["claim_left_s"]), (&false.into(), &serde_json::Value::Null));
    for path in ["status", "values", "metrics", "config", "revisions", "log", "stream"] {
        let refused = board.client.request(&format!("GET /api/v1/{path}"), "", b"").must_be(403);
        assert!(refused.text().contains("press its button"), "{}", refused.text());
    }
    let claim = |key: &str| {
        let body = format!("{{\"key\": \"{key}\"}}");
        board.client.request("POST /api/v1/claim", JSON, body.as_bytes())
    };
    assert!(claim(KEY).must_be(403).text().contains("press the button"));
    board.press();
    let info = board.client.request("GET /api/v1/info", "", b"").must_be(200).json();
    assert!((1..=60).contains(&info["claim_left_s"].as_u64().unwrap()), "{info}");
    for wrong in ["", "1234", &"0".repeat(32), &KEY[1..]] {
        claim(wrong).must_be(400);
    }
    // A page of another site cannot claim it.
    let body = format!("{{\"key\": \"{KEY}\"}}");
    let fields = format!("{JSON}\nOrigin: http://evil.test");
    board.client.request("POST /api/v1/claim", &fields, body.as_bytes()).must_be(403);
    claim(KEY).must_be(200);
    claim(KEY).must_be(403);
    // From now on all but a nonce needs the key.
    let refused = board.client.request("GET /api/v1/info", "", b"").must_be(401);
    assert!(refused.field("WWW-Authenticate").unwrap().contains("nonce="));
    board.client.key = Key::parse(KEY);
    assert_eq!(board.client.get("info").must_be(200).json()["claimed"], true);
    let printed = board.log() + board.client.get("log").must_be(200).text();
    assert!(!printed.contains(KEY), "a key is in the log");
    board.power_cycle();
    assert_eq!(board.client.get("info").must_be(200).json()["claimed"], true);
    board.until_log("configuration 1 of the store, the live one");
}
