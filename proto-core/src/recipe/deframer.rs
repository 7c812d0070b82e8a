//! Finds frames in a stream of bytes (docs/wire/recipes.md section 4, D19), and checks datagrams
//! (section 5).
//!
//! In: chunks of any size. Out: the payload of each frame, and counts of everything else. The
//! caller knows when the line was silent for too long, and calls [`Deframer::discard`].
//!
//! Work is linear in the bytes received, whatever they are: each byte costs at most a few
//! comparisons with the up to eight bytes of head and tail and a few copies, which a test counts.

use self::resync::Completed;
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

/// What became of a frame whose beginning is held.
enum Held {
    /// It is whole: so many bytes at the front of the ring. Nothing is held any more.
    Whole(usize),
    /// The chunk is used up.
    Partial,
    /// Each byte has to be looked at; nothing was taken.
    Resync,
}

/// Whether a chunk had a frame. Where that is is told elsewhere: a caller's branch on this alone can be decided where it
/// is returned, and one on a slice that may be absent is not.
enum Found {
    Frame,
    /// None; the chunk is used up.
    Nothing,
}

impl Found {
    #[inline(always)]
    fn of<'f>(found: Option<&'f [u8]>, frame: &mut &'f [u8]) -> Self {
        match found {
            Some(found) => {
                *frame = found;
                Self::Frame
            }
            None => Self::Nothing,
        }
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
        let mut frame: &[u8] = &[];
        match self.next_whole(layout, chunk, &mut frame) {
            // In one place for all frames, where the compiler sees how long a payload is.
            Found::Frame => layout.payload_of(frame),
            Found::Nothing => None,
        }
    }

    /// The same with head and tail.
    #[inline(always)]
    fn next_whole<'s, 'c: 's>(
        &'s mut self,
        layout: &StreamLayout,
        chunk: &mut &'c [u8],
        frame: &mut &'s [u8],
    ) -> Found {
        if self.len == 0 {
            return self.search(layout, chunk, frame);
        }
        match self.go_on(layout, chunk) {
            Held::Whole(len) => return Found::of(self.ring.get(..len), frame),
            Held::Partial => return Found::Nothing,
            Held::Resync => {}
        }
        match self.complete(layout, chunk) {
            Completed::Frame { at, taken } => {
                *chunk = chunk.get(usize::from(taken)..).unwrap_or(&[]);
                Found::of(self.ring.get(usize::from(at)..), frame)
            }
            Completed::Partial => {
                *chunk = &[];
                Found::Nothing
            }
            Completed::Again { taken } => {
                // A copy, so that the caller's chunk can stay in registers on the ways above.
                let mut rest = chunk.get(usize::from(taken)..).unwrap_or(&[]);
                let found = self.next_behind(layout, &mut rest);
                *chunk = rest;
                Found::of(found, frame)
            }
        }
    }

    /// Takes all that an intact frame needs: the ring is not wrapped, and the head is known to be right.
    #[inline(always)]
    fn go_on(&mut self, layout: &StreamLayout, chunk: &mut &[u8]) -> Held {
        let (held, frame_len) = (self.pending(), layout.frame_len());
        if self.hold_until != hold_until(layout) {
            return Held::Resync;
        }
        let Some(missing) = self.ring.get_mut(held..frame_len) else { return Held::Resync };
        let Some((more, after)) = chunk.split_at_checked(missing.len()) else {
            self.put(held, chunk);
            self.len = self.len.wrapping_add(chunk.len() as u16);
            *chunk = &[];
            return Held::Partial;
        };
        count_visits(missing.len().saturating_add(layout.tail_word().len()));
        copy(missing, more);
        if !self.ring.get(..frame_len).is_some_and(|frame| layout.tail_word().ends(frame)) {
            // The bytes after the held ones do not count.
            return Held::Resync;
        }
        self.stats.frames = self.stats.frames.wrapping_add(1);
        self.len = 0;
        self.hold_until = 0;
        *chunk = after;
        Held::Whole(frame_len)
    }

    /// The next frame with head and tail, after what was held first.
    #[inline(never)]
    fn next_behind<'s, 'c: 's>(
        &'s mut self,
        layout: &StreamLayout,
        chunk: &mut &'c [u8],
    ) -> Option<&'s [u8]> {
        while self.len != 0 {
            match self.go_on(layout, chunk) {
                Held::Whole(len) => return self.ring.get(..len),
                Held::Partial => return None,
                Held::Resync => {}
            }
            match self.complete(layout, chunk) {
                Completed::Frame { at, taken } => {
                    *chunk = chunk.get(usize::from(taken)..).unwrap_or(&[]);
                    return self.ring.get(usize::from(at)..);
                }
                Completed::Partial => {
                    *chunk = &[];
                    return None;
                }
                Completed::Again { taken } => *chunk = chunk.get(usize::from(taken)..).unwrap_or(&[]),
            }
        }
        self.search_on(layout, chunk)
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
    fn search<'s, 'c: 's>(
        &mut self,
        layout: &StreamLayout,
        chunk: &mut &'c [u8],
        frame: &mut &'s [u8],
    ) -> Found {
        count_visits(layout.head_word().len());
        if !layout.head_word().begins(chunk) {
            let Some(begun) = self.seek(layout.head_word(), chunk) else {
                *chunk = &[];
                return Found::Nothing;
            };
            *chunk = begun;
        }
        let Some((found, after)) = chunk.split_at_checked(layout.frame_len()) else {
            self.put_first(chunk);
            self.len = chunk.len() as u16;
            self.hold_until = hold_until(layout);
            *chunk = &[];
            return Found::Nothing;
        };
        count_visits(layout.tail_word().len());
        if layout.tail_word().ends(found) {
            self.stats.frames = self.stats.frames.wrapping_add(1);
            *chunk = after;
            *frame = found;
            return Found::Frame;
        }
        // A copy, so that the caller's chunk can stay in registers on the way above.
        let mut rest = *chunk;
        let found = self.search_behind(layout, &mut rest);
        *chunk = rest;
        Found::of(found, frame)
    }

    #[inline(always)]
    fn search_on<'c>(&mut self, layout: &StreamLayout, chunk: &mut &'c [u8]) -> Option<&'c [u8]> {
        let mut frame: &[u8] = &[];
        match self.search(layout, chunk, &mut frame) {
            Found::Frame => Some(frame),
            Found::Nothing => None,
        }
    }

    /// The same behind a head whose tail is wrong.
    #[inline(never)]
    fn search_behind<'c>(&mut self, layout: &StreamLayout, chunk: &mut &'c [u8]) -> Option<&'c [u8]> {
        loop {
            self.stats.tail_mismatches = self.stats.tail_mismatches.wrapping_add(1);
            self.skip(1);
            *chunk = chunk.get(1..).unwrap_or(&[]);
            count_visits(layout.head_word().len());
            if !layout.head_word().begins(chunk) {
                let Some(begun) = self.seek(layout.head_word(), chunk) else {
                    *chunk = &[];
                    return None;
                };
                *chunk = begun;
            }
            match chunk.get(..layout.frame_len()) {
                Some(frame) if !layout.tail_word().ends(frame) => count_visits(layout.tail_word().len()),
                _ => return self.search_on(layout, chunk),
            }
        }
    }

    /// Skips to the first head in a chunk that does not begin with one, as far as [`Head::begins`] says. `None` if
    /// there is none; then the beginning of one at the chunk's end is held.
    #[inline(never)]
    fn seek<'c>(&mut self, head: &Head, chunk: &'c [u8]) -> Option<&'c [u8]> {
        let (&first, behind) = chunk.split_first()?;
        if behind.is_empty() && head.len() > 1 {
            self.hold_first(head, first);
            return None;
        }
        count_visits(head.len());
        // What is wrong is one byte more often than several.
        if behind.first_chunk().is_some_and(|front| head.is(front)) {
            self.skip(1);
            return Some(behind);
        }
        let skip = head.find_behind(chunk);
        count_visits(head.len().saturating_mul(skip));
        self.skip(skip);
        let rest = chunk.get(skip..)?;
        if rest.len() >= MAX_DELIMITER { Some(rest) } else { self.seek_in_few(head, rest) }
    }

    /// The same in fewer than eight bytes, with which a head may begin.
    #[inline(never)]
    fn seek_in_few<'c>(&mut self, head: &Head, few: &'c [u8]) -> Option<&'c [u8]> {
        let skip = head.find_in_few(few);
        count_visits(head.len().saturating_mul(skip.saturating_add(1).min(few.len())));
        self.skip(skip);
        let rest = few.get(skip..)?;
        if rest.len() >= head.len() && !rest.is_empty() {
            return Some(rest);
        }
        self.put_first(rest);
        self.len = rest.len() as u16;
        self.hold_until = 0;
        None
    }

    /// Holds a byte if it begins a head, which has more than one.
    #[inline(always)]
    fn hold_first(&mut self, head: &Head, byte: u8) {
        if !head.may_be(byte.into(), 1) {
            self.skip(1);
            return;
        }
        count_visits(1);
        if let Some(place) = self.ring.first_mut() {
            *place = byte;
        }
        self.len = 1;
        self.hold_until = 0;
    }

    /// Writes to the ring without counting it as held.
    #[inline]
    fn put(&mut self, at: usize, bytes: &[u8]) {
        count_visits(bytes.len());
        if let Some(target) = self.ring.get_mut(at..at.saturating_add(bytes.len())) {
            copy(target, bytes);
        }
    }

    /// Writes to the front of the ring without counting it as held.
    #[inline(always)]
    fn put_first(&mut self, bytes: &[u8]) {
        match bytes.len() {
            // On its own: the compiler sees that a short piece fits.
            len @ 0..16 => {
                count_visits(len);
                if let Some(target) = self.ring.get_mut(..len) {
                    runs::copy(target, bytes);
                }
            }
            _ => self.put(0, bytes),
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

mod resync;

#[cfg(not(test))]
#[inline(always)]
fn count_visits(_bytes: usize) {}

#[cfg(test)]
use tests::count_visits;

#[cfg(test)]
mod tests;
