//! Bits with owners: several devices drive different bits of one byte (docs/engine.md section 5).

mod random;
#[path = "../rig/mod.rs"]
mod rig;

use proto_core::config::*;
use proto_core::engine::{LinkId, PortId};
use proto_core::recipe::model::Mode;
use proto_core::sysvar::VarBit;
use proto_core::wire::scalar::{Scalar, ScalarType as T};
use rig::*;

const BYTE: &str = "BitInputReg[3]";
/// The byte's coils in the Modbus map, and its place in the state packet.
const COILS: u16 = 32;
const SHOWN: usize = 1120;
/// The timeout of all ports.
const SILENT: u64 = 100;

fn to_bit(bit: u8) -> FieldSpec {
    user_in(T::Byte, InputBinding::Bit { var: var(BYTE), bit })
}

/// A device whose frame has one byte for each of these bits.
fn device(cell: &mut Cell, bits: &[u8]) -> PortId {
    let fields = cell.fields(bits.iter().map(|&bit| to_bit(bit)));
    let input = cell.part(&[255, 255], &[238, 238], fields);
    let recipe = cell.recipe(Mode::User, Parts::Stream { input, output: None });
    let port = cell.rs485(recipe);
    cell.last_port().timeout = MS(SILENT);
    port
}

fn safe_bit(cell: &mut Cell, bit: u8, on: bool) {
    cell.0.safe_values.push(SafeValue::bit(VarBit { var: var(BYTE), bit }, on)).unwrap();
    cell.last_port().on_timeout.len += 1;
}

fn frame(values: &[u8]) -> Vec<u8> {
    [&[255, 255], values, &[238, 238]].concat()
}

fn written(first: u16, values: &[bool]) -> Written {
    Written::Coils(COILS + first, values.to_vec())
}

/// The byte as the controller's Modbus map has it.
fn robot(rig: &Rig) -> u8 {
    (0..8).fold(0, |byte, bit| byte | u8::from(rig.map.coils[usize::from(COILS) + bit]) << bit)
}

fn set_robot(rig: &mut Rig, byte: u8) {
    for bit in 0..8 {
        rig.map.coils[usize::from(COILS) + bit] = byte >> bit & 1 == 1;
    }
}

/// Two devices on one byte: bits 0 and 1, and bit 4.
fn two(cell: &mut Cell) -> (PortId, PortId) {
    let first = device(cell, &[0, 1]);
    (first, device(cell, &[4]))
}

#[test]
fn by_modbus_each_device_writes_its_own_coils_only() {
    let mut cell = Cell::new();
    let (first, second) = two(&mut cell);
    let mut rig = cell.rig();
    set_robot(&mut rig, 0b1110_1100);
    rig.run(MS(10));
    assert_eq!(rig.take_written(), [], "nothing before the first frame");
    rig.bytes(first, &frame(&[1, 0]));
    assert_eq!(rig.take_written(), [written(0, &[true, false])]);
    rig.bytes(second, &frame(&[7]));
    assert_eq!(rig.take_written(), [written(4, &[true])]);
    rig.bytes(first, &frame(&[0, 1]));
    assert_eq!(rig.take_written(), [written(0, &[false, true])]);
    assert_eq!(robot(&rig), 0b1111_1110, "the other bits stay");
    // An unchanged frame is written all the same: another master may have changed the bit.
    rig.bytes(second, &frame(&[1]));
    assert_eq!(rig.take_written(), [written(4, &[true])]);
}

/// Answers the newest Modbus request.
fn answer(rig: &mut Rig) {
    let request = rig.sent_on(LinkId::MODBUS).pop().expect("a request is in flight");
    let answer = rig.answer(&request);
    rig.link_bytes(LinkId::MODBUS, &answer);
}

#[test]
fn edges_of_both_devices_are_kept_while_a_transaction_is_in_flight() {
    let mut cell = Cell::new();
    let (first, second) = two(&mut cell);
    let mut rig = cell.rig();
    rig.run(MS(10));
    rig.modbus_answers = false;
    for value in [1, 0, 1] {
        rig.bytes(first, &frame(&[value, 0]));
        rig.bytes(second, &frame(&[value ^ 1]));
    }
    for _ in 0..6 {
        answer(&mut rig);
    }
    assert!(rig.sent_on(LinkId::MODBUS).is_empty());
    let of = |from: u16, rig: &Rig| -> Vec<Written> {
        let is_own = |w: &&Written| matches!(w, Written::Coils(at, _) if *at == COILS + from);
        rig.map.written.iter().filter(is_own).cloned().collect()
    };
    assert_eq!(of(0, &rig), [true, false, true].map(|on| written(0, &[on, false])));
    assert_eq!(of(4, &rig), [false, true, false].map(|on| written(4, &[on])));
    assert_eq!(rig.counters(first).edges_lost, 0);
}

