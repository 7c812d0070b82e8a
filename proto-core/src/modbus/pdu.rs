//! Requests and responses of the six function codes (docs/wire/modbus.md section 3).
//!
//! In: PDUs or values. Out: the other. Does not know connections, transactions or the map.

use core::fmt;

pub use super::adu::MAX_PDU;
use super::exception::Exception;
use super::parts::{COIL_OFF, COIL_ON, NO_COUNT, Operands, RequestParts, coil_value, copy_cleared, in_limit};
pub use super::parts::{PduEncodeError, RequestHead};
pub use super::values::MAX_READ_COILS;
use super::values::{Coils, Registers, packed_len};

/// Most registers in one FC 3 request.
pub const MAX_READ_REGISTERS: u16 = 0x007D;
/// Most coils in one FC 15 request.
pub const MAX_WRITE_COILS: u16 = 0x07B0;
/// Most registers in one FC 16 request.
pub const MAX_WRITE_REGISTERS: u16 = 0x007B;
/// Most registers that one FC 23 request writes; it reads at most [`MAX_READ_REGISTERS`].
pub const MAX_READ_WRITE_REGISTERS: u16 = 0x0079;

/// The function codes. [`Request`] has those of the controller: 1, 3, 5, 6, 15 and 16.
pub mod function {
    /// FC 1, read coils.
    pub const READ_COILS: u8 = 0x01;
    /// FC 2, read discrete inputs.
    pub const READ_DISCRETE: u8 = 0x02;
    /// FC 3, read holding registers.
    pub const READ_HOLDING: u8 = 0x03;
    /// FC 4, read input registers.
    pub const READ_INPUT: u8 = 0x04;
    /// FC 5, write one coil.
    pub const WRITE_COIL: u8 = 0x05;
    /// FC 6, write one register.
    pub const WRITE_REGISTER: u8 = 0x06;
    /// FC 15, write several coils.
    pub const WRITE_COILS: u8 = 0x0F;
    /// FC 16, write several registers.
    pub const WRITE_REGISTERS: u8 = 0x10;
    /// FC 22, write bits of one register.
    pub const MASK_WRITE_REGISTER: u8 = 0x16;
    /// FC 23, write registers, then read registers.
    pub const READ_WRITE_REGISTERS: u8 = 0x17;
    /// Set in the function code of an exception response.
    pub const EXCEPTION_FLAG: u8 = 0x80;
}

/// A client's request.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum Request<'a> {
    /// FC 1.
    ReadCoils {
        /// First coil.
        address: u16,
        /// 1..=2000.
        count: u16,
    },
    /// FC 3.
    ReadHolding {
        /// First register.
        address: u16,
        /// 1..=125.
        count: u16,
    },
    /// FC 5.
    WriteCoil {
        /// The coil.
        address: u16,
        /// On or off.
        value: bool,
    },
    /// FC 6.
    WriteRegister {
        /// The register.
        address: u16,
        /// Its new value.
        value: u16,
    },
    /// FC 15.
    WriteCoils {
        /// First coil.
        address: u16,
        /// 1..=1968 coils.
        coils: Coils<'a>,
    },
    /// FC 16.
    WriteRegisters {
        /// First register.
        address: u16,
        /// 1..=123 registers.
        registers: Registers<'a>,
    },
}

