//! Edge nodes of Sparkplug B on a host ([docs/fleet.md](../../../docs/fleet.md)).
//!
//! The node itself is `recipe-sparkplug`, the same as on a board. This crate has what it needs on a host: connections
//! to a broker, with or without TLS, files, and the system clock. It also runs many simulated nodes in one process, to
//! test brokers.
#![forbid(unsafe_code)]

pub mod board;
pub mod broker;
pub mod drive;
pub mod file;
pub mod simulated;
