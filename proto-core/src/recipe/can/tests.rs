use std::string::ToString;
use std::vec;
use std::vec::Vec;

use proptest::prelude::*;

use super::*;
use crate::recipe::model::Mode;
use crate::sysvar::{Direction, SysVar, VarRange};
use crate::wire::scalar::ScalarType;

const REALTIME_IN: Rules = Rules { mode: Mode::Realtime, direction: Direction::Input };
const REALTIME_OUT: Rules = Rules { mode: Mode::Realtime, direction: Direction::Output };
const USER_IN: Rules = Rules { mode: Mode::User, direction: Direction::Input };

fn id(number: u16) -> CanId {
    CanId::Standard(number)
}

fn system(names: &str) -> Vec<Field> {
    VarRange::parse(names).unwrap().iter().map(Field::System).collect()
}

fn bytes(count: usize) -> Vec<Field> {
    vec![Field::User(ScalarType::Byte); count]
}

fn at(frame: u8, field: u8) -> FieldPlace {
    FieldPlace { frame: Some(frame), field }
}

#[track_caller]
fn assert_refused(rules: Rules, frames: &[(CanId, Vec<Field>)], expected: PartError, message: &str) {
    let error = CanLayout::new(rules, frames.iter().cloned()).unwrap_err();
    assert_eq!(error, expected);
    assert_eq!(error.to_string(), message);
    assert!(error.frame().is_some() || expected == PartError::NoFrames, "{error} names no frame");
}

#[test]
fn frames_that_break_a_rule_are_named() {
    let var = |name| SysVar::parse(name).unwrap();
    assert_refused(USER_IN, &[], PartError::NoFrames, "a CAN part needs 1..=32 frames; this one has none");
    let many: Vec<_> = (0..33).map(|number| (id(number), bytes(1))).collect();
    assert_refused(USER_IN, &many, PartError::TooManyFrames, "a CAN part has at most 32 frames");
    CanLayout::new(USER_IN, many.into_iter().take(32)).unwrap();
    assert_refused(
        USER_IN,
        &[(id(1), bytes(8)), (id(2), bytes(9))],
        PartError::CanFrameTooLong { frame: 1, len: 9 },
        "the fields of frame 2 take 9 bytes; a CAN frame carries at most 8",
    );
    assert_refused(
        USER_IN,
        &[(id(1), bytes(1)), (id(2), vec![])],
        PartError::NoFields { frame: Some(1) },
        "frame 2 has no fields",
    );
    let many: Vec<_> = (0..17).map(|number| (id(number), bytes(8))).collect();
    assert_refused(
        USER_IN,
        &many,
        PartError::TooManyFields { at: at(16, 0) },
        "field 1 of frame 17 is one too many; a part has at most 128",
    );
    assert_refused(
        USER_IN,
        &[(id(0x800), bytes(1))],
        PartError::InvalidId { frame: 0, id: id(0x800) },
        "id 0x800 does not fit in 11 bits (0x000..=0x7ff)",
    );
    assert_refused(
        USER_IN,
        &[(CanId::Extended(0x2000_0000), bytes(1))],
        PartError::InvalidId { frame: 0, id: CanId::Extended(0x2000_0000) },
        "id 0x20000000 does not fit in 29 bits (0x00000000..=0x1fffffff)",
    );
    assert_refused(
        USER_IN,
        &[(id(1), bytes(1)), (id(2), bytes(1)), (id(1), bytes(2))],
        PartError::DuplicateId { frame: 2, first: 0, id: id(1) },
        "frame 1 already has id 0x001",
    );
    assert_refused(
        REALTIME_IN,
        &[(id(1), system("ForceEnd[1..2]")), (id(2), system("RobotState[8]"))],
        PartError::WrongDirection { at: at(1, 0), var: var("RobotState[8]"), part: Direction::Input },
        "field 1 of frame 2: RobotState[8] is an output of the robot and cannot be in an input part",
    );
    assert_refused(
        REALTIME_IN,
        &[(id(1), bytes(1))],
        PartError::WrongMode { at: at(0, 0), mode: Mode::Realtime },
        "field 1 of frame 1 is user-defined; a realtime recipe has only system variables",
    );
    assert_refused(
        REALTIME_IN,
        &[
            (id(1), system("ForceEnd[1..2]")),
            (id(2), system("ForceEnd[3..4]")),
            (id(3), system("ForceEnd[4]")),
        ],
        PartError::DuplicateVariable { at: at(2, 0), first: at(1, 1), var: var("ForceEnd[4]") },
        "field 1 of frame 3: ForceEnd[4] is already field 2 of frame 2",
    );
    let twice = [system("WordInputReg[7]"), system("WordInputReg[7]")].concat();
    assert_refused(
        REALTIME_IN,
        &[(id(1), system("ForceEnd[1..2]")), (id(2), twice)],
        PartError::DuplicateVariable { at: at(1, 1), first: at(1, 0), var: var("WordInputReg[7]") },
        "field 2 of frame 2: WordInputReg[7] is already field 1 of frame 2",
    );
}

