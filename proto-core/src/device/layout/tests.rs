#![allow(clippy::needless_borrows_for_generic_args, reason = "the same elements are looked at again")]

use std::vec;
use std::vec::Vec;

use proptest::prelude::*;

use super::*;
use crate::device::checksum::Algorithm;
use crate::device::encoding::{Bits, Digits, Encoding, Kind, Width};
use crate::device::order::ByteOrder;
use crate::device::text::{Counts, Length, Text, TextWidth};
use crate::wire::scalar::ScalarType;

fn value(kind: Kind, order: ByteOrder) -> Element {
    Element::value(Encoding { kind, order, shared: false })
}

fn big(ty: ScalarType) -> Element {
    value(Kind::Scalar(ty), ByteOrder::Big)
}

fn fixed(ty: ScalarType, number: i64) -> Element {
    Element::Fixed { encoding: Encoding::scalar(ty), value: number }
}

fn bits(first: u8, count: u8, shared: bool) -> Element {
    let kind = Kind::Bits(Bits { bytes: 1, first, count, signed: false });
    Element::value(Encoding { kind, order: ByteOrder::Little, shared })
}

fn standard(name: &str, behind: usize) -> Option<(Checksum, usize)> {
    Some((Checksum::standard(Algorithm::named(name).unwrap()), behind))
}

fn encoded(layout: &FrameLayout, elements: &[Element], numbers: &[f64]) -> Vec<u8> {
    let mut out = [0xEE; 64];
    let len = layout.encode(elements, |nth| numbers[nth], &mut out).unwrap();
    assert!(out[len..].iter().all(|&byte| byte == 0xEE), "nothing is written behind the frame");
    out[..len].to_vec()
}

fn decoded(layout: &FrameLayout, elements: &[Element], frame: &[u8]) -> Vec<f64> {
    assert_eq!(layout.probe(elements, frame), Probe::Frame(frame.len()));
    layout.values(elements, frame).filter_map(|value| value.unwrap()).map(Scalar::as_f64).collect()
}

/// The reply of a Modbus RTU slave 9 with three registers, as the manual of a gripper has it.
#[test]
fn a_reply_with_constants_and_a_crc() {
    let elements = vec![
        fixed(ScalarType::Byte, 9),
        fixed(ScalarType::Byte, 3),
        fixed(ScalarType::Byte, 6),
        bits(0, 1, false),
        bits(3, 1, true),
        bits(4, 2, true),
        Element::Padding { len: 1, fill: 0 },
        big(ScalarType::Byte),
        big(ScalarType::Byte),
        big(ScalarType::Byte),
        big(ScalarType::Byte),
    ];
    let layout = FrameLayout::new(
        Carrier::Stream,
        Direction::Output,
        &[],
        &[],
        &elements,
        standard("crc16-modbus", 11),
    )
    .unwrap();
    assert_eq!(layout.lengths(), (11, 11));
    let numbers = [0.0, 0.0, 0.0, 1.0, 1.0, 3.0, 0.0, 0.0, 230.0, 66.0, 5.0];
    let frame = encoded(&layout, &elements, &numbers);
    let crc = Algorithm::named("crc16-modbus").unwrap().of([&frame[..9]]) as u16;
    assert_eq!(frame[..9], [9, 3, 6, 0x39, 0, 0, 230, 66, 5]);
    assert_eq!(frame[9..], crc.to_le_bytes());
    assert_eq!(decoded(&layout, &elements, &frame), [1.0, 1.0, 3.0, 0.0, 230.0, 66.0, 5.0]);

    // Every flipped bit is detected.
    for bit in 0..frame.len() * 8 {
        let mut broken = frame.clone();
        broken[bit / 8] ^= 1 << (bit % 8);
        assert_eq!(layout.probe(&elements, &broken), Probe::Wrong(11), "bit {bit}");
    }
    // Another slave's frame is valid, but not for us.
    let mut other = frame.clone();
    other[0] = 8;
    let crc = Algorithm::named("crc16-modbus").unwrap().of([&other[..9]]) as u16;
    other[9..].copy_from_slice(&crc.to_le_bytes());
    assert_eq!(layout.probe(&elements, &other), Probe::Other(11));
}

