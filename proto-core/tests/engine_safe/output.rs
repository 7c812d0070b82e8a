//! Safe values by the recipe link, with an output that shows what the input was set to.

use proto_core::engine::{LinkId, PortId};

use super::rig::*;
use super::{ON, SAFE, UDP, every, falls_silent, live, modbus_and_others, times};

/// DigitalOutputCommand[1] by the recipe link; DigitalSignalStatus[4] comes by Modbus, or the same way.
fn seen_in_an_output(by: LinkId) -> (Rig, PortId) {
    let mut cell = Cell::new();
    let witness = ["DigitalSignalStatus[4]"];
    let up = cell.stream(&["DigitalOutputCommand[1]"], if by == UDP { &witness } else { &[] });
    cell.recipe_link(up);
    let recipe = cell.stream(&["DigitalOutputCommand[1]"], &[]);
    let port = cell.rs485(recipe);
    cell.safe("DigitalOutputCommand[1]", 4.0);
    if by == LinkId::MODBUS {
        let recipe = cell.stream(&[], &witness);
        cell.rs485(recipe);
    }
    let rig = cell.rig();
    assert!(rig.engine.links().all(|link| [UDP, by].contains(&link.id)), "nothing else can show it");
    (rig, port)
}

#[test]
fn it_is_sent_until_a_poll_of_the_outputs_shows_it() {
    let (mut rig, port) = seen_in_an_output(LinkId::MODBUS);
    rig.map.coils[192] = true;
    let due = falls_silent(&mut rig, port, ON);
    rig.run(MS(3_000));
    assert_eq!(times(&mut rig, UDP, due, SAFE), every(4, 0, 2_999));
    (rig.map.coils[192], rig.map.coils[194]) = (false, true);
    rig.run(MS(9));
    rig.log.clear();
    rig.run(MS(5_000));
    assert_eq!(times(&mut rig, UDP, due, SAFE), Vec::<u64>::new());
}

#[test]
fn a_poll_within_200_ms_confirms_nothing() {
    let (mut rig, port) = seen_in_an_output(LinkId::MODBUS);
    rig.map.coils[194] = true;
    let due = falls_silent(&mut rig, port, SAFE);
    rig.run(MS(1_000));
    let times = times(&mut rig, UDP, due, SAFE);
    assert!((200..=208).contains(times.last().unwrap()), "the first poll of 200 ms or later: {times:?}");
}

#[test]
fn it_is_sent_until_a_frame_of_the_recipe_link_shows_it() {
    let (mut rig, port) = seen_in_an_output(UDP);
    let due = falls_silent(&mut rig, port, ON);
    let shows = |bits: u8| [255, 255, bits, 254, 254];
    for _ in 0..500 {
        rig.run(MS(4));
        rig.link_bytes(UDP, &shows(1));
    }
    assert_eq!(times(&mut rig, UDP, due, SAFE), every(4, 0, 1_999));
    rig.link_bytes(UDP, &shows(4));
    for _ in 0..2 {
        rig.run(MS(4));
        rig.link_bytes(UDP, &shows(4));
    }
    rig.log.clear();
    for _ in 0..500 {
        rig.run(MS(4));
        rig.link_bytes(UDP, &shows(4));
    }
    assert_eq!(times(&mut rig, UDP, due, SAFE), Vec::<u64>::new());
}

#[test]
fn a_udp_stream_that_was_silent_comes_from_a_controller_that_was_away() {
    let shows = [255, 255, 4, 254, 254];
    for (silence, is_sent_again) in [(400, false), (500, false), (501, true), (5_000, true)] {
        let (mut rig, port) = seen_in_an_output(UDP);
        rig.run(MS(10));
        rig.link_bytes(UDP, &shows);
        falls_silent(&mut rig, port, ON);
        rig.run(MS(301));
        rig.link_bytes(UDP, &shows);
        rig.run(MS(8));
        rig.link_bytes(UDP, &shows);
        rig.log.clear();
        rig.run(MS(silence));
        let back = rig.now;
        assert_eq!(times(&mut rig, UDP, back, SAFE), Vec::<u64>::new(), "it was there");
        rig.link_bytes(UDP, &shows);
        rig.run(MS(100));
        let expected = if is_sent_again { every(4, 0, 100) } else { vec![] };
        assert_eq!(times(&mut rig, UDP, back, SAFE), expected, "silent for {silence} ms");
    }
}

#[test]
fn a_udp_stream_that_was_away_has_the_modbus_values_written_too() {
    let (mut rig, port) = modbus_and_others();
    let shows = [&[255, 255][..], &1.0_f32.to_le_bytes(), &[254, 254]].concat();
    rig.run(MS(10));
    rig.link_bytes(UDP, &shows);
    falls_silent(&mut rig, port, ON);
    rig.run(MS(1));
    assert_eq!(rig.take_written(), [coils(192, 4)]);
    for _ in 0..10 {
        rig.link_bytes(UDP, &shows);
        live(&mut rig, 300);
    }
    assert_eq!(rig.take_written(), []);
    live(&mut rig, 300);
    rig.link_bytes(UDP, &shows);
    assert_eq!(rig.take_written(), [coils(192, 4)]);
}
