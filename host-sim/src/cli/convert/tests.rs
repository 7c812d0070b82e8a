use proptest::prelude::*;
use proto_core::sysvar::Direction;

use super::*;
use recipe_config::file::{Text, parse_recipes};

const STREAM: &str = r#"
[robot]
[[recipe]]
name = "pose"
kind = "stream"
mode = "realtime"
[recipe.input]
head = [255, 255]
tail = [238, 238]
fields = ["DigitalOutputCommand[1]"]
[recipe.output]
head = [255, 255]
tail = [254, 254]
fields = ["RobotState[8..13]"]
"#;

const CAN: &str = r#"
[robot]
[[recipe]]
name = "mixed"
kind = "can"
mode = "user"
[[recipe.output.frame]]
id = 2
fields = [{ name = "x", type = "float" }, { name = "y", type = "float" }]
[[recipe.output.frame]]
id = 0x1ABCDEF0
extended = true
fields = [{ name = "a", type = "char" }, { name = "b", type = "word" }, { name = "c", type = "int" }]
[[recipe.output.frame]]
id = 0x7FF
fields = [{ name = "d", type = "double" }]
"#;

fn part(toml: &str, part: Direction) -> CompiledPart {
    let recipes = parse_recipes(Text { name: "test.toml", toml }, &[]).unwrap();
    CompiledPart::choose(&recipes, None, Some(part)).unwrap()
}

/// The output of `decode`, and its notes.
pub(super) fn decoded(part: &CompiledPart, input: &str) -> (String, String) {
    let (mut out, mut notes) = (Vec::new(), Vec::new());
    decode_lines(part, input.as_bytes(), &mut out, &mut notes).unwrap();
    (String::from_utf8(out).unwrap(), String::from_utf8(notes).unwrap())
}

pub(super) fn encoded(part: &CompiledPart, input: &str) -> Result<String, String> {
    let mut out = Vec::new();
    encode_lines(part, None, input.as_bytes(), &mut out)?;
    Ok(String::from_utf8(out).unwrap())
}

pub(super) fn from_values(part: &CompiledPart, id: Option<u32>, values: &[&str]) -> Result<String, String> {
    let values: Vec<String> = values.iter().map(|&value| value.to_owned()).collect();
    let mut out = Vec::new();
    encode_values(part, id, &values, &mut out)?;
    Ok(String::from_utf8(out).unwrap().trim_end().to_owned())
}

const POSE: &str = "FF FF 39 2F 0B BF 86 87 13 3F BF BD 9D 3F 37 FC C8 BF 17 A0 1B BF 59 FC EA BE FE FE";

#[test]
fn the_pose_of_worked_example_5_has_its_values_and_units() {
    let part = part(STREAM, Direction::Output);
    let (values, notes) = decoded(&part, POSE);
    assert_eq!(
        values,
        "RobotState[8]=-0.5436893 m RobotState[9]=0.5762867 m RobotState[10]=1.2323531 m \
         RobotState[11]=-1.570197 rad RobotState[12]=-0.6079115 rad RobotState[13]=-0.4589565 rad\n"
    );
    assert_eq!(notes, "");
    assert_eq!(encoded(&part, &values).unwrap().trim_end(), POSE);
}

#[test]
fn values_stand_in_order_or_by_name() {
    let input = part(STREAM, Direction::Input);
    for values in ["1", "0x01", "DigitalOutputCommand[1]=1", "1.0"] {
        assert_eq!(from_values(&input, None, &[values]).unwrap(), "FF FF 01 EE EE", "{values}");
    }
    let can = part(CAN, Direction::Output);
    assert_eq!(from_values(&can, Some(2), &["0.46744487", "0.4099705"]).unwrap(), "002#EF54EF3EA7E7D13E");
    assert_eq!(from_values(&can, Some(2), &["y=0.4099705", "0.46744487"]).unwrap(), "002#EF54EF3EA7E7D13E");
}

