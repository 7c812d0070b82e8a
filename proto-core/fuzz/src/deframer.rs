//! Stream recipes: any bytes, in any pieces, against D19 read literally (docs/wire/recipes.md
//! sections 3 to 5 and 7).

use proto_core::recipe::model::{Field, Framing};
use proto_core::recipe::{Applied, Deframer, DeframerStats, StreamLayout, ValueError, datagram};
use proto_core::sysvar::IMAGE_BYTES;
use proto_core::wire::scalar::Scalar;

use crate::recipes::Part;
use crate::reference::{self, PlainDeframer};
use crate::source::{Source, cut};

/// Bytes of line that one input may lead to.
const LONGEST_LINE: usize = 16 * 1024;
/// How many payloads of an input are looked into.
const PAYLOADS: usize = 8;

pub(crate) fn run(input: &[u8]) {
    let mut input = Source::new(input);
    let part = Part::read(&mut input);
    let Some(layout) = part.layout() else { return };
    let mut test = Test {
        deframer: Deframer::new(),
        line: PlainDeframer::new(&layout),
        received: 0,
        payloads: 0,
        fields: &part.fields,
        layout: &layout,
    };
    let how = input.u8();
    let (mut line, mut piece) = (Vec::new(), Vec::new());
    while !input.is_empty() {
        let op = input.u8();
        match op % 8 {
            // A frame, whole, cut, or with a byte changed.
            0..=2 => {
                piece = frame(&layout, input.take(1 + usize::from(op >> 4)));
                match op % 8 {
                    1 => piece.truncate(usize::from(input.u16()) % (piece.len() + 1)),
                    2 => {
                        let at = usize::from(input.u16()) % piece.len();
                        piece[at] ^= input.u8();
                    }
                    _ => {}
                }
            }
            3 => piece = input.run().to_vec(),
            4 => piece = layout.head().to_vec(),
            5 => piece = layout.tail().to_vec(),
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
    if part.framing == Framing::Datagram {
        datagrams(&layout, &line);
    }
}

struct Test<'a> {
    deframer: Deframer,
    line: PlainDeframer,
    received: u64,
    payloads: usize,
    fields: &'a [Field],
    layout: &'a StreamLayout,
}

impl Test<'_> {
    fn receive(&mut self, line: &[u8], how: u8) {
        // Without head and tail there are no frames in a stream; only datagrams have such recipes.
        if self.layout.head().is_empty() && self.layout.tail().is_empty() {
            return;
        }
        for chunk in cut(line, how) {
            self.received += chunk.len() as u64;
            let expected = self.line.receive(chunk);
            let (mut rest, mut found) = (chunk, Vec::new());
            loop {
                let before = rest.len();
                let Some(payload) = self.deframer.next_frame(self.layout, &mut rest) else { break };
                // Each call takes what it looked at: that is what bounds the number of calls.
                assert!(rest.len() < before, "a frame was found and nothing was taken");
                found.push(payload.to_vec());
            }
            assert!(rest.is_empty(), "None means that the chunk is used up");
            let (head, len) = (self.layout.head().len(), self.layout.payload_len());
            let payloads: Vec<_> = expected.iter().map(|frame| frame[head..head + len].to_vec()).collect();
            assert_eq!(found, payloads);
            self.counters();
            for (frame, payload) in expected.iter().zip(&payloads) {
                if self.payloads < PAYLOADS {
                    self.payloads += 1;
                    assert_eq!(datagram(self.layout, frame), Ok(&payload[..]));
                    values(self.layout, self.fields, frame, payload);
                }
            }
        }
    }

    fn silence(&mut self) {
        let held = self.line.held();
        self.line.silence();
        assert_eq!(self.deframer.discard(), held);
        self.counters();
    }

    fn counters(&self) {
        let expected = DeframerStats {
            frames: self.line.frames,
            skipped_bytes: self.line.dropped,
            tail_mismatches: self.line.wrong_tails,
            discarded_bytes: self.line.discarded,
        };
        assert_eq!(self.deframer.stats(), expected);
        assert_eq!(self.deframer.pending(), self.line.held());
        assert!(self.deframer.pending() < self.layout.frame_len());
        let in_frames = expected.frames * self.layout.frame_len() as u64;
        let accounted = in_frames + expected.skipped_bytes + expected.discarded_bytes;
        assert_eq!(accounted + self.line.held() as u64, self.received, "every byte is somewhere");
    }
}

/// A frame whose payload is made of `bytes`, over and over.
fn frame(layout: &StreamLayout, bytes: &[u8]) -> Vec<u8> {
    let bytes = if bytes.is_empty() { &[0] } else { bytes };
    let payload = bytes.iter().copied().cycle().take(layout.payload_len()).collect::<Vec<_>>();
    [layout.head(), &payload, layout.tail()].concat()
}

