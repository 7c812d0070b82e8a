//! Ports with a device's own frames: checksums, byte orders, bits, constants, digits.

mod rig;

use proto_core::config::*;
use proto_core::device::{Algorithm, Bits, ByteOrder, Checksum, Digits, Encoding, Kind, Overflow, Width};
use proto_core::engine::{Input, PortId, Rejection, ReplyCode};
use proto_core::recipe::model::Mode;
use proto_core::wire::can::{CanFrame, CanId};
use proto_core::wire::scalar::ScalarType as T;
use rig::*;

fn to(name: &str) -> InputBinding {
    InputBinding::Variable { var: var(name), scale: 1.0, offset: 0.0 }
}

fn from(name: &str) -> OutputBinding {
    OutputBinding::Variable { var: var(name), scale: 1.0, offset: 0.0 }
}

fn big(ty: T) -> Encoding {
    Encoding { order: ByteOrder::Big, ..Encoding::scalar(ty) }
}

fn input(encoding: Encoding, to: InputBinding) -> FieldSpec {
    FieldSpec::DeviceInput { encoding, overflow: Overflow::Usual, to }
}

fn output(encoding: Encoding, from: OutputBinding) -> FieldSpec {
    FieldSpec::DeviceOutput { encoding, overflow: Overflow::Usual, from }
}

fn fixed(value: i64) -> FieldSpec {
    FieldSpec::Fixed { encoding: Encoding::scalar(T::Byte), value }
}

fn bits(first: u8, count: u8, shared: bool) -> Encoding {
    let kind = Kind::Bits(Bits { bytes: 1, first, count, signed: false });
    Encoding { kind, order: ByteOrder::Little, shared }
}

fn sum(name: &str) -> FieldSpec {
    FieldSpec::Checksum(Checksum::standard(Algorithm::named(name).unwrap()))
}

/// A port with one frame each way, without head and tail.
fn device(cell: &mut Cell, input: &[FieldSpec], output: &[FieldSpec], send: SendOn) -> PortId {
    let mut part = |fields: &[FieldSpec]| {
        let span = cell.fields(fields.iter().copied());
        (!fields.is_empty()).then(|| cell.part(&[], &[], span)).flatten()
    };
    let parts = Parts::Stream { input: part(input), output: part(output) };
    let recipe = cell.recipe(Mode::User, parts);
    cell.last_recipe().send = send;
    cell.rs485(recipe)
}

/// The gripper of slave 9: its reply has a status byte of bits, and position and current.
fn gripper(cell: &mut Cell) -> PortId {
    let reply = [
        fixed(9),
        fixed(3),
        fixed(6),
        input(bits(0, 1, false), to("WordInputReg[1]")),
        input(bits(4, 2, true), to("WordInputReg[2]")),
        FieldSpec::Padding { len: 3, fill: 0 },
        input(big(T::Word), to("WordInputReg[3]")),
        sum("crc16-modbus"),
    ];
    device(cell, &reply, &[], SendOn::Period)
}

const GOOD: [u8; 9] = [9, 3, 6, 0x31, 0, 0, 0, 1, 66];

#[test]
fn a_reply_with_a_right_checksum_reaches_the_robot() {
    let mut cell = Cell::new();
    let port = gripper(&mut cell);
    let mut rig = cell.rig();
    rig.run(MS(10));
    rig.bytes(port, &with_crc(&GOOD));
    assert_eq!(rig.take_written(), [Written::Registers(8, vec![1, 3, 322])]);
    // However it is cut.
    for byte in with_crc(&GOOD) {
        rig.bytes(port, &[byte]);
    }
    assert_eq!(rig.take_written(), [Written::Registers(8, vec![1, 3, 322])]);
    assert_eq!(rig.counters(port).frames_in, 2);
}

#[test]
fn a_reply_with_a_wrong_checksum_never_does() {
    let mut cell = Cell::new();
    let port = gripper(&mut cell);
    let mut rig = cell.rig();
    rig.run(MS(10));
    let mut wrong = with_crc(&GOOD);
    wrong[8] ^= 0x10;
    rig.bytes(port, &wrong);
    let counters = rig.counters(port);
    assert_eq!((counters.frames_in, counters.rejected_checksum), (0, 1));
    let now = rig.now;
    let last = rig.engine.status(now).ports().next().unwrap().last_rejection.unwrap();
    assert_eq!((last.why, last.bytes()), (Rejection::Checksum, wrong.as_slice()));
    assert_eq!(rig.take_written(), []);
    assert!(!rig.engine.image().is_known(var("WordInputReg[3]")));
    // The next good frame is taken.
    rig.bytes(port, &with_crc(&GOOD));
    assert_eq!(rig.counters(port).frames_in, 1);
    assert_eq!(rig.take_written(), [Written::Registers(8, vec![1, 3, 322])]);
}

