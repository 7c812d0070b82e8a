//! Exports for other tools that read the frames of a gateway or controller file.
//!
//! In: a file ([`Model`]). Out: a CAN database ([`dbc`](dbc::dbc)), a dissector for Wireshark ([`lua`](lua::lua)), a
//! map of the writers of variables ([`map`]). Names in files allow more characters than those tools; [`names`] converts
//! them. Does not know devices or sockets.

#![forbid(unsafe_code)]

pub mod dbc;
pub mod lua;
pub mod map;
mod model;
pub mod names;
mod uses;

pub use model::{BusModel, Format, FrameField, Model, Owner, PortModel, Recipe, Role};
pub use uses::{describe_use, unit_of};
