//! Rising bits that trigger a frame, when several frames come at once (docs/engine.md section 8).

mod rig;

use heapless::String;
use proto_core::config::{Bus, OutputBinding, Parts, SendOn};
use proto_core::engine::{LinkId, PortId};
use proto_core::recipe::model::Mode;
use proto_core::wire::scalar::ScalarType;
use rig::*;

/// A port that sends for each rise of a bit, and what it sent.
fn lamp(cell: &mut Cell, name: &str) -> PortId {
    let fields = cell.fields([user_out(ScalarType::Byte, OutputBinding::Counter)]);
    let output = cell.part(&[1], &[2], fields);
    let recipe = cell.recipe(Mode::User, Parts::Stream { input: None, output });
    cell.last_recipe().send = SendOn::Rising { var: var(name), bit: 0 };
    cell.rs485(recipe)
}

#[test]
fn a_bit_that_rises_and_falls_within_one_chunk_has_risen() {
    let mut cell = Cell::new();
    let recipe = cell.stream(&["DigitalOutputCommand[1]"], &[]);
    let switch = cell.rs485(recipe);
    let lamp = lamp(&mut cell, "DigitalOutputCommand[1]");
    let mut rig = cell.rig();
    rig.run(MS(10));
    let frames =
        |bits: &[u8]| bits.iter().flat_map(|&bit| [0xFF, 0xFF, bit, 0xEE, 0xEE]).collect::<Vec<u8>>();
    rig.bytes(switch, &frames(&[0]));
    rig.bytes(switch, &frames(&[0, 1, 0]));
    assert_eq!(rig.sent_to(lamp), [[1, 0, 2]], "it rose between two frames of the chunk");
    rig.bytes(switch, &frames(&[1, 0, 1, 0, 1]));
    assert_eq!(rig.sent_to(lamp), [[1, 1, 2]], "three times at once: the last one is answered");
    assert_eq!(rig.counters(lamp).skipped_cycles, 2, "and the others are counted");
    assert_eq!(rig.counters(switch).frames_in, 9);
    assert_eq!(rig.counters(switch).bytes_in, 45);
}

#[test]
fn a_bit_of_the_controllers_that_rises_and_falls_within_one_chunk_has_risen() {
    let mut cell = Cell::new();
    let up = cell.stream(&[], &["BitOutputReg[3]"]);
    let listen = String::try_from("0.0.0.0:50000").unwrap();
    let tcp = LinkId::of_port(cell.port(Bus::TcpListen { listen }, up));
    let lamp = lamp(&mut cell, "BitOutputReg[3]");
    let mut rig = cell.rig();
    rig.run(MS(10));
    let frames =
        |bits: &[u8]| bits.iter().flat_map(|&bit| [0xFF, 0xFF, bit, 0xFE, 0xFE]).collect::<Vec<u8>>();
    rig.link_bytes(tcp, &frames(&[0, 1, 0])[..13]);
    assert_eq!(rig.sent_to(lamp), [[1, 0, 2]]);
    rig.link_bytes(tcp, &frames(&[0, 1, 0])[13..]);
    assert!(rig.sent_to(lamp).is_empty());
    let counters = rig.link(tcp).counters;
    assert_eq!((counters.received, counters.bytes_in), (3, 15));
}
