use std::cell::Cell;
use std::vec;
use std::vec::Vec;

use proptest::collection::vec as many;
use proptest::prelude::*;

use super::*;
use crate::recipe::model::Rules;
use crate::recipe::model::{Field, Framing, Mode};
use crate::sysvar::Direction;
use crate::wire::scalar::{Scalar, ScalarType};

std::thread_local! {
    static VISITS: Cell<usize> = const { Cell::new(0) };
}

/// Counts comparisons and copies of received bytes.
pub(super) fn count_visits(bytes: usize) {
    VISITS.set(VISITS.get() + bytes);
}

/// Maximum number of visits per received byte: compared with eight bytes of head and eight of tail, and copied twice;
/// all of this on the fast path and again on the slow path.
const VISITS_PER_BYTE: usize = 2 * (8 + 8 + 2);

fn user_layout(head: &[u8], tail: &[u8], types: &[ScalarType]) -> StreamLayout {
    let rules = Rules { mode: Mode::User, direction: Direction::Input };
    let fields = types.iter().map(|&ty| Field::User(ty));
    StreamLayout::new(rules, head, tail, fields, Framing::Bytes).unwrap()
}

/// A layout whose payload has this length.
fn layout(head: &[u8], tail: &[u8], payload: usize) -> StreamLayout {
    let mut types = vec![ScalarType::Double; payload / 8];
    types.resize(payload / 8 + payload % 8, ScalarType::Byte);
    user_layout(head, tail, &types)
}

/// The force sensor's recipe: `48 AA`, six floats, `0D 0A`.
fn sensor() -> StreamLayout {
    user_layout(&[0x48, 0xAA], &[0x0D, 0x0A], &[ScalarType::Float; 6])
}

fn sensor_frame(number: u8) -> Vec<u8> {
    let mut frame = vec![0x48, 0xAA];
    frame.extend((0..24).map(|at| number.wrapping_add(at)));
    frame.extend([0x0D, 0x0A]);
    frame
}

fn sensor_payload(number: u8) -> Vec<u8> {
    sensor_frame(number)[2..26].to_vec()
}

/// Passes one chunk to the deframer and returns the payloads in it.
fn feed(deframer: &mut Deframer, layout: &StreamLayout, mut chunk: &[u8]) -> Vec<Vec<u8>> {
    let mut payloads = Vec::new();
    while let Some(payload) = deframer.next_frame(layout, &mut chunk) {
        payloads.push(payload.to_vec());
    }
    assert!(chunk.is_empty(), "None means that the chunk is used up");
    assert!(deframer.pending() < layout.frame_len());
    payloads
}

/// Like [`feed`], but tries [`Deframer::hold`] first, as the engine does.
fn hold_or_feed(deframer: &mut Deframer, layout: &StreamLayout, chunk: &[u8]) -> Vec<Vec<u8>> {
    let is_held = deframer.hold(layout, chunk);
    if is_held { Vec::new() } else { feed(deframer, layout, chunk) }
}

/// A way to pass a chunk to a deframer; returns the payloads in it.
type Way = fn(&mut Deframer, &StreamLayout, &[u8]) -> Vec<Vec<u8>>;

const WAYS: [Way; 2] = [feed, hold_or_feed];

fn feed_all<'a>(
    deframer: &mut Deframer,
    layout: &StreamLayout,
    chunks: impl IntoIterator<Item = &'a [u8]>,
) -> Vec<Vec<u8>> {
    chunks.into_iter().flat_map(|chunk| feed(deframer, layout, chunk)).collect()
}

/// D19 taken literally: a list of bytes whose first one is dropped if it cannot begin a frame.
#[derive(Default)]
struct Reference {
    bytes: Vec<u8>,
    stats: DeframerStats,
}

