//! The six worked examples of the controller's recipes, byte for byte (docs/wire/recipes.md
//! section 8). These vectors are frozen: a change that breaks one breaks every robot.

use proto_core::recipe::model::{Field, Framing, Mode, Rules};
use proto_core::recipe::{CanLayout, Deframer, StreamLayout, datagram};
use proto_core::sysvar::{Direction, IMAGE_BYTES, ModbusPlace, SysVar, VarRange};
use proto_core::wire::can::{CanFrame, CanId};
use proto_core::wire::scalar::Scalar::{self, Byte, Float};
use proto_core::wire::scalar::ScalarType;

type Image = [u8; IMAGE_BYTES];

/// Bytes as the specification prints them.
fn hex(text: &str) -> Vec<u8> {
    text.split_whitespace().map(|byte| u8::from_str_radix(byte, 16).unwrap()).collect()
}

fn rules(mode: Mode, direction: Direction) -> Rules {
    Rules { mode, direction }
}

/// The variables of these names, as fields.
fn system(names: &[&str]) -> Vec<Field> {
    names.iter().flat_map(|name| VarRange::parse(name).unwrap().iter().map(Field::System)).collect()
}

fn stream(mode: Mode, direction: Direction, delimiters: [[u8; 2]; 2], fields: Vec<Field>) -> StreamLayout {
    let [head, tail] = delimiters;
    StreamLayout::new(rules(mode, direction), &head, &tail, fields, Framing::Bytes).unwrap()
}

const INPUT: [[u8; 2]; 2] = [[255, 255], [238, 238]];
const OUTPUT: [[u8; 2]; 2] = [[255, 255], [254, 254]];

fn read(image: &Image, name: &str) -> Scalar {
    let var = SysVar::parse(name).unwrap();
    Scalar::decode(var.ty(), &image[var.image_offset()..]).unwrap()
}

fn write(image: &mut Image, name: &str, value: Scalar) {
    let var = SysVar::parse(name).unwrap();
    assert_eq!(value.ty(), var.ty());
    value.encode(&mut image[var.image_offset()..]).unwrap();
}

/// Encodes the image and asserts that nothing but the frame was written.
#[track_caller]
fn assert_encodes(layout: &StreamLayout, image: &Image, frame: &str) {
    let frame = hex(frame);
    let mut out = [0xA5; 600];
    assert_eq!(layout.encode(image, &mut out), Ok(frame.len()));
    assert_eq!(out[..frame.len()], frame);
    assert!(out[frame.len()..].iter().all(|&byte| byte == 0xA5));
}

#[test]
fn example_1_rs485_user_defined() {
    let bytes = vec![Field::User(ScalarType::Byte); 3];
    let input = stream(Mode::User, Direction::Input, INPUT, bytes.clone());
    let mut deframer = Deframer::new();
    let line = hex("FF FF 01 02 03 EE EE");
    let mut chunk = &line[..];
    let payload = deframer.next_frame(&input, &mut chunk).unwrap();
    assert!(input.values(payload).eq([Byte(1), Byte(2), Byte(3)]));
    assert!(deframer.next_frame(&input, &mut chunk).is_none());

    let output = stream(Mode::User, Direction::Output, OUTPUT, bytes);
    let mut out = [0xA5; 8];
    assert_eq!(output.encode_values(&[Byte(125); 3], &mut out), Ok(7));
    assert_eq!(out[..], hex("FF FF 7D 7D 7D FE FE A5"));
}

#[test]
fn example_2_rs485_system() {
    let input = stream(Mode::Realtime, Direction::Input, INPUT, system(&["DigitalOutputCommand[1]"]));
    let mut image = [0; IMAGE_BYTES];
    let line = hex("FF FF 01 EE EE");
    let mut deframer = Deframer::new();
    let payload = deframer.next_frame(&input, &mut &line[..]).unwrap();
    input.apply(payload, &mut image).unwrap();
    assert_eq!(read(&image, "DigitalOutputCommand[1]"), Byte(1));
    let coil = SysVar::parse("DigitalOutputCommand[1]").unwrap().modbus();
    assert_eq!(coil, Some(ModbusPlace::Coils { first: 192, count: 8 }), "bit 0 is coil 192");

    let output = stream(Mode::Realtime, Direction::Output, OUTPUT, system(&["RobotState[8..11]"]));
    for (nth, value) in [0.5_f32, -0.25, 1.0, 3.0].into_iter().enumerate() {
        write(&mut image, &format!("RobotState[{}]", nth + 8), Float(value));
    }
    assert_encodes(&output, &image, "FF FF 00 00 00 3F 00 00 80 BE 00 00 80 3F 00 00 40 40 FE FE");
}