#[test]
fn without_a_checksum_another_constant_is_no_frame() {
    let elements = [fixed(ScalarType::Byte, 9), big(ScalarType::Word)];
    let layout = FrameLayout::new(Carrier::Stream, Direction::Output, &[], &[0xEE], &elements, None).unwrap();
    assert_eq!(layout.probe(&elements, &[9, 1, 2, 0xEE]), Probe::Frame(4));
    assert_eq!(layout.probe(&elements, &[8, 1, 2, 0xEE]), Probe::No(6));
    assert_eq!(layout.probe(&elements, &[9, 1, 2, 0xEF]), Probe::No(6));
    assert_eq!(layout.probe(&elements, &[9, 1]), Probe::Partial(2));
}

#[test]
fn a_checksum_stands_where_its_device_has_it() {
    let elements = [big(ScalarType::Byte), big(ScalarType::Word)];
    let place = |behind, first, last| {
        let sum = Checksum::standard(Algorithm::Xor8).over(first, last);
        FrameLayout::new(Carrier::Stream, Direction::Output, &[0x55], &[0xEE], &elements, Some((sum, behind)))
    };
    let behind = place(2, 0, None).unwrap();
    assert_eq!(encoded(&behind, &elements, &[1.0, 515.0]), [0x55, 1, 2, 3, 0x55, 0xEE]);
    let without_head = place(2, 1, None).unwrap();
    assert_eq!(encoded(&without_head, &elements, &[1.0, 515.0]), [0x55, 1, 2, 3, 0, 0xEE]);
    let before = place(0, 2, Some(4)).unwrap();
    let frame = encoded(&before, &elements, &[1.0, 515.0]);
    assert_eq!(frame, [0x55, 0, 1, 2, 3, 0xEE]);
    assert_eq!(decoded(&before, &elements, &frame), [1.0, 515.0]);
    let between = place(1, 0, None).unwrap();
    let frame = encoded(&between, &elements, &[1.0, 515.0]);
    assert_eq!(frame, [0x55, 1, 0x54, 2, 3, 0xEE]);
    assert_eq!(decoded(&between, &elements, &frame), [1.0, 515.0]);

    assert_eq!(place(3, 0, None).unwrap_err(), LayoutError::ChecksumPlace);
    assert_eq!(place(2, 4, None).unwrap_err(), LayoutError::ChecksumRange, "nothing");
    assert_eq!(place(2, 0, Some(4)).unwrap_err(), LayoutError::ChecksumRange, "itself");
    assert_eq!(place(0, 2, Some(5)).unwrap_err(), LayoutError::ChecksumRange, "the tail");
    let bits = [bits(0, 1, false), bits(1, 1, true)];
    let split = FrameLayout::new(Carrier::Stream, Direction::Output, &[], &[], &bits, standard("sum8", 1));
    assert_eq!(split.unwrap_err(), LayoutError::ChecksumPlace);
}

#[test]
fn a_checksum_in_digits() {
    // Like Modbus ASCII, with an LRC in two digits.
    let elements = [value(Kind::Hex(Width::Fixed(4)), ByteOrder::Big)];
    let sum = Checksum { text: true, first: 1, ..Checksum::standard(Algorithm::Sum8) };
    let layout =
        FrameLayout::new(Carrier::Stream, Direction::Output, b":", b"\r\n", &elements, Some((sum, 1)))
            .unwrap();
    let frame = encoded(&layout, &elements, &[f64::from(0x12AB)]);
    // '1' + '2' + 'A' + 'B' is 0xE6.
    assert_eq!(frame, b":12ABE6\r\n");
    assert_eq!(layout.probe(&elements, b":12ABe6\r\n"), Probe::Frame(9));
    assert_eq!(layout.probe(&elements, b":12ABE7\r\n"), Probe::Wrong(9));
}

