//! Why an engine cannot be built.

use core::fmt;

use super::routes::PlanError;
use crate::config::{ConfigError, Counted};
use crate::device::LayoutError;
use crate::recipe::PartError;
use crate::sysvar::Direction;
use crate::wire::dialect::Dialect;

/// Why an engine cannot run a configuration.
#[derive(Debug, Clone, Copy, PartialEq)]
#[non_exhaustive]
pub enum BuildError {
    /// The configuration is invalid.
    Config(ConfigError),
    /// A variable has no way.
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
    /// A device's frame cannot be laid out.
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
    /// There is no dialect of the configured name.
    UnknownDialect,
    /// The configuration needs more entries than this engine has room for.
    TooMany {
        /// The list.
        what: Counted,
        /// Number of entries that the configuration needs; if only building it shows that, one more
        /// than there is room for.
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

/// There was no room for another entry.
pub(crate) fn one_too_many(what: Counted, room: usize) -> BuildError {
    BuildError::TooMany { what, needed: room.saturating_add(1), room }
}
