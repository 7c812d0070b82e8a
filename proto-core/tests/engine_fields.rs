//! Fields of a device's frames that are rejected alone: each grows old on its own, from its own last value.

mod rig;

use proto_core::config::*;
use proto_core::device::{Algorithm, Boundary, Checksum, Encoding, Overflow, Text, TextWidth};
use proto_core::engine::{PortId, PortState, RejectedField, Rejection, VariableStatus};
use proto_core::recipe::model::Mode;
use proto_core::wire::scalar::{Scalar, ScalarType as T};
use rig::*;

fn to(name: &str) -> InputBinding {
    scaled(name, 1.0, 0.0)
}

fn scaled(name: &str, scale: f32, offset: f32) -> InputBinding {
    InputBinding::Variable { var: var(name), scale, offset }
}

fn input(encoding: Encoding, to: InputBinding) -> FieldSpec {
    FieldSpec::DeviceInput { encoding, overflow: Overflow::Usual, to }
}

fn fixed(value: i64) -> FieldSpec {
    FieldSpec::Fixed { encoding: Encoding::scalar(T::Byte), value }
}

fn crc() -> FieldSpec {
    FieldSpec::Checksum(Checksum::standard(Algorithm::named("crc16-modbus").unwrap()))
}

fn short(name: &str) -> FieldSpec {
    input(Encoding::scalar(T::Short).big_endian(), to(name))
}

fn digits(until: u8, name: &str) -> FieldSpec {
    input(Encoding::decimal_until(until), scaled(name, 100.0, 32_768.0))
}

fn device(cell: &mut Cell, head: &[u8], tail: &[u8], fields: &[FieldSpec]) -> PortId {
    let span = cell.fields(fields.iter().copied());
    let mut part = cell.part(head, tail, span);
    if let Some(part) = part.as_mut().filter(|_| !tail.is_empty()) {
        part.framing = Boundary::Tail;
    }
    let recipe = cell.recipe(Mode::User, Parts::Stream { input: part, output: None });
    cell.rs485(recipe)
}

/// Two numbers, at WordInputReg[1] and WordInputReg[3], of a frame that begins with 7 and has a CRC.
fn pair(cell: &mut Cell) -> PortId {
    device(cell, &[], &[], &[fixed(7), short("WordInputReg[1]"), short("WordInputReg[3]"), crc()])
}

fn frame(numbers: &[i16]) -> Vec<u8> {
    let numbers = numbers.iter().flat_map(|number| number.to_be_bytes());
    with_crc(&[7].into_iter().chain(numbers).collect::<Vec<_>>())
}

/// The register of WordInputReg[1].
const FIRST: u16 = 8;
/// That of WordInputReg[3].
const THIRD: u16 = 10;

fn one(register: u16, value: u16) -> Written {
    Written::Registers(register, vec![value])
}

#[track_caller]
fn known(rig: &Rig, name: &str) -> (f64, u64, Option<String>) {
    let of = |known: VariableStatus<'_>| {
        (known.value.as_f64(), known.age.as_millis(), known.owner.map(str::to_owned))
    };
    of(rig.engine.status(rig.now).variable(var(name)).expect("the variable is known"))
}

fn rejected(rig: &Rig) -> Option<(Rejection, Option<RejectedField>)> {
    let status = rig.engine.status(rig.now);
    let port = status.ports().next().unwrap();
    port.last_rejection.map(|last| (last.why, port.rejected_field))
}

