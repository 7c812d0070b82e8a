//! Frames of devices: any layout, any bytes, in any pieces, against a slow reader that has all bytes
//! before it.

use proto_core::device::{
    Algorithm, Bits, ByteOrder, Carrier, Checksum, Crc, Digits, Element, Encoding, Found, FrameLayout,
    Framer, Kind, Overflow, Probe, Width,
};
use proto_core::sysvar::Direction;
use proto_core::wire::scalar::ScalarType;

use crate::plain_frame::{PlainFrame, Seen};
use crate::source::{Source, cut};

/// Bytes of line that one input may lead to.
const LONGEST_LINE: usize = 8 * 1024;

pub(crate) fn run(input: &[u8]) {
    let mut input = Source::new(input);
    let plain = plain_frame(&mut input);
    let PlainFrame { head, tail, elements, checksum } = &plain;
    let layout = FrameLayout::new(Carrier::Stream, Direction::Input, head, tail, elements, *checksum);
    let Ok(layout) = layout else { return };
    let how = input.u8();
    let is_of_replies = how & 1 == 1;
    let framer = if is_of_replies { Framer::of_replies() } else { Framer::new() };
    let reader = Reader { is_of_replies, ..Reader::default() };
    let mut test = Test { framer, layout, reader, received: 0, plain };
    let (mut line, mut piece) = (Vec::new(), Vec::new());
    while !input.is_empty() {
        let op = input.u8();
        match op % 8 {
            // A frame, whole, cut, or with a byte changed.
            0..=2 => {
                piece = test.frame(&mut input);
                match op % 8 {
                    1 => piece.truncate(usize::from(input.u16()) % (piece.len() + 1)),
                    2 if !piece.is_empty() => {
                        let at = usize::from(input.u16()) % piece.len();
                        piece[at] ^= input.u8();
                    }
                    _ => {}
                }
            }
            3 => piece = input.run().to_vec(),
            4 => piece = test.plain.head.clone(),
            5 => piece = test.plain.tail.clone(),
            // The same once more, many times.
            6 => piece = piece.repeat(1 + usize::from(op >> 4)),
            _ => {
                test.receive(&line, how);
                test.silence();
                line.clear();
                piece.clear();
            }
        }
        piece.truncate(LONGEST_LINE.saturating_sub(line.len()));
        line.extend(&piece);
    }
    test.receive(&line, how);
}

/// A reader with all bytes of the line before it.
#[derive(Default)]
struct Reader {
    line: Vec<u8>,
    at: usize,
    /// Where a frame is expected to begin.
    expected: Option<usize>,
    /// Behind the frames that were found; those with a wrong checksum among them.
    found_until: usize,
    /// A frame with a wrong checksum is one only where a frame is expected.
    is_of_replies: bool,
    skipped: usize,
}

impl Reader {
    fn receive(&mut self, plain: &PlainFrame, chunk: &[u8]) -> Vec<(Seen, Vec<u8>)> {
        self.line.extend(chunk);
        let mut found = Vec::new();
        while self.at < self.line.len() {
            let seen = plain.see(&self.line[self.at..]);
            let was_expected = self.expected == Some(self.at);
            match seen {
                Seen::Partial => break,
                Seen::Frame(len) | Seen::Other(len) => {
                    found.push((seen, self.line[self.at..self.at + len].to_vec()));
                    self.at += len;
                    (self.expected, self.found_until) = (Some(self.at), self.at);
                }
                Seen::Wrong(len) if was_expected || !self.is_of_replies && self.at >= self.found_until => {
                    found.push((seen, self.line[self.at..self.at + len].to_vec()));
                    (self.expected, self.found_until) = (Some(self.at + len), self.at + len);
                    self.at += 1;
                    self.skipped += 1;
                }
                Seen::No | Seen::Wrong(_) => {
                    if was_expected {
                        self.expected = None;
                    }
                    self.at += 1;
                    self.skipped += 1;
                }
            }
        }
        found
    }

    fn held(&self) -> &[u8] {
        &self.line[self.at..]
    }
}

struct Test {
    framer: Framer,
    layout: FrameLayout,
    reader: Reader,
    received: usize,
    plain: PlainFrame,
}

