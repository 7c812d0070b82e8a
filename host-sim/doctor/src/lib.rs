//! Why does it not work? Findings in words, from what a gateway knows.
//!
//! In: a [`Case`]: the configuration, the state of an engine or of a gateway elsewhere, the recent bytes and ids of each port, and what
//! is known of each link. Out: [`Finding`]s: what is seen, what was expected, the likely cause and the
//! remedy. Everything here is a function of its arguments: no clock, no sockets, no devices.
//!
//! A finding is a guess with reasons. What works is not spoken of: without trouble in the counters of the
//! last seconds no bytes are looked at, but for the byte order of numbers, which no counter shows.

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

/// Everything that findings are made of.
#[derive(Debug, Clone)]
pub struct Case<'a> {
    /// The gateway's configuration.
    pub config: ConfigView<'a>,
    /// What it says of itself.
    pub status: State,
    /// What came in at each field port; a port without a record is judged by its counters alone.
    pub ports: &'a [PortRecord],
    /// What the driver knows of each link beyond the status; may be empty.
    pub links: &'a [LinkFacts],
    /// How long the gateway has been running.
    pub running: Duration,
    /// The controller's states, if somebody else than the engine has looked: for configurations that need
    /// no state stream.
    pub looked: Option<States>,
}

/// What is wrong, ports first, then links, then the controller; empty if nothing is.
pub fn examine(case: &Case<'_>) -> Vec<Finding> {
    let mut findings = Vec::new();
    port::examine(case, &mut findings);
    link::examine(case, &mut findings);
    controller::examine(case, &mut findings);
    findings
}

#[cfg(test)]
mod tests;
