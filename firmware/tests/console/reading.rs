//! The endpoints that read.

use crate::board::{QemuBoard, panel};

#[test]
#[ignore = "needs QEMU and the firmware"]
fn each_document_is_whole_and_what_the_host_shows() {
    let board = QemuBoard::claimed(&panel(500));
    let info = board.client.get("info").must_be(200).json();
    assert_eq!(info["places"]["ports"]["device"], "rs485");
    assert_eq!((&info["has"]["rs485"], &info["has"]["can"]), (&2.into(), &1.into()));
    assert_eq!((&info["revision"], &info["can_be_changed"]), (&1.into(), &true.into()));
    let status = board.client.get("status").must_be(200).json();
    assert_eq!(status["ports"]["device"]["bus"], "rs485");
    assert!(status["links"]["modbus"]["state"].is_string() && status["latency"]["handed_over"].is_object());
    assert!(board.client.get("values").must_be(200).json()["values"].is_object());
    let metrics = board.client.get("metrics").must_be(200);
    assert!(metrics.field("Content-Type").unwrap().starts_with("application/openmetrics-text"));
    assert!(metrics.text().ends_with("# EOF\n") && metrics.text().contains("rgw_port_frames_in_total"));
    let log = board.client.get("log").must_be(200);
    assert_eq!(log.field("Content-Type"), Some("text/plain; charset=utf-8"));
    assert!(log.text().lines().next().unwrap().contains("recipe gateway"), "{}", log.text());
    let last = board.client.get("log?lines=2").must_be(200);
    assert_eq!(last.text().lines().count(), 2);
    for wrong in ["0", "257", "x", ""] {
        board.client.get(&format!("log?lines={wrong}")).must_be(400);
    }
    for missing in ["schema", "export/dbc", "doctor", "bundle", "check", "capture.pcapng", "pendant"] {
        board.client.get(missing).must_be(404);
    }
    let head = board.client.signed("HEAD /api/v1/info", "", b"");
    assert!(head.status == 200 && head.body.is_empty());
    board.client.signed("DELETE /api/v1/info", "", b"").must_be(405);
}

#[test]
#[ignore = "needs QEMU and the firmware"]
fn the_configuration_comes_back_as_it_was_put_there() {
    let board = QemuBoard::claimed(&panel(500));
    let revisions = board.revisions();
    assert_eq!((&revisions["running"], &revisions["live"]), (&1.into(), &1.into()));
    assert_eq!(revisions["kept"].as_array().unwrap().len(), 1);
    let config = board.client.get("config").must_be(200);
    assert_eq!(config.body, std::fs::read(board.folder.path().join("first.img")).unwrap());
    let etag = config.field("ETag").unwrap();
    assert_eq!(revisions["base"], etag);
    assert_eq!(config.field("Content-Type"), Some("application/octet-stream"));
    board.client.signed("GET /api/v1/config", &format!("If-None-Match: {etag}"), b"").must_be(304);
    assert_eq!(board.client.get("config?revision=1").must_be(200).body, config.body);
    board.client.get("config?revision=2").must_be(404);
    board.client.get("config?revision=x").must_be(400);
}

#[test]
#[ignore = "needs QEMU and the firmware"]
fn identify_is_shown_by_the_led_and_the_log() {
    let board = QemuBoard::claimed(&panel(500));
    board.client.post("identify", "{\"s\": 3}").must_be(200);
    board.until_log("looks for this board: its LED shows it for 3 s");
    for wrong in ["{\"s\": 0}", "{\"s\": 601}", "{\"seconds\": 1}", "[]"] {
        board.client.post("identify", wrong).must_be(400);
    }
}
