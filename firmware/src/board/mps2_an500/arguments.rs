//! The semihosting arguments (`-semihosting-config ...,arg=firmware,arg=PATH`).
//!
//! The loader compiles this file too (firmware/boot/src/board/mps2_an500/mod.rs).

use core::ffi::CStr;

use semihosting::experimental::env;

/// Passes argument `nth` to `look`.
pub(crate) fn argument<T>(nth: usize, look: impl FnOnce(&str) -> T) -> Option<T> {
    let args = env::args::<MAX_ARGUMENTS>().ok()?;
    (&args).nth(nth).and_then(Result::ok).map(look)
}

#[derive(Debug)]
pub(crate) struct FileName([u8; MAX_ARGUMENTS + 1]);

impl FileName {
    /// The name in an argument; `None` if there is none.
    pub(crate) fn argument(nth: usize) -> Option<Self> {
        let name = argument(nth, |path| {
            let mut name = [0; MAX_ARGUMENTS + 1];
            name.get_mut(..path.len())?.copy_from_slice(path.as_bytes());
            Some(Self(name))
        });
        name.flatten()
    }

    /// The NUL-terminated name for semihosting.
    pub(crate) fn as_c_str(&self) -> &CStr {
        CStr::from_bytes_until_nul(&self.0).unwrap_or_default()
    }
}

const MAX_ARGUMENTS: usize = 512;
