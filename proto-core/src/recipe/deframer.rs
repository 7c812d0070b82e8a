//! Finds frames in a stream of bytes (docs/wire/recipes.md section 4, D19), and checks datagrams
//! (section 5).
//!
//! In: chunks of any size. Out: the payload of each frame, and counts of everything else. The
//! caller knows when the line was silent for too long, and calls [`Deframer::discard`].
//!
//! Work is linear in the bytes received, whatever they are: each byte costs at most a few
//! comparisons with the up to eight bytes of head and tail and a few copies, which a test counts.

use super::delimiter::Head;
use super::error::DatagramError;
use super::model::{MAX_DELIMITER, MAX_STREAM_FRAME};
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
    /// Up to this many bytes, all but the last of a frame, are held whatever they are: the head was seen, and the ring
    /// is not wrapped. 0 if each byte has to be looked at, or none is held.
    hold_until: u16,
    stats: DeframerStats,
}

const RING: usize = MAX_STREAM_FRAME;
const WRAP: usize = RING - 1;
const _: () = assert!(RING.is_power_of_two());

/// How an attempt to complete a partial frame ended, and how many bytes of the chunk it took: fewer than two frames,
/// since what was taken is given back when nothing before it is held any more.
enum Held {
    /// A whole frame is in the ring from here on, and nothing is held any more.
    Frame { at: u16, taken: u16 },
    /// The chunk is used up.
    Partial,
    /// Something else is held now, or nothing.
    Again { taken: u16 },
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
        if self.len != 0 {
            let (held, frame_len) = (self.pending(), layout.frame_len());
            // The ring is not wrapped and the head is known to be right: all that undisturbed traffic needs.
            if usize::from(self.hold_until).wrapping_add(1) == frame_len
                && let Some(missing) = self.ring.get_mut(held..frame_len)
            {
                let Some((more, after)) = chunk.split_at_checked(missing.len()) else {
                    self.put(held, chunk);
                    self.len = self.len.wrapping_add(chunk.len() as u16);
                    *chunk = &[];
                    return None;
                };
                count_visits(missing.len().saturating_add(layout.tail_word().len()));
                copy(missing, more);
                if self.ring.get(..frame_len).is_some_and(|frame| layout.tail_word().ends(frame)) {
                    self.stats.frames = self.stats.frames.wrapping_add(1);
                    self.len = 0;
                    self.hold_until = 0;
                    *chunk = after;
                    return layout.payload_of(self.ring.get(..frame_len)?);
                }
                // Nothing was taken yet: the bytes after the held ones do not count.
            }
            match self.complete(layout, chunk) {
                Held::Frame { at, taken } => {
                    *chunk = chunk.get(usize::from(taken)..).unwrap_or(&[]);
                    return layout.payload_of(self.ring.get(usize::from(at)..)?);
                }
                Held::Partial => {
                    *chunk = &[];
                    return None;
                }
                Held::Again { taken } => {
                    // A copy, so that the caller's chunk can stay in registers on the ways above.
                    let mut rest = chunk.get(usize::from(taken)..).unwrap_or(&[]);
                    let found = self.next_behind(layout, &mut rest);
                    *chunk = rest;
                    return found;
                }
            }
        }
        self.search(layout, chunk)
    }

    /// The same, after what was held first.
    #[inline(never)]
    fn next_behind<'s, 'c: 's>(
        &'s mut self,
        layout: &StreamLayout,
        chunk: &mut &'c [u8],
    ) -> Option<&'s [u8]> {
        while self.len != 0 {
            match self.complete(layout, chunk) {
                Held::Frame { at, taken } => {
                    *chunk = chunk.get(usize::from(taken)..).unwrap_or(&[]);
                    return layout.payload_of(self.ring.get(usize::from(at)..)?);
                }
                Held::Partial => {
                    *chunk = &[];
                    return None;
                }
                Held::Again { taken } => *chunk = chunk.get(usize::from(taken)..).unwrap_or(&[]),
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
            self.hold_until = if end < layout.head_word().len() { 0 } else { hold_until(layout) };
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
    #[inline(always)]
    fn search<'c>(&mut self, layout: &StreamLayout, chunk: &mut &'c [u8]) -> Option<&'c [u8]> {
        let skip = layout.head_word().find(chunk)?;
        count_visits(layout.head_word().len().saturating_mul(skip.saturating_add(1).min(chunk.len())));
        if skip > 0 {
            self.skip(skip);
            *chunk = chunk.get(skip..).unwrap_or(&[]);
        }
        let Some((frame, after)) = chunk.split_at_checked(layout.frame_len()) else {
            self.put(0, chunk);
            self.len = chunk.len() as u16;
            // Without a head, every byte is one; and there is one.
            let begun = chunk.len() >= layout.head_word().len();
            self.hold_until = if begun { hold_until(layout) } else { 0 };
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
            let skip = layout.head_word().find(rest).unwrap_or(0);
            count_visits(layout.head_word().len().saturating_mul(skip.saturating_add(1).min(rest.len())));
            self.skip(skip);
            *chunk = rest.get(skip..).unwrap_or(&[]);
            match chunk.get(..layout.frame_len()) {
                Some(frame) if !layout.tail_word().ends(frame) => count_visits(layout.tail_word().len()),
                _ => return self.search(layout, chunk),
            }
        }
    }

    /// Takes what fewer bytes than a head need to become one.
    #[inline(never)]
    fn complete_head(&mut self, head: &Head, hold_until: u16, chunk: &[u8]) -> Held {
        let mut len = self.pending();
        let mut bytes = u64::from_le_bytes(self.word(usize::from(self.start)));
        let mut taken = 0_u16;
        let mut dropped = 0_usize;
        for &byte in chunk {
            let place = 8_u32.wrapping_mul(len as u32);
            bytes = bytes & !0xFF_u64.wrapping_shl(place) | u64::from(byte).wrapping_shl(place);
            len = len.wrapping_add(1);
            taken = taken.wrapping_add(1);
            while len > usize::from(taken) && !head.may_be(bytes, len) {
                count_visits(head.len());
                bytes = bytes.wrapping_shr(8);
                len = len.wrapping_sub(1);
                dropped = dropped.wrapping_add(1);
            }
            if len == usize::from(taken) || len >= head.len() {
                break;
            }
        }
        self.skip(dropped);
        self.start = 0;
        if len == usize::from(taken) {
            // What is left is of the chunk, and is looked for there.
            self.len = 0;
            return Held::Again { taken: 0 };
        }
        count_visits(MAX_DELIMITER);
        if let Some(front) = self.ring.first_chunk_mut() {
            *front = bytes.to_le_bytes();
        }
        self.len = len as u16;
        if len >= head.len() {
            self.hold_until = hold_until;
        }
        if usize::from(taken) == chunk.len() { Held::Partial } else { Held::Again { taken } }
    }

    /// Takes what the held bytes need to become a frame, whatever they are and whatever comes.
    #[inline(always)]
    fn complete(&mut self, layout: &StreamLayout, chunk: &[u8]) -> Held {
        match self.pending() < layout.head_word().len() {
            true => self.complete_head(layout.head_word(), hold_until(layout), chunk),
            false => self.complete_frame(layout, chunk),
        }
    }

    /// Takes what held bytes with a whole head at their front need to become a frame.
    #[inline(never)]
    fn complete_frame(&mut self, layout: &StreamLayout, chunk: &[u8]) -> Held {
        let (start, held) = (usize::from(self.start), self.pending());
        let len = held.wrapping_add(chunk.len());
        if len > layout.frame_len() {
            return self.complete_behind(layout, chunk);
        }
        self.put_around(start.wrapping_add(held) & WRAP, chunk);
        if len < layout.frame_len() {
            self.len = len as u16;
            return Held::Partial;
        }
        let (behind, left) = (start.wrapping_add(1) & WRAP, len.wrapping_sub(1));
        // Every byte of the worst line there is comes along here: one frame is over and the next one is held.
        if left > chunk.len()
            && left >= layout.head_word().len()
            && !layout.tail_word().is(&self.word(tail_word_at(start, len)))
            && layout.head_word().is(&self.word(behind))
        {
            count_visits(2 * MAX_DELIMITER);
            self.stats.tail_mismatches = self.stats.tail_mismatches.wrapping_add(1);
            self.skip(1);
            self.start = behind as u16;
            self.len = left as u16;
            self.hold_until = 0;
            return Held::Partial;
        }
        self.complete_behind(layout, chunk)
    }

    /// The same, whatever is held and whatever comes: also with other frames behind the first that is held.
    #[inline(never)]
    fn complete_behind(&mut self, layout: &StreamLayout, chunk: &[u8]) -> Held {
        let (head, tail, frame_len) = (layout.head_word(), layout.tail_word(), layout.frame_len());
        self.hold_until = 0;
        let held = self.pending();
        let (mut start, mut len) = (usize::from(self.start), held);
        if len >= frame_len {
            // The layout was changed without a discard.
            self.discard();
            return Held::Again { taken: 0 };
        }
        let mut rest = chunk;
        loop {
            let missing = frame_len.wrapping_sub(len);
            let (more, after) = rest.split_at_checked(missing).unwrap_or((rest, &[]));
            self.put_around(start.wrapping_add(len) & WRAP, more);
            if more.len() < missing {
                len = len.wrapping_add(more.len());
                rest = after;
                break;
            }
            (len, rest) = (frame_len, after);
            let taken = chunk.len().wrapping_sub(rest.len());
            count_visits(tail.len());
            if tail.is(&self.word(tail_word_at(start, len))) {
                self.skip(held.wrapping_add(taken).wrapping_sub(len));
                return Held::Frame { at: self.settle(layout, start) as u16, taken: taken as u16 };
            }
            self.stats.tail_mismatches = self.stats.tail_mismatches.wrapping_add(1);
            loop {
                count_visits(head.len());
                start = start.wrapping_add(1) & WRAP;
                len = len.wrapping_sub(1);
                if len <= taken {
                    // What is left is of the chunk, and is looked for there.
                    self.skip(held.wrapping_add(taken).wrapping_sub(len));
                    self.start = 0;
                    self.len = 0;
                    return Held::Again { taken: taken.wrapping_sub(len) as u16 };
                }
                let front = self.word(start);
                if head.is(&front) || len < head.len() && head.may_be(u64::from_le_bytes(front), len) {
                    break;
                }
            }
            if len < head.len() || rest.is_empty() {
                break;
            }
        }
        let taken = chunk.len().wrapping_sub(rest.len());
        let dropped = held.wrapping_add(taken).wrapping_sub(len);
        self.skip(dropped);
        self.len = len as u16;
        self.start = start as u16;
        if !rest.is_empty() {
            return Held::Again { taken: taken as u16 };
        }
        if self.move_to_front(dropped) && len >= head.len() {
            self.hold_until = hold_until(layout);
        }
        Held::Partial
    }

    /// Moves the held bytes to the front of the ring, where the next ones need less care, if they are no more than
    /// were dropped: so each byte is moved for one that was dropped. Returns whether they are there.
    #[inline]
    fn move_to_front(&mut self, dropped: usize) -> bool {
        let (start, len) = (usize::from(self.start), self.pending());
        if start == 0 || len > dropped || len > start {
            return start == 0;
        }
        let Some((front, from)) = self.ring.split_at_mut_checked(start) else { return false };
        let (Some(front), Some(from)) = (front.get_mut(..len), from.get(..len)) else { return false };
        count_visits(len);
        copy(front, from);
        self.start = 0;
        true
    }

    /// Eight bytes of the ring.
    #[inline(always)]
    fn word(&self, at: usize) -> [u8; MAX_DELIMITER] {
        match self.ring.get(at..).and_then(|from| from.first_chunk()) {
            Some(word) => *word,
            None => self.word_around(at),
        }
    }

    #[cold]
    #[inline(never)]
    fn word_around(&self, at: usize) -> [u8; MAX_DELIMITER] {
        core::array::from_fn(|nth| self.ring.get(at.wrapping_add(nth) & WRAP).copied().unwrap_or_default())
    }

    /// The frame that begins at `start`, in one piece; nothing is held afterwards.
    fn settle(&mut self, layout: &StreamLayout, start: usize) -> usize {
        self.stats.frames = self.stats.frames.wrapping_add(1);
        self.start = 0;
        self.len = 0;
        self.hold_until = 0;
        if start.saturating_add(layout.frame_len()) <= RING {
            return start;
        }
        count_visits(RING);
        rotate(&mut self.ring, start);
        0
    }

    /// Writes to the ring, and from its end on to its front, without counting it as held.
    #[inline]
    fn put_around(&mut self, at: usize, bytes: &[u8]) {
        if let [byte] = bytes {
            count_visits(1);
            if let Some(place) = self.ring.get_mut(at) {
                *place = *byte;
            }
            return;
        }
        match bytes.split_at_checked(RING.saturating_sub(at)) {
            None => self.put(at, bytes),
            Some((first, second)) => {
                self.put(at, first);
                self.put(0, second);
            }
        }
    }

    /// Writes to the ring without counting it as held.
    #[inline]
    fn put(&mut self, at: usize, bytes: &[u8]) {
        count_visits(bytes.len());
        if let Some(target) = self.ring.get_mut(at..at.saturating_add(bytes.len())) {
            copy(target, bytes);
        }
    }

    fn skip(&mut self, bytes: usize) {
        self.stats.skipped_bytes = self.stats.skipped_bytes.wrapping_add(bytes as u64);
    }
}

/// How many bytes of a frame are held without being looked at once its head is complete: all but the last.
#[inline]
fn hold_until(layout: &StreamLayout) -> u16 {
    // No frame is empty.
    (layout.frame_len() as u16).wrapping_sub(1)
}

/// Where the eight bytes begin with which a frame ends; in front of a frame of less stands anything.
#[inline]
fn tail_word_at(start: usize, frame_len: usize) -> usize {
    start.wrapping_add(frame_len).wrapping_sub(MAX_DELIMITER) & WRAP
}

/// Copies to a piece of the same length.
#[inline]
fn copy(to: &mut [u8], from: &[u8]) {
    // In this order, so that a short piece is not asked first whether it is a long one.
    match from.len() {
        0..16 => runs::copy(to, from),
        16..=runs::MAX_RUN => runs::copy(to, from),
        _ => runs::copy_long(to, from),
    }
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