#[test]
fn a_rejected_field_costs_the_others_nothing_and_takes_its_own_safe_value() {
    let mut cell = Cell::new();
    let port = pair(&mut cell);
    cell.safe("WordInputReg[1]", 9.0);
    cell.safe("WordInputReg[3]", 65_535.0);
    let mut rig = cell.rig();
    rig.run(MS(10));
    rig.bytes(port, &frame(&[1, 2]));
    assert_eq!(rig.take_written(), [one(FIRST, 1), one(THIRD, 2)]);
    // Every 40 ms a frame; after 100 ms without a value of its own the second field has its safe value.
    let mut written = Vec::new();
    for nth in 0..5 {
        rig.run(MS(40));
        written.extend(rig.take_written());
        rig.bytes(port, &frame(&[10 + nth, -50]));
        written.extend(rig.take_written());
        if nth == 1 {
            assert_eq!(known(&rig, "WordInputReg[3]"), (2.0, 80, Some("port0".into())));
            assert_eq!(known(&rig, "WordInputReg[1]"), (11.0, 0, Some("port0".into())));
        }
    }
    let expected =
        [one(FIRST, 10), one(FIRST, 11), one(THIRD, 65_535), one(FIRST, 12), one(FIRST, 13), one(FIRST, 14)];
    assert_eq!(written, expected);
    assert_eq!(known(&rig, "WordInputReg[3]"), (65_535.0, 200, Some("port0".into())));
    let counters = rig.counters(port);
    assert_eq!((counters.frames_in, counters.rejected_fields, counters.rejected()), (6, 5, 0));
    assert_eq!((counters.timeouts, rig.engine.port_state(port)), (0, Some(PortState::Working)));
    // Its next value ends it.
    rig.bytes(port, &frame(&[20, 5]));
    assert_eq!(rig.take_written(), [one(THIRD, 5), one(FIRST, 20)]);
    assert_eq!(known(&rig, "WordInputReg[3]"), (5.0, 0, Some("port0".into())));
    rig.run(MS(99));
    assert_eq!(rig.take_written(), []);
    rig.run(MS(1));
    assert_eq!(rig.take_written(), [one(THIRD, 65_535), one(FIRST, 9)]);
    assert_eq!(rig.counters(port).timeouts, 1);
}

#[test]
fn the_newest_rejection_names_field_value_and_range() {
    let mut cell = Cell::new();
    let port = pair(&mut cell);
    let mut rig = cell.rig();
    rig.run(MS(10));
    rig.bytes(port, &frame(&[1, -50]));
    let (why, field) = rejected(&rig).unwrap();
    let RejectedField { frame: nth, field, var: of, value, allowed, .. } = field.unwrap();
    assert_eq!((why, nth, field), (Rejection::OutOfRange, 0, 2));
    assert_eq!((of, value, allowed), (Some(var("WordInputReg[3]")), Some(-50.0), Some((0.0, 32_767.0))));
    // Also where nothing of the frame is taken.
    rig.bytes(port, &frame(&[-3, -50]));
    let (_, field) = rejected(&rig).unwrap();
    assert_eq!(field.and_then(|field| field.value), Some(-3.0));
    let counters = rig.counters(port);
    assert_eq!((counters.frames_in, counters.rejected_out_of_range, counters.rejected_fields), (1, 1, 1));
    // What is not about a field names none.
    let mut wrong = frame(&[1, 2]);
    wrong[2] ^= 1;
    rig.run(MS(30));
    rig.bytes(port, &wrong);
    assert_eq!(rejected(&rig), Some((Rejection::Checksum, None)));
}

#[test]
fn without_a_safe_value_it_holds() {
    let mut cell = Cell::new();
    let port = pair(&mut cell);
    let mut rig = cell.rig();
    rig.run(MS(10));
    rig.bytes(port, &frame(&[1, 2]));
    rig.take_written();
    for _ in 0..10 {
        rig.run(MS(40));
        rig.bytes(port, &frame(&[3, -1]));
    }
    let written = rig.take_written();
    assert!(written.iter().all(|write| *write == one(FIRST, 3)) && written.len() == 10, "{written:?}");
    assert_eq!(known(&rig, "WordInputReg[3]").1, 400);
}

#[test]
fn a_field_that_never_had_a_value_counts_from_the_first_frame_without_one() {
    let mut cell = Cell::new();
    let port = pair(&mut cell);
    cell.safe("WordInputReg[3]", 77.0);
    let mut rig = cell.rig();
    rig.run(MS(1_000));
    rig.bytes(port, &frame(&[1, -1]));
    assert_eq!(rig.take_written(), [one(FIRST, 1)]);
    assert!(!rig.engine.image().is_known(var("WordInputReg[3]")));
    rig.run(MS(60));
    rig.bytes(port, &frame(&[1, -1]));
    rig.run(MS(39));
    assert_eq!(rig.take_written(), [one(FIRST, 1)]);
    rig.run(MS(1));
    assert_eq!(rig.take_written(), [one(THIRD, 77)]);
}

