//! The last value of a silent owner, if nothing reads it back, stays in a recipe link's frame as long as
//! the controller has been there since; a controller that restarted does not get it (docs/engine.md
//! section 5).

mod rig;

use heapless::String;
use proto_core::config::Bus;
use proto_core::engine::{Input, LinkId, PortId};
use rig::*;

const SENSOR: PortId = PortId(0);
const BUTTONS: PortId = PortId(1);
const UDP: LinkId = LinkId::RECIPE_UDP;

/// What shows that the controller is there.
#[derive(Clone, Copy, PartialEq)]
enum By {
    Connection,
    Frames,
    Packets,
    Nothing,
}

/// A sensor's force, without a safe value, in one frame with an output of the buttons.
fn cell(by: By) -> (Rig, LinkId) {
    let mut cell = Cell::new();
    let sensor = cell.stream(&["ForceEnd[1]"], &[]);
    cell.rs485(sensor);
    let buttons = cell.stream(&["DigitalOutputCommand[1]"], &[]);
    cell.rs485(buttons);
    cell.last_port().timeout = MS(60_000);
    if by == By::Packets {
        let shows = cell.stream(&[], &["RobotState[8]"]);
        cell.rs485(shows);
    }
    let down: &[&str] = if by == By::Frames { &["RobotState[26]"] } else { &[] };
    let up = cell.stream(&["ForceEnd[1]", "DigitalOutputCommand[1]"], down);
    let mut link = UDP;
    if by == By::Connection {
        let listen = String::try_from("0.0.0.0:50000").unwrap();
        link = LinkId::of_port(cell.port(Bus::TcpListen { listen }, up));
    } else {
        cell.recipe_link(up);
    }
    let mut rig = cell.rig();
    rig.run(MS(10));
    says(&mut rig, by, link);
    assert_eq!(press(&mut rig, link, 1), Vec::<Vec<u8>>::new(), "no force has been measured yet");
    (rig, link)
}

/// The controller sends something.
fn says(rig: &mut Rig, by: By, link: LinkId) {
    match by {
        By::Frames => rig.link_bytes(link, &[255, 255, 0, 0, 128, 63, 254, 254]),
        By::Packets => rig.link_bytes(LinkId::STATE, &[0; 1468]),
        By::Connection | By::Nothing => {}
    }
}

/// Time passes while the controller goes on sending.
fn live(rig: &mut Rig, by: By, link: LinkId, millis: u64) {
    for _ in 0..millis / 100 {
        says(rig, by, link);
        rig.run(MS(100));
    }
}

fn frame(force: f32, bits: u8) -> Vec<u8> {
    [&[255, 255][..], &force.to_le_bytes(), &[bits, 238, 238]].concat()
}

fn measures(rig: &mut Rig, force: f32) {
    rig.bytes(SENSOR, &[&[255, 255][..], &force.to_le_bytes(), &[238, 238]].concat());
}

/// The buttons' next frame; what goes up.
fn press(rig: &mut Rig, link: LinkId, bits: u8) -> Vec<Vec<u8>> {
    rig.log.clear();
    rig.bytes(BUTTONS, &[255, 255, bits, 238, 238]);
    rig.sent_on(link)
}

/// The sensor has measured once and been silent for a while.
fn held(by: By) -> (Rig, LinkId) {
    let (mut rig, link) = cell(by);
    measures(&mut rig, 7.5);
    assert_eq!(rig.sent_on(link), [frame(7.5, 1)]);
    live(&mut rig, by, link, 2_000);
    (rig, link)
}

#[test]
fn it_goes_along_while_the_controller_has_it() {
    for by in [By::Connection, By::Frames, By::Packets] {
        let (mut rig, link) = held(by);
        assert_eq!(press(&mut rig, link, 3), [frame(7.5, 3)]);
        live(&mut rig, by, link, 60_000);
        assert_eq!(press(&mut rig, link, 1), [frame(7.5, 1)]);
    }
}

#[test]
fn where_nothing_tells_that_the_controller_is_there_it_does_not() {
    let (mut rig, link) = held(By::Nothing);
    assert_eq!(press(&mut rig, link, 3), Vec::<Vec<u8>>::new());
    assert_eq!(rig.counters(BUTTONS).withheld, 2, "before the first force, and now");
    measures(&mut rig, 2.5);
    assert_eq!(rig.sent_on(link), [frame(2.5, 3)], "its owner is back");
}

