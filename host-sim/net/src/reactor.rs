//! Descriptors of our own in tokio's reactor.

use std::io;
use std::os::fd::OwnedFd;

use tokio::io::unix::AsyncFd;

/// Puts a non-blocking descriptor into the current runtime's reactor.
///
/// # Errors
/// When the reactor refuses it, as it does with regular files.
pub fn register(fd: OwnedFd) -> io::Result<AsyncFd<OwnedFd>> {
    // SAFETY: an `OwnedFd` is an open descriptor that always answers with the same number, and the
    // `AsyncFd` owns it, so it leaves the reactor before it is closed.
    Ok(unsafe { AsyncFd::register(fd) }?)
}
