use std::string::ToString;
use std::vec;
use std::vec::Vec;

use proptest::prelude::*;

use super::*;
use crate::recipe::model::MAX_FIELDS;
use crate::sysvar::{Direction, SysVar, VarRange};
use crate::wire::scalar::ScalarType;

const REALTIME_IN: Rules = Rules { mode: Mode::Realtime, direction: Direction::Input };
const REALTIME_OUT: Rules = Rules { mode: Mode::Realtime, direction: Direction::Output };
const USER_IN: Rules = Rules { mode: Mode::User, direction: Direction::Input };

fn var(name: &str) -> SysVar {
    SysVar::parse(name).unwrap()
}

fn system(names: &[&str]) -> Vec<Field> {
    names.iter().flat_map(|name| VarRange::parse(name).unwrap().iter().map(Field::System)).collect()
}

fn bytes(count: usize) -> Vec<Field> {
    vec![Field::User(ScalarType::Byte); count]
}

/// A part with a one-byte head and tail.
fn part(rules: Rules, fields: Vec<Field>) -> Result<StreamLayout, PartError> {
    StreamLayout::new(rules, &[0xFF], &[0xFE], fields, Framing::Bytes)
}

fn at(field: u8) -> FieldPlace {
    FieldPlace { frame: None, field }
}

fn image_byte(image: &[u8; IMAGE_BYTES], name: &str) -> u8 {
    image[var(name).image_offset()]
}

#[track_caller]
fn assert_refused(rules: Rules, fields: Vec<Field>, expected: PartError, message: &str) {
    let error = part(rules, fields).unwrap_err();
    assert_eq!(error, expected);
    assert_eq!(error.to_string(), message);
}

#[test]
fn fields_that_break_a_rule_are_named() {
    assert_refused(
        REALTIME_IN,
        vec![],
        PartError::NoFields { frame: None },
        "a part needs 1..=128 fields; this one has none",
    );
    assert_refused(
        USER_IN,
        bytes(129),
        PartError::TooManyFields { at: at(128) },
        "field 129 is one too many; a part has at most 128",
    );
    assert_refused(
        REALTIME_IN,
        system(&["ForceEnd[1]", "RobotState[8]"]),
        PartError::WrongDirection { at: at(1), var: var("RobotState[8]"), part: Direction::Input },
        "field 2: RobotState[8] is an output of the robot and cannot be in an input part",
    );
    assert_refused(
        REALTIME_OUT,
        system(&["WordInputReg[3]"]),
        PartError::WrongDirection { at: at(0), var: var("WordInputReg[3]"), part: Direction::Output },
        "field 1: WordInputReg[3] is an input of the robot and cannot be in an output part",
    );
    assert_refused(
        REALTIME_IN,
        vec![Field::System(var("ForceEnd[1]")), Field::User(ScalarType::Float)],
        PartError::WrongMode { at: at(1), mode: Mode::Realtime },
        "field 2 is user-defined; a realtime recipe has only system variables",
    );
    assert_refused(
        USER_IN,
        system(&["ForceEnd[1]"]),
        PartError::WrongMode { at: at(0), mode: Mode::User },
        "field 1 is a system variable; a user-defined recipe has only typed fields",
    );
    assert_refused(
        REALTIME_IN,
        system(&["WordInputReg[1..3]", "WordInputReg[2]"]),
        PartError::DuplicateVariable { at: at(3), first: at(1), var: var("WordInputReg[2]") },
        "field 4: WordInputReg[2] is already field 2",
    );
    let error = part(USER_IN, bytes(129)).unwrap_err();
    assert_eq!((error.field(), error.frame()), (Some(at(128)), None));
    part(USER_IN, bytes(128)).unwrap();
    part(REALTIME_OUT, system(&["RobotState[8]", "RobotState[8]"])).expect("an output may be sent twice");
}

