//! The page of the console, for whoever serves it: a host's gateway, the simulated controller, a board.
//!
//! It is one file with everything in it, built from `web/` by Node and committed in `dist/`, so that no build needs
//! Node. What it shows it asks of the API (docs/api.md) of the server that it came from.
#![no_std]
#![forbid(unsafe_code)]

/// The page, compressed: `Content-Encoding: gzip`, `Content-Type: text/html; charset=utf-8`.
pub static PAGE: [u8; PACKED.len()] = {
    // By its length, so that it has a name in the table of symbols, which tells what takes a board's flash.
    *match PACKED.first_chunk() {
        Some(page) => page,
        None => panic!("a slice has its own length"),
    }
};
const PACKED: &[u8] = include_bytes!(concat!(env!("OUT_DIR"), "/index.html.gz"));
/// `Content-Security-Policy`: this script and this style, requests to the own server, nothing else.
pub const POLICY: &str = env!("RECIPE_CONSOLE_POLICY");
/// `ETag`, with its quotes.
pub const ETAG: &str = env!("RECIPE_CONSOLE_ETAG");
/// Most bytes that [`PAGE`] may have: what a board has room for.
pub const MAX_LEN: usize = 64 << 10;

const _: () = assert!(PACKED.len() <= MAX_LEN, "the page is too large for a board");
