//! Modbus TCP, client and server, for the six function codes of the controller's map (docs/wire/modbus.md). [`rtu`] has
//! Modbus RTU for serial lines with field devices.
//!
//! [`client::Client`] runs one transaction at a time and [`server::Server`] answers from a [`server::RegisterBank`];
//! both take received bytes in chunks of any size. [`map`] is the controller's address map. Timeouts, sockets and
//! reconnecting belong to the caller.
//!
//! ```
//! use proto_core::modbus::client::{Client, ClientEvent};
//! use proto_core::modbus::pdu::{Request, Response};
//!
//! let mut client = Client::new(1);
//! let mut out = [0; 260];
//! let len = client.start(Request::ReadHolding { address: 3, count: 1 }, &mut out)?;
//! // ... send out[..len]; hand over whatever comes back, in pieces of any size:
//! # assert_eq!(out[..len], [0, 1, 0, 0, 0, 6, 1, 3, 0, 3, 0, 1]);
//! for mut received in [&[0, 1, 0, 0, 0][..], &[5, 1, 3, 2, 0, 5]] {
//!     while let Some(event) = client.receive(&mut received) {
//!         match event {
//!             ClientEvent::Response(Response::Registers(safety)) => assert_eq!(safety.register(0), Some(5)),
//!             ClientEvent::Response(_) => {}
//!             ClientEvent::Exception(refused) => println!("{refused}"),
//!             ClientEvent::Violation(broken) => println!("close the connection: {broken}"),
//!         }
//!     }
//! }
//! assert!(!client.busy());
//! # Ok::<(), proto_core::modbus::client::StartError>(())
//! ```
//!
//! No function of these modules can panic on any input.

pub mod adu;
pub mod client;
mod exception;
pub mod map;
mod parts;
pub mod pdu;
pub mod rtu;
pub mod server;
mod values;

pub use exception::Exception;
pub use values::{Coils, Registers};

#[cfg(test)]
mod tests;
