//! Many nodes in one process.

use recipe_test_kit::Process;

use crate::broker::{Plant, Way};
use crate::cell::BINARY;
use crate::reader::Reader;

#[test]
#[ignore = "needs mosquitto"]
fn every_message_of_many_nodes_is_right_also_after_a_restart_of_the_broker() {
    let plant = Plant::new(Way::Plain);
    let mut broker = plant.broker();
    let mut reader = Reader::new(&plant);
    let mut command = BINARY.command();
    command.args(["fleet", "--gateways", "40", "--time", "14s", "--period", "250ms", "--group", "fleet"]);
    command.arg(format!("--broker=127.0.0.1:{}", plant.port()));
    command.arg(format!("--login={}", plant.path("scada.login").display()));
    let mut fleet = Process::start(&mut command);
    reader.next(0, "data of the last node", |told| told.node == "node-40" && told.verb == "DDATA");
    broker.kill();
    let _broker = plant.broker();
    let mut reader = Reader::late(&plant);
    let status = fleet.ended();
    let lines = fleet.lines().join("\n");
    assert!(status.success(), "{lines}");
    assert!(lines.contains("40 online") && lines.contains("in all: "), "{lines}");
    reader.read();
    assert!(reader.told.iter().any(|told| told.verb == "DDATA"), "some were born later than the reader");
}
