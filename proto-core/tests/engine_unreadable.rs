//! What cannot be read is unknown: a value that is not finite is neither shown nor written back, and
//! the rest of its packet counts (docs/engine.md section 3).

mod rig;

use heapless::String;
use proto_core::config::*;
use proto_core::engine::{LinkId, PortId};
use proto_core::recipe::model::Mode;
use proto_core::wire::scalar::{Scalar, ScalarType};
use rig::*;

const STATE: LinkId = LinkId::STATE;
const UDP: LinkId = LinkId::RECIPE_UDP;
const WRONG: [f32; 4] = [f32::NAN, f32::INFINITY, f32::NEG_INFINITY, -f32::NAN];

/// A state packet with the first two of the pose, and FloatInputReg[1] and [2].
fn packet(pose: [f32; 2], registers: [f32; 2]) -> Vec<u8> {
    let mut packet = vec![0; 1468];
    for (at, value) in [368, 372, 832, 836].into_iter().zip([pose, registers].concat()) {
        packet[at..at + 4].copy_from_slice(&value.to_le_bytes());
    }
    packet
}

fn good(pose: [f32; 2]) -> Vec<u8> {
    packet(pose, [0.0; 2])
}

fn down(values: &[f32]) -> Vec<u8> {
    let values = values.iter().flat_map(|value| value.to_le_bytes());
    [255, 255].into_iter().chain(values).chain([254, 254]).collect()
}

fn up(values: &[f32]) -> Vec<u8> {
    let values = values.iter().flat_map(|value| value.to_le_bytes());
    [255, 255].into_iter().chain(values).chain([238, 238]).collect()
}

#[track_caller]
fn stale(rig: &Rig, port: PortId) -> u32 {
    rig.counters(port).stale_cycles
}

/// Two displays: one of both values, one of the second alone.
fn displays(on_stale: OnStale) -> (Rig, PortId, PortId) {
    let mut cell = Cell::new();
    let recipe = cell.stream(&[], &["RobotState[8..9]"]);
    cell.last_recipe().on_stale = on_stale;
    let both = cell.rs485(recipe);
    let recipe = cell.stream(&[], &["RobotState[9]"]);
    cell.last_recipe().on_stale = on_stale;
    let second = cell.rs485(recipe);
    let mut rig = cell.rig();
    rig.run(MS(10));
    (rig, both, second)
}

#[test]
fn in_a_state_packet_it_is_unknown_until_it_can_be_read() {
    for on_stale in [OnStale::Hold, OnStale::Stop] {
        for wrong in WRONG {
            let (mut rig, both, second) = displays(on_stale);
            rig.link_bytes(STATE, &good([1.0, 2.0]));
            rig.run(MS(8));
            assert_eq!(rig.sent_to(both), [down(&[1.0, 2.0]), down(&[1.0, 2.0])]);
            rig.sent_to(second);
            let before = stale(&rig, both);
            rig.link_bytes(STATE, &good([wrong, 3.0]));
            let image = rig.engine.image();
            assert!(!image.is_known(var("RobotState[8]")) && image.is_known(var("RobotState[9]")));
            assert_eq!(image.age(var("RobotState[8]"), rig.now), None, "not young, and not old");
            assert_eq!(image.age(var("RobotState[9]"), rig.now), Some(MS(0)));
            rig.run(MS(40));
            assert!(rig.sent_to(both).is_empty(), "{on_stale:?}: it is unknown, held or not");
            assert_eq!(stale(&rig, both), before + 10);
            assert_eq!(rig.sent_to(second), vec![down(&[3.0]); 10], "the rest of the packet counts");
            rig.link_bytes(STATE, &good([4.0, 5.0]));
            rig.run(MS(4));
            assert_eq!(rig.sent_to(both), [down(&[4.0, 5.0])], "and it is back");
            let counters = rig.link(STATE).counters;
            assert_eq!((counters.received, counters.unreadable, counters.malformed), (3, 1, 0));
        }
    }
}

