//! Random bytes from the kernel, for keys and seeds.

use std::fs::File;
use std::io::{self, Read};

/// `N` cryptographically random bytes.
///
/// # Errors
/// If the kernel's source cannot be read, as in a chroot without `/dev`.
pub fn random<const N: usize>() -> io::Result<[u8; N]> {
    let mut bytes = [0; N];
    let read = File::open(SOURCE).and_then(|mut source| source.read_exact(&mut bytes));
    read.map_err(|error| io::Error::new(error.kind(), format!("{SOURCE}: {error}")))?;
    Ok(bytes)
}

const SOURCE: &str = "/dev/urandom";
