//! The client's side of one connection, one transaction in flight (docs/wire/modbus.md section 6).
//!
//! In: a request to send, then the connection's bytes. Out: the request's frame, then its answer.
//! Does not know time: the caller decides when an answer is overdue and calls [`Client::abort`].
//! The late answer is recognised by its transaction id, counted and skipped.

use core::fmt;

use super::adu::{self, Adu, AduError, AduReader, HEADER_LEN};
use super::exception::Exception;
use super::pdu::{EncodeError, Request, RequestHead, Response, ResponseError};

/// The client's side of one connection.
#[derive(Debug, Clone)]
pub struct Client {
    reader: AduReader,
    unit: u8,
    transaction: u16,
    in_flight: bool,
    /// The newest request, in flight or not.
    request: RequestHead,
    stale: u32,
}

/// An event in the received bytes.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum ClientEvent<'a> {
    /// The request was carried out.
    Response(Response<'a>),
    /// The server refused the request; the connection is fine.
    Exception(Exception),
    /// The server violated the protocol: the connection must be closed. A request in flight is
    /// over, and the rest of the chunk is dropped.
    Violation(Violation),
}

/// How a server broke the protocol.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
#[non_exhaustive]
pub enum Violation {
    /// A header after which frames can no longer be found.
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
    Encode(EncodeError),
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
        let request = RequestHead { function: 0, address: 0, count_or_value: 0 };
        Self { reader: AduReader::new(), unit, transaction: 0, in_flight: false, request, stale: 0 }
    }

    /// Whether a request is in flight.
    pub const fn busy(&self) -> bool {
        self.in_flight
    }

    /// Function code, address and count or value of the request in flight.
    pub const fn in_flight(&self) -> Option<RequestHead> {
        if self.in_flight { Some(self.request) } else { None }
    }

    /// Answers that arrived after their request had been given up, since the start.
    pub const fn stale_answers(&self) -> u32 {
        self.stale
    }

    /// Writes the request's frame to the front of `out` and returns its length; the request is then
    /// in flight.
    ///
    /// # Errors
    /// Nothing was written and nothing changed: a request is in flight, the count is outside the
    /// function's limits, or `out` is too short (260 bytes are always enough).
    #[inline]
    pub fn start(&mut self, request: Request<'_>, out: &mut [u8]) -> Result<usize, StartError> {
        if self.in_flight {
            return Err(StartError::Busy);
        }
        let parts = request.parts();
        let available = out.len();
        let no_space = || {
            let needed = parts.encoded_len().saturating_add(HEADER_LEN);
            StartError::Encode(EncodeError::NoSpace { needed, available })
        };
        let (header, body) = out.split_first_chunk_mut().ok_or_else(no_space)?;
        let pdu_len = parts.encode(body).map_err(|error| match error {
            EncodeError::NoSpace { .. } => no_space(),
            other => StartError::Encode(other),
        })?;
        self.transaction = self.transaction.wrapping_add(1);
        *header = adu::header(self.transaction, self.unit, pdu_len);
        self.in_flight = true;
        self.request = parts.head;
        Ok(pdu_len.saturating_add(HEADER_LEN))
    }

    /// Takes bytes from the front of `bytes` up to the end of the next answer and returns what it
    /// says; `None` once all of `bytes` is taken. To be called until then.
    #[inline]
    pub fn receive<'s, 'c: 's>(&'s mut self, bytes: &mut &'c [u8]) -> Option<ClientEvent<'s>> {
        loop {
            let place = match self.reader.advance(bytes)? {
                Ok(place) => place,
                Err(error) => return Some(self.violated(bytes, Violation::Header(error))),
            };
            let Adu { transaction, unit, .. } = self.reader.adu(place);
            if self.in_flight && transaction == self.transaction {
                if unit != self.unit {
                    let violation = Violation::Unit { expected: self.unit, received: unit };
                    return Some(self.violated(bytes, violation));
                }
                self.in_flight = false;
                return Some(match Response::parse(self.request, self.reader.adu(place).pdu) {
                    Ok(Ok(response)) => ClientEvent::Response(response),
                    Ok(Err(exception)) => ClientEvent::Exception(exception),
                    Err(error) => {
                        *bytes = &[];
                        ClientEvent::Violation(Violation::Response(error))
                    }
                });
            }
            // Ids count up, so those in the half circle behind the newest one are older.
            if self.transaction.wrapping_sub(transaction) >= 0x8000 {
                let violation = Violation::Transaction { newest: self.transaction, received: transaction };
                return Some(self.violated(bytes, violation));
            }
            self.stale = self.stale.saturating_add(1);
        }
    }

    /// Gives up the request in flight, on the same connection: its answer will be skipped.
    pub const fn abort(&mut self) {
        self.in_flight = false;
    }

    /// Gives up the request in flight and forgets a partial answer, for a new connection.
    pub const fn reset(&mut self) {
        self.in_flight = false;
        self.reader.reset();
    }

    #[cold]
    fn violated<'s>(&mut self, bytes: &mut &[u8], violation: Violation) -> ClientEvent<'s> {
        self.reset();
        *bytes = &[];
        ClientEvent::Violation(violation)
    }
}