/// A server's answer to a request that it executed.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum Response<'a> {
    /// FC 1: the requested coils.
    Coils(Coils<'a>),
    /// FC 3: the requested registers.
    Registers(Registers<'a>),
    /// FC 5: an echo of the request.
    WroteCoil {
        /// The coil.
        address: u16,
        /// Its new value.
        value: bool,
    },
    /// FC 6: an echo of the request.
    WroteRegister {
        /// The register.
        address: u16,
        /// Its new value.
        value: u16,
    },
    /// FC 15.
    WroteCoils {
        /// First coil.
        address: u16,
        /// Number of coils written.
        count: u16,
    },
    /// FC 16.
    WroteRegisters {
        /// First register.
        address: u16,
        /// Number of registers written.
        count: u16,
    },
}

/// Why bytes are not an answer to the request.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
#[non_exhaustive]
pub enum ResponseError {
    /// The answer has another function code.
    Function {
        /// The request's function code.
        expected: u8,
        /// The function code in the answer.
        received: u8,
    },
    /// More or fewer bytes than the answer must have.
    Length {
        /// The length that the answer must have.
        expected: usize,
        /// The length of the answer.
        received: usize,
    },
    /// The byte count of a read does not fit the requested count.
    ByteCount {
        /// The number of bytes requested.
        expected: u8,
        /// The byte count in the answer.
        received: u8,
    },
    /// The echo of a write has another address, count or value.
    Echo {
        /// The request.
        expected: RequestHead,
        /// The echo.
        received: RequestHead,
    },
}

impl fmt::Display for ResponseError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Function { expected, received } => {
                write!(f, "the answer has function 0x{received:02x} instead of 0x{expected:02x}")
            }
            Self::Length { expected, received } => {
                write!(f, "the answer has {received} bytes instead of {expected}")
            }
            Self::ByteCount { expected, received } => {
                write!(f, "the answer announces {received} bytes of data instead of {expected}")
            }
            Self::Echo { expected, received } => write!(
                f,
                "the request writes 0x{1:04x} to address {0}, the answer echoes 0x{3:04x} to address {2}",
                expected.address, expected.count_or_value, received.address, received.count_or_value
            ),
        }
    }
}

impl core::error::Error for ResponseError {}

impl<'a> Request<'a> {
    /// Parses a request, as a server does (D10).
    ///
    /// # Errors
    /// The exception to answer with: 01 for another function code; 03 for a count of 0 or over the limit, an FC 5 value
    /// other than 0x0000 and 0xFF00, or a PDU whose length disagrees with its function or byte count.
    pub fn parse(pdu: &'a [u8]) -> Result<Self, Exception> {
        let (&function, data) = pdu.split_first().ok_or(Exception::IllegalFunction)?;
        let Some((operands, rest)) = data.split_first_chunk() else { return Err(refusal(function)) };
        let operands = Operands::from_bytes(operands);
        let (address, count_or_value) = (operands.address(), operands.count_or_value());
        let request = match (function, rest) {
            (function::READ_COILS, []) if in_limit(count_or_value, MAX_READ_COILS) => {
                Self::ReadCoils { address, count: count_or_value }
            }
            (function::READ_HOLDING, []) if in_limit(count_or_value, MAX_READ_REGISTERS) => {
                Self::ReadHolding { address, count: count_or_value }
            }
            (function::WRITE_COIL, []) if count_or_value == COIL_OFF || count_or_value == COIL_ON => {
                Self::WriteCoil { address, value: count_or_value == COIL_ON }
            }
            (function::WRITE_REGISTER, []) => Self::WriteRegister { address, value: count_or_value },
            (function::WRITE_COILS, [byte_count, packed @ ..])
                if count_or_value <= MAX_WRITE_COILS && usize::from(*byte_count) == packed.len() =>
            {
                match Coils::exact(packed, count_or_value) {
                    Some(coils) => Self::WriteCoils { address, coils },
                    None => return Err(refusal(function)),
                }
            }
            (function::WRITE_REGISTERS, [byte_count, bytes @ ..])
                if count_or_value <= MAX_WRITE_REGISTERS && usize::from(*byte_count) == bytes.len() =>
            {
                match Registers::exact(bytes, count_or_value) {
                    Some(registers) => Self::WriteRegisters { address, registers },
                    None => return Err(refusal(function)),
                }
            }
            _ => return Err(refusal(function)),
        };
        Ok(request)
    }

    /// Function code, address, and count or value.
    pub fn head(&self) -> RequestHead {
        let parts = self.parts();
        parts.operands.of(parts.function)
    }

    /// Length of the request's PDU; 5..=252 for a request that can be sent.
    pub fn encoded_len(&self) -> usize {
        self.parts().encoded_len()
    }

    /// Writes the request's PDU to the front of `out` and returns its length.
    ///
    /// # Errors
    /// The count is outside the function's limits, or `out` is too short; nothing is written then.
    pub fn encode(&self, out: &mut [u8]) -> Result<usize, PduEncodeError> {
        self.parts().encode(out)
    }

