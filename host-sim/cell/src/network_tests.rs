//! Outages of the network, and TCP's behaviour in them.

use proto_core::config::Bus;
use proto_core::engine::{LinkId, PortId};
use proto_core::link::LinkState;
use proto_core::time::Duration;

use super::tests::cell;
use super::*;
use crate::soak::Scenario;

const DO1: [u8; 5] = [0xFF, 0xFF, 0x01, 0xEE, 0xEE];
/// The link of the controller's TCP client in the example of that name.
const CLIENT: LinkId = LinkId::of_port(PortId(0));

/// The worked example, after all links have come up.
fn system() -> (Cell, LineId) {
    let mut cell = cell("rs485-system", 1);
    cell.run_ms(505);
    let line = cell.line_of("rs485-1");
    (cell, line)
}

fn do1(cell: &Cell) -> f64 {
    cell.value("DO[1]")
}

#[test]
fn what_was_sent_into_an_outage_arrives_when_it_is_sent_again() {
    let (mut cell, line) = system();
    cell.cut_cable(LinkId::MODBUS);
    cell.send(line, &DO1);
    cell.run_ms(100);
    cell.repair_cable(LinkId::MODBUS);
    cell.run_ms(95);
    assert_eq!(do1(&cell), 0.0, "the cable is in, and nobody has tried again");
    cell.run_ms(10);
    assert_eq!(do1(&cell), 1.0);
    assert_eq!(cell.link(LinkId::MODBUS).history.losses, 0);
}

#[test]
fn each_wait_is_twice_as_long_and_order_is_kept() {
    // The controller's client sends a frame each 4 ms, which can be checked; the state stream cannot.
    let mut cell = cell("client", 1);
    cell.run_ms(505);
    cell.cut_way(CLIENT, Way::Down);
    let before = cell.link(CLIENT).counters.received;
    cell.run_ms(620);
    // Retransmitted after 200, 600 and 1400 ms; the second one was lost, too.
    cell.repair_way(CLIENT, Way::Down);
    cell.run_ms(770);
    assert_eq!(cell.link(CLIENT).counters.received, before);
    cell.run_ms(20);
    let link = cell.link(CLIENT);
    assert!((349..=353).contains(&(link.counters.received - before)), "{link:?}");
    assert_eq!((link.counters.malformed, link.counters.resync_bytes, link.history.losses), (0, 0, 0));
}

#[test]
fn what_the_sender_has_reset_never_arrives_and_the_peer_is_long_in_the_dark() {
    let (mut cell, line) = system();
    let requests = cell.controller().counters().modbus.requests;
    cell.cut_cable(LinkId::MODBUS);
    cell.send(line, &DO1);
    // Given up after 500 ms without an answer.
    cell.run_ms(700);
    assert_eq!(cell.link(LinkId::MODBUS).history.losses, 1);
    cell.repair_cable(LinkId::MODBUS);
    cell.run_ms(5_000);
    let modbus = cell.controller().counters().modbus;
    assert_eq!((do1(&cell), modbus.requests), (0.0, requests));
    assert_eq!(modbus.open, 2, "the reset was lost too");
    cell.run(TCP_TIMEOUT);
    assert_eq!(cell.controller().counters().modbus.open, 1);
}

#[test]
fn a_peer_that_sends_to_a_connection_that_is_gone_is_told_so() {
    let (mut cell, _) = system();
    cell.cut_cable(LinkId::STATE);
    // Closed after two silent seconds; the controller is not told.
    cell.run_ms(2_200);
    assert_eq!(cell.controller().counters().state.open, 1);
    cell.repair_cable(LinkId::STATE);
    // It retransmits after 0.2, 0.6, 1.4 and 3 s.
    cell.run_ms(1_000);
    let link = cell.link(LinkId::STATE);
    assert!(matches!(link.state, LinkState::Up { .. }), "{link:?}");
    assert_eq!(cell.controller().counters().state.open, 1, "the old one was reset");
}

#[test]
fn a_connection_asked_for_in_an_outage_comes_late() {
    let (mut cell, _) = system();
    cell.cut_cable(LinkId::MODBUS);
    cell.reset(LinkId::MODBUS);
    // Opened after 100 ms; the connection request is repeated a second later.
    cell.run_ms(600);
    cell.repair_cable(LinkId::MODBUS);
    cell.run_ms(495);
    assert!(matches!(cell.link(LinkId::MODBUS).state, LinkState::Opening { .. }));
    cell.run_ms(10);
    let link = cell.link(LinkId::MODBUS);
    assert!(matches!(link.state, LinkState::Up { .. }));
    assert_eq!(link.history.failed_opens, 0);
    // The same with a server that does not answer for a while.
    cell.black_hole(LinkId::MODBUS);
    cell.reset(LinkId::MODBUS);
    cell.run_ms(600);
    cell.admit(LinkId::MODBUS);
    // Lost twice in a short time: opened after 200 ms.
    cell.run_ms(605);
    assert!(matches!(cell.link(LinkId::MODBUS).state, LinkState::Up { .. }));
}

#[test]
fn a_peer_that_acknowledges_late_slows_nothing_and_one_that_does_not_is_given_up() {
    let mut cell = cell("client", 1);
    cell.network(CLIENT).ack_delay = Duration::from_millis(200);
    cell.network(CLIENT).ack_report = Duration::from_millis(20);
    cell.run_ms(505);
    let line = cell.line_of("rs485-1");
    let frame = |n: u64| vec![0xFF, 0xFF, n as u8, 0xEE, 0xEE];
    cell.attach(line, PeriodicSender::new(cell.now(), 250, 2_500, frame));
    cell.run_ms(5_000);
    let link = cell.link(CLIENT);
    assert_eq!((link.history.losses, link.counters.unacknowledged), (0, 0));
    let sent = link.counters.sent;
    assert!(sent >= 1_249, "{sent}");
    // From now on the frames arrive, but no acknowledgements.
    cell.cut_way(CLIENT, Way::Down);
    cell.run_ms(200);
    let value = cell.value("DigitalOutputCommand[1]");
    cell.run_ms(10);
    assert_ne!(cell.value("DigitalOutputCommand[1]"), value);
    cell.run_ms(500);
    let link = cell.link(CLIENT);
    assert_eq!((link.history.losses, link.counters.unacknowledged), (1, 1), "{link:?}");
}