#[test]
fn what_waits_of_a_rejected_field_is_not_written_after_its_time() {
    let mut cell = Cell::new();
    let port = pair(&mut cell);
    let mut rig = cell.rig();
    rig.run(MS(10));
    rig.modbus_answers = false;
    rig.bytes(port, &frame(&[1, 2]));
    rig.take_written();
    // The request for the first register has no answer, and what follows waits.
    rig.bytes(port, &frame(&[3, 4]));
    for _ in 0..3 {
        rig.run(MS(40));
        rig.bytes(port, &frame(&[5, -1]));
    }
    assert_eq!(rig.counters(port).values_expired, 1);
}

#[test]
fn letters_among_digits_reject_their_field() {
    let mut cell = Cell::new();
    let fields =
        [digits(b',', "WordInputReg[1]"), digits(b',', "WordInputReg[3]"), digits(b';', "WordInputReg[5]")];
    let port = device(&mut cell, b"M,", b"\r\n", &fields);
    let mut rig = cell.rig();
    rig.run(MS(10));
    rig.bytes(port, b"M,+1.5,-0.25,2;\r\n");
    assert_eq!(rig.take_written().len(), 3);
    rig.bytes(port, b"M,+1.5,-----,3;\r\n");
    assert_eq!(rig.take_written(), [one(FIRST, 32_918), one(THIRD + 2, 33_068)]);
    assert_eq!(
        rejected(&rig).map(|(why, field)| (why, field.unwrap().value)),
        Some((Rejection::Unreadable, None))
    );
    // Over range; the last field is still good.
    rig.bytes(port, b"M,+999.999,-----,4;\r\n");
    assert_eq!(rig.take_written(), [one(THIRD + 2, 33_168)]);
    let allowed = rejected(&rig).unwrap().1.unwrap().allowed.unwrap();
    assert_eq!(allowed, (-327.68, 327.67));
    rig.bytes(port, b"M,x,y,z;\r\n");
    let counters = rig.counters(port);
    assert_eq!((counters.frames_in, counters.rejected_fields, counters.rejected_unreadable), (3, 3, 1));
}

#[test]
fn an_alive_counter_still_rejects_the_frame() {
    let mut cell = Cell::new();
    let counter = input(Encoding::scalar(T::Byte), InputBinding::Counter { max: 255 });
    let fields = [fixed(7), short("WordInputReg[1]"), short("WordInputReg[3]"), counter, crc()];
    let port = device(&mut cell, &[], &[], &fields);
    let mut rig = cell.rig();
    rig.run(MS(10));
    let frame = |count: u8| with_crc(&[7, 0, 1, 0xFF, 0xFF, count]);
    rig.bytes(port, &frame(1));
    rig.bytes(port, &frame(1));
    let counters = rig.counters(port);
    assert_eq!((counters.frames_in, counters.rejected_counter, counters.rejected_fields), (1, 1, 1));
    rig.bytes(port, &frame(2));
    assert_eq!((rig.counters(port).frames_in, rig.counters(port).counter_jumps), (2, 0));
}

#[test]
fn a_command_field_without_a_value_picks_nothing_and_loses_its_base_in_its_time() {
    let mut cell = Cell::new();
    let table = cell.commands(&[(1, "run(a.jspf)"), (2, "run(b.jspf)")]);
    let command = InputBinding::Commands { table, when: CommandWhen::Change };
    let fields = [input(Encoding::decimal_until(b','), command), digits(b';', "WordInputReg[1]")];
    let port = device(&mut cell, b"M,", b"\r\n", &fields);
    let mut rig = cell.rig();
    rig.run(MS(10));
    rig.bytes(port, b"M,0,1;\r\n");
    rig.bytes(port, b"M,1,1;\r\n");
    assert_eq!(rig.counters(port).commands, 1);
    rig.run(MS(50));
    rig.bytes(port, b"M,?,1;\r\n");
    assert_eq!((rig.counters(port).commands, rig.counters(port).rejected_fields), (1, 1));
    // Within its time, the value before is the base.
    rig.bytes(port, b"M,2,1;\r\n");
    assert_eq!(rig.counters(port).commands, 2);
    for _ in 0..3 {
        rig.run(MS(40));
        rig.bytes(port, b"M,?,1;\r\n");
    }
    rig.bytes(port, b"M,1,1;\r\n");
    let counters = rig.counters(port);
    assert_eq!((counters.commands, counters.commands_based, counters.timeouts), (2, 1, 0));
}

