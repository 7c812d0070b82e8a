//! Logging to stderr: stdout is for results.

use std::io::{IsTerminal, stderr};

use tracing_subscriber::EnvFilter;

/// Warnings always; `-v` what happens, `-vv` everything. `RUST_LOG` decides when it is set.
pub(super) fn start(verbose: u8) {
    let level = match verbose {
        0 => "warn",
        1 => "info",
        _ => "trace",
    };
    let filter = EnvFilter::try_from_default_env().unwrap_or_else(|_| EnvFilter::new(level));
    // Fails only when somebody has set up logging before, which is as good.
    let format = tracing_subscriber::fmt().with_env_filter(filter).with_writer(stderr);
    let _ = format.with_ansi(stderr().is_terminal()).try_init();
}