#[test]
fn another_slaves_reply_is_not_ours() {
    let mut cell = Cell::new();
    let port = gripper(&mut cell);
    let mut rig = cell.rig();
    rig.run(MS(10));
    let mut other = GOOD;
    other[0] = 8;
    rig.bytes(port, &with_crc(&other));
    rig.bytes(port, &with_crc(&GOOD));
    let counters = rig.counters(port);
    assert_eq!((counters.frames_in, counters.rejected_other_device, counters.resync_bytes), (1, 1, 0));
}

#[test]
fn every_corrupted_bit_of_a_reply_is_found() {
    let mut cell = Cell::new();
    let port = gripper(&mut cell);
    let mut rig = cell.rig();
    rig.run(MS(10));
    let good = with_crc(&GOOD);
    for bit in 0..good.len() * 8 {
        let mut wrong = good.clone();
        wrong[bit / 8] ^= 1 << (bit % 8);
        rig.bytes(port, &wrong);
        rig.run(MS(60));
    }
    assert_eq!(rig.take_written(), []);
    assert_eq!((rig.counters(port).frames_in, rig.counters(port).rejected_checksum), (0, 88));
}

#[test]
fn an_output_frame_has_its_checksum() {
    let mut cell = Cell::new();
    let request = [
        fixed(9),
        fixed(6),
        output(big(T::Word), OutputBinding::Constant(1000.0)),
        output(big(T::Word), OutputBinding::Counter),
        sum("crc16-modbus"),
    ];
    let port = device(&mut cell, &[], &request, SendOn::Period);
    let mut rig = cell.rig();
    rig.run(MS(9));
    let frames = rig.sent_to(port);
    assert_eq!(frames[0], with_crc(&[9, 6, 0x03, 0xE8, 0, 0]));
    assert_eq!(frames[1], with_crc(&[9, 6, 0x03, 0xE8, 0, 1]));
}

#[test]
fn can_frames_of_a_device_are_big_endian_with_bits_and_a_crc() {
    let mut cell = Cell::new();
    let fields = [
        input(big(T::Word), to("WordInputReg[1]")),
        input(bits(0, 4, false), to("WordInputReg[2]")),
        sum("crc8-sae-j1850"),
    ];
    let received = cell.fields(fields);
    let fields = [output(big(T::Word), from("WordOutputReg[1]")), sum("crc8-sae-j1850")];
    let sent = cell.fields(fields);
    let frame = |id, fields| [CanFramePart { id: CanId::Standard(id), fields }].into_iter().collect();
    let parts = Parts::Can { input: frame(0x201, received), output: frame(0x301, sent) };
    let recipe = cell.recipe(Mode::User, parts);
    cell.last_recipe().send = SendOn::Frame;
    let port = cell.can_port(recipe);
    let mut rig = cell.rig();
    rig.map.registers[40] = 0x1234;
    rig.run(MS(50));

    let crc = |bytes: &[u8]| Algorithm::named("crc8-sae-j1850").unwrap().of([bytes]) as u8;
    let data = |bytes: &[u8]| [bytes, &[crc(bytes)]].concat();
    let can = |id, data: &[u8]| CanFrame::new(CanId::Standard(id), data).unwrap();
    rig.can(port, 0x201, &data(&[1, 2, 0xA5]));
    assert_eq!(rig.take_written(), [Written::Registers(8, vec![258, 5])]);
    assert_eq!(rig.can_sent_to(port), [can(0x301, &data(&[0x12, 0x34]))]);

    rig.can(port, 0x201, &[1, 2, 0xA5, 0]);
    rig.can(port, 0x202, &data(&[1, 2, 0xA5]));
    rig.can(port, 0x201, &data(&[1, 2]));
    let frame = CanFrame::remote(CanId::Standard(0x201), 4).unwrap();
    rig.input(Input::PortCan { port, frame });
    let counters = rig.counters(port);
    assert_eq!((counters.frames_in, counters.rejected_checksum, counters.rejected_id), (1, 1, 1));
    assert_eq!((counters.rejected_length, counters.rejected_remote), (1, 1));
    assert_eq!(rig.take_written(), []);
}

#[test]
fn digits_of_a_scale_are_read_and_letters_are_counted() {
    let mut cell = Cell::new();
    let kind = Kind::Decimal(Digits { width: Width::Until(b'k'), decimals: 0 });
    let weight = Encoding { kind, order: ByteOrder::Little, shared: false };
    let grams = InputBinding::Variable { var: var("WordInputReg[1]"), scale: 1000.0, offset: 0.0 };
    let fields = cell.fields([input(weight, grams)]);
    let parts = Parts::Stream { input: cell.part(b"ST,GS,", b"g\r\n", fields), output: None };
    let recipe = cell.recipe(Mode::User, parts);
    let port = cell.rs485(recipe);
    let mut rig = cell.rig();
    rig.run(MS(10));
    rig.bytes(port, b"ST,GS,+  1.234kg\r\n");
    assert_eq!(rig.take_written(), [Written::Registers(8, vec![1234])]);
    rig.bytes(port, b"ST,GS,-------kg\r\nST,GS, 99999kg\r\n");
    let counters = rig.counters(port);
    assert_eq!((counters.frames_in, counters.rejected_unreadable, counters.rejected_out_of_range), (1, 1, 1));
    assert_eq!(rig.take_written(), []);
}

