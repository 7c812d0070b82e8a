//! Finds frames in a stream of bytes (docs/wire/recipes.md section 4, D19), and checks datagrams
//! (section 5).
//!
//! In: chunks of any size. Out: the payload of each frame, and counts of everything else. Whether
//! the line was silent too long is the caller's knowledge: it calls [`Deframer::discard`].
//!
//! Work is linear in the bytes received, whatever they are: each is copied at most twice, compared
//! with the head for at most eight positions and with the tail for at most eight.

use super::error::DatagramError;
use super::model::MAX_STREAM_FRAME;
use super::stream::StreamLayout;

/// What a [`Deframer`] did since it was made.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct DeframerStats {
    /// Frames found.
    pub frames: u64,
    /// Bytes dropped because no frame begins there.
    pub skipped_bytes: u64,
    /// Times a head was followed, a frame's length on, by something else than the tail.
    pub tail_mismatches: u64,
    /// Bytes of partial frames that [`Deframer::discard`] dropped.
    pub discarded_bytes: u64,
}

/// Cuts a byte stream into frames.
///
/// It holds at most one frame less a byte, and only bytes that may still become a frame.
#[derive(Debug, Clone)]
pub struct Deframer {
    /// A ring, so that dropping a byte at the front moves nothing; it starts at 0 whenever it is
    /// empty, so that it wraps only after a broken frame.
    ring: [u8; RING],
    start: u16,
    len: u16,
    stats: DeframerStats,
}

const RING: usize = MAX_STREAM_FRAME;
const WRAP: usize = RING - 1;
const _: () = assert!(RING.is_power_of_two());

