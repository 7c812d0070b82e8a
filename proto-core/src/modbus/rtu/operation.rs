//! Requests of a master, and how their replies are recognised (docs/wire/modbus-rtu.md section 3).
//!
//! In: an operation and the data to write. Out: the request's frame, and what its reply must look like. Does not know
//! when requests are sent.

use core::{fmt, slice};

use super::super::Exception;
use super::super::pdu::{
    MAX_READ_COILS, MAX_READ_REGISTERS, MAX_READ_WRITE_REGISTERS, MAX_WRITE_COILS, MAX_WRITE_REGISTERS,
    function,
};
use super::super::values::{last_mask, packed_len};
use super::adu::{BROADCAST, MAX_ADU, is_right, seal};
use crate::sysvar::Direction;

/// A function with its addresses and counts, but without values.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
pub enum Operation {
    /// FC 1.
    ReadCoils {
        /// First coil.
        address: u16,
        /// 1..=2000.
        count: u16,
    },
    /// FC 2.
    ReadDiscreteInputs {
        /// First input.
        address: u16,
        /// 1..=2000.
        count: u16,
    },
    /// FC 3.
    ReadHoldingRegisters {
        /// First register.
        address: u16,
        /// 1..=125.
        count: u16,
    },
    /// FC 4.
    ReadInputRegisters {
        /// First register.
        address: u16,
        /// 1..=125.
        count: u16,
    },
    /// FC 5.
    WriteCoil {
        /// The coil.
        address: u16,
    },
    /// FC 6.
    WriteRegister {
        /// The register.
        address: u16,
    },
    /// FC 15.
    WriteCoils {
        /// First coil.
        address: u16,
        /// 1..=1968.
        count: u16,
    },
    /// FC 16.
    WriteRegisters {
        /// First register.
        address: u16,
        /// 1..=123.
        count: u16,
    },
    /// FC 23: writes, then reads.
    ReadWriteRegisters {
        /// First register to read.
        read_address: u16,
        /// 1..=125.
        read_count: u16,
        /// First register to write.
        write_address: u16,
        /// 1..=121.
        write_count: u16,
    },
    /// FC 22: writes some bits of one register and keeps the others.
    MaskWriteRegister {
        /// The register.
        address: u16,
        /// The bits that are written.
        mask: u16,
    },
}

/// A count that the function does not allow.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct CountError {
    /// The count.
    pub count: u16,
    /// The function's limit.
    pub max: u16,
}

impl fmt::Display for CountError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "a count of {} is out of range; allowed: 1..={}", self.count, self.max)
    }
}

impl core::error::Error for CountError {}

/// The four tables of a slave.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum Table {
    /// Single bits that can be written.
    Coils,
    /// Single bits.
    DiscreteInputs,
    /// Registers that can be written.
    HoldingRegisters,
    /// Registers.
    InputRegisters,
}

impl Operation {
    /// The operation with this function code; `read` and `written` are address and count of what it reads and writes,
    /// `mask` is for FC 22. `None` for any other function code.
    pub const fn of_function(code: u8, read: (u16, u16), written: (u16, u16), mask: u16) -> Option<Self> {
        let ((read_address, read_count), (write_address, write_count)) = (read, written);
        let (address, count) = read;
        Some(match code {
            function::READ_COILS => Self::ReadCoils { address, count },
            function::READ_DISCRETE => Self::ReadDiscreteInputs { address, count },
            function::READ_HOLDING => Self::ReadHoldingRegisters { address, count },
            function::READ_INPUT => Self::ReadInputRegisters { address, count },
            function::WRITE_COIL => Self::WriteCoil { address: write_address },
            function::WRITE_REGISTER => Self::WriteRegister { address: write_address },
            function::WRITE_COILS => Self::WriteCoils { address: write_address, count: write_count },
            function::WRITE_REGISTERS => Self::WriteRegisters { address: write_address, count: write_count },
            function::READ_WRITE_REGISTERS => {
                Self::ReadWriteRegisters { read_address, read_count, write_address, write_count }
            }
            function::MASK_WRITE_REGISTER => Self::MaskWriteRegister { address: write_address, mask },
            _ => return None,
        })
    }

    /// The operation of a master on a whole block that the gateway serves as a slave: a write if the block's fields are
    /// an input part, else a read.
    pub const fn of_block(table: Table, fields: Direction, address: u16, count: u16) -> Self {
        match (table, fields) {
            (Table::Coils, Direction::Input) => Self::WriteCoils { address, count },
            (Table::Coils, Direction::Output) => Self::ReadCoils { address, count },
            (Table::DiscreteInputs, _) => Self::ReadDiscreteInputs { address, count },
            (Table::HoldingRegisters, Direction::Input) => Self::WriteRegisters { address, count },
            (Table::HoldingRegisters, Direction::Output) => Self::ReadHoldingRegisters { address, count },
            (Table::InputRegisters, _) => Self::ReadInputRegisters { address, count },
        }
    }

