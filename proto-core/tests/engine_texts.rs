//! Devices whose frames vary in length: texts, lengths, silence, escape bytes.

mod rig;

use proto_core::config::*;
use proto_core::device::{
    Algorithm, Boundary, ByteOrder, Checksum, Counts, Encoding, Escape, Ignored, Length, Overflow, Text,
    TextWidth,
};
use proto_core::engine::{PortId, PortState, Rejection};
use proto_core::recipe::model::Mode;
use proto_core::sysvar::ModbusPlace;
use proto_core::wire::scalar::ScalarType as T;
use rig::*;

fn words(first: &str, count: u8) -> Words {
    Words { first: var(first), count, order: ByteOrder::Big }
}

fn code_to(width: TextWidth) -> FieldSpec {
    FieldSpec::TextInput {
        text: Text { width, fill: None },
        to: Some(words("WordInputReg[1]", 8)),
        length_to: Some(var("WordInputReg[9]")),
        count_to: Some(var("WordInputReg[10]")),
        ignored: Ignored::NONE,
    }
}

fn number(ty: T, to: &str) -> FieldSpec {
    let to = InputBinding::Variable { var: var(to), scale: 1.0, offset: 0.0 };
    let encoding = Encoding { order: ByteOrder::Big, ..Encoding::scalar(ty) };
    FieldSpec::DeviceInput { encoding, overflow: Overflow::Usual, to }
}

fn crc() -> FieldSpec {
    FieldSpec::Checksum(Checksum::standard(Algorithm::named("crc16-modbus").unwrap()))
}

struct Frames<'a> {
    head: &'a [u8],
    tail: &'a [u8],
    framing: Boundary,
    escape: Option<Escape>,
}

const PLAIN: Frames<'static> = Frames { head: &[], tail: &[], framing: Boundary::Fields, escape: None };

fn device(cell: &mut Cell, frames: &Frames<'_>, input: &[FieldSpec], output: &[FieldSpec]) -> PortId {
    let mut part = |fields: &[FieldSpec]| {
        let span = cell.fields(fields.iter().copied());
        let mut part = cell.part(frames.head, frames.tail, span)?;
        (part.framing, part.escape) = (frames.framing, frames.escape);
        (!fields.is_empty()).then_some(part)
    };
    let parts = Parts::Stream { input: part(input), output: part(output) };
    let recipe = cell.recipe(Mode::User, parts);
    cell.rs485(recipe)
}

const SCANNER: Frames<'static> = Frames { tail: b"\r\n", framing: Boundary::Tail, ..PLAIN };

fn scanner(cell: &mut Cell, width: TextWidth) -> PortId {
    device(cell, &SCANNER, &[code_to(width)], &[])
}

/// The registers of a code: its characters, its length, the number of codes so far.
fn registers(code: &[u8], count: u16) -> Vec<u16> {
    let mut characters = [0; 16];
    characters[..code.len()].copy_from_slice(code);
    let pairs = characters.chunks(2).map(|pair| u16::from_be_bytes([pair[0], pair[1]]));
    pairs.chain([code.len() as u16, count]).collect()
}

fn shown(rig: &Rig) -> Vec<u16> {
    let value = |nth| rig.engine.image().value(var(&format!("WordInputReg[{nth}]"))).as_f64() as u16;
    (1..=10).map(value).collect()
}

#[test]
fn codes_of_any_length_reach_the_robot() {
    let mut cell = Cell::new();
    let port = scanner(&mut cell, TextWidth::Rest);
    let mut rig = cell.rig();
    rig.run(MS(10));
    rig.bytes(port, b"4006381333931\r\n");
    assert_eq!(rig.take_written(), [Written::Registers(8, registers(b"4006381333931", 1))]);
    rig.run(MS(300));
    rig.bytes(port, b"ABC\r\n");
    rig.run(MS(1));
    // The registers behind the shorter one are zeros again.
    assert_eq!(shown(&rig), registers(b"ABC", 2));
    rig.bytes(port, b"1234567890123456\r\n");
    assert_eq!(shown(&rig), registers(b"1234567890123456", 3));
    assert_eq!((rig.counters(port).frames_in, rig.counters(port).rejected_length), (3, 0));
}

