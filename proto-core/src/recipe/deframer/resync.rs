//! Frames with a wrong byte, or whose head came in pieces: what is held is looked at byte by byte, in a ring
//! that may be wrapped (docs/wire/recipes.md section 4).
//!
//! In: a chunk, and what is held before it. Out: a frame in the ring, or less that is held. Does not know what follows
//! in the chunk once nothing is held any more.

use super::super::delimiter::Head;
use super::super::model::MAX_DELIMITER;
use super::super::stream::StreamLayout;
use super::{Deframer, RING, WRAP, copy, count_visits, hold_until};

/// How an attempt to complete a partial frame ended, and how many bytes of the chunk it took: fewer than two frames,
/// since what was taken is given back when nothing before it is held any more.
pub(super) enum Completed {
    /// A whole frame is in the ring from here on, and nothing is held any more.
    Frame { at: u16, taken: u16 },
    /// The chunk is used up.
    Partial,
    /// Something else is held now, or nothing.
    Again { taken: u16 },
}

impl Deframer {
    /// Takes what fewer bytes than a head need to become one.
    #[inline(never)]
    fn complete_head(&mut self, head: &Head, hold_until: u16, chunk: &[u8]) -> Completed {
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
            return Completed::Again { taken: 0 };
        }
        count_visits(MAX_DELIMITER);
        if let Some(front) = self.ring.first_chunk_mut() {
            *front = bytes.to_le_bytes();
        }
        self.len = len as u16;
        if len >= head.len() {
            self.hold_until = hold_until;
        }
        if usize::from(taken) == chunk.len() { Completed::Partial } else { Completed::Again { taken } }
    }

    /// Takes what the held bytes need to become a frame, whatever they are and whatever comes.
    #[inline(always)]
    pub(super) fn complete(&mut self, layout: &StreamLayout, chunk: &[u8]) -> Completed {
        match self.pending() < layout.head_word().len() {
            true => self.complete_head(layout.head_word(), hold_until(layout), chunk),
            false => self.complete_frame(layout, chunk),
        }
    }

    /// Takes what held bytes with a whole head at their front need to become a frame.
    #[inline(never)]
    fn complete_frame(&mut self, layout: &StreamLayout, chunk: &[u8]) -> Completed {
        let (start, held) = (usize::from(self.start), self.pending());
        let len = held.wrapping_add(chunk.len());
        if len > layout.frame_len() {
            return self.complete_behind(layout, chunk);
        }
        self.put_around(start.wrapping_add(held) & WRAP, chunk);
        if len < layout.frame_len() {
            self.len = len as u16;
            return Completed::Partial;
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
            return Completed::Partial;
        }
        self.complete_behind(layout, chunk)
    }

    /// The same, whatever is held and whatever comes: also with other frames behind the first that is held.
    #[inline(never)]
    fn complete_behind(&mut self, layout: &StreamLayout, chunk: &[u8]) -> Completed {
        let (head, tail, frame_len) = (layout.head_word(), layout.tail_word(), layout.frame_len());
        self.hold_until = 0;
        let held = self.pending();
        let (mut start, mut len) = (usize::from(self.start), held);
        if len >= frame_len {
            // The layout was changed without a discard.
            self.discard();
            return Completed::Again { taken: 0 };
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
                return Completed::Frame { at: self.settle(layout, start) as u16, taken: taken as u16 };
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
                    return Completed::Again { taken: taken.wrapping_sub(len) as u16 };
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
            return Completed::Again { taken: taken as u16 };
        }
        if self.move_to_front(dropped) && len >= head.len() {
            self.hold_until = hold_until(layout);
        }
        Completed::Partial
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
}

/// Where the eight bytes begin with which a frame ends; in front of a frame of less stands anything.
#[inline]
fn tail_word_at(start: usize, frame_len: usize) -> usize {
    start.wrapping_add(frame_len).wrapping_sub(MAX_DELIMITER) & WRAP
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
