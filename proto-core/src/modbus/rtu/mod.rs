//! Modbus RTU, master and slave of one line (docs/wire/modbus-rtu.md).
//!
//! [`Master`] asks up to 32 slaves what a table of [`Exchange`]s says, and [`Slave`] answers as one
//! address over a [`RegisterBank`](super::server::RegisterBank). Both take received bytes in chunks
//! of any size, and the time. Serial ports and the meaning of values belong to the caller.
//!
//! ```
//! use proto_core::modbus::rtu::{Echo, Exchange, MAX_ADU, Master, Operation, Output, Reply, Timing, When};
//! use proto_core::time::{Duration, Instant};
//!
//! let weight = Exchange {
//!     slave: 9,
//!     operation: Operation::ReadInputRegisters { address: 0x10, count: 1 },
//!     when: When::every(Duration::from_millis(100)),
//!     timeout: Duration::from_millis(20),
//!     retries: 1,
//! };
//! let timing = Timing::new(19_200, 11);
//! let mut master = Master::<1>::new(timing, Echo::Absent, &[weight], Instant::ZERO)?;
//! let mut out = [0; MAX_ADU];
//! let mut now = master.deadline();
//! # let mut replies = 0;
//! for received in [&[][..], &[], &[9, 4, 2], &[0x03, 0xE8, 0x58, 0x4F]] {
//!     master.received(received, now);
//!     // The table writes nothing, so nobody asks for values.
//!     while let Some(output) = master.poll(now, |_, _| false, &mut out) {
//!         match output {
//!             Output::Send(len) => assert_eq!(out[..len], [9, 4, 0, 0x10, 0, 1, 0x31, 0x47]),
//!             Output::Reply { exchange: 0, reply: Reply::Registers(registers) } => {
//!                 assert_eq!(registers.register(0), Some(1000));
//! #               replies += 1;
//!             }
//!             other => println!("{other:?}"),
//!         }
//!     }
//!     // ... wait until `master.deadline()` or until bytes arrive
//!     now = master.deadline().min(now + Duration::from_millis(3));
//! }
//! # assert_eq!(replies, 1);
//! # Ok::<(), proto_core::modbus::rtu::TableError>(())
//! ```
//!
//! No function of these modules can panic, whatever bytes it is given, and each is bounded: one
//! frame is held, and each received byte is looked at a bounded number of times.

mod adu;
mod exchange;
mod master;
mod operation;
mod receiver;
mod slave;
mod timing;

pub use crate::schedule::Presence;
pub(crate) use adu::CRC_LEN;
pub use adu::{
    Adu, AduError, BROADCAST, FrameLen, MAX_ADDRESS, MAX_ADU, MIN_ADU, checksum, reply_len, request_len,
};
pub use exchange::{Exchange, MAX_SLAVES, TableError, When};
pub use master::{Failure, Master, Output, SlaveCounters, SlaveStatus};
pub use operation::{CountError, Operation, Reply, Table};
pub(crate) use operation::{Expected, Probe, REFUSAL_LEN};
pub use slave::{Counters, Slave};
pub use timing::Timing;

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