#[test]
fn the_bits_of_one_byte_stand_and_fall_together() {
    let mut cell = Cell::new();
    let bit = |bit| InputBinding::Bit { var: var("BitInputReg[1]"), bit };
    let number = |until, bit| input(Encoding::decimal_until(until), bit);
    let fields = [number(b',', bit(0)), number(b',', bit(1)), digits(b';', "WordInputReg[1]")];
    let port = device(&mut cell, b"M,", b"\r\n", &fields);
    let safe = SafeValue::bit(proto_core::sysvar::VarBit { var: var("BitInputReg[1]"), bit: 0 }, true);
    cell.0.safe_values.push(safe).unwrap();
    cell.last_port().on_timeout.len += 1;
    let mut rig = cell.rig();
    rig.run(MS(10));
    rig.bytes(port, b"M,0,1,1;\r\n");
    rig.run(MS(5));
    let bits = |rig: &mut Rig| rig.engine.image().value(var("BitInputReg[1]"));
    assert_eq!(bits(&mut rig), Scalar::Byte(0b10));
    // One of them cannot be read: the other keeps its value, too.
    for _ in 0..3 {
        rig.run(MS(30));
        rig.bytes(port, b"M,x,0,1;\r\n");
        assert_eq!(bits(&mut rig), Scalar::Byte(0b10));
    }
    let ages: Vec<_> = rig.engine.status(rig.now).bits().map(|bit| bit.age.as_millis()).collect();
    assert_eq!(ages, [95, 95]);
    rig.run(MS(5));
    assert_eq!(bits(&mut rig), Scalar::Byte(0b11), "the first has a safe value, the other holds");
    rig.bytes(port, b"M,0,0,1;\r\n");
    assert_eq!(bits(&mut rig), Scalar::Byte(0));
}

#[test]
fn a_text_that_does_not_fit_is_rejected_with_what_belongs_to_it() {
    let mut cell = Cell::new();
    let text = FieldSpec::TextInput {
        text: Text { width: TextWidth::Until(b','), fill: None },
        to: Some(Words {
            first: var("WordInputReg[1]"),
            count: 2,
            order: proto_core::device::ByteOrder::Big,
        }),
        length_to: Some(var("WordInputReg[3]")),
        count_to: None,
        ignored: proto_core::device::Ignored::NONE,
    };
    let port = device(&mut cell, b"M,", b"\r\n", &[text, digits(b';', "WordInputReg[5]")]);
    let mut rig = cell.rig();
    rig.run(MS(10));
    rig.bytes(port, b"M,ABC,1;\r\n");
    rig.take_written();
    rig.bytes(port, b"M,ABCDE,2;\r\n");
    assert_eq!(rig.take_written(), [one(THIRD + 2, 32_968)]);
    let field = rejected(&rig).unwrap().1.unwrap();
    assert_eq!((field.field, field.var), (0, Some(var("WordInputReg[1]"))));
    rig.run(MS(30));
    assert_eq!(known(&rig, "WordInputReg[2]"), (17152.0, 30, Some("port0".into())));
    rig.bytes(port, b"M,AB,2;\r\n");
    assert_eq!(known(&rig, "WordInputReg[3]"), (2.0, 0, Some("port0".into())));
}

#[test]
fn more_groups_than_there_is_room_for_never_stop_a_frame_for_good() {
    let mut cell = Cell::new();
    let names: Vec<_> = (1..=20).map(|nth| format!("WordInputReg[{nth}]")).collect();
    let fields: Vec<_> =
        [fixed(7)].into_iter().chain(names.iter().map(|name| short(name))).chain([crc()]).collect();
    let port = device(&mut cell, &[], &[], &fields);
    for name in &names[..19] {
        cell.safe(name, 1_000.0);
    }
    let mut rig = cell.rig();
    rig.run(MS(10));
    let mut numbers = [5_i16; 20];
    rig.bytes(port, &frame(&numbers));
    // One after the other fails, each for good.
    let mut accepted = 1;
    for nth in 0..19 {
        numbers[nth] = -1;
        for _ in 0..3 {
            rig.run(MS(20));
            rig.bytes(port, &frame(&numbers));
            accepted += 1;
        }
        assert_eq!(rig.counters(port).frames_in, accepted, "with {nth}");
    }
    rig.run(MS(60));
    rig.bytes(port, &frame(&numbers));
    rig.run(MS(60));
    for name in &names[..19] {
        assert_eq!(rig.engine.image().value(var(name)), Scalar::Word(1_000), "{name}");
        assert!(known(&rig, name).1 >= 100 && known(&rig, name).2.as_deref() == Some("port0"));
    }
    assert_eq!(rig.engine.image().value(var(&names[19])), Scalar::Word(5));
    // All at once in one frame, too fast for their timeout: beyond the room, the frame is rejected.
    rig.bytes(port, &frame(&[6; 20]));
    assert!((0..20).all(|nth| rig.engine.image().value(var(&names[nth])) == Scalar::Word(6)));
    let mut numbers = [7_i16; 20];
    for nth in 0..19 {
        numbers[nth] = -1;
        rig.run(MS(1));
        rig.bytes(port, &frame(&numbers));
    }
    assert_eq!(rig.counters(port).rejected_out_of_range, 7);
    rig.bytes(port, &frame(&[8; 20]));
    assert!((0..20).all(|nth| known(&rig, &names[nth]).0 == 8.0));
}

