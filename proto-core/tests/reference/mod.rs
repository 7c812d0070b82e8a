//! What docs/wire/recipes.md says of bytes and payloads, read literally: slow, obvious, and written
//! without a look at the code that does it.
#![allow(dead_code, unreachable_pub, reason = "each user takes its own part")]

use proto_core::recipe::StreamLayout;
use proto_core::recipe::model::Field;
use proto_core::sysvar::IMAGE_BYTES;
use proto_core::wire::scalar::ScalarType;

/// Section 4, D19: every byte of a line since the last silence, and how far it was understood.
#[derive(Debug, Clone)]
pub struct PlainDeframer {
    head: Vec<u8>,
    tail: Vec<u8>,
    frame_len: usize,
    bytes: Vec<u8>,
    at: usize,
    /// Frames found so far.
    pub frames: u64,
    /// Bytes dropped in steps 1 and 4.
    pub dropped: u64,
    /// Times of step 4.
    pub wrong_tails: u64,
    /// Bytes that silence discarded.
    pub discarded: u64,
}

impl PlainDeframer {
    pub fn new(layout: &StreamLayout) -> Self {
        Self {
            head: layout.head().to_vec(),
            tail: layout.tail().to_vec(),
            frame_len: layout.frame_len(),
            bytes: Vec::new(),
            at: 0,
            frames: 0,
            dropped: 0,
            wrong_tails: 0,
            discarded: 0,
        }
    }

    /// What is held: the beginning of a possible frame.
    pub fn held(&self) -> usize {
        self.bytes.len() - self.at
    }

    pub fn silence(&mut self) {
        self.discarded += self.held() as u64;
        self.at = self.bytes.len();
    }

    /// The whole frames, head and tail included, that `chunk` completes.
    pub fn receive(&mut self, chunk: &[u8]) -> Vec<Vec<u8>> {
        self.bytes.extend(chunk);
        let mut found = Vec::new();
        while self.held() > 0 {
            let front = &self.bytes[self.at..];
            if front.iter().zip(&self.head).any(|(got, wanted)| got != wanted) {
                self.at += 1;
                self.dropped += 1;
            } else if front.len() < self.frame_len {
                break;
            } else if front[..self.frame_len].ends_with(&self.tail) {
                found.push(front[..self.frame_len].to_vec());
                self.at += self.frame_len;
                self.frames += 1;
            } else {
                self.at += 1;
                self.dropped += 1;
                self.wrong_tails += 1;
            }
        }
        found
    }
}

/// Section 7, D22: the image after a payload of these fields, and how many fields had reserved bits
/// set; or the first field whose value may not be used.
pub fn apply(fields: &[Field], payload: &[u8], image: &[u8; IMAGE_BYTES]) -> Result<(Vec<u8>, u16), u8> {
    let (mut after, mut masked, mut at) = (image.to_vec(), 0, 0);
    for (nth, field) in fields.iter().enumerate() {
        let size = field.ty().size();
        let value = &payload[at..at + size];
        at += size;
        let usable = match field.ty() {
            ScalarType::Float => f32::from_le_bytes(value.try_into().unwrap()).is_finite(),
            ScalarType::Double => f64::from_le_bytes(value.try_into().unwrap()).is_finite(),
            _ => true,
        };
        if !usable {
            return Err(nth as u8);
        }
        if let Field::System(var) = field {
            let place = &mut after[var.image_offset()..][..size];
            place.copy_from_slice(value);
            if size == 1 {
                masked += u16::from(value[0] & !var.valid_bits() != 0);
                place[0] &= var.valid_bits();
            }
        }
    }
    assert_eq!(at, payload.len());
    Ok((after, masked))
}
