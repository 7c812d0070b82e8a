//! A record of what happened in the cell: a hash and, if requested, all entries.

use proto_core::time::Instant;

/// The kind of an entry.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
#[repr(u8)]
pub enum What {
    /// The gateway opens a link.
    LinkOpen,
    /// The gateway closes a link.
    LinkClose,
    /// A link was reported to the gateway as up.
    LinkUp,
    /// A link was reported to the gateway as down.
    LinkDown,
    /// The gateway sent on a link.
    LinkSent,
    /// The gateway received on a link.
    LinkReceived,
    /// The controller accepted a connection.
    ControllerOpened,
    /// A lost connection was reported to the controller.
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
    /// A fault as text; not part of the digest.
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
    /// The bytes; for a CAN frame its id (4 bytes, big-endian) and data; for a remark its text.
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

    /// Keeps the next `limit` entries.
    pub fn keep(&mut self, limit: usize) {
        self.entries.clear();
        self.limit = limit;
    }

    /// A hash of all entries. It is equal for two runs in which the same things happened at the same times.
    pub fn digest(&self) -> u64 {
        self.digest
    }

    /// Number of entries.
    pub fn count(&self) -> u64 {
        self.count
    }

    /// The entries kept since [`Self::keep`].
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

    /// Adds a remark, which is not part of the digest.
    pub(super) fn remark(&mut self, at: Instant, words: std::fmt::Arguments<'_>) {
        if self.entries.len() < self.limit {
            let bytes = words.to_string().into_bytes();
            self.entries.push(Entry { at, what: What::Remark, subject: 0, bytes });
        }
    }

    /// Takes whole words, read in little-endian order, so the digest is the same on every machine.
    fn mix(&mut self, word: u64) {
        self.digest = (self.digest.rotate_left(23) ^ word).wrapping_mul(ODD);
    }
}

const SEED: u64 = 0xCBF2_9CE4_8422_2325;
/// 2^64 divided by the golden ratio.
const ODD: u64 = 0x9E37_79B9_7F4A_7C15;
