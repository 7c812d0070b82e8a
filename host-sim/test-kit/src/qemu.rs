//! Arguments for QEMU that make its serial lines as fast as the host allows.
//!
//! QEMU's UARTs take one byte at a time, and each byte costs an iteration of its main loop. A multiplexer and a single
//! processor make that cheap (firmware/README.md has both for users).

use std::path::Path;
use std::sync::atomic::{AtomicUsize, Ordering};

use rustix::thread::{CpuSet, sched_getaffinity, sched_setaffinity};

/// Arguments for a machine with [`line()`]s: no byte is an escape character for the multiplexer.
pub const MACHINE: [&str; 2] = ["-echr", "256"];

/// Arguments for the next UART, whose other end is the socket at `path`. The multiplexer buffers 32 bytes; the next one
/// is in the UART as soon as the board has read the previous one.
pub fn line(name: &str, path: &Path) -> [String; 4] {
    let device = format!("socket,id={name},path={},server=on,wait=off,mux=on", path.display());
    ["-chardev".into(), device, "-serial".into(), format!("chardev:{name}")]
}

/// Calls `start` while this thread, and so each process that it starts, may run on one processor only.
///
/// QEMU's CPU thread and its main loop wait for each other at each byte, which costs several times as much between two
/// processors. Successive calls use the processors in turn.
pub fn on_one_processor<T>(start: impl FnOnce() -> T) -> T {
    static CALLS: AtomicUsize = AtomicUsize::new(0);
    let Ok(before) = sched_getaffinity(None) else { return start() };
    let allowed: Vec<usize> = (0..CpuSet::MAX_CPU).filter(|&at| before.is_set(at)).collect();
    // Test programs that start at the same time start with different processors.
    let turn = std::process::id() as usize + CALLS.fetch_add(1, Ordering::Relaxed);
    let mut one = CpuSet::new();
    if let Some(&processor) = allowed.get(turn % allowed.len().max(1)) {
        one.set(processor);
        // If this fails, QEMU is only slower.
        let _ = sched_setaffinity(None, &one);
    }
    let started = start();
    let _ = sched_setaffinity(None, &before);
    started
}