#[test]
fn in_the_first_packet_it_was_never_known() {
    let (mut rig, both, second) = displays(OnStale::Hold);
    for _ in 0..5 {
        rig.link_bytes(STATE, &good([f32::NAN, 3.0]));
        rig.run(MS(100));
    }
    assert!(rig.sent_to(both).is_empty());
    assert_eq!(rig.sent_to(second).len(), 125);
    assert_eq!(rig.link(STATE).counters.unreadable, 5);
    assert_eq!(rig.engine.image().value(var("RobotState[8]")), Scalar::Float(0.0), "not half of it");
    rig.link_bytes(STATE, &good([1.0, 2.0]));
    rig.run(MS(4));
    assert_eq!(rig.sent_to(both), [down(&[1.0, 2.0])]);
}

#[test]
fn each_value_is_counted_once() {
    let (mut rig, both, second) = displays(OnStale::Hold);
    rig.link_bytes(STATE, &packet([f32::NAN, f32::NAN], [f32::NAN, f32::NAN]));
    assert_eq!(rig.link(STATE).counters.unreadable, 2, "of those that are used");
    rig.run(MS(40));
    assert!(rig.sent_to(both).is_empty() && rig.sent_to(second).is_empty());
}

#[test]
fn another_connection_does_not_make_it_known() {
    let (mut rig, both, _) = displays(OnStale::Hold);
    rig.link_bytes(STATE, &good([1.0, 2.0]));
    rig.link_bytes(STATE, &good([f32::NAN, 2.0]));
    rig.sent_to(both);
    rig.input(proto_core::engine::Input::LinkDown { link: STATE });
    rig.run(MS(1_000));
    assert_eq!(rig.link(STATE).state.name(), "up");
    assert!(rig.sent_to(both).is_empty());
}

#[test]
fn a_misaligned_packet_changes_nothing() {
    let (mut rig, both, _) = displays(OnStale::Hold);
    rig.link_bytes(STATE, &good([1.0, 2.0]));
    let mut bad = good([f32::NAN, 3.0]);
    for joint in bad[..12].chunks_mut(4) {
        joint.copy_from_slice(&f32::NAN.to_le_bytes());
    }
    rig.link_bytes(STATE, &bad);
    rig.sent_to(both);
    rig.run(MS(8));
    assert_eq!(rig.sent_to(both), vec![down(&[1.0, 2.0]); 2]);
    let counters = rig.link(STATE).counters;
    assert_eq!((counters.malformed, counters.unreadable), (1, 0));
}

#[test]
fn a_joint_that_cannot_be_read_is_unknown_too() {
    let mut cell = Cell::new();
    let recipe = cell.stream(&[], &["RobotState[1]"]);
    let first = cell.rs485(recipe);
    let recipe = cell.stream(&[], &["RobotState[2]"]);
    let second = cell.rs485(recipe);
    let mut rig = cell.rig();
    rig.run(MS(10));
    let mut packet = good([0.0; 2]);
    packet[..4].copy_from_slice(&f32::NAN.to_le_bytes());
    packet[4..8].copy_from_slice(&0.5_f32.to_le_bytes());
    rig.link_bytes(STATE, &packet);
    rig.run(MS(4));
    assert!(rig.sent_to(first).is_empty());
    assert_eq!(rig.sent_to(second), [down(&[0.5])]);
    let counters = rig.link(STATE).counters;
    assert_eq!((counters.received, counters.unreadable, counters.malformed), (1, 1, 0));
}

#[test]
fn on_a_can_port_the_whole_cycle_waits() {
    let mut cell = Cell::new();
    let recipe = cell.can(&[], &[(1, &["RobotState[8]"]), (2, &["RobotState[9]"])]);
    let port = cell.can_port(recipe);
    let mut rig = cell.rig();
    rig.run(MS(10));
    rig.link_bytes(STATE, &good([1.0, f32::NAN]));
    rig.run(MS(40));
    assert!(rig.can_sent_to(port).is_empty());
    rig.link_bytes(STATE, &good([1.0, 2.0]));
    rig.run(MS(4));
    assert_eq!(rig.can_sent_to(port).len(), 2);
}