#[test]
fn a_controller_that_was_silent_may_have_begun_anew() {
    for by in [By::Frames, By::Packets] {
        for (silence, goes) in [(499, true), (500, true), (501, false), (5_000, false)] {
            let (mut rig, link) = held(by);
            says(&mut rig, by, link);
            rig.run(MS(silence));
            let expected = if goes { vec![frame(7.5, 3)] } else { vec![] };
            assert_eq!(press(&mut rig, link, 3), expected, "in the silence of {silence} ms");
            says(&mut rig, by, link);
            let expected = if goes { vec![frame(7.5, 1)] } else { vec![] };
            assert_eq!(press(&mut rig, link, 1), expected, "after the silence of {silence} ms");
            live(&mut rig, by, link, 10_000);
            measures(&mut rig, 2.5);
            assert!(rig.sent_on(link).contains(&frame(2.5, 1)));
        }
    }
}

#[test]
fn a_recipe_link_that_came_up_leads_to_a_controller_that_has_nothing() {
    for by in [By::Connection, By::Frames] {
        let (mut rig, link) = held(by);
        rig.input(Input::LinkDown { link });
        live(&mut rig, By::Nothing, link, 200);
        says(&mut rig, by, link);
        assert_eq!(rig.link(link).state.name(), "up");
        assert_eq!(press(&mut rig, link, 3), Vec::<Vec<u8>>::new());
        measures(&mut rig, 2.5);
        assert_eq!(rig.sent_on(link), [frame(2.5, 3)]);
    }
}

#[test]
fn a_value_that_never_got_to_the_controller_is_not_delivered_later() {
    let (mut rig, link) = cell(By::Frames);
    rig.run(MS(1_000));
    // The controller is off: it sends nothing.
    measures(&mut rig, 7.5);
    rig.run(MS(5_000));
    rig.log.clear();
    live(&mut rig, By::Frames, link, 1_000);
    assert_eq!(press(&mut rig, link, 3), Vec::<Vec<u8>>::new());
}

#[test]
fn other_links_that_come_and_go_change_nothing() {
    let (mut rig, link) = held(By::Packets);
    rig.input(Input::LinkDown { link: LinkId::STATE });
    rig.run(MS(150));
    assert_eq!(rig.link(LinkId::STATE).state.name(), "up");
    assert_eq!(press(&mut rig, link, 3), [frame(7.5, 3)], "the last packet is not 500 ms old");
    says(&mut rig, By::Packets, link);
    assert_eq!(press(&mut rig, link, 1), [frame(7.5, 1)]);
}

#[test]
fn a_value_that_waited_for_its_neighbours_in_vain_is_not_sent_later() {
    let mut cell = Cell::new();
    let sensor = cell.stream(&["ForceEnd[1]"], &[]);
    cell.rs485(sensor);
    let buttons = cell.stream(&["DigitalOutputCommand[1]"], &[]);
    cell.rs485(buttons);
    let up = cell.stream(&["ForceEnd[1]", "DigitalOutputCommand[1]"], &["RobotState[26]"]);
    cell.recipe_link(up);
    let mut rig = cell.rig();
    rig.run(MS(10));
    // No bit is known, and none comes from the controller: the force is never handed over.
    live(&mut rig, By::Frames, UDP, 1_000);
    measures(&mut rig, 7.5);
    live(&mut rig, By::Frames, UDP, 60_000);
    assert_eq!(press(&mut rig, UDP, 3), Vec::<Vec<u8>>::new());
    measures(&mut rig, 2.5);
    assert_eq!(rig.sent_on(UDP), [frame(2.5, 3)]);
}

#[test]
fn frames_or_packets_either_of_them_is_enough() {
    let mut cell = Cell::new();
    let sensor = cell.stream(&["ForceEnd[1]"], &[]);
    cell.rs485(sensor);
    let buttons = cell.stream(&["DigitalOutputCommand[1]"], &["RobotState[8]"]);
    cell.rs485(buttons);
    cell.last_port().timeout = MS(60_000);
    let up = cell.stream(&["ForceEnd[1]", "DigitalOutputCommand[1]"], &["RobotState[26]"]);
    cell.recipe_link(up);
    let mut rig = cell.rig();
    rig.run(MS(10));
    says(&mut rig, By::Frames, UDP);
    press(&mut rig, UDP, 1);
    measures(&mut rig, 7.5);
    for by in [By::Frames, By::Packets, By::Frames, By::Packets] {
        live(&mut rig, by, UDP, 1_500);
        assert_eq!(press(&mut rig, UDP, 3), [frame(7.5, 3)], "the other was silent, this one was not");
    }
}