#[test]
fn the_same_code_twice_is_seen() {
    let mut cell = Cell::new();
    let port = scanner(&mut cell, TextWidth::Rest);
    let mut rig = cell.rig();
    rig.run(MS(10));
    rig.bytes(port, b"A1\r\n");
    rig.run(MS(20));
    let _ = rig.take_written();
    rig.bytes(port, b"A1\r\n");
    rig.run(MS(20));
    assert_eq!(shown(&rig), registers(b"A1", 2));
    assert_ne!(rig.take_written(), []);
}

#[test]
fn a_code_is_read_wherever_it_is_cut() {
    let code = b"4006381333931\r\n";
    for cut in 1..code.len() {
        let mut cell = Cell::new();
        let port = scanner(&mut cell, TextWidth::Rest);
        let mut rig = cell.rig();
        rig.run(MS(10));
        rig.bytes(port, &code[..cut]);
        rig.run(MS(20));
        rig.bytes(port, &code[cut..]);
        assert_eq!(shown(&rig), registers(b"4006381333931", 1), "cut at {cut}");
    }
}

#[test]
fn the_end_of_a_code_that_silence_has_cut_is_no_code() {
    let code = b"4006381333931\r\n";
    for cut in 1..code.len() {
        let mut cell = Cell::new();
        let port = scanner(&mut cell, TextWidth::Rest);
        let mut rig = cell.rig();
        rig.run(MS(10));
        rig.bytes(port, &code[..cut]);
        rig.run(MS(80));
        rig.bytes(port, &code[cut..]);
        let counters = rig.counters(port);
        assert_eq!((counters.frames_in, counters.discarded_bytes), (0, 15), "cut at {cut}");
        assert!(!rig.engine.image().is_known(var("WordInputReg[1]")));
        // The next code is read.
        rig.bytes(port, code);
        assert_eq!(shown(&rig), registers(b"4006381333931", 1), "cut at {cut}");
    }
}

#[test]
fn noread_is_not_a_code_of_five_letters() {
    for framed in [SCANNER, Frames { framing: Boundary::Silence, ..SCANNER }] {
        let mut cell = Cell::new();
        let port = device(&mut cell, &framed, &[code_to(TextWidth::Fixed(5))], &[]);
        let mut rig = cell.rig();
        rig.run(MS(10));
        for (code, rejected) in [("NOREAD", 1), ("1234", 2), ("", 3)] {
            rig.bytes(port, format!("{code}\r\n").as_bytes());
            rig.run(MS(60));
            assert_eq!(rig.counters(port).rejected_length, rejected, "{code}");
            let now = rig.now;
            let last = rig.engine.status(now).ports().next().unwrap().last_rejection.unwrap();
            assert_eq!((last.why, last.len), (Rejection::WrongLength, code.len() + 2));
        }
        assert!(!rig.engine.image().is_known(var("WordInputReg[1]")));
        assert_eq!(rig.take_written(), []);
        rig.bytes(port, b"12345\r\n");
        rig.run(MS(60));
        assert_eq!(shown(&rig), registers(b"12345", 1));
    }
}

/// A scanner that says when it read nothing, with a safe value after 100 ms.
fn telling(cell: &mut Cell) -> PortId {
    let mut field = code_to(TextWidth::Rest);
    let FieldSpec::TextInput { ignored, .. } = &mut field else { unreachable!() };
    *ignored = Ignored::new(&[b"NOREAD", b"?", b""]).unwrap();
    let port = device(cell, &SCANNER, &[field], &[]);
    cell.safe("WordInputReg[9]", 99.0);
    port
}

