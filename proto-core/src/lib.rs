#![no_std]
#![cfg_attr(docsrs, feature(doc_cfg))]
#![forbid(unsafe_code)]
#![cfg_attr(
    not(test),
    deny(
        clippy::indexing_slicing,
        clippy::unwrap_used,
        clippy::expect_used,
        clippy::panic,
        clippy::arithmetic_side_effects
    )
)]
// The first definition of a link wins: in this documentation the one here, elsewhere that of README.md (to docs.rs).
//! [`docs::driver`]: crate::docs::driver
//! [`docs::wire`]: crate::docs::wire
//!
#![doc = include_str!("../README.md")]

#[cfg(any(test, feature = "std"))]
extern crate std;

/// Re-exported, because the configuration's collections must be of the same version.
pub use heapless;

pub mod command;
pub mod config;
mod decimal;
pub mod device;
#[cfg(doc)]
pub mod docs;
pub mod engine;
pub mod histogram;
pub mod image;
pub mod link;
pub mod modbus;
pub mod recipe;
#[cfg(feature = "record")]
pub mod record;
pub mod schedule;
pub mod sysvar;
pub mod time;
pub mod wire;