    /// The function code.
    pub const fn function(&self) -> u8 {
        match self {
            Self::ReadCoils { .. } => function::READ_COILS,
            Self::ReadDiscreteInputs { .. } => function::READ_DISCRETE,
            Self::ReadHoldingRegisters { .. } => function::READ_HOLDING,
            Self::ReadInputRegisters { .. } => function::READ_INPUT,
            Self::WriteCoil { .. } => function::WRITE_COIL,
            Self::WriteRegister { .. } => function::WRITE_REGISTER,
            Self::WriteCoils { .. } => function::WRITE_COILS,
            Self::WriteRegisters { .. } => function::WRITE_REGISTERS,
            Self::ReadWriteRegisters { .. } => function::READ_WRITE_REGISTERS,
            Self::MaskWriteRegister { .. } => function::MASK_WRITE_REGISTER,
        }
    }

    /// Whether a good reply has the same bytes as the request, like an echo of the line.
    pub const fn is_repeated_by_reply(&self) -> bool {
        matches!(self, Self::WriteCoil { .. } | Self::WriteRegister { .. } | Self::MaskWriteRegister { .. })
    }

    /// Whether the reply carries data; such a request cannot be a broadcast.
    pub const fn reads(&self) -> bool {
        self.reply_data_len().is_some()
    }

    /// Checks the counts.
    ///
    /// # Errors
    /// A count of 0 or over the function's limit.
    pub const fn check(&self) -> Result<(), CountError> {
        let (count, max) = match *self {
            Self::ReadCoils { count, .. } | Self::ReadDiscreteInputs { count, .. } => (count, MAX_READ_COILS),
            Self::ReadHoldingRegisters { count, .. } | Self::ReadInputRegisters { count, .. } => {
                (count, MAX_READ_REGISTERS)
            }
            Self::WriteCoil { .. } | Self::WriteRegister { .. } | Self::MaskWriteRegister { .. } => (1, 1),
            Self::WriteCoils { count, .. } => (count, MAX_WRITE_COILS),
            Self::WriteRegisters { count, .. } => (count, MAX_WRITE_REGISTERS),
            Self::ReadWriteRegisters { read_count, write_count, .. } => {
                if matches!(write_count, 1..=MAX_READ_WRITE_REGISTERS) {
                    (read_count, MAX_READ_REGISTERS)
                } else {
                    (write_count, MAX_READ_WRITE_REGISTERS)
                }
            }
        };
        if count == 0 || count > max { Err(CountError { count, max }) } else { Ok(()) }
    }

    /// Bytes of data in a request: 0 for a read; 1 for one coil, of which the lowest bit counts; coils packed eight per
    /// byte with the first in the lowest bit; two bytes per register, high byte first. For FC 22, the register with the
    /// written bits.
    pub const fn written_len(&self) -> usize {
        match *self {
            Self::WriteCoil { .. } => 1,
            Self::WriteRegister { .. } | Self::MaskWriteRegister { .. } => 2,
            Self::WriteCoils { count, .. } => packed_len(count),
            Self::WriteRegisters { count, .. } | Self::ReadWriteRegisters { write_count: count, .. } => {
                (count as usize).saturating_mul(2)
            }
            _ => 0,
        }
    }

    /// Bytes of data that a reply carries; 0 for a write.
    pub const fn read_len(&self) -> usize {
        match self.reply_data_len() {
            Some(len) => len,
            None => 0,
        }
    }

    /// Table, first address and count; for FC 23, of the registers that it reads.
    pub const fn place(&self) -> (Table, u16, u16) {
        let table = match self {
            Self::ReadCoils { .. } | Self::WriteCoil { .. } | Self::WriteCoils { .. } => Table::Coils,
            Self::ReadDiscreteInputs { .. } => Table::DiscreteInputs,
            Self::ReadInputRegisters { .. } => Table::InputRegisters,
            _ => Table::HoldingRegisters,
        };
        let (address, count) = self.head();
        match self {
            Self::WriteCoil { .. } | Self::WriteRegister { .. } | Self::MaskWriteRegister { .. } => {
                (table, address, 1)
            }
            _ => (table, address, count),
        }
    }

    /// Length of the request's frame.
    pub const fn request_len(&self) -> usize {
        match self {
            Self::WriteCoils { .. } | Self::WriteRegisters { .. } => self.written_len().saturating_add(9),
            Self::ReadWriteRegisters { .. } => self.written_len().saturating_add(13),
            Self::MaskWriteRegister { .. } => MASK_WRITE_LEN,
            _ => 8,
        }
    }

