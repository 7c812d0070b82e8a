//! Puts the board's memory layout where the linker looks.

use std::path::{Path, PathBuf};
use std::{env, fs};

fn main() {
    println!("cargo::rerun-if-changed=build.rs");
    let board = if env::var_os("CARGO_FEATURE_BOARD_MPS2_AN500").is_some() { "mps2-an500" } else { return };
    if env::var("CARGO_CFG_TARGET_OS").as_deref() != Ok("none") {
        return;
    }
    let out = PathBuf::from(env::var_os("OUT_DIR").expect("cargo sets OUT_DIR"));
    for file in ["memory.x", "device.x"] {
        let from = Path::new("boards").join(board).join(file);
        println!("cargo::rerun-if-changed={}", from.display());
        fs::copy(&from, out.join(file)).unwrap_or_else(|error| panic!("{}: {error}", from.display()));
    }
    println!("cargo::rustc-link-search={}", out.display());
}
