//! The loader of the NUCLEO-H743ZI2: runs the firmware in one of two slots (docs/update.md section 4).
//!
//! In: the marks of the store, and what the slots hold. Out: a running firmware, with the watchdog started, or a
//! lamp that blinks because nothing can run. What it decides is in `recipe-update`; here are the registers.
#![cfg_attr(target_os = "none", no_std, no_main)]

#[cfg(target_os = "none")]
mod flash;
#[cfg(target_os = "none")]
mod lamp;
#[cfg(target_os = "none")]
mod program;
#[cfg(target_os = "none")]
#[path = "../../src/board/nucleo_h743zi/readable.rs"]
mod readable;
#[cfg(target_os = "none")]
mod register;
#[cfg(target_os = "none")]
mod watchdog;

#[cfg(not(target_os = "none"))]
fn main() {
    eprintln!("This is for a board: build it with `cargo loader`.");
    std::process::exit(2);
}
