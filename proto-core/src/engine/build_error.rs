//! Why an engine cannot be built.

use core::fmt;

use super::io::{LinkId, PortId};
use crate::config::{ConfigError, Counted};
use crate::device::LayoutError;
use crate::recipe::PartError;
use crate::sysvar::{Direction, SysVar, VarBit};
use crate::wire::dialect::Dialect;

/// Why an engine cannot run a configuration.
#[derive(Debug, Clone, Copy, PartialEq)]
#[non_exhaustive]
pub enum BuildError {
    /// The configuration is invalid.
    Config(ConfigError),
    /// A variable has no route, no source, or no single owner.
    Plan(PlanError),
    /// A recipe's part is invalid.
    Part {
        /// Index of the recipe.
        recipe: u8,
        /// The part.
        part: Direction,
        /// What is wrong.
        error: PartError,
    },
    /// A device frame cannot be laid out.
    Layout {
        /// Index of the recipe.
        recipe: u8,
        /// The part.
        part: Direction,
        /// Index of the CAN frame; 0 in a stream recipe.
        frame: u8,
        /// What is wrong.
        error: LayoutError,
    },
    /// There is no dialect with the configured name.
    UnknownDialect,
    /// The configuration has more entries than this engine has room for.
    TooMany {
        /// The kind of entries.
        what: Counted,
        /// Number of entries needed; one more than `room` if only building shows that they do not fit.
        needed: usize,
        /// Number of entries there is room for.
        room: usize,
    },
}

impl fmt::Display for BuildError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Config(error) => error.fmt(f),
            Self::Plan(error) => error.fmt(f),
            Self::Part { recipe, part, error } => {
                let part = if *part == Direction::Input { "input" } else { "output" };
                write!(f, "recipe {}, {part} part: {error}", recipe.saturating_add(1))
            }
            Self::Layout { recipe, part, frame, error } => {
                let part = if *part == Direction::Input { "input" } else { "output" };
                let (recipe, frame) = (recipe.saturating_add(1), frame.saturating_add(1));
                write!(f, "recipe {recipe}, {part} part, frame {frame}: {error}")
            }
            Self::UnknownDialect => write!(f, "unknown dialect; there are {:?}", Dialect::NAMES),
            Self::TooMany { what, needed, room } => {
                write!(f, "too many {what}: {needed} are needed; this gateway has room for {room}")
            }
        }
    }
}

impl core::error::Error for BuildError {}

/// The error for one entry more than there is room for.
pub(super) fn one_too_many(what: Counted, room: usize) -> BuildError {
    BuildError::TooMany { what, needed: room.saturating_add(1), room }
}

/// Why a variable has no route, no source, or no single owner.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[non_exhaustive]
pub enum PlanError {
    /// Two ports write the same input variable.
    TwoOwners {
        /// The variable.
        var: SysVar,
        /// The port that writes it first.
        first: PortId,
        /// The other port.
        second: PortId,
    },
    /// Two ports write the same bit.
    TwoBitOwners {
        /// The bit.
        bit: VarBit,
        /// The port that writes it first.
        first: PortId,
        /// The other port.
        second: PortId,
    },
    /// One port writes the whole variable, and another one of its bits.
    OwnedAndShared {
        /// The bit.
        bit: VarBit,
        /// The port that writes the variable.
        whole: PortId,
        /// The port that writes the bit.
        part: PortId,
    },
    /// No configured route can carry the input variable (D15).
    NoRoute {
        /// The variable.
        var: SysVar,
        /// The port that writes it.
        port: PortId,
    },
    /// No configured source has the variable that a port shows (D15).
    NoSource {
        /// The variable.
        var: SysVar,
        /// The port that shows it.
        port: PortId,
    },
    /// A recipe link's frame has a variable that no port sends and that cannot be read back: its value would have to be
    /// invented.
    NobodySends {
        /// The variable.
        var: SysVar,
        /// The recipe link.
        link: LinkId,
    },
}

impl fmt::Display for PlanError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::TwoOwners { var, first, second } => {
                write!(
                    f,
                    "{var} is written by port {} and by port {}; a variable has one owner",
                    first.0, second.0
                )
            }
            Self::TwoBitOwners { bit, first, second } => {
                write!(
                    f,
                    "{bit} is written by port {} and by port {}; a bit has one owner",
                    first.0, second.0
                )
            }
            Self::OwnedAndShared { bit, whole, part } => {
                write!(
                    f,
                    "{} is written by port {} as a whole, and {bit} by port {}; allowed: one owner of the whole, \
                     or owners of bits",
                    bit.var, whole.0, part.0
                )
            }
            Self::NoRoute { var, .. } => {
                write!(f, "{var} can be written only through a recipe link whose input part carries it")
            }
            Self::NoSource { var, .. } => {
                write!(f, "{var} can be read only through a recipe link whose output part carries it")
            }
            Self::NobodySends { var, .. } => {
                write!(
                    f,
                    "{var} is in the recipe link's frame, but no port sends it and it cannot be read back"
                )
            }
        }
    }
}

impl core::error::Error for PlanError {}
