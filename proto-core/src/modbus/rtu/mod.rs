//! Modbus RTU: frames, a master's operations, and the slave (docs/wire/modbus-rtu.md).
//!
//! An [`Operation`] is a request of a master without its values, with the lengths of request and reply; the engine
//! sends it ([`config::ExchangeBuilder`](crate::config::ExchangeBuilder)). [`Slave`] answers for one address from a
//! [`RegisterBank`](super::server::RegisterBank); it takes received bytes in chunks of any size, and the time.
//!
//! No function of these modules can panic on any input, and their work is bounded: one frame is held, and each received
//! byte is examined a bounded number of times.

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

/// Maximum number of slaves per line for a master.
pub const MAX_SLAVES: usize = 32;

/// Whether the receiver of a line also hears what is sent on it.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
pub enum Echo {
    /// It hears only others.
    #[default]
    Absent,
    /// It hears each byte that is sent, as with a 2-wire adapter whose receiver is always on. A reply is expected only
    /// after the echo of its request, because replies of FC 5 and 6 look like their requests.
    Heard,
}

#[cfg(test)]
mod tests;
