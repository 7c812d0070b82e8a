//! Limits of a field's number, tables of numbers, and rules of input fields.
//!
//! These entries follow their field in the list of fields, so fields without them need no extra space. They have no
//! bytes in the frame. If an output field's number is not allowed, the frame is not sent; only [`Outside::Clamp`] sends
//! another number. Input fields can have entries if they write a variable as a whole. Nothing here is checked;
//! `check_limits.rs` does that.

use crate::device::Encoding;
use crate::image::round;
use crate::sysvar::{SysVar, VarBit};

/// Maximum number of limits and entries of tables of numbers on all ports together.
pub const MAX_SENDABLE: usize = 64;

/// The numbers that an output field may send, or that an input field accepts.
#[derive(Debug, Clone, Copy, PartialEq)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
pub struct Limits {
    /// The lowest number in the frame: for an output field after scale and offset, for an input field before them.
    pub low: f64,
    /// The highest number.
    pub high: f64,
    /// What happens to a number out of the limits.
    pub outside: Outside,
}

/// What happens to a number out of the limits of its field.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
pub enum Outside {
    /// The frame is not sent, or the input field is rejected.
    #[default]
    Refuse,
    /// The nearer limit is used.
    Clamp,
}

/// One entry of a field's table. For an output field: for these values of the source it sends this number; for a value
/// in no entry the frame is not sent. For an input field: for these values the variable gets this number.
#[derive(Debug, Clone, Copy, PartialEq)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
pub struct MapEntry {
    /// The first value.
    pub first: i64,
    /// The last value.
    pub last: i64,
    /// The number to send, or the number for the variable.
    pub sent: f64,
}

impl Limits {
    /// The number to send for `number`; NaN if it is not allowed.
    pub(crate) fn apply(&self, encoding: &Encoding, number: f64) -> f64 {
        self.apply_to(encoding.is_integer(), number)
    }

    /// The number to use for `number`; NaN if it is not allowed.
    pub(crate) fn take(&self, encoding: &Encoding, number: f64) -> f64 {
        self.apply_to(encoding.reads_integers(), number)
    }

    fn apply_to(&self, is_integer: bool, number: f64) -> f64 {
        // A scale such as 0.1 is inexact, so numbers that a float cannot distinguish from a limit are within it.
        let near = |number: f64| if is_integer { round(number) } else { f64::from(number as f32) };
        let is_inside = near(number) >= near(self.low) && near(number) <= near(self.high);
        if number.is_nan() || !is_inside && self.outside == Outside::Refuse {
            return f64::NAN;
        }
        number.max(self.low).min(self.high)
    }
}

impl MapEntry {
    /// Whether the entry is for this value after rounding.
    pub(crate) fn has(&self, value: f64) -> bool {
        let value = round(value);
        value >= self.first as f64 && value <= self.last as f64
    }
}

/// Maximum number of characters of a text for "no value".
pub const NO_TEXT: usize = 8;

/// A text for "no value", such as `----`.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
pub struct NoText {
    len: u8,
    bytes: [u8; NO_TEXT],
}

impl NoText {
    /// A text of 1..=[`NO_TEXT`] printable ASCII characters, without spaces at its ends; otherwise `None`.
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

    /// The characters.
    pub fn bytes(&self) -> &[u8] {
        self.bytes.get(..usize::from(self.len)).unwrap_or(&[])
    }
}

/// A rule for the value of the input field before it.
#[derive(Debug, Clone, Copy, PartialEq)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
#[non_exhaustive]
pub enum InputRule {
    /// A word register holds the value in two's complement: -32768..=32767 after scale and offset.
    Int16,
    /// The variable gets this number for values in no [`MapEntry`]; without this rule the field is rejected.
    Else(f64),
    /// This number means "no value".
    NoNumber(f64),
    /// This text means "no value", also with spaces around it; only for fields of digits.
    NoText(NoText),
    /// A decimal field has a comma as decimal point.
    Comma,
    /// This variable, a word register or one bit, is 1 while the field's newest value is accepted, and 0 if it is
    /// rejected, missing or overdue.
    ValidTo {
        /// An input variable.
        var: SysVar,
        /// Bit 0..=7; `None` for a word register.
        bit: Option<u8>,
    },
}

impl InputRule {
    /// The word register of [`Self::ValidTo`].
    pub(super) const fn variable(self) -> Option<SysVar> {
        match self {
            Self::ValidTo { var, bit: None } => Some(var),
            _ => None,
        }
    }

    /// The bit of [`Self::ValidTo`].
    pub(super) const fn bit(self) -> Option<VarBit> {
        match self {
            Self::ValidTo { var, bit: Some(bit) } => Some(VarBit { var, bit }),
            _ => None,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::wire::scalar::ScalarType;

    fn limits(outside: Outside) -> Limits {
        Limits { low: -10.0, high: 100.0, outside }
    }

    #[test]
    fn a_number_outside_is_not_sent_unless_it_is_to_be_clamped() {
        let word = Encoding::scalar(ScalarType::Short);
        let sent = |outside, number| limits(outside).apply(&word, number);
        for number in [-10.0, 0.0, 100.0] {
            assert_eq!(sent(Outside::Refuse, number), number);
            assert_eq!(sent(Outside::Clamp, number), number);
        }
        for (number, nearest) in [(-11.0, -10.0), (101.0, 100.0), (1e300, 100.0), (f64::INFINITY, 100.0)] {
            assert!(sent(Outside::Refuse, number).is_nan());
            assert_eq!(sent(Outside::Clamp, number), nearest);
        }
        // Integer fields send the rounded number.
        assert_eq!(sent(Outside::Refuse, 100.4), 100.0);
        assert!(sent(Outside::Refuse, 100.5).is_nan());
        assert!(sent(Outside::Refuse, f64::NAN).is_nan());
        assert!(sent(Outside::Clamp, f64::NAN).is_nan());
    }

    #[test]
    fn a_scale_that_no_float_has_exactly_does_not_push_a_number_over_its_limit() {
        let double = Encoding::scalar(ScalarType::Double);
        let number = 1000.0 * f64::from(0.1_f32);
        assert!(number > 100.0);
        assert_eq!(limits(Outside::Refuse).apply(&double, number), 100.0);
        assert!(limits(Outside::Refuse).apply(&double, 100.001).is_nan());
    }

    #[test]
    fn a_table_takes_rounded_values() {
        let entry = MapEntry { first: -2, last: 3, sent: 7.0 };
        for (value, has) in [(-2.4, true), (-2.6, false), (3.4, true), (3.5, false), (f64::NAN, false)] {
            assert_eq!(entry.has(value), has, "{value}");
        }
    }
}