// Triggers.

/// Sends a variable in thousandths.
fn lamp(cell: &mut Cell, name: &str, send: SendOn) -> PortId {
    let millis = OutputBinding::Variable { var: var(name), scale: 1_000.0, offset: 0.0 };
    let fields = cell.fields([user_out(ScalarType::Short, millis)]);
    let output = cell.part(&[1], &[2], fields);
    let fields = cell.fields([user_in(ScalarType::Byte, InputBinding::Unused)]);
    let input = cell.part(&[255, 255], &[238, 238], fields);
    let recipe = cell.recipe(Mode::User, Parts::Stream { input, output });
    cell.last_recipe().send = send;
    cell.rs485(recipe)
}

#[test]
fn a_frame_that_asks_for_it_is_not_answered() {
    let mut cell = Cell::new();
    let port = lamp(&mut cell, "RobotState[8]", SendOn::Frame);
    let mut rig = cell.rig();
    rig.run(MS(10));
    rig.link_bytes(STATE, &good([f32::NAN, 0.0]));
    rig.bytes(port, &[255, 255, 9, 238, 238]);
    rig.run(MS(100));
    assert!(rig.sent_to(port).is_empty());
    assert_eq!(stale(&rig, port), 1);
    rig.link_bytes(STATE, &good([0.5, 0.0]));
    rig.run(MS(100));
    assert!(rig.sent_to(port).is_empty(), "nor later");
    rig.bytes(port, &[255, 255, 9, 238, 238]);
    assert_eq!(rig.sent_to(port), [[1, 0xF4, 1, 2]]);
}

#[test]
fn a_bit_that_rises_with_it_has_risen() {
    let mut cell = Cell::new();
    let trigger = SendOn::Rising { var: var("DigitalSignalStatus[7]"), bit: 0 };
    let blind = lamp(&mut cell, "RobotState[8]", trigger);
    let fields = cell.fields([user_out(ScalarType::Byte, OutputBinding::Counter)]);
    let output = cell.part(&[1], &[2], fields);
    let recipe = cell.recipe(Mode::User, Parts::Stream { input: None, output });
    cell.last_recipe().send = trigger;
    let counts = cell.rs485(recipe);
    // The trigger comes with the value, in the recipe link's frames.
    let link = cell.stream(&[], &["DigitalSignalStatus[7]", "RobotState[8]"]);
    cell.recipe_link(link);
    let mut rig = cell.rig();
    rig.run(MS(10));
    let frame = |bit: u8, pose: f32| [&[255, 255, bit][..], &pose.to_le_bytes(), &[254, 254]].concat();
    rig.link_bytes(UDP, &frame(0, 0.5));
    rig.link_bytes(UDP, &frame(1, f32::NAN));
    assert_eq!(rig.sent_to(counts), [[1, 0, 2]], "what can be read counts");
    assert!(rig.sent_to(blind).is_empty());
    assert_eq!(stale(&rig, blind), 1);
    rig.link_bytes(UDP, &frame(1, 0.5));
    assert!(rig.sent_to(blind).is_empty(), "it has risen before");
    rig.link_bytes(UDP, &frame(0, 0.5));
    rig.link_bytes(UDP, &frame(1, 0.25));
    assert_eq!(rig.sent_to(blind), [[1, 250, 0, 2]]);
}

#[test]
fn a_change_is_told_when_it_can_be_read_again() {
    let mut cell = Cell::new();
    let port = lamp(&mut cell, "RobotState[8]", SendOn::Change);
    let mut rig = cell.rig();
    rig.run(MS(10));
    rig.link_bytes(STATE, &good([0.5, 0.0]));
    rig.run(MS(8));
    assert_eq!(rig.sent_to(port), [[1, 0xF4, 1, 2]]);
    rig.link_bytes(STATE, &good([f32::NAN, 0.0]));
    rig.run(MS(40));
    assert!(rig.sent_to(port).is_empty());
    rig.link_bytes(STATE, &good([0.25, 0.0]));
    rig.run(MS(8));
    assert_eq!(rig.sent_to(port), [[1, 250, 0, 2]]);
}

