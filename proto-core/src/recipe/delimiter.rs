//! Heads and tails of stream frames. They are compared as one word: comparing byte by byte would be half the work of
//! decoding a short frame.

use super::model::MAX_DELIMITER;
use crate::wire::runs;

/// Up to 8 bytes at the front of a frame, padded with zeros at the end.
#[derive(Debug, Clone, Copy)]
pub(super) struct FrameHead {
    word: [u8; MAX_DELIMITER],
    /// Ones in the bytes of the head.
    mask: [u8; MAX_DELIMITER],
    len: u8,
}

/// Up to 8 bytes at the end of a frame, padded with zeros at the front.
#[derive(Debug, Clone, Copy)]
pub(super) struct FrameTail {
    word: [u8; MAX_DELIMITER],
    /// Ones in the bytes of the tail.
    mask: [u8; MAX_DELIMITER],
    len: u8,
}

impl FrameHead {
    /// `None` if there are more than 8 bytes.
    pub(super) fn new(head: &[u8]) -> Option<Self> {
        let (mut word, mut mask) = ([0; MAX_DELIMITER], [0; MAX_DELIMITER]);
        word.get_mut(..head.len())?.copy_from_slice(head);
        mask.get_mut(..head.len())?.fill(0xFF);
        Some(Self { word, mask, len: head.len() as u8 })
    }

    pub(super) fn bytes(&self) -> &[u8] {
        self.word.get(..self.len()).unwrap_or(&[])
    }

    pub(super) const fn len(&self) -> usize {
        self.len as usize
    }

    /// The head, padded with zeros at the end.
    pub(super) const fn padded(&self) -> [u8; MAX_DELIMITER] {
        self.word
    }

    /// Whether `data` begins with the head, or is the beginning of it.
    pub(super) fn agrees(&self, data: &[u8]) -> bool {
        let front = match data.first_chunk() {
            Some(front) => *front,
            None => {
                // Bytes that have not arrived count as equal.
                let mut front = self.word;
                if let Some(front) = front.get_mut(..data.len()) {
                    runs::copy(front, data);
                }
                front
            }
        };
        agree(front, self.word, self.mask)
    }
}

impl FrameTail {
    /// `None` if there are more than 8 bytes.
    pub(super) fn new(tail: &[u8]) -> Option<Self> {
        let (mut word, mut mask) = ([0; MAX_DELIMITER], [0; MAX_DELIMITER]);
        let unused = MAX_DELIMITER.checked_sub(tail.len())?;
        word.get_mut(unused..)?.copy_from_slice(tail);
        mask.get_mut(unused..)?.fill(0xFF);
        Some(Self { word, mask, len: tail.len() as u8 })
    }

    pub(super) fn bytes(&self) -> &[u8] {
        self.word.get(MAX_DELIMITER.saturating_sub(self.len())..).unwrap_or(&[])
    }

    pub(super) const fn len(&self) -> usize {
        self.len as usize
    }

    /// The tail, padded with zeros at the front.
    pub(super) const fn padded(&self) -> [u8; MAX_DELIMITER] {
        self.word
    }

    /// Whether `frame` ends with the tail.
    pub(super) fn ends(&self, frame: &[u8]) -> bool {
        let back = match frame.last_chunk() {
            Some(back) => *back,
            None => {
                // A frame is never shorter than its tail.
                let mut back = self.word;
                if let Some(back) = back.get_mut(MAX_DELIMITER.saturating_sub(frame.len())..) {
                    runs::copy(back, frame);
                }
                back
            }
        };
        agree(back, self.word, self.mask)
    }
}

/// Whether two words are equal in the bits of the mask.
fn agree(a: [u8; MAX_DELIMITER], b: [u8; MAX_DELIMITER], mask: [u8; MAX_DELIMITER]) -> bool {
    (u64::from_ne_bytes(a) ^ u64::from_ne_bytes(b)) & u64::from_ne_bytes(mask) == 0
}