impl Reference {
    fn feed(&mut self, layout: &StreamLayout, chunk: &[u8]) -> Vec<Vec<u8>> {
        let mut payloads = Vec::new();
        for &byte in chunk {
            self.bytes.push(byte);
            while !self.bytes.is_empty() {
                let seen = self.bytes.len().min(layout.head().len());
                if self.bytes[..seen] == layout.head()[..seen] {
                    if self.bytes.len() < layout.frame_len() {
                        break;
                    }
                    if self.bytes.ends_with(layout.tail()) {
                        let start = layout.head().len();
                        payloads.push(self.bytes[start..start + layout.payload_len()].to_vec());
                        self.stats.frames += 1;
                        self.bytes.clear();
                        break;
                    }
                    self.stats.tail_mismatches += 1;
                }
                self.bytes.remove(0);
                self.stats.skipped_bytes += 1;
            }
        }
        payloads
    }
}

#[test]
fn two_frames_in_one_chunk_and_one_frame_in_28_chunks() {
    let (layout, mut deframer) = (sensor(), Deframer::new());
    let twice = [sensor_frame(1), sensor_frame(2)].concat();
    assert_eq!(feed(&mut deframer, &layout, &twice), [sensor_payload(1), sensor_payload(2)]);
    let frame = sensor_frame(3);
    assert_eq!(frame.len(), 28);
    assert_eq!(feed_all(&mut deframer, &layout, frame.chunks(1)), [sensor_payload(3)]);
    assert_eq!(deframer.stats(), DeframerStats { frames: 3, ..Default::default() });
    assert_eq!(deframer.pending(), 0);
}

#[test]
fn a_frame_cut_at_every_byte_still_arrives_once() {
    let layout = sensor();
    for cut in 0..=28 {
        let (frame, mut deframer) = (sensor_frame(7), Deframer::new());
        let (first, second) = frame.split_at(cut);
        let early = feed(&mut deframer, &layout, first);
        assert_eq!(deframer.pending(), if cut == 28 { 0 } else { cut });
        let late = feed(&mut deframer, &layout, second);
        assert_eq!([early, late].concat(), [sensor_payload(7)], "cut at {cut}");
    }
}

#[test]
fn a_frame_that_lost_its_end_hides_no_other() {
    // The next frame begins inside the expected length of the cut one.
    let layout = sensor();
    for kept in 0..28 {
        let bytes = [&sensor_frame(1)[..kept], &sensor_frame(2), &sensor_frame(3)].concat();
        for size in [1, 5, 28, bytes.len()] {
            let mut deframer = Deframer::new();
            let found = feed_all(&mut deframer, &layout, bytes.chunks(size));
            assert_eq!(found, [sensor_payload(2), sensor_payload(3)], "{kept} bytes kept, chunks of {size}");
            let stats = deframer.stats();
            assert_eq!((stats.frames, stats.skipped_bytes), (2, kept as u64));
            assert_eq!(stats.tail_mismatches, u64::from(kept >= 2), "{kept} bytes kept");
        }
    }
}

#[test]
fn heads_and_tails_inside_the_payload_are_data() {
    let layout = sensor();
    let mut frame = sensor_frame(1);
    frame[4..8].copy_from_slice(&[0x48, 0xAA, 0x0D, 0x0A]);
    frame[24..26].copy_from_slice(&[0x0D, 0x0A]);
    let line = [&frame[..], &frame].concat();
    for size in 1..=line.len() {
        let mut deframer = Deframer::new();
        let found = feed_all(&mut deframer, &layout, line.chunks(size));
        assert_eq!(found, [&frame[2..26], &frame[2..26]], "chunks of {size}");
        assert_eq!(deframer.stats().skipped_bytes, 0);
    }
}

#[test]
fn a_wrong_tail_costs_its_frame_and_no_other() {
    let layout = sensor();
    let mut broken = sensor_frame(1);
    broken[27] = 0x0B;
    let line = [sensor_frame(0), broken, sensor_frame(2)].concat();
    for size in 1..=line.len() {
        let mut deframer = Deframer::new();
        let found = feed_all(&mut deframer, &layout, line.chunks(size));
        assert_eq!(found, [sensor_payload(0), sensor_payload(2)], "chunks of {size}");
        let expected =
            DeframerStats { frames: 2, skipped_bytes: 28, tail_mismatches: 1, ..Default::default() };
        assert_eq!(deframer.stats(), expected);
    }
}

