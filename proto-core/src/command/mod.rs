//! Port 2000, both sides: short ASCII commands and their replies (docs/wire/command.md).
//!
//! In: bytes in chunks of any size, and the time. Out: requests for the simulated controller, replies for the gateway.
//! Does not know connections, nor which commands are allowed.

mod client;
mod percent;
mod reply;
mod request;
mod server;
mod text;

pub use client::{ClientEvent, CommandClient, MAX_REPLY, StartError};
pub use percent::Percent;
pub use reply::{ActionOutcome, Reply, ReplyKind, StateCodes};
pub use request::{Action, EncodeError, Keyword, ParseError, Request};
pub use server::{CommandServer, ServerEvent, UnknownCommand};
pub use text::NoTextSpace;

/// Longest command, in bytes, without its terminator (D5).
pub const MAX_COMMAND: usize = 256;

#[cfg(test)]
mod tests;
