//! The tokio shells, which connect the controller and the gateway to sockets, devices and the
//! clock.
//!
//! A shell is one thread with a current-thread runtime. It owns every socket and device of its
//! side, hands received data to the core and carries out the core's outputs; it does not know
//! protocols.

pub mod controller;
pub mod gateway;
mod host;
mod link;
pub mod out;
mod ready;
mod signals;
mod tcp;
mod udp;

use std::fmt;
use std::time::Duration;

pub use host::Handle;
pub use ready::ReadyFile;
pub use signals::Signals;

use recipe_device::bind::Bind;

/// Options of a run beside its file.
#[derive(Debug, Clone, Default)]
pub struct RunOptions {
    /// The device that each serial or CAN port is bound to.
    pub binds: Vec<Bind>,
    /// Where the addresses are written once everything is listening.
    pub ready: Option<ReadyFile>,
    /// Interval at which a line of counters is printed.
    pub stats: Option<Duration>,
}

/// Why a run could not start, or could not continue: one message; nothing was left behind.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct StartError {
    message: String,
    had_started: bool,
}

impl StartError {
    /// The run could not start.
    pub fn new(message: impl Into<String>) -> Self {
        Self { message: message.into(), had_started: false }
    }

    /// The same, for a run that had started.
    #[must_use]
    pub fn after_start(self) -> Self {
        Self { had_started: true, ..self }
    }

    /// 2 if nothing was started, 1 if the run failed later.
    pub const fn exit_code(&self) -> u8 {
        if self.had_started { 1 } else { 2 }
    }
}

impl fmt::Display for StartError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&self.message)
    }
}

impl std::error::Error for StartError {}
