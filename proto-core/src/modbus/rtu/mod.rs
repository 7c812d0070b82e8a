//! Modbus RTU: frames, what a master asks, and the slave (docs/wire/modbus-rtu.md).
//!
//! An [`Operation`] is what a master asks, with the lengths of its request and reply; the engine asks it
//! ([`config::ExchangeBuilder`](crate::config::ExchangeBuilder)). [`Slave`] answers as one address over a
//! [`RegisterBank`](super::server::RegisterBank): it takes received bytes in chunks of any size, and the time.
//!
//! No function of these modules can panic, whatever bytes it is given, and each is bounded: one
//! frame is held, and each received byte is looked at a bounded number of times.

mod adu;
mod operation;
mod slave;
mod timing;

pub(crate) use adu::CRC_LEN;
pub use adu::{
    Adu, AduError, BROADCAST, FrameLen, MAX_ADDRESS, MAX_ADU, MIN_ADU, checksum, reply_len, request_len,
};
pub use operation::{CountError, Operation, Table};
pub(crate) use operation::{Expected, Probe, REFUSAL_LEN};
pub use slave::{Slave, SlaveStats};
pub use timing::Timing;

/// Most slaves that a master asks on one line.
pub const MAX_SLAVES: usize = 32;

/// Whether a line gives back what was sent on it.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
pub enum Echo {
    /// Only others are heard.
    #[default]
    Absent,
    /// Each own byte is heard, as with a 2-wire adapter whose receiver is always on. A reply is
    /// looked for only behind the echo of its request: replies of FC 5 and 6 look like requests.
    Heard,
}

#[cfg(test)]
mod tests;
