//! Frames of devices: worked bytes of the example files, and any bytes there and back.

use proptest::prelude::*;
use proto_core::device::{Algorithm, ByteOrder};
use proto_core::sysvar::Direction;
use recipe_config::file::{Text, load_recipes, parse_recipes};
use recipe_test_kit::example;

use super::codec::ExchangePart;
use super::tests::{decoded, encoded, from_values};
use super::*;

fn example_part(file: &str, recipe: Option<&str>, part: Direction) -> CompiledPart {
    CompiledPart::choose(&load_recipes(&example(file), &[]).unwrap(), recipe, Some(part)).unwrap()
}

/// A frame of an exchange of an example, which has one recipe.
fn exchange_part(file: &str, number: usize, part: ExchangePart) -> CompiledPart {
    let recipes = load_recipes(&example(file), &[]).unwrap();
    CompiledPart::choose_exchange(&recipes, None, Some(number), Some(part)).unwrap()
}

const REPLY: &str = "09 17 06 F9 00 00 DC D0 1E 4E 11";

#[test]
fn the_grippers_reply_has_its_values() {
    let part = exchange_part("gripper.toml", 1, ExchangePart::Reply);
    let values = "activated=1 going=1 status=3 object=3 fault=0 wanted=220 position=208 current=30\n";
    assert_eq!(decoded(&part, REPLY), (values.into(), String::new()));
    assert_eq!(encoded(&part, values).unwrap().trim_end(), REPLY);
    // A reserved byte that is not as it is sent.
    let other = "09 17 06 F9 AB 00 DC D0 1E";
    let bytes = text::parse_hex_line(other).unwrap();
    let crc = Algorithm::named("crc16-modbus").unwrap().of([&bytes[..]]) as u16;
    let other = format!("{other} {}\n", text::hex(&crc.to_le_bytes()));
    let (values, _) = decoded(&part, &other);
    assert!(
        values.trim_end().ends_with(&format!("current=30 raw={}", other.trim_end().replace(' ', ""))),
        "{values}"
    );
    assert_eq!(encoded(&part, &values).unwrap(), other);
    let changed = values.replace("current=30", "current=31");
    let refused = encoded(&part, &changed).unwrap_err();
    assert!(refused.ends_with("has other values; leave it out to make a frame from the values"), "{refused}");
}

#[test]
fn the_grippers_request_needs_no_constants() {
    let part = exchange_part("gripper.toml", 1, ExchangePart::Request);
    let request = "09 17 07 D0 00 03 03 E8 00 03 06 09 00 00 DC FF 96 D7 DA";
    assert_eq!(from_values(&part, None, &["220", "255", "150"]).unwrap(), request);
    assert_eq!(from_values(&part, None, &["force=150", "position=220", "speed=255"]).unwrap(), request);
    let (values, notes) = decoded(&part, request);
    assert_eq!(values, "activate=1 go=1 position=220 speed=255 force=150\n");
    assert_eq!((encoded(&part, &values).unwrap().trim_end(), notes.as_str()), (request, ""));
    let stopped = from_values(&part, None, &["go=0", "220", "255", "150"]).unwrap();
    assert_eq!(stopped[..41], request.replacen("06 09", "06 01", 1)[..41]);
    assert_eq!(from_values(&part, None, &["1"]).unwrap_err(), "no value for speed, force");
    assert_eq!(
        from_values(&part, None, &["activate=2", "1", "2", "3"]).unwrap_err(),
        "activate: 2 does not fit; allowed: 0..=1"
    );
}