#[test]
fn an_ignored_text_changes_nothing_and_shows_that_the_device_is_there() {
    let mut cell = Cell::new();
    let port = telling(&mut cell);
    let mut rig = cell.rig();
    rig.run(MS(10));
    let state = |rig: &Rig| rig.engine.status(rig.now).ports().next().unwrap().state;
    for nth in 1..=5 {
        rig.bytes(port, [&b"NOREAD\r\n"[..], b"?\r\n", b"\r\n"][nth as usize % 3]);
        assert_eq!((state(&rig), rig.counters(port).ignored), (PortState::Working, nth));
        rig.run(MS(60));
    }
    assert!(!rig.engine.image().is_known(var("WordInputReg[1]")), "nothing was read yet");
    assert_eq!(rig.take_written(), []);
    rig.bytes(port, b"4711\r\n");
    rig.run(MS(60));
    let _ = rig.take_written();
    for _ in 0..5 {
        rig.bytes(port, b"NOREAD\r\n");
        rig.run(MS(60));
    }
    assert_eq!((shown(&rig), rig.take_written()), (registers(b"4711", 1), vec![]));
    let counters = rig.counters(port);
    assert_eq!((counters.frames_in, counters.ignored, counters.timeouts), (1, 10, 0));
    // Another text is a code, also one that begins so.
    rig.bytes(port, b"NOREADS\r\n");
    assert_eq!(shown(&rig), registers(b"NOREADS", 2));
}

#[test]
fn the_robot_is_told_that_nothing_was_read() {
    let mut cell = Cell::new();
    let port = telling(&mut cell);
    cell.last_port().health.ignored = Some(var("WordInputReg[20]"));
    cell.last_port().health.frames = Some(var("WordInputReg[21]"));
    let mut rig = cell.rig();
    rig.run(MS(10));
    for _ in 0..3 {
        rig.bytes(port, b"NOREAD\r\n");
        rig.run(MS(60));
    }
    rig.run(MS(100));
    let register = |name: &str| {
        let Some(ModbusPlace::Register { address }) = var(name).modbus() else { panic!() };
        rig.map.registers[usize::from(address)]
    };
    assert_eq!((register("WordInputReg[20]"), register("WordInputReg[21]")), (3, 0));
}

#[test]
fn a_device_that_falls_silent_after_an_ignored_text_is_overdue() {
    let mut cell = Cell::new();
    let port = telling(&mut cell);
    let mut rig = cell.rig();
    rig.run(MS(10));
    rig.bytes(port, b"4711\r\n");
    rig.run(MS(60));
    rig.bytes(port, b"NOREAD\r\n");
    rig.run(MS(99));
    assert_eq!((rig.counters(port).timeouts, rig.map.registers[16]), (0, 4));
    rig.run(MS(20));
    assert_eq!((rig.counters(port).timeouts, rig.map.registers[16]), (1, 99));
    // It is there again; its values are still the safe ones.
    rig.bytes(port, b"NOREAD\r\n");
    rig.run(MS(20));
    let state = rig.engine.status(rig.now).ports().next().unwrap().state;
    assert_eq!((state, rig.map.registers[16]), (PortState::Working, 99));
}

#[test]
fn an_ignored_text_keeps_no_code_waiting() {
    let mut cell = Cell::new();
    let port = telling(&mut cell);
    let mut rig = cell.rig();
    rig.run(MS(10));
    rig.modbus_answers = false;
    // The first is on its way, the second waits behind it.
    rig.bytes(port, b"4711\r\n");
    rig.run(MS(10));
    rig.bytes(port, b"4712\r\n");
    rig.run(MS(60));
    assert_eq!(rig.counters(port).values_expired, 0);
    for _ in 0..4 {
        rig.bytes(port, b"NOREAD\r\n");
        rig.run(MS(60));
    }
    let counters = rig.counters(port);
    assert_eq!((counters.timeouts, counters.values_expired), (0, 10), "eight registers, length and count");
    let _ = rig.take_written();
    rig.modbus_answers = true;
    for _ in 0..40 {
        rig.bytes(port, b"NOREAD\r\n");
        rig.run(MS(60));
    }
    assert_eq!(rig.take_written(), [], "it was older than the timeout");
}

