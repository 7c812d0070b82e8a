//! The simulated controller's console.

use serde_json::json;

use crate::kit::*;

#[test]
fn the_pendant_does_what_the_control_socket_does() {
    let folder = tempfile::tempdir().unwrap();
    let key = write_key(&folder).display().to_string();
    let file = folder.path().join("robot.toml");
    std::fs::write(&file, ROBOT).unwrap();
    let robot = BINARY.controller(&file, &["--console", "127.0.0.1:0", "--console-key", &key]);
    let console = robot.at("console");
    assert_eq!(get(console, "info").must_be(200).json()["role"], "controller");
    assert_eq!(get(console, "status").must_be(200).json()["mode"], robot.fresh()["mode"]);
    let set = r#"{"id": 7, "do": "set", "items": {"DI[3]": 1}}"#;
    let fields = "Content-Type: application/json";
    request(console, "POST /api/v1/pendant", fields, set).must_be(401);
    let done = post(console, "pendant", set).must_be(200).json();
    assert_eq!((&done["id"], &done["ok"]), (&json!(7), &json!(true)));
    let read = post(console, "pendant", r#"{"do": "get", "items": ["DI[3]"]}"#).must_be(200).json();
    assert_eq!(read["result"], json!({ "DI[3]": 1 }));
    let wrong = post(console, "pendant", r#"{"do": "estp"}"#).must_be(422).json();
    assert!(wrong["error"].as_str().unwrap().contains("unknown variant `estp`"), "{wrong}");
    post(console, "pendant", r#"{"do": "follow"}"#).must_be(400);
    post(console, "pendant", "[]").must_be(400);
    // What only a gateway has.
    for path in
        ["values", "config", "revisions", "metrics", "schema", "export/lua", "doctor", "capture.pcapng"]
    {
        get(console, path).must_be(404);
    }
    post(console, "apply", "").must_be(404);
    post(console, "identify", "").must_be(404);
    get(console, "stream?frames=1").must_be(400);
    let bundle = get(console, "bundle").must_be(200).json();
    assert_eq!(bundle["info"]["role"], "controller");
    assert_eq!(bundle["status"]["mode"], robot.fresh()["mode"]);
    let names: Vec<_> = bundle.as_object().unwrap().keys().collect();
    assert_eq!(names, ["info", "log", "status"]);
    assert!(!get(console, "log").must_be(200).body.contains("ERROR"));
    robot.end();
}

#[test]
fn a_gateway_has_no_pendant() {
    let cell = Cell::new();
    post(cell.console, "pendant", r#"{"do": "state"}"#).must_be(404);
}
