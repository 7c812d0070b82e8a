//! What reaches the robot when the network, the controller or the gateway fails: nothing old, but safe
//! values and stops. The model watches every test.

use proto_core::engine::LinkId;
use proto_core::time::Duration;
use recipe_cell::soak::Scenario;
use recipe_cell::{Cell, Way};
use recipe_config::SimConfig;
use recipe_controller::Link;
use recipe_test_kit::toml;

use crate::kit::*;

/// A watched cell of these configurations, one second after it was switched on.
fn watched(gateway: &str, controller: Option<&str>) -> Cell {
    let controller = controller.map_or_else(SimConfig::default, toml::controller);
    let mut cell = Cell::new(&toml::gateway(gateway), &controller, 1).unwrap();
    cell.watch();
    cell.run_ms(1_000);
    cell
}

/// An embedded cell of the soak runs, same.
fn scenario(name: &str) -> Cell {
    let scenario = Scenario::named(name).unwrap().unwrap();
    let mut cell = Cell::new(&scenario.gateway, &scenario.controller, 1).unwrap();
    cell.watch();
    cell.run_ms(1_000);
    cell
}

#[track_caller]
fn assert_good(cell: &Cell) {
    assert_eq!(cell.violation(), None, "at {:?}", cell.now());
}

/// A panel with commands that start and stop.
fn panel() -> String {
    toml::panel(r#"1 = "speed(10)", 2 = "stop", 3 = "pause", 4 = "disable""#, 300)
}

/// The device sends an order for some time.
fn hold(cell: &mut Cell, order: u8, millis: u64) {
    let line = cell.line_of("device");
    for _ in 0..millis / 50 {
        cell.send(line, &[0xFF, 0xFF, order, 1, 0xEE, 0xEE]);
        cell.run_ms(50);
    }
}

fn requests(cell: &Cell) -> u64 {
    cell.controller().counters().command.requests
}

#[test]
fn a_cable_that_was_out_brings_nothing_old() {
    for millis in [100, 300, 700, 1_500, 4_000, 15_000] {
        let mut cell = watched(&panel(), None);
        hold(&mut cell, 0, 500);
        let links: Vec<LinkId> = cell.link_ids().collect();
        links.iter().for_each(|link| cell.cut_cable(*link));
        // Pressed briefly while the cable is out.
        hold(&mut cell, 1, 50);
        hold(&mut cell, 0, millis - 50);
        links.iter().for_each(|link| cell.repair_cable(*link));
        hold(&mut cell, 0, 8_000);
        assert_good(&cell);
        let expected = u64::from(millis < 700);
        assert_eq!(requests(&cell), expected, "out for {millis} ms");
        assert_eq!(cell.value("DigitalOutputCommand[1]"), 1.0);
    }
}

#[test]
fn a_stop_arrives_when_the_cable_is_in_again() {
    let mut cell = watched(&panel(), None);
    hold(&mut cell, 0, 500);
    let links: Vec<LinkId> = cell.link_ids().collect();
    links.iter().for_each(|link| cell.cut_cable(*link));
    hold(&mut cell, 2, 6_000);
    assert_eq!(requests(&cell), 0);
    links.iter().for_each(|link| cell.repair_cable(*link));
    hold(&mut cell, 2, 8_000);
    assert_eq!(requests(&cell), 1, "once");
    assert_good(&cell);
}

#[test]
fn a_stop_does_not_wait_behind_one_that_nobody_answered() {
    let mut cell = watched(&panel(), None);
    cell.server_fault_begins(Link::Command);
    cell.controller_mut().mute(Link::Command);
    hold(&mut cell, 0, 500);
    for nth in 1..=3 {
        hold(&mut cell, 2, 1_500);
        assert_eq!(requests(&cell), nth);
        hold(&mut cell, 0, 500);
    }
    assert_good(&cell);
}

#[test]
fn of_what_was_pressed_while_the_gateway_slept_only_a_stop_that_is_held_is_given() {
    for (held, given) in [(1, 0), (2, 1)] {
        let mut cell = watched(&panel(), None);
        hold(&mut cell, 0, 500);
        cell.stall_gateway(Duration::from_secs(3));
        hold(&mut cell, 3 - held, 1_000);
        hold(&mut cell, held, 2_500);
        hold(&mut cell, held, 3_000);
        assert_eq!(requests(&cell), given, "the first frame after sleep sets the base of all others");
        hold(&mut cell, 0, 500);
        hold(&mut cell, 2, 500);
        assert_eq!(requests(&cell), given + 1);
        assert_good(&cell);
    }
}

#[test]
fn a_safe_value_gets_there_through_a_burst_and_late_packets_that_show_it() {
    let mut cell = scenario("several-ports");
    let line = cell.line_of("plc");
    let send = |cell: &mut Cell, bits: u8, times: u32| {
        let frame = [&[0xAA, 0x55, bits][..], &[0; 28], &[0x0D]].concat();
        for _ in 0..times {
            cell.send(line, &frame);
            cell.run_ms(50);
        }
    };
    // 128 is the safe value; packets that show it are held on their way.
    send(&mut cell, 128, 20);
    cell.hold(LinkId::STATE, Way::Down);
    send(&mut cell, 128, 6);
    send(&mut cell, 5, 4);
    assert_eq!(cell.value("DigitalOutputCommand[1]"), 5.0);
    cell.cut_way(LinkId::RECIPE_UDP, Way::Up);
    cell.run_ms(500);
    cell.release(LinkId::STATE, Way::Down);
    cell.run_ms(50);
    cell.repair_way(LinkId::RECIPE_UDP, Way::Up);
    cell.run_ms(4_000);
    assert_eq!(cell.value("DigitalOutputCommand[1]"), 128.0);
    assert_good(&cell);
}

#[test]
fn a_safe_value_is_written_again_to_a_controller_that_was_without_power() {
    for (name, port, var) in [
        ("force-sensor", "force", "ForceEnd[1]"),
        ("several-ports", "plc", "DigitalOutputCommand[1]"),
        ("two-clients", "buttons", "DigitalOutputCommand[1]"),
    ] {
        let mut cell = scenario(name);
        let safe = match name {
            "force-sensor" => {
                let line = cell.line_of(port);
                cell.send(line, &force_frame([3.0; 6]));
                0.0
            }
            "several-ports" => {
                let line = cell.line_of(port);
                cell.send(line, &[&[0xAA, 0x55, 7][..], &[0; 28], &[0x0D]].concat());
                128.0
            }
            _ => {
                let (bus, sensor) = (cell.bus_of(port), cell.line_of("sensor"));
                // Both are in one frame of the link.
                cell.send(sensor, &force_frame([3.0; 6]));
                cell.send_can(bus, can(5, &[7, 7]));
                1.0
            }
        };
        cell.run_ms(3_000);
        assert_eq!(cell.value(var), safe, "{name}");
        cell.power_cut();
        cell.run_ms(1_000);
        cell.power_up();
        cell.run_ms(100);
        if safe != 0.0 {
            assert_eq!(cell.value(var), 0.0, "{name} begins anew");
        }
        cell.run_ms(8_000);
        assert_eq!(cell.value(var), safe, "{name}");
        assert_good(&cell);
    }
}

#[test]
fn another_stop_takes_the_place_that_is_free_beside_one_that_nobody_answered() {
    let mut cell = watched(&panel(), None);
    hold(&mut cell, 0, 500);
    // The second connection is refused: both stops go over the first.
    cell.refuse(LinkId::URGENT);
    cell.reset(LinkId::URGENT);
    cell.server_fault_begins(Link::Command);
    cell.controller_mut().mute(Link::Command);
    hold(&mut cell, 2, 1_000);
    hold(&mut cell, 0, 100);
    cell.controller_mut().unmute(Link::Command);
    // One reply for two stops.
    hold(&mut cell, 2, 1_500);
    let before = requests(&cell);
    hold(&mut cell, 3, 1_600);
    assert_eq!(requests(&cell), before + 1);
    assert_good(&cell);
}

#[test]
fn a_safe_value_gets_there_though_a_late_answer_shows_it_from_before() {
    let gateway = include_str!("../../src/soak/cells/witness.toml");
    let controller = include_str!("../../src/soak/cells/witness-controller.toml");
    for offset in 0..20 {
        let mut cell = watched(gateway, Some(controller));
        let line = cell.line_of("device");
        let send = |cell: &mut Cell, bits: u8, times: u32| {
            for _ in 0..times {
                cell.send(line, &[1, bits, 0, 4]);
                cell.run_ms(50);
            }
        };
        send(&mut cell, 128, 10);
        cell.run_ms(offset * 30);
        cell.send(line, &[1, 128, 0, 4]);
        cell.server_fault_begins(Link::Modbus);
        cell.controller_mut().delay_answers(Link::Modbus, Duration::from_millis(480));
        cell.run_ms(90);
        send(&mut cell, 5, 1);
        cell.cut_way(LinkId::RECIPE_UDP, Way::Up);
        cell.run_ms(600);
        cell.controller_mut().delay_answers(Link::Modbus, Duration::ZERO);
        cell.server_fault_ends(Link::Modbus);
        cell.repair_way(LinkId::RECIPE_UDP, Way::Up);
        cell.run_ms(4_000);
        assert_eq!(cell.value("DigitalOutputCommand[1]"), 128.0, "{offset}");
        assert_good(&cell);
    }
}

#[test]
fn a_value_of_a_silent_owner_is_not_written_to_a_controller_that_began_anew() {
    let toml = include_str!("../../src/soak/cells/two-clients.toml");
    let without: Vec<&str> = toml.lines().filter(|line| !line.starts_with("\"ForceEnd")).collect();
    let controller = include_str!("../../src/soak/cells/two-clients-controller.toml");
    let mut cell = watched(&without.join("\n"), Some(controller));
    let (line, bus) = (cell.line_of("sensor"), cell.bus_of("buttons"));
    cell.send_can(bus, can(5, &[1, 1]));
    cell.run_ms(20);
    cell.send(line, &force_frame([7.5; 6]));
    cell.run_ms(1_000);
    assert_eq!(force(&cell), [7.5; 6]);
    cell.power_cut();
    cell.run_ms(2_000);
    cell.power_up();
    cell.run_ms(10_000);
    cell.send_can(bus, can(5, &[3, 1]));
    cell.run_ms(500);
    assert_eq!(force(&cell), [0.0; 6], "nobody has measured since");
    cell.send(line, &force_frame([2.5; 6]));
    cell.run_ms(100);
    assert_eq!(force(&cell), [2.5; 6]);
    assert_good(&cell);
}