impl Test {
    fn receive(&mut self, line: &[u8], how: u8) {
        if self.received == 0 {
            self.reader.expected = Some(0);
        }
        let (layout, elements) = (&self.layout, &self.plain.elements);
        for chunk in cut(line, how) {
            self.received += chunk.len();
            let expected = self.reader.receive(&self.plain, chunk);
            let (mut rest, mut found) = (chunk, Vec::new());
            // So little effort that no byte is dropped unseen: a long frame without a head costs more than a byte pays for.
            let probe = |bytes: &[u8]| match layout.probe(elements, bytes) {
                Probe::No(_) => Probe::No(1),
                probe => probe,
            };
            while let Some(event) = self.framer.next_frame(&mut rest, 1, probe) {
                found.push(match event {
                    Found::Frame(bytes) => (Seen::Frame(bytes.len()), bytes.to_vec()),
                    Found::Other(bytes) => (Seen::Other(bytes.len()), bytes.to_vec()),
                    Found::Wrong(bytes) => (Seen::Wrong(bytes.len()), bytes.to_vec()),
                });
            }
            assert!(rest.is_empty(), "None means that the chunk is used up");
            assert_eq!(found, expected);
            assert_eq!(self.framer.held(), self.reader.held());
            let stats = self.framer.stats();
            assert_eq!(stats.skipped_bytes as usize, self.reader.skipped);
            let (shortest, longest) = layout.lengths();
            for (seen, frame) in found {
                assert!((shortest..=longest).contains(&frame.len()));
                if let Seen::Frame(_) = seen {
                    self.values(&frame);
                }
            }
        }
    }

    fn values(&self, frame: &[u8]) {
        let values = self.layout.values(&self.plain.elements, frame);
        let found: Vec<Option<f64>> = values
            .zip(&self.plain.elements)
            .filter(|(_, element)| matches!(element, Element::Value { .. }))
            .map(|(value, _)| value.ok().map(|value| value.expect("it is a value").as_f64()))
            .collect();
        let expected = self.plain.values(frame);
        assert_eq!(found.len(), expected.len());
        for (found, expected) in found.iter().zip(&expected) {
            let is_same = match (found, expected) {
                // Digits behind a point are rounded in two ways.
                (Some(one), Some(other)) => {
                    one == other
                        || one.is_nan() && other.is_nan()
                        || (one - other).abs() <= other.abs() * f64::EPSILON
                }
                (None, None) => true,
                _ => false,
            };
            assert!(is_same, "{found:?}, and slowly {expected:?}");
        }
    }

    fn silence(&mut self) {
        assert_eq!(self.framer.discard(), self.reader.held().len());
        self.reader.at = self.reader.line.len();
        self.reader.expected = Some(self.reader.at);
    }

    /// A frame with numbers of the input.
    fn frame(&self, input: &mut Source<'_>) -> Vec<u8> {
        let mut out = [0xA5; 512];
        let len = self.layout.encode(
            &self.plain.elements,
            |_| match input.u8() {
                255 => f64::from(input.u32()) * 1e6 + 0.123,
                254 => -f64::from(input.u16()),
                253 => f64::from(input.u16()) / 1000.0,
                small => f64::from(small),
            },
            &mut out,
        );
        let Some(len) = len else { return Vec::new() };
        assert!(out[len..].iter().all(|&byte| byte == 0xA5), "nothing past the frame is written");
        let (shortest, longest) = self.layout.lengths();
        assert!((shortest..=longest).contains(&len));
        // What shares bytes with a constant can change it.
        let has_shared =
            self.plain.elements.iter().filter_map(Element::encoding).any(|encoding| encoding.shared);
        let seen = self.plain.see(&out[..len]);
        assert!(has_shared || seen == Seen::Frame(len), "{seen:?}: {:02X?}", &out[..len]);
        out[..len].to_vec()
    }
}

/// An encoding, right or wrong.
pub(crate) fn encoding(input: &mut Source<'_>) -> Encoding {
    let (kind, how) = (input.u8(), input.u8());
    let width = |fixed: u8| {
        if how & 8 == 0 { Width::Fixed(fixed) } else { Width::Until(b",;\r\n k"[usize::from(how >> 4) % 6]) }
    };
    let kind = match kind % 16 {
        ty @ 0..8 => Kind::Scalar(ScalarType::ALL[usize::from(ty)]),
        8 => Kind::Uint24,
        9 => Kind::Int24,
        10 => Kind::Bcd { bytes: 1 + (kind >> 4) % 4 },
        11 => Kind::Hex(width(1 + (kind >> 4) % 8)),
        12 => Kind::Decimal(Digits { width: width(1 + (kind >> 4)), decimals: 0 }),
        13 => Kind::Decimal(Digits { width: width(1 + (kind >> 4)), decimals: input.u8() % 4 }),
        _ => {
            let (bytes, first) = (1 << (kind >> 4 & 1), input.u8());
            Kind::Bits(Bits {
                bytes: bytes << (kind >> 5 & 1),
                first: first & 31,
                count: 1 + (first >> 5) % 7,
                signed: kind & 128 != 0,
            })
        }
    };
    let orders = [ByteOrder::Little, ByteOrder::Big, ByteOrder::BigSwapped, ByteOrder::LittleSwapped];
    let order = orders[usize::from(how & 3)];
    Encoding { kind, order, shared: how & 4 != 0 }
}

