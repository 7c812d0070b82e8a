//! The server's side of one connection (docs/wire/modbus.md section 5).
//!
//! In: a connection's bytes. Out: one answer for each request, from a [`RegisterBank`] that knows
//! the map. Any unit id is answered and echoed (D10).

use super::adu::{self, AduError, AduReader, HEADER_LEN, MAX_ADU, MAX_PDU};
use super::exception::Exception;
use super::pdu::{
    HEAD_LEN, MAX_READ_REGISTERS, READ_HEAD_LEN, Request, RequestHead, exception_pdu, function,
};
use super::values::{Coils, MAX_READ_COILS, Registers, last_mask, packed_len};

/// The registers behind a server.
///
/// The server has checked counts and that `address + count` does not pass 65536. A bank answers
/// [`Exception::IllegalDataAddress`] for anything outside its map or read-only, **before** it
/// changes anything: each call happens whole or not at all (D12).
pub trait RegisterBank {
    /// Writes `count` coils from `address` into `packed`, the first in the least significant bit of
    /// the first byte. `packed` is all zero and just long enough; bits beyond the last coil are
    /// cleared afterwards.
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

    /// Same as [`Self::read_coils`] for discrete inputs, FC 2. A bank without them has not this function.
    ///
    /// # Errors
    /// The exception to answer with.
    fn read_discrete(&self, _address: u16, _count: u16, _packed: &mut [u8]) -> Result<(), Exception> {
        Err(Exception::IllegalFunction)
    }

    /// Same as [`Self::read_holding`] for input registers, FC 4. A bank without them has not this
    /// function.
    ///
    /// # Errors
    /// The exception to answer with.
    fn read_input(&self, _address: u16, _words: &mut [[u8; 2]]) -> Result<(), Exception> {
        Err(Exception::IllegalFunction)
    }
}

/// The server's side of one connection.
#[derive(Debug, Clone, Default)]
pub struct Server {
    reader: AduReader,
}

impl Server {
    /// A server for a new connection.
    pub const fn new() -> Self {
        Self { reader: AduReader::new() }
    }

    /// Takes one request from the front of `bytes`, carries it out on `bank`, writes the answer to
    /// the front of `out` and returns its length. Call it until it returns `None`, which means that
    /// all of `bytes` has been taken.
    ///
    /// # Errors
    /// The connection must be closed (D10); the rest of its bytes is dropped.
    #[inline]
    pub fn receive<B: RegisterBank + ?Sized>(
        &mut self,
        bytes: &mut &[u8],
        bank: &mut B,
        out: &mut [u8; MAX_ADU],
    ) -> Option<Result<usize, AduError>> {
        let request = match self.reader.advance(bytes)? {
            Ok(place) => self.reader.adu(place),
            Err(error) => return Some(Err(error)),
        };
        let (header, body) = split_frame(out)?;
        let len = answer(request.pdu, bank, body);
        *header = adu::header(request.transaction, request.unit, len);
        Some(Ok(len.saturating_add(HEADER_LEN)))
    }

    /// Forgets a partial request, for a new connection.
    pub const fn reset(&mut self) {
        self.reader.reset();
    }
}

/// Carries out the request in `pdu`, writes the answer's PDU to `out` and returns its length.
///
/// For other framings of PDUs; [`Server`] calls it for each frame.
#[inline]
pub fn answer<B: RegisterBank + ?Sized>(pdu: &[u8], bank: &mut B, out: &mut [u8; MAX_PDU]) -> usize {
    match Request::parse(pdu).and_then(|request| carry_out(request, bank, out)) {
        Ok(len) => len,
        Err(Exception::IllegalFunction) => match read_inputs(pdu, bank, out) {
            Ok(len) => len,
            Err(exception) => refuse(pdu, exception, out),
        },
        Err(exception) => refuse(pdu, exception, out),
    }
}

