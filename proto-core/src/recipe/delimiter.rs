//! Heads and tails, compared as one masked word.

use super::model::MAX_DELIMITER;

/// Up to 8 bytes at the front of a frame.
#[derive(Debug, Clone, Copy)]
pub(super) struct Head {
    bytes: [u8; MAX_DELIMITER],
    mask: [u8; MAX_DELIMITER],
    len: u8,
}

/// Up to 8 bytes at the end of a frame, kept at the end of `bytes`.
#[derive(Debug, Clone, Copy)]
pub(super) struct Tail {
    bytes: [u8; MAX_DELIMITER],
    mask: [u8; MAX_DELIMITER],
    len: u8,
}

fn same(a: [u8; 8], b: [u8; 8], mask: [u8; 8]) -> bool {
    (u64::from_ne_bytes(a) ^ u64::from_ne_bytes(b)) & u64::from_ne_bytes(mask) == 0
}

impl Head {
    /// `None` when there are more than 8 bytes.
    pub(super) fn new(head: &[u8]) -> Option<Self> {
        let (mut bytes, mut mask) = ([0; MAX_DELIMITER], [0; MAX_DELIMITER]);
        bytes.get_mut(..head.len())?.copy_from_slice(head);
        mask.get_mut(..head.len())?.fill(0xFF);
        Some(Self { bytes, mask, len: head.len() as u8 })
    }

    pub(super) fn bytes(&self) -> &[u8] {
        self.bytes.get(..self.len()).unwrap_or(&[])
    }

    pub(super) const fn len(&self) -> usize {
        self.len as usize
    }

    /// Whether `data` begins with the head, or is the beginning of it.
    #[inline]
    pub(super) fn agrees(&self, data: &[u8]) -> bool {
        match data.first_chunk() {
            Some(&front) => same(front, self.bytes, self.mask),
            None => self.bytes().iter().zip(data).all(|(a, b)| a == b),
        }
    }

    /// How many bytes at the front of `data` cannot begin a frame.
    #[inline]
    pub(super) fn find(&self, data: &[u8]) -> usize {
        if self.agrees(data) {
            return 0;
        }
        self.find_further(data)
    }

    fn find_further(&self, data: &[u8]) -> usize {
        let [first, ..] = self.bytes;
        let mut at = 1_usize;
        while let Some(rest) = data.get(at..) {
            let Some(ahead) = rest.iter().position(|&byte| byte == first) else { break };
            at = at.saturating_add(ahead);
            if self.agrees(rest.get(ahead..).unwrap_or(&[])) {
                return at;
            }
            at = at.saturating_add(1);
        }
        data.len()
    }
}

impl Tail {
    /// `None` when there are more than 8 bytes.
    pub(super) fn new(tail: &[u8]) -> Option<Self> {
        let (mut bytes, mut mask) = ([0; MAX_DELIMITER], [0; MAX_DELIMITER]);
        let unused = MAX_DELIMITER.checked_sub(tail.len())?;
        bytes.get_mut(unused..)?.copy_from_slice(tail);
        mask.get_mut(unused..)?.fill(0xFF);
        Some(Self { bytes, mask, len: tail.len() as u8 })
    }

    pub(super) fn bytes(&self) -> &[u8] {
        self.bytes.get(MAX_DELIMITER.saturating_sub(self.len())..).unwrap_or(&[])
    }

    pub(super) const fn len(&self) -> usize {
        self.len as usize
    }

    /// Whether `frame` ends with the tail.
    #[inline]
    pub(super) fn ends(&self, frame: &[u8]) -> bool {
        match frame.last_chunk() {
            Some(&back) => same(back, self.bytes, self.mask),
            None => frame.ends_with(self.bytes()),
        }
    }
}
