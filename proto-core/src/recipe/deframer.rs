//! Finds frames in a byte stream (docs/wire/recipes.md section 4, D19), and checks datagrams (section 5).
//!
//! In: chunks of any size. Out: the payload of each frame, and counts of everything else. The caller knows when the
//! line was silent for too long and calls [`Deframer::discard`].
//!
//! Work is linear in the bytes received, whatever they are: a byte is compared with the at most eight bytes of head and
//! of tail and copied at most twice. A test counts this.

use core::ops::Range;

use super::delimiter::FrameHead;
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
    /// Number of possible frames without the tail at their end.
    pub tail_mismatches: u64,
    /// Bytes of partial frames that [`Deframer::discard`] dropped.
    pub discarded_bytes: u64,
}

/// Splits a byte stream into frames.
///
/// Holds at most one byte less than a frame, and only bytes that may still become a frame.
#[derive(Debug, Clone)]
pub struct Deframer {
    /// Twice the longest frame, so that held bytes are moved to the front only after as many bytes were dropped.
    buffer: [u8; 2 * MAX_STREAM_FRAME],
    start: u16,
    len: u16,
    stats: DeframerStats,
}

impl DeframerStats {
    /// Whether `frame`, which has the right length and head, also has the tail; counts the result.
    fn judge(&mut self, layout: &StreamLayout, frame: &[u8]) -> bool {
        count_visits(layout.tail.len());
        let is_frame = layout.tail.ends(frame);
        let counter = if is_frame { &mut self.frames } else { &mut self.tail_mismatches };
        *counter = counter.wrapping_add(1);
        is_frame
    }
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
        Self { buffer: [0; _], start: 0, len: 0, stats }
    }

    /// The payload of the next frame. Takes bytes from the front of `chunk`. Call it again with the rest until it
    /// returns `None`: then all of `chunk` is taken.
    ///
    /// All calls between two [`Self::discard`]s must use the same layout.
    // Inlined into other crates with its callees: a short frame takes 10 % fewer instructions. docs/performance.md
    // section 1 has the cost of this attribute and the others here.
    #[inline]
    pub fn next_frame<'s, 'c: 's>(
        &'s mut self,
        layout: &StreamLayout,
        chunk: &mut &'c [u8],
    ) -> Option<&'s [u8]> {
        if self.pending() > 0
            && let Some(frame) = self.complete(layout, chunk)
        {
            return layout.payload_of(self.buffer.get(frame)?);
        }
        self.search(layout, chunk)
    }

    /// Takes missing bytes of the held frame from the chunk until the frame is complete, nothing is held any more, or
    /// the chunk is empty. Returns the position of the frame in the buffer.
    #[inline]
    fn complete(&mut self, layout: &StreamLayout, chunk: &mut &[u8]) -> Option<Range<usize>> {
        let frame_len = layout.frame_len();
        while self.pending() > 0 && !chunk.is_empty() {
            let Some(missing @ 1..) = frame_len.checked_sub(self.pending()) else {
                // The layout changed without a discard.
                self.discard();
                break;
            };
            let is_head_known = self.pending() >= layout.head.len();
            if let Some((bytes, rest)) = chunk.split_at_checked(missing) {
                self.push(bytes);
                *chunk = rest;
            } else {
                self.push(core::mem::take(chunk));
            }
            if !is_head_known && !agrees(&layout.head, self.held()) {
                self.drop_front(position_of_head(&layout.head, self.held()));
            }
            if self.pending() == frame_len {
                let frame = usize::from(self.start)..self.end();
                if self.stats.judge(layout, self.buffer.get(frame.clone())?) {
                    (self.start, self.len) = (0, 0);
                    return Some(frame);
                }
                self.drop_front(1);
                self.drop_front(position_of_head(&layout.head, self.held()));
            }
        }
        None
    }

    /// Searches a frame in the chunk itself while nothing is held, and holds a beginning of a frame at its end.
    #[inline]
    fn search<'c>(&mut self, layout: &StreamLayout, chunk: &mut &'c [u8]) -> Option<&'c [u8]> {
        while !chunk.is_empty() {
            if !agrees(&layout.head, chunk) {
                let skipped = position_of_head(&layout.head, chunk);
                self.skip(skipped);
                *chunk = chunk.get(skipped..)?;
            }
            let Some((frame, rest)) = chunk.split_at_checked(layout.frame_len()) else {
                self.push(core::mem::take(chunk));
                return None;
            };
            if self.stats.judge(layout, frame) {
                *chunk = rest;
                return layout.payload_of(frame);
            }
            self.skip(1);
            *chunk = chunk.get(1..)?;
        }
        None
    }

    /// Holds a chunk that neither completes a frame nor rules out that one has begun. Returns `false`, with nothing
    /// taken, if [`Self::next_frame`] has to handle it.
    // A frame byte by byte through the engine takes 4846 instructions if this is out of line, and 4130 inline.
    #[inline(always)]
    pub(crate) fn hold(&mut self, layout: &StreamLayout, chunk: &[u8]) -> bool {
        let held = self.pending();
        let begins = || {
            let missing = layout.head().get(held..).unwrap_or(&[]);
            missing.iter().zip(chunk).all(|(expected, byte)| expected == byte)
        };
        if held.saturating_add(chunk.len()) >= layout.frame_len() || held < layout.head().len() && !begins() {
            return false;
        }
        let place = self.end();
        match (chunk, self.buffer.get_mut(place)) {
            // Many drivers report single bytes.
            ([byte], Some(free)) => {
                count_visits(1);
                *free = *byte;
                self.len = self.len.wrapping_add(1);
            }
            _ => self.push_short(chunk),
        }
        !chunk.is_empty()
    }

    // If inline, its copy slows down single bytes: a frame byte by byte to UDP takes 4984 instead of 4130 instructions.
    #[inline(never)]
    fn push_short(&mut self, bytes: &[u8]) {
        self.push(bytes);
    }

    /// The held bytes of a possible frame.
    pub fn held(&self) -> &[u8] {
        self.buffer.get(usize::from(self.start)..self.end()).unwrap_or(&[])
    }

    /// Number of held bytes of a possible frame.
    pub const fn pending(&self) -> usize {
        self.len as usize
    }

    /// End of the held bytes.
    const fn end(&self) -> usize {
        self.start.wrapping_add(self.len) as usize
    }

    /// Drops a partial frame, because the line was silent or the recipe changed, and returns its number of bytes.
    pub fn discard(&mut self) -> usize {
        let dropped = self.pending();
        self.stats.discarded_bytes = self.stats.discarded_bytes.wrapping_add(dropped as u64);
        (self.start, self.len) = (0, 0);
        dropped
    }

    /// Counters since the deframer was created.
    pub const fn stats(&self) -> DeframerStats {
        self.stats
    }

    fn drop_front(&mut self, bytes: usize) {
        self.skip(bytes);
        self.start = self.start.wrapping_add(bytes as u16);
        self.len = self.len.wrapping_sub(bytes as u16);
    }

    fn skip(&mut self, bytes: usize) {
        self.stats.skipped_bytes = self.stats.skipped_bytes.wrapping_add(bytes as u64);
    }

    /// Holds `bytes`, at most the missing bytes of a frame.
    #[inline]
    fn push(&mut self, bytes: &[u8]) {
        count_visits(bytes.len());
        if self.end().saturating_add(bytes.len()) > self.buffer.len() {
            self.move_to_front();
        }
        let place = self.end();
        let Some(free) = self.buffer.get_mut(place..place.saturating_add(bytes.len())) else { return };
        match bytes.len() {
            ..=runs::MAX_RUN => runs::copy(free, bytes),
            _ => runs::copy_long(free, bytes),
        }
        self.len = self.len.wrapping_add(bytes.len() as u16);
    }

    fn move_to_front(&mut self) {
        let held = self.pending();
        count_visits(held);
        if let Some((front, back)) = self.buffer.split_at_mut_checked(usize::from(self.start))
            && let (Some(front), Some(back)) = (front.get_mut(..held), back.get(..held))
        {
            front.copy_from_slice(back);
        }
        self.start = 0;
    }
}

/// Position of the first bytes that match the head, or its beginning at the end of `bytes`; the length if there are
/// none.
fn position_of_head(head: &FrameHead, bytes: &[u8]) -> usize {
    let mut at = 0;
    while let Some(rest) = bytes.get(at..)
        && !agrees(head, rest)
    {
        at = at.saturating_add(1);
    }
    at
}

/// Whether `bytes` begin with the head, or are the beginning of it.
fn agrees(head: &FrameHead, bytes: &[u8]) -> bool {
    count_visits(head.len());
    head.agrees(bytes)
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
    if !layout.head.agrees(bytes) {
        return Err(DatagramError::Head);
    }
    if !layout.tail.ends(bytes) {
        return Err(DatagramError::Tail);
    }
    layout.payload_of(bytes).ok_or(length)
}

#[cfg(not(test))]
fn count_visits(_bytes: usize) {}

#[cfg(test)]
use tests::count_visits;

#[cfg(test)]
mod tests;
