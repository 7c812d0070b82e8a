//! Safe values by the recipe link, with a state stream that shows them.

use proto_core::engine::{Input, LinkId, PortId};

use super::rig::*;
use super::{UDP, every, falls_silent, float, floats, packet, times};

/// FloatInputReg[1] from a port, [2] as it was read back; safe: -1.
fn seen_in_the_stream() -> (Rig, PortId) {
    let mut cell = Cell::new();
    let up = cell.stream(&["FloatInputReg[1..2]"], &[]);
    cell.recipe_link(up);
    let recipe = cell.stream(&["FloatInputReg[1]"], &[]);
    let port = cell.rs485(recipe);
    cell.safe("FloatInputReg[1]", -1.0);
    let mut rig = cell.rig();
    rig.run(MS(10));
    rig.link_bytes(LinkId::STATE, &packet(0.0, 7.0));
    (rig, port)
}

#[test]
fn it_is_sent_every_4_ms_until_the_state_stream_shows_it() {
    let (mut rig, port) = seen_in_the_stream();
    let due = falls_silent(&mut rig, port, &float(5.0));
    // The stream goes on showing what was there before, for five seconds.
    for _ in 0..50 {
        rig.run(MS(100));
        rig.link_bytes(LinkId::STATE, &packet(5.0, 7.0));
    }
    let frame = floats(-1.0, 7.0);
    assert_eq!(times(&mut rig, UDP, due, &frame), every(4, 0, 4_999), "however long it takes");
    rig.run(MS(1));
    rig.link_bytes(LinkId::STATE, &packet(-1.0, 7.0));
    rig.log.clear();
    rig.run(MS(10_000));
    assert_eq!(times(&mut rig, UDP, due, &frame), Vec::<u64>::new(), "it is there");
}

#[test]
fn a_value_that_the_stream_soon_shows_no_more_is_sent_again() {
    let (mut rig, port) = seen_in_the_stream();
    falls_silent(&mut rig, port, &float(5.0));
    rig.run(MS(300));
    // A packet that was late on its way, of before the owner's last value.
    rig.link_bytes(LinkId::STATE, &packet(-1.0, 7.0));
    rig.run(MS(100));
    rig.log.clear();
    let now = rig.now;
    rig.link_bytes(LinkId::STATE, &packet(5.0, 7.0));
    rig.run(MS(10));
    assert_eq!(times(&mut rig, UDP, now, &floats(-1.0, 7.0)), every(4, 0, 8));
    rig.link_bytes(LinkId::STATE, &packet(-1.0, 7.0));
    // Much later it is another client that writes.
    for _ in 0..31 {
        rig.run(MS(100));
        rig.link_bytes(LinkId::STATE, &packet(-1.0, 7.0));
    }
    rig.log.clear();
    rig.link_bytes(LinkId::STATE, &packet(9.0, 7.0));
    rig.run(MS(100));
    assert_eq!(times(&mut rig, UDP, now, &[]), Vec::<u64>::new());
}

#[test]
fn a_packet_that_shows_it_within_200_ms_confirms_nothing() {
    let (mut rig, port) = seen_in_the_stream();
    let due = falls_silent(&mut rig, port, &float(-1.0));
    rig.run(MS(200));
    rig.link_bytes(LinkId::STATE, &packet(-1.0, 7.0));
    rig.run(MS(1));
    rig.link_bytes(LinkId::STATE, &packet(-1.0, 7.0));
    rig.run(MS(1_000));
    let frame = floats(-1.0, 7.0);
    assert_eq!(times(&mut rig, UDP, due, &frame), every(4, 0, 200), "199 ms are too soon, 200 are not");
}

#[test]
fn an_unreadable_value_confirms_nothing() {
    let (mut rig, port) = seen_in_the_stream();
    let due = falls_silent(&mut rig, port, &float(5.0));
    rig.run(MS(301));
    rig.link_bytes(LinkId::STATE, &packet(f32::NAN, 7.0));
    rig.run(MS(99));
    assert_eq!(times(&mut rig, UDP, due, &floats(-1.0, 7.0)), every(4, 0, 399));
}

