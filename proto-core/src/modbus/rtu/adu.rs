//! The Modbus RTU frame: address, PDU, CRC (docs/wire/modbus-rtu.md section 1).
//!
//! In: a frame's bytes, or its contents. Out: the other, and the length of a frame from its first bytes. Does not know
//! silence, transactions or the meaning of a function.

use core::fmt;

use super::super::pdu::{MAX_PDU, PduEncodeError, function};
use crate::device::Algorithm;

/// Longest frame.
pub const MAX_ADU: usize = MAX_PDU + OVERHEAD;
/// Shortest frame: address, function code, CRC.
pub const MIN_ADU: usize = 4;
/// Address of a broadcast: a request to all slaves, which is not answered.
pub const BROADCAST: u8 = 0;
/// Highest address of a slave; those above are reserved.
pub const MAX_ADDRESS: u8 = 247;

/// Bytes of the CRC, low byte first.
pub(crate) const CRC_LEN: usize = 2;
/// Address and CRC.
const OVERHEAD: usize = 1 + CRC_LEN;

/// A frame with a right CRC.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct Adu<'a> {
    /// The slave that is asked or that answers, or [`BROADCAST`].
    pub address: u8,
    /// Function code and data, 1..=253 bytes.
    pub pdu: &'a [u8],
}

/// Why bytes are not a frame.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
#[non_exhaustive]
pub enum AduError {
    /// Fewer than 4 or more than 256 bytes.
    Length {
        /// Number of bytes.
        received: usize,
    },
    /// The CRC does not match the bytes before it.
    Checksum {
        /// The CRC of the bytes.
        expected: u16,
        /// The CRC in the frame.
        received: u16,
    },
}

impl fmt::Display for AduError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Length { received } => write!(f, "a frame has {received} bytes; allowed: 4..=256"),
            Self::Checksum { expected, received } => {
                write!(f, "a frame has the CRC 0x{received:04x} instead of 0x{expected:04x}")
            }
        }
    }
}

impl core::error::Error for AduError {}

/// The length of a frame, as far as its first bytes show it.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum FrameLen {
    /// Length of the whole frame in bytes, CRC included; at most 256.
    Known(usize),
    /// This many bytes of the frame are needed to know the length.
    NeedsBytes(usize),
    /// The function's length is not known, or the byte count is too large for a frame.
    Unknown,
}

impl<'a> Adu<'a> {
    /// Checks that `frame` is one whole frame.
    ///
    /// # Errors
    /// An invalid length or a wrong CRC.
    pub fn parse(frame: &'a [u8]) -> Result<Self, AduError> {
        let length = AduError::Length { received: frame.len() };
        if !(MIN_ADU..=MAX_ADU).contains(&frame.len()) {
            return Err(length);
        }
        let (checked, crc) = frame.split_last_chunk::<CRC_LEN>().ok_or(length)?;
        let (expected, received) = (checksum(checked), u16::from_le_bytes(*crc));
        if expected != received {
            return Err(AduError::Checksum { expected, received });
        }
        let (&address, pdu) = checked.split_first().ok_or(length)?;
        Ok(Self { address, pdu })
    }

    /// Number of bytes of the frame, CRC included.
    pub const fn encoded_len(&self) -> usize {
        self.pdu.len().saturating_add(OVERHEAD)
    }

    /// Writes the frame to the front of `out` and returns its length.
    ///
    /// # Errors
    /// `out` is too short; nothing is written then.
    pub fn encode(&self, out: &mut [u8]) -> Result<usize, PduEncodeError> {
        let (needed, available) = (self.encoded_len(), out.len());
        let no_space = PduEncodeError::NoSpace { needed, available };
        let (address, body) = out.get_mut(..needed).ok_or(no_space)?.split_first_mut().ok_or(no_space)?;
        *address = self.address;
        for (slot, &byte) in body.iter_mut().zip(self.pdu) {
            *slot = byte;
        }
        seal(out, self.pdu.len().saturating_add(1)).ok_or(no_space)
    }
}

/// The CRC of `bytes`; it is sent low byte first.
pub fn checksum(bytes: &[u8]) -> u16 {
    // A CRC of width 16 fits.
    Algorithm::CRC16_MODBUS.of([bytes]) as u16
}

/// Whether `frame` ends with the CRC of the bytes before it.
pub(super) fn is_right(frame: &[u8]) -> bool {
    Adu::parse(frame).is_ok()
}

/// Appends the CRC to the first `len` bytes and returns the new length; `None` if there is no space.
pub(super) fn seal(frame: &mut [u8], len: usize) -> Option<usize> {
    let (checked, rest) = frame.split_at_mut_checked(len)?;
    *rest.first_chunk_mut::<CRC_LEN>()? = checksum(checked).to_le_bytes();
    len.checked_add(CRC_LEN)
}

/// Length of a request from its first bytes, address first: function codes 1-6, 15, 16, 22 and 23.
pub fn request_len(frame: &[u8]) -> FrameLen {
    match frame.get(1) {
        None => FrameLen::NeedsBytes(2),
        Some(
            &(function::READ_COILS
            | function::READ_DISCRETE
            | function::READ_HOLDING
            | function::READ_INPUT
            | function::WRITE_COIL
            | function::WRITE_REGISTER),
        ) => FrameLen::Known(8),
        Some(&(function::WRITE_COILS | function::WRITE_REGISTERS)) => counted(frame, 6),
        Some(&function::READ_WRITE_REGISTERS) => counted(frame, 10),
        Some(&function::MASK_WRITE_REGISTER) => FrameLen::Known(10),
        Some(_) => FrameLen::Unknown,
    }
}

/// Length of a reply from its first bytes, address first: function codes 1-6, 15, 16, 22 and 23, and exceptions.
pub fn reply_len(frame: &[u8]) -> FrameLen {
    match frame.get(1) {
        None => FrameLen::NeedsBytes(2),
        Some(
            &(function::READ_COILS
            | function::READ_DISCRETE
            | function::READ_HOLDING
            | function::READ_INPUT
            | function::READ_WRITE_REGISTERS),
        ) => counted(frame, 2),
        Some(
            &(function::WRITE_COIL
            | function::WRITE_REGISTER
            | function::WRITE_COILS
            | function::WRITE_REGISTERS),
        ) => FrameLen::Known(8),
        Some(&function::MASK_WRITE_REGISTER) => FrameLen::Known(10),
        Some(code) if code & function::EXCEPTION_FLAG != 0 => FrameLen::Known(5),
        Some(_) => FrameLen::Unknown,
    }
}

/// Length of a frame whose byte count is at offset `at`, followed by the data.
fn counted(frame: &[u8], at: usize) -> FrameLen {
    let head = at.saturating_add(1);
    match frame.get(at) {
        None => FrameLen::NeedsBytes(head),
        Some(&count) => match head.saturating_add(usize::from(count)).saturating_add(CRC_LEN) {
            len if len <= MAX_ADU => FrameLen::Known(len),
            _ => FrameLen::Unknown,
        },
    }
}
