//! Gateways and drivers that break one promise each about what reaches the robot: the model reports it.

use proto_core::engine::{Input, LinkId, Output, PortId};
use proto_core::sysvar::SysVar;
use proto_core::time::{Duration, Instant};

use super::tests::{CELL, DEVICE, cell, coils, frame, is_rest, modbus};
use super::upward::Carried;
use super::*;
use crate::corruption::{Forged, Outward};
use crate::network::Sender;
use crate::soak::Scenario;
use crate::{Cell, LineId, PeriodicSender, Way};
use recipe_test_kit::toml;

/// A panel that starts and stops, and a variable with a safe value.
fn panel_cell() -> String {
    toml::panel(r#"1 = "speed(10)", 2 = "speed(20)", 9 = "stop""#, 100) + MIRROR
}

/// Outputs of the controller are shown.
const MIRROR: &str = r#"
[[recipe]]
name = "mirror"
kind = "stream"
mode = "user"
[recipe.output]
head = [1]
tail = [4]
on_stale = "stop"
fields = [{ name = "bits", type = "byte", from = "DigitalOutputCommand[1]" }]

[[port]]
name = "mirror"
bus = "rs485"
recipe = "mirror"
cycle_ms = 20
stale_after_ms = 300
"#;

/// One float is sent; the other one in its frame is read back.
const NEIGHBOUR: &str = r#"
[controller]
address = "127.0.0.1"
recipe_link = { udp = 2011, recipe = "up" }

[[recipe]]
name = "up"
kind = "stream"
mode = "realtime"
[recipe.input]
head = [1]
fields = ["FloatInputReg[1..2]"]

[[recipe]]
name = "device"
kind = "stream"
mode = "realtime"
[recipe.input]
head = [1]
fields = ["FloatInputReg[1]"]

[[port]]
name = "device"
bus = "rs485"
recipe = "device"
"#;

/// A frame of the panel.
fn panel(order: u8, bits: u8) -> Vec<u8> {
    vec![0xFF, 0xFF, order, bits, 0xEE, 0xEE]
}

/// The cell after one second; its device has sent a first frame.
fn ready(toml: &str, first: &[u8]) -> (Cell, LineId) {
    let mut cell = cell(toml);
    cell.run_ms(1_000);
    let line = cell.line_of("device");
    cell.send(line, first);
    cell.run_ms(50);
    assert_eq!(cell.violation(), None);
    (cell, line)
}

#[track_caller]
fn broken(cell: &Cell) -> Invariant {
    match cell.violation() {
        Some(violation) => violation.invariant,
        None => panic!("nothing was noticed"),
    }
}

fn outward(
    change: impl FnMut(Instant, &Input<'_>, &Output<'_>) -> Option<Vec<Forged>> + 'static,
) -> Option<Outward> {
    Some(Box::new(change))
}

/// A driver that does not close this link.
fn never_closes(link: LinkId) -> Option<Outward> {
    outward(move |_, _, output| (*output == Output::LinkClose { link }).then(Vec::new))
}

#[test]
fn good_ones_are_not_accused() {
    let (mut cell, line) = ready(&panel_cell(), &panel(0, 1));
    for (order, bits) in [(9, 2), (9, 3), (0, 4), (1, 5), (9, 6)] {
        for _ in 0..40 {
            cell.send(line, &panel(order, bits));
            cell.run_ms(50);
        }
        cell.stall_gateway(Duration::from_millis(400));
        cell.run_ms(1_000);
    }
    cell.run_ms(5_000);
    assert_eq!(cell.violation(), None);
    let checks = cell.checks();
    for invariant in
        [Invariant::ValueAge, Invariant::CommandAge, Invariant::StopArrives, Invariant::SafeArrives]
    {
        assert!(checks[&invariant] > 0, "{invariant:?}");
    }
}

#[test]
fn a_value_that_the_network_delivers_when_it_is_old() {
    let (mut cell, line) = ready(CELL, &frame(1));
    cell.corrupt(None, never_closes(LinkId::MODBUS));
    cell.cut_way(LinkId::MODBUS, Way::Up);
    cell.send(line, &frame(2));
    cell.run_ms(1_000);
    cell.repair_way(LinkId::MODBUS, Way::Up);
    cell.run_ms(390);
    assert_eq!(cell.violation(), None);
    cell.run_ms(100);
    assert_eq!(broken(&cell), Invariant::ValueAge);
}

#[test]
fn a_command_that_the_network_delivers_when_it_is_old() {
    let (mut cell, line) = ready(&panel_cell(), &panel(0, 1));
    cell.corrupt(None, never_closes(LinkId::COMMAND));
    cell.cut_way(LinkId::COMMAND, Way::Up);
    cell.send(line, &panel(1, 1));
    cell.run_ms(1_200);
    cell.repair_way(LinkId::COMMAND, Way::Up);
    cell.run_ms(300);
    assert_eq!(broken(&cell), Invariant::CommandAge);
}

#[test]
fn a_stop_that_nobody_has_asked_for_any_more_for_long() {
    let (mut cell, line) = ready(&panel_cell(), &panel(0, 1));
    cell.cut_way(LinkId::URGENT, Way::Up);
    cell.send(line, &panel(9, 1));
    cell.run_ms(20);
    cell.send(line, &panel(0, 1));
    cell.run_ms(20);
    let conn = cell.gate(LinkId::URGENT).conn.unwrap();
    for (late, expected) in [(1_900, None), (2_100, Some(Invariant::CommandAge))] {
        let mut oracle = cell.oracle.clone().unwrap();
        oracle.delivered(conn, 100, Duration::ZERO, cell.now() + Duration::from_millis(late));
        assert_eq!(oracle.violation().map(|broken| broken.invariant), expected, "{late} ms");
    }
}

#[test]
fn a_stop_that_is_kept_back() {
    let (mut cell, line) = ready(&panel_cell(), &panel(0, 1));
    let stop =
        |output: &Output<'_>| matches!(output, Output::LinkSend { bytes, .. } if bytes.starts_with(b"stop"));
    cell.corrupt(None, outward(move |_, _, output| stop(output).then(Vec::new)));
    for _ in 0..30 {
        cell.send(line, &panel(9, 1));
        cell.run_ms(50);
    }
    assert_eq!(cell.violation(), None, "it may take a second and a half");
    for _ in 0..4 {
        cell.send(line, &panel(9, 1));
        cell.run_ms(50);
    }
    assert_eq!(broken(&cell), Invariant::StopArrives);
}

#[test]
fn a_command_that_the_controller_does_not_understand() {
    let (mut cell, _) = ready(&panel_cell(), &panel(0, 1));
    cell.run_ms(1_000);
    let (mut oracle, now) = (cell.oracle.take().unwrap(), cell.now());
    oracle.note_fault(Some(LinkId::URGENT), now);
    oracle.not_understood(LinkId::URGENT, now);
    assert_eq!(oracle.violation(), None, "it may have come in pieces");
    oracle.not_understood(LinkId::COMMAND, now);
    assert_eq!(oracle.violation().map(|broken| broken.invariant), Some(Invariant::Understood));
}

#[test]
fn a_safe_value_that_is_not_there() {
    let (mut cell, _) = ready(&panel_cell(), &panel(0, 1));
    cell.run_ms(3_000);
    assert_eq!(cell.value("DigitalOutputCommand[1]"), 128.0);
    let inputs = copied_inputs(cell.controller().registers().image());
    let (paths, now) = (cell.paths(), cell.now());
    let mut without = inputs;
    without[0] = 1;
    let judged = |change: &dyn Fn(&mut Oracle), cell: &mut Cell| {
        let mut oracle = cell.oracle.clone().unwrap();
        change(&mut oracle);
        oracle.survey(&paths, &without, now);
        oracle.violation().map(|broken| broken.invariant)
    };
    // As if the newest arrival had set it.
    let arrives = |oracle: &mut Oracle| oracle.robot.applied(&inputs, &without, now);
    assert_eq!(judged(&arrives, &mut cell), Some(Invariant::SafeArrives));
    assert_eq!(judged(&|_| (), &mut cell), None, "somebody else has written it");
    let faulted = |oracle: &mut Oracle| {
        arrives(oracle);
        oracle.note_fault(None, now);
    };
    assert_eq!(judged(&faulted, &mut cell), None, "it may be on its way");
}

#[test]
fn a_frame_with_a_value_that_cannot_be_read() {
    let (mut cell, line) = ready(CELL, &frame(1));
    cell.run_ms(100);
    let shown = cell.line(line).take_heard().pop().unwrap().1;
    cell.corrupt_float(SysVar::parse("FloatOutputReg[1]").unwrap(), f32::NAN);
    cell.run_ms(200);
    assert_eq!(cell.violation(), None, "it shows nothing");
    cell.corrupt(
        None,
        outward(move |now, input, output| {
            let on_grid = now.as_micros() % 20_000 == 0 && matches!(input, Input::Tick);
            (on_grid && is_rest(output)).then(|| vec![Forged::Port(DEVICE, shown.clone())])
        }),
    );
    cell.run_ms(100);
    assert_eq!(broken(&cell), Invariant::Unreadable);
}

#[test]
fn a_value_that_cannot_be_read_is_written_back() {
    let float = |value: f32| [&[1], &value.to_le_bytes()[..]].concat();
    let (mut cell, line) = ready(NEIGHBOUR, &float(1.5));
    cell.corrupt_float(SysVar::parse("FloatInputReg[2]").unwrap(), f32::INFINITY);
    cell.run_ms(300);
    let sent = cell.link(LinkId::RECIPE_UDP).counters.sent;
    cell.send(line, &float(2.5));
    cell.run_ms(50);
    assert_eq!((cell.link(LinkId::RECIPE_UDP).counters.sent, cell.violation()), (sent, None));
    cell.corrupt(
        None,
        outward(|_, input, output| {
            let bytes = [&[1], &3.5_f32.to_le_bytes()[..], &[0; 4]].concat();
            let now = matches!(input, Input::PortBytes { .. }) && is_rest(output);
            now.then(|| vec![Forged::Link(LinkId::RECIPE_UDP, bytes)])
        }),
    );
    cell.send(line, &float(3.5));
    cell.run_ms(50);
    assert_eq!(broken(&cell), Invariant::Unreadable);
}

#[test]
fn a_value_of_our_own_that_is_older_than_promised() {
    let (mut cell, _) = ready(&panel_cell(), &panel(0, 1));
    cell.run_ms(500);
    assert_eq!(cell.violation(), None);
    cell.corrupt(
        None,
        outward(|now, input, output| {
            let on_grid = now.as_micros() % 20_000 == 0 && matches!(input, Input::Tick);
            (on_grid && is_rest(output)).then(|| vec![Forged::Port(PortId(1), vec![1, 128, 4])])
        }),
    );
    cell.run_ms(100);
    assert_eq!(broken(&cell), Invariant::OwnAge);
}

#[test]
fn a_timeout_of_a_device_that_was_not_silent() {
    let (mut cell, line) = ready(&panel_cell(), &panel(0, 1));
    cell.attach(line, PeriodicSender::new(cell.now(), 40, u64::MAX, |_| panel(0, 1)));
    cell.run_ms(200);
    cell.stall_gateway(Duration::from_millis(300));
    let wakes = cell.now() + Duration::from_millis(300);
    cell.corrupt(
        None,
        outward(move |now, input, output| {
            let answered = matches!(input, Input::LinkBytes { link: LinkId::MODBUS, .. }) && is_rest(output);
            (answered && now > wakes).then(|| modbus(coils(128))).flatten()
        }),
    );
    cell.run_ms(299);
    assert_eq!(cell.violation(), None);
    cell.run_ms(200);
    assert_eq!(broken(&cell), Invariant::FalseTimeout);
}

#[test]
fn a_value_that_waited_while_the_gateway_slept() {
    let (mut cell, line) = ready(CELL, &frame(1));
    cell.stall_gateway(Duration::from_millis(700));
    cell.run_ms(100);
    cell.send(line, &[0xFF, 0xFF, 0x40, 0, 0, 0xEE, 0xEE]);
    cell.corrupt(
        None,
        outward(|_, input, output| {
            let is_up = matches!(input, Input::LinkUp { link: LinkId::MODBUS });
            (is_up && is_rest(output)).then(|| modbus(coils(0x40))).flatten()
        }),
    );
    cell.run_ms(1_000);
    assert_eq!(broken(&cell), Invariant::FromSleep);
}

#[test]
fn a_command_that_waited_while_the_gateway_slept() {
    let (mut cell, line) = ready(&panel_cell(), &panel(0, 1));
    cell.stall_gateway(Duration::from_millis(700));
    cell.run_ms(100);
    cell.send(line, &panel(2, 1));
    cell.corrupt(
        None,
        outward(|_, input, output| {
            let is_up = matches!(input, Input::LinkUp { link: LinkId::COMMAND });
            let bytes = b"speed(20)".to_vec();
            (is_up && is_rest(output)).then(|| vec![Forged::Link(LinkId::COMMAND, bytes)])
        }),
    );
    cell.run_ms(1_000);
    assert_eq!(broken(&cell), Invariant::FromSleep);
}

#[test]
fn a_driver_that_answers_a_stranger() {
    let scenario = Scenario::named("two-clients").unwrap().unwrap();
    let mut cell = Cell::new(&scenario.gateway, &scenario.controller, 1).unwrap();
    cell.watch();
    cell.run_ms(500);
    let link = cell.datagram_links().next().unwrap();
    let bus = cell.bus_of("buttons");
    let id = proto_core::wire::can::CanId::Standard(5);
    cell.send_can(bus, proto_core::wire::can::CanFrame::new(id, &[0, 1]).unwrap());
    for _ in 0..200 {
        cell.run(Duration::from_micros(50));
        cell.gate(link).answers_to = Some(Sender::Stranger);
    }
    assert_eq!(broken(&cell), Invariant::Destination);
}

/// Forces of a sensor without safe values, in one frame with outputs of another device.
fn two_clients_without_safe_forces() -> Cell {
    let text = include_str!("../soak/cells/two-clients.toml");
    let text: String =
        text.lines().filter(|line| !line.starts_with("\"ForceEnd")).map(|line| format!("{line}\n")).collect();
    let scenario = Scenario::named("two-clients").unwrap().unwrap();
    let mut cell = Cell::new(&toml::gateway(&text), &scenario.controller, 1).unwrap();
    cell.watch();
    cell
}

#[test]
fn a_held_value_from_before_the_controller_began_anew() {
    let mut cell = two_clients_without_safe_forces();
    cell.run_ms(1_000);
    let line = cell.line_of("sensor");
    let forces: Vec<u8> = [7.5_f32; 6].iter().flat_map(|value| value.to_le_bytes()).collect();
    cell.send(line, &[&[0x48, 0xAA], &forces[..], &[0x0D, 0x0A]].concat());
    cell.run_ms(1_000);
    cell.restart_controller();
    cell.run_ms(3_000);
    let held = Carried::Held { accepted: cell.now() - Duration::from_secs(4) };
    let mut oracle = cell.oracle.take().unwrap();
    let now = cell.now();
    oracle.robot.note_sent(SysVar::parse("ForceEnd[1]").unwrap(), 7.5_f32.to_le_bytes(), held);
    oracle.sent(7, LinkId::of_port(PortId(0)), b"frame", Duration::ZERO, now);
    oracle.delivered(7, 5, Duration::ZERO, now);
    assert_eq!(oracle.violation().map(|broken| broken.invariant), Some(Invariant::NoReplay));
}

#[test]
fn a_command_that_comes_behind_the_stop_that_overtook_it() {
    let (mut cell, line) = ready(&panel_cell(), &panel(0, 1));
    cell.corrupt(None, never_closes(LinkId::COMMAND));
    cell.cut_way(LinkId::COMMAND, Way::Up);
    cell.send(line, &panel(1, 1));
    cell.run_ms(100);
    cell.send(line, &panel(9, 1));
    cell.run_ms(300);
    assert_eq!(cell.violation(), None);
    cell.repair_way(LinkId::COMMAND, Way::Up);
    cell.run_ms(300);
    assert_eq!(broken(&cell), Invariant::Overtaken);
}