    /// Length of the frame of a good reply.
    pub const fn reply_len(&self) -> usize {
        match self.reply_data_len() {
            Some(len) => len.saturating_add(5),
            None => repeated_len(self.function()).saturating_add(4),
        }
    }

    /// Bytes of data in the reply; `None` for a reply that repeats the operands.
    const fn reply_data_len(&self) -> Option<usize> {
        match *self {
            Self::ReadCoils { count, .. } | Self::ReadDiscreteInputs { count, .. } => Some(packed_len(count)),
            Self::ReadHoldingRegisters { count, .. }
            | Self::ReadInputRegisters { count, .. }
            | Self::ReadWriteRegisters { read_count: count, .. } => Some((count as usize).saturating_mul(2)),
            _ => None,
        }
    }

    /// First address and count in the request. FC 5 and 6 have the value in place of the count, FC 22 the mask of the
    /// kept bits.
    const fn head(&self) -> (u16, u16) {
        match *self {
            Self::ReadCoils { address, count }
            | Self::ReadDiscreteInputs { address, count }
            | Self::ReadHoldingRegisters { address, count }
            | Self::ReadInputRegisters { address, count }
            | Self::WriteCoils { address, count }
            | Self::WriteRegisters { address, count } => (address, count),
            Self::WriteCoil { address } | Self::WriteRegister { address } => (address, 0),
            Self::ReadWriteRegisters { read_address, read_count, .. } => (read_address, read_count),
            Self::MaskWriteRegister { address, mask } => (address, !mask),
        }
    }

    /// Writes the request's frame to the front of `out` and returns its length. `fill` writes the data into
    /// [`Self::written_len`] zeros; `None` if it has no data.
    pub(crate) fn encode(
        &self,
        slave: u8,
        out: &mut [u8; MAX_ADU],
        fill: impl FnOnce(&mut [u8]) -> bool,
    ) -> Option<usize> {
        let (address, count) = self.head();
        let ([a1, a0], [c1, c0]) = (address.to_be_bytes(), count.to_be_bytes());
        let (head, rest) = out.split_first_chunk_mut::<6>()?;
        *head = [slave, self.function(), a1, a0, c1, c0];
        let len = self.written_len();
        match *self {
            Self::WriteCoil { .. } => {
                let [.., high, _] = head;
                if !fill(slice::from_mut(high)) {
                    return None;
                }
                *high = if *high & 1 == 1 { COIL_ON } else { 0 };
            }
            Self::WriteRegister { .. } => {
                let value = head.last_chunk_mut::<2>()?;
                if !fill(value) {
                    return None;
                }
            }
            Self::WriteCoils { count, .. } => {
                let data = behind_count(rest, len)?;
                if !fill(data) {
                    return None;
                }
                if let Some(last) = data.last_mut() {
                    *last &= last_mask(count);
                }
            }
            Self::WriteRegisters { .. } => {
                let data = behind_count(rest, len)?;
                if !fill(data) {
                    return None;
                }
            }
            Self::ReadWriteRegisters { write_address, write_count, .. } => {
                let ([w1, w0], [n1, n0]) = (write_address.to_be_bytes(), write_count.to_be_bytes());
                let (write, rest) = rest.split_first_chunk_mut::<4>()?;
                *write = [w1, w0, n1, n0];
                if !fill(behind_count(rest, len)?) {
                    return None;
                }
            }
            Self::MaskWriteRegister { mask, .. } => {
                let bits = rest.first_chunk_mut::<2>()?;
                *bits = [0; 2];
                if !fill(bits) {
                    return None;
                }
                *bits = (u16::from_be_bytes(*bits) & mask).to_be_bytes();
            }
            _ => {}
        }
        seal(out, self.request_len().saturating_sub(2))
    }
}

/// Writes the byte count `len` and returns the zeroed space for the data after it.
fn behind_count(rest: &mut [u8], len: usize) -> Option<&mut [u8]> {
    let (byte_count, data) = rest.split_first_mut()?;
    // At most 246, because the counts are limited.
    *byte_count = len as u8;
    let data = data.get_mut(..len)?;
    data.fill(0);
    Some(data)
}

impl Operation {
    /// Whether a good reply to `self` could be mistaken for one to `other`, sent to the same slave. Replies of FC 5 and
    /// 6 contain the written value, which may differ; it is ignored here.
    pub(crate) fn is_answered_like(&self, other: &Self) -> bool {
        if self.function() != other.function() {
            return false;
        }
        match (self.reply_data_len(), other.reply_data_len()) {
            (Some(one), Some(other)) => one == other,
            _ => self.head() == other.head(),
        }
    }
}

