//! Sessions of an slcan client, cut at every byte, and invalid lines.

use std::format;
use std::string::String;
use std::vec::Vec;

use super::*;
use proptest::prelude::*;

/// The frames and answers of a channel for `bytes`, given in chunks of `size`.
fn feed(channel: &mut Channel, bytes: &[u8], size: usize) -> (Vec<CanFrame>, Vec<u8>) {
    let (mut frames, mut answers) = (Vec::new(), Vec::new());
    for mut chunk in bytes.chunks(size) {
        while let Some(reaction) = channel.receive(&mut chunk) {
            answers.extend_from_slice(reaction.answer);
            frames.extend(reaction.frame);
        }
        assert!(chunk.is_empty());
    }
    (frames, answers)
}

#[track_caller]
fn session(bytes: &[u8], expected_answers: &[u8]) -> Vec<CanFrame> {
    let whole = feed(&mut Channel::new(500_000), bytes, bytes.len());
    for size in 1..bytes.len() {
        assert_eq!(feed(&mut Channel::new(500_000), bytes, size), whole, "chunks of {size}");
    }
    let text = String::from_utf8_lossy;
    assert_eq!(text(&whole.1), text(expected_answers));
    whole.0
}

fn standard(id: u16, data: &[u8]) -> CanFrame {
    CanFrame::new(CanId::Standard(id), data).unwrap()
}

#[test]
fn python_can_opens_with_an_empty_line_and_twice() {
    let frames = session(b"C\rS6\r\rO\rO\rt0013010203\r", b"\r\r\r\rz\r");
    assert_eq!(frames, [standard(1, &[1, 2, 3])]);
}

#[test]
fn every_kind_of_frame_is_read() {
    let frames = session(b"O\rt7FF0\rT1FFFFFFF2aBcD\rr0018\rR000000003\r", b"\rz\rZ\rz\rZ\r");
    assert_eq!(
        frames,
        [
            standard(0x7FF, &[]),
            CanFrame::new(CanId::Extended(0x1FFF_FFFF), &[0xAB, 0xCD]).unwrap(),
            CanFrame::remote(CanId::Standard(1), 8).unwrap(),
            CanFrame::remote(CanId::Extended(0), 3).unwrap(),
        ]
    );
}

#[test]
fn what_is_wrong_gets_a_bell_and_the_next_line_passes() {
    for wrong in [
        "t",
        "t00",
        "t0019",
        "t00110",
        "t001111zz",
        "t80010",
        "T2000000010",
        "t0011000",
        "t00111+1",
        "x",
        "S9",
        "S",
        "O1",
        "Z2",
        "P",
        "M00000000",
        "s12",
        "t00180102030405060708000011",
        "\u{e9}",
    ] {
        let mut channel = Channel::new(500_000);
        feed(&mut channel, b"O\r", 9);
        let bytes = format!("{wrong}\rt0010\r");
        let (frames, answers) = feed(&mut channel, bytes.as_bytes(), 5);
        assert_eq!(frames, [standard(1, &[])], "{wrong:?}");
        assert_eq!(answers, b"\x07z\r", "{wrong:?}");
        assert_eq!(channel.refused(), 1);
    }
}

#[test]
fn a_line_without_end_takes_no_memory_and_one_bell() {
    let mut channel = Channel::new(500_000);
    let mut bytes = b"O\r".to_vec();
    bytes.extend(std::iter::repeat_n(b't', 100_000));
    bytes.extend_from_slice(b"\rt0010\r");
    let (frames, answers) = feed(&mut channel, &bytes, 777);
    assert_eq!((frames.len(), answers.as_slice()), (1, b"\r\x07z\r".as_slice()));
}

#[test]
fn frames_pass_only_where_the_channel_is_open() {
    let mut channel = Channel::new(500_000);
    let frame = standard(2, &[0x7D]);
    let send = |channel: &mut Channel, bytes: &[u8]| feed(channel, bytes, 99).1;
    assert_eq!(send(&mut channel, b"t0010\r"), b"\x07");
    assert_eq!(channel.deliver(&frame, 0), None);
    assert_eq!(send(&mut channel, b"L\rt0010\r"), b"\r\x07");
    assert_eq!(channel.deliver(&frame, 0).unwrap(), b"t00217D\r");
    assert_eq!(send(&mut channel, b"Z1\rS6\r"), b"\r\x07");
    assert_eq!(channel.deliver(&frame, 60_000 + 0x1234).unwrap(), b"t00217D1234\r");
    assert_eq!(send(&mut channel, b"C\r"), b"\r");
    assert_eq!(channel.deliver(&frame, 0), None);
}

#[test]
fn a_client_at_another_bit_rate_is_not_let_onto_the_bus() {
    let mut channel = Channel::new(500_000);
    assert_eq!(feed(&mut channel, b"S5\rO\rL\r", 99).1, b"\r\x07\x07");
    assert_eq!(channel.state(), ChannelState::Closed);
    assert_eq!(feed(&mut channel, b"s031C\rO\rC\rS6\rO\r", 99).1, b"\r\r\r\r\r");
    assert_eq!(channel.state(), ChannelState::Open);
}

#[test]
fn queries_are_answered_and_an_overrun_is_told_once() {
    let mut channel = Channel::new(500_000);
    channel.note_overrun();
    assert_eq!(feed(&mut channel, b"V\rv\rN\rF\rF\rX1\r", 1).1, b"V1013\rv1013\rNRG01\rF08\rF00\r\r");
}

fn any_frame() -> impl Strategy<Value = CanFrame> {
    let id = prop_oneof![
        (0..=0x7FF_u16).prop_map(CanId::Standard),
        (0..=0x1FFF_FFFF_u32).prop_map(CanId::Extended)
    ];
    (id, any::<bool>(), proptest::collection::vec(any::<u8>(), 0..=8)).prop_map(|(id, remote, data)| {
        if remote { CanFrame::remote(id, data.len()) } else { CanFrame::new(id, &data) }.unwrap()
    })
}

proptest! {
    #[test]
    fn a_frame_survives_its_line(frame in any_frame(), time in proptest::option::of(0..60_000_u16)) {
        let line = encode(&frame, time);
        let (end, text) = line.split_last().unwrap();
        prop_assert_eq!(*end, b'\r');
        prop_assert!(text.len() <= MAX_LINE);
        prop_assert_eq!(decode(text), Ok(frame));
    }

    #[test]
    fn whatever_comes_in_the_chunks_do_not_matter(
        bytes in proptest::collection::vec(prop_oneof![
            any::<u8>(),
            proptest::sample::select(b"tTrR0123fFOCLSZVN\r\r\r".to_vec()),
        ], 0..200),
        size in 1..20_usize,
    ) {
        let (mut one, mut other) = (Channel::new(500_000), Channel::new(500_000));
        let whole = feed(&mut one, &bytes, bytes.len().max(1));
        prop_assert_eq!(&feed(&mut other, &bytes, size), &whole);
        // Every sent frame came from a line that encodes exactly this frame.
        let lines: Vec<_> = bytes.split(|&byte| byte == b'\r').collect();
        prop_assert!(whole.0.len() <= lines.len());
    }

    #[test]
    fn a_line_is_refused_or_means_one_frame(line in "[tTrR][0-9a-fA-F]{0,30}") {
        if let Ok(frame) = decode(line.as_bytes()) {
            let canonical = encode(&frame, None);
            let text = &canonical[..canonical.len() - 1];
            prop_assert!(line.to_ascii_uppercase().as_bytes().starts_with(&text.to_ascii_uppercase()));
            prop_assert!(line.len() == text.len() || line.len() == text.len() + 4);
        }
    }
}