#[test]
fn nothing_is_written_for_a_device_that_never_said_anything() {
    let mut cell = Cell::new();
    let port = telling(&mut cell);
    let mut rig = cell.rig();
    rig.run(MS(10));
    rig.bytes(port, b"NOREAD\r\n");
    rig.run(MS(1_000));
    let state = rig.engine.status(rig.now).ports().next().unwrap().state;
    assert_eq!((state, rig.counters(port).timeouts, rig.take_written()), (PortState::Silent, 1, vec![]));
    rig.bytes(port, b"4711\r\n");
    rig.run(MS(1_000));
    assert_eq!((rig.counters(port).timeouts, rig.map.registers[16]), (2, 99));
}

#[test]
fn a_text_that_does_not_fit_meanwhile_is_no_change() {
    let mut cell = Cell::new();
    let text = FieldSpec::TextOutput {
        text: Text { width: TextWidth::Rest, fill: None },
        from: words("WordOutputReg[1]", 3),
        length_from: Some(var("WordOutputReg[9]")),
    };
    let framed = Frames { head: b"T", tail: b"\r\n", ..PLAIN };
    let port = device(&mut cell, &framed, &[], &[text]);
    cell.last_recipe().send = SendOn::Change;
    let mut rig = cell.rig();
    let mut sends = |len| {
        rig.map.registers[48] = len;
        rig.run(MS(200));
        rig.sent_to(port).len()
    };
    assert_eq!([2, 7, 2, 3, 9, 2].map(&mut sends), [1, 0, 0, 1, 0, 1]);
}

#[test]
fn a_code_too_long_for_its_registers_is_not_cut() {
    let mut cell = Cell::new();
    let port = scanner(&mut cell, TextWidth::Rest);
    let mut rig = cell.rig();
    rig.run(MS(10));
    rig.bytes(port, b"12345678901234567\r\n");
    rig.bytes(port, &[vec![b'x'; 700], b"\r\n".to_vec()].concat());
    let counters = rig.counters(port);
    assert_eq!((counters.frames_in, counters.rejected_out_of_range, counters.rejected_length), (0, 1, 1));
    assert_eq!(rig.take_written(), []);
    rig.bytes(port, b"1\r\n");
    assert_eq!(shown(&rig), registers(b"1", 1));
}

#[test]
fn silence_ends_frames_of_any_length() {
    let mut cell = Cell::new();
    let framed = Frames { framing: Boundary::Silence, ..PLAIN };
    let port = device(&mut cell, &framed, &[code_to(TextWidth::Rest), crc()], &[]);
    let mut rig = cell.rig();
    rig.run(MS(10));
    let frame = with_crc(b"HELLO");
    rig.bytes(port, &frame[..3]);
    rig.run(MS(40));
    rig.bytes(port, &frame[3..]);
    rig.run(MS(40));
    assert_eq!(rig.counters(port).frames_in, 0);
    rig.run(MS(20));
    assert_eq!(shown(&rig), registers(b"HELLO", 1));
    assert_eq!(rig.take_written(), [Written::Registers(8, registers(b"HELLO", 1))]);
    // Two frames without silence between are none.
    rig.bytes(port, &[with_crc(b"A"), with_crc(b"B")].concat());
    rig.run(MS(60));
    rig.bytes(port, &with_crc(b"C"));
    rig.run(MS(60));
    assert_eq!((rig.counters(port).rejected_checksum, rig.counters(port).frames_in), (1, 2));
    assert_eq!(shown(&rig), registers(b"C", 2));
}

