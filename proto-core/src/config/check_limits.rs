//! Checks of the entries that follow a field: limits, tables of numbers, rules of input fields.
//!
//! In: the fields of a frame, in order. Out: nothing, or an error in one of them.

use super::error::{ConfigError, ConfigErrorKind as Kind, Place};
use super::rules::{Check, check_bit, fail};
use super::{FieldSpec, InputBinding, InputRule, Limits, MapEntry, OutputBinding};
use crate::device::{Digits, Encoding, Kind as EncodingKind, Overflow};
use crate::image::{bind_to_variable, round};
use crate::sysvar::{Direction, SysVar, VarBit};
use crate::wire::scalar::{Scalar, ScalarType};

/// Checks the entries that follow an output field, while the fields of a frame are checked in order.
#[derive(Default)]
pub(super) struct Behind<'c> {
    /// The output field, and the rest of the fields, beginning with it.
    field: Option<(Encoding, Overflow, OutputBinding, &'c [FieldSpec])>,
    has_limits: bool,
    /// Number of table entries so far.
    entries: usize,
}

impl<'c> Behind<'c> {
    /// Checks the first field of `rest`.
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

    /// The output field to which the entry belongs.
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

/// Whether the source is a count, which wraps in its field.
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

fn check_order(place: Place, limits: &Limits) -> Check {
    let Limits { low, high, .. } = *limits;
    if low > high { fail(place, Kind::BackwardLimits { low, high }) } else { Ok(()) }
}

/// `encoding` is that of the field with the entry's number, if there is one.
fn check_entry<'c>(
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

/// Checks that a number can be sent unchanged in a field.
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

/// Checks the entries that follow an input field, while the fields of a frame are checked in order.
#[derive(Default)]
pub(super) struct BehindInput<'c> {
    field: Option<Own<'c>>,
    has_limits: bool,
    /// Number of table entries so far.
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
    /// The rest of the fields, beginning with it.
    all: &'c [FieldSpec],
}

impl<'c> BehindInput<'c> {
    /// Checks the first field of `rest`.
    pub(super) fn check(&mut self, place: Place, rest: &'c [FieldSpec]) -> Check {
        let Some((field, _)) = rest.split_first() else { return Ok(()) };
        match *field {
            FieldSpec::Limits(limits) => {
                let own = self.own(place)?;
                if self.has_limits || self.entries > 0 {
                    return fail(place, Kind::LimitsAndMap);
                }
                self.has_limits = true;
                check_number_read(place, &own.encoding, limits.low)?;
                check_number_read(place, &own.encoding, limits.high)?;
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

    /// Checks that the variable can have a number from a table.
    fn becomes(&self, place: Place, own: Own<'_>, number: f64) -> Check {
        let fits = match self.is_int16 {
            true => (-32_768.0..=32_767.0).contains(&number),
            false => bind_to_variable(own.var, Scalar::Double(number), 1.0, 0.0).is_some(),
        };
        let is_whole = own.var.ty() == ScalarType::Float || round(number) == number;
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
                // The numbers of a table depend on this rule, so it must come first.
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
                check_number_read(place, &own.encoding, code)
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

/// Checks that a number can be received in a field.
///
/// # Errors
/// [`ConfigErrorKind::NotInField`](Kind::NotInField) or [`ConfigErrorKind::FractionOfInteger`](Kind::FractionOfInteger).
pub fn check_read(encoding: &Encoding, value: f64) -> Result<(), Kind> {
    let (low, high) = encoding.range();
    if !(low..=high).contains(&value) {
        return Err(Kind::NotInField { value, low, high });
    }
    let is_possible = !encoding.reads_integers() || round(value) == value;
    if is_possible { Ok(()) } else { Err(Kind::FractionOfInteger { value }) }
}

pub(super) fn check_number_read(place: Place, encoding: &Encoding, value: f64) -> Check {
    check_read(encoding, value).map_err(|kind| ConfigError { place, kind })
}

/// The input field, if it writes a variable as a whole.
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