#[test]
fn negative_numbers_become_twos_complement_where_that_is_said() {
    let mut cell = Cell::new();
    let as_int16 = FieldSpec::InputRule(InputRule::Int16);
    let fields = [
        fixed(7),
        input(Encoding::scalar(T::Short).big_endian(), scaled("WordInputReg[1]", 2.0, 0.0)),
        as_int16,
        short("WordInputReg[3]"),
        crc(),
    ];
    let port = device(&mut cell, &[], &[], &fields);
    let mut rig = cell.rig();
    rig.run(MS(10));
    rig.bytes(port, &frame(&[-25, 2]));
    assert_eq!(rig.take_written(), [one(FIRST, 65_486), one(THIRD, 2)]);
    rig.bytes(port, &frame(&[16_383, 2]));
    assert_eq!(rig.take_written(), [one(FIRST, 32_766), one(THIRD, 2)]);
    rig.bytes(port, &frame(&[16_384, 3]));
    assert_eq!(rig.take_written(), [one(THIRD, 3)]);
    let field = rejected(&rig).unwrap().1.unwrap();
    assert_eq!((field.value, field.allowed), (Some(16_384.0), Some((-16_384.0, 16_383.0))));
}

#[test]
fn limits_reject_or_clamp_and_tables_map() {
    let mut cell = Cell::new();
    let limits = |outside| FieldSpec::Limits(Limits { low: 10.0, high: 110.0, outside });
    let entry = |first, last, sent| FieldSpec::Mapped(MapEntry { first, last, sent });
    let fields = [
        fixed(7),
        short("WordInputReg[1]"),
        limits(Outside::Refuse),
        short("WordInputReg[3]"),
        limits(Outside::Clamp),
        short("WordInputReg[5]"),
        entry(0, 0, 100.0),
        entry(1, 5, 200.0),
        short("WordInputReg[7]"),
        entry(0, 0, 1.0),
        FieldSpec::InputRule(InputRule::Else(9.0)),
        crc(),
    ];
    let port = device(&mut cell, &[], &[], &fields);
    let mut rig = cell.rig();
    let word = |rig: &Rig, nth: u8| rig.engine.image().value(var(&format!("WordInputReg[{nth}]"))).as_f64();
    let all = |rig: &Rig| [1, 3, 5, 7].map(|nth| word(rig, nth));
    rig.run(MS(10));
    rig.bytes(port, &frame(&[10, -5, 0, 0]));
    assert_eq!(all(&rig), [10.0, 10.0, 100.0, 1.0]);
    rig.bytes(port, &frame(&[111, 500, 5, -7]));
    assert_eq!(all(&rig), [10.0, 110.0, 200.0, 9.0]);
    assert_eq!(rejected(&rig).unwrap().1.unwrap().allowed, Some((10.0, 110.0)));
    rig.bytes(port, &frame(&[110, 50, 6, 0]));
    assert_eq!(all(&rig), [110.0, 50.0, 200.0, 1.0]);
    assert_eq!(rejected(&rig).unwrap().1.unwrap().allowed, None);
    assert_eq!((rig.counters(port).frames_in, rig.counters(port).rejected_fields), (3, 2));
}