#[test]
fn numbers_wrap_where_asked() {
    let mut cell = Cell::new();
    let shifted = |name| InputBinding::Variable { var: var(name), scale: 1.0, offset: 65_000.0 };
    let field = |overflow, to| FieldSpec::DeviceInput { encoding: Encoding::scalar(T::Word), overflow, to };
    let fields = [fixed(1), field(Overflow::Wrap, shifted("WordInputReg[1]"))];
    let port = device(&mut cell, &fields, &[], SendOn::Period);
    let fields = [fixed(1), field(Overflow::Usual, shifted("WordInputReg[2]"))];
    let strict = device(&mut cell, &fields, &[], SendOn::Period);
    let mut rig = cell.rig();
    rig.run(MS(10));
    rig.bytes(port, &[1, 0xE8, 0x03]);
    rig.bytes(strict, &[1, 0xE8, 0x03]);
    assert_eq!(rig.take_written(), [Written::Registers(8, vec![(66_000_u32 % 65_536) as u16])]);
    assert_eq!(rig.counters(strict).rejected_out_of_range, 1);
}

#[test]
fn one_field_may_be_a_value_and_pick_commands() {
    let mut cell = Cell::new();
    let table = cell.commands(&[(1, "stop")]);
    let commands = InputBinding::Commands { table, when: CommandWhen::Frame };
    let again = Encoding { shared: true, ..big(T::Word) };
    let fields = [fixed(7), input(big(T::Word), to("WordInputReg[1]")), input(again, commands)];
    let port = device(&mut cell, &fields, &[], SendOn::Period);
    let mut rig = cell.rig();
    rig.run(MS(10));
    rig.bytes(port, &[7, 0, 1]);
    assert_eq!(rig.take_written(), [Written::Registers(8, vec![1])]);
    assert_eq!(rig.counters(port).commands, 1);
    assert_ne!(rig.engine.reply_code(port), Some(ReplyCode::None));
}

#[test]
fn silence_ends_a_partial_frame() {
    let mut cell = Cell::new();
    let port = gripper(&mut cell);
    let mut rig = cell.rig();
    rig.run(MS(10));
    rig.bytes(port, &with_crc(&GOOD)[..5]);
    rig.run(MS(60));
    assert_eq!(rig.counters(port).discarded_bytes, 5);
    rig.bytes(port, &with_crc(&GOOD));
    assert_eq!((rig.counters(port).frames_in, rig.counters(port).resync_bytes), (1, 0));
}

#[test]
fn what_a_device_cannot_have_is_refused_with_its_place() {
    let check = |fields: &[FieldSpec]| {
        let mut cell = Cell::new();
        device(&mut cell, fields, &[], SendOn::Period);
        cell.0.validate().map_err(|error| format!("{error}"))
    };
    assert_eq!(check(&[fixed(1), input(big(T::Word), to("WordInputReg[1]"))]), Ok(()));
    let start = "recipe 1, input part";
    for (fields, message) in [
        (vec![fixed(256)], ", field 1: the field cannot have this value"),
        (
            vec![fixed(1), sum("crc8"), input(bits(0, 1, true), InputBinding::Unused)],
            ", field 2: the checksum must stand between two fields, or behind the last one",
        ),
        (
            vec![sum("crc8"), fixed(1)],
            ", field 1: the checksum must cover bytes of head and fields, and not itself",
        ),
    ] {
        assert_eq!(check(&fields), Err(format!("{start}{message}")));
    }
    let wrapping = FieldSpec::DeviceInput {
        encoding: big(T::Word),
        overflow: Overflow::Wrap,
        to: to("FloatInputReg[1]"),
    };
    let message = check(&[fixed(1), wrapping]).unwrap_err();
    assert_eq!(message, format!("{start}, field 2: only integers wrap; this one may have a fraction"));
}

#[test]
fn a_value_that_was_refused_changes_nothing_else() {
    let mut cell = Cell::new();
    let fields =
        [fixed(1), input(big(T::Word), to("WordInputReg[1]")), input(big(T::Float), to("FloatInputReg[1]"))];
    let port = device(&mut cell, &fields, &[], SendOn::Period);
    let link = cell.stream(&["FloatInputReg[1]"], &[]);
    cell.recipe_link(link);
    let mut rig = cell.rig();
    rig.run(MS(10));
    rig.bytes(port, &[&[1, 0, 5][..], &f32::NAN.to_be_bytes()].concat());
    assert_eq!((rig.counters(port).rejected_fields, rig.counters(port).rejected_not_finite), (1, 0));
    assert_eq!(rig.take_written(), [Written::Registers(8, vec![5])]);
    assert!(!rig.engine.image().is_known(var("FloatInputReg[1]")));
}