/// How completing a partial frame ended.
enum Held {
    /// The ring holds a whole frame.
    Frame,
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
        Self { ring: [0; RING], start: 0, len: 0, stats }
    }

    /// The payload of the next frame. Bytes are taken from the front of `chunk`; call it again
    /// with what is left until it returns `None`, which means that the chunk is used up.
    ///
    /// All calls between two [`Self::discard`]s must be given the same layout.
    pub fn next_frame<'s, 'c: 's>(
        &'s mut self,
        layout: &StreamLayout,
        chunk: &mut &'c [u8],
    ) -> Option<&'s [u8]> {
        if self.len != 0 {
            match self.complete(layout, chunk) {
                Held::Frame => return Some(self.take(layout)),
                Held::Partial => return None,
                Held::Nothing => {}
            }
        }
        self.search(layout, chunk)
    }

    /// How many bytes of a possible frame are held.
    pub const fn pending(&self) -> usize {
        self.len as usize
    }

    /// Drops a partial frame, because the line was silent or the recipe changed, and returns how
    /// many bytes that were.
    pub fn discard(&mut self) -> usize {
        let dropped = self.pending();
        self.stats.discarded_bytes = self.stats.discarded_bytes.wrapping_add(dropped as u64);
        self.start = 0;
        self.len = 0;
        dropped
    }

    /// What happened so far.
    pub const fn stats(&self) -> DeframerStats {
        self.stats
    }

    /// Looks for a frame in the chunk itself, with nothing held. What may become one is held.
    fn search<'c>(&mut self, layout: &StreamLayout, chunk: &mut &'c [u8]) -> Option<&'c [u8]> {
        let mut rest = *chunk;
        loop {
            let skip = layout.head_word().find(rest);
            count_visits(skip.saturating_add(1).saturating_mul(layout.head().len().max(1)));
            self.skip(skip);
            rest = rest.get(skip..).unwrap_or(&[]);
            let Some((frame, after)) = rest.split_at_checked(layout.frame_len()) else {
                *chunk = &[];
                self.append(rest);
                return None;
            };
            count_visits(layout.tail().len());
            if layout.tail_word().ends(frame) {
                self.stats.frames = self.stats.frames.wrapping_add(1);
                *chunk = after;
                return Some(layout.payload_of(frame));
            }
            self.stats.tail_mismatches = self.stats.tail_mismatches.wrapping_add(1);
            self.skip(1);
            rest = rest.get(1..).unwrap_or(&[]);
        }
    }

    /// Takes what the held bytes need to become a frame.
    fn complete(&mut self, layout: &StreamLayout, chunk: &mut &[u8]) -> Held {
        loop {
            let held = self.pending();
            // Nothing is missing only when the layout was changed without a discard.
            let Some(missing) = layout.frame_len().checked_sub(held).filter(|&missing| missing > 0) else {
                self.discard();
                return Held::Nothing;
            };
            let (more, after) = chunk.split_at_checked(missing).unwrap_or((chunk, &[]));
            self.append(more);
            *chunk = after;
            if self.head_goes_on(layout, held) {
                if more.len() < missing {
                    return Held::Partial;
                }
                if self.tail_agrees(layout) {
                    return Held::Frame;
                }
                self.stats.tail_mismatches = self.stats.tail_mismatches.wrapping_add(1);
            }
            if !self.next_candidate(layout) {
                return Held::Nothing;
            }
        }
    }

    /// The held frame's payload; the ring is empty afterwards.
    fn take(&mut self, layout: &StreamLayout) -> &[u8] {
        self.stats.frames = self.stats.frames.wrapping_add(1);
        let start = usize::from(self.start);
        self.start = 0;
        self.len = 0;
        let end = start.saturating_add(layout.frame_len());
        let frame = if end <= RING {
            self.ring.get(start..end)
        } else {
            count_visits(RING);
            self.ring.rotate_left(start & WRAP);
            self.ring.get(..layout.frame_len())
        };
        layout.payload_of(frame.unwrap_or(&[]))
    }

    /// Whether the held bytes from `from` on agree with the head; those before are known to.
    fn head_goes_on(&self, layout: &StreamLayout, from: usize) -> bool {
        let end = self.pending().min(layout.head().len());
        count_visits(end.saturating_sub(from));
        (from..end).all(|at| layout.head().get(at) == self.held(at))
    }

    /// Whether the held bytes, a frame's length of them, end with the tail.
    fn tail_agrees(&self, layout: &StreamLayout) -> bool {
        count_visits(layout.tail().len());
        let back = layout.frame_len().saturating_sub(layout.tail().len());
        layout.tail().iter().zip(back..).all(|(byte, at)| Some(byte) == self.held(at))
    }

    /// Drops bytes, at least one, up to the next that may begin a frame.
    fn next_candidate(&mut self, layout: &StreamLayout) -> bool {
        let held = self.pending();
        let mut at = 1_usize;
        while at < held {
            count_visits(layout.head().len().max(1));
            if layout.head().iter().zip(at..held).all(|(byte, at)| Some(byte) == self.held(at)) {
                break;
            }
            at = at.saturating_add(1);
        }
        self.skip(at);
        self.len = held.saturating_sub(at) as u16;
        self.start = if self.len == 0 { 0 } else { (usize::from(self.start).wrapping_add(at) & WRAP) as u16 };
        self.len != 0
    }

    /// The held byte `at` from the front.
    fn held(&self, at: usize) -> Option<&u8> {
        self.ring.get(usize::from(self.start).wrapping_add(at) & WRAP)
    }

    /// Holds more bytes; there is always space, since what is held stays below a frame's length.
    fn append(&mut self, bytes: &[u8]) {
        count_visits(bytes.len());
        let end = usize::from(self.start).wrapping_add(self.pending()) & WRAP;
        let straight = RING.saturating_sub(end).min(bytes.len());
        let (first, second) = bytes.split_at_checked(straight).unwrap_or((bytes, &[]));
        if let Some(target) = self.ring.get_mut(end..end.saturating_add(first.len())) {
            target.copy_from_slice(first);
        }
        if let Some(target) = self.ring.get_mut(..second.len()) {
            target.copy_from_slice(second);
        }
        self.len = self.len.saturating_add(bytes.len() as u16);
    }

    fn skip(&mut self, bytes: usize) {
        self.stats.skipped_bytes = self.stats.skipped_bytes.wrapping_add(bytes as u64);
    }
}

/// The payload of a datagram that is exactly one frame.
///
/// # Errors
/// [`DatagramError`] says whether length, head or tail is wrong.
pub fn datagram<'d>(layout: &StreamLayout, bytes: &'d [u8]) -> Result<&'d [u8], DatagramError> {
    if bytes.len() != layout.frame_len() {
        return Err(DatagramError::Length { expected: layout.frame_len(), got: bytes.len() });
    }
    if !layout.head_word().agrees(bytes) {
        return Err(DatagramError::Head);
    }
    if !layout.tail_word().ends(bytes) {
        return Err(DatagramError::Tail);
    }
    Ok(layout.payload_of(bytes))
}

#[cfg(not(test))]
#[inline(always)]
fn count_visits(_bytes: usize) {}

#[cfg(test)]
use tests::count_visits;

#[cfg(test)]
mod tests;
