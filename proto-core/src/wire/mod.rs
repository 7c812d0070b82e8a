//! Stateless bytes ↔ values: nothing here knows time, connections or configuration.
//!
//! No function of this module can panic, whatever bytes it is given.

pub(crate) mod ascii;
pub mod can;
pub mod dialect;
pub mod scalar;
pub mod slcan;
pub mod state;
