#![no_std]
#![forbid(unsafe_code)]
//! The recipe gateway on a board: tasks that move bytes, frames and events between drivers and the
//! engine of `proto-core`.
//!
//! Nothing here knows a protocol, and nothing here knows a board: every task is generic over
//! `embedded_io_async`, [`can::CanPort`] or an `embassy_net::Stack`, and is bounded in memory. The
//! binary beside this library names the board.

pub mod can;
pub mod fair;
pub mod fmt;
pub mod gateway;
pub mod identity;
pub mod lan9118;
pub mod led;
pub mod link;
pub mod mcan;
mod notify;
pub mod platform;
pub mod serial;
pub mod slcan;
pub mod status;
pub mod usart;
pub mod watchdog;

#[cfg(test)]
extern crate std;
#[cfg(test)]
mod test_chip;
#[cfg(test)]
mod test_clock;
#[cfg(test)]
mod test_executor;
