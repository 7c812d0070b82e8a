//! Safe values by a recipe link, where nothing shows them.

use heapless::String;
use proto_core::config::Bus;
use proto_core::engine::{Input, LinkId, PortId};

use super::rig::*;
use super::{UDP, every, falls_silent, float, floats, packet, times};

/// ForceEnd[1] by UDP or TCP.
fn never_seen(tcp: bool) -> (Rig, PortId, LinkId) {
    let mut cell = Cell::new();
    let up = cell.stream(&["ForceEnd[1]"], &[]);
    let mut link = UDP;
    if tcp {
        let listen = String::try_from("0.0.0.0:50000").unwrap();
        link = LinkId::of_port(cell.port(Bus::TcpListen { listen }, up));
    } else {
        cell.recipe_link(up);
    }
    let recipe = cell.stream(&["ForceEnd[1]"], &[]);
    let port = cell.rs485(recipe);
    cell.safe("ForceEnd[1]", -1.0);
    let rig = cell.rig();
    assert_eq!(rig.engine.links().count(), 1);
    (rig, port, link)
}

#[test]
fn what_nothing_shows_is_sent_fast_for_a_second_and_then_ten_times_a_second() {
    for tcp in [false, true] {
        let (mut rig, port, link) = never_seen(tcp);
        let due = falls_silent(&mut rig, port, &float(5.0));
        rig.run(MS(60_001));
        let expected = [every(4, 0, 1_000), every(100, 1_100, 60_000)].concat();
        assert_eq!(times(&mut rig, link, due, &float(-1.0)), expected, "for as long as its owner is silent");
        rig.bytes(port, &float(6.0));
        rig.run(MS(99));
        assert_eq!(rig.sent_on(link), [float(6.0)]);
    }
}

#[test]
fn what_nothing_shows_is_sent_fast_again_when_the_link_was_away() {
    for tcp in [false, true] {
        let (mut rig, port, link) = never_seen(tcp);
        falls_silent(&mut rig, port, &float(5.0));
        rig.run(MS(5_001));
        rig.log.clear();
        rig.input(Input::LinkDown { link });
        rig.run(MS(99));
        assert!(rig.sent_on(link).is_empty());
        let up = rig.now + MS(1);
        rig.run(MS(2_001));
        let expected = [every(4, 0, 1_000), every(100, 1_100, 2_000)].concat();
        assert_eq!(times(&mut rig, link, up, &float(-1.0)), expected);
    }
}

#[test]
fn what_nothing_shows_is_sent_fast_again_when_another_link_was_away() {
    let mut cell = Cell::new();
    let up = cell.stream(&["ForceEnd[1]"], &[]);
    cell.recipe_link(up);
    let recipe = cell.stream(&["ForceEnd[1]"], &["DigitalSignalStatus[1]"]);
    let port = cell.rs485(recipe);
    cell.safe("ForceEnd[1]", -1.0);
    let mut rig = cell.rig();
    falls_silent(&mut rig, port, &float(5.0));
    rig.run(MS(5_031));
    rig.input(Input::LinkDown { link: LinkId::MODBUS });
    rig.run(MS(99));
    rig.log.clear();
    let up = rig.now + MS(1);
    rig.run(MS(2_001));
    let expected = [every(4, 0, 1_000), every(100, 1_100, 2_000)].concat();
    assert_eq!(times(&mut rig, UDP, up, &float(-1.0)), expected);
}

#[test]
fn by_tcp_it_goes_to_the_next_connection_when_nobody_acknowledges() {
    let (mut rig, port, link) = never_seen(true);
    let due = falls_silent(&mut rig, port, &float(5.0));
    rig.acknowledges = false;
    rig.run(MS(1_000));
    let closed = rig.closed();
    assert_eq!(closed[0], (due + MS(250), link));
    let sent = times(&mut rig, link, due, &float(-1.0));
    assert_eq!(sent[..63], every(4, 0, 248), "up to there");
    assert_eq!(sent[63], 350, "and from 100 ms later on");
    assert!(closed.len() >= 2, "{closed:?}");
    rig.acknowledges = true;
    rig.run(MS(6_000));
    assert_eq!(rig.link(link).state.name(), "up");
    rig.sent_on(link);
    rig.run(MS(1_000));
    assert_eq!(rig.sent_on(link).len(), 10);
}

#[test]
fn a_full_transport_gets_one_value_and_not_a_queue_of_them() {
    let (mut rig, port, link) = never_seen(true);
    rig.run(MS(10));
    rig.bytes(port, &float(5.0));
    rig.reports_sent = false;
    rig.sent_on(link);
    rig.bytes(port, &float(5.0));
    assert_eq!(rig.sent_on(link).len(), 1);
    rig.acked(link, 0);
    rig.run(MS(1_000));
    assert!(rig.sent_on(link).is_empty());
    rig.input(Input::LinkSent { link });
    assert_eq!(rig.sent_on(link), [float(-1.0)]);
}

#[test]
fn nothing_is_safe_before_an_owner_has_spoken() {
    let (mut rig, _, link) = never_seen(false);
    rig.run(MS(5_000));
    rig.input(Input::LinkDown { link });
    rig.run(MS(5_000));
    assert!(rig.sent_on(link).is_empty());
}

#[test]
fn a_safe_value_that_fell_due_while_its_link_was_down_goes_first_when_it_is_up() {
    let (mut rig, port, link) = never_seen(false);
    rig.run(MS(10));
    rig.bytes(port, &float(5.0));
    rig.reachable.remove(&link.0);
    rig.input(Input::LinkDown { link });
    rig.log.clear();
    rig.run(MS(3_000));
    assert!(rig.sent_on(link).is_empty());
    rig.reachable.insert(link.0);
    rig.run(MS(5_000));
    let sent = rig.sent_on(link);
    assert!(sent.len() > 250 && sent.iter().all(|frame| *frame == float(-1.0)), "{}", sent.len());
}

#[test]
fn a_variable_that_is_seen_does_not_speed_up_one_that_is_not() {
    let mut cell = Cell::new();
    let up = cell.stream(&["FloatInputReg[1]", "ForceEnd[1]"], &[]);
    cell.recipe_link(up);
    let recipe = cell.stream(&["FloatInputReg[1]", "ForceEnd[1]"], &[]);
    let port = cell.rs485(recipe);
    cell.safe("FloatInputReg[1]", -1.0);
    cell.safe("ForceEnd[1]", -2.0);
    let shows = cell.stream(&[], &["RobotState[8]"]);
    cell.rs485(shows);
    let mut rig = cell.rig();
    rig.run(MS(10));
    let due = falls_silent(&mut rig, port, &floats(5.0, 6.0));
    let frame = floats(-1.0, -2.0);
    for _ in 0..30 {
        rig.run(MS(100));
        rig.link_bytes(LinkId::STATE, &packet(0.0, 0.0));
    }
    assert_eq!(times(&mut rig, UDP, due, &frame), every(4, 0, 2_999), "one of them can be seen, and is not");
    rig.link_bytes(LinkId::STATE, &packet(-1.0, 0.0));
    rig.run(MS(2_001));
    assert_eq!(times(&mut rig, UDP, due, &frame), every(100, 3_000, 5_000), "the other cannot");
}