#[test]
fn a_head_that_repeats_itself_is_found_after_its_own_beginning() {
    let layout = layout(&[0xFF, 0xFF, 0x01], &[], 1);
    let line = [0xFF, 0xFF, 0xFF, 0x01, 0x55, 0xFF, 0x00, 0xFF, 0xFF, 0x01, 0x66];
    for size in 1..=line.len() {
        let mut deframer = Deframer::new();
        let found = feed_all(&mut deframer, &layout, line.chunks(size));
        assert_eq!(found, [[0x55], [0x66]], "chunks of {size}");
        assert_eq!(deframer.stats().skipped_bytes, 3);
    }
}

/// Passes a line to a deframer and to the reference, in chunks of every size.
#[track_caller]
fn is_read_as_the_reference_reads_it(layout: &StreamLayout, line: &[u8]) {
    for (size, way) in (1..=line.len()).flat_map(|size| WAYS.map(|way| (size, way))) {
        let (mut deframer, mut reference) = (Deframer::new(), Reference::default());
        for chunk in line.chunks(size) {
            assert_eq!(way(&mut deframer, layout, chunk), reference.feed(layout, chunk), "{line:?}, {size}");
            assert_eq!(deframer.stats(), reference.stats, "{line:?}, {size}");
            assert_eq!(deframer.held(), reference.bytes, "{line:?}, {size}");
        }
    }
}

#[test]
fn a_head_of_any_length_is_found_behind_anything() {
    for head in (0..=8).map(|len| &b"ABABABAC"[8 - len..]) {
        let layout = layout(head, b"\r\n", 20);
        let frame = |number: u8| [head, &[number; 20], b"\r\n"].concat();
        let garbage = [&b""[..], b"x", b"A", b"AB", b"xx", b"ABABABA", b"ABABABAB", b"xxxxxxxxx"];
        for garbage in garbage {
            let line = [&frame(1), garbage, &frame(2), &frame(3), garbage, head, garbage].concat();
            is_read_as_the_reference_reads_it(&layout, &line);
        }
        for lost in 1..layout.frame_len() {
            let line = [&frame(1)[lost..], &frame(2)[..lost], &frame(3), &frame(4)].concat();
            is_read_as_the_reference_reads_it(&layout, &line);
        }
    }
}

#[test]
fn silence_discards_a_partial_frame() {
    let (layout, mut deframer) = (sensor(), Deframer::new());
    feed(&mut deframer, &layout, &sensor_frame(1)[..13]);
    assert_eq!(deframer.discard(), 13);
    assert_eq!(deframer.discard(), 0);
    assert_eq!(feed(&mut deframer, &layout, &sensor_frame(2)), [sensor_payload(2)]);
    let expected = DeframerStats { frames: 1, discarded_bytes: 13, ..Default::default() };
    assert_eq!(deframer.stats(), expected);

    // The head is dropped too: bytes like the end of a frame do not complete one.
    feed(&mut deframer, &layout, &sensor_frame(3)[..13]);
    deframer.discard();
    let mut headless = sensor_frame(4);
    headless[0] ^= 1;
    for byte in headless {
        assert_eq!(hold_or_feed(&mut deframer, &layout, &[byte]), Vec::<Vec<u8>>::new());
    }
}

#[test]
fn another_layout_without_a_discard_loses_bytes_but_not_its_footing() {
    let mut deframer = Deframer::new();
    feed(&mut deframer, &sensor(), &sensor_frame(1)[..20]);
    let short = layout(&[0xFF, 0xFF], &[0xEE, 0xEE], 1);
    assert_eq!(feed(&mut deframer, &short, &[0xFF, 0xFF, 0x01, 0xEE, 0xEE]), [[1]]);
    assert_eq!(deframer.stats().discarded_bytes, 20);
}

#[test]
fn the_deframer_is_not_much_larger_than_two_frames() {
    assert!(size_of::<Deframer>() <= 2 * MAX_STREAM_FRAME + 40, "{}", size_of::<Deframer>());
}

