//! Parts of a PDU on both sides: operands, data of a write, limits (docs/wire/modbus.md section 3).
//!
//! In: the fields of a request. Out: its bytes after the function code. Does not know connections.

use core::fmt;

use crate::wire::runs;

/// Function code, address, and count or value of a request; its response is checked against them.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct RequestHead {
    /// Function code.
    pub function: u8,
    /// First address.
    pub address: u16,
    /// The value as on the wire for FC 5 and 6, the count otherwise.
    pub count_or_value: u16,
}

/// Why a request or response cannot be encoded.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
#[non_exhaustive]
pub enum PduEncodeError {
    /// The buffer is too short; nothing was written.
    NoSpace {
        /// Number of bytes that the PDU or frame needs.
        needed: usize,
        /// Number of bytes available.
        available: usize,
    },
    /// A count of 0 or over the function's limit.
    Count {
        /// The count in the request.
        count: u16,
        /// The function's limit.
        max: u16,
    },
}

impl fmt::Display for PduEncodeError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::NoSpace { needed, available } => {
                write!(f, "{needed} bytes are needed and {available} available")
            }
            Self::Count { count, max } => write!(f, "a count of {count} is outside 1..={max}"),
        }
    }
}

impl core::error::Error for PduEncodeError {}

/// The address, and the count or value, that follow most function codes, as one number.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Operands(u32);

impl Operands {
    pub(super) const fn new(address: u16, count_or_value: u16) -> Self {
        Self((address as u32) << 16 | count_or_value as u32)
    }

    pub(super) const fn from_bytes(bytes: &[u8; OPERANDS_LEN]) -> Self {
        Self(u32::from_be_bytes(*bytes))
    }

    pub(super) const fn to_bytes(self) -> [u8; OPERANDS_LEN] {
        self.0.to_be_bytes()
    }

    pub(super) const fn address(self) -> u16 {
        (self.0 >> 16) as u16
    }

    pub(super) const fn count_or_value(self) -> u16 {
        self.0 as u16
    }

    /// Combines the operands with a function code.
    pub(super) const fn of(self, function: u8) -> RequestHead {
        RequestHead { function, address: self.address(), count_or_value: self.count_or_value() }
    }
}

/// The parts of a request's PDU.
#[derive(Clone, Copy)]
pub(super) struct RequestParts<'a> {
    pub(super) function: u8,
    pub(super) operands: Operands,
    /// Limit of the count, or [`NO_COUNT`].
    pub(super) max: u16,
    /// The data of a multiple write, and the number of unused highest bits in its last byte, which are sent as 0.
    pub(super) data: Option<(&'a [u8], u8)>,
    /// Number of bytes after the function code of a good answer.
    pub(super) answer_len: usize,
}

impl RequestParts<'_> {
    /// A request without data, whose answer repeats its operands.
    pub(super) const fn new(function: u8, address: u16, count_or_value: u16, max: u16) -> Self {
        let operands = Operands::new(address, count_or_value);
        Self { function, operands, max, data: None, answer_len: OPERANDS_LEN }
    }

    /// Number of bytes after the function code.
    pub(super) fn data_len(&self) -> usize {
        self.data.map_or(OPERANDS_LEN, |(data, _)| data.len().wrapping_add(OPERANDS_LEN + 1))
    }

    /// Refuses a count that the function does not allow.
    pub(super) fn check_count(&self) -> Result<(), PduEncodeError> {
        let (count, max) = (self.operands.count_or_value(), self.max);
        if max == NO_COUNT || in_limit(count, max) {
            Ok(())
        } else {
            Err(PduEncodeError::Count { count, max })
        }
    }

    /// Writes the bytes after the function code to `out`, which is [`Self::data_len`] bytes long.
    pub(super) fn write(&self, out: &mut [u8]) {
        let Some((operands, rest)) = out.split_first_chunk_mut() else { return };
        *operands = self.operands.to_bytes();
        if let Some((data, unused)) = self.data
            && let Some((byte_count, target)) = rest.split_first_mut()
        {
            // At most 246 bytes, because the count is limited.
            *byte_count = data.len() as u8;
            copy_cleared(data, unused, target);
        }
    }

    pub(super) fn encoded_len(&self) -> usize {
        self.data_len().saturating_add(1)
    }

    pub(super) fn encode(&self, out: &mut [u8]) -> Result<usize, PduEncodeError> {
        self.check_count()?;
        let (needed, available) = (self.encoded_len(), out.len());
        let no_space = PduEncodeError::NoSpace { needed, available };
        let out = out.get_mut(..needed).ok_or(no_space)?;
        let (function, data) = out.split_first_mut().ok_or(no_space)?;
        *function = self.function;
        self.write(data);
        Ok(needed)
    }
}

/// Copies `data` to `target`, which has the same length, and clears the highest `unused` bits (at most 7) of its last
/// byte.
pub(super) fn copy_cleared(data: &[u8], unused: u8, target: &mut [u8]) {
    match (&mut *target, data) {
        // Sixteen digital outputs, or one register.
        ([first, second], &[from, next]) => (*first, *second) = (from, next),
        // Checked here so the compiler knows that the lengths are equal.
        (target, data) if target.len() != data.len() => return,
        (target, data) if data.len() <= runs::MAX_RUN => runs::copy(target, data),
        (target, data) => target.copy_from_slice(data),
    }
    if unused != 0
        && let Some(last) = target.last_mut()
    {
        *last &= 0xFF_u8.wrapping_shr(unused.into());
    }
}

pub(super) const fn in_limit(count: u16, max: u16) -> bool {
    count != 0 && count <= max
}

pub(super) const fn coil_value(on: bool) -> u16 {
    if on { COIL_ON } else { COIL_OFF }
}

/// Length of an address and a count or value.
pub(super) const OPERANDS_LEN: usize = 4;

/// Used as the limit if the operand is a value.
pub(super) const NO_COUNT: u16 = u16::MAX;

pub(super) const COIL_OFF: u16 = 0x0000;
pub(super) const COIL_ON: u16 = 0xFF00;