#[test]
fn frames_that_are_not_the_recipes_are_refused() {
    let extended = CanId::Extended(5);
    let layout =
        CanLayout::new(USER_IN, [(id(1), bytes(3)), (id(5), bytes(1)), (extended, bytes(8))]).unwrap();
    let accept = |id, data: &[u8]| layout.accept(&CanFrame::new(id, data).unwrap());
    assert_eq!(accept(id(1), &[0; 3]), Ok(0));
    assert_eq!(accept(id(5), &[0; 1]), Ok(1));
    assert_eq!(accept(extended, &[0; 8]), Ok(2), "11 and 29 bits are different ids");
    assert_eq!(accept(id(2), &[0; 3]), Err(CanReject::UnknownId { id: id(2) }));
    let short = CanReject::WrongLength { frame: 0, expected: 3, got: 2 };
    assert_eq!(accept(id(1), &[0; 2]), Err(short));
    assert_eq!(short.to_string(), "frame 1 carries 3 bytes, not 2");
    let long = CanReject::WrongLength { frame: 1, expected: 1, got: 8 };
    assert_eq!(accept(id(5), &[0; 8]), Err(long));
    let remote = CanFrame::remote(id(1), 3).unwrap();
    assert_eq!(layout.accept(&remote), Err(CanReject::Remote { id: id(1) }));
    assert!(layout.frame(3).is_none());
    assert_eq!(layout.frames().count(), 3);
    assert!(size_of::<CanLayout>() <= 1200, "{}", size_of::<CanLayout>());
}

#[test]
fn can_frames_refuse_what_no_bus_carries() {
    assert_eq!(CanFrame::new(id(0x800), &[]), None);
    assert_eq!(CanFrame::new(CanId::Extended(0x2000_0000), &[]), None);
    assert_eq!(CanFrame::new(id(1), &[0; 9]), None);
    assert_eq!(CanFrame::new(id(1), &[0; 264]), None);
    assert_eq!(CanFrame::remote(id(1), 9), None);
    assert_eq!(CanFrame::remote(id(0x800), 0), None);
    let remote = CanFrame::remote(CanId::Extended(0x1FFF_FFFF), 8).unwrap();
    assert_eq!((remote.data(), remote.dlc(), remote.is_extended()), (&[][..], 8, true));
    assert_eq!(CanId::from(Frame::id(&remote)), CanId::Extended(0x1FFF_FFFF));
    let frame = <CanFrame as Frame>::new(embedded_can::StandardId::MAX, &[1, 2]).unwrap();
    assert_eq!((frame.id(), frame.data(), frame.is_remote_frame()), (id(0x7FF), &[1, 2][..], false));
}

