//! Modbus TCP, both sides, for the six function codes of the controller's map (docs/wire/modbus.md).
//!
//! [`client::Client`] runs one transaction at a time and [`server::Server`] answers over a
//! [`server::RegisterBank`]; both take received bytes in chunks of any size. [`map`] is the
//! controller's address map. Timeouts, sockets and reconnecting belong to the caller.
//!
//! No function of these modules can panic, whatever bytes it is given.

pub mod adu;
pub mod client;
mod exception;
pub mod map;
pub mod pdu;
pub mod server;
mod values;

pub use exception::Exception;
pub use values::{Coils, Registers};

#[cfg(test)]
mod tests;
