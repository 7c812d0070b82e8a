use std::cell::Cell;
use std::vec::Vec;
extern crate std;

use super::*;
use crate::recipe::Rules;
use crate::recipe::model::{Field, Framing, Mode};
use crate::sysvar::Direction;
use crate::wire::scalar::ScalarType;

std::thread_local! {
    static VISITS: Cell<usize> = const { Cell::new(0) };
}

/// Counts looks at received bytes, and copies of them.
pub(super) fn count_visits(bytes: usize) {
    VISITS.set(VISITS.get() + bytes);
}

fn layout(head: &[u8], tail: &[u8], payload: usize) -> StreamLayout {
    let rules = Rules { mode: Mode::User, direction: Direction::Input };
    let (doubles, bytes) = if payload > 100 { (payload / 8, payload % 8) } else { (0, payload) };
    let fields = core::iter::repeat_n(Field::User(ScalarType::Double), doubles)
        .chain(core::iter::repeat_n(Field::User(ScalarType::Byte), bytes));
    StreamLayout::new(rules, head, tail, fields, Framing::Bytes).unwrap()
}

/// Every payload found in `chunks`.
fn decode<'a>(
    deframer: &mut Deframer,
    layout: &StreamLayout,
    chunks: impl IntoIterator<Item = &'a [u8]>,
) -> Vec<Vec<u8>> {
    let mut payloads = Vec::new();
    for mut chunk in chunks {
        while let Some(payload) = deframer.next_frame(layout, &mut chunk) {
            payloads.push(payload.to_vec());
        }
        assert!(chunk.is_empty(), "None means that the chunk is used up");
    }
    payloads
}

#[test]
fn two_frames_in_one_chunk_and_one_frame_in_many() {
    let layout = layout(&[0x48, 0xAA], &[0x0D, 0x0A], 24);
    let mut frame = std::vec![0x48, 0xAA];
    frame.extend(1..=24);
    frame.extend([0x0D, 0x0A]);
    let payload: Vec<u8> = (1..=24).collect();

    let twice = [&frame[..], &frame[..]].concat();
    let mut deframer = Deframer::new();
    assert_eq!(decode(&mut deframer, &layout, [&twice[..]]), [&payload[..], &payload[..]]);
    assert_eq!(decode(&mut deframer, &layout, frame.chunks(1)), [&payload[..]]);
    assert_eq!(deframer.stats(), DeframerStats { frames: 3, ..Default::default() });
    assert_eq!(deframer.pending(), 0);
}