#[test]
fn a_device_that_is_gone_ends_no_frame() {
    let mut cell = Cell::new();
    let framed = Frames { framing: Boundary::Silence, ..PLAIN };
    let port = device(&mut cell, &framed, &[code_to(TextWidth::Rest)], &[]);
    let mut rig = cell.rig();
    rig.run(MS(10));
    rig.bytes(port, b"12");
    rig.input(proto_core::engine::Input::PortDown { port });
    rig.run(MS(60));
    rig.input(proto_core::engine::Input::PortUp { port });
    rig.run(MS(60));
    assert_eq!((rig.counters(port).frames_in, rig.counters(port).discarded_bytes), (0, 2));
}

#[test]
fn a_sensor_says_how_long_its_frames_are() {
    let mut cell = Cell::new();
    let length = Length { encoding: Encoding::scalar(T::Byte), counts: Counts::Rest, plus: 0 };
    let fields =
        [FieldSpec::Length(length), number(T::Word, "WordInputReg[11]"), code_to(TextWidth::Rest), crc()];
    let port = device(&mut cell, &Frames { head: &[0x7E], ..PLAIN }, &fields, &[]);
    let mut rig = cell.rig();
    rig.run(MS(10));
    let short = with_crc(b"\x7E\x06\x01\x02AB");
    let long = with_crc(b"\x7E\x0E\x03\x04ABCDEFGHIJ");
    let stream = [&short[..], b"\x7E\xFF?", &long].concat();
    for &byte in &stream {
        rig.bytes(port, &[byte]);
    }
    assert_eq!(rig.counters(port).frames_in, 2);
    assert_eq!(shown(&rig), registers(b"ABCDEFGHIJ", 2));
    // A length that no frame has is no beginning.
    assert_eq!(rig.counters(port).resync_bytes, 3);
    let mut wrong = long.clone();
    wrong[7] ^= 1;
    rig.bytes(port, &wrong);
    assert_eq!((rig.counters(port).frames_in, rig.counters(port).rejected_checksum), (2, 1));
}

#[test]
fn escapes_are_taken_out_before_the_checksum() {
    for escape in [Escape::Slip, Escape::Dle, Escape::Cobs] {
        let mut cell = Cell::new();
        let framed = Frames { escape: Some(escape), ..PLAIN };
        let constant = |value| OutputBinding::Constant(value);
        let encoding = Encoding { order: ByteOrder::Big, ..Encoding::scalar(T::Dword) };
        let from = constant(f64::from(0xC010_DB00_u32));
        let output = FieldSpec::DeviceOutput { encoding, overflow: Overflow::Usual, from };
        let input = [number(T::Word, "WordInputReg[1]"), number(T::Word, "WordInputReg[2]"), crc()];
        let port = device(&mut cell, &framed, &input, &[output, crc()]);
        let mut rig = cell.rig();
        rig.run(MS(10));
        let frame = with_crc(&[0xC0, 0x10, 0xDB, 0x00]);
        let mut line = [0; 64];
        line[..frame.len()].copy_from_slice(&frame);
        let len = escape.stuff(frame.len(), &mut line).unwrap();
        assert_eq!(rig.sent_to(port)[0], line[..len], "{escape:?}");
        for &byte in &line[..len] {
            rig.bytes(port, &[byte]);
        }
        assert_eq!(rig.take_written(), [Written::Registers(8, vec![0xC010, 0xDB00])], "{escape:?}");
        // One wrong bit is one wrong frame, and the next one is taken.
        line[4] ^= 0x04;
        rig.bytes(port, &line[..len]);
        line[4] ^= 0x04;
        rig.bytes(port, &line[..len]);
        assert_eq!(rig.counters(port).frames_in, 2, "{escape:?}");
    }
}