// Frames of recipe links.

/// A display of both values, one of the second alone, from a recipe link.
fn by_recipe_link(tcp: bool) -> (Rig, LinkId, PortId, PortId) {
    let mut cell = Cell::new();
    let recipe = cell.stream(&[], &["RobotState[26..27]"]);
    let mut link = UDP;
    if tcp {
        let listen = String::try_from("0.0.0.0:50000").unwrap();
        link = LinkId::of_port(cell.port(Bus::TcpListen { listen }, recipe));
    } else {
        cell.recipe_link(recipe);
    }
    let recipe = cell.stream(&[], &["RobotState[26..27]"]);
    let both = cell.rs485(recipe);
    let recipe = cell.stream(&[], &["RobotState[27]"]);
    let second = cell.rs485(recipe);
    let mut rig = cell.rig();
    rig.run(MS(10));
    (rig, link, both, second)
}

#[test]
fn in_a_frame_of_a_recipe_link_it_is_unknown_and_the_rest_counts() {
    for tcp in [false, true] {
        for wrong in WRONG {
            let (mut rig, link, both, second) = by_recipe_link(tcp);
            rig.link_bytes(link, &down(&[wrong, 2.0]));
            rig.run(MS(4));
            assert!(rig.sent_to(both).is_empty(), "the first one");
            assert_eq!(rig.sent_to(second), [down(&[2.0])]);
            rig.link_bytes(link, &down(&[1.0, 2.0]));
            rig.run(MS(4));
            assert_eq!(rig.sent_to(both), [down(&[1.0, 2.0])]);
            rig.sent_to(second);
            rig.link_bytes(link, &down(&[wrong, wrong]));
            rig.run(MS(400));
            assert!(rig.sent_to(both).is_empty() && rig.sent_to(second).is_empty());
            rig.link_bytes(link, &down(&[wrong, 7.0]));
            rig.run(MS(4));
            assert!(rig.sent_to(both).is_empty());
            assert_eq!(rig.sent_to(second), [down(&[7.0])]);
            rig.link_bytes(link, &down(&[6.0, 7.0]));
            rig.run(MS(4));
            assert_eq!(rig.sent_to(both), [down(&[6.0, 7.0])]);
            let counters = rig.link(link).counters;
            assert_eq!((counters.received, counters.unreadable, counters.malformed), (5, 4, 0));
        }
    }
}

#[test]
fn a_recipe_link_whose_values_cannot_be_read_is_not_silent() {
    let (mut rig, link, _, _) = by_recipe_link(true);
    for _ in 0..100 {
        rig.link_bytes(link, &down(&[f32::NAN, 2.0]));
        rig.run(MS(100));
    }
    assert_eq!((rig.link(link).history.silences, rig.link(link).history.losses), (0, 0));
}

// Neighbours that are read back.

/// FloatInputReg[1] from a device, [2] as it was read back.
fn with_a_neighbour() -> (Rig, PortId) {
    let mut cell = Cell::new();
    let link = cell.stream(&["FloatInputReg[1..2]"], &[]);
    cell.recipe_link(link);
    let recipe = cell.stream(&["FloatInputReg[1]"], &[]);
    let port = cell.rs485(recipe);
    let mut rig = cell.rig();
    rig.run(MS(10));
    (rig, port)
}

