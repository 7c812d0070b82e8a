//! The recipe of a port, with its layouts computed once.

use proto_core::recipe::model::{Framing, Mode, Rules};
use proto_core::recipe::{CanLayout, PartError, StreamLayout};
use proto_core::sysvar::Direction;
use proto_core::wire::can::CanId;

use recipe_config::{SimBus, SimCanFrame, SimField, SimParts, SimRecipe, SimStreamPart};

#[derive(Debug, Clone)]
pub(super) enum PartLayouts {
    Stream { input: Option<Box<StreamLayout>>, output: Option<Box<StreamLayout>> },
    Can { input: Option<Box<CanLayout>>, output: Option<Box<CanLayout>> },
}

/// Why a port cannot carry its recipe.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[non_exhaustive]
pub enum RecipeError {
    /// The recipe does not exist.
    NoSuchRecipe,
    /// A CAN recipe on a port that is no CAN bus, or a stream recipe on a CAN bus (D16).
    WrongKind,
    /// A user-defined recipe on a TCP or UDP port (D16).
    UserOnNetwork,
    /// A part breaks a rule.
    Part {
        /// Which part.
        direction: Direction,
        /// The rule.
        error: PartError,
    },
}

impl std::fmt::Display for RecipeError {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            Self::NoSuchRecipe => f.write_str("there is no such recipe"),
            Self::WrongKind => f.write_str("CAN ports take CAN recipes, all others stream recipes"),
            Self::UserOnNetwork => f.write_str("TCP and UDP ports take realtime recipes only"),
            Self::Part { direction: Direction::Input, error } => write!(f, "input part: {error}"),
            Self::Part { direction: Direction::Output, error } => write!(f, "output part: {error}"),
        }
    }
}

impl std::error::Error for RecipeError {}

impl PartLayouts {
    /// Checks that `bus` can carry the recipe, and computes the layouts.
    pub(super) fn new(recipe: &SimRecipe, bus: &SimBus) -> Result<Self, RecipeError> {
        let framing = match bus {
            SimBus::Rs485(_) | SimBus::TcpClient { .. } => Framing::Bytes,
            SimBus::UdpServer | SimBus::UdpClient { .. } => Framing::Datagram,
            SimBus::Can { .. } => return Self::can(recipe),
        };
        if recipe.mode == Mode::User && !matches!(bus, SimBus::Rs485(_)) {
            return Err(RecipeError::UserOnNetwork);
        }
        let SimParts::Stream { input, output } = &recipe.parts else {
            return Err(RecipeError::WrongKind);
        };
        let compile = |part: &Option<SimStreamPart>, direction| {
            let layout = part.as_ref().map(|part| {
                let rules = Rules { mode: recipe.mode, direction };
                StreamLayout::new(rules, &part.head, &part.tail, fields(&part.fields), framing)
                    .map(Box::new)
                    .map_err(|error| RecipeError::Part { direction, error })
            });
            layout.transpose()
        };
        Ok(Self::Stream {
            input: compile(input, Direction::Input)?,
            output: compile(output, Direction::Output)?,
        })
    }

    fn can(recipe: &SimRecipe) -> Result<Self, RecipeError> {
        let SimParts::Can { input, output } = &recipe.parts else {
            return Err(RecipeError::WrongKind);
        };
        let compile = |frames: &[SimCanFrame], direction| {
            if frames.is_empty() {
                return Ok(None);
            }
            let rules = Rules { mode: recipe.mode, direction };
            CanLayout::new(rules, frames.iter().map(|frame| (frame.id, fields(&frame.fields))))
                .map(|layout| Some(Box::new(layout)))
                .map_err(|error| RecipeError::Part { direction, error })
        };
        Ok(Self::Can {
            input: compile(input, Direction::Input)?,
            output: compile(output, Direction::Output)?,
        })
    }

    pub(super) fn has_input(&self) -> bool {
        match self {
            Self::Stream { input, .. } => input.is_some(),
            Self::Can { input, .. } => input.is_some(),
        }
    }

    pub(super) fn has_output(&self) -> bool {
        match self {
            Self::Stream { output, .. } => output.is_some(),
            Self::Can { output, .. } => output.is_some(),
        }
    }
}

fn fields(fields: &[SimField]) -> impl Iterator<Item = proto_core::recipe::model::Field> + '_ {
    fields.iter().map(|field| field.field)
}

/// The frame with this id, standard or extended, as a program names it.
pub(super) fn frame_of(layout: &CanLayout, id: i64) -> Option<usize> {
    layout.ids().position(|own| match own {
        CanId::Standard(own) => i64::from(own) == id,
        CanId::Extended(own) => i64::from(own) == id,
    })
}