#[test]
fn a_wrong_checksum_is_told_with_the_right_one() {
    let part = exchange_part("gripper.toml", 1, ExchangePart::Reply);
    let wrong = REPLY.replace("1E 4E", "1F 4E");
    let (values, notes) = decoded(&part, &format!("{wrong}\n{REPLY}\n"));
    assert_eq!(values.lines().count(), 1);
    assert_eq!(
        notes,
        "line 1: 09 17 06 F9 00 00 DC D0 1F 4E 11: the checksum is 4E 11 instead of 8F D1, so a receiver rejects the \
         frame\n"
    );
    // At the end, and of another slave.
    let (mut out, mut notes) = (Vec::new(), Vec::new());
    let refused = decode_lines(&part, wrong.as_bytes(), &mut out, &mut notes).unwrap_err();
    assert_eq!(refused, "the input has no frame of this recipe");
    let notes = String::from_utf8(notes).unwrap();
    assert!(notes.starts_with("line 1: ") && notes.lines().count() == 1, "{notes}");
    let bytes = text::parse_hex_line("08 17 06 F9 00 00 DC D0 1E").unwrap();
    let crc = Algorithm::named("crc16-modbus").unwrap().of([&bytes[..]]) as u16;
    let other = format!("{} {}\n{REPLY}", text::hex(&bytes), text::hex(&crc.to_le_bytes()));
    let (values, notes) = decoded(&part, &other);
    assert_eq!(values.lines().count(), 1);
    assert!(notes.starts_with("line 1: 08 17 ") && notes.contains("other constants"), "{notes}");
}

#[test]
fn frames_of_exchanges_are_whole() {
    for (number, frame, values, bytes) in [
        (1, ExchangePart::Request, &[][..], "01 02 00 00 00 08 79 CC"),
        (1, ExchangePart::Reply, &["1", "0", "0", "1"], "01 02 01 81 61 E8"),
        (1, ExchangePart::Refusal, &["2"], "01 82 02 C1 61"),
        (2, ExchangePart::Request, &["1", "0", "1"], "01 0F 00 00 00 04 01 0D FF 53"),
        (2, ExchangePart::Reply, &[], "01 0F 00 00 00 04 54 08"),
        (4, ExchangePart::Request, &["zero=1"], "02 05 01 00 FF 00 8D F5"),
        (4, ExchangePart::Reply, &["zero=0"], "02 05 01 00 00 00 CC 05"),
        (13, ExchangePart::Request, &["3"], "00 06 00 F0 00 03 C8 29"),
    ] {
        let part = exchange_part("modbus-line.toml", number, frame);
        let found = from_values(&part, None, values).unwrap();
        assert_eq!(found, bytes, "exchange {number}");
        let (values, notes) = decoded(&part, &found);
        assert_eq!((encoded(&part, &values).unwrap(), notes.as_str()), (found + "\n", ""), "{values}");
        let needs_values = matches!(
            (number, frame),
            (1, ExchangePart::Reply | ExchangePart::Refusal) | (2 | 13, ExchangePart::Request)
        );
        assert_eq!(part.is_constant(), !needs_values, "{values}");
    }
    let recipes = load_recipes(&example("modbus-line.toml"), &[]).unwrap();
    let refused = |number, part| CompiledPart::choose_exchange(&recipes, None, number, part).unwrap_err();
    assert_eq!(refused(Some(13), Some(ExchangePart::Reply)), "the exchange has no reply; there are request");
    assert_eq!(refused(Some(14), None), "there is no exchange 14 in recipe \"line\"; allowed: 1..=13");
    assert_eq!(refused(Some(0), None), "there is no exchange 0 in recipe \"line\"; allowed: 1..=13");
    assert_eq!(
        refused(None, None),
        "recipe \"line\" has several exchanges; choose one with --exchange N: 1..=13"
    );
    assert_eq!(
        refused(Some(1), None),
        "the exchange has several frames; choose one with --part: request, reply, refusal"
    );
    assert_eq!(CompiledPart::choose(&recipes, None, None).unwrap_err(), refused(None, None));
}

/// The fenced blocks of a part of docs/configuration.md, and its text.
fn documented(part: &str) -> (String, String) {
    let path = recipe_test_kit::repository().join("docs/configuration.md");
    let document = std::fs::read_to_string(path).unwrap();
    let (_, text) = document.split_once(&format!("\n### {part}\n")).unwrap();
    let text = text.split("\n## ").next().unwrap().split("\n### ").next().unwrap();
    // Those behind the first one of this part are of Modbus.
    let count = if part == "Exchanges" { 1 } else { usize::MAX };
    let blocks: Vec<_> = text.split("```\n").skip(1).step_by(2).take(count).collect();
    (blocks.concat(), text.to_owned())
}