#[test]
fn lengths_are_limited() {
    let new = |head: &[u8], tail: &[u8], fields, framing| {
        StreamLayout::new(USER_IN, head, tail, fields, framing).map(|layout| layout.frame_len())
    };
    assert_eq!(new(&[1; 8], &[2; 8], bytes(1), Framing::Bytes), Ok(17));
    let error = new(&[1; 9], &[], bytes(1), Framing::Bytes).unwrap_err();
    assert_eq!(error.to_string(), "the head has 9 bytes; at most 8 are allowed");
    let error = new(&[], &[1; 300], bytes(1), Framing::Bytes).unwrap_err();
    assert_eq!(error.to_string(), "the tail has 300 bytes; at most 8 are allowed");
    assert_eq!(new(&[], &[], bytes(1), Framing::Bytes), Err(PartError::NoDelimiter));
    assert_eq!(new(&[1], &[], bytes(1), Framing::Datagram), Err(PartError::UserDatagram));
    let doubles = |count| vec![Field::User(ScalarType::Double); count];
    assert_eq!(new(&[1; 4], &[2; 4], doubles(63), Framing::Bytes), Ok(512));
    let error = new(&[1; 4], &[2; 5], doubles(63), Framing::Bytes).unwrap_err();
    assert_eq!(error, PartError::StreamFrameTooLong { len: 513 });
    let pose = system(&["RobotState[8..13]"]);
    let bare = StreamLayout::new(REALTIME_OUT, &[], &[], pose, Framing::Datagram).unwrap();
    assert_eq!((bare.frame_len(), bare.payload_len()), (24, 24));
}

#[test]
fn a_layout_shows_what_it_was_made_of() {
    let fields = system(&["DigitalOutputCommand[3]", "WordInputReg[1..2]", "ForceEnd[1]"]);
    let layout = StreamLayout::new(REALTIME_IN, &[1, 2], &[3], fields.clone(), Framing::Bytes).unwrap();
    assert_eq!((layout.head(), layout.tail(), layout.rules()), (&[1, 2][..], &[3][..], REALTIME_IN));
    assert!(layout.fields().map(|placed| placed.field).eq(fields));
    assert!(layout.fields().map(|placed| placed.offset).eq([0, 1, 3, 5]));
    assert!(size_of::<StreamLayout>() <= 840, "{}", size_of::<StreamLayout>());
}

#[test]
fn reserved_bits_are_masked_and_counted() {
    let layout = part(REALTIME_IN, system(&["DigitalOutputCommand[1..3]"])).unwrap();
    let mut image = [0xA5; IMAGE_BYTES];
    assert_eq!(layout.apply(&[0xFF, 0x80, 0b11], &mut image), Ok(Applied { masked: 0 }));
    assert_eq!(layout.apply(&[0xFF, 0x80, 0b101], &mut image), Ok(Applied { masked: 1 }));
    assert_eq!(image_byte(&image, "DigitalOutputCommand[1]"), 0xFF);
    assert_eq!(image_byte(&image, "DigitalOutputCommand[2]"), 0x80);
    assert_eq!(image_byte(&image, "DigitalOutputCommand[3]"), 0b01);
    assert_eq!(image_byte(&image, "BitInputReg[1]"), 0xA5, "a neighbour that is not in the part");
}

#[test]
fn a_float_that_is_not_finite_rejects_the_whole_frame() {
    let layout = part(REALTIME_IN, system(&["WordInputReg[1]", "ForceEnd[1..6]"])).unwrap();
    let mut payload = [0; 26];
    for bad in [f32::NAN, f32::INFINITY, f32::NEG_INFINITY, f32::from_bits(0xFF80_0001)] {
        for field in 1..=6 {
            let mut payload = payload;
            payload[0] = 7;
            payload[4 * field - 2..][..4].copy_from_slice(&bad.to_le_bytes());
            let mut image = [0xA5; IMAGE_BYTES];
            let error = ValueError::NotFinite { field: field as u8 };
            assert_eq!(layout.apply(&payload, &mut image), Err(error));
            assert_eq!(layout.check(&payload), Err(error));
            assert_eq!(image, [0xA5; IMAGE_BYTES], "all or nothing");
        }
    }
    payload[2..6].copy_from_slice(&f32::MAX.to_le_bytes());
    payload[6..10].copy_from_slice(&f32::MIN_POSITIVE.to_le_bytes());
    assert_eq!(layout.apply(&payload, &mut [0; IMAGE_BYTES]), Ok(Applied::default()));
    let error = ValueError::Length { expected: 26, got: 25 };
    assert_eq!(layout.apply(&payload[..25], &mut [0; IMAGE_BYTES]), Err(error));
}

