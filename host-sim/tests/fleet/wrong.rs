//! What is wrong between a gateway and its broker is said, and the gateway runs all the same.

use std::path::Path;

use recipe_test_kit::until;

use crate::broker::{Plant, Way};
use crate::cell::{BINARY, Cell, TLS};

/// The log says so, and the gateway runs.
#[track_caller]
fn is_said(cell: &Cell, file: &Path, words: &str) {
    let mut gateway = cell.gateway(file);
    until(words, || gateway.errors().iter().any(|line| line.contains(words)).then_some(()));
    gateway.fresh();
    gateway.must_run();
}

#[test]
#[ignore = "needs mosquitto"]
fn what_is_wrong_with_the_broker_is_logged() {
    let plant = Plant::new(Way::Tls);
    let cell = Cell::new();
    is_said(&cell, &plant.sparkplug(TLS, "", ""), "Connection refused");
    let _broker = plant.broker();
    let other = TLS.replace("ca.pem", "other.pem");
    is_said(&cell, &plant.sparkplug(&other, "", ""), "invalid peer certificate: UnknownIssuer");
    is_said(&cell, &plant.sparkplug("ca = \"ca.pem\"", "", ""), "the broker does not allow this client");
    plant.write("press.login", "press\nwrong\n");
    is_said(&cell, &plant.sparkplug(TLS, "", ""), "the broker does not allow this client");
    // To a port with TLS, without.
    is_said(&cell, &plant.sparkplug("plain = true", "", ""), "no session with the broker");
}

#[test]
fn a_file_with_a_mistake_is_one_message_and_nothing_runs() {
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("sparkplug.toml");
    std::fs::write(&file, "[broker]\naddress = \"b\"\nplain = true\n[node]\ngroup = \"a+b\"\nname = \"c\"\n")
        .unwrap();
    let cell = recipe_test_kit::example("rs485-system.toml");
    let output =
        BINARY.command().args(["gateway", "-c"]).arg(cell).arg("--sparkplug").arg(&file).output().unwrap();
    assert_eq!(output.status.code(), Some(2));
    let message = String::from_utf8(output.stderr).unwrap();
    assert_eq!(message, format!("{}:5:9: node.group: \"a+b\": '+' is not allowed in it\n", file.display()));
}