/// Passes `line` in chunks of every interesting size, compares with the reference, and returns the maximum number of
/// visits per byte.
#[track_caller]
fn visits_per_byte(layout: &StreamLayout, line: &[u8]) -> usize {
    let mut worst = 0;
    for size in [1, 2, 7, layout.frame_len() - 1, layout.frame_len(), 4096, line.len()] {
        let mut deframer = Deframer::new();
        VISITS.set(0);
        feed_all(&mut deframer, layout, line.chunks(size));
        worst = worst.max(VISITS.get() / line.len());
    }
    worst
}

#[test]
fn the_worst_input_costs_a_bounded_number_of_visits_a_byte() {
    const LINE: usize = 20_000;
    let ones = vec![0xFF; LINE];
    for payload in [1, 24, 300, 496] {
        // Every byte begins a head, and the tail of every frame is wrong in its last byte.
        let mut tail = [0xFF; 8];
        tail[7] = 0xFE;
        let worst = visits_per_byte(&layout(&[0xFF; 8], &tail, payload), &ones);
        assert!(worst <= VISITS_PER_BYTE, "{worst} visits a byte with {payload} bytes of payload");
        // Every head fails at its last byte.
        let worst = visits_per_byte(&layout(&tail, &tail, payload), &ones);
        assert!(worst <= VISITS_PER_BYTE, "{worst} visits a byte with {payload} bytes of payload");
        // No head at all.
        let worst = visits_per_byte(&layout(&[], &tail, payload), &ones);
        assert!(worst <= VISITS_PER_BYTE, "{worst} visits a byte with {payload} bytes of payload");
        // Broken frames nested in broken frames, with a whole one now and then.
        let nested = layout(&[0xFF], &[0x00, 0xFF], payload);
        let line: Vec<u8> = (0..LINE).map(|at| if at % 3 == 0 { 0x00 } else { 0xFF }).collect();
        let worst = visits_per_byte(&nested, &line);
        assert!(worst <= VISITS_PER_BYTE, "{worst} visits a byte with {payload} bytes of payload");
    }
}

#[test]
fn a_datagram_is_exactly_one_frame() {
    let layout = sensor();
    let frame = sensor_frame(1);
    assert_eq!(datagram(&layout, &frame), Ok(&sensor_payload(1)[..]));
    for len in 0..28 {
        let cut = &frame[..len];
        assert_eq!(datagram(&layout, cut), Err(DatagramError::Length { expected: 28, got: len }));
    }
    let longer = [&frame[..], &[0]].concat();
    assert_eq!(datagram(&layout, &longer), Err(DatagramError::Length { expected: 28, got: 29 }));
    for (at, error) in [
        (0, DatagramError::Head),
        (1, DatagramError::Head),
        (26, DatagramError::Tail),
        (27, DatagramError::Tail),
    ] {
        let mut wrong = frame.clone();
        wrong[at] ^= 1;
        assert_eq!(datagram(&layout, &wrong), Err(error), "byte {at}");
    }
    let rules = Rules { mode: Mode::Realtime, direction: Direction::Output };
    let field = Field::System("WordOutputReg[1]".parse().unwrap());
    let bare = StreamLayout::new(rules, &[], &[], [field], Framing::Datagram).unwrap();
    assert_eq!(datagram(&bare, &[1, 2]), Ok(&[1, 2][..]));
}

/// A recipe; heads and tails consist of few different bytes, so that they often overlap.
fn any_layout() -> impl Strategy<Value = StreamLayout> {
    let delimiter = || many(prop_oneof![4 => Just(0xFF_u8), 2 => Just(0xFE), 1 => any::<u8>()], 0..=8);
    let fields = prop_oneof![8 => many(0..8_usize, 1..12), 1 => many(0..8_usize, 100..=128)];
    (delimiter(), delimiter(), fields).prop_filter_map(
        "a part that the rules allow",
        |(head, tail, types)| {
            let rules = Rules { mode: Mode::User, direction: Direction::Input };
            let fields = types.iter().map(|&nth| Field::User(ScalarType::ALL[nth]));
            StreamLayout::new(rules, &head, &tail, fields, Framing::Bytes).ok()
        },
    )
}

