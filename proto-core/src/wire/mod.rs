//! Stateless conversions between bytes and values. Does not know time, connections or configuration.
//!
//! No function of this module can panic on any input.

pub(crate) mod ascii;
pub mod can;
mod codes;
pub mod dialect;
pub(crate) mod runs;
pub mod scalar;
pub mod slcan;
pub mod state;