#[test]
fn the_worked_bytes_of_exchanges_are_right() {
    for (title, recipe, frames) in [
        (
            "Exchanges",
            "[[recipe]]\nname = \"r\"\nkind = \"stream\"\nmode = \"user\"\n",
            &[(1, ExchangePart::Request, ""), (1, ExchangePart::Reply, "1000")][..],
        ),
        (
            "Modbus RTU master",
            "[[recipe]]\nname = \"r\"\nkind = \"modbus-rtu\"\n",
            &[
                (1, ExchangePart::Request, ""),
                (1, ExchangePart::Reply, "1000"),
                (2, ExchangePart::Request, "1 1"),
                (2, ExchangePart::Refusal, "2"),
            ],
        ),
        ("Modbus RTU slave", "", &[(2, ExchangePart::Request, ""), (2, ExchangePart::Reply, "0.5")]),
    ] {
        let (blocks, text) = documented(title);
        let toml = format!("[controller]\naddress = \"a\"\n{recipe}{blocks}");
        let recipes = parse_recipes(Text { name: title, toml: &toml }, &[]).unwrap();
        for &(number, part, values) in frames {
            let part = CompiledPart::choose_exchange(&recipes, None, Some(number), Some(part)).unwrap();
            let values: Vec<_> = values.split_whitespace().collect();
            let bytes = from_values(&part, None, &values).unwrap();
            assert!(text.contains(&format!("`{bytes}`")), "{title}, {number}: {bytes}");
        }
    }
}

#[test]
fn the_force_sensors_stream_is_found_in_garbage() {
    let part = example_part("force-sensor-crc.toml", Some("force-sensor"), Direction::Input);
    let values = ["Fx=-150", "Fy=20", "Fz=981", "Mx=0", "My=-1", "Mz=5"];
    let frame = "20 4E 6A FF 14 00 D5 03 00 00 FF FF 05 00 74 77";
    assert_eq!(from_values(&part, None, &values).unwrap(), frame);
    let (shown, notes) = decoded(&part, &format!("4E 20 {frame} 20 4E 00"));
    assert_eq!(shown.trim_end(), values.join(" "));
    assert_eq!(notes, "2 bytes skipped outside of frames\n3 bytes of an unfinished frame at the end\n");
}

#[test]
fn the_scales_text_is_a_number() {
    let part = example_part("scale.toml", None, Direction::Input);
    let line = |text: &str| text::hex(text.as_bytes());
    let (values, notes) =
        decoded(&part, &line("ST,GS,+  12.34kg\r\nUS,GS,+  12.30kg\r\nST,GS,-0012.34kg\r\n"));
    let lines: Vec<&str> = values.lines().collect();
    // Blanks are not what a gateway would write, so the bytes are kept.
    assert_eq!(lines[0], format!("weight=12.34 raw={}", line("ST,GS,+  12.34kg\r\n").replace(' ', "")));
    assert_eq!(lines[1], "weight=-12.34");
    assert_eq!(
        notes,
        "line 1: a gateway rejects this field: weight is -12.34; WordInputReg[1] takes 0..=655.35\n\
         18 bytes skipped outside of frames\n"
    );
    assert_eq!(from_values(&part, None, &["-12.34"]).unwrap(), line("ST,GS,-0012.34kg\r\n"));
    assert_eq!(from_values(&part, None, &["12.345"]).unwrap_err(), "weight: 12.345 has more than 2 decimals");
    let broken = format!("{} {}", line("ST,GS,12x34.00kg\r\n"), line("ST,GS,00012.34kg\r\n"));
    let (values, notes) = decoded(&part, &broken);
    assert_eq!(values, "weight=12.34\n");
    assert!(notes.contains("weight: the field has a character that is not a digit"), "{notes}");
    let request = example_part("scale.toml", None, Direction::Output);
    assert_eq!(decoded(&request, &line("READ\r\n")).0, "raw=524541440D0A\n");
}