#[test]
fn bits_that_are_no_neighbours_take_turns_and_keep_their_edges() {
    let mut cell = Cell::new();
    let port = device(&mut cell, &[0, 7]);
    let mut rig = cell.rig();
    rig.run(MS(10));
    rig.modbus_answers = false;
    for value in [1, 0] {
        rig.bytes(port, &frame(&[value, value]));
    }
    for _ in 0..4 {
        answer(&mut rig);
    }
    let runs = [(0, true), (7, true), (0, false), (7, false)];
    assert_eq!(rig.take_written(), runs.map(|(first, on)| written(first, &[on])));
    // A device that sends faster than Modbus writes does not keep its other bit waiting.
    for nth in 0..6 {
        rig.bytes(port, &frame(&[1, 1]));
        answer(&mut rig);
        let last = rig.take_written().pop();
        assert_eq!(last, Some(written(if nth % 2 == 0 { 0 } else { 7 }, &[true])));
    }
}

#[test]
fn whole_neighbours_are_written_as_ever_beside_bits() {
    let mut cell = Cell::new();
    let (first, _) = two(&mut cell);
    let recipe = cell.stream(&["BitInputReg[2]", "BitInputReg[4..5]"], &[]);
    let whole = cell.rs485(recipe);
    let mut rig = cell.rig();
    rig.run(MS(10));
    rig.modbus_answers = false;
    rig.bytes(whole, &frame(&[1, 2, 3]));
    rig.bytes(first, &frame(&[1, 1]));
    for _ in 0..3 {
        answer(&mut rig);
    }
    let two = [2_u8, 3].iter().flat_map(|byte| (0..8).map(move |bit| byte >> bit & 1 == 1)).collect();
    let expected = [coils(8, 1), written(0, &[true, true]), Written::Coils(40, two)];
    assert_eq!(rig.take_written(), expected);
}

#[test]
fn a_silent_devices_safe_bits_are_written_and_no_others() {
    let mut cell = Cell::new();
    let first = device(&mut cell, &[0, 1, 2]);
    safe_bit(&mut cell, 0, false);
    safe_bit(&mut cell, 2, true);
    let second = device(&mut cell, &[4]);
    let mut rig = cell.rig();
    set_robot(&mut rig, 0b1010_0000);
    rig.run(MS(10));
    rig.bytes(first, &frame(&[1, 1, 0]));
    assert_eq!(robot(&rig), 0b1010_0011);
    rig.take_written();
    for _ in 0..12 {
        rig.run(MS(10));
        rig.bytes(second, &frame(&[1]));
    }
    let others: Vec<_> = rig.take_written().into_iter().filter(|w| *w != written(4, &[true])).collect();
    assert_eq!(others, [written(0, &[false]), written(2, &[true])], "bit 1 holds");
    assert_eq!(robot(&rig), 0b1011_0110);
    assert_eq!(rig.counters(first).timeouts, 1);
    // Its next frame takes over.
    rig.bytes(first, &frame(&[1, 0, 0]));
    assert_eq!(robot(&rig), 0b1011_0001);
}

/// A safe value that was not answered is written again; a value of a frame is not (P2).
#[test]
fn by_modbus_a_safe_bit_is_repeated_until_it_is_answered() {
    let mut cell = Cell::new();
    let (first, _) = two(&mut cell);
    cell.0.ports[0].on_timeout.start = 0;
    cell.0.safe_values.push(SafeValue::bit(VarBit { var: var(BYTE), bit: 1 }, true)).unwrap();
    cell.0.ports[0].on_timeout.len = 1;
    let mut rig = cell.rig();
    rig.run(MS(10));
    rig.bytes(first, &frame(&[1, 0]));
    rig.take_written();
    rig.sent_on(LinkId::MODBUS);
    rig.modbus_answers = false;
    rig.run(MS(SILENT + 1));
    assert_eq!(rig.sent_on(LinkId::MODBUS).len(), 1);
    rig.run(MS(501));
    answer(&mut rig);
    assert_eq!(rig.take_written(), [written(1, &[true])], "written again after the unanswered one");
    rig.run(MS(2_000));
    assert!(rig.sent_on(LinkId::MODBUS).is_empty(), "answered");
    // After the link was lost it is written again.
    rig.modbus_answers = true;
    rig.input(proto_core::engine::Input::LinkDown { link: LinkId::MODBUS });
    rig.run(MS(500));
    assert_eq!(rig.take_written(), [written(1, &[true])]);
    assert_eq!(robot(&rig), 0b11);
}

