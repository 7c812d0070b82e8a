//! Another configuration: stored, tried, confirmed, taken back, and there after a restart.

use std::io::Write;

use recipe_test_kit::until;
use serde_json::json;

use crate::kit::*;

#[test]
fn a_stored_configuration_runs_once_it_is_applied_and_stays_once_it_is_confirmed() {
    let mut cell = Cell::new();
    let stored = put(cell.console, &cell.base(), &config(400)).must_be(201);
    assert_eq!(stored.json()["waiting"], 2);
    assert_eq!(get(cell.console, "config").body, config(500), "it only waits");
    let applied = post(cell.console, "apply", r#"{"confirm_s": 60}"#).must_be(200).json();
    assert_eq!((&applied["running"], &applied["live"]), (&json!(2), &json!(1)));
    assert!(applied["trial"]["left_s"].as_f64().unwrap() > 30.0);
    assert_eq!(get(cell.console, "config").body, config(400));
    put(cell.console, &cell.base(), &config(300)).must_be(409);
    post(cell.console, "apply", "").must_be(409);
    let confirmed = post(cell.console, "confirm", "{}").must_be(200).json();
    assert_eq!((&confirmed["live"], &confirmed["previous"]), (&json!(2), &json!(1)));
    assert_eq!(confirmed.get("trial"), None);
    post(cell.console, "confirm", "").must_be(409);
    cell.restart();
    assert_eq!(get(cell.console, "config").body, config(400), "the live one, not that of the file");
    assert_eq!(post(cell.console, "rollback", "").must_be(200).json()["live"], 1);
    assert_eq!(get(cell.console, "config").body, config(500));
    // A person edits the file.
    std::fs::write(cell.folder.path().join("cell.toml"), config(250)).unwrap();
    cell.restart();
    assert_eq!(get(cell.console, "config").body, config(250));
    assert_eq!(cell.revisions()["kept"].as_array().unwrap().len(), 3);
}

#[test]
fn what_nobody_confirms_is_taken_back_and_not_there_after_a_restart() {
    let mut cell = Cell::new();
    put(cell.console, &cell.base(), &config(400)).must_be(201);
    post(cell.console, "apply", r#"{"confirm_s": 1}"#).must_be(200);
    let back = cell.until_revisions("taken back", |revisions| revisions["running"] == 1);
    assert_eq!(back["last"], json!({ "revision": 2, "ended": "not-confirmed" }));
    until("it is in the log", || {
        (cell.gateway.log("nobody confirmed the revision in time").len() == 1).then_some(())
    });
    // On trial while the process is killed.
    post(cell.console, "apply", r#"{"revision": 2, "confirm_s": 600}"#).must_be(200);
    assert_eq!(cell.revisions()["running"], 2);
    cell.restart();
    assert_eq!(get(cell.console, "config").body, config(500));
    post(cell.console, "apply", r#"{"revision": 2}"#).must_be(200);
    let back = post(cell.console, "rollback", "").must_be(200).json();
    assert_eq!((&back["running"], &back["last"]["ended"]), (&json!(1), &json!("taken-back")));
}

#[test]
fn safe_values_go_out_before_the_gateway_is_replaced() {
    let cell = Cell::new();
    // The panel would be overdue only after an hour.
    put(cell.console, &cell.base(), &config(3_600_000)).must_be(201);
    post(cell.console, "apply", "").must_be(200);
    post(cell.console, "confirm", "").must_be(200);
    cell.switch(&mut cell.panel(), 5);
    put(cell.console, &cell.base(), &config(500)).must_be(201);
    post(cell.console, "apply", "").must_be(200);
    cell.outputs_are(128);
    // The next gateway has the panel, and another one is not there any more.
    cell.switch(&mut cell.panel(), 6);
    assert!(cell.gateway.log("does not show all safe values").is_empty());
}

#[test]
fn what_cannot_run_is_refused_with_its_place_and_what_does_not_start_is_taken_back() {
    let cell = Cell::new();
    let wrong = put(cell.console, &cell.base(), &config(400).replace("rs485", "rs486")).must_be(422).json();
    assert_eq!(wrong["key"], "port.device.bus");
    assert!(wrong["line"].as_u64().is_some() && wrong["column"].as_u64().is_some(), "{wrong}");
    put(cell.console, &cell.base(), "\"").must_be(422);
    // It is right, but its port has no device.
    let other = config(400).replace("name = \"device\"", "name = \"other\"");
    put(cell.console, &cell.base(), &other).must_be(201);
    let failed = post(cell.console, "apply", "").must_be(409).json();
    assert!(
        failed["error"]
            .as_str()
            .unwrap()
            .contains("revision 2 does not start: port other needs exactly one device"),
        "{failed}"
    );
    assert_eq!((&failed["running"], &failed["last"]["ended"]), (&json!(1), &json!("failed")));
    assert_eq!(get(cell.console, "config").body, config(500));
}

#[test]
fn what_does_not_start_is_found_before_anything_is_stopped() {
    let mut cell = Cell::new();
    // Another name than the option below knows.
    let other = config(400).replace("name = \"device\"", "name = \"other\"");
    put(cell.console, &cell.base(), &other).must_be(201);
    cell.restart_with(&["--set", "port.device.timeout_ms=450"]);
    let mut panel = cell.panel();
    cell.switch(&mut panel, 5);
    let place = get(cell.console, "info").json()["places"]["ports"]["device"].clone();
    let failed = post(cell.console, "apply", r#"{"revision": 2}"#).must_be(409).json();
    assert!(
        failed["error"].as_str().unwrap().contains("revision 2 does not start: revision 2: "),
        "{failed}"
    );
    assert_eq!((&failed["running"], &failed["last"]["ended"]), (&json!(1), &json!("failed")));
    // The panel is still connected, and its outputs are what they were.
    assert_eq!(get(cell.console, "info").json()["places"]["ports"]["device"], place);
    cell.outputs_are(5);
    panel.write_all(&frame(6)).unwrap();
    cell.outputs_are(6);
}

#[test]
fn a_device_may_be_bound_before_its_port_is_there() {
    let mut cell = Cell::new();
    cell.restart_with(&["--bind=later=tcp-listen:127.0.0.1:0"]);
    let ports = |cell: &Cell| get(cell.console, "info").must_be(200).json()["places"]["ports"].clone();
    assert!(ports(&cell).get("later").is_none());
    assert!(get(cell.console, "log").must_be(200).body.contains("--bind is not used"));
    let more = config(500)
        + "[[recipe]]\nname = \"lamp\"\nkind = \"stream\"\nmode = \"user\"\n[recipe.output]\nhead = [1]\n\
           fields = [{ name = \"lamp\", type = \"byte\", value = 1 }]\n\
           [[port]]\nname = \"later\"\nbus = \"rs485\"\nrecipe = \"lamp\"\n";
    put(cell.console, &cell.base(), &more).must_be(201);
    post(cell.console, "apply", "").must_be(200);
    let place = ports(&cell)["later"].as_str().unwrap().parse::<std::net::SocketAddr>().unwrap();
    let mut device = std::net::TcpStream::connect(place).unwrap();
    let mut frame = [0; 2];
    std::io::Read::read_exact(&mut device, &mut frame).unwrap();
    assert_eq!(frame, [1, 1]);
}

#[test]
fn two_people_do_not_overwrite_each_other() {
    let cell = Cell::new();
    let base = cell.base();
    let fields = format!("Authorization: Bearer {KEY}\nContent-Type: application/toml");
    request(cell.console, "PUT /api/v1/config", &fields, &config(400)).must_be(428);
    for wrong in ["*", "1", "\"1\"", "\"1-00000000\"", "W/\"1\"", "\"01-c028d264\""] {
        put(cell.console, wrong, &config(400)).must_be(412);
    }
    put(cell.console, &base, &config(400)).must_be(201);
    let late = put(cell.console, &base, &config(300)).must_be(412);
    assert_eq!(late.field("ETag"), Some(cell.base().as_str()));
    put(cell.console, &cell.base(), &config(300)).must_be(201);
    let log = until("both are in the log", || {
        let log = cell.gateway.log("done for a client of the console");
        (log.len() == 2).then_some(log)
    });
    assert!(log.iter().all(|line| line.contains("peer=127.0.0.1")), "{log:?}");
    assert!(log[1].contains("revision=3"), "{log:?}");
}

#[test]
fn arguments_have_limits() {
    let cell = Cell::new();
    put(cell.console, &cell.base(), &config(400)).must_be(201);
    for wrong in [
        r#"{"confirm_s": 0}"#,
        r#"{"confirm_s": -1}"#,
        r#"{"confirm_s": 3601}"#,
        r#"{"confirm_s": 1e300}"#,
        r#"{"confirm": 1}"#,
        r#"{"confirm_s": "1"}"#,
        "[]",
        "{",
    ] {
        post(cell.console, "apply", wrong).must_be(400);
    }
    post(cell.console, "apply", r#"{"revision": 9}"#).must_be(404);
    post(cell.console, "apply", r#"{"revision": 1}"#).must_be(409);
    post(cell.console, "confirm", r#"{"revision": 1}"#).must_be(400);
    post(cell.console, "rollback", "").must_be(409);
    assert_eq!(cell.revisions()["running"], 1);
}
