//! What the value of an input field may be, and what becomes of it: `as`, limits, a table, "no value", `valid_to`.
//!
//! All stand behind their field, as entries of their own, like the limits of output fields
//! ([`Limits`](super::Limits), [`MapEntry`](super::MapEntry)): fields without them have no room for them, and frames have
//! nothing in their place. They are for fields that write a variable as a whole.

use super::error::{ConfigError, ConfigErrorKind as Kind, Place};
use super::rules::{Check, check_bit, fail};
use super::sendable::{check_entry, check_order};
use super::{FieldSpec, InputBinding, MapEntry};
use crate::device::{Encoding, Kind as EncodingKind, Overflow};
use crate::image::bind_to_variable;
use crate::sysvar::{Direction, SysVar, VarBit};
use crate::wire::scalar::{Scalar, ScalarType};

/// Maximum number of characters of a text that says that there is no value.
pub const NO_TEXT: usize = 8;

/// A text that says that there is no value, such as `----`.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
pub struct NoText {
    len: u8,
    bytes: [u8; NO_TEXT],
}

impl NoText {
    /// A text of 1..=[`NO_TEXT`] printable ASCII characters, without spaces at its ends; `None` for another one.
    pub fn new(text: &str) -> Option<Self> {
        let text = text.as_bytes();
        let is_fine = (1..=NO_TEXT).contains(&text.len()) && text.trim_ascii() == text;
        if !is_fine || !text.iter().all(|byte| (b' '..=b'~').contains(byte)) {
            return None;
        }
        let mut bytes = [0; NO_TEXT];
        bytes.iter_mut().zip(text).for_each(|(slot, &byte)| *slot = byte);
        Some(Self { len: text.len() as u8, bytes })
    }

    /// Its characters.
    pub fn bytes(&self) -> &[u8] {
        self.bytes.get(..usize::from(self.len)).unwrap_or(&[])
    }
}

/// What becomes of the value of the input field before it.
#[derive(Debug, Clone, Copy, PartialEq)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
#[non_exhaustive]
pub enum InputRule {
    /// A word register has it in two's complement: -32768..=32767 after scale and offset.
    Int16,
    /// The variable becomes this for values that no [`MapEntry`] has; without it the field is rejected.
    Else(f64),
    /// This number says that there is no value.
    NoNumber(f64),
    /// This text says that there is no value, spaces around it aside; fields of digits only.
    NoText(NoText),
    /// The digits of a decimal field have a comma where others have a point.
    Comma,
    /// This variable, a word register or one bit, is 1 while the field's newest value was taken, and 0 when it was rejected,
    /// had none, or is overdue.
    ValidTo {
        /// An input variable.
        var: SysVar,
        /// Bit 0..=7; `None` for a word register.
        bit: Option<u8>,
    },
}

impl InputRule {
    /// The word register that tells whether a value was taken.
    pub(super) const fn variable(self) -> Option<SysVar> {
        match self {
            Self::ValidTo { var, bit: None } => Some(var),
            _ => None,
        }
    }

    /// The bit that does.
    pub(super) const fn bit(self) -> Option<VarBit> {
        match self {
            Self::ValidTo { var, bit: Some(bit) } => Some(VarBit { var, bit }),
            _ => None,
        }
    }
}

/// What stands behind an input field, while the fields of a frame are checked in order.
#[derive(Default)]
pub(super) struct BehindInput<'c> {
    field: Option<Own<'c>>,
    has_limits: bool,
    /// Entries of its table so far.
    entries: usize,
    has_else: bool,
    has_valid: bool,
    is_int16: bool,
}

/// The input field.
#[derive(Clone, Copy)]
struct Own<'c> {
    encoding: Encoding,
    overflow: Overflow,
    var: SysVar,
    is_scaled: bool,
    /// All from it on.
    all: &'c [FieldSpec],
}

impl<'c> BehindInput<'c> {
    /// Looks at the first of these fields, the rest of a frame's.
    pub(super) fn check(&mut self, place: Place, rest: &'c [FieldSpec]) -> Check {
        let Some((field, _)) = rest.split_first() else { return Ok(()) };
        match *field {
            FieldSpec::Limits(limits) => {
                let own = self.own(place)?;
                if self.has_limits || self.entries > 0 {
                    return fail(place, Kind::LimitsAndMap);
                }
                self.has_limits = true;
                check_read(place, &own.encoding, limits.low)?;
                check_read(place, &own.encoding, limits.high)?;
                check_order(place, &limits)
            }
            FieldSpec::Mapped(entry) => self.entry(place, entry),
            FieldSpec::InputRule(rule) => self.rule(place, rule),
            _ => {
                *self = Self { field: own_of(field, rest), ..Self::default() };
                Ok(())
            }
        }
    }

