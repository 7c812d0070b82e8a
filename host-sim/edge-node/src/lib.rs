//! Edge nodes of Sparkplug B on a host ([docs/fleet.md](../../../docs/fleet.md)).
//!
//! The node itself is `recipe-sparkplug`, the same as on a board. Here are what it needs on a host: connections to a
//! broker, also over TLS, files, the system's clock; and many simulated nodes in one process, for tests of brokers.
#![forbid(unsafe_code)]

pub mod board;
pub mod broker;
pub mod drive;
pub mod file;
pub mod simulated;