#[test]
fn a_refused_safe_bit_is_written_again() {
    let mut cell = Cell::new();
    let first = device(&mut cell, &[0]);
    safe_bit(&mut cell, 0, false);
    let mut rig = cell.rig();
    rig.run(MS(10));
    rig.bytes(first, &frame(&[1]));
    rig.take_written();
    rig.map.exception = Some(proto_core::modbus::Exception::IllegalDataAddress);
    rig.run(MS(SILENT + 300));
    rig.map.exception = None;
    rig.run(MS(300));
    assert_eq!(rig.take_written(), [written(0, &[false])]);
}

#[test]
fn what_waited_too_long_or_for_a_lost_link_is_dropped() {
    let mut cell = Cell::new();
    let (first, second) = two(&mut cell);
    let mut rig = cell.rig();
    rig.run(MS(10));
    rig.modbus_answers = false;
    rig.bytes(second, &frame(&[1]));
    rig.bytes(first, &frame(&[1, 1]));
    rig.bytes(first, &frame(&[0, 0]));
    rig.input(proto_core::engine::Input::LinkDown { link: LinkId::MODBUS });
    assert_eq!(rig.counters(first).values_expired, 2);
    rig.bytes(first, &frame(&[1, 1]));
    assert_eq!(rig.counters(first).undelivered, 1);
    rig.map.written.clear();
    rig.modbus_answers = true;
    rig.run(MS(90));
    rig.run(MS(500));
    assert_eq!(rig.take_written(), [], "nothing stale after a reconnect");
}

/// A recipe link that carries the byte and a word.
fn by_udp(cell: &mut Cell) -> (PortId, PortId) {
    let ports = two(cell);
    let up = cell.stream(&[BYTE], &[]);
    cell.recipe_link(up);
    ports
}

fn packet(byte: u8) -> Vec<u8> {
    let mut packet = vec![0; 1468];
    for bit in 0..8 {
        packet[SHOWN + bit] = byte >> bit & 1;
    }
    packet
}

/// The bytes of the frames since the last call.
fn sent(rig: &mut Rig) -> Vec<u8> {
    let frames = rig.sent_on(LinkId::RECIPE_UDP);
    frames.into_iter().filter(|bytes| bytes.len() == 5).map(|bytes| bytes[2]).collect()
}

#[test]
fn by_a_recipe_link_the_other_bits_are_read_back() {
    let mut cell = Cell::new();
    let (first, second) = by_udp(&mut cell);
    let mut rig = cell.rig();
    rig.run(MS(10));
    rig.bytes(first, &frame(&[1, 0]));
    assert_eq!(sent(&mut rig), [0_u8; 0], "the other bits are unknown");
    assert_eq!(rig.counters(first).withheld, 1);
    rig.link_bytes(LinkId::STATE, &packet(0b1001_0010));
    assert_eq!(sent(&mut rig), [0b1001_0001]);
    rig.bytes(second, &frame(&[0]));
    assert_eq!(sent(&mut rig), [0b1000_0001]);
    // The robot's program changes a bit that nobody owns; an older packet does not change ours.
    rig.link_bytes(LinkId::STATE, &packet(0b0101_1110));
    rig.bytes(second, &frame(&[0]));
    assert_eq!(sent(&mut rig), [0b0100_1101]);
    // What was read back grows old.
    rig.run(MS(501));
    rig.bytes(second, &frame(&[1]));
    assert_eq!(sent(&mut rig), [0_u8; 0]);
    rig.link_bytes(LinkId::STATE, &packet(0));
    assert_eq!(sent(&mut rig), [0b0001_0000], "the first device is silent, so its bits were read back");
}

#[test]
fn by_a_recipe_link_edges_are_kept() {
    let mut cell = Cell::new();
    let (first, second) = by_udp(&mut cell);
    let mut rig = cell.rig();
    rig.run(MS(10));
    rig.link_bytes(LinkId::STATE, &packet(0b1000_0000));
    rig.reports_sent = false;
    rig.bytes(second, &frame(&[1]));
    for value in [1, 0, 1] {
        rig.bytes(first, &frame(&[value, 1]));
    }
    for _ in 0..4 {
        rig.input(proto_core::engine::Input::LinkSent { link: LinkId::RECIPE_UDP });
    }
    assert_eq!(sent(&mut rig), [0b1001_0000, 0b1001_0011, 0b1001_0010, 0b1001_0011]);
}

