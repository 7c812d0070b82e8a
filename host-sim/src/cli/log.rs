//! Logging to stderr: stdout is for results.

use std::io::{self, IsTerminal, Write, stderr};

use recipe_runtime::log::Log;
use tracing_subscriber::EnvFilter;

/// Logs warnings; with `-v` events, with `-vv` every frame. `RUST_LOG` overrides this.
pub(super) fn start(verbose: u8) -> Log {
    let level = match verbose {
        0 => "warn",
        1 => "info",
        _ => "trace",
    };
    let filter = EnvFilter::try_from_default_env().unwrap_or_else(|_| EnvFilter::new(level));
    let log = Log::start(stderr());
    let own = log.clone();
    let format = tracing_subscriber::fmt().with_env_filter(filter);
    let format = format.with_writer(move || LogLine(own.clone()));
    // Fails only if logging is set up already.
    let _ = format.with_ansi(stderr().is_terminal()).try_init();
    log
}

/// Writer of one line.
struct LogLine(Log);

impl Write for LogLine {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        self.0.put(bytes);
        Ok(bytes.len())
    }

    fn flush(&mut self) -> io::Result<()> {
        Ok(())
    }
}