/// A checksum, with a name or any parameters.
pub(crate) fn checksum(input: &mut Source<'_>) -> Checksum {
    let kind = input.u8();
    let names: Vec<&str> = Algorithm::names().collect();
    let algorithm = match usize::from(kind >> 1) {
        nth if nth < names.len() => Algorithm::named(names[nth]).expect("it has this name"),
        nth => {
            let width = 1 + (nth % 32) as u8;
            let mut number = || input.u32() >> (32 - u32::from(width));
            let (poly, init, xorout) = (number(), number(), number());
            Algorithm::Crc(Crc { width, poly, init, xorout, refin: kind & 1 != 0, refout: nth & 32 != 0 })
        }
    };
    let sum = Checksum::standard(algorithm);
    match input.u8() {
        how @ 0..32 => Checksum { text: how & 1 != 0, ..sum },
        how => {
            let order = if how & 64 == 0 { ByteOrder::Little } else { ByteOrder::Big };
            let last = (how & 128 != 0).then(|| u16::from(input.u8() % 16));
            Checksum { text: how & 1 != 0, order, ..sum }.over(u16::from(how >> 1 & 7), last)
        }
    }
}

fn plain_frame(input: &mut Source<'_>) -> PlainFrame {
    let kind = input.u8();
    let head = input.take(usize::from(kind & 3)).to_vec();
    let tail = input.take(usize::from(kind >> 2 & 3)).to_vec();
    let count = 1 + usize::from(kind >> 5);
    let elements: Vec<Element> = (0..count)
        .map(|_| match input.u8() {
            pad @ 240.. => Element::Padding { len: pad - 239, fill: pad },
            kind @ 200.. => {
                let encoding = encoding(input);
                let value = if kind & 1 == 0 { i64::from(input.u8()) } else { i64::from(input.u32() as i32) };
                Element::Fixed { encoding, value }
            }
            _ => Element::Value { encoding: encoding(input), overflow: Overflow::Usual },
        })
        .collect();
    let checksum = (kind & 16 != 0).then(|| {
        let behind = input.u8();
        (checksum(input), if behind & 128 == 0 { count } else { usize::from(behind) % (count + 1) })
    });
    PlainFrame { head, tail, elements, checksum }
}

pub(crate) fn seeds() -> Vec<Vec<u8>> {
    let life = [
        0, 0, 1, 2, 3, 4, 5, 6, 7, 8, 0x10, 9, 9, 9, 9, 2, 1, 2, 3, 4, 5, 3, 0, 0x40, 1, 1, 2, 3, 4, 2, 0, 6,
        7, 0, 4, 4, 0, 1, 2, 3, 0x36, 3, 4, 0xAA, 0, 1, 2, 5,
    ];
    // A head, a byte, a big word, CRC-16/MODBUS.
    let checked = [0x10 | 1 | 1 << 5, 0xAA, 0, 0, 0, 0, 2, 1, 0, 22, 0, 200];
    // Constants of a slave, bits of a byte, padding, CRC.
    let gripper =
        [0x10 | 5 << 5, 200, 0, 0, 9, 200, 0, 0, 3, 0, 14, 0, 0, 0, 14, 4, 0x24, 242, 0, 2, 1, 0, 22, 0, 3];
    // A scale: "S", a decimal number until 'k', "g\r".
    let scale = [1 | 2 << 2, b'S', b'g', b'\r', 0, 12, 0x58, 0];
    // Hexadecimal digits, and an LRC in digits.
    let ascii = [0x10 | 1 | 2 << 2 | 1 << 5, b':', b'\r', b'\n', 0, 0x1B, 0, 0, 0x3B, 0, 0, 44, 1, 77];
    // Nothing but a constant.
    let bare = [1 << 5, 201, 3, 1, 0xEF, 0xBE, 0, 0, 0, 2, 0, 0];
    let mut seeds =
        [&checked[..], &gripper, &scale, &ascii, &bare].map(|start| [start, &life].concat()).to_vec();
    // A long frame without a head, that begins with its own padding.
    seeds.push([&[255; 5][..], b"1", &[255; 30], b"\tSg\x02\x05"].concat());
    seeds
}