#[test]
fn it_waits_while_its_neighbours_are_unknown() {
    let (mut rig, port) = seen_in_the_stream();
    rig.run(MS(90));
    rig.link_bytes(LinkId::STATE, &packet(0.0, 7.0));
    let due = falls_silent(&mut rig, port, &float(5.0));
    // The newest packet is 110 ms old now.
    rig.run(MS(1_000));
    let frame = floats(-1.0, 7.0);
    assert_eq!(times(&mut rig, UDP, due, &frame), every(4, 0, 390), "read back at most 500 ms ago");
    rig.link_bytes(LinkId::STATE, &packet(0.0, 8.0));
    rig.run(MS(8));
    assert_eq!(times(&mut rig, UDP, due, &floats(-1.0, 8.0)).len(), 3, "at once, and every 4 ms");
}

#[test]
fn it_ends_when_the_owner_is_back() {
    let (mut rig, port) = seen_in_the_stream();
    falls_silent(&mut rig, port, &float(5.0));
    rig.run(MS(51));
    rig.log.clear();
    rig.bytes(port, &float(6.0));
    assert_eq!(rig.sent_on(UDP), [floats(6.0, 7.0)]);
    rig.run(MS(99));
    assert!(rig.sent_on(UDP).is_empty(), "one frame, one frame");
    rig.run(MS(1));
    assert_eq!(rig.sent_on(UDP), [floats(-1.0, 7.0)], "and silent again");
}

#[test]
fn it_is_sent_again_after_each_link_that_came_up_until_it_is_seen_again() {
    for link in [LinkId::STATE, UDP] {
        let (mut rig, port) = seen_in_the_stream();
        falls_silent(&mut rig, port, &float(5.0));
        rig.run(MS(301));
        rig.link_bytes(LinkId::STATE, &packet(-1.0, 7.0));
        rig.run(MS(4));
        rig.log.clear();
        rig.run(MS(100));
        assert!(rig.sent_on(UDP).is_empty(), "it is there");
        rig.input(Input::LinkDown { link });
        rig.run(MS(99));
        assert!(rig.sent_on(UDP).is_empty());
        let up = rig.now + MS(1);
        rig.run(MS(200));
        rig.link_bytes(LinkId::STATE, &packet(-1.0, 7.0));
        rig.run(MS(1));
        rig.link_bytes(LinkId::STATE, &packet(-1.0, 7.0));
        rig.run(MS(500));
        let frame = floats(-1.0, 7.0);
        assert_eq!(times(&mut rig, UDP, up, &frame), every(4, 0, 200), "{link:?} was away");
    }
}

#[test]
fn a_frame_of_a_safe_value_carries_what_the_other_owner_sent_last() {
    let mut cell = Cell::new();
    let up = cell.stream(&["ForceEnd[1..2]"], &[]);
    cell.recipe_link(up);
    let recipe = cell.stream(&["ForceEnd[1]"], &[]);
    let silent = cell.rs485(recipe);
    cell.safe("ForceEnd[1]", -1.0);
    let recipe = cell.stream(&["ForceEnd[2]"], &[]);
    let alive = cell.rs485(recipe);
    let mut rig = cell.rig();
    rig.run(MS(10));
    rig.bytes(alive, &float(1.0));
    let due = falls_silent(&mut rig, silent, &float(5.0));
    for nth in 0..20_u8 {
        rig.bytes(alive, &float(f32::from(nth)));
        rig.run(MS(50));
        let sent = rig.sent_after(UDP, due);
        assert!(sent.len() >= 12, "{}", sent.len());
        let expected = floats(-1.0, f32::from(nth));
        assert!(sent.iter().all(|(at, frame)| *frame == expected || nth == 0 && *at == 0), "{sent:?}");
    }
}
