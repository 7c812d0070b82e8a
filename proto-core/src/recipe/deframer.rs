//! Finds frames in a stream of bytes (docs/wire/recipes.md section 4, D19), and checks datagrams
//! (section 5).
//!
//! In: chunks of any size. Out: the payload of each frame, and counts of everything else. The
//! caller knows when the line was silent for too long, and calls [`Deframer::discard`].
//!
//! Work is linear in the bytes received, whatever they are: each byte costs at most a few
//! comparisons with the up to eight bytes of head and tail and a few copies, which a test counts.

use super::error::DatagramError;
use super::model::MAX_STREAM_FRAME;
use super::stream::StreamLayout;
use crate::wire::runs;

/// Counters of a [`Deframer`].
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct DeframerStats {
    /// Frames found.
    pub frames: u64,
    /// Bytes dropped because no frame begins there.
    pub skipped_bytes: u64,
    /// Times that the bytes in the tail's place were not the tail.
    pub tail_mismatches: u64,
    /// Bytes of partial frames that [`Deframer::discard`] dropped.
    pub discarded_bytes: u64,
}

/// Cuts a byte stream into frames.
///
/// It holds at most one byte less than a frame, and only bytes that may still become a frame.
#[derive(Debug, Clone)]
pub struct Deframer {
    /// A ring, so that dropping a byte at the front moves nothing; it starts at 0 whenever it is
    /// empty, so that it wraps only after a broken frame.
    ring: [u8; RING],
    start: u16,
    len: u16,
    /// Up to this many bytes are held whatever they are, because the head was seen; 0 if each has to be looked at. Only
    /// [`Self::hold`] notes it: what comes in long chunks has no use for it.
    hold_until: u16,
    stats: DeframerStats,
}

const RING: usize = MAX_STREAM_FRAME;
const WRAP: usize = RING - 1;
const _: () = assert!(RING.is_power_of_two());

/// How completing a partial frame ended.
enum Held {
    /// A whole frame is in the ring from here on, and nothing is held any more.
    Frame { at: usize },
    /// The chunk is used up.
    Partial,
    /// No frame began in the held bytes.
    Nothing,
}

impl Default for Deframer {
    fn default() -> Self {
        Self::new()
    }
}

impl Deframer {
    /// An empty deframer.
    pub const fn new() -> Self {
        let stats = DeframerStats { frames: 0, skipped_bytes: 0, tail_mismatches: 0, discarded_bytes: 0 };
        Self { ring: [0; RING], start: 0, len: 0, hold_until: 0, stats }
    }