#[test]
fn no_value_is_no_error_and_is_told() {
    let mut cell = Cell::new();
    let rule = FieldSpec::InputRule;
    let valid = |bit| rule(InputRule::ValidTo { var: var("BitInputReg[3]"), bit: Some(bit) });
    let fields = [
        digits(b',', "WordInputReg[1]"),
        rule(InputRule::NoText(NoText::new("----").unwrap())),
        valid(4),
        input(Encoding::decimal_until(b';'), to("WordInputReg[3]")),
        rule(InputRule::NoNumber(32_767.0)),
        rule(InputRule::ValidTo { var: var("WordInputReg[5]"), bit: None }),
    ];
    let port = device(&mut cell, b"M,", b"\r\n", &fields);
    cell.safe("WordInputReg[1]", 65_535.0);
    let mut rig = cell.rig();
    let tells = |rig: &Rig| {
        let image = rig.engine.image();
        (image.value(var("BitInputReg[3]")).as_f64(), image.value(var("WordInputReg[5]")).as_f64())
    };
    rig.run(MS(10));
    rig.bytes(port, b"M,1.5,7;\r\n");
    assert_eq!(tells(&rig), (16.0, 1.0));
    rig.bytes(port, b"M, ---- ,32767;\r\n");
    assert_eq!(tells(&rig), (0.0, 0.0));
    let counters = rig.counters(port);
    let values = (counters.frames_in, counters.rejected_fields, counters.fields_without_value);
    assert_eq!((values, counters.rejected(), rejected(&rig)), ((2, 0, 2), 0, None));
    rig.bytes(port, b"M,1.5,99999;\r\n");
    assert_eq!(tells(&rig), (16.0, 0.0));
    rig.bytes(port, b"M,x,7;\r\n");
    assert_eq!(tells(&rig), (0.0, 1.0));
    // A frame of which nothing else is taken still tells.
    rig.bytes(port, b"M,x,99999;\r\n");
    assert_eq!((tells(&rig), rig.counters(port).frames_in), ((0.0, 0.0), 5));
    // The device falls silent.
    rig.bytes(port, b"M,1.5,7;\r\n");
    assert_eq!(tells(&rig), (16.0, 1.0));
    rig.run(MS(100));
    assert_eq!(tells(&rig), (0.0, 0.0));
    assert_eq!(rig.engine.image().value(var("WordInputReg[1]")), Scalar::Word(65_535));
}

#[test]
fn what_cannot_be_is_refused_with_its_place() {
    let rule = FieldSpec::InputRule;
    let check = |fields: &[FieldSpec]| {
        let mut cell = Cell::new();
        let fields: Vec<_> = [fixed(1)].iter().chain(fields).copied().collect();
        device(&mut cell, &[], &[], &fields);
        cell.0.validate().map_err(|error| format!("{error}"))
    };
    let own = short("WordInputReg[1]");
    let limits = FieldSpec::Limits(Limits { low: 0.0, high: 5.0, outside: Outside::Refuse });
    let entry = |sent| FieldSpec::Mapped(MapEntry { first: 1, last: 2, sent });
    assert_eq!(check(&[own, rule(InputRule::Int16), limits]), Ok(()));
    for (fields, message) in [
        (
            &[limits][..],
            "field 2: only an input field that writes a variable, and not a bit of it, has as, min, max, map, no_value or valid_to",
        ),
        (
            &[own, entry(1.0), limits],
            "field 4: a map has nothing but its own numbers; min, max and outside are not for it",
        ),
        (&[own, entry(70_000.0)], "field 3: WordInputReg[1] cannot be 70000"),
        (&[own, rule(InputRule::Int16), entry(40_000.0)], "field 4: WordInputReg[1] cannot be 40000"),
        (&[own, rule(InputRule::Else(1.0))], "field 3: else is for a map with other entries"),
        (
            &[own, rule(InputRule::NoNumber(40_000.0))],
            "field 3: the field cannot be 40000; allowed: -32768..=32767",
        ),
        (
            &[own, rule(InputRule::NoText(NoText::new("-").unwrap()))],
            "field 3: a text stands for no value in fields of digits only: decimal, hex",
        ),
        (
            &[own, rule(InputRule::ValidTo { var: var("FloatInputReg[1]"), bit: None })],
            "field 3: FloatInputReg[1] is no word register; allowed: WordInputReg",
        ),
    ] {
        let start = "recipe 1, input part, ";
        assert_eq!(check(fields), Err(format!("{start}{message}")));
    }
}