#[test]
fn fields_of_varying_length_end_where_their_delimiter_is() {
    let digits = |end, decimals| {
        value(Kind::Decimal(Digits { width: Width::Until(end), decimals }), ByteOrder::Little)
    };
    let elements = [digits(b',', 0), digits(b'\r', 2)];
    let layout =
        FrameLayout::new(Carrier::Stream, Direction::Output, b"ST,", b"\n", &elements, None).unwrap();
    assert_eq!(layout.lengths(), (6, 38));
    assert_eq!(decoded(&layout, &elements, b"ST,17,-  3.25\r\n"), [17.0, -3.25]);
    assert_eq!(encoded(&layout, &elements, &[17.0, -3.25]), b"ST,17,-3.25\r\n");
    for len in 1..15 {
        let probe = layout.probe(&elements, &b"ST,17,-  3.25\r\n"[..len]);
        assert!(matches!(probe, Probe::Partial(1..)), "{len} bytes: {probe:?}");
    }
    assert_eq!(layout.probe(&elements, b"ST,17,123456789012345678\r\n"), Probe::No(4), "too long");
    assert_eq!(layout.probe(&elements, b"SA"), Probe::No(2), "seen at once");
    // Found, but its value is rejected.
    let frame = b"ST,x,1\r\n";
    assert_eq!(layout.probe(&elements, frame), Probe::Frame(8));
    assert_eq!(layout.values(&elements, frame).next(), Some(Err(Unreadable::NotADigit)));
}

#[test]
fn can_frames_have_no_delimiters_and_eight_bytes() {
    let elements = [bits(0, 4, false), bits(4, 4, true), big(ScalarType::Float), big(ScalarType::Word)];
    let layout =
        FrameLayout::new(Carrier::Can, Direction::Output, &[], &[], &elements, standard("crc8-sae-j1850", 4))
            .unwrap();
    assert_eq!(layout.lengths(), (8, 8));
    let frame = encoded(&layout, &elements, &[3.0, 12.0, 1.5, 258.0]);
    assert_eq!(frame[..7], [0xC3, 0x3F, 0xC0, 0, 0, 1, 2]);
    assert_eq!(decoded(&layout, &elements, &frame), [3.0, 12.0, 1.5, 258.0]);
    let too_long = [big(ScalarType::Double), big(ScalarType::Byte)];
    let error = FrameLayout::new(Carrier::Can, Direction::Output, &[], &[], &too_long, None).unwrap_err();
    assert_eq!(error, LayoutError::TooLong { len: 9, room: 8 });
}

