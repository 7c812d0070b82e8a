//! Stateless conversions between bytes and values. Time, connections and configuration are not
//! known here.
//!
//! No function of this module can panic, whatever bytes it gets.

pub(crate) mod ascii;
pub mod can;
mod codes;
pub mod dialect;
pub(crate) mod runs;
pub mod scalar;
pub mod slcan;
pub mod state;