#[test]
fn a_payload_of_another_length_is_refused() {
    for names in [&["ForceEnd[1..6]"][..], &["WordInputReg[1]"], &["WordInputReg[1]", "ForceEnd[1..6]"]] {
        let layout = part(REALTIME_IN, system(names)).unwrap();
        let expected = layout.payload_len();
        for got in (0..=expected + 8).filter(|&got| got != expected) {
            let mut image = [0xA5; IMAGE_BYTES];
            let error = ValueError::Length { expected, got };
            assert_eq!(layout.apply(&vec![0; got], &mut image), Err(error), "{names:?}");
            assert_eq!(image, [0xA5; IMAGE_BYTES], "all or nothing");
        }
    }
}

#[test]
fn long_runs_of_neighbours_are_moved_whole() {
    for (direction, first) in
        [(Direction::Input, "DigitalOutputCommand[1]"), (Direction::Output, "RobotState[1]")]
    {
        // The longest sequences of adjacent bits, words and floats in a part.
        let start = var(first).ordinal();
        let vars = (start..).map_while(SysVar::from_ordinal).take(MAX_FIELDS);
        let vars: Vec<SysVar> = vars.filter(|var| var.direction() == direction).collect();
        let layout =
            part(Rules { mode: Mode::Realtime, direction }, vars.iter().map(|&v| Field::System(v)).collect());
        let layout = layout.unwrap();
        let place = vars[0].image_offset()..vars[0].image_offset() + layout.payload_len();
        let mut image = [0; IMAGE_BYTES];
        // Bytes below 0x3F never form a float that is not finite.
        for (at, byte) in image[place.clone()].iter_mut().enumerate() {
            *byte = (at % 0x3F) as u8;
        }
        let mut out = [0xA5; MAX_STREAM_FRAME];
        assert_eq!(layout.encode(&image, &mut out), Ok(layout.payload_len() + 2));
        let payload = &out[1..][..layout.payload_len()];
        assert_eq!(payload, &image[place.clone()]);
        let mut target = [0xA5; IMAGE_BYTES];
        layout.apply(payload, &mut target).unwrap();
        for &var in &vars {
            let place = var.image_offset()..var.image_offset() + var.size();
            if var.valid_bits() == 0xFF {
                assert_eq!(target[place.clone()], image[place], "{var}");
            }
        }
        assert!(target[..place.start].iter().chain(&target[place.end..]).all(|&byte| byte == 0xA5));
    }
}

#[test]
fn user_defined_floats_and_doubles_are_checked_too() {
    let types = [ScalarType::Byte, ScalarType::Double, ScalarType::Float];
    let layout = part(USER_IN, types.map(Field::User).to_vec()).unwrap();
    let mut payload = [0xFF; 13];
    payload[1..9].copy_from_slice(&1.0_f64.to_le_bytes());
    payload[9..].copy_from_slice(&1.0_f32.to_le_bytes());
    let mut image = [0xA5; IMAGE_BYTES];
    assert_eq!(layout.apply(&payload, &mut image), Ok(Applied::default()));
    assert_eq!(image, [0xA5; IMAGE_BYTES], "user-defined fields have no place in the image");
    payload[1..9].copy_from_slice(&f64::NEG_INFINITY.to_le_bytes());
    assert_eq!(layout.check(&payload), Err(ValueError::NotFinite { field: 1 }));
    payload[1..9].fill(0);
    payload[9..].copy_from_slice(&f32::NAN.to_le_bytes());
    assert_eq!(layout.check(&payload), Err(ValueError::NotFinite { field: 2 }));
}