#[test]
fn what_cannot_be_laid_out_is_refused() {
    let new = |elements: &[Element]| {
        FrameLayout::new(Carrier::Stream, Direction::Output, &[1], &[], elements, None)
            .map(|layout| layout.lengths())
    };
    assert_eq!(new(&[]), Ok((1, 1)), "a head alone");
    let without_head = FrameLayout::new(Carrier::Stream, Direction::Output, &[], b"\r", &[], None);
    assert_eq!(without_head.map(|layout| layout.lengths()), Err(LayoutError::Empty));
    assert_eq!(new(&vec![big(ScalarType::Byte); 129]), Err(LayoutError::TooManyElements));
    assert_eq!(new(&vec![big(ScalarType::Double); 64]), Err(LayoutError::TooLong { len: 513, room: 512 }));
    let encoding = Err(LayoutError::Encoding { element: 1 });
    let with = |element: Element| new(&[big(ScalarType::Byte), element]);
    assert_eq!(with(Element::Padding { len: 0, fill: 0 }), encoding);
    assert_eq!(with(value(Kind::Bcd { bytes: 5 }, ByteOrder::Big)), encoding);
    assert_eq!(with(value(Kind::Hex(Width::Fixed(9)), ByteOrder::Big)), encoding);
    assert_eq!(with(value(Kind::Hex(Width::Until(b'A')), ByteOrder::Big)), encoding);
    assert_eq!(with(bits(5, 4, false)), encoding);
    assert_eq!(with(bits(0, 0, false)), encoding);
    let three = Digits { width: Width::Fixed(3), decimals: 2 };
    assert_eq!(with(value(Kind::Decimal(three), ByteOrder::Big)), encoding);
    let words = Err(LayoutError::NotWords { element: 1 });
    assert_eq!(with(value(Kind::Int24, ByteOrder::BigSwapped)), words);
    assert_eq!(with(value(Kind::Scalar(ScalarType::Byte), ByteOrder::LittleSwapped)), words);
    assert_eq!(with(fixed(ScalarType::Byte, 256)), Err(LayoutError::Constant { element: 1 }));
    assert_eq!(with(fixed(ScalarType::Float, 1)), Err(LayoutError::Constant { element: 1 }));
    let shared = Err(LayoutError::NotShared { element: 1 });
    assert_eq!(with(bits(0, 1, true)), shared, "no bits before");
    assert_eq!(new(&[bits(0, 2, false), bits(1, 1, true)]), shared, "the same bit");
    assert_eq!(new(&[bits(0, 2, false), bits(2, 6, true)]), Ok((2, 2)));
    // Received bytes may be used twice.
    let twice = Element::value(Encoding { shared: true, ..Encoding::scalar(ScalarType::Byte) });
    assert_eq!(with(twice), shared);
    let input = |elements: &[Element]| {
        FrameLayout::new(Carrier::Stream, Direction::Input, &[1], &[], elements, None)
            .map(|layout| layout.lengths())
    };
    assert_eq!(input(&[big(ScalarType::Word), twice, bits(3, 1, true)]), Ok((3, 3)));
    assert_eq!(input(&[twice]), Err(LayoutError::NotShared { element: 0 }));
    let nothing =
        FrameLayout::new(Carrier::Stream, Direction::Output, &[], &[], &[big(ScalarType::Byte)], None);
    assert_eq!(nothing.unwrap_err(), LayoutError::NothingToFind);
    let long =
        FrameLayout::new(Carrier::Stream, Direction::Output, &[0; 9], &[], &[big(ScalarType::Byte)], None);
    assert_eq!(long.unwrap_err(), LayoutError::DelimiterTooLong { len: 9 });
}

fn text(width: TextWidth) -> Element {
    Element::Text(Text { width, fill: None })
}

fn length(counts: Counts, plus: i8) -> Element {
    Element::Length(Length { encoding: Encoding::scalar(ScalarType::Byte), counts, plus })
}

/// A length, a byte, and a text; checksum and tail as requested.
fn sized(counts: Counts, plus: i8, checked: bool) -> (Vec<Element>, FrameLayout) {
    let elements = vec![length(counts, plus), fixed(ScalarType::Byte, 7), text(TextWidth::Rest)];
    let checksum = if checked { standard("crc16-modbus", 3) } else { None };
    let layout =
        FrameLayout::new(Carrier::Stream, Direction::Input, &[2], &[3], &elements, checksum).unwrap();
    (elements, layout)
}

fn sized_frame(layout: &FrameLayout, elements: &[Element], characters: &[u8]) -> Vec<u8> {
    let mut out = [0; 512];
    let put = |_: usize, out: &mut [u8]| {
        out.get_mut(..characters.len())?.copy_from_slice(characters);
        Some(characters.len())
    };
    let len = layout.encode_with(elements, |_| 0.0, put, &mut out).unwrap();
    out[..len].to_vec()
}