#[test]
fn wrong_escapes_are_counted() {
    let mut cell = Cell::new();
    let framed = Frames { escape: Some(Escape::Slip), ..PLAIN };
    let port = device(&mut cell, &framed, &[number(T::Word, "WordInputReg[1]")], &[]);
    let mut rig = cell.rig();
    rig.run(MS(10));
    rig.bytes(port, &[0xC0, 1, 0xDB, 2, 0xC0, 1, 2, 3, 0xC0, 1, 2, 0xC0]);
    let counters = rig.counters(port);
    assert_eq!((counters.rejected_unreadable, counters.rejected_length, counters.frames_in), (1, 1, 1));
    assert_eq!(rig.take_written(), [Written::Registers(8, vec![258])]);
}

#[test]
fn texts_go_to_a_device() {
    for (length_from, expected) in [(None, &b"HI!"[..]), (Some("WordOutputReg[9]"), &b"HI!\0X"[..])] {
        let mut cell = Cell::new();
        let text = FieldSpec::TextOutput {
            text: Text { width: TextWidth::Rest, fill: None },
            from: words("WordOutputReg[1]", 3),
            length_from: length_from.map(var),
        };
        let framed = Frames { head: b"T", tail: b"\r\n", ..PLAIN };
        let port = device(&mut cell, &framed, &[], &[text]);
        let mut rig = cell.rig();
        for (nth, word) in [0x4849, 0x2100, 0x5859].into_iter().enumerate() {
            rig.map.registers[40 + nth] = word;
        }
        rig.map.registers[48] = 5;
        rig.run(MS(100));
        let sent = rig.sent_to(port);
        assert_eq!(*sent.last().unwrap(), [b"T", expected, b"\r\n"].concat());
        // More than there are registers for is not sent.
        rig.map.registers[48] = 7;
        rig.run(MS(100));
        let _ = rig.sent_to(port);
        rig.run(MS(100));
        assert_eq!(rig.sent_to(port).is_empty(), length_from.is_some());
    }
}

#[test]
fn what_cannot_be_is_refused_with_its_place() {
    let check = |framed: &Frames<'_>, fields: &[FieldSpec]| {
        let mut cell = Cell::new();
        device(&mut cell, framed, fields, &[]);
        cell.0.validate().map_err(|error| format!("{error}"))
    };
    let start = "recipe 1, input part";
    let text = |count, first| FieldSpec::TextInput {
        text: Text { width: TextWidth::Rest, fill: None },
        to: Some(words(first, count)),
        length_to: None,
        count_to: None,
        ignored: Ignored::NONE,
    };
    assert_eq!(check(&SCANNER, &[text(32, "WordInputReg[1]")]), Ok(()));
    for (framed, field, message) in [
        (
            SCANNER,
            text(2, "WordInputReg[32]"),
            ", field 1: 2 word variables are needed, such as WordInputReg[1]; found: WordInputReg[32]",
        ),
        (
            SCANNER,
            text(2, "FloatInputReg[1]"),
            ", field 1: 2 word variables are needed, such as WordInputReg[1]; found: FloatInputReg[1]",
        ),
        (
            SCANNER,
            text(2, "WordOutputReg[1]"),
            ", field 1: WordOutputReg[1] is an output of the robot and cannot be written; inputs are \
             DigitalOutputCommand, BitInputReg, WordInputReg, FloatInputReg, ForceEnd, ForceBase",
        ),
        (Frames { tail: &[], ..SCANNER }, text(2, "WordInputReg[1]"), ": framing = \"tail\" needs a tail"),
        (
            Frames { escape: Some(Escape::Cobs), ..SCANNER },
            text(2, "WordInputReg[1]"),
            ": escape bytes tell frames apart already; framing is not needed beside them",
        ),
    ] {
        assert_eq!(check(&framed, &[field]), Err(format!("{start}{message}")));
    }
    let error =
        check(&Frames { framing: Boundary::Fields, ..SCANNER }, &[text(2, "WordInputReg[1]")]).unwrap_err();
    assert!(error.starts_with(&format!("{start}, field 1: a text at the beginning")), "{error}");
}
