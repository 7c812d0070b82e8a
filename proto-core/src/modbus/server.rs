//! The server side of one connection (docs/wire/modbus.md section 5).
//!
//! In: a connection's bytes. Out: one answer for each request, from a [`RegisterBank`] that knows the map. Answers any
//! unit id and echoes it (D10).

use super::adu::{AduError, AduFrame, AduReader, FRONT_LEN, MAX_ADU, MAX_PDU};
use super::exception::Exception;
use super::parts::{COIL_OFF, COIL_ON, OPERANDS_LEN, Operands, in_limit};
use super::pdu::{
    MAX_READ_REGISTERS, MAX_WRITE_COILS, MAX_WRITE_REGISTERS, exception_pdu, function, refusal,
};
use super::values::{Coils, MAX_READ_COILS, Registers, last_mask, packed_len};

/// The registers behind a server.
///
/// The server has checked the count and that `address + count` is at most 65536. A bank returns
/// [`Exception::IllegalDataAddress`] for addresses that are outside its map or read-only **before** it changes
/// anything: each call succeeds or fails as a whole (D12).
pub trait RegisterBank {
    /// Writes `count` coils from `address` on into `packed`, the first in the least significant bit of the first byte.
    /// `packed` is all zero and just long enough; bits beyond the last coil are cleared afterwards.
    ///
    /// # Errors
    /// The exception to answer with.
    fn read_coils(&self, address: u16, count: u16, packed: &mut [u8]) -> Result<(), Exception>;

