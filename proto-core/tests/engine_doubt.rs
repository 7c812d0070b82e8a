//! A late packet may seem to confirm a safe value; a newer one that shows another value soon after
//! withdraws the confirmation (docs/engine.md section 6).

mod rig;

use proto_core::engine::{LinkId, PortId};
use rig::*;

const UDP: LinkId = LinkId::RECIPE_UDP;
const SAFE: [u8; 5] = [255, 255, 4, 238, 238];
/// The coil of DigitalSignalStatus[4] that shows bit 2 of DigitalOutputCommand[1], set by its safe value.
const SHOWN: usize = 194;

/// DigitalOutputCommand[1] goes up by UDP 2011; DigitalSignalStatus[4] comes by Modbus or the same way.
/// The owner is silent.
fn silent(by: LinkId) -> Rig {
    let mut cell = Cell::new();
    let witness = ["DigitalSignalStatus[4]"];
    let up = cell.stream(&["DigitalOutputCommand[1]"], if by == UDP { &witness } else { &[] });
    cell.recipe_link(up);
    let recipe = cell.stream(&["DigitalOutputCommand[1]"], &[]);
    cell.rs485(recipe);
    cell.safe("DigitalOutputCommand[1]", 4.0);
    if by == LinkId::MODBUS {
        let recipe = cell.stream(&[], &witness);
        cell.rs485(recipe);
    }
    let mut rig = cell.rig();
    rig.run(MS(10));
    shows(&mut rig, by, 1);
    rig.bytes(PortId(0), &[255, 255, 1, 238, 238]);
    for _ in 0..100 {
        rig.run(MS(4));
        shows(&mut rig, by, 1);
    }
    rig.log.clear();
    rig
}

/// The controller shows these bits from now on.
fn shows(rig: &mut Rig, by: LinkId, bits: u8) {
    if by == UDP {
        rig.link_bytes(UDP, &[255, 255, bits, 254, 254]);
    } else {
        (rig.map.coils[SHOWN - 2], rig.map.coils[SHOWN]) = (bits & 1 == 1, bits & 4 == 4);
    }
}

/// Time passes while the controller shows these bits; returns how many frames went up.
fn sent_in(rig: &mut Rig, by: LinkId, bits: u8, millis: u64) -> usize {
    rig.log.clear();
    for _ in 0..millis / 4 {
        shows(rig, by, bits);
        rig.run(MS(4));
    }
    let sent = rig.sent_on(UDP);
    assert!(sent.iter().all(|frame| *frame == SAFE || *frame == [0]), "{sent:?}");
    sent.iter().filter(|frame| **frame == SAFE).count()
}

#[test]
fn a_witness_that_shows_otherwise_soon_after_takes_it_back() {
    for by in [UDP, LinkId::MODBUS] {
        let mut rig = silent(by);
        assert_eq!(sent_in(&mut rig, by, 1, 40), 10, "not there yet");
        // What was late: the value of before was the same.
        sent_in(&mut rig, by, 4, 200);
        assert_eq!(sent_in(&mut rig, by, 4, 400), 0, "it is there, so it seems");
        let again = sent_in(&mut rig, by, 1, 400);
        assert!((97..=101).contains(&again), "{again}: it is not");
        sent_in(&mut rig, by, 4, 40);
        assert_eq!(sent_in(&mut rig, by, 4, 400), 0);
    }
}

#[test]
fn long_after_it_is_another_masters_doing() {
    for by in [UDP, LinkId::MODBUS] {
        let mut rig = silent(by);
        sent_in(&mut rig, by, 4, 4_000);
        assert_eq!(sent_in(&mut rig, by, 1, 400), 0);
    }
}

#[test]
fn the_owner_who_is_back_is_not_doubted() {
    for by in [UDP, LinkId::MODBUS] {
        let mut rig = silent(by);
        sent_in(&mut rig, by, 4, 400);
        rig.log.clear();
        rig.bytes(PortId(0), &[255, 255, 1, 238, 238]);
        shows(&mut rig, by, 2);
        rig.run(MS(50));
        let sent = rig.sent_on(UDP);
        assert_eq!(sent, [[255, 255, 1, 238, 238]]);
    }
}