#[test]
fn a_neighbour_that_cannot_be_read_is_not_written_back() {
    for wrong in WRONG {
        let (mut rig, port) = with_a_neighbour();
        let registers = |second: f32| packet([0.0; 2], [0.0, second]);
        rig.link_bytes(STATE, &registers(wrong));
        rig.bytes(port, &up(&[1.0]));
        assert!(rig.sent_on(UDP).is_empty(), "never known");
        assert_eq!(rig.counters(port).withheld, 1);
        rig.link_bytes(STATE, &registers(7.0));
        assert_eq!(rig.sent_on(UDP), [up(&[1.0, 7.0])], "what waited goes now");
        rig.link_bytes(STATE, &registers(wrong));
        rig.bytes(port, &up(&[2.0]));
        assert!(rig.sent_on(UDP).is_empty(), "7 may not be true any more");
        assert_eq!(rig.counters(port).withheld, 2);
        rig.run(MS(50));
        rig.link_bytes(STATE, &registers(8.0));
        assert_eq!(rig.sent_on(UDP), [up(&[2.0, 8.0])]);
        assert_eq!(rig.link(STATE).counters.unreadable, 2);
    }
}

#[test]
fn what_its_owner_sends_need_not_be_readable() {
    let (mut rig, port) = with_a_neighbour();
    rig.link_bytes(STATE, &packet([0.0; 2], [f32::NAN, 7.0]));
    assert_eq!(rig.link(STATE).counters.unreadable, 1, "its owner has not sent it yet");
    rig.bytes(port, &up(&[1.0]));
    assert_eq!(rig.sent_on(UDP), [up(&[1.0, 7.0])]);
    rig.link_bytes(STATE, &packet([0.0; 2], [f32::NAN, 8.0]));
    rig.bytes(port, &up(&[2.0]));
    assert_eq!(rig.sent_on(UDP), [up(&[2.0, 8.0])], "its owner is there");
    assert_eq!(rig.link(STATE).counters.unreadable, 1);
    // Its owner is silent and the packet unreadable: it is unknown.
    rig.run(MS(100));
    rig.link_bytes(STATE, &packet([0.0; 2], [f32::NAN, 8.0]));
    assert_eq!(rig.link(STATE).counters.unreadable, 2);
    assert!(rig.sent_on(UDP).is_empty());
}

#[test]
fn a_neighbour_that_a_port_shows_is_counted_once() {
    let mut cell = Cell::new();
    let link = cell.stream(&["FloatInputReg[1..2]"], &[]);
    cell.recipe_link(link);
    let recipe = cell.stream(&["FloatInputReg[1]"], &[]);
    let port = cell.rs485(recipe);
    let shows = lamp(&mut cell, "FloatInputReg[2]", SendOn::Period);
    let mut rig = cell.rig();
    rig.run(MS(10));
    rig.link_bytes(STATE, &packet([0.0; 2], [0.0, f32::NAN]));
    rig.bytes(port, &up(&[1.0]));
    rig.run(MS(8));
    assert!(rig.sent_on(UDP).is_empty() && rig.sent_to(shows).is_empty());
    assert_eq!(rig.link(STATE).counters.unreadable, 1);
    rig.link_bytes(STATE, &packet([0.0; 2], [0.0, 0.5]));
    rig.run(MS(4));
    assert_eq!((rig.sent_on(UDP), rig.sent_to(shows)), (vec![up(&[1.0, 0.5])], vec![vec![1, 0xF4, 1, 2]]));
}

#[test]
fn a_field_frame_is_still_rejected_whole() {
    let (mut rig, port) = with_a_neighbour();
    rig.link_bytes(STATE, &packet([0.0; 2], [0.0, 7.0]));
    rig.bytes(port, &up(&[1.0]));
    rig.sent_on(UDP);
    rig.bytes(port, &up(&[f32::NAN]));
    assert!(rig.sent_on(UDP).is_empty());
    let image = rig.engine.image();
    assert!(image.is_known(var("FloatInputReg[1]")), "what its owner sent before is still known");
    assert_eq!(image.value(var("FloatInputReg[1]")), Scalar::Float(1.0));
    assert_eq!(rig.counters(port).rejected_not_finite, 1);
}