#[test]
fn a_length_tells_where_the_frame_ends() {
    // Head, length, 7, "AB", checksum, tail.
    for (counts, plus, checked, expected) in [
        (Counts::Rest, 0, false, 4),
        (Counts::Rest, 1, false, 3),
        (Counts::Rest, 0, true, 6),
        (Counts::Frame, 0, false, 6),
        (Counts::Frame, 0, true, 8),
        (Counts::Fields, 0, false, 3),
        (Counts::Fields, 0, true, 3),
        (Counts::Fields, -2, true, 5),
    ] {
        let (elements, layout) = sized(counts, plus, checked);
        let frame = sized_frame(&layout, &elements, b"AB");
        assert_eq!(frame[1], expected, "{counts:?} {plus} {checked}");
        for len in 0..frame.len() {
            let found = layout.probe(&elements, &frame[..len]);
            assert!(matches!(found, Probe::Partial(_)), "{len} of {frame:?}: {found:?}");
        }
        let longer = [&frame[..], &[3, 3]].concat();
        assert_eq!(layout.probe(&elements, &longer), Probe::Frame(frame.len()));
        assert_eq!(layout.probe_whole(&elements, &frame), Probe::Frame(frame.len()));
        assert!(matches!(layout.probe_whole(&elements, &longer), Probe::No(_)));
        assert_eq!(layout.text(&elements, &frame, 2), Some(&b"AB"[..]));
        assert_eq!((layout.text(&elements, &frame, 1), layout.text(&elements, &frame, 9)), (None, None));
    }
}

#[test]
fn a_length_out_of_range_is_no_frame() {
    let (elements, layout) = sized(Counts::Rest, 0, false);
    assert_eq!(layout.lengths(), (4, 132));
    // Head, length, 7, the text, tail: 4 + 128 bytes at most.
    for (number, is_possible) in [(0, false), (1, false), (2, true), (130, true), (131, false), (255, false)]
    {
        let found = layout.probe(&elements, &[2, number, 7, 3]);
        assert_eq!(!matches!(found, Probe::No(_)), is_possible, "{number}: {found:?}");
    }
}

#[test]
fn a_frame_of_fixed_fields_has_the_length_it_says() {
    let elements = [length(Counts::Rest, 0), value(Kind::Scalar(ScalarType::Word), ByteOrder::Big)];
    let layout = FrameLayout::new(Carrier::Stream, Direction::Input, &[2], &[], &elements, None).unwrap();
    assert_eq!(layout.probe(&elements, &[2, 2, 1, 2]), Probe::Frame(4));
    assert!(matches!(layout.probe(&elements, &[2, 3, 1, 2]), Probe::No(_)));
    assert_eq!(encoded(&layout, &elements, &[0.0, 258.0]), [2, 2, 1, 2]);
}

#[test]
fn a_length_of_some_bits_leaves_the_others() {
    let kind = |first| Kind::Bits(Bits { bytes: 1, first, count: 4, signed: false });
    let bits = |first, shared| Encoding { kind: kind(first), order: ByteOrder::Little, shared };
    let elements = [
        Element::value(bits(4, false)),
        Element::Length(Length { encoding: bits(0, true), counts: Counts::Rest, plus: 0 }),
        text(TextWidth::Rest),
    ];
    let layout = FrameLayout::new(Carrier::Stream, Direction::Output, &[2], &[], &elements, None).unwrap();
    let mut out = [0xA5; 8];
    let put = |_: usize, out: &mut [u8]| {
        out[..3].copy_from_slice(b"ABC");
        Some(3)
    };
    assert_eq!(layout.encode_with(&elements, |_| 9.0, put, &mut out), Some(5));
    assert_eq!(&out[..5], b"\x02\x93ABC");
    let too_long = |_: usize, _: &mut [u8]| Some(16);
    assert_eq!(layout.encode_with(&elements, |_| 9.0, too_long, &mut [0; 64]), None);
}

