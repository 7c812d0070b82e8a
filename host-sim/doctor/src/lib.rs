//! Why does it not work? Findings in words, from what a gateway knows.
//!
//! In: a [`Case`]: the configuration, the state of an engine or of another gateway, the recent bytes and ids of each
//! port, and facts about each link. Out: [`Finding`]s: what was seen, what was expected, the likely cause and the
//! remedy. Does not know clocks, sockets or devices: everything here is a function of its arguments.
//!
//! A finding is a guess with reasons. Nothing is said about what works. Bytes are only examined if the counters of the
//! last seconds show trouble, except for the byte order of numbers, which no counter shows.

#![forbid(unsafe_code)]

mod bytes;
mod can;
mod checksum;
mod command;
mod controller;
mod document;
mod finding;
mod given;
mod link;
mod peers;
mod port;
mod port_case;
mod record;
mod shape;
mod state;
mod stream;
mod value;
mod watch;

use proto_core::config::ConfigView;
use proto_core::time::Duration;
use proto_core::wire::state::States;

pub use bytes::HexBytes;
pub use controller::has_commands;
pub use document::StatusDocument;
pub use finding::{Cause, FILE, Finding, FindingPlace, Severity};
pub use record::{KEPT, LinkFacts, PortRecord, Reach, WINDOW};
pub use state::State;
pub use watch::{Change, Watch};

/// The input of an examination.
#[derive(Debug, Clone)]
pub struct Case<'a> {
    /// The gateway's configuration.
    pub config: ConfigView<'a>,
    /// The gateway's state.
    pub status: State,
    /// Input of each field port. A port without a record is judged by its counters alone.
    pub ports: &'a [PortRecord],
    /// What the driver knows of each link beyond its status; may be empty.
    pub links: &'a [LinkFacts],
    /// How long the gateway has been running.
    pub running: Duration,
    /// The controller's states, if they were read outside the engine: for configurations that need no state stream.
    pub looked: Option<States>,
}

/// All findings: ports first, then links, then the controller.
pub fn examine(case: &Case<'_>) -> Vec<Finding> {
    let mut findings = Vec::new();
    port::examine(case, &mut findings);
    link::examine(case, &mut findings);
    controller::examine(case, &mut findings);
    findings
}

#[cfg(test)]
mod tests;
