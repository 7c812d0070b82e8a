//! Bus-off: this driver does not take the interface's carrier away, and cannot restart the adapter.

use std::process::Command;

use super::Case;
use super::candlelight::{Bus, Restart};
use super::stand::{Adapter, Cell, INTERFACE};
use recipe_test_kit::can::{cansend, tool};
use recipe_test_kit::until;

pub(crate) const CASES: &[Case] = &[
    ("bus_off_is_warned_of_and_nothing_is_sent", bus_off),
    ("the_adapter_restarts_and_it_sends_again", restarts),
    ("a_bus_that_stays_shorted_is_warned_of_now_and_then", stays_shorted),
    ("the_gateway_starts_while_the_adapter_is_bus_off", starts),
];

const OPEN: &str = "501#000000000000";
const CLOSED: &str = "501#C8C8C8C8C8C8";

fn bus_off() {
    let adapter = Adapter::up(1_000_000);
    let cell = Cell::hand();
    adapter.sends_a(OPEN);
    adapter.becomes(Bus::Shorted);
    let port = cell.bus("bus-off");
    assert_eq!(port["bus_offs"], 1, "{port}");
    until("a warning", || cell.gateway.log("bus-off: nothing is sent").pop());
    // The carrier does not show it, and the driver cannot end it.
    let carrier = std::fs::read_to_string(format!("/sys/class/net/{INTERFACE}/carrier")).unwrap();
    assert_eq!(carrier.trim(), "1");
    let restart = Command::new("ip").args(["link", "set", INTERFACE, "type", "can", "restart"]).output();
    let errors = String::from_utf8(restart.unwrap().stderr).unwrap();
    assert!(errors.contains("doesn't support restart from Bus Off"), "{errors}");

    let (sent, given) = (port["device"]["frames_out"].clone(), adapter.given());
    cell.robot.command("run(grip.jspf)", "run start");
    cell.looks_on(|port| {
        assert_eq!(port["device"]["bus"], "bus-off", "{port}");
        assert_eq!(port["device"]["frames_out"], sent, "nothing is sent: {port}");
    });
    assert_eq!(adapter.given(), given);
    // Root can take the interface down and up, whatever the adapter does.
    adapter.forget();
    adapter.becomes(Bus::Sound);
    tool(&format!("ip link set {INTERFACE} down"));
    tool(&format!("ip link set {INTERFACE} up"));
    assert_eq!(adapter.sends(1)[0], CLOSED, "what is true now");
    let port = cell.bus("active");
    assert_eq!((&port["bus_offs"], &port["device"]["restarts"]), (&1.into(), &0.into()), "{port}");
    cell.end();
}

fn restarts() {
    let adapter = Adapter::up(1_000_000);
    let cell = Cell::hand();
    adapter.sends_a(OPEN);
    let ways = [Restart::Firmware, Restart::Controller, Restart::Silent];
    for (bus_offs, how) in (1_u16..).zip(ways) {
        adapter.becomes(Bus::Shorted);
        cell.port("bus-off", |port| port["bus_offs"] == bus_offs);
        adapter.forget();
        adapter.becomes(Bus::Sound);
        adapter.restarts(how);
        if how == Restart::Silent {
            // Only a received frame shows that it is back.
            adapter.receive_from_bus("502#0307F401");
        }
        cell.restarted(1);
        adapter.sends(5);
        cell.grips(&adapter, bus_offs);
        let port = cell.fresh();
        assert_eq!(port["bus_offs"], bus_offs);
        assert_eq!(port["device"]["restarts"], 1, "only the first says so, {how:?}: {port}");
    }
    cell.end();
}

fn stays_shorted() {
    const TIMES: u64 = 60;
    let adapter = Adapter::up(1_000_000);
    let cell = Cell::hand();
    adapter.sends_a(OPEN);
    adapter.becomes(Bus::Shorted);
    for bus_offs in 1..=TIMES {
        cell.port("bus-off", |port| port["bus_offs"].as_u64() == Some(bus_offs));
        adapter.restarts(Restart::Firmware);
    }
    let warned = cell.gateway.log("bus-off").len();
    assert!((1..20).contains(&warned), "{warned} lines about one fault");
    cell.port("bus-off", |port| port["bus_offs"].as_u64() == Some(TIMES + 1));
    adapter.becomes(Bus::Sound);
    adapter.restarts(Restart::Firmware);
    adapter.sends_a(OPEN);
    cell.restarted(TIMES + 1);
    cell.end();
}

fn starts() {
    let adapter = Adapter::up(1_000_000);
    adapter.becomes(Bus::Shorted);
    // A frame of another program.
    cansend(INTERFACE, "123#");
    let details = || tool(&format!("ip -details link show {INTERFACE}"));
    until("the driver knows", || details().contains("state BUS-OFF").then_some(()));
    let given = adapter.given();
    let cell = Cell::hand();
    cell.looks_on(|port| {
        assert_eq!(port["device"]["bus"], "bus-off", "{port}");
        assert_eq!(port["device"]["frames_out"], 0, "{port}");
    });
    assert_eq!(adapter.given(), given);
    adapter.becomes(Bus::Sound);
    adapter.restarts(Restart::Firmware);
    adapter.sends_a(OPEN);
    cell.bus("active");
    cell.end();
}