#[test]
fn texts_must_begin_and_end_somewhere() {
    let layout = |carrier, direction, head: &[u8], elements: &[Element]| {
        FrameLayout::new(carrier, direction, head, b"\r\n", elements, None).map(|layout| layout.lengths())
    };
    let (input, output) = (Direction::Input, Direction::Output);
    let until = text(TextWidth::Until(b';'));
    for width in [TextWidth::Rest, TextWidth::Until(b';'), TextWidth::Fixed(13)] {
        let found = layout(Carrier::Stream, input, &[], &[text(width)]);
        assert_eq!(found, Err(LayoutError::NoBeginning { element: 0 }), "{width:?}");
        assert!(layout(Carrier::Whole, input, &[], &[text(width)]).is_ok());
        assert!(layout(Carrier::Stream, output, &[], &[text(width)]).is_ok());
    }
    let found = layout(Carrier::Stream, input, &[2], &[until, text(TextWidth::Rest)]);
    assert_eq!(found, Err(LayoutError::NoEnd { element: 1 }));
    assert_eq!(layout(Carrier::Stream, input, &[2], &[until, until]), Ok((5, 261)));
    let found = layout(Carrier::Whole, input, &[2], &[text(TextWidth::Rest), until]);
    assert_eq!(found, Err(LayoutError::BehindRest { element: 1 }));
    let found = layout(Carrier::Whole, input, &[2], &[text(TextWidth::Fixed(129))]);
    assert_eq!(found, Err(LayoutError::Encoding { element: 0 }));
    let twice = [length(Counts::Rest, 0), length(Counts::Rest, 0)];
    assert_eq!(layout(Carrier::Stream, input, &[2], &twice), Err(LayoutError::Length { element: 1 }));
}

#[test]
fn the_rest_ends_before_what_is_behind_it() {
    let elements = [text(TextWidth::Rest), fixed(ScalarType::Byte, 9), text(TextWidth::Fixed(2))];
    let layout =
        FrameLayout::new(Carrier::Whole, Direction::Input, &[], b"\n", &elements, standard("xor8", 1))
            .unwrap();
    let frame = [b"ABC", &[b'A' ^ b'B' ^ b'C'][..], &[9], b"xy\n"].concat();
    assert_eq!(layout.probe_whole(&elements, &frame), Probe::Frame(frame.len()));
    assert_eq!(layout.text(&elements, &frame, 0), Some(&b"ABC"[..]));
    assert_eq!(layout.text(&elements, &frame, 2), Some(&b"xy"[..]));
    let mut wrong = frame.clone();
    wrong[0] ^= 1;
    assert_eq!(layout.probe_whole(&elements, &wrong), Probe::Wrong(frame.len()));
    assert_eq!(layout.probe_whole(&elements, &frame[1..]), Probe::Wrong(frame.len() - 1));
    assert!(matches!(layout.probe_whole(&elements, b"\n"), Probe::Partial(_)));
}

proptest! {
    /// The same frames as from a reader that tries each length separately, for any stream.
    #[test]
    fn frames_with_a_length_are_those_of_a_slow_reader(
        stream in prop::collection::vec(prop::sample::select(vec![2_u8, 3, 4, 5, 7, b'A']), 0..60),
    ) {
        let (elements, layout) = sized(Counts::Rest, 0, false);
        let slow = |bytes: &[u8]| {
            let len = 2 + usize::from(*bytes.get(1)?);
            let frame = bytes.get(..len)?;
            (len >= 4 && frame[0] == 2 && frame[2] == 7 && frame[len - 1] == 3).then_some(len)
        };
        for at in 0..stream.len() {
            let found = match layout.probe(&elements, &stream[at..]) {
                Probe::Frame(len) => Some(len),
                _ => None,
            };
            prop_assert_eq!(found, slow(&stream[at..]));
        }
    }
}

#[test]
fn the_parts_of_a_frame_are_told_with_their_places() {
    let until = Element::Text(Text { width: TextWidth::Until(b','), fill: None });
    let word = Element::value(Encoding::scalar(ScalarType::Word));
    let told = |elements: &[Element], behind| {
        let layout = FrameLayout::new(
            Carrier::Stream,
            Direction::Input,
            &[2],
            &[13, 10],
            elements,
            standard("crc16-modbus", behind),
        );
        let mut told = Vec::new();
        layout.unwrap().parts(elements, |part, place| told.push((part, place.at, place.len)));
        told
    };
    assert_eq!(
        told(&[bits(0, 4, false), bits(4, 4, true), word, until, word], 5),
        [
            (Part::Head, Some(0), Some(1)),
            (Part::Element(0), Some(1), Some(1)),
            (Part::Element(1), Some(1), Some(1)),
            (Part::Element(2), Some(2), Some(2)),
            (Part::Element(3), Some(4), None),
            (Part::Element(4), None, Some(2)),
            (Part::Checksum, None, Some(2)),
            (Part::Tail, None, Some(2)),
        ]
    );
    assert_eq!(
        told(&[word, word], 1)[1..],
        [
            (Part::Element(0), Some(1), Some(2)),
            (Part::Checksum, Some(3), Some(2)),
            (Part::Element(1), Some(5), Some(2)),
            (Part::Tail, Some(7), Some(2)),
        ]
    );
}