    /// The payload of the next frame. Takes bytes from the front of `chunk`. Call it again with the
    /// rest until it returns `None`, which means that the chunk is used up.
    ///
    /// All calls between two [`Self::discard`]s must be given the same layout.
    #[inline]
    pub fn next_frame<'s, 'c: 's>(
        &'s mut self,
        layout: &StreamLayout,
        chunk: &mut &'c [u8],
    ) -> Option<&'s [u8]> {
        if chunk.is_empty() {
            return None;
        }
        if self.len != 0 {
            match self.complete(layout, chunk) {
                Held::Frame { at } => return layout.payload_of(self.ring.get(at..)?),
                Held::Partial => return None,
                Held::Nothing => {}
            }
        }
        self.search(layout, chunk)
    }

    /// Holds a byte that can only continue the frame whose head was seen, as most bytes of a slow line do. `false`
    /// if it may begin, end or break a frame; then it was not taken.
    #[inline(always)]
    pub(crate) fn hold_byte(&mut self, byte: u8) -> bool {
        if self.len >= self.hold_until {
            return false;
        }
        count_visits(1);
        if let Some(place) = self.ring.get_mut(usize::from(self.len)) {
            *place = byte;
        }
        self.len = self.len.wrapping_add(1);
        true
    }

    /// Holds a chunk that neither completes a frame nor shows that none has begun. `false` if [`Self::next_frame`] has
    /// to look at it; then nothing was taken.
    #[inline]
    pub(crate) fn hold(&mut self, layout: &StreamLayout, chunk: &[u8]) -> bool {
        let held = self.pending();
        let end = held.saturating_add(chunk.len());
        if end > usize::from(self.hold_until) {
            let missing = layout.head().get(held..).unwrap_or(&[]);
            let begins = || missing.iter().zip(chunk).all(|(expected, byte)| expected == byte);
            if self.start != 0 || end >= layout.frame_len() || !begins() {
                return false;
            }
            self.hold_until = hold_until(layout, end);
        }
        self.put(held, chunk);
        self.len = end as u16;
        !chunk.is_empty()
    }

    /// The bytes of a possible frame that are held, in two pieces.
    pub fn held(&self) -> (&[u8], &[u8]) {
        let (start, len) = (usize::from(self.start), self.pending());
        let straight = len.min(RING.saturating_sub(start));
        let first = self.ring.get(start..start.saturating_add(straight)).unwrap_or(&[]);
        (first, self.ring.get(..len.saturating_sub(straight)).unwrap_or(&[]))
    }

    /// Number of held bytes, which may become a frame.
    pub const fn pending(&self) -> usize {
        self.len as usize
    }

    /// Drops a partial frame, because the line was silent or the recipe changed, and returns its
    /// number of bytes.
    pub fn discard(&mut self) -> usize {
        let dropped = self.pending();
        self.stats.discarded_bytes = self.stats.discarded_bytes.wrapping_add(dropped as u64);
        self.start = 0;
        self.len = 0;
        self.hold_until = 0;
        dropped
    }

    /// Counters since the deframer was made.
    pub const fn stats(&self) -> DeframerStats {
        self.stats
    }

    /// Looks for a frame in the chunk itself, with nothing held. Bytes that may become one are
    /// held.
    #[inline]
    fn search<'c>(&mut self, layout: &StreamLayout, chunk: &mut &'c [u8]) -> Option<&'c [u8]> {
        let skip = layout.head_word().find(chunk);
        count_visits(layout.head_word().len().saturating_mul(skip.saturating_add(1).min(chunk.len())));
        if skip > 0 {
            self.skip(skip);
            *chunk = chunk.get(skip..).unwrap_or(&[]);
        }
        let Some((frame, after)) = chunk.split_at_checked(layout.frame_len()) else {
            self.put(0, chunk);
            self.len = chunk.len() as u16;
            *chunk = &[];
            return None;
        };
        count_visits(layout.tail_word().len());
        if !layout.tail_word().ends(frame) {
            // A copy, so that the caller's chunk can stay in registers on the way above.
            let mut rest = *chunk;
            let found = self.search_behind(layout, &mut rest);
            *chunk = rest;
            return found;
        }
        self.stats.frames = self.stats.frames.wrapping_add(1);
        *chunk = after;
        layout.payload_of(frame)
    }

    /// The same behind a head whose tail is wrong.
    #[inline(never)]
    fn search_behind<'c>(&mut self, layout: &StreamLayout, chunk: &mut &'c [u8]) -> Option<&'c [u8]> {
        loop {
            self.stats.tail_mismatches = self.stats.tail_mismatches.wrapping_add(1);
            self.skip(1);
            let rest = chunk.get(1..).unwrap_or(&[]);
            let skip = layout.head_word().find(rest);
            count_visits(layout.head_word().len().saturating_mul(skip.saturating_add(1).min(rest.len())));
            self.skip(skip);
            *chunk = rest.get(skip..).unwrap_or(&[]);
            match chunk.get(..layout.frame_len()) {
                Some(frame) if !layout.tail_word().ends(frame) => count_visits(layout.tail_word().len()),
                _ => return self.search(layout, chunk),
            }
        }
    }

    /// Takes what the held bytes need to become a frame.
    #[inline]
    fn complete(&mut self, layout: &StreamLayout, chunk: &mut &[u8]) -> Held {
        let held = self.pending();
        // The ring is not wrapped and the head is known to be right: all that undisturbed traffic
        // needs.
        if self.start == 0
            && held >= layout.head_word().len()
            && let Some(missing) = layout.frame_len().checked_sub(held)
        {
            let Some((more, after)) = chunk.split_at_checked(missing) else {
                self.put(held, chunk);
                self.len = self.len.wrapping_add(chunk.len() as u16);
                *chunk = &[];
                return Held::Partial;
            };
            self.hold_until = 0;
            self.put(held, more);
            count_visits(layout.tail_word().len());
            if self.ring.get(..layout.frame_len()).is_some_and(|frame| layout.tail_word().ends(frame)) {
                self.stats.frames = self.stats.frames.wrapping_add(1);
                self.len = 0;
                *chunk = after;
                return Held::Frame { at: 0 };
            }
            // Nothing was taken yet: the bytes after the held ones do not count.
        }
        let mut rest = *chunk;
        let held = self.complete_carefully(layout, &mut rest);
        *chunk = rest;
        held
    }

    /// Same, whatever is held and whatever comes. Nothing of the chunk is taken before it is known
    /// what it is.
    #[inline(never)]
    fn complete_carefully(&mut self, layout: &StreamLayout, chunk: &mut &[u8]) -> Held {
        let tail_at = layout.frame_len().saturating_sub(layout.tail().len());
        // No frame is held, unless the layout was changed without a discard.
        if self.pending() >= layout.frame_len() {
            self.discard();
        }
        while self.len != 0 {
            let missing = layout.frame_len().saturating_sub(self.pending());
            if self.agrees(chunk, 0, layout.head()) {
                let Some((more, after)) = chunk.split_at_checked(missing) else {
                    self.append(chunk);
                    *chunk = &[];
                    return Held::Partial;
                };
                if self.agrees(chunk, tail_at, layout.tail()) {
                    self.append(more);
                    *chunk = after;
                    return Held::Frame { at: self.settle(layout) };
                }
                self.stats.tail_mismatches = self.stats.tail_mismatches.wrapping_add(1);
            }
            self.skip(1);
            self.len = self.len.wrapping_sub(1);
            self.start = (usize::from(self.start).wrapping_add(1) & WRAP) as u16;
        }
        self.start = 0;
        Held::Nothing
    }

    /// Whether the held bytes followed by the chunk match `expected` from `at` on, as far as they
    /// go.
    fn agrees(&self, chunk: &[u8], at: usize, expected: &[u8]) -> bool {
        count_visits(expected.len());
        let held = self.pending();
        expected.iter().zip(at..).all(|(byte, at)| {
            let seen = match at.checked_sub(held) {
                Some(at) => chunk.get(at),
                None => self.ring.get(usize::from(self.start).wrapping_add(at) & WRAP),
            };
            seen.is_none_or(|seen| seen == byte)
        })
    }

    /// The held frame, in one piece; nothing is held afterwards.
    fn settle(&mut self, layout: &StreamLayout) -> usize {
        self.stats.frames = self.stats.frames.wrapping_add(1);
        let start = usize::from(self.start) & WRAP;
        self.start = 0;
        self.len = 0;
        if start.saturating_add(layout.frame_len()) <= RING {
            return start;
        }
        count_visits(RING);
        rotate(&mut self.ring, start);
        0
    }

    /// Holds more bytes. There is always room, since less than a frame is held.
    fn append(&mut self, bytes: &[u8]) {
        count_visits(bytes.len());
        let end = usize::from(self.start).wrapping_add(self.pending());
        self.len = self.len.wrapping_add(bytes.len() as u16);
        let straight = RING.saturating_sub(end).min(bytes.len());
        let (first, second) = bytes.split_at_checked(straight).unwrap_or((bytes, &[]));
        let around = end.saturating_sub(RING);
        if let Some(target) = self.ring.get_mut(end..end.saturating_add(first.len())) {
            target.copy_from_slice(first);
        }
        if let Some(target) = self.ring.get_mut(around..around.saturating_add(second.len())) {
            target.copy_from_slice(second);
        }
    }

    /// Writes to the ring without counting it as held.
    #[inline]
    fn put(&mut self, at: usize, bytes: &[u8]) {
        count_visits(bytes.len());
        match self.ring.get_mut(at..at.saturating_add(bytes.len())) {
            Some(target) if bytes.len() <= runs::MAX_RUN => runs::copy(target, bytes),
            Some(target) => runs::copy_long(target, bytes),
            None => {}
        }
    }

    fn skip(&mut self, bytes: usize) {
        self.stats.skipped_bytes = self.stats.skipped_bytes.wrapping_add(bytes as u64);
    }
}