/// The next bytes on the line.
#[derive(Debug, Clone)]
enum Event {
    /// A frame whose values consist of these bytes, repeated.
    Frame(Vec<u8>),
    /// A frame of which only a part arrives, in 256ths.
    Cut(Vec<u8>, u8),
    /// A frame with one byte changed.
    Changed(Vec<u8>, u16, u8),
    /// Anything.
    Garbage(Vec<u8>),
}

fn any_event() -> impl Strategy<Value = Event> {
    let bytes = |most| many(prop_oneof![Just(0xFF_u8), Just(0xFE_u8), any::<u8>()], 1..=most);
    prop_oneof![
        4 => bytes(8).prop_map(Event::Frame),
        1 => (bytes(8), any::<u8>()).prop_map(|(values, part)| Event::Cut(values, part)),
        1 => (bytes(8), any::<u16>(), 1..=255_u8).prop_map(|(values, at, bits)| Event::Changed(values, at, bits)),
        1 => bytes(40).prop_map(Event::Garbage),
    ]
}

/// Encodes a frame whose values consist of these bytes.
fn encode(layout: &StreamLayout, bytes: &[u8]) -> Vec<u8> {
    let mut source = bytes.iter().copied().cycle();
    let values: Vec<Scalar> = layout
        .fields()
        .map(|placed| {
            let raw: Vec<u8> = source.by_ref().take(placed.field.ty().size()).collect();
            Scalar::decode(placed.field.ty(), &raw).unwrap()
        })
        .collect();
    let mut out = vec![0xA5; layout.frame_len() + 3];
    assert_eq!(layout.encode_values(&values, &mut out), Ok(layout.frame_len()));
    assert_eq!(out.split_off(layout.frame_len()), [0xA5; 3], "nothing past the frame is written");
    let start = layout.head().len();
    let payload = &out[start..start + layout.payload_len()];
    // Compared as text, because a NaN is not equal to itself.
    let (left, right): (Vec<_>, Vec<_>) = (
        layout.values(payload).map(|v| std::format!("{v:?}")).collect(),
        values.iter().map(|v| std::format!("{v:?}")).collect(),
    );
    assert_eq!(left, right);
    out
}

fn line(layout: &StreamLayout, events: &[Event]) -> Vec<u8> {
    let mut line = Vec::new();
    for event in events {
        match event {
            Event::Frame(values) => line.extend(encode(layout, values)),
            Event::Cut(values, part) => {
                let frame = encode(layout, values);
                line.extend(&frame[..frame.len() * usize::from(*part) / 256]);
            }
            Event::Changed(values, at, bits) => {
                let mut frame = encode(layout, values);
                let at = usize::from(*at) % frame.len();
                frame[at] ^= bits;
                line.extend(frame);
            }
            Event::Garbage(bytes) => line.extend(bytes),
        }
    }
    line
}

proptest! {
    #[test]
    fn whatever_arrives_is_read_as_the_reference_reads_it(
        layout in any_layout(),
        events in many(any_event(), 1..20),
        sizes in many(prop_oneof![Just(1_usize), 1..64_usize, 1..2000_usize], 1..20),
    ) {
        let line = line(&layout, &events);
        for way in WAYS {
            let (mut deframer, mut reference) = (Deframer::new(), Reference::default());
            let mut sizes = sizes.iter().cycle();
            let mut rest = &line[..];
            VISITS.set(0);
            while !rest.is_empty() {
                let (chunk, after) = rest.split_at(*sizes.next().unwrap().min(&rest.len()));
                prop_assert_eq!(way(&mut deframer, &layout, chunk), reference.feed(&layout, chunk));
                prop_assert_eq!(deframer.stats(), reference.stats);
                prop_assert_eq!(deframer.pending(), reference.bytes.len());
                rest = after;
            }
            prop_assert!(VISITS.get() <= VISITS_PER_BYTE * line.len());
            let stats = deframer.stats();
            let accounted =
                stats.frames * layout.frame_len() as u64 + stats.skipped_bytes + deframer.pending() as u64;
            prop_assert_eq!(accounted, line.len() as u64, "every byte is accounted for");
        }
    }
}