    /// Writes the coils from `address` on.
    ///
    /// # Errors
    /// The exception to answer with; nothing was changed.
    fn write_coils(&mut self, address: u16, coils: Coils<'_>) -> Result<(), Exception>;

    /// Reads the registers from `address` on into `words`, each big-endian, until `words` is full.
    ///
    /// # Errors
    /// The exception to answer with.
    fn read_holding(&self, address: u16, words: &mut [[u8; 2]]) -> Result<(), Exception>;

    /// Writes the registers from `address` on.
    ///
    /// # Errors
    /// The exception to answer with; nothing was changed.
    fn write_holding(&mut self, address: u16, registers: Registers<'_>) -> Result<(), Exception>;

    /// FC 22: writes the register at `address`. Bits in `keep` stay unchanged; the others are taken from `value`, where
    /// the bits in `keep` are 0. By default the function is not supported.
    ///
    /// # Errors
    /// The exception to answer with; nothing was changed.
    fn mask_holding(&mut self, _address: u16, _keep: u16, _value: u16) -> Result<(), Exception> {
        Err(Exception::IllegalFunction)
    }

    /// Same as [`Self::read_coils`] for discrete inputs, FC 2. By default the function is not supported.
    ///
    /// # Errors
    /// The exception to answer with.
    fn read_discrete(&self, _address: u16, _count: u16, _packed: &mut [u8]) -> Result<(), Exception> {
        Err(Exception::IllegalFunction)
    }

    /// Same as [`Self::read_holding`] for input registers, FC 4. By default the function is not supported.
    ///
    /// # Errors
    /// The exception to answer with.
    fn read_input(&self, _address: u16, _words: &mut [[u8; 2]]) -> Result<(), Exception> {
        Err(Exception::IllegalFunction)
    }
}

/// The server side of one connection.
#[derive(Debug, Clone, Default)]
pub struct Server {
    reader: AduReader,
}

impl Server {
    /// A server for a new connection.
    pub const fn new() -> Self {
        Self { reader: AduReader::new() }
    }

    /// Takes one request from the front of `bytes`, executes it on `bank`, writes the answer to the front of `out` and
    /// returns its length. Call it until it returns `None`: then all of `bytes` is taken.
    ///
    /// # Errors
    /// The connection must be closed (D10); the rest of `bytes` is dropped.
    pub fn receive<B: RegisterBank + ?Sized>(
        &mut self,
        bytes: &mut &[u8],
        bank: &mut B,
        out: &mut [u8; MAX_ADU],
    ) -> Option<Result<usize, AduError>> {
        let AduFrame { front, data } = match self.reader.take(bytes) {
            Some(frame) => frame,
            None => match self.reader.next_buffered(bytes)? {
                Ok(front) => AduFrame { front, data: self.reader.data(front) },
                Err(error) => return Some(Err(error)),
            },
        };
        let (target, body) = out.split_first_chunk_mut()?;
        let body = body.first_chunk_mut()?;
        let (front, len) = match carry_out(front.function(), data, bank, body) {
            Ok(len) => (front, len),
            Err(exception) => {
                let answer = others(front.function(), data, exception, bank, body);
                (front.with_function(answer.function), answer.data_len)
            }
        };
        *target = front.resized(data.len(), len).to_bytes();
        Some(Ok(len.wrapping_add(FRONT_LEN)))
    }

    /// Drops a partial request, for a new connection.
    pub const fn reset(&mut self) {
        self.reader.reset();
    }
}

/// Executes the request in `pdu`, writes the answer's PDU to `out` and returns its length. [`Server`] calls it for each
/// frame; it also serves other framings.
pub fn answer<B: RegisterBank + ?Sized>(pdu: &[u8], bank: &mut B, out: &mut [u8; MAX_PDU]) -> usize {
    let (&asked, data) = pdu.split_first().unwrap_or((&0, &[]));
    let Some((function, body)) = out.split_first_mut() else { return 0 };
    let Some(body) = body.first_chunk_mut() else { return 0 };
    let answer = match carry_out(asked, data, bank, body) {
        Ok(data_len) => ResponseStart { function: asked, data_len },
        Err(exception) => others(asked, data, exception, bank, body),
    };
    *function = answer.function;
    answer.data_len.wrapping_add(1)
}

/// Front of an answer, and the number of bytes after it.
struct ResponseStart {
    function: u8,
    data_len: usize,
}

/// The bytes after a function code.
type ResponseBody = [u8; MAX_PDU - 1];

/// Handles the other functions, and builds exceptions.
fn others<B: RegisterBank + ?Sized>(
    function: u8,
    data: &[u8],
    exception: Exception,
    bank: &mut B,
    out: &mut ResponseBody,
) -> ResponseStart {
    let answer = match exception {
        Exception::IllegalFunction if function == function::MASK_WRITE_REGISTER => {
            write_masked(data, bank, out)
        }
        Exception::IllegalFunction => read_inputs(function, data, bank, out),
        _ => Err(exception),
    };
    let exception = match answer {
        Ok(data_len) => return ResponseStart { function, data_len },
        Err(exception) => exception,
    };
    let [function, code] = exception_pdu(function, exception);
    let [first, ..] = out;
    *first = code;
    ResponseStart { function, data_len: 1 }
}

/// FC 22: the answer repeats the request's data. Another length is refused.
fn write_masked<B: RegisterBank + ?Sized>(
    data: &[u8],
    bank: &mut B,
    out: &mut ResponseBody,
) -> Result<usize, Exception> {
    let request: &[u8; 6] = data.try_into().map_err(|_| Exception::IllegalFunction)?;
    let [a1, a0, k1, k0, v1, v0] = *request;
    let [address, keep, value] = [[a1, a0], [k1, k0], [v1, v0]].map(u16::from_be_bytes);
    bank.mask_holding(address, keep, value & !keep)?;
    *out.first_chunk_mut().ok_or(Exception::DeviceFailure)? = *request;
    Ok(request.len())
}

/// FC 2 and 4, which this project's client never sends.
fn read_inputs<B: RegisterBank + ?Sized>(
    function: u8,
    data: &[u8],
    bank: &B,
    out: &mut ResponseBody,
) -> Result<usize, Exception> {
    let Some((operands, more)) = data.split_first_chunk() else { return Err(Exception::IllegalFunction) };
    let operands = Operands::from_bytes(operands);
    let (address, count) = (operands.address(), operands.count_or_value());
    let max = match function {
        function::READ_DISCRETE => MAX_READ_COILS,
        function::READ_INPUT => MAX_READ_REGISTERS,
        _ => return Err(Exception::IllegalFunction),
    };
    // The function is checked before count and address.
    match function {
        function::READ_DISCRETE => bank.read_discrete(address, 0, &mut [])?,
        _ => bank.read_input(address, &mut [])?,
    }
    if !more.is_empty() || !in_limit(count, max) {
        return Err(Exception::IllegalDataValue);
    }
    check_end(address, count)?;
    match function {
        function::READ_DISCRETE => read_bits(out, count, |packed| bank.read_discrete(address, count, packed)),
        _ => read_words(out, count, |words| bank.read_input(address, words)),
    }
}

/// Executes a request. `data` are its bytes after the function code; those of the answer are written to `out`, and
/// their number is returned.
// Does not build a `Request`, which would be stored and taken apart again. Branches on the length first, which is
// checked once for both reads and for both multiple writes.
fn carry_out<B: RegisterBank + ?Sized>(
    function: u8,
    data: &[u8],
    bank: &mut B,
    out: &mut ResponseBody,
) -> Result<usize, Exception> {
    let Some((operands, more)) = data.split_first_chunk() else { return Err(refusal(function)) };
    let operands = Operands::from_bytes(operands);
    let (address, count) = (operands.address(), operands.count_or_value());
    if let Some((byte_count, data)) = more.split_first() {
        if usize::from(*byte_count) != data.len() {
            return Err(refusal(function));
        }
        if function == function::WRITE_COILS && in_limit(count, MAX_WRITE_COILS) {
            let coils = Coils::exact(data, count).ok_or(Exception::IllegalDataValue)?;
            check_end(address, count)?;
            bank.write_coils(address, coils)?;
        } else if function == function::WRITE_REGISTERS && in_limit(count, MAX_WRITE_REGISTERS) {
            let registers = Registers::exact(data, count).ok_or(Exception::IllegalDataValue)?;
            check_end(address, count)?;
            bank.write_holding(address, registers)?;
        } else {
            return Err(refusal(function));
        }
    } else if function == function::READ_HOLDING && in_limit(count, MAX_READ_REGISTERS) {
        check_end(address, count)?;
        return read_words(out, count, |words| bank.read_holding(address, words));
    } else if function == function::READ_COILS && in_limit(count, MAX_READ_COILS) {
        check_end(address, count)?;
        return read_bits(out, count, |packed| bank.read_coils(address, count, packed));
    } else {
        write_one(function, operands, bank)?;
    }
    // Every write is answered with its operands.
    *out.first_chunk_mut().ok_or(Exception::DeviceFailure)? = operands.to_bytes();
    Ok(OPERANDS_LEN)
}

/// FC 5 and 6.
fn write_one<B: RegisterBank + ?Sized>(
    function: u8,
    operands: Operands,
    bank: &mut B,
) -> Result<(), Exception> {
    let (address, value) = (operands.address(), operands.count_or_value());
    match function {
        function::WRITE_COIL if value == COIL_OFF || value == COIL_ON => {
            let coil = [u8::from(value == COIL_ON)];
            bank.write_coils(address, Coils::new(&coil, 1).ok_or(Exception::DeviceFailure)?)
        }
        function::WRITE_REGISTER => {
            let word = value.to_be_bytes();
            bank.write_holding(address, Registers::new(&word).ok_or(Exception::DeviceFailure)?)
        }
        _ => Err(refusal(function)),
    }
}

/// Writes byte count and packed bits of an answer and returns their length. `read` gets the bits cleared.
fn read_bits(
    out: &mut ResponseBody,
    count: u16,
    read: impl FnOnce(&mut [u8]) -> Result<(), Exception>,
) -> Result<usize, Exception> {
    let packed = read_answer(out, packed_len(count))?;
    packed.fill(0);
    read(packed)?;
    if let Some(last) = packed.last_mut() {
        *last &= last_mask(count);
    }
    Ok(packed.len().saturating_add(1))
}

/// Writes byte count and registers of an answer and returns their length.
fn read_words(
    out: &mut ResponseBody,
    count: u16,
    read: impl FnOnce(&mut [[u8; 2]]) -> Result<(), Exception>,
) -> Result<usize, Exception> {
    let bytes = read_answer(out, usize::from(count).saturating_mul(2))?;
    read(bytes.as_chunks_mut().0)?;
    Ok(bytes.len().saturating_add(1))
}

/// Writes the byte count of a read's answer and returns the space for the data.
fn read_answer(out: &mut ResponseBody, len: usize) -> Result<&mut [u8], Exception> {
    let (byte_count, data) = out.split_first_mut().ok_or(Exception::DeviceFailure)?;
    // At most 250 bytes, because the count is limited.
    *byte_count = len as u8;
    data.get_mut(..len).ok_or(Exception::DeviceFailure)
}

/// Addresses have 16 bits: a run that exceeds them is outside every map.
fn check_end(address: u16, count: u16) -> Result<(), Exception> {
    let end = u32::from(address).wrapping_add(u32::from(count));
    if end <= ADDRESSES { Ok(()) } else { Err(Exception::IllegalDataAddress) }
}

const ADDRESSES: u32 = 0x1_0000;