/// Section 7, and encoding again.
fn values(layout: &StreamLayout, fields: &[Field], frame: &[u8], payload: &[u8]) {
    let before = [0x5A; IMAGE_BYTES];
    let mut image = before;
    let applied = layout.apply(payload, &mut image);
    let expected = reference::apply(fields, payload, &before);
    match &expected {
        Ok((after, masked)) => {
            assert_eq!(applied, Ok(Applied { masked: *masked }));
            assert_eq!(layout.check(payload), Ok(()));
            assert_eq!(image[..], after[..]);
        }
        Err(field) => {
            assert_eq!(applied, Err(ValueError::NotFinite { field: *field }));
            assert_eq!(layout.check(payload), applied.map(|_| ()));
            assert_eq!(image, before, "all or nothing");
        }
    }
    let got: Vec<Scalar> = layout.values(payload).collect();
    let mut out = [0xA5; 520];
    assert_eq!(layout.encode_values(&got, &mut out), Ok(frame.len()));
    assert_eq!(out[..frame.len()], *frame);
    assert!(out[frame.len()..].iter().all(|&byte| byte == 0xA5), "nothing past the frame is written");
    assert!(layout.encode(&image, &mut out[..frame.len() - 1]).is_err());
    if let (Ok((_, 0)), Some(Field::System(_))) = (&expected, fields.first()) {
        out.fill(0xA5);
        assert_eq!(layout.encode(&image, &mut out), Ok(frame.len()));
        // An output variable may stand in a part twice; the image has the last.
        let twice = (1..fields.len()).any(|nth| fields[..nth].contains(&fields[nth]));
        assert!(twice || out[..frame.len()] == *frame);
    }
}

/// Section 5: what is not exactly one frame is refused.
fn datagrams(layout: &StreamLayout, line: &[u8]) {
    let len = layout.frame_len();
    for from in 0..line.len().min(64) {
        for piece in [line.get(from..from + len), line.get(from..from + len + 1), line.get(from..)] {
            let Some(piece) = piece else { continue };
            let right =
                piece.len() == len && piece.starts_with(layout.head()) && piece.ends_with(layout.tail());
            let payload = &piece[layout.head().len().min(piece.len())..];
            match datagram(layout, piece) {
                Ok(found) => {
                    assert!(right && payload.starts_with(found) && found.len() == layout.payload_len())
                }
                Err(_) => assert!(!right),
            }
        }
    }
}

pub(crate) fn seeds() -> Vec<Vec<u8>> {
    let part = |kind: u8, head: &[u8], tail: &[u8], fields: &[u8]| {
        [&[kind, head.len() as u8], head, &[tail.len() as u8], tail, fields].concat()
    };
    let bytes = |bytes: &[u8]| [&[3, bytes.len() as u8], bytes].concat();
    let three = part(0, &[255, 255], &[238, 238], &[3, 0, 0]);
    let command = part(1, &[255, 255], &[238, 238], &[1, 0, 0]);
    let pose = part(3, &[255, 255], &[254, 254], &[4, 13, 3]);
    // The force sensor.
    let sensor = part(1, &[0x48, 0xAA], &[0x0D, 0x0A], &[6, 77, 5]);
    let user_sensor = part(0, &[0x48, 0xAA], &[0x0D, 0x0A], &[6, 0, 0x66]);
    let nested = part(0, &[255; 8], &[255, 255, 255, 255, 255, 255, 255, 254], &[24, 0, 0]);
    let overlapping = part(0, &[255, 255, 1], &[], &[1, 0, 0]);
    let bare = part(7, &[], &[], &[6, 13, 5]);
    let longest = part(0, &[255; 8], &[254; 8], &[62, 0, 0x77]);
    let many = part(3, &[255], &[], &[128, 8, 39, 50, 39, 90, 39, 8, 39]);
    let floats = [0x9A_u8, 0x99, 0x19, 0x3F, 0, 0, 0x80, 0x3F, 0, 0, 0x80, 0x7F];
    vec![
        [&three[..], &[0], &bytes(&[255, 255, 1, 2, 3, 238, 238])].concat(),
        [&three[..], &[1], &bytes(&[255, 255, 255, 1, 2, 3, 238, 255, 255, 1, 2, 3, 238, 238])].concat(),
        [&command[..], &[0], &bytes(&[255, 255, 1, 238, 238])].concat(),
        [&pose[..], &[3, 0xF0], &floats, &[0x16]].concat(),
        [
            &sensor[..],
            &[130, 0xB0],
            &floats,
            &[0x31, 1, 2, 3, 4, 5, 0, 0x91],
            &floats,
            &[9, 0, 7, 0xB0],
            &floats,
        ]
        .concat(),
        [&user_sensor[..], &[64, 0xB0], &floats, &[0xB2], &floats, &[27, 0, 1, 0xF6, 4, 5]].concat(),
        [&nested[..], &[200, 4, 0xF6, 0xF6, 0xF6, 5]].concat(),
        [&nested[..], &[0, 0x00, 255, 0xF6, 0x10, 255, 254, 0xF6]].concat(),
        [&overlapping[..], &[70], &bytes(&[255, 255, 255, 1, 85, 255, 0, 255, 255, 1, 102])].concat(),
        [&bare[..], &[0, 0xB0], &floats, &[0xB0], &floats].concat(),
        [
            &longest[..],
            &[255, 0xF0],
            &floats,
            &floats,
            &[0xF6, 4, 5, 0xF1],
            &floats,
            &floats,
            &[200, 1, 0xF6],
        ]
        .concat(),
        [&many[..], &[0, 0xF0], &floats, &[0xF6]].concat(),
    ]
}
