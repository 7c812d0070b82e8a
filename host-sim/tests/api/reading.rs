//! Documents that are made when somebody asks for them.

use std::io::Write;
use std::path::Path;

use recipe_test_kit::until;
use serde_json::{Value, json};

use crate::kit::*;

/// What a command prints.
#[track_caller]
fn printed(arguments: &[&str], file: Option<&Path>) -> String {
    let output = BINARY.command().args(arguments).args(file).output().unwrap();
    assert_eq!(output.status.code(), Some(0), "{}", String::from_utf8_lossy(&output.stderr));
    String::from_utf8(output.stdout).unwrap()
}

#[test]
fn exports_are_those_of_the_command() {
    let cell = Cell::new();
    let file = cell.folder.path().join("cell.toml");
    for (path, command) in [("lua", "lua"), ("md", "map")] {
        let shown = get(cell.console, &format!("export/{path}")).must_be(200);
        assert_eq!(shown.field("Content-Type"), Some("text/plain; charset=utf-8"));
        assert_eq!(shown.body, printed(&["export", command], Some(&file)), "{path}");
    }
    let none = get(cell.console, "export/dbc").must_be(404).json();
    assert!(none["error"].as_str().unwrap().contains("no CAN port"), "{none}");
    let schema: Value = serde_json::from_str(&printed(&["export", "schema"], None)).unwrap();
    assert_eq!(get(cell.console, "schema").must_be(200).json(), schema);
    // Of what runs, not of the file.
    put(cell.console, &cell.base(), &config(500).replace("\"outputs\"", "\"lamps\"")).must_be(201);
    assert!(get(cell.console, "export/lua").body.contains("outputs"));
    post(cell.console, "apply", "").must_be(200);
    let shown = get(cell.console, "export/lua").body;
    assert!(shown.contains("lamps") && !shown.contains("outputs"), "{shown}");
    for wrong in
        ["schema?x=1", "export/lua?port=device", "export/dbc?port=a&port=b", "bundle?log=1", "doctor?"]
    {
        let status = if wrong == "doctor?" { 200 } else { 400 };
        get(cell.console, wrong).must_be(status);
    }
}

#[test]
fn the_doctor_says_what_is_wrong_and_when_it_is_over() {
    let cell = Cell::new();
    let findings = || get(cell.console, "doctor").must_be(200).json()["findings"].as_array().unwrap().clone();
    let causes = |findings: &[Value]| -> Vec<String> {
        findings.iter().map(|finding| finding["cause"].as_str().unwrap().to_owned()).collect()
    };
    let mut panel = cell.panel();
    // Bytes, and no head in them.
    let found = until("no head", || {
        panel.write_all(&[7; 60]).unwrap();
        let found = findings();
        causes(&found).iter().any(|cause| cause == "no_head").then_some(found)
    });
    let finding = found.iter().find(|finding| finding["cause"] == "no_head").unwrap();
    assert_eq!((&finding["place"], &finding["name"]), (&json!("port"), &json!("device")));
    assert!(finding["expected"].as_str().unwrap().contains("FF FF"), "{finding}");
    until("it is over", || {
        panel.write_all(&frame(1)).unwrap();
        std::thread::yield_now();
        findings().is_empty().then_some(())
    });
}

#[test]
fn the_log_is_there_and_somebody_who_looks_for_a_gateway_finds_it_in_it() {
    let cell = Cell::new();
    request(cell.console, "POST /api/v1/identify", "Content-Type: application/json", "").must_be(401);
    assert_eq!(post(cell.console, "identify", r#"{"s": 10}"#).must_be(200).json(), json!({}));
    let log = until("it is in the log", || {
        let log = get(cell.console, "log?lines=1").must_be(200).body;
        log.contains("this is the gateway that somebody looks for").then_some(log)
    });
    assert!(log.lines().count() == 1 && log.contains("peer=127.0.0.1"), "{log}");
    for wrong in [r#"{"s": 0}"#, r#"{"s": 601}"#, r#"{"s": "1"}"#, r#"{"seconds": 1}"#, "[]"] {
        post(cell.console, "identify", wrong).must_be(400);
    }
    for wrong in ["log?lines=0", "log?lines=257", "log?lines=x", "log?lines=-1", "log?lines"] {
        get(cell.console, wrong).must_be(400);
    }
    // What stderr has, no more and no less.
    let mut cell = cell;
    for nth in 0..300 {
        post(cell.console, "identify", &format!("{{\"s\": {}}}", nth % 600 + 1)).must_be(200);
    }
    let all = until("all lines", || {
        let all = get(cell.console, "log").must_be(200).body;
        (all.lines().count() == 256).then_some(all)
    });
    cell.gateway.end_by(rustix::process::Signal::TERM);
    let said = cell.gateway.all_errors();
    assert!(said.contains(all.trim_end()), "{all}");
}

#[test]
fn a_bundle_has_everything_but_the_key() {
    let cell = Cell::new();
    let mut panel = cell.panel();
    cell.switch(&mut panel, 5);
    let bundle = get(cell.console, "bundle").must_be(200);
    assert!(!bundle.body.contains(KEY));
    let bundle = bundle.json();
    assert_eq!(bundle["config"], json!(config(500)));
    assert_eq!(bundle["info"]["role"], "gateway");
    assert_eq!(bundle["values"]["values"]["DigitalOutputCommand[1]"]["value"], 5);
    assert!(bundle["metrics"].as_str().unwrap().ends_with("# EOF\n"));
    assert_eq!(bundle["revisions"]["running"], 1);
    for (name, is_right) in [
        ("status", bundle["status"]["ports"]["device"].is_object()),
        ("doctor", bundle["doctor"].is_array()),
        ("log", bundle["log"].is_array()),
    ] {
        assert!(is_right, "{name}: {bundle}");
    }
}

#[test]
fn info_has_the_name_of_the_machine() {
    let cell = Cell::new();
    let name = std::fs::read_to_string("/proc/sys/kernel/hostname").unwrap();
    assert_eq!(get(cell.console, "info").json()["name"], json!(name.trim()));
}

#[test]
fn the_page_is_one_compressed_file_that_loads_nothing_else() {
    let cell = Cell::new();
    let page = request(cell.console, "GET /", "", "").must_be(200);
    assert_eq!(page.field("Content-Type"), Some("text/html; charset=utf-8"));
    assert_eq!(page.field("Content-Encoding"), Some("gzip"));
    let policy = page.field("Content-Security-Policy").unwrap();
    for part in ["default-src 'none'", "script-src 'sha256-", "connect-src 'self'", "frame-ancestors 'none'"]
    {
        assert!(policy.contains(part), "{policy}");
    }
    // A browser keeps it, and is not sent it again.
    assert_eq!(page.field("Cache-Control"), Some("no-cache"));
    let etag = page.field("ETag").unwrap();
    let held = request(cell.console, "GET /", &format!("If-None-Match: {etag}\r\n"), "").must_be(304);
    assert_eq!((held.field("ETag"), held.body.is_empty()), (Some(etag), true));
    request(cell.console, "GET /", "If-None-Match: \"0\"\r\n", "").must_be(200);
    request(cell.console, "POST /", "", "").must_be(405);
    request(cell.console, "GET /index.html", "", "").must_be(404);
}
