//! The table of a master: what is asked, of whom, and when.

use core::fmt;

use super::adu::{BROADCAST, MAX_ADDRESS};
use super::operation::{CountError, Operation};
use crate::time::Duration;

/// Most slaves on one line.
pub const MAX_SLAVES: usize = 32;

/// One row of a master's table.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
pub struct Exchange {
    /// Address of the slave, 1..=247, or 0 for a write to all.
    pub slave: u8,
    /// What is asked.
    pub operation: Operation,
    /// When it is asked.
    pub when: When,
    /// How long the slave may take for its reply, from the end of the request to the end of the
    /// reply.
    pub timeout: Duration,
    /// How often a request without a good reply is repeated at once, if the slave is up. Where other
    /// bytes came in place of the reply, it is repeated once in any case.
    pub retries: u8,
}

/// When an exchange is due. Each can also be [requested](super::Master::request) at any time: because
/// values have changed, or for a command.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
pub struct When {
    /// With this period; it keeps its phase while the slave is up.
    pub every: Option<Duration>,
    /// Once at the start, and each time that the slave has come back.
    pub start: bool,
}

impl When {
    /// Only when it is requested.
    pub const REQUESTED: Self = Self { every: None, start: false };
    /// At the start, when the slave has come back, and when it is requested: for values that a slave
    /// forgets without power.
    pub const START: Self = Self { every: None, start: true };

    /// Each `period`.
    pub const fn every(period: Duration) -> Self {
        Self { every: Some(period), start: false }
    }
}

/// Why a table is refused.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
#[non_exhaustive]
pub enum TableError {
    /// More exchanges than the master has room for.
    TooManyExchanges {
        /// Number of exchanges.
        needed: usize,
        /// Room of the master.
        available: usize,
    },
    /// More than 32 slaves.
    TooManySlaves,
    /// An address above 247.
    Slave {
        /// The exchange, counted from 0.
        exchange: usize,
        /// The address.
        address: u8,
    },
    /// A broadcast that asks for data.
    BroadcastRead {
        /// The exchange, counted from 0.
        exchange: usize,
    },
    /// A count of 0 or over the function's limit.
    Count {
        /// The exchange, counted from 0.
        exchange: usize,
        /// The count and its limit.
        error: CountError,
    },
}

impl fmt::Display for TableError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::TooManyExchanges { needed, available } => {
                write!(f, "{needed} exchanges are too many; allowed: up to {available}")
            }
            Self::TooManySlaves => write!(f, "more slaves than allowed; allowed: up to {MAX_SLAVES}"),
            Self::Slave { exchange, address } => {
                write!(f, "exchange {exchange}: slave {address} is out of range; allowed: 0..={MAX_ADDRESS}")
            }
            Self::BroadcastRead { exchange } => {
                write!(f, "exchange {exchange}: a broadcast cannot read; allowed: a write")
            }
            Self::Count { exchange, error } => write!(f, "exchange {exchange}: {error}"),
        }
    }
}

impl core::error::Error for TableError {}

impl Exchange {
    /// Checks row `nth` of a table.
    pub(super) fn check(&self, nth: usize) -> Result<(), TableError> {
        if self.slave > MAX_ADDRESS {
            return Err(TableError::Slave { exchange: nth, address: self.slave });
        }
        if self.slave == BROADCAST && self.operation.reads() {
            return Err(TableError::BroadcastRead { exchange: nth });
        }
        self.operation.check().map_err(|error| TableError::Count { exchange: nth, error })
    }
}