/// Only the safe bits count: the others may be shown as anything (P2).
#[test]
fn by_a_recipe_link_safe_bits_are_repeated_until_they_are_shown() {
    let mut cell = Cell::new();
    let first = device(&mut cell, &[0, 1]);
    safe_bit(&mut cell, 0, false);
    safe_bit(&mut cell, 1, true);
    let second = device(&mut cell, &[4]);
    let up = cell.stream(&[BYTE], &[]);
    cell.recipe_link(up);
    let mut rig = cell.rig();
    rig.run(MS(10));
    rig.link_bytes(LinkId::STATE, &packet(0));
    rig.bytes(first, &frame(&[1, 0]));
    rig.run(MS(SILENT - 1));
    rig.link_bytes(LinkId::STATE, &packet(1));
    rig.bytes(second, &frame(&[1]));
    sent(&mut rig);
    rig.run(MS(1));
    assert_eq!(sent(&mut rig), [0b0001_0010]);
    rig.run(MS(40));
    assert_eq!(sent(&mut rig), [0b0001_0010; 10], "every 4 ms");
    // One of the two bits is there.
    rig.run(MS(160));
    rig.link_bytes(LinkId::STATE, &packet(0b0001_0011));
    sent(&mut rig);
    rig.run(MS(40));
    assert_eq!(sent(&mut rig).len(), 10);
    // Both are; what the other device and nobody drives does not matter.
    rig.link_bytes(LinkId::STATE, &packet(0b1110_0010));
    sent(&mut rig);
    rig.run(MS(40));
    assert_eq!(sent(&mut rig), [0_u8; 0]);
    // Something late overwrote it.
    rig.link_bytes(LinkId::STATE, &packet(0b1110_0011));
    assert_eq!(sent(&mut rig).first(), Some(&0b1110_0010), "the second device is silent by now");
}

#[test]
fn a_byte_has_one_owner_or_its_bits_have() {
    let refused = |make: &dyn Fn(&mut Cell)| {
        let mut cell = Cell::new();
        make(&mut cell);
        let error = cell.0.validate().unwrap_err();
        cell.0.view().describe(error).to_string()
    };
    let twice = refused(&|cell| {
        device(cell, &[0, 1]);
        device(cell, &[1]);
    });
    assert!(twice.contains("BitInputReg[3].1 is written by this port and by"), "{twice}");
    assert!(twice.contains("port0") && twice.contains("port1"), "{twice}");
    for whole_first in [false, true] {
        let whole = |cell: &mut Cell| {
            let recipe = cell.stream(&[BYTE], &[]);
            cell.rs485(recipe);
        };
        let mixed = refused(&|cell| {
            if whole_first {
                whole(cell);
            }
            device(cell, &[5]);
            if !whole_first {
                whole(cell);
            }
        });
        assert!(mixed.contains("one as a whole and one BitInputReg[3].5"), "{mixed}");
        assert!(mixed.contains("port0") && mixed.contains("port1"), "{mixed}");
    }
    let same = refused(&|cell| {
        device(cell, &[3, 3]);
    });
    assert!(same.contains("another field of this recipe already writes BitInputReg[3].3"), "{same}");
    let none = refused(&|cell| {
        device(cell, &[8]);
    });
    assert!(none.contains("BitInputReg[3] has no bit 8; allowed: 0..=7"), "{none}");
    let foreign = refused(&|cell| {
        device(cell, &[3]);
        safe_bit(cell, 4, true);
    });
    assert!(foreign.contains("this port does not write BitInputReg[3].4 by itself"), "{foreign}");
}

#[test]
fn the_status_names_the_owner_of_each_bit() {
    let mut cell = Cell::new();
    let (first, second) = two(&mut cell);
    let mut rig = cell.rig();
    rig.run(MS(10));
    rig.bytes(second, &frame(&[1]));
    let known = |rig: &Rig| -> Vec<(String, Scalar, String)> {
        let status = rig.engine.status(rig.now);
        status.variables().map(|v| (v.name().to_string(), v.value, v.owner.unwrap_or("").into())).collect()
    };
    let of = |bit: u8, on: u8, port: &str| (format!("{BYTE}.{bit}"), Scalar::Byte(on), port.to_owned());
    assert_eq!(known(&rig), [of(4, 1, "port1")]);
    rig.bytes(first, &frame(&[0, 1]));
    assert_eq!(known(&rig), [of(0, 0, "port0"), of(1, 1, "port0"), of(4, 1, "port1")]);
}
