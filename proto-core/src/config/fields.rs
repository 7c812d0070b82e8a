//! The fields of a recipe's part, as a program writes them.
//!
//! In: names such as `"ForceEnd[1..6]"`, variables, or user-defined fields with their bindings.
//! Out: the same, borrowed; [`GatewayConfig::add_recipe`](super::GatewayConfig::add_recipe) reads
//! the names.

use super::{CommandWhen, FieldSpec};
use crate::sysvar::{ParseError, SysVar, VarRange};
use crate::wire::can::CanId;
use crate::wire::scalar::ScalarType;

/// A system variable, by name or as a value.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Var<'a> {
    /// `RobotState[8]` or `__RobotState_8`.
    Name(&'a str),
    /// The variable.
    Var(SysVar),
}

impl Var<'_> {
    pub(super) fn read(self) -> Result<SysVar, ParseError> {
        match self {
            Self::Name(name) => SysVar::parse(name),
            Self::Var(var) => Ok(var),
        }
    }
}

impl<'a> From<&'a str> for Var<'a> {
    fn from(name: &'a str) -> Self {
        Self::Name(name)
    }
}

impl From<SysVar> for Var<'_> {
    fn from(var: SysVar) -> Self {
        Self::Var(var)
    }
}

/// The fields of a stream part or of one CAN frame, in order.
///
/// Made from `&["ForceEnd[1..6]"]`, from `&[var]`, from `&[InputField::...]`, from
/// `&[OutputField::...]`, or from `&[FieldSpec]`.
#[derive(Debug, Clone, Copy, PartialEq)]
#[non_exhaustive]
pub enum Fields<'a> {
    /// System variables and ranges of them, such as `RobotState[8..13]`.
    Names(&'a [&'a str]),
    /// System variables.
    Vars(&'a [SysVar]),
    /// Fields of the input part of a user-defined recipe.
    Inputs(&'a [InputField<'a>]),
    /// Fields of the output part of a user-defined recipe.
    Outputs(&'a [OutputField<'a>]),
    /// As in the configuration; command tables are ranges of its `commands`.
    Specs(&'a [FieldSpec]),
}

impl Fields<'_> {
    /// Number of fields and of commands; a name that cannot be read counts as one field.
    pub(super) fn counts(&self) -> (usize, usize) {
        match self {
            Self::Names(names) => {
                let len = |name: &&str| VarRange::parse(name).map_or(1, |range| range.iter().len());
                (names.iter().map(len).fold(0, usize::saturating_add), 0)
            }
            Self::Vars(vars) => (vars.len(), 0),
            Self::Inputs(fields) => {
                (fields.len(), fields.iter().map(InputField::commands_len).fold(0, usize::saturating_add))
            }
            Self::Outputs(fields) => (fields.len(), 0),
            Self::Specs(fields) => (fields.len(), 0),
        }
    }
}

macro_rules! fields_from {
    ($($item:ty => $variant:ident),* $(,)?) => {$(
        impl<'a> From<&'a [$item]> for Fields<'a> {
            fn from(fields: &'a [$item]) -> Self {
                Self::$variant(fields)
            }
        }

        impl<'a, const N: usize> From<&'a [$item; N]> for Fields<'a> {
            fn from(fields: &'a [$item; N]) -> Self {
                Self::$variant(fields)
            }
        }
    )*};
}

fields_from! {
    &'a str => Names,
    SysVar => Vars,
    InputField<'a> => Inputs,
    OutputField<'a> => Outputs,
    FieldSpec => Specs,
}

/// A field of a user-defined recipe's input part.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct InputField<'a> {
    pub(super) ty: ScalarType,
    pub(super) does: Does<'a>,
}

#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) enum Does<'a> {
    Nothing,
    Writes { var: Var<'a>, scale: f32, offset: f32 },
    WritesBit { name: &'a str },
    Commands { entries: &'a [(i64, &'a str)], when: CommandWhen },
}

impl<'a> InputField<'a> {
    /// A field whose value is ignored.
    pub const fn unused(ty: ScalarType) -> Self {
        Self { ty, does: Does::Nothing }
    }

