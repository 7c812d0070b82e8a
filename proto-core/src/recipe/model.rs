//! The parts of a recipe, and their limits (docs/wire/recipes.md section 2, D16, D18).

use crate::sysvar::{Direction, SysVar};
use crate::wire::scalar::ScalarType;

/// Longest head or tail of a stream part, in bytes.
pub const MAX_DELIMITER: usize = 8;
/// Most fields of one part.
pub const MAX_FIELDS: usize = 128;
/// Longest stream frame, head and tail included, in bytes.
pub const MAX_STREAM_FRAME: usize = 512;
/// Most frame ids of one CAN part.
pub const MAX_CAN_IDS: usize = 32;

/// The kind of a recipe's fields.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
pub enum Mode {
    /// System variables, sent and applied by the system in every cycle.
    Realtime,
    /// Fields named by the user; a program, or the gateway's bindings, moves their values.
    User,
}

/// What fields a part may have.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct Rules {
    /// System variables or user-defined fields.
    pub mode: Mode,
    /// Which part of the recipe this is.
    pub direction: Direction,
}

/// One field of a part.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum Field {
    /// A system variable; its type is the table's.
    System(SysVar),
    /// A field of a user-defined recipe.
    User(ScalarType),
}

impl Field {
    /// The field's type.
    pub fn ty(self) -> ScalarType {
        match self {
            Self::System(var) => var.ty(),
            Self::User(ty) => ty,
        }
    }
}

/// Whether frames are searched in a byte stream, or arrive one per datagram (D18).
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum Framing {
    /// RS-485 and TCP: a head or a tail is required.
    Bytes,
    /// UDP: one datagram is one frame; head and tail may both be empty.
    Datagram,
}
