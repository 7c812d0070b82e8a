//! What the number of an output field may be: limits, or a table of the numbers that are sent. Input fields have the same
//! (`input_rule.rs`).
//!
//! Both stand behind their field, as entries of their own, so that fields without them have no room for
//! them. Frames have nothing in their place. A number that is not allowed is not sent, and with it the
//! frame: only [`Outside::Clamp`] sends another one.

use super::error::{ConfigError, ConfigErrorKind as Kind, Place};
use super::rules::{Check, fail};
use super::{FieldSpec, OutputBinding};
use crate::device::{Digits, Encoding, Kind as EncodingKind, Overflow};
use crate::image::round;

/// Maximum number of limits and entries of tables of numbers on all ports together.
pub const MAX_SENDABLE: usize = 64;

/// The numbers that an output field may send, of those that fit it; or those that an input field takes.
#[derive(Debug, Clone, Copy, PartialEq)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
pub struct Limits {
    /// The lowest number, as the frame has it: of an output field after scale and offset, of an input field before.
    pub low: f64,
    /// The highest number.
    pub high: f64,
    /// What becomes of another one.
    pub outside: Outside,
}

/// What becomes of a number outside of its field's limits.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
pub enum Outside {
    /// It is not sent, nor is its frame. An input field with it is rejected.
    #[default]
    Refuse,
    /// The nearer limit is sent, or taken.
    Clamp,
}

/// One entry of the table of an output field: these values of its source send this number. A value in no
/// entry is not sent, nor is its frame. Of an input field: for these values its variable becomes this number.
#[derive(Debug, Clone, Copy, PartialEq)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
pub struct MapEntry {
    /// The first value.
    pub first: i64,
    /// The last value.
    pub last: i64,
    /// The number that is sent, or that the variable becomes.
    pub sent: f64,
}

impl Limits {
    /// The number that is sent for `number`; not a number if none is.
    pub(crate) fn apply(&self, encoding: &Encoding, number: f64) -> f64 {
        self.apply_to(encoding.is_integer(), number)
    }

    /// The number that is taken for `number`; not a number if none is.
    pub(crate) fn take(&self, encoding: &Encoding, number: f64) -> f64 {
        self.apply_to(encoding.reads_integers(), number)
    }

    fn apply_to(&self, is_integer: bool, number: f64) -> f64 {
        // A scale such as 0.1 is a little more than it is written, so numbers that a float does not tell
        // from a limit are within it.
        let near = |number: f64| if is_integer { round(number) } else { f64::from(number as f32) };
        let is_inside = near(number) >= near(self.low) && near(number) <= near(self.high);
        if number.is_nan() || !is_inside && self.outside == Outside::Refuse {
            return f64::NAN;
        }
        number.max(self.low).min(self.high)
    }
}

impl MapEntry {
    /// Whether the entry is for this value, rounded.
    pub(crate) fn has(&self, value: f64) -> bool {
        let value = round(value);
        value >= self.first as f64 && value <= self.last as f64
    }
}

impl FieldSpec {
    /// Whether it only says what the field before it may send, or what becomes of its value.
    pub const fn is_of_field_before(&self) -> bool {
        matches!(self, Self::Limits(_) | Self::Mapped(_) | Self::InputRule(_))
    }
}

/// What stands behind a field, while the fields of a frame are checked in order.
#[derive(Default)]
pub(super) struct Behind<'c> {
    /// The output field, and all from it on.
    field: Option<(Encoding, Overflow, OutputBinding, &'c [FieldSpec])>,
    has_limits: bool,
    /// Entries of its table so far.
    entries: usize,
}

impl<'c> Behind<'c> {
    /// Looks at the first of these fields, the rest of a frame's.
    pub(super) fn check(&mut self, place: Place, rest: &'c [FieldSpec]) -> Check {
        let Some((field, _)) = rest.split_first() else { return Ok(()) };
        match *field {
            FieldSpec::Limits(limits) => {
                let (encoding, from) = self.bound(place)?;
                if self.has_limits || self.entries > 0 {
                    return fail(place, Kind::LimitsAndMap);
                }
                if is_count(from) {
                    return fail(place, Kind::LimitedCount);
                }
                self.has_limits = true;
                check_limits(place, &encoding, &limits)
            }
            FieldSpec::Mapped(entry) => {
                let (encoding, from) = self.bound(place)?;
                if self.has_limits {
                    return fail(place, Kind::LimitsAndMap);
                }
                if is_count(from) {
                    return fail(place, Kind::LimitedCount);
                }
                if is_scaled(from) {
                    return fail(place, Kind::ScaledMap);
                }
                let before = self.field.map_or(&[][..], |(.., all)| all);
                let before = before.get(1..).unwrap_or(&[]).iter().take(self.entries);
                self.entries = self.entries.saturating_add(1);
                check_entry(place, Some(&encoding), &entry, before)
            }
            FieldSpec::UserOutput { ty, from } => {
                self.begin(Some((Encoding::scalar(ty), Overflow::Usual, from, rest)));
                Ok(())
            }
            FieldSpec::DeviceOutput { encoding, overflow, from } => {
                self.begin(Some((encoding, overflow, from, rest)));
                Ok(())
            }
            _ => {
                self.begin(None);
                Ok(())
            }
        }
    }