#[test]
fn wrong_values_are_refused_by_name() {
    let can = part(CAN, Direction::Output);
    let refused = |id, values: &[&str]| from_values(&can, id, values).unwrap_err();
    assert_eq!(refused(None, &["1"]), "several frames; choose one with --id ID: 0x002, 0x1ABCDEF0, 0x7FF");
    assert_eq!(refused(Some(3), &["1"]), "id 0x3 is not in this part; there are 0x002, 0x1ABCDEF0, 0x7FF");
    assert_eq!(refused(Some(2), &["1"]), "no value for y");
    assert_eq!(refused(Some(2), &["1", "2", "3"]), "too many values, from \"3\" on; the fields are x, y");
    assert_eq!(refused(Some(2), &["z=1"]), "there is no field \"z\"; there are x, y");
    assert_eq!(refused(Some(2), &["x=1", "x=1"]), "field \"x\" is given twice");
    assert_eq!(refused(Some(2), &["1", "1e300"]), "y: \"1e300\" is not a number");
    assert_eq!(refused(Some(0x1ABC_DEF0), &["200", "0", "0"]), "a: 200 does not fit in a char (-128..=127)");
    assert_eq!(
        refused(Some(0x1ABC_DEF0), &["1", "0.5", "0"]),
        "b: 0.5 is not an integer, but a word must be"
    );
}

#[test]
fn frames_are_found_wherever_lines_and_garbage_cut_them() {
    let part = part(STREAM, Direction::Input);
    let log = "# a tap\n> 2026/01/01 10:00:00 length=9\n 00 FF FF FF 01\nEE EE ff\nFF02EEEE 0xFF,0xFF";
    let (values, notes) = decoded(&part, log);
    assert_eq!(values, "DigitalOutputCommand[1]=1\nDigitalOutputCommand[1]=2\n");
    assert!(notes.contains("2 bytes skipped outside of frames"), "{notes}");
    assert!(notes.contains("2 bytes of an unfinished frame at the end"), "{notes}");
}

#[test]
fn what_is_not_hex_or_not_can_names_its_line() {
    let stream = part(STREAM, Direction::Input);
    let (mut out, mut notes) = (Vec::new(), Vec::new());
    let mut refused = |part: &CompiledPart, log: &str| {
        decode_lines(part, log.as_bytes(), &mut out, &mut notes).unwrap_err()
    };
    assert_eq!(refused(&stream, "FF\nF"), "line 2: \"F\" is not hexadecimal with two digits for each byte");
    assert_eq!(refused(&stream, "FF GG"), "line 1: \"GG\" is not hexadecimal with two digits for each byte");
    assert_eq!(refused(&stream, "FF é"), "line 1: \"é\" is not hexadecimal with two digits for each byte");
    assert_eq!(refused(&stream, ""), "the input has no frame of this recipe");
    let can = part(CAN, Direction::Output);
    assert_eq!(
        refused(&can, "can0 FF FF"),
        "line 1: \"can0 FF FF\" is not a CAN frame; write 123#AABB, (time) can0 123#AABB, or can0 123 [2] AA BB"
    );
    assert_eq!(
        refused(&can, "1234#00"),
        "line 1: \"1234\" is not a CAN id; write three hexadecimal digits, or eight for an extended id"
    );
    assert_eq!(
        refused(&can, "800#00"),
        "line 1: \"800\" is not a CAN id; write three hexadecimal digits, or eight for an extended id"
    );
    assert_eq!(refused(&can, "  can0  002   [2]  11"), "line 1: fewer than 2 bytes");
    assert_eq!(refused(&can, "(1.0 can0 002#00"), "line 1: a time without ')'");
}

#[test]
fn a_candump_log_replays_byte_for_byte() {
    let part = part(CAN, Direction::Output);
    let log = "\
(1436509052.249713) can0 002#EF54EF3EA7E7D13E
(1436509052.253713) vcan0 1ABCDEF0#80FFFF00000080
(1436509052.257713) can0 7FF#182D4454FB210940
(1436509052.261713) can0 002#0000C07FFFFFFFFF
(1436509052.265713) can0 002#0000807F00000080
  can0  002   [8]  EF 54 EF 3E A7 E7 D1 3E
  can0  1ABCDEF0   [7]  00 01 02 03 04 05 06
002#0000000000000000
";
    let (values, notes) = decoded(&part, log);
    assert!(values.starts_with("(1436509052.249713) can0 id=0x002 x=0.46744487 y=0.4099705\n"), "{values}");
    assert!(values.contains("id=0x1ABCDEF0 a=-128 b=65535 c=-2147483648\n"), "{values}");
    assert!(values.contains("x=nan:0x7FC00000 y=nan:0xFFFFFFFF\n"), "{values}");
    assert!(values.contains("x=inf y=-0\n"), "{values}");
    assert_eq!(encoded(&part, &values).unwrap(), log);
    assert!(notes.contains("line 4: a receiver rejects this frame"), "{notes}");
}

