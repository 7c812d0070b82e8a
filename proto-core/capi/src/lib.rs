//! The gateway engine for programs in C: `include/rgw.h` and a static library
//! (`proto-core/docs/driver.md` has the rules of a driver).
//!
//! In: the caller's memory, a configuration image, and what happened. Out: what has to be done, counters
//! and states. Nothing is allocated, nothing is called back, no clock is read. What a caller passes is
//! checked as far as it can be: null pointers, sizes, alignment and codes are refused with a [`Status`];
//! what can only be promised is in the section "Safety" of each function.
//!
//! This is the only crate with `unsafe` beside the boards: raw pointers become references in
//! `memory` and nowhere else.

#![no_std]
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

// A static library for a host takes its panic handler from there.
#[cfg(not(target_os = "none"))]
extern crate std;

mod config;
mod gateway;
mod info;
mod input;
mod memory;
mod output;
mod status;

pub use config::*;
pub use gateway::*;
pub use info::*;
pub use input::*;
pub use memory::RGW_ALIGN;
pub use output::*;
pub use status::*;

/// What is built: the environment variable `NO_PANIC` says it.
mod no_panic {
    /// For the proof of `.ci/run capi`: a panic does not link.
    #[cfg(target_os = "none")]
    pub(crate) const PROOF: bool = option_env!("NO_PANIC").is_some();
    /// The same with an index that nobody checked, to see that the proof can fail.
    pub(crate) const PROVOKED: bool = matches!(option_env!("NO_PANIC"), Some(name) if name.len() == 8);
}

#[cfg(target_os = "none")]
#[panic_handler]
fn panic(_: &core::panic::PanicInfo<'_>) -> ! {
    unsafe extern "C" {
        safe fn rgw_can_panic() -> !;
    }
    if no_panic::PROOF {
        rgw_can_panic()
    }
    loop {}
}