    fn begin(&mut self, field: Option<(Encoding, Overflow, OutputBinding, &'c [FieldSpec])>) {
        *self = Self { field, ..Self::default() };
    }

    /// The field that it stands behind.
    fn bound(&self, place: Place) -> Result<(Encoding, OutputBinding), ConfigError> {
        match self.field {
            Some((_, Overflow::Wrap, ..)) => Err(ConfigError { place, kind: Kind::LimitsAndWrap }),
            Some((_, _, OutputBinding::Constant(_), _)) | None => {
                Err(ConfigError { place, kind: Kind::NothingToLimit })
            }
            Some((encoding, _, from, _)) => Ok((encoding, from)),
        }
    }
}

/// Counts wrap in their field.
const fn is_count(from: OutputBinding) -> bool {
    match from {
        OutputBinding::Counter | OutputBinding::CounterTo { .. } => true,
        OutputBinding::Port { value, .. } => value.is_count(),
        _ => false,
    }
}

fn is_scaled(from: OutputBinding) -> bool {
    match from {
        OutputBinding::Variable { scale, offset, .. }
        | OutputBinding::State { scale, offset, .. }
        | OutputBinding::Port { scale, offset, .. }
        | OutputBinding::Link { scale, offset, .. } => (scale, offset) != (1.0, 0.0),
        _ => false,
    }
}

fn check_limits(place: Place, encoding: &Encoding, limits: &Limits) -> Check {
    check_number(place, encoding, limits.low)?;
    check_number(place, encoding, limits.high)?;
    check_order(place, limits)
}

pub(super) fn check_order(place: Place, limits: &Limits) -> Check {
    let Limits { low, high, .. } = *limits;
    if low > high { fail(place, Kind::BackwardLimits { low, high }) } else { Ok(()) }
}

/// `encoding` is of the field that has the number of the entry, if one has.
pub(super) fn check_entry<'c>(
    place: Place,
    encoding: Option<&Encoding>,
    entry: &MapEntry,
    before: impl Iterator<Item = &'c FieldSpec>,
) -> Check {
    let &MapEntry { first, last, sent } = entry;
    if first > last {
        return fail(place, Kind::BackwardRange { first, last });
    }
    if let Some(encoding) = encoding {
        check_number(place, encoding, sent)?;
    }
    let others = before.filter_map(|field| match field {
        FieldSpec::Mapped(other) => Some(other),
        _ => None,
    });
    let mut common = others.map(|other| (first.max(other.first), last.min(other.last)));
    match common.find(|(first, last)| first <= last) {
        Some((value, _)) => fail(place, Kind::MappedTwice { value }),
        None => Ok(()),
    }
}

/// Checks that a field can have a number as it is, so that it is sent unchanged.
///
/// # Errors
/// [`ConfigErrorKind::NotInField`](Kind::NotInField), [`ConfigErrorKind::FractionOfInteger`](Kind::FractionOfInteger)
/// or [`ConfigErrorKind::TooManyDecimals`](Kind::TooManyDecimals).
pub fn check_sent(encoding: &Encoding, value: f64) -> Result<(), Kind> {
    let (low, high) = encoding.range();
    if !(low..=high).contains(&value) {
        return Err(Kind::NotInField { value, low, high });
    }
    if encoding.is_integer() {
        return if round(value) == value { Ok(()) } else { Err(Kind::FractionOfInteger { value }) };
    }
    let EncodingKind::Decimal(Digits { decimals, .. }) = encoding.kind else { return Ok(()) };
    let unit = (0..decimals).fold(1.0, |unit, _| unit * 10.0);
    let steps = value * unit;
    let is_whole = (round(steps) - steps).abs() < 1e-6 * steps.abs().max(1.0);
    if is_whole { Ok(()) } else { Err(Kind::TooManyDecimals { value, decimals }) }
}

fn check_number(place: Place, encoding: &Encoding, value: f64) -> Check {
    check_sent(encoding, value).map_err(|kind| ConfigError { place, kind })
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
        // An integer field has the rounded number.
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