#[test]
fn encoding_needs_space_and_the_right_values() {
    let layout = part(USER_IN, vec![Field::User(ScalarType::Byte), Field::User(ScalarType::Short)]).unwrap();
    let good = [Scalar::Byte(1), Scalar::Short(-2)];
    let mut out = [0xA5; 6];
    assert_eq!(layout.encode_values(&good, &mut out), Ok(5));
    assert_eq!(out, [0xFF, 1, 0xFE, 0xFF, 0xFE, 0xA5]);

    let mut out = [0xA5; 6];
    let no_space = NoSpace { needed: 5, available: 4 };
    assert_eq!(layout.encode_values(&good, &mut out[..4]), Err(EncodeError::NoSpace(no_space)));
    assert_eq!(layout.encode(&[0; IMAGE_BYTES], &mut out[..4]), Err(no_space));
    let count = EncodeError::Count { expected: 2, got: 1 };
    assert_eq!(layout.encode_values(&good[..1], &mut out), Err(count));
    let ty = EncodeError::Type { field: 1, expected: ScalarType::Short, got: ScalarType::Word };
    assert_eq!(layout.encode_values(&[Scalar::Byte(1), Scalar::Word(2)], &mut out), Err(ty));
    assert_eq!(out, [0xA5; 6], "nothing is written");
    assert_eq!(layout.encode(&[0xFF; IMAGE_BYTES], &mut out), Ok(5));
    assert_eq!(out, [0xFF, 0, 0, 0, 0xFE, 0xA5], "user-defined fields are sent as zero");
}

proptest! {
    #[test]
    fn any_variables_go_through_a_frame_and_nothing_else_changes(
        head in proptest::collection::vec(any::<u8>(), 0..=8),
        tail in proptest::collection::vec(any::<u8>(), 1..=8),
        direction in prop_oneof![Just(Direction::Input), Just(Direction::Output)],
        picks in proptest::collection::vec(any::<proptest::sample::Index>(), 1..=60),
        sorted in any::<bool>(),
        noise in proptest::collection::vec(any::<u8>(), IMAGE_BYTES),
    ) {
        let all: Vec<SysVar> = SysVar::all().filter(|var| var.direction() == direction).collect();
        let mut vars: Vec<SysVar> = Vec::new();
        for pick in picks {
            let var = *pick.get(&all);
            if !vars.contains(&var) {
                vars.push(var);
            }
        }
        if sorted {
            vars.sort();
        }
        let rules = Rules { mode: Mode::Realtime, direction };
        let fields = vars.iter().map(|&var| Field::System(var));
        let layout = StreamLayout::new(rules, &head, &tail, fields, Framing::Bytes).unwrap();

        // A source with valid values only: finite floats, no reserved bits.
        let mut source: [u8; IMAGE_BYTES] = noise.try_into().unwrap();
        for var in SysVar::all() {
            let at = var.image_offset();
            match var.ty() {
                ScalarType::Float => source[at + 3] &= 0xBF,
                ScalarType::Byte => source[at] &= var.valid_bits(),
                _ => {}
            }
        }
        let mut out = vec![0xA5; layout.frame_len() + 1];
        prop_assert_eq!(layout.encode(&source, &mut out), Ok(layout.frame_len()));
        prop_assert_eq!(out.pop(), Some(0xA5));
        prop_assert!(out.starts_with(&head) && out.ends_with(&tail));

        let payload = &out[head.len()..][..layout.payload_len()];
        let mut target = [0x5A; IMAGE_BYTES];
        prop_assert_eq!(layout.apply(payload, &mut target), Ok(Applied::default()));
        for var in SysVar::all() {
            let place = var.image_offset()..var.image_offset() + var.size();
            if vars.contains(&var) {
                prop_assert_eq!(&target[place.clone()], &source[place], "{}", var);
            } else {
                prop_assert!(target[place].iter().all(|&byte| byte == 0x5A), "{}", var);
            }
        }
        let values: Vec<Scalar> = layout.values(payload).collect();
        prop_assert_eq!(values.len(), vars.len());
        let mut again = vec![0; out.len()];
        prop_assert_eq!(layout.encode_values(&values, &mut again), Ok(out.len()));
        prop_assert_eq!(again, out);
    }
}
