//! The client side of one connection, with one transaction in flight (docs/wire/modbus.md section 6).
//!
//! In: a request to send, then the connection's bytes. Out: the request's frame, then its answer. Does not know time:
//! the caller decides when an answer is overdue and calls [`Client::abort`]. A late answer is recognised by its
//! transaction id, counted and skipped.

use core::fmt;

use super::adu::{AduError, AduFrame, AduReader, FRONT_LEN, Front, HEADER_LEN};
use super::exception::Exception;
use super::parts::{OPERANDS_LEN, Operands, RequestParts, copy_cleared};
use super::pdu::{PduEncodeError, Request, RequestHead, Response, ResponseError};

/// The client side of one connection.
#[derive(Debug, Clone)]
pub struct Client {
    reader: AduReader,
    in_flight: bool,
    /// Front of a good answer to the newest request, in flight or not.
    answer: Front,
    /// Bytes of data in that answer.
    answer_len: u16,
    /// Address, and count or value of the newest request.
    operands: Operands,
    stale: u32,
}

/// An event in the received bytes.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum ClientEvent<'a> {
    /// The answer to a request that was executed.
    Response(Response<'a>),
    /// The server refused the request; the connection is fine.
    Exception(Exception),
    /// The server violated the protocol: the connection must be closed. A request in flight has ended, and the rest of
    /// the chunk is dropped.
    Violation(Violation),
}

/// How a server broke the protocol.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
#[non_exhaustive]
pub enum Violation {
    /// A header after which the next frame can no longer be found.
    Header(AduError),
    /// An answer to a request that was never sent.
    Transaction {
        /// Id of the newest request.
        newest: u16,
        /// The id in the answer.
        received: u16,
    },
    /// An answer from another unit.
    Unit {
        /// The unit of the request.
        expected: u8,
        /// The unit in the answer.
        received: u8,
    },
    /// A PDU that does not answer the request.
    Response(ResponseError),
}

impl fmt::Display for Violation {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Header(error) => error.fmt(f),
            Self::Transaction { newest, received } => {
                write!(f, "an answer to transaction {received}, but the newest request is {newest}")
            }
            Self::Unit { expected, received } => {
                write!(f, "an answer from unit {received}, but the request was for unit {expected}")
            }
            Self::Response(error) => error.fmt(f),
        }
    }
}

impl core::error::Error for Violation {}

/// Why a request was not started.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
#[non_exhaustive]
pub enum StartError {
    /// Another request is in flight.
    Busy,
    /// The request cannot be encoded.
    Encode(PduEncodeError),
}

impl fmt::Display for StartError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Busy => f.write_str("another Modbus request is in flight"),
            Self::Encode(error) => error.fmt(f),
        }
    }
}

impl core::error::Error for StartError {}

impl Client {
    /// A client for a new connection to the server's unit id `unit`.
    pub const fn new(unit: u8) -> Self {
        let (answer, operands) = (Front::first(unit), Operands::new(0, 0));
        Self { reader: AduReader::new(), in_flight: false, answer, answer_len: 0, operands, stale: 0 }
    }

    /// Whether a request is in flight.
    pub const fn busy(&self) -> bool {
        self.in_flight
    }

    /// Function code, address and count or value of the request in flight.
    pub const fn in_flight(&self) -> Option<RequestHead> {
        if self.in_flight { Some(self.request()) } else { None }
    }

    /// The newest request, in flight or not.
    const fn request(&self) -> RequestHead {
        self.operands.of(self.answer.function())
    }

    /// Number of answers that arrived after their request was given up.
    pub const fn stale_answers(&self) -> u32 {
        self.stale
    }

    /// Writes the request's frame to the front of `out` and returns its length. The request is then in flight.
    ///
    /// # Errors
    /// Nothing was written or changed: a request is in flight, the count is outside the function's limits, or `out` is
    /// too short (260 bytes are always enough).
    pub fn start(&mut self, request: Request<'_>, out: &mut [u8]) -> Result<usize, StartError> {
        if self.in_flight {
            return Err(StartError::Busy);
        }
        let parts = request.parts();
        // Tells reads from writes first, so a request of a kind that is known at compile time needs no other checks.
        match parts.data {
            None => {
                parts.check_count().map_err(StartError::Encode)?;
                let available = out.len();
                let heads = out.first_chunk_mut().ok_or_else(|| no_space(&parts, available))?;
                self.begin(&parts, heads, OPERANDS_LEN, parts.answer_len);
                Ok(HEADS_LEN)
            }
            Some((data, unused)) => {
                parts.check_count().map_err(StartError::Encode)?;
                let no_space = no_space(&parts, out.len());
                let (heads, rest) = out.split_first_chunk_mut().ok_or(no_space)?;
                let (byte_count, rest) = rest.split_first_mut().ok_or(no_space)?;
                let target = rest.get_mut(..data.len()).ok_or(no_space)?;
                // At most 246 bytes by the limits of the count.
                *byte_count = data.len() as u8;
                copy_cleared(data, unused, target);
                self.begin(&parts, heads, parts.data_len(), OPERANDS_LEN);
                Ok(parts.data_len().wrapping_add(FRONT_LEN))
            }
        }
    }