    pub(super) fn parts(&self) -> RequestParts<'a> {
        let single = RequestParts::new;
        match *self {
            Self::ReadCoils { address, count } => RequestParts {
                answer_len: packed_len(count).wrapping_add(1),
                ..single(function::READ_COILS, address, count, MAX_READ_COILS)
            },
            Self::ReadHolding { address, count } => RequestParts {
                answer_len: usize::from(count).wrapping_mul(2).wrapping_add(1),
                ..single(function::READ_HOLDING, address, count, MAX_READ_REGISTERS)
            },
            Self::WriteCoil { address, value } => {
                single(function::WRITE_COIL, address, coil_value(value), NO_COUNT)
            }
            Self::WriteRegister { address, value } => {
                single(function::WRITE_REGISTER, address, value, NO_COUNT)
            }
            Self::WriteCoils { address, coils } => RequestParts {
                data: Some((coils.packed(), coils.unused())),
                ..single(function::WRITE_COILS, address, coils.count(), MAX_WRITE_COILS)
            },
            Self::WriteRegisters { address, registers } => RequestParts {
                data: Some((registers.as_be_bytes(), 0)),
                ..single(function::WRITE_REGISTERS, address, registers.count(), MAX_WRITE_REGISTERS)
            },
        }
    }
}

impl<'a> Response<'a> {
    /// The answer to an executed request of `function`. `data` are the bytes after its function code; `None` if they do
    /// not have exactly the expected length.
    pub(super) fn expected(function: u8, operands: Operands, data: &'a [u8]) -> Option<Self> {
        let (address, count_or_value) = (operands.address(), operands.count_or_value());
        // Ranges, so that one comparison tells reads from writes; `function` is valid here.
        match function {
            0..=function::READ_COILS => {
                let (byte_count, packed) = data.split_first()?;
                let coils = Coils::of_request(packed, count_or_value);
                (usize::from(*byte_count) == packed.len()).then_some(Self::Coils(coils))
            }
            function::READ_DISCRETE..=function::READ_HOLDING => {
                let (byte_count, bytes) = data.split_first()?;
                let registers = Registers::of_request(bytes);
                (usize::from(*byte_count) == bytes.len()).then_some(Self::Registers(registers))
            }
            _ if Operands::from_bytes(data.try_into().ok()?) != operands => None,
            function::WRITE_COIL => Some(Self::WroteCoil { address, value: count_or_value != COIL_OFF }),
            function::WRITE_REGISTER => Some(Self::WroteRegister { address, value: count_or_value }),
            function::WRITE_COILS => Some(Self::WroteCoils { address, count: count_or_value }),
            _ => Some(Self::WroteRegisters { address, count: count_or_value }),
        }
    }

    /// Parses the answer to `request`: a response, or the server's exception.
    ///
    /// # Errors
    /// [`ResponseError`] if the bytes do not answer that request.
    pub fn parse(request: RequestHead, pdu: &'a [u8]) -> Result<Result<Self, Exception>, ResponseError> {
        match pdu.split_first() {
            Some((&received, data)) => Self::parse_data(request, received, data),
            None => Err(ResponseError::Length { expected: HEAD_LEN, received: 0 }),
        }
    }

    /// Like [`Self::parse`], for a function code and the bytes after it.
    pub(super) fn parse_data(
        request: RequestHead,
        received: u8,
        data: &'a [u8],
    ) -> Result<Result<Self, Exception>, ResponseError> {
        let RequestHead { function, address, count_or_value } = request;
        if received != function {
            return parse_exception(function, received, data).map(Err);
        }
        match function {
            function::READ_COILS => {
                let packed = counted(data, packed_len(count_or_value))?;
                match Coils::exact(packed, count_or_value) {
                    Some(coils) => Ok(Ok(Self::Coils(coils))),
                    None => Err(unanswerable(data)),
                }
            }
            function::READ_HOLDING => {
                let bytes = counted(data, usize::from(count_or_value).saturating_mul(2))?;
                match Registers::new(bytes) {
                    Some(registers) => Ok(Ok(Self::Registers(registers))),
                    None => Err(unanswerable(data)),
                }
            }
            _ => {
                let Ok(echo) = data.try_into().map(Operands::from_bytes) else {
                    return Err(unanswerable(data));
                };
                let echo = echo.of(function);
                if echo != request {
                    return Err(ResponseError::Echo { expected: request, received: echo });
                }
                Ok(Ok(match function {
                    function::WRITE_COIL => Self::WroteCoil { address, value: count_or_value != COIL_OFF },
                    function::WRITE_REGISTER => Self::WroteRegister { address, value: count_or_value },
                    function::WRITE_COILS => Self::WroteCoils { address, count: count_or_value },
                    _ => Self::WroteRegisters { address, count: count_or_value },
                }))
            }
        }
    }

