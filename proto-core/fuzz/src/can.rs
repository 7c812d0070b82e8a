//! CAN recipes: any part, any frame, against a list that is searched from its front
//! (docs/wire/recipes.md sections 2, 6 and 7).

use proto_core::recipe::model::{Field, Rules};
use proto_core::recipe::{CanFrameLayout, CanLayout, CanReject, ValueError};
use proto_core::sysvar::IMAGE_BYTES;
use proto_core::wire::can::{CanFrame, CanId};
use proto_core::wire::scalar::Scalar;

use crate::recipes::{fields, no_input_twice, rules};
use crate::reference;
use crate::source::Source;

pub(crate) fn run(input: &[u8]) {
    let mut input = Source::new(input);
    let rules = rules(input.u8());
    let count = input.below(34);
    let part: Vec<(CanId, Vec<Field>)> =
        (0..count).map(|_| (id(&mut input), fields(&mut input, rules, 9))).collect();
    let layout = CanLayout::new(rules, part.iter().map(|(id, fields)| (*id, fields.iter().copied())));
    assert_eq!(layout.is_ok(), is_right(rules, &part), "{:?}", layout.map(|_| ()));
    let Ok(layout) = layout else { return };

    assert!(layout.ids().eq(part.iter().map(|(id, _)| *id)));
    while !input.is_empty() {
        let kind = input.u8();
        // A declared id, or any.
        let id = if kind & 1 == 0 { part[input.below(part.len())].0 } else { id(&mut input) };
        let data = input.take(usize::from(kind >> 4));
        let frame = if kind & 2 == 0 { CanFrame::new(id, data) } else { CanFrame::remote(id, data.len()) };
        assert_eq!(frame.is_some(), id.is_valid() && data.len() <= 8);
        let Some(frame) = frame else { continue };
        assert_eq!((frame.id(), frame.is_remote()), (id, kind & 2 != 0));
        received(&layout, &part, &frame);
    }
}

fn id(input: &mut Source<'_>) -> CanId {
    match input.u8() {
        kind @ 0..64 => CanId::Standard(u16::from(kind)),
        64..128 => CanId::Standard(input.u16() & 0xFFF),
        kind @ 128..192 => CanId::Extended(u32::from(kind & 63)),
        192.. => CanId::Extended(input.u32() & 0x3FFF_FFFF),
    }
}

fn size(fields: &[Field]) -> usize {
    fields.iter().map(|field| field.ty().size()).sum()
}

/// Section 2.
fn is_right(rules: Rules, part: &[(CanId, Vec<Field>)]) -> bool {
    let all: Vec<Field> = part.iter().flat_map(|(_, fields)| fields.iter().copied()).collect();
    let id_twice = (1..part.len()).any(|nth| part[..nth].iter().any(|(id, _)| *id == part[nth].0));
    (1..=32).contains(&part.len())
        && all.len() <= 128
        && !id_twice
        && part.iter().all(|(id, fields)| id.is_valid() && (1..=8).contains(&size(fields)))
        && no_input_twice(rules, &all)
}

/// Section 6.
fn received(layout: &CanLayout, part: &[(CanId, Vec<Field>)], frame: &CanFrame) {
    let declared = part.iter().position(|(id, _)| *id == frame.id());
    let accepted = layout.accept(frame);
    assert_eq!(layout.accept_frame(frame), accepted, "an id that was checked before");
    match declared {
        _ if frame.is_remote() => assert_eq!(accepted, Err(CanReject::Remote { id: frame.id() })),
        None => assert_eq!(accepted, Err(CanReject::UnknownId { id: frame.id() })),
        Some(nth) if frame.data().len() != size(&part[nth].1) => {
            let (expected, got) = (size(&part[nth].1) as u8, frame.data().len() as u8);
            assert_eq!(accepted, Err(CanReject::WrongLength { frame: nth as u8, expected, got }));
        }
        Some(nth) => {
            assert_eq!(accepted, Ok(nth));
            values(layout.frame(nth).expect("an accepted frame is one of the part"), &part[nth].1, frame);
        }
    }
}

/// Section 7, and encoding again.
fn values(layout: CanFrameLayout<'_>, fields: &[Field], frame: &CanFrame) {
    let before = [0x5A; IMAGE_BYTES];
    let mut image = before;
    let applied = layout.apply(frame.data(), &mut image);
    match reference::apply(fields, frame.data(), &before) {
        Ok((after, masked)) => {
            assert_eq!(applied.map(|applied| applied.masked), Ok(masked));
            assert_eq!(image[..], after[..]);
            let twice = (1..fields.len()).any(|nth| fields[..nth].contains(&fields[nth]));
            if masked == 0 && !twice && matches!(fields[0], Field::System(_)) {
                assert_eq!(layout.encode(&image), *frame);
            }
        }
        Err(field) => {
            assert_eq!(applied, Err(ValueError::NotFinite { field }));
            assert_eq!(image, before, "all or nothing");
        }
    }
    assert_eq!(layout.check(frame.data()), applied.map(|_| ()));
    let got: Vec<Scalar> = layout.values(frame.data()).collect();
    assert_eq!(layout.encode_values(&got), Ok(*frame));
    assert!(layout.encode_values(&got[1..]).is_err());
}

pub(crate) fn seeds() -> Vec<Vec<u8>> {
    // Standard ids below 64 are one byte, see `id`.
    let user = [0, 1, 1, 3, 0, 0];
    let command = [1, 1, 1, 1, 0, 0];
    let pose = [3, 3, 2, 2, 13, 1, 3, 2, 15, 1, 4, 2, 17, 1];
    let extended = [1, 2, 192, 1, 0, 0, 0, 1, 0, 2, 1, 1, 77, 0];
    let many: Vec<u8> = (0..32_u8).flat_map(|id| [id * 2, 2, 0, 0x66]).collect();
    vec![
        [&user[..], &[0x30, 0, 1, 2, 3]].concat(),
        [&command[..], &[0x10, 0, 1, 0x12, 0, 1, 0x20, 0, 1, 1, 0x11, 7, 1]].concat(),
        [&pose[..], &[0x80, 0, 0xEF, 0x54, 0xEF, 0x3E, 0xA7, 0xE7, 0xD1, 0x3E]].concat(),
        [&pose[..], &[0x80, 2, 0, 0, 0x80, 0x7F, 0, 0, 0xC0, 0xFF]].concat(),
        [&extended[..], &[0x10, 0, 0xFF, 0x40, 1, 0, 0, 0x80, 0x3F, 0x01, 193, 1, 0, 0, 0]].concat(),
        [&[0, 32], &many[..], &[0x80, 31, 0, 0, 0x80, 0x3F, 0, 0, 0, 0, 0x80, 5, 1, 2, 3, 4, 5, 6, 7, 8]]
            .concat(),
    ]
}