#[test]
fn the_checksum_in_a_frame_is_told_with_the_right_one() {
    let elements = [Element::Text(Text { width: TextWidth::Until(b','), fill: None })];
    let sum = standard("xor8", 1).map(|(sum, behind)| (Checksum { text: true, ..sum }, behind));
    let layout = FrameLayout::new(Carrier::Stream, Direction::Input, b"$", b"\r\n", &elements, sum).unwrap();
    let frame = b"$AB,00\r\n";
    assert_eq!(layout.probe(&elements, frame), Probe::Wrong(8));
    let right = std::format!("{:02X}", b"$AB,".iter().fold(0, |sum, byte| sum ^ byte));
    let (found, told) = layout.checksums(&elements, frame).unwrap();
    assert_eq!((found, &told[..]), (&b"00"[..], right.as_bytes()));
    let plain = FrameLayout::new(Carrier::Stream, Direction::Input, b"$", b"\r\n", &elements, None);
    assert_eq!(plain.unwrap().checksums(&elements, b"$AB,\r\n"), None);
}

/// Examples of AUTOSAR document 849 (E2E protocol specification, R20-11) for profile 11, with which profile 1 is
/// interoperable, and for profile 22 with one data id; the crate autosar-e2e 1.0.0 tests the same bytes. All data is
/// zero.
#[test]
fn a_checksum_covers_a_data_id_that_is_not_in_the_frame() {
    let counter = fixed(ScalarType::Byte, 0);
    let frame = |kind: &str, id: DataId, header: i64| {
        let header = match counter {
            Element::Fixed { encoding, .. } => Element::Fixed { encoding, value: header },
            other => other,
        };
        let elements = [header, Element::Padding { len: 6, fill: 0 }];
        let sum = Checksum::standard(Algorithm::named(kind).unwrap()).over(1, Some(7)).with_data_id(id);
        let layout =
            FrameLayout::new(Carrier::Can, Direction::Output, &[], &[], &elements, Some((sum, 0))).unwrap();
        let bytes = encoded(&layout, &elements, &[0.0; 2]);
        assert_eq!(layout.probe_whole(&elements, &bytes), Probe::Frame(8));
        let wrong = Checksum { data_id: DataId::NONE, ..sum };
        let without =
            FrameLayout::new(Carrier::Can, Direction::Input, &[], &[], &elements, Some((wrong, 0))).unwrap();
        assert_eq!(without.probe_whole(&elements, &bytes), Probe::Wrong(8), "for somebody else");
        (bytes[0], bytes[1])
    };
    let both = DataId::new(&0x123_u16.to_le_bytes()).unwrap();
    assert_eq!(frame("crc8-gsm-a", both, 0), (0xCC, 0x00));
    assert_eq!(frame("crc8-gsm-a", both, 1), (0x91, 0x01));
    // The high nibble of the id is part of the frame.
    let nibble = DataId::new(&[0x23, 0]).unwrap();
    assert_eq!(frame("crc8-gsm-a", nibble, 0x10), (0x2A, 0x10));
    assert_eq!(frame("crc8-gsm-a", nibble, 0x11), (0x77, 0x11));
    let behind = |id| DataId::new(&[id]).unwrap().behind();
    assert_eq!(frame("crc8-autosar", behind(2), 1), (0x1B, 0x01));
    assert_eq!(frame("crc8-autosar", behind(3), 2), (0x98, 0x02));
    assert_eq!(DataId::new(&[0; 5]), None);
}