    /// Length of the response's PDU, 3..=252.
    pub const fn encoded_len(&self) -> usize {
        match self {
            Self::Coils(coils) => coils.packed().len().saturating_add(READ_HEAD_LEN),
            Self::Registers(registers) => registers.as_be_bytes().len().saturating_add(READ_HEAD_LEN),
            _ => HEAD_LEN,
        }
    }

    /// Writes the response's PDU to the front of `out` and returns its length.
    ///
    /// # Errors
    /// `out` is too short; nothing is written then.
    pub fn encode(&self, out: &mut [u8]) -> Result<usize, PduEncodeError> {
        let (needed, available) = (self.encoded_len(), out.len());
        let no_space = PduEncodeError::NoSpace { needed, available };
        let out = out.get_mut(..needed).ok_or(no_space)?;
        let (function, address, count_or_value) = match *self {
            Self::Coils(coils) => {
                if let [function, byte_count, data @ ..] = out {
                    (*function, *byte_count) = (function::READ_COILS, data.len() as u8);
                    copy_cleared(coils.packed(), coils.unused(), data);
                }
                return Ok(needed);
            }
            Self::Registers(registers) => {
                if let [function, byte_count, data @ ..] = out {
                    (*function, *byte_count) = (function::READ_HOLDING, data.len() as u8);
                    copy_cleared(registers.as_be_bytes(), 0, data);
                }
                return Ok(needed);
            }
            Self::WroteCoil { address, value } => (function::WRITE_COIL, address, coil_value(value)),
            Self::WroteRegister { address, value } => (function::WRITE_REGISTER, address, value),
            Self::WroteCoils { address, count } => (function::WRITE_COILS, address, count),
            Self::WroteRegisters { address, count } => (function::WRITE_REGISTERS, address, count),
        };
        *out.first_chunk_mut().ok_or(no_space)? =
            RequestHead { function, address, count_or_value }.to_bytes();
        Ok(needed)
    }
}

impl RequestHead {
    pub(super) const fn to_bytes(self) -> [u8; HEAD_LEN] {
        let ([a1, a0], [c1, c0]) = (self.address.to_be_bytes(), self.count_or_value.to_be_bytes());
        [self.function, a1, a0, c1, c0]
    }
}

/// The exception response to a request of `function`.
pub fn exception_pdu(function: u8, exception: Exception) -> [u8; 2] {
    [function | function::EXCEPTION_FLAG, exception.code()]
}

/// The error for an echo of the wrong length. Also for a read with an invalid count, which has no valid answer.
fn unanswerable(data: &[u8]) -> ResponseError {
    ResponseError::Length { expected: HEAD_LEN, received: data.len().saturating_add(1) }
}

fn parse_exception(function: u8, received: u8, data: &[u8]) -> Result<Exception, ResponseError> {
    match data {
        _ if received != function | function::EXCEPTION_FLAG => {
            Err(ResponseError::Function { expected: function, received })
        }
        [code] => Ok(Exception::from_code(*code)),
        _ => Err(ResponseError::Length { expected: 2, received: data.len().saturating_add(1) }),
    }
}

/// The data of a read's answer. `data` is everything after the function code.
fn counted(data: &[u8], expected: usize) -> Result<&[u8], ResponseError> {
    match data.split_first() {
        Some((byte_count, _)) if usize::from(*byte_count) != expected => {
            Err(ResponseError::ByteCount { expected: expected as u8, received: *byte_count })
        }
        Some((_, bytes)) if bytes.len() == expected => Ok(bytes),
        _ => Err(ResponseError::Length {
            expected: expected.saturating_add(READ_HEAD_LEN),
            received: data.len().saturating_add(1),
        }),
    }
}

/// The exception for a request that cannot be parsed: 03 if the function is known, else 01.
pub(super) fn refusal(function: u8) -> Exception {
    match function {
        function::READ_COILS
        | function::READ_HOLDING
        | function::WRITE_COIL
        | function::WRITE_REGISTER
        | function::WRITE_COILS
        | function::WRITE_REGISTERS => Exception::IllegalDataValue,
        _ => Exception::IllegalFunction,
    }
}

/// Length of function code and operands.
pub(super) const HEAD_LEN: usize = 5;
/// Length of the function code and byte count in a read's answer.
pub(super) const READ_HEAD_LEN: usize = 2;
