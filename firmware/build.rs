//! Provides the board's linker script.

use std::path::{Path, PathBuf};
use std::{env, fs};

fn main() {
    println!("cargo::rerun-if-changed=build.rs");
    if env::var("CARGO_CFG_TARGET_OS").as_deref() != Ok("none") {
        return;
    }
    // The sources refuse two boards or none, with a better message.
    let (file, script) = if env::var_os("CARGO_FEATURE_BOARD_MPS2_AN500").is_some() {
        ("boards/mps2-an500/mps2-an500.x", "mps2-an500.x")
    } else {
        // cortex-m-rt's script, which includes memory.x.
        ("../memory.x", "link.x")
    };
    let out = PathBuf::from(env::var_os("OUT_DIR").expect("cargo sets OUT_DIR"));
    let file = Path::new(file);
    println!("cargo::rerun-if-changed={}", file.display());
    let copy = out.join(file.file_name().expect("a file"));
    fs::copy(file, copy).unwrap_or_else(|error| panic!("{}: {error}", file.display()));
    println!("cargo::rustc-link-search={}", out.display());
    println!("cargo::rustc-link-arg=-T{script}");
    if env::var_os("CARGO_FEATURE_DEFMT").is_some() {
        println!("cargo::rustc-link-arg=-Tdefmt.x");
    }
}