#[test]
fn the_panels_frames_keep_time_and_interface() {
    let part = example_part("can-panel.toml", None, Direction::Input);
    let data = from_values(&part, None, &["1", "0", "5", "1000", "0x10203", "7"]).unwrap();
    assert_eq!(data, "181#5103E801020307E9");
    let log = format!("(1436509052.249713) can0 {data}\n");
    let (values, notes) = decoded(&part, &log);
    assert_eq!(
        values,
        "(1436509052.249713) can0 id=0x181 start=1 stop=0 program=5 setpoint=1000 pulses=66051 counter=7\n"
    );
    assert_eq!((encoded(&part, &values).unwrap(), notes), (log.clone(), String::new()));
    let wrong = format!("{log}{}{}181#00\n182#00\n", log.replace("E9\n", "E8\n"), "181#5103E8\n");
    let (values, notes) = decoded(&part, &wrong);
    assert_eq!(values.lines().count(), 1);
    assert_eq!(
        notes,
        "line 2: 51 03 E8 01 02 03 07 E8: the checksum is E8 instead of E9, so a receiver rejects the frame\n\
         1 rejected: id 0x181: 1 bytes instead of 8\n1 rejected: id 0x181: 3 bytes instead of 8\n\
         1 rejected: id 0x181: a wrong checksum\n1 rejected: id 0x182 is not in the recipe\n"
    );
}

#[test]
fn a_field_that_is_used_twice_is_one_value() {
    let part = input_part(
        r#"
head = [1]
tail = [13]
fields = [
    { name = "order", type = "byte", bits = "4..7", to = "WordInputReg[1]", commands = { 1 = "stop" } },
    { name = "raw", type = "hex", until = "," },
]
"#,
    );
    assert_eq!(from_values(&part, None, &["3", "0x1F"]).unwrap(), "01 30 31 46 2C 0D");
    // A field with the name of the key for bytes is a field.
    assert_eq!(decoded(&part, "01 30 31 46 2C 0D").0, "order=3 raw=31\n");
}

/// The input part of a stream recipe, with these keys.
fn input_part(keys: &str) -> CompiledPart {
    let toml = format!(
        r#"
[controller]
address = "a"
[[recipe]]
name = "r"
kind = "stream"
mode = "user"
[recipe.input]
{keys}
"#
    );
    let recipes = parse_recipes(Text { name: "test.toml", toml: &toml }, &[]).unwrap();
    CompiledPart::choose(&recipes, None, None).unwrap()
}

/// One with these keys, and with a text `code` behind other fields.
fn text_part(keys: &str, fields: &str) -> CompiledPart {
    let code = "{ name = \"code\", type = \"text\", to = \"WordInputReg[1..4]\" }";
    input_part(&format!("{keys}\nfields = [{fields}{code}]"))
}

#[test]
fn texts_end_with_the_tail() {
    let part = text_part("framing = \"tail\"\ntail = [13, 10]", "");
    let (values, notes) = decoded(&part, "41 42 0D 0A 43 20 5C\n00 E4 0D 0A 0D 0A 44");
    assert_eq!(values, "code=AB\ncode=C\\x20\\\\\\x00\\xE4\ncode=\n");
    assert_eq!(notes, "1 bytes of an unfinished frame at the end\n");
    assert_eq!(encoded(&part, &values).unwrap(), "41 42 0D 0A\n43 20 5C 00 E4 0D 0A\n0D 0A\n");
    assert_eq!(from_values(&part, None, &["A=1"]).unwrap_err(), "there is no field \"A\"; there are code");
    assert_eq!(from_values(&part, None, &["code=A=1"]).unwrap(), "41 3D 31 0D 0A");
    for wrong in ["A\\", "A\\n", "A\\x4", "A\\xGG"] {
        let refused = from_values(&part, None, &[wrong]).unwrap_err();
        assert!(refused.ends_with("a backslash stands only in \\\\ and \\x20"), "{wrong}: {refused}");
    }
    let long = "A".repeat(600);
    assert_eq!(
        from_values(&part, None, &[&long]).unwrap_err(),
        "a text does not fit its field, or a value is not a number"
    );
}

