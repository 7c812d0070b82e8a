//! The NUCLEO-H743ZI2 for tests of the firmware's binary: an emulated Cortex-M7 (Unicorn, loaded at run
//! time) and models of the peripherals that the firmware uses. What is modelled, and what this cannot show,
//! is in docs/chip.md.
//!
//! [`Chip`] runs a [`Program`] in virtual time. Its [`Devices`] include what the pins are connected to: RS-485
//! lines, a CAN bus, an Ethernet cable. The models are strict: an access that the manual forbids, or that
//! is not modelled, ends the run and is reported with its address. Manuals are cited by the titles of their
//! sections.

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
pub use devices::{Devices, Led};
#[cfg(feature = "emulator")]
pub use program::Program;
