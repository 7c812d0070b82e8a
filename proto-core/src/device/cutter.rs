//! Splits a byte stream into frames whose ends do not depend on their fields: by a tail, escape bytes, or silence.
//!
//! In: chunks of any size, and notice that the line was silent. Out: frames without escapes, still to be matched with a
//! layout ([`FrameLayout::probe_whole`]), and broken frames. A broken frame lasts until the next end, so its last bytes
//! are never taken for a frame. The work per received byte is constant.
//!
//! [`FrameLayout::probe_whole`]: super::FrameLayout::probe_whole

use super::escape::{DLE, END, ESC, ESC_END, ESC_ESC, ETX, Escape, STX};
use crate::recipe::model::MAX_STREAM_FRAME;

/// How the frames of a stream are separated.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
pub enum Boundary {
    /// By their fields, head and tail: a frame is searched at each byte.
    #[default]
    Fields,
    /// By the tail alone: a frame begins after the previous tail.
    Tail,
    /// By silence before and after a frame.
    Silence,
}

/// The bytes between two ends.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Piece<'a> {
    /// A frame, without escapes.
    Whole(&'a [u8]),
    /// Longer than the longest frame; only its first bytes.
    TooLong(&'a [u8]),
    /// An invalid escape sequence; only the bytes before it.
    BadEscape(&'a [u8]),
    /// The rest of a frame after a discard.
    Cut(&'a [u8]),
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Fault {
    TooLong,
    BadEscape,
    Cut,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Ends {
    Tail,
    Silence,
    Escape(Escape),
}

/// Splits a byte stream into frames.
#[derive(Debug, Clone)]
pub struct Cutter {
    ends: Ends,
    buffer: [u8; MAX_STREAM_FRAME],
    len: u16,
    /// The held bytes have been returned.
    is_done: bool,
    fault: Option<Fault>,
    /// The newest eight bytes since the last end, and how many are valid.
    newest: u64,
    newest_len: u8,
    /// The last byte was an escape byte.
    is_escaped: bool,
    /// DLE STX was received: a frame has begun. `is_reopened`: so has the next one, before this one ended.
    is_open: bool,
    is_reopened: bool,
    /// COBS: bytes left in the group, and whether a zero follows the group.
    group: u8,
    zero_due: bool,
    skipped_bytes: u32,
}

impl Cutter {
    /// A cutter for these ends of frames; `None` if the fields determine them.
    pub const fn new(boundary: Boundary, escape: Option<Escape>) -> Option<Self> {
        let ends = match (boundary, escape) {
            (_, Some(escape)) => Ends::Escape(escape),
            (Boundary::Tail, None) => Ends::Tail,
            (Boundary::Silence, None) => Ends::Silence,
            (Boundary::Fields, None) => return None,
        };
        Some(Self {
            ends,
            buffer: [0; MAX_STREAM_FRAME],
            len: 0,
            is_done: false,
            fault: None,
            newest: 0,
            newest_len: 0,
            is_escaped: false,
            is_open: false,
            is_reopened: false,
            group: 0,
            zero_due: false,
            skipped_bytes: 0,
        })
    }

    /// Whether silence ends a frame.
    pub fn ends_by_silence(&self) -> bool {
        self.ends == Ends::Silence
    }

    /// The bytes up to the next end. Takes bytes from the front of `chunk`; returns `None` once all are taken. `tail`
    /// must always be the same.
    pub fn next_piece(&mut self, chunk: &mut &[u8], tail: &[u8]) -> Option<Piece<'_>> {
        while let Some((&byte, rest)) = chunk.split_first() {
            *chunk = rest;
            if self.is_done {
                let is_open = self.is_reopened;
                self.begin();
                self.is_open = is_open;
            }
            let is_end = match self.ends {
                Ends::Tail => self.ends_with_tail(byte, tail),
                Ends::Silence => {
                    self.push(byte);
                    false
                }
                Ends::Escape(Escape::Dle) => self.dle(byte),
                Ends::Escape(Escape::Slip) => self.slip(byte),
                Ends::Escape(Escape::Cobs) => self.cobs(byte),
            };
            if is_end {
                return Some(self.piece());
            }
        }
        None
    }

    /// Call this when the line was silent. Returns the frame that has ended, if silence ends frames.
    pub fn silence(&mut self) -> Option<Piece<'_>> {
        if self.ends == Ends::Silence && self.has_begun() { Some(self.piece()) } else { None }
    }

    /// Whether bytes of an unfinished frame are held.
    pub fn has_begun(&self) -> bool {
        let is_cut = self.ends == Ends::Silence && self.fault.is_some();
        let in_escapes = self.is_escaped || self.is_open || self.group > 0 || self.zero_due;
        !self.is_done && (self.len > 0 || is_cut || in_escapes) || self.is_done && self.is_reopened
    }

    /// The held bytes of an unfinished frame.
    pub fn held(&self) -> &[u8] {
        if self.is_done { &[] } else { self.buffer.get(..usize::from(self.len)).unwrap_or(&[]) }
    }

    /// Drops an unfinished frame, because the line was silent or bytes are missing, and returns its number of bytes.
    /// The bytes up to the next end are dropped too.
    pub fn discard(&mut self) -> usize {
        let dropped = self.held().len();
        let was_cut = self.has_begun() || !self.is_done && self.fault.is_some();
        let newest = if self.is_done { (0, 0) } else { (self.newest, self.newest_len) };
        self.begin();
        if was_cut && self.ends != Ends::Escape(Escape::Dle) {
            self.fault = Some(Fault::Cut);
            // Kept, because the discard may have split the tail.
            (self.newest, self.newest_len) = newest;
        }
        dropped
    }

    /// Number of bytes outside frames so far, wrapping.
    pub const fn skipped_bytes(&self) -> u32 {
        self.skipped_bytes
    }

    fn begin(&mut self) {
        (self.len, self.is_done, self.fault) = (0, false, None);
        (self.newest, self.newest_len) = (0, 0);
        (self.is_escaped, self.is_open, self.is_reopened) = (false, false, false);
        (self.group, self.zero_due) = (0, false);
    }

    fn piece(&mut self) -> Piece<'_> {
        self.is_done = true;
        let bytes = self.buffer.get(..usize::from(self.len)).unwrap_or(&[]);
        match self.fault {
            None => Piece::Whole(bytes),
            Some(Fault::TooLong) => Piece::TooLong(bytes),
            Some(Fault::BadEscape) => Piece::BadEscape(bytes),
            Some(Fault::Cut) => Piece::Cut(bytes),
        }
    }

    fn push(&mut self, byte: u8) {
        match self.buffer.get_mut(usize::from(self.len)) {
            Some(slot) => {
                *slot = byte;
                self.len = self.len.saturating_add(1);
            }
            None => self.fault = self.fault.or(Some(Fault::TooLong)),
        }
    }

    fn broken(&mut self) {
        self.fault = self.fault.or(Some(Fault::BadEscape));
    }

    fn ends_with_tail(&mut self, byte: u8, tail: &[u8]) -> bool {
        self.push(byte);
        self.newest = self.newest.unbounded_shl(8) | u64::from(byte);
        self.newest_len = self.newest_len.saturating_add(1).min(8);
        let unused = 8_usize.saturating_sub(tail.len()) as u32;
        let mask = u64::MAX.unbounded_shr(unused.saturating_mul(8));
        let expected = tail.iter().fold(0_u64, |all, &byte| all.unbounded_shl(8) | u64::from(byte));
        usize::from(self.newest_len) >= tail.len() && self.newest & mask == expected
    }

    fn slip(&mut self, byte: u8) -> bool {
        let was_escaped = core::mem::take(&mut self.is_escaped);
        match byte {
            END if self.len == 0 && !was_escaped => {
                // This END may begin a frame, or end a frame that was cut before.
                self.begin();
                return false;
            }
            END => {
                if was_escaped {
                    self.broken();
                }
                return true;
            }
            ESC_END if was_escaped => self.push(END),
            ESC_ESC if was_escaped => self.push(ESC),
            _ if was_escaped => {
                self.broken();
                self.push(byte);
            }
            ESC => self.is_escaped = true,
            _ => self.push(byte),
        }
        false
    }

    fn dle(&mut self, byte: u8) -> bool {
        let was_escaped = core::mem::take(&mut self.is_escaped);
        if !self.is_open {
            if was_escaped && byte == STX {
                self.is_open = true;
                return false;
            }
            self.is_escaped = byte == DLE;
            // A DLE is counted once the next byte is known.
            let skipped = u32::from(was_escaped).saturating_add(u32::from(byte != DLE));
            self.skipped_bytes = self.skipped_bytes.wrapping_add(skipped);
            return false;
        }
        match (was_escaped, byte) {
            (false, DLE) => self.is_escaped = true,
            (false, _) | (true, DLE) => self.push(byte),
            (true, ETX) => return true,
            (true, _) => {
                // Another beginning, or an invalid escape: it is unknown what was lost.
                self.broken();
                self.is_reopened = byte == STX;
                return true;
            }
        }
        false
    }

    fn cobs(&mut self, byte: u8) -> bool {
        if byte == 0 {
            if self.len == 0 && self.group == 0 && !self.zero_due {
                self.begin();
                return false;
            }
            if self.group > 0 {
                self.broken();
            }
            return true;
        }
        match self.group.checked_sub(1) {
            Some(left) => {
                self.group = left;
                self.push(byte);
            }
            None => {
                if self.zero_due {
                    self.push(0);
                }
                self.zero_due = byte != u8::MAX;
                self.group = byte.saturating_sub(1);
            }
        }
        false
    }
}

#[cfg(test)]
mod tests;