#[test]
fn what_no_recipe_takes_is_counted_by_reason() {
    let part = part(CAN, Direction::Output);
    let log = "\
002#EF54EF3EA7E7D13E
003#00
003#01
002#00
002#R
  can0  002   [0]  remote request
002##1AABB
  can0  20000004   [8]  00 00 00 00 00 00 00 00   ERRORFRAME
";
    let (values, notes) = decoded(&part, log);
    assert_eq!(values.lines().count(), 1);
    assert_eq!(
        notes,
        "1 rejected: a CAN FD frame\n2 rejected: a remote frame\n1 rejected: an error frame\n\
         1 rejected: id 0x002: 1 bytes instead of 8\n2 rejected: id 0x003 is not in the recipe\n"
    );
}

#[test]
fn a_datagram_without_head_and_tail_is_one_line() {
    let toml = STREAM.replace("head = [255, 255]", "head = []").replace("tail = [254, 254]", "");
    let part = part(&toml, Direction::Output);
    let payload = &POSE[6..POSE.len() - 6];
    let (values, _) = decoded(&part, payload);
    assert_eq!(encoded(&part, &values).unwrap().trim_end(), payload);
    let (mut out, mut notes) = (Vec::new(), Vec::new());
    let short = decode_lines(&part, &b"00 11"[..], &mut out, &mut notes);
    assert_eq!(short.unwrap_err(), "the input has no frame of this recipe");
    assert_eq!(String::from_utf8(notes).unwrap(), "line 1: a frame is 24 bytes, the datagram 2\n");
}

proptest! {
    #[test]
    fn any_payload_survives_decode_and_encode(
        x in any::<[u8; 8]>(), y in any::<[u8; 7]>(), z in any::<[u8; 8]>(), pose in any::<[u8; 24]>(),
    ) {
        let can = part(CAN, Direction::Output);
        let digits = |bytes: &[u8]| text::hex(bytes).replace(' ', "");
        let log = format!("002#{}\n1ABCDEF0#{}\n7FF#{}\n", digits(&x), digits(&y), digits(&z));
        prop_assert_eq!(encoded(&can, &decoded(&can, &log).0).unwrap(), log);

        let stream = part(STREAM, Direction::Output);
        let frame = format!("FF FF {} FE FE\n", text::hex(&pose));
        // Payload bytes may look like a head, but a frame at the front is found first.
        prop_assert_eq!(encoded(&stream, &decoded(&stream, &frame).0).unwrap(), frame);
    }
}

const FORCES: &str = r#"
[controller]
address = "127.0.0.1"
[[recipe]]
name = "force"
kind = "stream"
mode = "user"
[recipe.input]
head = [0x48, 0xAA]
tail = [0x0D, 0x0A]
fields = [
  { name = "Fx", type = "float", to = "WordInputReg[1]", scale = 100, offset = 32768 },
  { name = "Fy", type = "float", to = "WordInputReg[2]" },
]
"#;

#[test]
fn a_value_that_a_gateway_rejects_is_named() {
    // As a recipe of the controller's own kind, and as the frame of a device.
    let constant = "{ name = \"id\", type = \"byte\", equals = 9 },";
    for (more, byte, what) in [("", "", "frame"), (constant, "09 ", "field")] {
        let why = format!(
            "line 1: a gateway rejects this {what}: Fx is 400; WordInputReg[1] takes -327.68..=327.67\n"
        );
        let toml = FORCES.replacen("  { name = \"Fy\"", &format!("{more}\n  {{ name = \"Fy\""), 1);
        let text = Text { name: "test.toml", toml: &toml };
        let mut part = part(&toml, Direction::Input);
        part.bind(&recipe_config::file::parse_frames(text, &[]).unwrap());
        let (values, notes) = decoded(&part, &format!("48 AA 00 00 C8 43 {byte}00 00 80 3F 0D 0A"));
        assert_eq!(notes, why, "{values}");
        let (_, notes) = decoded(&part, &format!("48 AA 00 00 80 3F {byte}00 00 80 3F 0D 0A"));
        assert_eq!(notes, "");
    }
}
