//! Items as files and programs name them: `WordOutputReg[1]`, `DI[3]`, `AI_V[2]`.

use proto_core::sysvar::{ParseError, SysVar};

use crate::config::{AnalogInput, BitGroup, InitialTarget};

/// Why a name means no item.
#[derive(Debug, Clone, PartialEq, Eq)]
#[non_exhaustive]
pub enum NameError {
    /// No bit or analog group, and no system variable either.
    Variable(ParseError),
    /// The group has no such index.
    Index {
        /// The group's name.
        group: &'static str,
        /// Its last index; the first is 1.
        last: u8,
    },
}

impl std::fmt::Display for NameError {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            Self::Variable(error) => error.fmt(f),
            Self::Index { group, last } => write!(f, "{group} has indices 1..{last}"),
        }
    }
}

impl std::error::Error for NameError {}

/// The item `name` means.
///
/// # Errors
/// [`NameError`] says what there is.
pub fn parse_target(name: &str) -> Result<InitialTarget, NameError> {
    let Some((word, index)) = name.strip_suffix(']').and_then(|name| name.split_once('[')) else {
        return SysVar::parse(name).map(InitialTarget::Var).map_err(NameError::Variable);
    };
    let within = |group: &'static str, last: u8| match index.parse::<u8>() {
        Ok(index) if (1..=last).contains(&index) => Ok(index),
        _ => Err(NameError::Index { group, last }),
    };
    if let Some(group) = BitGroup::ALL.into_iter().find(|group| group.name() == word) {
        return Ok(InitialTarget::Bit { group, index: within(group.name(), group.count())? });
    }
    if let Some(group) = AnalogInput::ALL.into_iter().find(|group| group.name() == word) {
        return Ok(InitialTarget::Analog { group, index: within(group.name(), group.count())? });
    }
    SysVar::parse(name).map(InitialTarget::Var).map_err(NameError::Variable)
}
