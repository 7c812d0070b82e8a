//! Provides the linker script, the memory of the board, and the public key of `RECIPE_UPDATE_KEY`.

use std::path::{Path, PathBuf};
use std::{env, fs};

fn main() {
    println!("cargo::rerun-if-changed=build.rs");
    println!("cargo::rerun-if-env-changed={KEY}");
    if env::var("CARGO_CFG_TARGET_OS").as_deref() != Ok("none") {
        return;
    }
    let out = PathBuf::from(env::var_os("OUT_DIR").expect("cargo sets OUT_DIR"));
    println!("cargo::rerun-if-changed=loader.x");
    fs::copy("loader.x", out.join("loader.x")).expect("the linker script is there");
    // The sources refuse two boards or none, with a better message.
    let board = match env::var_os("CARGO_FEATURE_BOARD_MPS2_AN500") {
        Some(_) => "boards/mps2-an500.x",
        None => "boards/nucleo-h743zi.x",
    };
    println!("cargo::rerun-if-changed={board}");
    fs::copy(board, out.join("board.x")).expect("the memory of the board is there");
    println!("cargo::rustc-link-search={}", out.display());
    println!("cargo::rustc-link-arg-bins=-Tloader.x");
    match key() {
        Ok(key) => fs::write(out.join("key.rs"), format!("{key:?}")).expect("OUT_DIR can be written"),
        Err(why) => println!("cargo::error={why}"),
    }
}

/// The file with the public key, absolute.
const KEY: &str = "RECIPE_UPDATE_KEY";

fn key() -> Result<[u8; 32], String> {
    let Some(path) = env::var_os(KEY) else {
        return Err(format!(
            "{KEY} does not name the file with the public key; `host-sim ctl keygen --signing FILE` makes FILE and FILE.pub"
        ));
    };
    let path = Path::new(&path);
    println!("cargo::rerun-if-changed={}", path.display());
    let text = fs::read_to_string(path).map_err(|error| format!("{KEY}, {}: {error}", path.display()))?;
    let digits = text.trim_end();
    let bytes = (digits.len() == 64 && digits.is_ascii())
        .then(|| {
            (0..32)
                .map(|nth| u8::from_str_radix(&digits[2 * nth..2 * nth + 2], 16).ok())
                .collect::<Option<Vec<u8>>>()
        })
        .flatten();
    let bytes: Option<[u8; 32]> = bytes.and_then(|bytes| bytes.try_into().ok());
    bytes.ok_or_else(|| format!("{KEY}, {}: not 64 hexadecimal digits", path.display()))
}