/// How many bytes of a frame are held without being looked at, of which so many are there: all but the last, when the
/// head is complete.
#[inline]
fn hold_until(layout: &StreamLayout, held: usize) -> u16 {
    if held < layout.head_word().len() { 0 } else { (layout.frame_len() as u16).saturating_sub(1) }
}

/// Rotates the ring until the byte at `start` is at its front, by three reversals: unlike
/// `rotate_left`, they need no length check.
#[cold]
#[inline(never)]
fn rotate(ring: &mut [u8; RING], start: usize) {
    if let Some((before, from)) = ring.split_at_mut_checked(start) {
        before.reverse();
        from.reverse();
    }
    ring.reverse();
}

/// The payload of a datagram that is exactly one frame.
///
/// # Errors
/// [`DatagramError`] says whether length, head or tail is wrong.
pub fn datagram<'d>(layout: &StreamLayout, bytes: &'d [u8]) -> Result<&'d [u8], DatagramError> {
    let length = DatagramError::Length { expected: layout.frame_len(), got: bytes.len() };
    if bytes.len() != layout.frame_len() {
        return Err(length);
    }
    if !layout.head_word().agrees(bytes) {
        return Err(DatagramError::Head);
    }
    if !layout.tail_word().ends(bytes) {
        return Err(DatagramError::Tail);
    }
    layout.payload_of(bytes).ok_or(length)
}

#[cfg(not(test))]
#[inline(always)]
fn count_visits(_bytes: usize) {}

#[cfg(test)]
use tests::count_visits;

#[cfg(test)]
mod tests;