    fn own(&self, place: Place) -> Result<Own<'c>, ConfigError> {
        match self.field {
            None => Err(ConfigError { place, kind: Kind::NothingToRule }),
            Some(Own { overflow: Overflow::Wrap, .. }) => {
                Err(ConfigError { place, kind: Kind::LimitsAndWrap })
            }
            Some(own) => Ok(own),
        }
    }

    fn entry(&mut self, place: Place, entry: MapEntry) -> Check {
        let own = self.own(place)?;
        if self.has_limits {
            return fail(place, Kind::LimitsAndMap);
        }
        if own.is_scaled {
            return fail(place, Kind::ScaledMap);
        }
        let before =
            own.all.get(1..).unwrap_or(&[]).iter().filter(|field| matches!(field, FieldSpec::Mapped(_)));
        let before = before.take(self.entries);
        self.entries = self.entries.saturating_add(1);
        check_entry(place, None, &entry, before)?;
        self.becomes(place, own, entry.sent)
    }

    /// Whether the variable can have a number of a table.
    fn becomes(&self, place: Place, own: Own<'_>, number: f64) -> Check {
        let fits = match self.is_int16 {
            true => (-32_768.0..=32_767.0).contains(&number),
            false => bind_to_variable(own.var, Scalar::Double(number), 1.0, 0.0).is_some(),
        };
        let is_whole = own.var.ty() == ScalarType::Float || crate::image::round(number) == number;
        if fits && is_whole {
            Ok(())
        } else {
            fail(place, Kind::NotInVariable { var: own.var, value: number })
        }
    }

    fn rule(&mut self, place: Place, rule: InputRule) -> Check {
        let Some(own) = self.field else { return fail(place, Kind::NothingToRule) };
        match rule {
            InputRule::Int16 => {
                self.own(place)?;
                if own.var.ty() != ScalarType::Word {
                    return fail(place, Kind::NotAWord { var: own.var });
                }
                // What a table has is judged by it.
                if self.entries > 0 || self.has_else || core::mem::replace(&mut self.is_int16, true) {
                    return fail(place, Kind::RuleTwice);
                }
                Ok(())
            }
            InputRule::Else(number) => {
                self.own(place)?;
                if self.entries == 0 {
                    return fail(place, Kind::ElseWithoutMap);
                }
                if core::mem::replace(&mut self.has_else, true) {
                    return fail(place, Kind::RuleTwice);
                }
                self.becomes(place, own, number)
            }
            InputRule::NoNumber(code) => {
                let is_float =
                    matches!(own.encoding.kind, EncodingKind::Scalar(ScalarType::Float | ScalarType::Double));
                if code.is_nan() && is_float {
                    return Ok(());
                }
                check_read(place, &own.encoding, code)
            }
            InputRule::NoText(_) => {
                let is_digits = own.encoding.is_digits();
                if is_digits { Ok(()) } else { fail(place, Kind::NoTextNeedsDigits) }
            }
            InputRule::Comma => {
                let is_decimal = matches!(own.encoding.kind, EncodingKind::Decimal(_));
                if !is_decimal || own.encoding.until() == Some(b',') {
                    return fail(place, Kind::NoComma);
                }
                Ok(())
            }
            InputRule::ValidTo { var, bit } => {
                if core::mem::replace(&mut self.has_valid, true) {
                    return fail(place, Kind::RuleTwice);
                }
                if var.direction() != Direction::Input {
                    return fail(place, Kind::NotAnInput { var });
                }
                match bit {
                    Some(bit) => {
                        check_bit(VarBit { var, bit }).map(|_| ()).map_err(|kind| ConfigError { place, kind })
                    }
                    None if var.ty() == ScalarType::Word => Ok(()),
                    None => fail(place, Kind::NotAWord { var }),
                }
            }
        }
    }
}

/// Checks that a number can be read from a field.
pub(super) fn check_read(place: Place, encoding: &Encoding, value: f64) -> Check {
    let (low, high) = encoding.range();
    if !(low..=high).contains(&value) {
        return fail(place, Kind::NotInField { value, low, high });
    }
    let is_possible = !encoding.reads_integers() || crate::image::round(value) == value;
    if is_possible { Ok(()) } else { fail(place, Kind::FractionOfInteger { value }) }
}

/// A field that writes a variable as a whole.
fn own_of<'c>(field: &FieldSpec, all: &'c [FieldSpec]) -> Option<Own<'c>> {
    let (encoding, overflow, to) = match *field {
        FieldSpec::UserInput { ty, to } => (Encoding::scalar(ty), Overflow::Usual, to),
        FieldSpec::DeviceInput { encoding, overflow, to } => (encoding, overflow, to),
        _ => return None,
    };
    let InputBinding::Variable { var, scale, offset } = to else { return None };
    let is_scaled = (scale, offset) != (1.0, 0.0);
    Some(Own { encoding, overflow, var, is_scaled, all })
}
