//! The Modbus TCP frame: seven bytes of header before each PDU (docs/wire/modbus.md section 2).
//!
//! In: a connection's bytes in chunks of any size. Out: whole frames. Does not know functions.

use core::fmt;

/// Longest frame: header and PDU.
pub const MAX_ADU: usize = 260;
/// Transaction id, protocol id, length, unit id.
pub const HEADER_LEN: usize = 7;
/// Longest PDU.
pub const MAX_PDU: usize = 253;

/// Length of the header up to and including its length field.
const PREFIX_LEN: usize = 6;
/// The length field counts the unit id and the PDU: at least a function code, at most 253 bytes (D10).
const LENGTHS: core::ops::RangeInclusive<u16> = 2..=254;

/// One received frame.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct Adu<'a> {
    /// Chosen by the client, echoed by the server.
    pub transaction: u16,
    /// Unit id; echoed by the server.
    pub unit: u8,
    /// Function code and data, 1..=253 bytes when received.
    pub pdu: &'a [u8],
}

/// A header after which frames can no longer be found: the connection must be closed (D10).
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
#[non_exhaustive]
pub enum AduError {
    /// The protocol id is not 0.
    Protocol {
        /// The received id.
        received: u16,
    },
    /// The length field is outside 2..=254.
    Length {
        /// The received length.
        received: u16,
    },
}

impl fmt::Display for AduError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Protocol { received } => write!(f, "Modbus protocol id is 0x{received:04x} instead of 0"),
            Self::Length { received } => write!(f, "Modbus frame length {received} is outside 2..=254"),
        }
    }
}

impl core::error::Error for AduError {}

/// The header of a frame that carries `pdu_len` bytes of PDU.
#[inline]
pub(super) const fn header(transaction: u16, unit: u8, pdu_len: usize) -> [u8; HEADER_LEN] {
    let [t1, t0] = transaction.to_be_bytes();
    let [l1, l0] = (pdu_len as u16).wrapping_add(1).to_be_bytes();
    [t1, t0, 0, 0, l1, l0, unit]
}

/// Cuts a connection's bytes into frames.
///
/// Holds at most one partial frame. A frame that lies whole in a chunk is returned in place,
/// without a copy.
#[derive(Debug, Clone)]
pub struct AduReader {
    buffer: [u8; MAX_ADU],
    filled: usize,
}

/// Where a whole frame is.
#[derive(Clone, Copy)]
pub(super) enum Place<'c> {
    Chunk(&'c [u8]),
    Buffer(usize),
}

impl Default for AduReader {
    fn default() -> Self {
        Self::new()
    }
}

impl AduReader {
    /// A reader at the start of a connection.
    pub const fn new() -> Self {
        Self { buffer: [0; MAX_ADU], filled: 0 }
    }

    /// Takes bytes from the front of `chunk` up to the end of the next frame and returns it;
    /// `None` once all of `chunk` is taken and no frame is complete.
    ///
    /// # Errors
    /// After an [`AduError`] the rest of the chunk is dropped and the connection must be closed;
    /// the reader is at the start of a connection again.
    pub fn next_adu<'s, 'c: 's>(&'s mut self, chunk: &mut &'c [u8]) -> Option<Result<Adu<'s>, AduError>> {
        let place = self.advance(chunk)?;
        Some(place.map(|place| self.adu(place)))
    }

    /// Forgets a partial frame, for a new connection.
    pub const fn reset(&mut self) {
        self.filled = 0;
    }

    /// Bytes of a partial frame that are held.
    pub const fn pending(&self) -> usize {
        self.filled
    }

    #[inline]
    pub(super) fn advance<'c>(&mut self, chunk: &mut &'c [u8]) -> Option<Result<Place<'c>, AduError>> {
        if chunk.is_empty() {
            return None;
        }
        if self.filled != 0 {
            return self.advance_buffered(chunk);
        }
        let Some(prefix) = chunk.first_chunk() else { return self.advance_buffered(chunk) };
        let total = match frame_len(prefix) {
            Ok(total) => total,
            Err(error) => return Some(Err(self.fail(chunk, error))),
        };
        let Some((frame, rest)) = chunk.split_at_checked(total) else {
            return self.advance_buffered(chunk);
        };
        *chunk = rest;
        Some(Ok(Place::Chunk(frame)))
    }

    /// The frame at `place`, which must come from the last call of [`AduReader::advance`].
    #[inline]
    pub(super) fn adu<'s, 'c: 's>(&'s self, place: Place<'c>) -> Adu<'s> {
        let frame = match place {
            Place::Chunk(frame) => frame,
            Place::Buffer(len) => self.buffer.get(..len).unwrap_or_default(),
        };
        match frame.split_first_chunk::<HEADER_LEN>() {
            Some((&[t1, t0, _, _, _, _, unit], pdu)) => {
                Adu { transaction: u16::from_be_bytes([t1, t0]), unit, pdu }
            }
            // Not reached: every place holds at least a header and one byte.
            None => Adu { transaction: 0, unit: 0, pdu: &[] },
        }
    }

    #[cold]
    fn advance_buffered<'c>(&mut self, chunk: &mut &'c [u8]) -> Option<Result<Place<'c>, AduError>> {
        if !self.fill_to(PREFIX_LEN, chunk) {
            return None;
        }
        let total = match self.buffer.first_chunk().map(frame_len)? {
            Ok(total) => total,
            Err(error) => return Some(Err(self.fail(chunk, error))),
        };
        if !self.fill_to(total, chunk) {
            return None;
        }
        self.filled = 0;
        Some(Ok(Place::Buffer(total)))
    }

    /// Moves bytes from `chunk` until `target` are buffered; false if the chunk was too short.
    fn fill_to(&mut self, target: usize, chunk: &mut &[u8]) -> bool {
        let missing = target.saturating_sub(self.filled);
        let (moved, rest) = chunk.split_at_checked(missing).unwrap_or((*chunk, &[]));
        let space = self.buffer.get_mut(self.filled..).and_then(|space| space.get_mut(..moved.len()));
        if let Some(space) = space {
            space.copy_from_slice(moved);
        }
        self.filled = self.filled.saturating_add(moved.len());
        *chunk = rest;
        self.filled >= target
    }

    #[cold]
    fn fail(&mut self, chunk: &mut &[u8], error: AduError) -> AduError {
        self.filled = 0;
        *chunk = &[];
        error
    }
}

/// The length of the whole frame, from the first six bytes of its header.
#[inline]
fn frame_len(&[_, _, p1, p0, l1, l0]: &[u8; PREFIX_LEN]) -> Result<usize, AduError> {
    let protocol = u16::from_be_bytes([p1, p0]);
    if protocol != 0 {
        return Err(AduError::Protocol { received: protocol });
    }
    let length = u16::from_be_bytes([l1, l0]);
    if !LENGTHS.contains(&length) {
        return Err(AduError::Length { received: length });
    }
    Ok(usize::from(length).saturating_add(PREFIX_LEN))
}
