//! An edge node of Sparkplug B 3.0 over MQTT 3.1.1, for a host and a board alike: docs/fleet.md says what it publishes.
//!
//! In: samples of values, the bytes of an MQTT server, the current time. Out: the bytes for the server. Does not know
//! sockets, TLS or clocks, and allocates nothing. It only publishes: the one command that it obeys is the request for a
//! rebirth.
//!
//! Beside the node is what a board needs in addition: its settings as bytes ([`document`]), and UTC ([`sntp`]).
//!
//! A driver has a connection and follows the contract of all state machines of this repository: report one change, then
//! drain the outputs.
//!
//! ```
//! use proto_core::time::Instant;
//! use recipe_sparkplug::catalog::{Catalog, MAX_NAME, Metric, Owner, Report};
//! use recipe_sparkplug::node::{EdgeNode, Input, MIN_BUFFER, NodeOutput, Settings};
//! use recipe_sparkplug::topic::Id;
//! use recipe_sparkplug::value::{DataType, Value};
//!
//! /// A node with one metric and no devices.
//! struct Thermometer;
//!
//! impl Catalog for Thermometer {
//!     fn devices(&self) -> usize {
//!         0
//!     }
//!     fn device(&self, _: usize) -> &str {
//!         ""
//!     }
//!     fn metrics(&self, _: Owner) -> usize {
//!         1
//!     }
//!     fn metric(&self, _: usize) -> Option<Metric<'_>> {
//!         let name = heapless::String::try_from("temperature").ok()?;
//!         let data_type = DataType::Float;
//!         Some(Metric { name, data_type, unit: "°C", range: None, description: "of the oil" })
//!     }
//!     fn report(&self, _: usize) -> Report {
//!         Report { dead_band: 0.5, ..Report::ALL }
//!     }
//! }
//!
//! let settings = Settings::new(Id::new("hall 1").unwrap(), Id::new("press 4").unwrap());
//! let mut node = EdgeNode::<8, 32>::new(settings, &Thermometer, None, 1).unwrap();
//! let now = Instant::from_millis(10);
//! node.handle(now, Input::Time { utc_ms: 1_700_000_000_000 }, &Thermometer);
//! node.handle(now, Input::Sample { values: &[Some(Value::Float(21.5))], alive: 0 }, &Thermometer);
//! let mut buf = [0; MIN_BUFFER];
//! // The driver opens a connection and reports it.
//! assert_eq!(node.poll_output(now, &Thermometer, &mut buf), NodeOutput::Open);
//! node.handle(now, Input::Opened, &Thermometer);
//! // The driver stores this number, where it can, so that it survives restarts.
//! assert_eq!(node.poll_output(now, &Thermometer, &mut buf), NodeOutput::Keep { bd_seq: 0 });
//! // From here on, the driver sends the bytes that it gets, and reports those that it receives.
//! let NodeOutput::Send(connect) = node.poll_output(now, &Thermometer, &mut buf) else { unreachable!() };
//! assert_eq!(&connect[4..8], b"MQTT");
//! assert!(matches!(node.poll_output(now, &Thermometer, &mut buf), NodeOutput::Sleep { .. }));
//! node.handle(now, Input::Bytes(b"\x20\x02\x00\x00"), &Thermometer);
//! assert!(matches!(node.poll_output(now, &Thermometer, &mut buf), NodeOutput::Send(_)));
//! ```
#![no_std]
#![forbid(unsafe_code)]
#![cfg_attr(
    not(test),
    deny(
        clippy::indexing_slicing,
        clippy::unwrap_used,
        clippy::expect_used,
        clippy::panic,
        clippy::arithmetic_side_effects
    )
)]

#[cfg(test)]
extern crate std;

mod bytes;
pub mod catalog;
mod clock;
pub mod document;
pub mod gateway;
mod history;
pub mod mqtt;
pub mod node;
mod payload;
mod protobuf;
pub mod sntp;
pub mod topic;
pub mod value;
