//! The loader of a board: runs the firmware in one of two slots (docs/update.md section 4).
//!
//! In: the marks of the store, and the contents of the slots. Out: a running firmware, with the watchdog started; if
//! nothing can run, a blinking LED or a line of text. Does not know the rules: `recipe-update` decides which slot runs.
#![cfg_attr(target_os = "none", no_std, no_main)]

#[cfg(target_os = "none")]
mod board;
#[cfg(target_os = "none")]
mod program;

#[cfg(not(target_os = "none"))]
fn main() {
    eprintln!("This is for a board: build it with `cargo loader` or `cargo loader-qemu`.");
    std::process::exit(2);
}
