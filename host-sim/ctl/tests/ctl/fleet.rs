//! Several gateways at once.

use std::sync::{Arc, Condvar, Mutex};
use std::time::Duration;

use recipe_ctl::{Member, Rollout, Stop, Verdict};
use serde_json::{Value, json};

use crate::server::*;

const PATIENT: Duration = Duration::from_secs(20);
/// Longer than sixteen connections take.
const LONG: Duration = Duration::from_millis(500);

/// The members of an inventory of these servers.
fn members(servers: &[&Server]) -> Vec<Member> {
    let folder = tempfile::tempdir().unwrap();
    key_file(&folder, "the.key");
    let text: String = servers
        .iter()
        .enumerate()
        .map(|(nth, server)| {
            format!("[[gateway]]\nname = \"cell-{nth}\"\naddress = \"{}\"\nkey = \"the.key\"\n", server.at)
        })
        .collect();
    let path = folder.path().join("cells.toml");
    std::fs::write(&path, text).unwrap();
    recipe_ctl::members(&path, &[]).unwrap()
}

fn status(health: &'static str) -> Server {
    Server::start(move |_| ok(&json!({ "health": health, "ports": {}, "links": {} })))
}

#[test]
fn each_has_a_row_and_who_fails_is_named() {
    let (well, ill) = (status("running"), status("port-silent"));
    let gone = Server::start(|_| Reply::Bytes(b"garbage".to_vec()));
    let all = members(&[&well, &gone, &ill]);
    let stop = Stop::new();
    let outcomes = recipe_ctl::ask(&all, None, PATIENT, &stop, &|client| recipe_ctl::status(client, WIDE));
    let table = outcomes.table(WIDE);
    let lines: Vec<_> = table.lines().collect();
    assert!(lines[0].starts_with("gateway  health"), "{table}");
    assert!(lines[1].starts_with("cell-0") && lines[1].contains("running"), "{table}");
    assert!(lines[2].contains("the answer is not one of HTTP/1.1"), "{table}");
    assert!(lines[3].contains("port-silent"), "{table}");
    let error = outcomes.verdict().unwrap_err();
    assert_eq!(error.message(), "1 of 3 gateways failed: cell-1");
    let document: Value = serde_json::from_str(&outcomes.json()).unwrap();
    assert_eq!(document["cell-0"]["answer"]["health"], "running");
    assert_eq!(document["cell-1"]["ok"], false);
    let ask = |servers: &[&Server]| {
        let all = members(servers);
        recipe_ctl::ask(&all, None, PATIENT, &stop, &|client| recipe_ctl::status(client, WIDE)).verdict()
    };
    assert_eq!(ask(&[&well, &ill]), Ok(Verdict::Trouble));
    assert_eq!(ask(&[&well, &well]), Ok(Verdict::Well));
}

#[test]
fn sixteen_are_asked_side_by_side_and_not_one_more() {
    let crowd = Arc::<(Mutex<(usize, usize)>, Condvar)>::default();
    let server = {
        let crowd = Arc::clone(&crowd);
        Server::start(move |_| {
            let (counts, changed) = &*crowd;
            let mut here = counts.lock().unwrap();
            here.0 += 1;
            here.1 = here.1.max(here.0);
            changed.notify_all();
            // Each waits for a seventeenth, who never comes.
            here = changed.wait_timeout_while(here, LONG, |here| here.0 <= 16).unwrap().0;
            here.0 -= 1;
            ok(&json!({ "health": "running" }))
        })
    };
    let all = members(&[&server; 32]);
    let outcomes =
        recipe_ctl::ask(&all, None, PATIENT, &Stop::new(), &|client| recipe_ctl::status(client, WIDE));
    assert_eq!(outcomes.verdict(), Ok(Verdict::Well));
    assert_eq!(crowd.0.lock().unwrap().1, 16);
}