#[test]
fn silence_is_where_a_line_ends() {
    let part = text_part(
        "framing = \"silence\"\nhead = [2]\nchecksum = { kind = \"xor8\" }",
        "{ name = \"n\", type = \"byte\" }, ",
    );
    let (values, notes) = decoded(&part, "02 07 41 44\n02 07 41\n02 07 41 45\n03 07 41 45\n");
    assert_eq!(values, "n=7 code=A\n");
    let lines: Vec<&str> = notes.lines().collect();
    assert!(lines[0].starts_with("line 2: 02 07 41: "), "{notes}");
    assert!(lines[1].starts_with("line 3: 02 07 41 45: the checksum is 45 instead of 44"), "{notes}");
    assert!(lines[2].starts_with("line 4: 03 07 41 45: another length or other constants"), "{notes}");
    assert_eq!(encoded(&part, &values).unwrap(), "02 07 41 44\n");
}

#[test]
fn escape_bytes_are_taken_out_and_put_in() {
    let part = text_part("escape = \"slip\"", "{ name = \"n\", type = \"byte\", bits = \"0..3\" }, ");
    let (values, notes) = decoded(&part, "C0 07 41 DB DC C0 C0 17 42 C0 C0 01 DB 00 C0");
    assert_eq!(values, "n=7 code=A\\xC0\nn=7 code=B raw=1742\n");
    assert_eq!(notes, "line 1: 01 00: then escape bytes that mean nothing\n");
    assert_eq!(encoded(&part, &values).unwrap(), "C0 07 41 DB DC C0\nC0 17 42 C0\n");
}

#[test]
fn a_length_is_no_value() {
    let part = text_part("head = [2]\ntail = [3]", "{ name = \"length\", type = \"byte\", length = true }, ");
    let (values, notes) = decoded(&part, "02 03 41 42 03 02 01 03 FF");
    assert_eq!(
        (values.as_str(), notes.as_str()),
        ("code=AB\ncode=\n", "1 bytes skipped outside of frames\n")
    );
    assert_eq!(encoded(&part, &values).unwrap(), "02 03 41 42 03\n02 01 03\n");
}

const ANY: &str = r#"
[controller]
address = "a"
[[recipe]]
name = "any"
kind = "stream"
mode = "user"
[recipe.input]
head = [0x48, 0xAA]
tail = [13]
endian = "big"
checksum = { kind = "crc16-xmodem", over = "2..", as = "hex" }
fields = [
    { name = "a", type = "byte", bits = "0..2" },
    { name = "b", type = "byte", bits = "5..7", signed = true },
    { pad = 2 },
    { name = "c", type = "float", word_order = "low-first" },
    { name = "d", type = "int24" },
    { name = "e", type = "bcd", width = 2 },
    { name = "f", type = "double" },
    { name = "g", type = "decimal", width = 5 },
    { name = "h", type = "hex", width = 3 },
]
"#;

