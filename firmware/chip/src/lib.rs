//! The NUCLEO-H743ZI2 for tests of the firmware's binary: an emulated Cortex-M7 (Unicorn, loaded while a
//! test runs) among readable models of what the board uses. What is modelled, and what this cannot show,
//! is in docs/chip.md.
//!
//! [`Chip`] runs a [`Program`] in virtual time. Its [`Devices`] have the pins' other ends: RS-485 lines, a
//! CAN bus, an Ethernet cable. The models are strict: an access that the manual forbids, or that they do
//! not know, ends the run with its place.

mod board;
mod chip;
pub mod device;
mod devices;
mod exception;
pub mod models;
mod program;
pub mod realtime;
pub mod unicorn;

pub use board::{Access, Violation};
pub use chip::{CONFIG, Chip, Stopped};
pub use devices::Devices;
pub use program::Program;