    /// A field whose value is written to an input variable.
    pub fn variable(ty: ScalarType, var: impl Into<Var<'a>>) -> Self {
        Self { ty, does: Does::Writes { var: var.into(), scale: 1.0, offset: 0.0 } }
    }

    /// A field that switches one bit of an input variable, such as `BitInputReg[3].4`: off for 0, on
    /// for any other value. Integer types only.
    pub const fn bit(ty: ScalarType, name: &'a str) -> Self {
        Self { ty, does: Does::WritesBit { name } }
    }

    /// A field whose value picks a command of port 2000 when it changes: pairs of value and command,
    /// such as `(1, "run(pick.jspf,50)")`. Integer types only.
    pub const fn commands(ty: ScalarType, entries: &'a [(i64, &'a str)]) -> Self {
        Self { ty, does: Does::Commands { entries, when: CommandWhen::Change } }
    }

    /// Makes the variable `value * scale + offset`. No effect on other fields.
    pub fn scaled(mut self, scale: f32, offset: f32) -> Self {
        if let Does::Writes { scale: own_scale, offset: own_offset, .. } = &mut self.does {
            (*own_scale, *own_offset) = (scale, offset);
        }
        self
    }

    /// Sets when a value picks its command. No effect on other fields.
    pub fn when(mut self, when: CommandWhen) -> Self {
        if let Does::Commands { when: own, .. } = &mut self.does {
            *own = when;
        }
        self
    }

    fn commands_len(&self) -> usize {
        match self.does {
            Does::Commands { entries, .. } => entries.len(),
            Does::Nothing | Does::Writes { .. } | Does::WritesBit { .. } => 0,
        }
    }
}

/// A field of a user-defined recipe's output part.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct OutputField<'a> {
    pub(super) ty: ScalarType,
    pub(super) sends: Sends<'a>,
}

#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) enum Sends<'a> {
    Variable { var: Var<'a>, scale: f32, offset: f32 },
    Constant(f64),
    Counter,
    Reply,
}

impl<'a> OutputField<'a> {
    /// A variable's value, saturated to the field's type.
    pub fn variable(ty: ScalarType, var: impl Into<Var<'a>>) -> Self {
        Self { ty, sends: Sends::Variable { var: var.into(), scale: 1.0, offset: 0.0 } }
    }

    /// A constant.
    pub const fn constant(ty: ScalarType, value: f64) -> Self {
        Self { ty, sends: Sends::Constant(value) }
    }

    /// The number of frames sent so far, wrapping in the field's type. Integer types only.
    pub const fn counter(ty: ScalarType) -> Self {
        Self { ty, sends: Sends::Counter }
    }

    /// The result of the port's newest command: see [`crate::engine::ReplyCode`].
    pub const fn reply(ty: ScalarType) -> Self {
        Self { ty, sends: Sends::Reply }
    }

    /// Makes the field `variable * scale + offset`. No effect on other fields.
    pub fn scaled(mut self, scale: f32, offset: f32) -> Self {
        if let Sends::Variable { scale: own_scale, offset: own_offset, .. } = &mut self.sends {
            (*own_scale, *own_offset) = (scale, offset);
        }
        self
    }
}

/// One frame of a CAN recipe's part.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct CanFields<'a> {
    pub(super) id: CanId,
    pub(super) fields: Fields<'a>,
}

impl<'a> CanFields<'a> {
    /// A frame with this id and these fields, at most 8 bytes together.
    pub fn new(id: CanId, fields: impl Into<Fields<'a>>) -> Self {
        Self { id, fields: fields.into() }
    }

    /// With an id of 11 bits, 0..=0x7FF.
    pub fn standard(id: u16, fields: impl Into<Fields<'a>>) -> Self {
        Self::new(CanId::Standard(id), fields)
    }

    /// With an id of 29 bits, 0..=0x1FFF_FFFF.
    pub fn extended(id: u32, fields: impl Into<Fields<'a>>) -> Self {
        Self::new(CanId::Extended(id), fields)
    }
}
