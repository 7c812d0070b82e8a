//! The gateway engine for programs in C: `include/rgw.h` and a static library
//! (`proto-core/docs/driver.md` has the rules of a driver).
//!
//! In: the caller's memory, a configuration image, and inputs. Out: tasks for the driver, counters and
//! states. The library does not allocate, call back or read a clock. Null pointers, wrong sizes,
//! misaligned memory and unknown codes are refused with a [`Status`]; what a call cannot check is in the
//! section "Safety" of each function.
//!
//! Apart from the firmware's boards and drivers this is the only crate with `unsafe`: raw pointers
//! become references in `memory` and nowhere else.

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

/// What is built, as the environment variable `NO_PANIC` says.
mod no_panic {
    /// For the proof in `.ci/run capi`: a panic does not link.
    #[cfg(target_os = "none")]
    pub(crate) const PROOF: bool = option_env!("NO_PANIC").is_some();
    /// The same with an unchecked index, to see that the proof can fail.
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
