//! What each endpoint that reads answers.

use std::io::Write;

use serde_json::json;

use crate::kit::*;
use crate::live::follow;

#[test]
fn info_says_who_and_where() {
    let cell = Cell::new();
    let info = get(cell.console, "info").must_be(200).json();
    assert_eq!(info["role"], "gateway");
    assert_eq!(info["version"], env!("CARGO_PKG_VERSION"));
    assert_eq!((&info["can_be_changed"], &info["revision"]), (&json!(true), &json!(1)));
    assert_eq!(info["places"]["ports"], cell.gateway.ready["ports"]);
    assert!(!info.to_string().contains(KEY));
}

#[test]
fn status_and_values_are_those_of_the_statistics() {
    let cell = Cell::new();
    let mut panel = cell.panel();
    panel.write_all(&frame(5)).unwrap();
    cell.outputs_are(5);
    let stats = cell.gateway.fresh();
    let status = get(cell.console, "status").must_be(200).json();
    for (name, link) in stats["links"].as_object().unwrap() {
        assert_eq!(status["links"][name]["state"], link["state"], "{name}");
        assert_eq!(status["links"][name]["history"]["connects"], link["connects"], "{name}");
    }
    let port = &status["ports"]["device"];
    assert_eq!((&port["counters"]["frames_in"], &port["bus"]), (&json!(1), &json!("rs485")));
    assert_eq!(status["devices"]["device"]["bytes_in"], 6);
    let values = get(cell.console, "values").must_be(200).json();
    let outputs = &values["values"]["DigitalOutputCommand[1]"];
    assert_eq!((&outputs["value"], &outputs["owner"]), (&json!(5), &json!("device")));
    assert_eq!(status.get("values"), None);
}

#[test]
fn a_head_is_that_of_the_document_without_it() {
    let cell = Cell::new();
    let whole = get(cell.console, "config").must_be(200);
    let head = request(cell.console, "HEAD /api/v1/config", "", "").must_be(200);
    assert_eq!((head.head, head.body), (whole.head.clone(), String::new()));
    assert_eq!(whole.body, config(500));
    // Nothing but the text has changed since.
    let etag = whole.field("ETag").unwrap();
    let fields = format!("If-None-Match: {etag}");
    assert_eq!(request(cell.console, "GET /api/v1/config", &fields, "").must_be(304).body, "");
    assert_eq!(get(cell.console, "config?revision=1").must_be(200).body, config(500));
    get(cell.console, "config?revision=2").must_be(404);
    get(cell.console, "config?revision=x").must_be(400);
}

#[test]
fn metrics_are_for_prometheus() {
    let cell = Cell::new();
    let metrics = get(cell.console, "metrics").must_be(200);
    let kind = "application/openmetrics-text; version=1.0.0; charset=utf-8";
    assert_eq!(metrics.field("Content-Type"), Some(kind));
    assert!(metrics.body.contains("rgw_link_up{link=\"modbus\"} 1\n"), "{}", metrics.body);
    assert!(metrics.body.ends_with("# EOF\n"));
}

#[test]
fn a_check_names_the_place_of_a_mistake_and_stores_nothing() {
    let cell = Cell::new();
    let check = |text: &str| {
        request(cell.console, "POST /api/v1/check", "Content-Type: application/toml", text)
            .must_be(200)
            .json()
    };
    assert_eq!(check(&config(100))["ok"], true);
    assert_eq!(check(ROBOT)["kind"], "controller");
    let wrong = check(&config(100).replace("timeout_ms = 100", "timeout_ms = \"soon\""));
    assert_eq!((&wrong["ok"], &wrong["key"]), (&json!(false), &json!("port.device.timeout_ms")));
    let line = config(100).lines().position(|line| line.starts_with("timeout_ms")).unwrap() + 1;
    assert_eq!((&wrong["line"], &wrong["column"]), (&json!(line), &json!(14)), "{wrong}");
    assert_eq!(cell.revisions()["kept"].as_array().unwrap().len(), 1);
}

#[test]
fn a_check_makes_the_image_for_a_board_on_request() {
    let cell = Cell::new();
    let image = |query: &str, text: &str| {
        let line = format!("POST /api/v1/check?image={query}");
        request(cell.console, &line, "Content-Type: application/toml", text)
    };
    let made = image("1", &config(100)).must_be(200);
    assert_eq!(made.field("Content-Type"), Some("application/octet-stream"));
    assert!(made.body.starts_with("RGCI"), "{made:?}");
    let wrong = image("1", &config(100).replace("timeout_ms = 100", "timeout_ms = \"soon\"")).must_be(422);
    assert_eq!(wrong.json()["key"], "port.device.timeout_ms");
    // A board runs no controller.
    image("1", ROBOT).must_be(422);
    assert!(image("2", &config(100)).must_be(400).body.contains("allowed: 1"));
}

#[test]
fn info_names_the_other_console_of_the_machine() {
    let mut cell = Cell::new();
    assert_eq!(get(cell.console, "info").must_be(200).json().get("peer_port"), None);
    cell.restart_with(&["--console-peer=8481"]);
    assert_eq!(get(cell.console, "info").must_be(200).json()["peer_port"], 8481);
}

#[test]
fn a_stream_shows_what_happens() {
    let cell = Cell::new();
    let mut panel = cell.panel();
    let (mut sent, mut statuses) = (false, 0);
    follow(&cell, "", |event, data| match event {
        "status" => {
            statuses += 1;
            if !std::mem::replace(&mut sent, true) {
                assert_eq!(data["ports"]["device"]["counters"]["frames_in"], 0);
                panel.write_all(&frame(9)).unwrap();
            }
            false
        }
        "values" => data["values"]["DigitalOutputCommand[1]"]["value"] == 9,
        _ => false,
    });
    assert!(statuses >= 2);
    // It also goes on while the gateway is replaced.
    put(cell.console, &cell.base(), &config(400)).must_be(201);
    let mut is_applied = false;
    follow(&cell, "", |event, data| {
        if !std::mem::replace(&mut is_applied, true) {
            post(cell.console, "apply", "").must_be(200);
        }
        event == "status" && data["ports"]["device"]["counters"]["frames_in"] == 0
    });
}
