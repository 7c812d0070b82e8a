//! Finds a device's frames in a stream of bytes.
//!
//! In: chunks of any size, and a probe that classifies bytes ([`FrameLayout::probe`] of one or several layouts). Out:
//! frames, good or with a wrong checksum, and counts of everything else. The caller knows when the line was silent for
//! too long and calls [`Framer::discard`].
//!
//! After a broken frame only one byte is dropped, so a frame inside it is still found. Work is bounded: if probing
//! takes more than [`EFFORT`] steps per received byte, held bytes are dropped without probing.
//!
//! [`FrameLayout::probe`]: super::FrameLayout::probe

use super::layout::Probe;
use crate::recipe::model::MAX_STREAM_FRAME;

/// Probe steps allowed per received byte. This is enough to search frames of 30 bytes at every byte; longer frames
/// should have a head, which most bytes do not match.
const EFFORT: i32 = 64;
/// Unused steps are saved up to this limit: enough for one frame.
const MAX_CREDIT: i32 = EFFORT * MAX_STREAM_FRAME as i32;
/// Twice the longest frame, so that held bytes are moved to the front only once per frame's worth of bytes.
const BUFFER: usize = 2 * MAX_STREAM_FRAME;

/// What was found in the stream.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Found<'a> {
    /// A valid frame.
    Frame(&'a [u8]),
    /// A frame with a right checksum, but with the constants of another device.
    Other(&'a [u8]),
    /// A frame with a wrong checksum that is not inside a frame found before. A framer of replies reports it only where
    /// a frame is expected.
    Wrong(&'a [u8]),
}

/// Counters of a [`Framer`], wrapping.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct FramerStats {
    /// Frames found.
    pub frames: u32,
    /// Frames of other devices.
    pub others: u32,
    /// Frames with a wrong checksum, as reported by [`Found::Wrong`].
    pub wrong: u32,
    /// Bytes dropped while looking for a frame.
    pub skipped_bytes: u32,
    /// Those of `skipped_bytes` that are not part of a frame with a wrong checksum.
    pub noise_bytes: u32,
    /// Bytes of partial frames that [`Framer::discard`] dropped.
    pub discarded_bytes: u32,
}

/// Splits a byte stream into frames of any layouts.
#[derive(Debug, Clone)]
pub struct Framer {
    buffer: [u8; BUFFER],
    start: u16,
    end: u16,
    /// Offset from the start at which a frame is expected to begin; `None` if unknown.
    expected: Option<u16>,
    /// Report a wrong checksum only where a frame is expected.
    is_of_replies: bool,
    /// Remaining probe steps; negative if overdrawn.
    credit: i32,
    stats: FramerStats,
}

impl Default for Framer {
    fn default() -> Self {
        Self::new()
    }
}

impl Framer {
    /// An empty framer of replies. A wrong checksum ends a request, so it is reported only where a frame is expected:
    /// at the beginning, after a [`Self::discard`] and directly after another frame.
    pub const fn of_replies() -> Self {
        Self { is_of_replies: true, ..Self::new() }
    }

    /// An empty framer. A frame is expected at the first byte.
    pub const fn new() -> Self {
        let stats = FramerStats {
            frames: 0,
            others: 0,
            wrong: 0,
            skipped_bytes: 0,
            noise_bytes: 0,
            discarded_bytes: 0,
        };
        Self {
            buffer: [0; BUFFER],
            start: 0,
            end: 0,
            expected: Some(0),
            is_of_replies: false,
            credit: 0,
            stats,
        }
    }

    /// The next frame. Takes bytes from the front of `chunk`. Call it again with the rest until it returns `None`, even
    /// if the rest is empty: more frames may be held after a broken one.
    ///
    /// `probe` must stay the same between two [`Self::discard`]s, and never ask for more than 512 bytes. `effort` is
    /// the approximate number of steps to find that a checksum is wrong.
    pub fn next_frame(
        &mut self,
        chunk: &mut &[u8],
        effort: usize,
        probe: impl Fn(&[u8]) -> Probe,
    ) -> Option<Found<'_>> {
        loop {
            let missing = match self.held() {
                [] => 1,
                held => match probe(held) {
                    Probe::Partial(missing) => missing,
                    Probe::Frame(len) => {
                        self.stats.frames = self.stats.frames.wrapping_add(1);
                        return Some(Found::Frame(self.take(len)));
                    }
                    Probe::Other(len) => {
                        self.stats.others = self.stats.others.wrapping_add(1);
                        return Some(Found::Other(self.take(len)));
                    }
                    Probe::Wrong(len) if self.may_be_wrong() => {
                        let at = usize::from(self.start);
                        self.stats.wrong = self.stats.wrong.wrapping_add(1);
                        self.skip(effort, false);
                        self.expected = Some(len.saturating_sub(1) as u16);
                        return Some(Found::Wrong(self.buffer.get(at..at.saturating_add(len))?));
                    }
                    Probe::No(steps) => {
                        self.skip(steps, true);
                        continue;
                    }
                    Probe::Wrong(_) => {
                        self.skip(effort, true);
                        continue;
                    }
                },
            };
            if chunk.is_empty() {
                return None;
            }
            self.hold(chunk, missing);
        }
    }

    /// Whether a frame with a wrong checksum may begin at the start, because it is not inside another one.
    const fn may_be_wrong(&self) -> bool {
        match self.expected {
            Some(missing) => missing == 0,
            None => !self.is_of_replies,
        }
    }

    /// The held bytes, a possible frame.
    pub fn held(&self) -> &[u8] {
        self.buffer.get(usize::from(self.start)..usize::from(self.end)).unwrap_or(&[])
    }

    /// Drops a partial frame, because the line was silent or the layouts changed, and returns its number of bytes. A
    /// frame is expected next.
    pub fn discard(&mut self) -> usize {
        let dropped = self.held().len();
        self.stats.discarded_bytes = self.stats.discarded_bytes.wrapping_add(dropped as u32);
        (self.start, self.end, self.expected) = (0, 0, Some(0));
        dropped
    }

    /// Counters since the framer was created.
    pub const fn stats(&self) -> FramerStats {
        self.stats
    }

    /// Removes the frame at the start from the held bytes.
    fn take(&mut self, len: usize) -> &[u8] {
        let at = usize::from(self.start);
        self.start = self.start.saturating_add(len as u16).min(self.end);
        self.expected = Some(0);
        self.buffer.get(at..usize::from(self.start)).unwrap_or(&[])
    }

    /// Drops the byte at the start, or all held bytes if no probe steps remain.
    fn skip(&mut self, steps: usize, is_noise: bool) {
        // Inside a frame with a wrong checksum, whose end is expected.
        let is_noise = is_noise && !matches!(self.expected, Some(1..));
        self.credit = self.credit.saturating_sub(i32::try_from(steps).unwrap_or(i32::MAX));
        let skipped = if self.credit < 0 { self.end.saturating_sub(self.start) } else { 1 };
        self.start = self.start.saturating_add(skipped);
        self.expected = self.expected.and_then(|expected| expected.checked_sub(skipped));
        self.stats.skipped_bytes = self.stats.skipped_bytes.wrapping_add(u32::from(skipped));
        if is_noise {
            self.stats.noise_bytes = self.stats.noise_bytes.wrapping_add(u32::from(skipped));
        }
    }

    /// Holds up to `missing` more bytes.
    fn hold(&mut self, chunk: &mut &[u8], missing: usize) {
        if self.start == self.end {
            (self.start, self.end) = (0, 0);
        }
        let more = missing.min(chunk.len()).min(MAX_STREAM_FRAME);
        if usize::from(self.end).saturating_add(more) > BUFFER {
            self.move_to_front();
        }
        let (more, rest) = chunk.split_at_checked(more).unwrap_or((&[], chunk));
        let room = self.buffer.get_mut(usize::from(self.end)..).unwrap_or(&mut []);
        for (slot, &byte) in room.iter_mut().zip(more) {
            *slot = byte;
        }
        self.end = self.end.saturating_add(more.len() as u16).min(BUFFER as u16);
        let paid = (more.len() as i32).saturating_mul(EFFORT);
        self.credit = self.credit.saturating_add(paid).min(MAX_CREDIT);
        *chunk = rest;
    }

    fn move_to_front(&mut self) {
        let start = usize::from(self.start);
        let held = usize::from(self.end).saturating_sub(start);
        for at in 0..held {
            let byte = self.buffer.get(start.saturating_add(at)).copied().unwrap_or(0);
            if let Some(slot) = self.buffer.get_mut(at) {
                *slot = byte;
            }
        }
        (self.start, self.end) = (0, held as u16);
    }
}

#[cfg(test)]
mod tests;
