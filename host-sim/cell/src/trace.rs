//! What happened in the cell, as a hash and, if requested, in full.

use proto_core::time::Instant;

/// The kind of an entry.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
#[repr(u8)]
pub enum What {
    /// The gateway opens a link.
    LinkOpen,
    /// The gateway closes a link.
    LinkClose,
    /// The gateway was told that a link is up.
    LinkUp,
    /// The gateway was told that a link is down.
    LinkDown,
    /// The gateway sent on a link.
    LinkSent,
    /// The gateway received on a link.
    LinkReceived,
    /// The controller accepted a connection.
    ControllerOpened,
    /// The controller was told that a connection is gone.
    ControllerClosed,
    /// Bytes reached the controller.
    ControllerReceived,
    /// The gateway sent on a field port.
    PortSent,
    /// The gateway received on a field port.
    PortReceived,
    /// The controller sent on a recipe port.
    ControllerPortSent,
    /// The controller received on a recipe port.
    ControllerPortReceived,
    /// A fault began or ended.
    Fault,
    /// A fault in words; not part of the digest.
    Remark,
}

/// One entry.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Entry {
    /// When it happened.
    pub at: Instant,
    /// Its kind.
    pub what: What,
    /// The link, port or connection.
    pub subject: u64,
    /// The bytes; a CAN frame's id (4 bytes, big-endian) and data; a remark's words.
    pub bytes: Vec<u8>,
}

impl Entry {
    /// The subject of a fault of the controller.
    pub const CONTROLLER: u64 = u64::MAX;
    /// The subject of a fault of the gateway.
    pub const GATEWAY: u64 = u64::MAX - 1;
}

/// The record of a run.
#[derive(Debug, Clone)]
pub struct Trace {
    digest: u64,
    count: u64,
    limit: usize,
    entries: Vec<Entry>,
}

impl Trace {
    pub(super) const fn new() -> Self {
        Self { digest: SEED, count: 0, limit: 0, entries: Vec::new() }
    }

    /// Keeps the next `limit` entries in full.
    pub fn keep(&mut self, limit: usize) {
        self.entries.clear();
        self.limit = limit;
    }

    /// A hash of all entries: equal for two runs in which the same happened at the same times.
    pub fn digest(&self) -> u64 {
        self.digest
    }

    /// Number of entries.
    pub fn count(&self) -> u64 {
        self.count
    }

    /// The entries kept; see [`Self::keep`].
    pub fn entries(&self) -> &[Entry] {
        &self.entries
    }

    pub(super) fn add(&mut self, at: Instant, what: What, subject: u64, bytes: &[u8]) {
        self.count += 1;
        self.mix(at.as_micros());
        self.mix(subject << 32 | bytes.len() as u64 ^ (what as u64) << 24);
        let (words, rest) = bytes.as_chunks();
        for word in words {
            self.mix(u64::from_le_bytes(*word));
        }
        self.mix(rest.iter().rev().fold(0, |word, &byte| word << 8 | u64::from(byte)));
        if self.entries.len() < self.limit {
            self.entries.push(Entry { at, what, subject, bytes: bytes.to_vec() });
        }
    }

    /// A note, which is not part of the hash.
    pub(super) fn remark(&mut self, at: Instant, words: std::fmt::Arguments<'_>) {
        if self.entries.len() < self.limit {
            let bytes = words.to_string().into_bytes();
            self.entries.push(Entry { at, what: What::Remark, subject: 0, bytes });
        }
    }

    /// Adds whole words in little-endian order: the digest is the same on every machine.
    fn mix(&mut self, word: u64) {
        self.digest = (self.digest.rotate_left(23) ^ word).wrapping_mul(ODD);
    }
}

const SEED: u64 = 0xCBF2_9CE4_8422_2325;
/// 2^64 divided by the golden ratio.
const ODD: u64 = 0x9E37_79B9_7F4A_7C15;
