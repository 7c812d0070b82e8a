//! The simulated controller as a program: its counters, its events, and the commands that act on it.

use std::collections::BTreeSet;
use std::path::Path;

use rustix::process::Signal;
use serde_json::Value;

use super::BINARY;
use recipe_test_kit::{HostSim, example, repository};

/// Every key of an object and of what is in it, but for names from the file and of variables.
fn keys(value: &Value, into: &mut BTreeSet<String>) {
    let Some(object) = value.as_object() else { return };
    for (key, value) in object {
        into.insert(key.clone());
        match (key.as_str(), value.as_object()) {
            ("registers" | "variables", _) => {}
            ("ports", Some(ports)) => ports.values().for_each(|port| keys(port, into)),
            _ => keys(value, into),
        }
    }
}

/// The words that a page shows as code.
fn documented(page: &Path) -> BTreeSet<String> {
    let text = std::fs::read_to_string(page).unwrap();
    let code = text.split('`').skip(1).step_by(2);
    let words = code.flat_map(|code| code.split(|c: char| !c.is_alphanumeric() && c != '_'));
    words.map(str::to_owned).collect()
}

#[test]
fn every_counter_of_the_controller_is_documented() {
    let folder = tempfile::tempdir().unwrap();
    let documented = documented(&repository().join("docs/devices.md"));
    for (file, device) in [
        ("rs485-system-controller.toml", "rs485=pty"),
        ("can-system-controller.toml", "can=slcan-pty"),
        ("udp-server-controller.toml", ""),
        ("client-controller.toml", ""),
    ] {
        let bind = format!("--bind={device}:{}", folder.path().join("line").display());
        let bind: &[&str] = if device.is_empty() { &[] } else { &[&bind] };
        let robot = BINARY.controller(&example(file), bind);
        let mut found = BTreeSet::new();
        keys(&robot.fresh(), &mut found);
        assert!(found.len() > 50, "{found:?}");
        let missing: Vec<_> = found.difference(&documented).collect();
        assert!(missing.is_empty(), "{file}: docs/devices.md section 4 does not name {missing:?}");
        robot.end();
    }
}

#[test]
fn the_events_file_holds_every_event_and_the_log_tells_them_in_words() {
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("events.jsonl");
    let events = format!("--events={}", file.display());
    let robot = BINARY.controller(&example("udp-server-controller.toml"), &[&events, "-v"]);
    robot.command("speed(50)", "set success");
    robot.command("state", "6:0:5:2");
    robot.ended_by(Signal::TERM);
    let text = std::fs::read_to_string(&file).unwrap();
    let events: Vec<Value> = text.lines().map(|line| serde_json::from_str(line).unwrap()).collect();
    assert!(events.iter().zip(1..).all(|(event, nth)| event["n"] == nth), "{text}");
    let kinds: BTreeSet<_> = events.iter().map(|event| event["event"].as_str().unwrap()).collect();
    for kind in ["started", "connected", "command", "reply", "speed"] {
        assert!(kinds.contains(kind), "{kind}: {text}");
    }
    // The next run replaces it; a wrong file stays and nothing is started.
    let robot = BINARY
        .controller(&example("udp-server-controller.toml"), &[&format!("--events={}", file.display()), "-v"]);
    robot.command("speed(50)", "set success");
    let said = recipe_test_kit::until("the words", || robot.log("speed: 100 % -> 50 %").pop());
    assert!(said.contains("INFO controller:") && said.contains("time_s="), "{said}");
    robot.end();
    assert!(std::fs::read_to_string(&file).unwrap().len() < text.len());
}

#[test]
fn a_ready_file_of_a_killed_run_is_gone_even_if_the_next_one_cannot_start() {
    let folder = tempfile::tempdir().unwrap();
    let ready = folder.path().join("ready.json");
    let controller = |extra: &[&str]| {
        let mut command = BINARY.run("controller", &example("udp-server-controller.toml"));
        command.args(recipe_test_kit::free_servers()).arg("--ready").arg(&ready).args(extra);
        command
    };
    for wrong in [["--set=listen.command=x"], ["--bind=wrong=pty:x"]] {
        let mut first = HostSim::start(&mut controller(&[]));
        first.kill();
        assert!(ready.exists());
        let output = controller(&wrong).output().unwrap();
        assert_eq!(output.status.code(), Some(2), "{wrong:?}");
        assert!(!ready.exists(), "{wrong:?}");
    }
}
