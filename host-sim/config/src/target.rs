//! Names of items in files and programs: `WordOutputReg[1]`, `DI[3]`, `AI_V[2]`.

use std::fmt;
use std::str::FromStr;

use proto_core::sysvar::{ParseError, SysVar, VarBit};

use super::{AnalogInput, BitGroup, InitialTarget};

/// Why a name is not that of an item.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[non_exhaustive]
pub enum TargetError {
    /// The group has no such index.
    Index {
        /// The group's name.
        group: &'static str,
        /// Its last index; the first is 1.
        last: u8,
    },
    /// The variable has no such bit.
    Bit(VarBit),
    /// No group of bits or analog inputs, and no system variable either.
    Variable(ParseError),
}

impl fmt::Display for TargetError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Index { group, last } => write!(f, "there is only {group}[1..{last}]"),
            Self::Bit(VarBit { var, bit }) if var.is_bits() => {
                let last = var.valid_bits().count_ones().saturating_sub(1);
                write!(f, "{var} has no bit {bit}; allowed: 0..={last}")
            }
            Self::Bit(VarBit { var, .. }) => write!(f, "{var} is a {} without bits", var.ty()),
            Self::Variable(error) => {
                let bits: Vec<_> = BitGroup::ALL.into_iter().map(BitGroup::name).collect();
                let analog: Vec<_> = AnalogInput::ALL.into_iter().map(AnalogInput::name).collect();
                write!(f, "{error}; and {}, {} with an index", bits.join(", "), analog.join(", "))
            }
        }
    }
}

impl std::error::Error for TargetError {}

impl FromStr for InitialTarget {
    type Err = TargetError;

    fn from_str(name: &str) -> Result<Self, TargetError> {
        let (word, index) = match name.strip_suffix(']').and_then(|name| name.split_once('[')) {
            Some((word, index)) => (word, index.parse::<u8>().ok()),
            None => (name, None),
        };
        let within = |group: &'static str, last: u8| {
            index.filter(|index| (1..=last).contains(index)).ok_or(TargetError::Index { group, last })
        };
        if let Some(group) = BitGroup::ALL.into_iter().find(|group| group.name() == word) {
            return Ok(Self::Bit { group, index: within(group.name(), group.count())? });
        }
        if let Some(group) = AnalogInput::ALL.into_iter().find(|group| group.name() == word) {
            return Ok(Self::Analog { group, index: within(group.name(), group.count())? });
        }
        if let Some(bit) = VarBit::parse(name) {
            let bit = bit.map_err(TargetError::Variable)?;
            return if bit.mask().is_some() { Ok(Self::VarBit(bit)) } else { Err(TargetError::Bit(bit)) };
        }
        SysVar::parse(name).map(Self::Var).map_err(TargetError::Variable)
    }
}