#[test]
fn example_3_can_user_defined() {
    let three = [Field::User(ScalarType::Byte); 3];
    let part =
        |direction, id| CanLayout::new(rules(Mode::User, direction), [(CanId::Standard(id), three)]).unwrap();
    let input = part(Direction::Input, 1);
    let received = CanFrame::new(CanId::Standard(1), &hex("01 02 03")).unwrap();
    let frame = input.frame(input.accept(&received).unwrap()).unwrap();
    assert_eq!(frame.id(), CanId::Standard(1));
    assert!(frame.values(received.data()).eq([Byte(1), Byte(2), Byte(3)]));

    let output = part(Direction::Output, 2);
    let sent = output.frame(0).unwrap().encode_values(&[Byte(125); 3]).unwrap();
    assert_eq!((sent.id(), sent.data()), (CanId::Standard(2), &hex("7D 7D 7D")[..]), "D23");
}

#[test]
fn example_4_can_system() {
    let id = CanId::Standard;
    let fields = system(&["DigitalOutputCommand[1]"]);
    let input = CanLayout::new(rules(Mode::Realtime, Direction::Input), [(id(1), fields)]).unwrap();
    let mut image = [0; IMAGE_BYTES];
    let received = CanFrame::new(id(1), &hex("01")).unwrap();
    let index = input.accept(&received).unwrap();
    input.frame(index).unwrap().apply(received.data(), &mut image).unwrap();
    assert_eq!(read(&image, "DigitalOutputCommand[1]"), Byte(1));

    let pairs = [(2, "RobotState[8..9]"), (3, "RobotState[10..11]"), (4, "RobotState[12..13]")];
    let frames = pairs.map(|(number, names)| (id(number), system(&[names])));
    let output = CanLayout::new(rules(Mode::Realtime, Direction::Output), frames).unwrap();
    assert!(output.ids().eq([id(2), id(3), id(4)]));
    let captured = CanFrame::new(id(2), &hex("EF 54 EF 3E A7 E7 D1 3E")).unwrap();
    let pose = output.frame(output.accept(&captured).unwrap()).unwrap();
    for (value, expected) in pose.values(captured.data()).zip([0.467445, 0.409970]) {
        assert!((value.as_f64() - expected).abs() < 0.000_001, "{value} is not {expected}");
    }
    pose.apply(captured.data(), &mut image).unwrap();
    assert_eq!(read(&image, "RobotState[8]"), Float(f32::from_le_bytes([0xEF, 0x54, 0xEF, 0x3E])));
    assert_eq!(pose.encode(&image), captured);
}

#[test]
fn example_5_udp_2011() {
    let pose = system(&["RobotState[8..13]"]);
    let [head, tail] = OUTPUT;
    let rules_out = rules(Mode::Realtime, Direction::Output);
    let output = StreamLayout::new(rules_out, &head, &tail, pose, Framing::Datagram).unwrap();
    let dump = "FF FF 39 2F 0B BF 86 87 13 3F BF BD 9D 3F 37 FC C8 BF 17 A0 1B BF 59 FC EA BE FE FE";
    let received = hex(dump);
    let payload = datagram(&output, &received).unwrap();
    let expected = [-0.543689, 0.576287, 1.232353, -1.570197, -0.607912, -0.458957];
    assert_eq!(output.values(payload).count(), expected.len());
    for (value, expected) in output.values(payload).zip(expected) {
        assert!((value.as_f64() - expected).abs() < 0.000_001, "{value} is not {expected}");
    }
    let mut image = [0; IMAGE_BYTES];
    output.apply(payload, &mut image).unwrap();
    assert_eq!(read(&image, "RobotState[13]"), Float(f32::from_le_bytes([0x59, 0xFC, 0xEA, 0xBE])));
    assert_encodes(&output, &image, dump);

    let [head, tail] = INPUT;
    let fields = system(&["DigitalOutputCommand[1]"]);
    let rules_in = rules(Mode::Realtime, Direction::Input);
    let input = StreamLayout::new(rules_in, &head, &tail, fields, Framing::Datagram).unwrap();
    assert_eq!(datagram(&input, &hex("FF FF 01 EE EE")), Ok(&[1][..]));
}

#[test]
fn example_6_tcp_client() {
    // One connection carries frames both ways; TCP may cut and join them anywhere.
    let input = stream(Mode::Realtime, Direction::Input, INPUT, system(&["DigitalOutputCommand[1]"]));
    let received = hex("FF FF 01 EE EE FF FF 00 EE EE");
    for cut in 0..=received.len() {
        let mut deframer = Deframer::new();
        let mut commands = vec![];
        let (first, second) = received.split_at(cut);
        for mut chunk in [first, second] {
            while let Some(payload) = deframer.next_frame(&input, &mut chunk) {
                commands.push(payload[0]);
            }
        }
        assert_eq!(commands, [1, 0], "cut at {cut}");
    }
}
