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
/// Length of a header and a function code.
pub(super) const FRONT_LEN: usize = 8;

/// Length of the header up to and including its length field.
pub(crate) const PREFIX_LEN: usize = 6;
/// The fields of a [`Front`].
const TRANSACTION_SHIFT: u32 = 48;
const TRANSACTION: u64 = 0xFFFF << TRANSACTION_SHIFT;
const LENGTH_SHIFT: u32 = 16;
const UNIT_SHIFT: u32 = 8;
const UNIT: u64 = 0xFF << UNIT_SHIFT;
const FUNCTION: u64 = 0xFF;
/// The length field counts the unit id and the PDU: at least a function code, at most 253 bytes (D10).
const LENGTHS: core::ops::RangeInclusive<u16> = NO_DATA..=254;
/// Value of the length field of a frame without data: unit id and function code.
const NO_DATA: u16 = 2;

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

/// A header after which the next frame can no longer be found: the connection must be closed (D10).
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

/// Splits a connection's bytes into frames.
///
/// Holds at most one partial frame. A frame that is complete in one chunk is returned without a copy.
#[derive(Debug, Clone)]
pub struct AduReader {
    buffer: [u8; MAX_ADU],
    filled: usize,
}

#[derive(Clone, Copy)]
pub(super) struct AduFrame<'a> {
    pub(super) front: Front,
    /// Data after the function code.
    pub(super) data: &'a [u8],
}

/// The first eight bytes of a frame as one big-endian number, so they are compared and written at once: transaction id,
/// protocol id, length, unit id and function code.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Front(u64);

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

    /// Takes bytes from the front of `chunk` up to the end of the next frame and returns the frame; `None` once all of
    /// `chunk` is taken and no frame is complete.
    ///
    /// # Errors
    /// After an [`AduError`] the rest of the chunk is dropped and the connection must be closed; the reader is reset.
    pub fn next_adu<'s, 'c: 's>(&'s mut self, chunk: &mut &'c [u8]) -> Option<Result<Adu<'s>, AduError>> {
        let received = *chunk;
        let (front, bytes) = match self.take(chunk) {
            Some(AduFrame { front, .. }) => (front, received),
            None => match self.next_buffered(chunk)? {
                Ok(front) => (front, &self.buffer[..]),
                Err(error) => return Some(Err(error)),
            },
        };
        let pdu = bytes.get(HEADER_LEN..).and_then(|behind| behind.get(..front.data_len().saturating_add(1)));
        let (transaction, unit) = (front.transaction(), front.unit());
        Some(Ok(Adu { transaction, unit, pdu: pdu.unwrap_or_default() }))
    }

    /// Drops a partial frame, for a new connection.
    pub const fn reset(&mut self) {
        self.filled = 0;
    }

    /// Number of held bytes of a partial frame.
    pub const fn pending(&self) -> usize {
        self.filled
    }

    /// Takes a frame that is complete at the front of `chunk`. Returns `None`, with nothing taken, if
    /// [`Self::next_buffered`] has to handle the bytes: a frame in pieces, or a wrong header.
    pub(super) fn take<'c>(&self, chunk: &mut &'c [u8]) -> Option<AduFrame<'c>> {
        let (front, behind) = chunk.split_first_chunk().filter(|_| self.filled == 0)?;
        let front = Front::from_bytes(front);
        let (data, rest) = behind.split_at_checked(front.checked_data_len()?)?;
        *chunk = rest;
        Some(AduFrame { front, data })
    }

    /// Buffers bytes until a frame is complete and returns its front; [`Self::data`] returns its data. Also reports
    /// wrong headers.
    pub(super) fn next_buffered(&mut self, chunk: &mut &[u8]) -> Option<Result<Front, AduError>> {
        // The usual end of a chunk.
        if chunk.is_empty() || !self.fill_to(PREFIX_LEN, chunk) {
            return None;
        }
        let total = match self.buffer.first_chunk().map(frame_len)? {
            Ok(total) => total,
            Err(error) => {
                self.filled = 0;
                *chunk = &[];
                return Some(Err(error));
            }
        };
        if !self.fill_to(total, chunk) {
            return None;
        }
        self.filled = 0;
        Some(Ok(Front::from_bytes(self.buffer.first_chunk()?)))
    }

    /// The data of the frame whose front [`Self::next_buffered`] just returned.
    pub(super) fn data(&self, front: Front) -> &[u8] {
        self.buffer.get(FRONT_LEN..).and_then(|behind| behind.get(..front.data_len())).unwrap_or_default()
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
}

impl Front {
    /// Front of the first frame of a connection to `unit`, with length and function code 0.
    pub(super) const fn first(unit: u8) -> Self {
        Self((unit as u64) << UNIT_SHIFT)
    }

    /// Front of the next frame, with this function code and length 0.
    pub(super) const fn next(self, function: u8) -> Self {
        Self((self.0 & (TRANSACTION | UNIT)).wrapping_add(1 << TRANSACTION_SHIFT) | function as u64)
    }

    /// Changes the length from `had` to `data_len` bytes of data.
    pub(super) const fn resized(self, had: usize, data_len: usize) -> Self {
        Self(self.0.wrapping_add((data_len as u64).wrapping_sub(had as u64) << LENGTH_SHIFT))
    }

    /// Sets the length, which is 0 here, for `data_len` bytes of data.
    pub(super) const fn carrying(self, data_len: usize) -> Self {
        Self(self.0 | ((data_len as u16).wrapping_add(NO_DATA) as u64) << LENGTH_SHIFT)
    }

    pub(super) const fn with_function(self, function: u8) -> Self {
        Self(self.0 & !FUNCTION | function as u64)
    }

    pub(super) const fn from_bytes(bytes: &[u8; FRONT_LEN]) -> Self {
        Self(u64::from_be_bytes(*bytes))
    }

    pub(super) const fn to_bytes(self) -> [u8; FRONT_LEN] {
        self.0.to_be_bytes()
    }

    pub(super) const fn transaction(self) -> u16 {
        (self.0 >> TRANSACTION_SHIFT) as u16
    }

    pub(super) const fn unit(self) -> u8 {
        (self.0 >> UNIT_SHIFT) as u8
    }

    pub(super) const fn function(self) -> u8 {
        self.0 as u8
    }

    /// Number of bytes after the function code. The header must be valid.
    pub(super) const fn data_len(self) -> usize {
        ((self.0 >> LENGTH_SHIFT) as u16).wrapping_sub(NO_DATA) as usize
    }

    /// Number of bytes after the function code; `None` if the header is wrong.
    fn checked_data_len(self) -> Option<usize> {
        // Checks the protocol id, which must be 0, and the length together.
        let length = (self.0 >> LENGTH_SHIFT) as u32;
        let range = u32::from(*LENGTHS.start())..=u32::from(*LENGTHS.end());
        range.contains(&length).then(|| length.wrapping_sub(NO_DATA.into()) as usize)
    }
}

/// The length of the whole frame, from the first six bytes of its header.
pub(crate) fn frame_len(&[_, _, p1, p0, l1, l0]: &[u8; PREFIX_LEN]) -> Result<usize, AduError> {
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