/// FC 2 and 4, which a client of this project never asks.
#[cold]
fn read_inputs<B: RegisterBank + ?Sized>(
    pdu: &[u8],
    bank: &B,
    out: &mut [u8; MAX_PDU],
) -> Result<usize, Exception> {
    let head = pdu.first_chunk().map(RequestHead::from_bytes).ok_or(Exception::IllegalFunction)?;
    let RequestHead { function, address, count_or_value: count } = head;
    let max = match function {
        function::READ_DISCRETE => MAX_READ_COILS,
        function::READ_INPUT => MAX_READ_REGISTERS,
        _ => return Err(Exception::IllegalFunction),
    };
    // Whether there is the function is asked before its count and address.
    match function {
        function::READ_DISCRETE => bank.read_discrete(address, 0, &mut [])?,
        _ => bank.read_input(address, &mut [])?,
    }
    if pdu.len() != HEAD_LEN || count == 0 || count > max {
        return Err(Exception::IllegalDataValue);
    }
    check_end(address, count)?;
    let len = if function == function::READ_DISCRETE {
        let packed = read_answer(out, head, packed_len(count))?;
        packed.fill(0);
        bank.read_discrete(address, count, packed)?;
        if let Some(last) = packed.last_mut() {
            *last &= last_mask(count);
        }
        packed.len()
    } else {
        let bytes = read_answer(out, head, usize::from(count).saturating_mul(2))?;
        bank.read_input(address, bytes.as_chunks_mut().0)?;
        bytes.len()
    };
    Ok(len.saturating_add(READ_HEAD_LEN))
}

#[inline]
fn carry_out<B: RegisterBank + ?Sized>(
    request: Request<'_>,
    bank: &mut B,
    out: &mut [u8; MAX_PDU],
) -> Result<usize, Exception> {
    let head = request.head();
    match request {
        Request::ReadCoils { address, count } => {
            check_end(address, count)?;
            let packed = read_answer(out, head, packed_len(count))?;
            packed.fill(0);
            bank.read_coils(address, count, packed)?;
            if let Some(last) = packed.last_mut() {
                *last &= last_mask(count);
            }
            return Ok(packed.len().saturating_add(READ_HEAD_LEN));
        }
        Request::ReadHolding { address, count } => {
            check_end(address, count)?;
            let bytes = read_answer(out, head, usize::from(count).saturating_mul(2))?;
            bank.read_holding(address, bytes.as_chunks_mut().0)?;
            return Ok(bytes.len().saturating_add(READ_HEAD_LEN));
        }
        Request::WriteCoil { address, value } => {
            let coil = [u8::from(value)];
            bank.write_coils(address, Coils::new(&coil, 1).ok_or(Exception::DeviceFailure)?)?;
        }
        Request::WriteRegister { address, value } => {
            let word = value.to_be_bytes();
            bank.write_holding(address, Registers::new(&word).ok_or(Exception::DeviceFailure)?)?;
        }
        Request::WriteCoils { address, coils } => {
            check_end(address, coils.count())?;
            bank.write_coils(address, coils)?;
        }
        Request::WriteRegisters { address, registers } => {
            check_end(address, registers.count())?;
            bank.write_holding(address, registers)?;
        }
    }
    // Every write is answered by its first five bytes.
    *out.first_chunk_mut().ok_or(Exception::DeviceFailure)? = head.to_bytes();
    Ok(HEAD_LEN)
}

/// Function code and byte count of a read's answer; returns the place for the data.
#[inline]
fn read_answer(out: &mut [u8; MAX_PDU], head: RequestHead, len: usize) -> Result<&mut [u8], Exception> {
    let (answer_head, data) = out.split_first_chunk_mut().ok_or(Exception::DeviceFailure)?;
    // At most 250 bytes by the limits of the count.
    *answer_head = [head.function, len as u8];
    data.get_mut(..len).ok_or(Exception::DeviceFailure)
}

#[cold]
fn refuse(pdu: &[u8], exception: Exception, out: &mut [u8; MAX_PDU]) -> usize {
    let refusal = exception_pdu(pdu.first().copied().unwrap_or_default(), exception);
    if let Some(target) = out.first_chunk_mut() {
        *target = refusal;
    }
    refusal.len()
}

#[inline]
fn split_frame(out: &mut [u8; MAX_ADU]) -> Option<(&mut [u8; HEADER_LEN], &mut [u8; MAX_PDU])> {
    let (header, body) = out.split_first_chunk_mut()?;
    Some((header, body.first_chunk_mut()?))
}

/// Addresses are 16 bits: a run beyond the last one is outside every map.
#[inline]
fn check_end(address: u16, count: u16) -> Result<(), Exception> {
    let end = u32::from(address).wrapping_add(u32::from(count));
    if end <= ADDRESSES { Ok(()) } else { Err(Exception::IllegalDataAddress) }
}

const ADDRESSES: u32 = 0x1_0000;
