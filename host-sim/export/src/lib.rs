//! What other tools need to read the frames of a gateway or controller file.
//!
//! In: a file ([`Model`]). Out: a CAN database ([`dbc`](dbc::dbc)), a dissector for Wireshark ([`lua`](lua::lua)),
//! a map of who writes which variable ([`map`]). Names of files allow more than those tools do; [`names`] says
//! what they become. Nothing here opens a device or a socket.

#![forbid(unsafe_code)]

pub mod dbc;
pub mod lua;
pub mod map;
mod model;
pub mod names;
mod uses;

pub use model::{BusModel, Format, FrameField, Model, Owner, PortModel, Recipe, Role};
pub use uses::{describe_use, unit_of};
