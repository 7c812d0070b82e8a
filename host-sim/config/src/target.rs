//! Items of the controller and their names in files and programs: `WordOutputReg[1]`, `DI[3]`, `AI_V[2]`.

use std::fmt;
use std::str::FromStr;

use proto_core::sysvar::{ParseError, SysVar, VarBit};

/// A target for an initial value.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum InitialTarget {
    /// A whole system variable.
    Var(SysVar),
    /// One input or output bit, such as `DI[3]`.
    Bit {
        /// The group.
        group: BitGroup,
        /// 1-based.
        index: u8,
    },
    /// One bit of a system variable, such as `BitInputReg[3].4`.
    VarBit(VarBit),
    /// One analog input of the cabinet or the tool, in mA or V.
    Analog {
        /// The group.
        group: AnalogInput,
        /// 1-based.
        index: u8,
    },
}

impl fmt::Display for InitialTarget {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Var(var) => var.fmt(f),
            Self::VarBit(bit) => bit.fmt(f),
            Self::Bit { group, index } => write!(f, "{}[{index}]", group.name()),
            Self::Analog { group, index } => write!(f, "{}[{index}]", group.name()),
        }
    }
}

/// The groups of input and output bits.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum BitGroup {
    /// Cabinet digital inputs, `DI[1..16]`.
    Di,
    /// Cabinet digital outputs, `DO[1..16]`.
    Do,
    /// Functional digital inputs, `FDI[1..8]`.
    Fdi,
    /// Functional digital outputs, `FDO[1..8]`.
    Fdo,
    /// Tool digital inputs, `ToolDI[1..2]`.
    ToolDi,
    /// Tool digital outputs, `ToolDO[1..2]`.
    ToolDo,
    /// Tool end buttons, `ToolButton[1..2]`: S and T.
    ToolButton,
}

impl BitGroup {
    /// Every group.
    pub const ALL: [Self; 7] =
        [Self::Di, Self::Do, Self::Fdi, Self::Fdo, Self::ToolDi, Self::ToolDo, Self::ToolButton];

    /// The name used in files.
    pub fn name(self) -> &'static str {
        match self {
            Self::Di => "DI",
            Self::Do => "DO",
            Self::Fdi => "FDI",
            Self::Fdo => "FDO",
            Self::ToolDi => "ToolDI",
            Self::ToolDo => "ToolDO",
            Self::ToolButton => "ToolButton",
        }
    }

    /// Number of bits in the group.
    pub fn count(self) -> u8 {
        match self {
            Self::Di | Self::Do => 16,
            Self::Fdi | Self::Fdo => 8,
            Self::ToolDi | Self::ToolDo | Self::ToolButton => 2,
        }
    }

    /// The bit of a system variable that holds `index`, from 1; `None` for the buttons and for an index that does not
    /// exist. For an output, the command's bit.
    pub fn var_bit(self, index: u8) -> Option<VarBit> {
        let nth = index.checked_sub(1).filter(|_| index <= self.count())?;
        let byte = u32::from(nth / 8);
        let (group, index) = match self {
            Self::Di => ("DigitalSignalStatus", 1 + byte),
            Self::Do => ("DigitalOutputCommand", 1 + byte),
            Self::Fdi => ("DigitalSignalStatus", 7),
            Self::Fdo => ("DigitalSignalStatus", 8),
            Self::ToolDi => ("DigitalSignalStatus", 3),
            Self::ToolDo => ("DigitalOutputCommand", 3),
            Self::ToolButton => return None,
        };
        SysVar::named(group, index).ok().map(|var| VarBit { var, bit: nth % 8 })
    }
}

/// The groups of analog inputs.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum AnalogInput {
    /// Cabinet current inputs in mA, `AI_C[1..4]`.
    CabinetCurrent,
    /// Cabinet voltage inputs in V, `AI_V[1..4]`.
    CabinetVoltage,
    /// Tool voltage inputs in V, `ToolAI[1..2]`.
    Tool,
}

impl AnalogInput {
    /// Every group.
    pub const ALL: [Self; 3] = [Self::CabinetCurrent, Self::CabinetVoltage, Self::Tool];

    /// The name used in files.
    pub fn name(self) -> &'static str {
        match self {
            Self::CabinetCurrent => "AI_C",
            Self::CabinetVoltage => "AI_V",
            Self::Tool => "ToolAI",
        }
    }

    /// Number of inputs in the group.
    pub fn count(self) -> u8 {
        match self {
            Self::CabinetCurrent | Self::CabinetVoltage => 4,
            Self::Tool => 2,
        }
    }

    /// The smallest and the largest value, in mA or V.
    pub fn range(self) -> (f64, f64) {
        match self {
            Self::CabinetCurrent => (0.0, 20.0),
            Self::CabinetVoltage | Self::Tool => (0.0, 10.0),
        }
    }
}

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