#[test]
fn a_rollout_goes_in_batches_and_stops_at_a_failure() {
    let good = || {
        Server::start(|asked| match asked.path.as_str() {
            "nonce" => ok(&json!({ "nonce": "0".repeat(48) })),
            _ => ok(&json!({ "live": 1 })),
        })
    };
    let bad = Server::start(|asked| match asked.path.as_str() {
        "nonce" => ok(&json!({ "nonce": "0".repeat(48) })),
        _ => document(409, "", &json!({ "error": "no revision is on trial" })),
    });
    let servers = [good(), good(), good(), good()];
    let all = members(&[&servers[0], &bad, &servers[1], &servers[2], &servers[3]]);
    let rollout = Rollout { batch: 2, stop_on_failure: true };
    let outcomes = recipe_ctl::ask(&all, Some(rollout), PATIENT, &Stop::new(), &recipe_ctl::confirm);
    let error = outcomes.verdict().unwrap_err();
    assert_eq!(error.message(), "4 of 5 gateways failed: cell-1, cell-2, cell-3, cell-4");
    let asked: Vec<_> = servers.iter().map(|server| server.asked().len()).collect();
    assert_eq!(asked, [2, 0, 0, 0], "nothing is begun behind the batch that failed");
    assert_eq!(outcomes.table(WIDE).matches("not begun").count(), 3);
    let goes_on = Rollout { batch: 2, stop_on_failure: false };
    let outcomes = recipe_ctl::ask(&all, Some(goes_on), PATIENT, &Stop::new(), &recipe_ctl::confirm);
    assert_eq!(outcomes.verdict().unwrap_err().message(), "1 of 5 gateways failed: cell-1");
}

#[test]
fn an_inventory_names_what_is_wrong_with_it() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("cells.toml");
    let read = |text: &str, only: &[String]| {
        std::fs::write(&path, text).unwrap();
        recipe_ctl::members(&path, only)
            .map(|members| members.len())
            .map_err(|error| error.message().to_owned())
    };
    let two = "[[gateway]]\nname = \"a\"\naddress = \"10.0.0.1\"\n[[gateway]]\nname = \"b\"\naddress = \"10.0.0.2\"\n";
    assert_eq!(read(two, &[]), Ok(2));
    assert_eq!(read(two, &["b".into()]), Ok(1));
    let error = read(two, &["c".into()]).unwrap_err();
    assert!(
        error.starts_with("--only c: ") && error.ends_with("has no such gateway; it has a, b"),
        "{error}"
    );
    let error = read("[[gateway]]\nname = \"a\"\naddress = \"http://x\"\n", &[]).unwrap_err();
    assert!(
        error.contains("cells.toml:3:11: gateway.a.address: \"http://x\" is not an address but a link"),
        "{error}"
    );
    let error = read("[[gateway]]\nname = \"a\"\naddress = \"x\"\nkey = \"none.key\"\n", &[]).unwrap_err();
    assert!(error.contains("the key ") && error.contains("none.key: No such file"), "{error}");
}

#[test]
fn a_gateway_behind_a_forwarded_port_is_asked_by_the_address_it_knows() {
    let server = Server::start(|asked| match asked.field("Host") {
        Some("10.0.2.15") => ok(&json!({ "health": "running" })),
        _ => document(421, "", &json!({ "error": "this server is not that host" })),
    });
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("cells.toml");
    let ask = |more: &str| {
        let text = format!("[[gateway]]\nname = \"board\"\naddress = \"{}\"\n{more}", server.at);
        std::fs::write(&path, text).unwrap();
        let all = recipe_ctl::members(&path, &[]).unwrap();
        recipe_ctl::ask(&all, None, PATIENT, &Stop::new(), &|client| recipe_ctl::status(client, WIDE))
    };
    assert_eq!(ask("host = \"10.0.2.15\"\n").verdict(), Ok(Verdict::Well));
    let table = ask("").table(WIDE);
    assert!(table.contains("give its own address with --host, or as `host` in the inventory"), "{table}");
}
