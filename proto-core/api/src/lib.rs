//! The HTTP/1.1 API of a gateway, for a host and a board alike: docs/api.md has its endpoints.
//!
//! In: the bytes of a request, the current time, a [`proto_core::engine::Status`]. Out: an operation that may be
//! executed, or a refusal, and the bytes of the response. Does not know sockets, clocks, files or TOML, and allocates
//! nothing.
//!
//! A driver serves a connection like this; each connection carries one request:
//!
//! ```
//! use proto_core::time::Instant;
//! use recipe_api::guard::{Admitted, Guard, Site};
//! use recipe_api::request::{HeadBuffer, HeadError};
//! use recipe_api::response::{ContentType, Length, Response, StatusCode};
//! use recipe_api::route::{ApiOperation, Served};
//!
//! # fn random() -> [u8; 32] { [7; 32] }
//! # fn receive(to: &mut [u8]) -> usize {
//! #     let request = b"GET /api/v1/info HTTP/1.1\r\nHost: 127.0.0.1:8480\r\n\r\n";
//! #     to[..request.len()].copy_from_slice(request);
//! #     request.len()
//! # }
//! # fn send(_: &str) {}
//! // One for all connections. Without a key nothing can be changed.
//! let mut guard = Guard::new(None, random());
//! // From here on for each connection.
//! let site = Site { local: "127.0.0.1".parse().unwrap(), peer: "127.0.0.1".parse().unwrap(), names: &[] };
//! let mut head = HeadBuffer::new();
//! let mut chunk = [0; 512];
//! let admitted = loop {
//!     let count = receive(&mut chunk);
//!     // What is not taken is the beginning of the body.
//!     let taken = head.push(&chunk[..count]);
//!     match head.head() {
//!         Ok(head) => break guard.admit(Instant::ZERO, &head, &site, Served::Gateway),
//!         Err(HeadError::Incomplete) => assert_eq!(taken, count),
//!         Err(error) => break Err(error.into()),
//!     }
//! };
//! let mut text = heapless::String::<512>::new();
//! match admitted {
//!     Ok(Admitted { operation: ApiOperation::Info, .. }) => {
//!         let body = "{}";
//!         Response::new(StatusCode::OK, ContentType::Json, Length::Bytes(body.len() as u64)).write(&mut text).unwrap();
//!         send(&text);
//!         send(body);
//!     }
//!     Ok(_) => unreachable!("this request is for info"),
//!     Err(refusal) => panic!("{}", refusal.text),
//! }
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

mod address;
pub mod arguments;
pub mod attempts;
pub mod claim;
pub mod documents;
mod fields;
pub mod guard;
pub mod json;
pub mod key;
pub mod metrics;
pub mod nonces;
mod number;
pub mod request;
pub mod response;
pub mod revisions;
pub mod route;
