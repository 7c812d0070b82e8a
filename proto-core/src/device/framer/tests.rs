use std::vec;
use std::vec::Vec;

use proptest::prelude::*;

use super::super::{Algorithm, Carrier, Checksum, Element, Encoding, FrameLayout};
use super::*;
use crate::sysvar::Direction;
use crate::wire::scalar::ScalarType;

fn byte() -> Element {
    Element::value(Encoding::scalar(ScalarType::Byte))
}

/// A head of one byte, two bytes of values, CRC-16/MODBUS: frames of five bytes.
fn small() -> (Vec<Element>, FrameLayout) {
    let elements = vec![byte(), byte()];
    let checksum = Checksum::standard(Algorithm::named("crc16-modbus").unwrap());
    let layout = FrameLayout::new(
        Carrier::Stream,
        Direction::Output,
        &[0xAA],
        &[],
        &elements,
        Some((checksum, elements.len())),
    )
    .unwrap();
    (elements, layout)
}

fn frame(values: [u8; 2]) -> Vec<u8> {
    let (elements, layout) = small();
    let mut out = [0; 16];
    let number = |nth: usize| f64::from(values[nth]);
    let len = layout.encode(&elements, number, &mut out).unwrap();
    out[..len].to_vec()
}

#[derive(Debug, Clone, PartialEq)]
enum Event {
    Frame(Vec<u8>),
    Other(Vec<u8>),
    Wrong(Vec<u8>),
}

fn run(framer: &mut Framer, chunks: &[&[u8]]) -> Vec<Event> {
    let (elements, layout) = small();
    let mut events = Vec::new();
    for chunk in chunks {
        let mut rest = *chunk;
        while let Some(found) = framer.next_frame(&mut rest, 8, |bytes| layout.probe(&elements, bytes)) {
            events.push(match found {
                Found::Frame(bytes) => Event::Frame(bytes.to_vec()),
                Found::Other(bytes) => Event::Other(bytes.to_vec()),
                Found::Wrong(bytes) => Event::Wrong(bytes.to_vec()),
            });
        }
        assert!(rest.is_empty());
    }
    events
}

#[test]
fn frames_are_found_however_they_are_cut() {
    let stream: Vec<u8> = [frame([1, 2]), vec![0x55], frame([0xAA, 0xAA]), frame([3, 4])].concat();
    for cut in 0..stream.len() {
        let mut framer = Framer::new();
        let (first, second) = stream.split_at(cut);
        let events = run(&mut framer, &[first, second]);
        let expected = [frame([1, 2]), frame([0xAA, 0xAA]), frame([3, 4])].map(Event::Frame);
        assert_eq!(events, expected, "cut at {cut}");
        assert_eq!(
            (framer.stats().skipped_bytes, framer.stats().noise_bytes, framer.stats().wrong),
            (1, 1, 0)
        );
    }
}

#[test]
fn a_wrong_checksum_is_told_once_and_the_next_frame_is_taken() {
    let mut broken = frame([0xAA, 7]);
    broken[2] ^= 1;
    let mut framer = Framer::new();
    let events = run(&mut framer, &[&[broken.clone(), broken.clone(), frame([1, 2])].concat()]);
    // The false beginning inside, a value that looks like a head, is not reported.
    let expected = [Event::Wrong(broken.clone()), Event::Wrong(broken), Event::Frame(frame([1, 2]))];
    assert_eq!(events, expected);
    let stats = framer.stats();
    assert_eq!((stats.frames, stats.wrong, stats.skipped_bytes, stats.noise_bytes), (1, 2, 10, 0));
}

#[test]
fn each_broken_frame_counts_whatever_is_between_them() {
    let mut broken = frame([1, 7]);
    broken[2] ^= 1;
    // A line produces such a byte before each frame when its direction changes.
    let stream = [&[0x55][..], &broken, &[0x55, 0x01], &broken, &broken, &[0x55], &frame([1, 2])].concat();
    let mut framer = Framer::new();
    let wrong = || Event::Wrong(broken.clone());
    assert_eq!(run(&mut framer, &[&stream]), [wrong(), wrong(), wrong(), Event::Frame(frame([1, 2]))]);
    assert_eq!((framer.stats().wrong, framer.stats().noise_bytes), (3, 4));
    let mut framer = Framer::of_replies();
    assert_eq!(run(&mut framer, &[&stream]), [Event::Frame(frame([1, 2]))], "a reply is not behind noise");
    framer.discard();
    assert_eq!(run(&mut framer, &[&broken]), [wrong()]);
}

/// Counts all frames of five bytes that begin with the head, right or wrong. A wrong one counts unless it begins inside
/// another that counts.
fn slowly(stream: &[u8]) -> (usize, usize) {
    let (elements, layout) = small();
    let (mut right, mut wrong, mut at, mut until) = (0, 0, 0, 0);
    while let Some(bytes) = stream.get(at..at + 5) {
        match layout.probe(&elements, bytes) {
            Probe::Frame(_) => {
                (right, at) = (right + 1, at + 5);
                until = at;
                continue;
            }
            Probe::Wrong(_) if at >= until => (wrong, until) = (wrong + 1, at + 5),
            _ => {}
        }
        at += 1;
    }
    (right, wrong)
}