proptest! {
    #[test]
    fn what_decode_prints_encode_turns_into_the_same_bytes(
        binary in any::<[u8; 20]>(), text in "[ +-][0-9]{2}[.0-9][0-9][0-9a-fA-F]{3}",
    ) {
        let recipes = parse_recipes(Text { name: "any.toml", toml: ANY }, &[]).unwrap();
        let part = CompiledPart::choose(&recipes, None, None).unwrap();
        let mut frame = [&[0x48, 0xAA], &binary[..10], &[0x12, 0x34], &binary[12..], text.as_bytes()].concat();
        let mut crc = [0; 2];
        ByteOrder::Big.write(u64::from(Algorithm::named("crc16-xmodem").unwrap().of([&frame[2..]])), &mut crc);
        frame.extend(format!("{:02X}{:02X}\r", crc[0], crc[1]).bytes());
        let log = text::hex(&frame) + "\n";
        let values = decoded(&part, &log).0;
        prop_assert_eq!(encoded(&part, &values).unwrap(), log);
    }

    #[test]
    fn any_text_is_shown_in_one_word_and_read_back(text in prop::collection::vec(any::<u8>(), 0..100)) {
        let shown = text::show_text(&text);
        prop_assert!(shown.bytes().all(|byte| byte.is_ascii_graphic()));
        prop_assert_eq!(text::parse_text(&shown).unwrap(), text);
    }

    #[test]
    fn escaped_frames_are_read_back(escape in prop::sample::select(vec!["dle", "slip", "cobs"]), texts in prop::collection::vec(prop::collection::vec(any::<u8>(), 1..100), 1..4)) {
        let part = text_part(&format!("escape = \"{escape}\""), "");
        let values: String = texts.iter().map(|text| format!("code={}\n", text::show_text(text))).collect();
        let log = encoded(&part, &values).unwrap();
        prop_assert_eq!(decoded(&part, &log), (values, String::new()));
    }

    #[test]
    fn any_bytes_are_decoded_or_told_of(bytes in prop::collection::vec(any::<u8>(), 0..80)) {
        let parts = [
            exchange_part("gripper.toml", 1, ExchangePart::Reply),
            example_part("force-sensor-crc.toml", Some("force-sensor"), Direction::Input),
            example_part("scale.toml", None, Direction::Input),
        ];
        for part in parts {
            let (mut out, mut notes) = (Vec::new(), Vec::new());
            let log = format!("{}\n", text::hex(&bytes));
            // A frame by chance is possible, a panic is not.
            let frames = decode_lines(&part, log.as_bytes(), &mut out, &mut notes);
            prop_assert!(frames.is_ok() || out.is_empty());
        }
    }
}

/// A battery whose frames have one id, and the number of the first cell tells them apart.
const BATTERY: &str = r#"
[controller]
address = "192.168.1.10"

[[recipe]]
name = "battery"
kind = "can"
mode = "user"

[[recipe.input.frame]]
id = 0x200
fields = [{ name = "first", type = "byte", equals = 1 }, { name = "volt", type = "word", to = "WordInputReg[1]" }]

[[recipe.input.frame]]
id = 0x200
fields = [{ name = "first", type = "byte", equals = 3 }, { name = "volt", type = "word", to = "WordInputReg[2]" }]

[[recipe.input.frame]]
id = 0x200
fields = [{ name = "first", type = "byte", equals = 9 }, { name = "celsius", type = "byte", to = "WordInputReg[3]" }]
"#;

#[test]
fn frames_with_one_id_are_shown_and_made_by_their_constant() {
    let recipes = parse_recipes(Text { name: "battery.toml", toml: BATTERY }, &[]).unwrap();
    let part = CompiledPart::choose(&recipes, None, Some(Direction::Input)).unwrap();
    let lines = "200#030A00\n200#0937\n200#010B00\n";
    let values = "id=0x200 first=3 volt=10\nid=0x200 first=9 celsius=55\nid=0x200 first=1 volt=11\n";
    assert_eq!(decoded(&part, lines), (values.into(), String::new()));
    assert_eq!(encoded(&part, values).unwrap(), lines);
    let id = || Some(0x200);
    assert_eq!(from_values(&part, id(), &["celsius=55"]).unwrap(), "200#0937");
    let two = from_values(&part, id(), &["volt=10"]).unwrap_err();
    assert!(two.starts_with("several frames with this id can have these values"), "{two}");
    let none = from_values(&part, id(), &["first=2", "volt=10"]).unwrap_err();
    assert_eq!(none, "first: this frame has another constant");
    let (shown, notes) = decoded(&part, "200#040A00\n200#0937\n");
    assert_eq!(shown, "id=0x200 first=9 celsius=55\n");
    assert!(notes.contains("id 0x200: other constants, so not this frame"), "{notes}");
}
