//! Compresses the built page, as small as gzip can be: a board keeps it in flash. The page is committed as text, so
//! that a change of it can be seen.

use std::fs;
use std::num::NonZeroU64;
use std::path::Path;

use crc::{CRC_32_ISO_HDLC, Crc};
use zopfli::{Format, Options};

fn main() {
    println!("cargo::rerun-if-changed=dist/index.html");
    println!("cargo::rerun-if-changed=dist/policy.txt");
    let page = fs::read("dist/index.html").expect("dist/index.html is part of the sources");
    let policy = fs::read_to_string("dist/policy.txt").expect("dist/policy.txt is part of the sources");
    let out = std::env::var("OUT_DIR").expect("cargo sets it");
    // It has no name and no time in it, so each build makes the same bytes.
    let mut packed = Vec::new();
    let options = Options { iteration_count: ROUNDS, ..Options::default() };
    zopfli::compress(options, Format::Gzip, &page[..], &mut packed).expect("there is room");
    fs::write(Path::new(&out).join("index.html.gz"), packed).expect("the folder is cargo's");
    println!("cargo::rustc-env=RECIPE_CONSOLE_POLICY={}", policy.trim());
    println!(
        "cargo::rustc-env=RECIPE_CONSOLE_ETAG=\"{:08x}\"",
        Crc::<u32>::new(&CRC_32_ISO_HDLC).checksum(&page)
    );
}

/// Three times as many take two seconds more and save no byte.
const ROUNDS: NonZeroU64 = NonZeroU64::new(5).expect("it is five");
