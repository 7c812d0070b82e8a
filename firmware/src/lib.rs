#![no_std]
#![forbid(unsafe_code)]
//! The recipe gateway on a board: tasks that move bytes, frames and events between drivers and the
//! engine of `proto-core`.
//!
//! Does not know protocols or boards: every task is generic over `embedded_io_async`, [`drivers::can_port::CanPort`] or
//! an
//! `embassy_net::Stack`, and its memory is bounded. The binary chooses the board.

mod clock;
pub mod drivers;
pub mod fmt;
pub mod identity;
pub mod journal;
pub mod platform;
pub mod stored;
pub mod tasks;
pub mod update;

#[cfg(test)]
extern crate std;
