//! Buttons that gave no command, and nobody else says why.

use super::*;

/// A panel whose bits start and stop, and which sends only changes.
const PANEL: &str = "controller = { address = \"127.0.0.1\" }
    [[recipe]]
    name = \"r\"
    kind = \"stream\"
    mode = \"user\"
    [recipe.input]
    head = [255]
    tail = [254]
    fields = [
      { name = \"start\", type = \"byte\", bits = 0, commands = { rising = \"run(pick.jspf)\" } },
      { name = \"stop\", type = \"byte\", bits = 1, commands = { level = \"stop\" } },
      { name = \"tool\", type = \"byte\", bits = \"2..7\", commands = { 1 = \"enable\" } },
    ]
    [[port]]
    name = \"panel\"
    bus = \"rs485\"
    timeout_ms = \"never\"
    recipe = \"r\"";

fn panel() -> Bench {
    let mut bench = Bench::new(PANEL);
    bench.pass(1_100);
    bench.up(LinkId::COMMAND);
    bench
}

#[test]
fn a_first_press_is_told_for_a_minute() {
    let mut bench = panel();
    bench.bytes(&[255, 1, 254]);
    bench.pass(2_000);
    bench.says(Cause::FirstValue, &["port panel: value 1 gave no command 2 s ago", "press again"]);
    bench.bytes(&[255, 0, 254]);
    bench.pass(57_500);
    bench.says(Cause::FirstValue, &["59 s ago"]);
    bench.pass(1_000);
    assert_eq!(bench.of_ports(), []);
}

#[test]
fn a_press_that_works_ends_it() {
    let mut bench = panel();
    for value in [1, 0] {
        bench.bytes(&[255, value, 254]);
        bench.pass(1_100);
    }
    bench.says(Cause::FirstValue, &["base = \"keep\""]);
    bench.bytes(&[255, 1, 254]);
    bench.pass(10);
    bench.input(Input::LinkBytes { link: LinkId::COMMAND, bytes: b"run start" });
    bench.pass(1_100);
    assert_eq!(bench.of_ports(), []);
}

#[test]
fn a_panel_at_rest_is_not_blamed() {
    let mut bench = panel();
    for value in [0, 0, 0] {
        bench.bytes(&[255, value, 254]);
        bench.pass(1_000);
    }
    assert_eq!(bench.of_ports(), []);
}

#[test]
fn a_value_that_no_command_has() {
    let mut bench = panel();
    bench.bytes(&[255, 0, 254]);
    bench.bytes(&[255, 0b1000, 254]);
    bench.pass(100);
    bench.says(Cause::UnknownValue, &["value 2 gave no command 0 s ago: it is in no entry"]);
}

#[test]
fn input_from_the_gateways_sleep_may_hide_a_press() {
    let mut bench = panel();
    bench.bytes(&[255, 0, 254]);
    bench.now += Duration::from_secs(3);
    bench.bytes(&[255, 1, 254]);
    bench.pass(1_000);
    bench.says(Cause::Slept, &["discarded 1 s ago: the gateway itself had slept", "pressed meanwhile"]);
    bench.pass(60_000);
    assert_eq!(bench.of_ports(), []);
}
