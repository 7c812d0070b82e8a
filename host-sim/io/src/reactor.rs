//! File descriptors in tokio's reactor.

use std::io;
use std::os::fd::OwnedFd;

use tokio::io::Interest;
use tokio::io::unix::AsyncFd;

/// Registers a non-blocking descriptor with the current runtime's reactor for `interest`.
///
/// # Errors
/// If the reactor refuses it, as it does a regular file.
pub(crate) fn register(fd: OwnedFd, interest: Interest) -> io::Result<AsyncFd<OwnedFd>> {
    // SAFETY: an `OwnedFd` is open and its number never changes; the `AsyncFd` owns it, so it is
    // deregistered before it is closed.
    Ok(unsafe { AsyncFd::register_with_interest(fd, interest) }?)
}
