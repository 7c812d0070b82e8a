//! Names of variables as text: `RobotState[8]`, `RobotState[8..13]`, `__RobotState_8` (D14).

use core::fmt;

use super::{SPANS, SysVar};
use crate::wire::ascii::{rsplit_once, split_once};

/// Consecutive variables of one group, as `RobotState[8..13]` names them; at least one.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct VarRange {
    first: SysVar,
    last: SysVar,
}

impl VarRange {
    /// The variables from `first` to `last`; `None` if they are not of one group, in order.
    pub fn of(first: SysVar, last: SysVar) -> Option<Self> {
        (first <= last && first.group() == last.group()).then_some(Self { first, last })
    }

    /// The variables, in order.
    pub fn iter(self) -> impl ExactSizeIterator<Item = SysVar> + Clone {
        (self.first.0..self.last.0.saturating_add(1)).map(SysVar)
    }
}

/// Why a text is not the name of a variable.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[non_exhaustive]
pub enum ParseError {
    /// Neither `Name[i]`, `Name[i..j]` nor `__Name_i`.
    Syntax,
    /// No group has this name.
    UnknownGroup,
    /// The group has no such index.
    OutOfRange {
        /// The group's name.
        group: &'static str,
        /// The index in the text.
        index: u32,
        /// The group's last index; the first is 1.
        last: u8,
    },
    /// A range runs backwards.
    Backwards {
        /// The range's first index.
        first: u32,
        /// The range's last index.
        last: u32,
    },
    /// A range where a single variable is needed.
    NotSingle,
}

impl fmt::Display for ParseError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Syntax => {
                f.write_str("a system variable is written Name[1], Name[1..4] for a range, or __Name_1")
            }
            Self::UnknownGroup => {
                f.write_str("no such system variable; there are")?;
                let mut last = "";
                for span in &SPANS {
                    if span.group != last {
                        f.write_str(if last.is_empty() { " " } else { ", " })?;
                        f.write_str(span.group)?;
                        last = span.group;
                    }
                }
                Ok(())
            }
            Self::OutOfRange { group, index, last } => {
                write!(f, "there is no {group}[{index}], only {group}[1..{last}]")
            }
            Self::Backwards { first, last } => write!(f, "the range {first}..{last} runs backwards"),
            Self::NotSingle => f.write_str("one variable is needed here, not a range"),
        }
    }
}

impl core::error::Error for ParseError {}

impl SysVar {
    /// The variable with this name: `RobotState[8]` or `__RobotState_8`.
    ///
    /// # Errors
    /// [`ParseError`] says what is wrong and what is allowed.
    pub fn parse(name: &str) -> Result<Self, ParseError> {
        let range = VarRange::parse(name)?;
        if range.first == range.last { Ok(range.first) } else { Err(ParseError::NotSingle) }
    }

    /// The variable of `group` with this 1-based index.
    ///
    /// # Errors
    /// [`ParseError::UnknownGroup`], or [`ParseError::OutOfRange`] with the group's last index.
    pub fn named(group: &str, index: u32) -> Result<Self, ParseError> {
        let mut base = 0_usize;
        let mut known: Option<(&'static str, u8)> = None;
        for span in &SPANS {
            if span.group == group {
                if (u32::from(span.first)..=u32::from(span.last)).contains(&index) {
                    let nth = index.saturating_sub(u32::from(span.first)) as usize;
                    if let Some(var) = Self::from_ordinal(base.saturating_add(nth)) {
                        return Ok(var);
                    }
                }
                known = Some((span.group, span.last));
            }
            base = base.saturating_add(span.len());
        }
        match known {
            Some((group, last)) => Err(ParseError::OutOfRange { group, index, last }),
            None => Err(ParseError::UnknownGroup),
        }
    }
}

impl VarRange {
    /// The variables with this name: one (`RobotState[8]`, `__RobotState_8`) or a range (`RobotState[8..13]`,
    /// inclusive).
    ///
    /// # Errors
    /// [`ParseError`] says what is wrong and what is allowed.
    pub fn parse(name: &str) -> Result<Self, ParseError> {
        if let Some(pendant) = name.strip_prefix("__") {
            let (group, index) = rsplit_once(pendant, b'_').ok_or(ParseError::Syntax)?;
            let var = SysVar::named(group, number(index)?)?;
            return Ok(Self { first: var, last: var });
        }
        let (group, rest) = split_once(name, b'[').ok_or(ParseError::Syntax)?;
        let inside = rest.strip_suffix(']').ok_or(ParseError::Syntax)?;
        let (first, last) = match split_once(inside, b'.') {
            Some((first, last)) => {
                (number(first)?, number(last.strip_prefix('.').ok_or(ParseError::Syntax)?)?)
            }
            None => (number(inside)?, number(inside)?),
        };
        if last < first {
            return Err(ParseError::Backwards { first, last });
        }
        Ok(Self { first: SysVar::named(group, first)?, last: SysVar::named(group, last)? })
    }
}

/// One bit of a byte variable, named like `BitInputReg[3].4`.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub struct VarBit {
    /// The variable; [`Self::mask`] says whether it has the bit.
    pub var: SysVar,
    /// The bit, 0 for the least significant.
    pub bit: u8,
}

impl VarBit {
    /// Parses a name such as `BitInputReg[3].4` or `__BitInputReg_3.4`; `None` if it names no bit. Does not check
    /// whether the variable has the bit.
    ///
    /// # Errors
    /// [`ParseError`] says what is wrong with the variable's name.
    pub fn parse(name: &str) -> Option<Result<Self, ParseError>> {
        let (var, bit) = rsplit_once(name, b'.')?;
        // In `Group[1..2` the dot belongs to a range, whose bracket is still open.
        let bit = number(bit).ok().filter(|_| !bit.is_empty())?;
        let bit = u8::try_from(bit).unwrap_or(u8::MAX);
        Some(SysVar::parse(var).map(|var| Self { var, bit }))
    }

    /// Mask of the bit in the variable's byte; `None` if the variable has no such bit.
    pub fn mask(self) -> Option<u8> {
        let mask = 1_u8.checked_shl(self.bit.into())?;
        (self.var.is_bits() && self.var.valid_bits() & mask != 0).then_some(mask)
    }
}

impl fmt::Display for VarBit {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}.{}", self.var, self.bit)
    }
}

fn number(text: &str) -> Result<u32, ParseError> {
    if text.bytes().all(|b| b.is_ascii_digit()) {
        text.parse().map_err(|_| ParseError::Syntax)
    } else {
        Err(ParseError::Syntax)
    }
}

impl fmt::Display for SysVar {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}[{}]", self.group(), self.index())
    }
}

impl core::str::FromStr for SysVar {
    type Err = ParseError;
    fn from_str(name: &str) -> Result<Self, ParseError> {
        Self::parse(name)
    }
}