    /// Writes the part of a request's frame before its data, and expects the answer.
    fn begin(
        &mut self,
        parts: &RequestParts<'_>,
        heads: &mut [u8; HEADS_LEN],
        data_len: usize,
        answer_len: usize,
    ) {
        let newest = self.answer.next(parts.function);
        if let Some((front, rest)) = heads.split_first_chunk_mut() {
            *front = newest.carrying(data_len).to_bytes();
            if let Some(operands) = rest.first_chunk_mut() {
                *operands = parts.operands.to_bytes();
            }
        }
        self.answer = newest.carrying(answer_len);
        self.answer_len = answer_len as u16;
        self.operands = parts.operands;
        self.in_flight = true;
    }

    /// Takes bytes from the front of `bytes` up to the end of the next answer and returns the event. Call it until it
    /// returns `None`: then all of `bytes` is taken.
    pub fn receive<'s, 'c: 's>(&'s mut self, bytes: &mut &'c [u8]) -> Option<ClientEvent<'s>> {
        match self.take_answer(bytes) {
            Some(response) => Some(ClientEvent::Response(response)),
            // The usual end of a chunk.
            None if bytes.is_empty() => None,
            None => self.receive_other(bytes),
        }
    }

    /// Takes the expected answer if it is complete at the front of the chunk. Returns `None`, with nothing taken, for
    /// anything else; call [`Self::receive_other`] then.
    fn take_answer<'c>(&mut self, bytes: &mut &'c [u8]) -> Option<Response<'c>> {
        if !self.in_flight {
            return None;
        }
        let (front, behind) = bytes.split_first_chunk()?;
        if Front::from_bytes(front) != self.answer || self.reader.pending() != 0 {
            return None;
        }
        let (data, rest) = behind.split_at_checked(usize::from(self.answer_len))?;
        let response = Response::expected(self.answer.function(), self.operands, data)?;
        self.in_flight = false;
        *bytes = rest;
        Some(response)
    }

    /// Handles everything else: partial answers, exceptions, late answers, violations.
    fn receive_other<'s, 'c: 's>(&'s mut self, bytes: &mut &'c [u8]) -> Option<ClientEvent<'s>> {
        let newest = self.answer.transaction();
        loop {
            let (front, in_chunk) = match self.reader.take(bytes) {
                Some(AduFrame { front, data }) => (front, Some(data)),
                None => match self.reader.next_buffered(bytes)? {
                    Ok(front) => (front, None),
                    Err(error) => return Some(self.violated(bytes, Violation::Header(error))),
                },
            };
            let received = front.transaction();
            if self.in_flight && received == newest {
                let (expected, received) = (self.answer.unit(), front.unit());
                if received != expected {
                    return Some(self.violated(bytes, Violation::Unit { expected, received }));
                }
                self.in_flight = false;
                let request = self.request();
                let data = in_chunk.unwrap_or_else(|| self.reader.data(front));
                return Some(match Response::parse_data(request, front.function(), data) {
                    Ok(Ok(response)) => ClientEvent::Response(response),
                    Ok(Err(exception)) => ClientEvent::Exception(exception),
                    Err(error) => {
                        *bytes = &[];
                        ClientEvent::Violation(Violation::Response(error))
                    }
                });
            }
            // Ids count up and wrap: those less than half the range behind the newest one are older.
            if newest.wrapping_sub(received) >= 0x8000 {
                return Some(self.violated(bytes, Violation::Transaction { newest, received }));
            }
            self.stale = self.stale.saturating_add(1);
        }
    }

    /// Gives up the request in flight on the same connection: its answer will be skipped.
    pub const fn abort(&mut self) {
        self.in_flight = false;
    }

    /// Gives up the request in flight and drops a partial answer, for a new connection.
    pub const fn reset(&mut self) {
        self.in_flight = false;
        self.reader.reset();
    }

    fn violated<'s>(&mut self, bytes: &mut &[u8], violation: Violation) -> ClientEvent<'s> {
        self.reset();
        *bytes = &[];
        ClientEvent::Violation(violation)
    }
}

fn no_space(parts: &RequestParts<'_>, available: usize) -> StartError {
    let needed = parts.encoded_len().saturating_add(HEADER_LEN);
    StartError::Encode(PduEncodeError::NoSpace { needed, available })
}

/// Length of the part of a frame before its data.
const HEADS_LEN: usize = FRONT_LEN + OPERANDS_LEN;