#[test]
fn the_transport_itself_gives_up_a_peer_that_acknowledges_nothing() {
    let mut cell = cell("client", 1);
    cell.run_ms(505);
    let line = cell.line_of("rs485-1");
    cell.cut_way(CLIENT, Way::Up);
    cell.send(line, &DO1);
    cell.run_ms(1);
    // No call of the engine can give it up.
    cell.stall_gateway(Duration::from_secs(10));
    cell.run_ms(2_100);
    cell.repair_way(CLIENT, Way::Up);
    cell.run_ms(7_000);
    assert_eq!(do1(&cell), 0.0, "it is not sent again for ever");
}

#[test]
fn a_full_transport_takes_the_next_when_there_is_room() {
    let mut cell = cell("client", 1);
    cell.run_ms(505);
    cell.network(CLIENT).send_buffer = 8;
    cell.network(CLIENT).delay = Duration::from_millis(10);
    let line = cell.line_of("rs485-1");
    let frame = |n: u64| vec![0xFF, 0xFF, n as u8, 0xEE, 0xEE];
    cell.attach(line, PeriodicSender::new(cell.now(), 250, u64::MAX, frame));
    let before = cell.link(CLIENT).counters.sent;
    cell.run_ms(2_000);
    // Two frames of five bytes in each round trip of 20 ms.
    let sent = cell.link(CLIENT).counters.sent - before;
    assert!((150..=210).contains(&sent), "{sent}");
    assert_eq!(cell.link(CLIENT).history.losses, 0);
}

#[test]
fn a_burst_loses_all_datagrams_and_no_more() {
    let mut cell = cell("udp-server", 1);
    cell.run_ms(505);
    let line = cell.line_of("rs485-1");
    cell.cut_way(LinkId::RECIPE_UDP, Way::Up);
    cell.cut_way(LinkId::RECIPE_UDP, Way::Up);
    cell.repair_way(LinkId::RECIPE_UDP, Way::Up);
    cell.send(line, &DO1);
    cell.run_ms(50);
    assert_eq!(do1(&cell), 0.0, "one of two faults is still there");
    cell.repair_way(LinkId::RECIPE_UDP, Way::Up);
    cell.run_ms(2_000);
    assert_eq!(do1(&cell), 0.0, "what is lost is lost");
    cell.send(line, &DO1);
    cell.run_ms(5);
    assert_eq!(do1(&cell), 1.0);
}

#[test]
fn a_controller_that_was_without_power_has_forgotten_its_connections_and_its_registers() {
    let (mut cell, line) = system();
    cell.send(line, &[0xFF, 0xFF, 0xFF, 0xEE, 0xEE]);
    cell.set_value("WordOutputReg[3]", 9.0);
    cell.run_ms(50);
    assert_eq!(do1(&cell), 1.0);
    cell.power_cut();
    cell.run_ms(300);
    cell.power_up();
    cell.run_ms(10);
    assert_eq!((do1(&cell), cell.value("WordOutputReg[3]")), (0.0, 0.0));
    let before = cell.link(LinkId::MODBUS).history.losses;
    cell.send(line, &DO1);
    cell.run_ms(10);
    assert_eq!(cell.link(LinkId::MODBUS).history.losses, before + 1, "what came there was reset");
    cell.run_ms(3_500);
    let counters = cell.controller().counters();
    assert_eq!((counters.modbus.open, counters.state.open, do1(&cell)), (1, 1, 0.0));
    cell.send(line, &DO1);
    cell.run_ms(10);
    assert_eq!(do1(&cell), 1.0);
}

#[test]
fn the_gateway_answers_whoever_sends_frames_and_nobody_else() {
    let scenario = Scenario::named("two-clients").unwrap().unwrap();
    let mut cell = Cell::new(&scenario.gateway, &scenario.controller, 1).unwrap();
    cell.watch();
    let nth = scenario.gateway.ports.iter().position(|port| matches!(port.bus, Bus::UdpListen { .. }));
    let link = LinkId::of_port(PortId(nth.unwrap() as u8));
    // After the link is opened, any sender's first datagram is answered.
    cell.stranger_sends(link, &[1, 2, 3]);
    cell.run_ms(500);
    let arrived = |cell: &Cell| cell.controller().counters().ports["udp"].frames_in;
    let bus = cell.bus_of("buttons");
    let press = |cell: &mut Cell, bits| {
        let id = proto_core::wire::can::CanId::Standard(5);
        cell.send_can(bus, proto_core::wire::can::CanFrame::new(id, &[0, bits]).unwrap());
        cell.run_ms(20);
        cell.value("DigitalOutputCommand[2]")
    };
    assert_eq!(press(&mut cell, 3), 3.0);
    let before = arrived(&cell);
    cell.stranger_sends(link, &[9; 3]);
    cell.run_ms(1);
    assert_eq!(press(&mut cell, 5), 5.0, "the stranger changed nothing");
    assert!(arrived(&cell) > before);
    // A client that restarts has a new socket, from which its next frame comes.
    cell.restart_controller();
    cell.run_ms(500);
    assert_eq!(press(&mut cell, 6), 6.0);
    assert_eq!(cell.violation(), None);
}
