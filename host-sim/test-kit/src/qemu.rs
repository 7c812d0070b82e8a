//! QEMU as the tests run it, so that the bytes of its lines are as fast as a host allows.
//!
//! Its UARTs take one byte at a time, and it goes round its main loop for each of them. Two things make that cheap
//! (firmware/README.md tells them to users).

use std::path::Path;
use std::sync::atomic::{AtomicUsize, Ordering};

use rustix::thread::{CpuSet, sched_getaffinity, sched_setaffinity};

/// Arguments for the whole machine with [`line()`]s: its multiplexer takes no byte of them for its own.
pub const MACHINE: [&str; 2] = ["-echr", "256"];

/// Arguments of the next UART, whose other end is the socket at `path`. The multiplexer keeps 32 bytes, the next of
/// which is in the UART as soon as the board has read the one before.
pub fn line(name: &str, path: &Path) -> [String; 4] {
    let device = format!("socket,id={name},path={},server=on,wait=off,mux=on", path.display());
    ["-chardev".into(), device, "-serial".into(), format!("chardev:{name}")]
}

/// Calls `start` while this thread, and so what it starts, may run on one processor only.
///
/// QEMU's processor and its main loop wait for each other with each byte, which costs several times as much between
/// two processors. Those who call share the processors in turn.
pub fn on_one_processor<T>(start: impl FnOnce() -> T) -> T {
    static CALLS: AtomicUsize = AtomicUsize::new(0);
    let Ok(before) = sched_getaffinity(None) else { return start() };
    let allowed: Vec<usize> = (0..CpuSet::MAX_CPU).filter(|&at| before.is_set(at)).collect();
    // Programs that begin at the same time begin with different ones.
    let turn = std::process::id() as usize + CALLS.fetch_add(1, Ordering::Relaxed);
    let mut one = CpuSet::new();
    if let Some(&processor) = allowed.get(turn % allowed.len().max(1)) {
        one.set(processor);
        // Slower without it, and not wrong.
        let _ = sched_setaffinity(None, &one);
    }
    let started = start();
    let _ = sched_setaffinity(None, &before);
    started
}
