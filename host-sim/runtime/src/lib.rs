//! The runtimes, which connect the engine and the simulated controller to sockets, devices and the clock.
//!
//! A runtime is one thread with a current-thread tokio runtime. It owns all its sockets and devices, reports received
//! data to the state machine, and executes its outputs. It does not know protocols.

pub mod cells;
mod client;
pub mod console;
pub mod controller;
mod events_file;
mod findings;
pub mod gateway;
mod host;
mod link;
pub mod log;
pub mod out;
mod publisher;
mod ready;
mod service;
mod signals;
mod snapshot;
mod stdout;
mod tcp;
mod udp;
mod worker;

use std::fmt;
use std::sync::Arc;
use std::time::Duration;

pub use events_file::EventsFile;
pub use host::Handle;
pub use ready::ReadyFile;
pub use signals::Signals;

use recipe_capture::{Decoder, Watch};
pub use recipe_edge_node::file::PublisherConfig;
use recipe_io::bind::Bind;
pub use recipe_io::realtime::Scheduling;

/// Options of a run beside its file.
#[derive(Debug, Clone, Default)]
pub struct RunOptions {
    /// The device that each serial or CAN port is bound to.
    pub binds: Vec<Bind>,
    /// The file for the addresses, written when everything is listening.
    pub ready: Option<ReadyFile>,
    /// Interval at which a line of counters is printed.
    pub stats: Option<Duration>,
    /// The scheduling of the run's thread.
    pub scheduling: Scheduling,
    /// The console.
    pub console: Option<console::ConsoleOptions>,
    /// The Sparkplug broker that a gateway publishes to.
    pub sparkplug: Option<PublisherConfig>,
    /// A gateway's frames and engine calls, for subscribers.
    pub watch: Watch,
    /// Decodes frames of the configuration file for subscribers. A gateway with a console uses its running revision.
    pub decoder: Arc<Decoder>,
    /// The log, whose newest lines a console shows.
    pub log: Option<log::Log>,
    /// `ready` goes to stderr: stdout is for a capture.
    pub stdout_is_taken: bool,
}

/// Why a run could not start or continue, as one message. Everything that was opened is closed.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct RunError {
    message: String,
    had_started: bool,
}

impl RunError {
    /// The run could not start.
    pub fn new(message: impl Into<String>) -> Self {
        Self { message: message.into(), had_started: false }
    }

    /// Marks the error as one of a run that had started.
    #[must_use]
    pub fn after_start(self) -> Self {
        Self { had_started: true, ..self }
    }

    /// Prefixes the message with the name of a cell.
    #[must_use]
    pub(crate) fn of(self, cell: &str) -> Self {
        Self { message: format!("{cell}: {}", self.message), ..self }
    }

    /// 2 if nothing was started, 1 if the run failed later.
    pub const fn exit_code(&self) -> u8 {
        if self.had_started { 1 } else { 2 }
    }
}

impl fmt::Display for RunError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&self.message)
    }
}

impl std::error::Error for RunError {}