/// What the reply to a request looks like.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Expected {
    slave: u8,
    function: u8,
    body: Body,
}

#[derive(Debug, Clone, Copy)]
enum Body {
    /// This many bytes of data after the byte count.
    Data(u8),
    /// The same bytes as in the request: four, or six for FC 22.
    Echo([u8; 6]),
}

/// Number of bytes after the function code that a reply without data repeats from the request.
const fn repeated_len(function: u8) -> usize {
    if function == function::MASK_WRITE_REGISTER { 6 } else { 4 }
}

/// How received bytes look to a master that waits for a reply.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Probe {
    /// Not the beginning of the reply.
    No,
    /// Possibly the beginning of the reply.
    Partial,
    /// The reply; its length.
    Reply(usize),
    /// The request is refused.
    Refused(Exception),
    /// The reply by head and length, but with a wrong CRC.
    Wrong,
}

impl Expected {
    /// The expected reply to the request in `frame`; `None` for a broadcast.
    pub(crate) fn of(operation: &Operation, frame: &[u8]) -> Option<Self> {
        let (&[slave, function], rest) = frame.split_first_chunk()?;
        if slave == BROADCAST {
            return None;
        }
        let body = match operation.reply_data_len() {
            // At most 250, because the counts are limited.
            Some(len) => Body::Data(len as u8),
            // If only four bytes are repeated, the other two are ignored; every request has a CRC there.
            None => Body::Echo(*rest.first_chunk()?),
        };
        Some(Self { slave, function, body })
    }

    /// The bytes after the function code that a reply without data must repeat.
    fn repeated<'a>(&self, head: &'a [u8; 6]) -> &'a [u8] {
        head.get(..repeated_len(self.function)).unwrap_or(head)
    }

    /// Length of the frame that `bytes` begin, unless it is an exception.
    pub(crate) fn len_of(&self, bytes: &[u8]) -> usize {
        match (bytes.get(1), self.body) {
            (Some(function), _) if *function == self.function | function::EXCEPTION_FLAG => REFUSAL_LEN,
            (_, Body::Data(len)) => usize::from(len).saturating_add(5),
            (_, Body::Echo(_)) => repeated_len(self.function).saturating_add(4),
        }
    }

    /// Judges a whole frame without its CRC: true for the reply, false for an exception, `None` for neither.
    pub(crate) fn judge(&self, frame: &[u8]) -> Option<bool> {
        let (&[slave, function], rest) = frame.split_first_chunk()?;
        if slave != self.slave {
            return None;
        }
        if function == self.function | function::EXCEPTION_FLAG {
            return (rest.len() == 1).then_some(false);
        }
        let fits = match self.body {
            Body::Data(len) => rest
                .split_first()
                .is_some_and(|(count, data)| *count == len && data.len() == usize::from(len)),
            Body::Echo(head) => rest == self.repeated(&head),
        };
        (function == self.function && fits).then_some(true)
    }

    /// Judges the frame that `bytes` begin.
    pub(crate) fn probe(&self, bytes: &[u8]) -> Probe {
        let [slave, rest @ ..] = bytes else { return Probe::Partial };
        if *slave != self.slave {
            return Probe::No;
        }
        let [function, rest @ ..] = rest else { return Probe::Partial };
        if *function == self.function | function::EXCEPTION_FLAG {
            return match (bytes.get(..5), rest) {
                (Some(frame), [code, ..]) if is_right(frame) => Probe::Refused(Exception::from_code(*code)),
                (Some(_), _) => Probe::Wrong,
                (None, _) => Probe::Partial,
            };
        }
        if *function != self.function {
            return Probe::No;
        }
        let (fits, len) = match self.body {
            Body::Data(len) => (rest.first().is_none_or(|count| *count == len), usize::from(len) + 5),
            Body::Echo(head) => {
                let head = self.repeated(&head);
                (rest.iter().zip(head).all(|(byte, wanted)| byte == wanted), head.len().saturating_add(4))
            }
        };
        match bytes.get(..len) {
            _ if !fits => Probe::No,
            None => Probe::Partial,
            Some(frame) if is_right(frame) => Probe::Reply(len),
            Some(_) => Probe::Wrong,
        }
    }
}

/// Length of an exception's frame.
pub(crate) const REFUSAL_LEN: usize = 5;

/// Length of the frame of an FC 22 request, and of its good reply.
const MASK_WRITE_LEN: usize = 10;

/// High byte of the value that switches a coil on.
const COIL_ON: u8 = 0xFF;
