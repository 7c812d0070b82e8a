//! The NUCLEO-H743ZI2 for tests of the firmware's binary: an emulated Cortex-M7 (Unicorn, loaded while a
//! test runs) among readable models of what the board uses. What is modelled, and what this cannot show,
//! is in docs/chip.md.
//!
//! [`Chip`] runs a [`Program`] in virtual time. Its [`Devices`] have the pins' other ends: RS-485 lines, a
//! CAN bus, an Ethernet cable. The models are strict: an access that the manual forbids, or that they do
//! not know, ends the run with its place.

#[cfg(feature = "emulator")]
mod access;
#[cfg(feature = "emulator")]
mod board;
#[cfg(feature = "emulator")]
mod chip;
pub mod device;
#[cfg(feature = "emulator")]
mod devices;
#[cfg(feature = "emulator")]
mod exception;
pub mod models;
#[cfg(feature = "emulator")]
mod program;
#[cfg(feature = "emulator")]
pub mod realtime;
#[cfg(feature = "emulator")]
pub mod unicorn;

#[cfg(feature = "emulator")]
pub use access::{Access, Violation};
#[cfg(feature = "emulator")]
pub use chip::{CONFIG, Chip, Stopped};
#[cfg(feature = "emulator")]
pub use devices::Devices;
#[cfg(feature = "emulator")]
pub use program::Program;