#[test]
fn each_frame_moves_its_own_variables_only() {
    // The two pairs are neighbours in the image, but their runs must not be merged.
    let frames = [(id(2), system("RobotState[8..9]")), (id(3), system("RobotState[10..11]"))];
    let layout = CanLayout::new(REALTIME_OUT, frames).unwrap();
    let mut image = [0; IMAGE_BYTES];
    let pose = SysVar::parse("RobotState[8]").unwrap().image_offset();
    let data = [1, 2, 3, 4, 5, 6, 7, 8];
    layout.frame(1).unwrap().apply(&data, &mut image).unwrap();
    assert_eq!(image[pose..pose + 16], [0, 0, 0, 0, 0, 0, 0, 0, 1, 2, 3, 4, 5, 6, 7, 8]);
    assert_eq!(layout.frame(0).unwrap().encode(&image).data(), [0; 8]);
    let encoded = layout.frame(1).unwrap().encode(&image);
    assert_eq!((encoded.id(), encoded.data()), (id(3), &data[..]));
    let mut nan = data;
    nan[4..].copy_from_slice(&f32::NAN.to_le_bytes());
    let before = image;
    let refused = layout.frame(0).unwrap().apply(&nan, &mut image);
    assert_eq!((refused, image), (Err(ValueError::NotFinite { field: 1 }), before));
}

proptest! {
    #[test]
    fn any_values_go_through_any_frames(
        frames in proptest::collection::vec((any::<bool>(), 0..0x800_u32, proptest::collection::vec(0..8_usize, 1..=4)), 1..=32),
        bytes in proptest::collection::vec(any::<u8>(), 8),
    ) {
        let mut parts: Vec<(CanId, Vec<Field>)> = Vec::new();
        for (extended, number, types) in frames {
            let id = if extended { CanId::Extended(number << 18) } else { CanId::Standard(number as u16) };
            let mut room = MAX_CAN_DATA;
            let fields: Vec<Field> = types
                .iter()
                .map(|&nth| ScalarType::ALL[nth])
                .take_while(|ty| { room = room.wrapping_sub(ty.size()); room <= MAX_CAN_DATA })
                .map(Field::User)
                .collect();
            if parts.iter().all(|part| part.0 != id) {
                parts.push((id, fields));
            }
        }
        let layout = CanLayout::new(USER_IN, parts.clone()).unwrap();
        for (index, (id, fields)) in parts.iter().enumerate() {
            let frame = layout.frame(index).unwrap();
            prop_assert!(frame.fields().map(|placed| placed.field).eq(fields.iter().copied()));
            let data = &bytes[..frame.len()];
            let values: Vec<Scalar> = frame.values(data).collect();
            let encoded = frame.encode_values(&values).unwrap();
            prop_assert_eq!((encoded.id(), encoded.data()), (*id, data));
            prop_assert_eq!(layout.accept(&encoded), Ok(index));
            let shorter = CanFrame::new(*id, &data[1..]).unwrap();
            let is_length = matches!(layout.accept(&shorter), Err(CanReject::WrongLength { .. }));
            prop_assert!(is_length);
        }
    }
}

#[test]
fn a_frame_is_accepted_with_and_without_a_look_at_its_id() {
    let extended = |number| CanId::Extended(number);
    let part = [(id(5), bytes(2)), (extended(5), bytes(3)), (extended(0x1FFF_FFFF), bytes(1))];
    let layout = CanLayout::new(USER_IN, part).unwrap();
    for id in [id(5), extended(5), id(6), extended(6), id(0x7FF), extended(0x7FF), extended(0x1FFF_FFFF)] {
        for len in 0..=8 {
            let frame = CanFrame::new(id, &vec![0; len]).unwrap();
            assert_eq!(layout.accept_frame(&frame), layout.accept(&frame), "{frame:?}");
            assert_eq!(layout.has(&frame), layout.ids().any(|other| other == id));
            assert_eq!((frame.id(), frame.data().len()), (id, len));
            let remote = CanFrame::remote(id, len).unwrap();
            assert_eq!(layout.accept_frame(&remote), Err(CanReject::Remote { id }));
        }
    }
    let frame = CanFrame::new(extended(5), &[1]).unwrap();
    assert!(std::format!("{frame:?}").contains("Extended(5)"), "{frame:?}");
}