proptest! {
    #[test]
    fn in_dense_garbage_all_that_counts_is_counted(
        pieces in prop::collection::vec((0_u8..4, any::<[u8; 2]>()), 0..200),
        cut in 1_usize..40,
    ) {
        let stream: Vec<u8> = pieces.iter().flat_map(|&(what, values)| match what {
            0 => vec![0xAA],
            1 => frame(values),
            2 => frame([0xAA, values[0]]).split_last().map(|(_, rest)| rest.to_vec()).unwrap_or_default(),
            _ => vec![0xAA, values[0], 0xAA, values[1], values[0]],
        }).collect();
        let mut framer = Framer::new();
        let chunks: Vec<&[u8]> = stream.chunks(cut).collect();
        run(&mut framer, &chunks);
        let stats = framer.stats();
        prop_assert_eq!((stats.frames as usize, stats.wrong as usize), slowly(&stream));
    }
}

#[test]
fn a_frame_inside_a_broken_one_is_found() {
    // A byte was lost: the next frame begins where the last byte of this one should be.
    let stream = [&frame([1, 2])[..4], &frame([3, 4])[..]].concat();
    let events = run(&mut Framer::new(), &[&stream]);
    assert_eq!(events.last(), Some(&Event::Frame(frame([3, 4]))));
}

#[test]
fn silence_discards_what_is_partial() {
    let mut framer = Framer::new();
    assert_eq!(run(&mut framer, &[&frame([1, 2])[..3]]), []);
    assert_eq!(framer.discard(), 3);
    assert_eq!(run(&mut framer, &[&frame([3, 4])]), [Event::Frame(frame([3, 4]))]);
    assert_eq!(framer.stats().discarded_bytes, 3);
}

#[test]
fn a_frame_behind_much_noise_is_taken() {
    // Noise without heads.
    let noise: Vec<u8> =
        (0..100_000_u32).map(|nth| (nth.wrapping_mul(2_654_435_761) >> 24) as u8 & 0x7F).collect();
    let events = run(&mut Framer::new(), &[&noise, &frame([1, 2])]);
    assert_eq!(events, [Event::Frame(frame([1, 2]))]);
}

#[test]
fn endless_false_beginnings_cost_bounded_work() {
    let elements = vec![byte(); 100];
    let checksum = Checksum::standard(Algorithm::named("crc32").unwrap());
    let layout = FrameLayout::new(
        Carrier::Stream,
        Direction::Output,
        &[0xAA],
        &[],
        &elements,
        Some((checksum, elements.len())),
    )
    .unwrap();
    let effort = elements.len() + layout.lengths().1;
    let (mut framer, mut probes) = (Framer::new(), std::cell::Cell::new(0_usize));
    let stream = vec![0xAA; 100_000];
    let mut rest = stream.as_slice();
    let probe = |bytes: &[u8]| {
        let found = layout.probe(&elements, bytes);
        if !matches!(found, Probe::Partial(_)) {
            probes.set(probes.get() + 1);
        }
        found
    };
    while framer.next_frame(&mut rest, effort, probe).is_some() {}
    let steps = *probes.get_mut() * effort;
    assert!(steps <= stream.len() * EFFORT as usize + effort, "{steps} steps");
    // After a discard, a good frame is accepted.
    framer.discard();
    let mut out = [0; 512];
    let zero = |_: usize| 0.0;
    let len = layout.encode(&elements, zero, &mut out).unwrap();
    let mut rest = &out[..len];
    let found = framer.next_frame(&mut rest, effort, |bytes| layout.probe(&elements, bytes));
    assert_eq!(found, Some(Found::Frame(&out[..len])));
}

/// The frames that a reader finds if it tries every byte with all bytes available.
fn reference(stream: &[u8]) -> Vec<Vec<u8>> {
    let (elements, layout) = small();
    let (mut at, mut frames) = (0, Vec::new());
    while at < stream.len() {
        match layout.probe(&elements, &stream[at..]) {
            Probe::Frame(len) => {
                frames.push(stream[at..at + len].to_vec());
                at += len;
            }
            Probe::Partial(_) => break,
            Probe::Other(len) => at += len,
            Probe::No(_) | Probe::Wrong(_) => at += 1,
        }
    }
    frames
}

fn any_stream() -> impl Strategy<Value = Vec<u8>> {
    let piece = prop_oneof![
        4 => any::<[u8; 2]>().prop_map(frame),
        1 => prop::collection::vec(prop_oneof![Just(0xAA_u8), any::<u8>()], 0..7),
        1 => (any::<[u8; 2]>(), 0_usize..5, any::<u8>()).prop_map(|(values, at, byte)| {
            let mut broken = frame(values);
            broken[at] = byte;
            broken
        }),
    ];
    prop::collection::vec(piece, 0..30).prop_map(|pieces| pieces.concat())
}

proptest! {
    #[test]
    fn any_stream_gives_the_frames_of_the_slow_reference(
        stream in any_stream(),
        sizes in prop::collection::vec(1_usize..20, 1..20),
    ) {
        let mut chunks = Vec::new();
        let mut rest = stream.as_slice();
        for size in sizes.iter().cycle() {
            if rest.is_empty() {
                break;
            }
            let (chunk, after) = rest.split_at((*size).min(rest.len()));
            chunks.push(chunk);
            rest = after;
        }
        let mut framer = Framer::new();
        let events = run(&mut framer, &chunks);
        let frames: Vec<Vec<u8>> = events
            .into_iter()
            .filter_map(|event| match event {
                Event::Frame(bytes) => Some(bytes),
                _ => None,
            })
            .collect();
        prop_assert_eq!(&frames, &reference(&stream));
        let stats = framer.stats();
        let accounted = frames.iter().map(Vec::len).sum::<usize>() + stats.skipped_bytes as usize;
        prop_assert_eq!(accounted + framer.held().len(), stream.len());
    }
}
