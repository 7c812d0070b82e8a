//! The rules of input fields of devices: limits, tables, "no value", two's complement, and a variable that shows
//! whether a value was taken.
//!
//! In: the number of a field, or why it could not be read. Out: the value of its variable, or why there is none. Rules
//! are stored as single words after the bindings of their port, so fields without rules take no memory for them. Does
//! not know frames.

use heapless::Vec;

use super::bindings::{InputBind, InputTo, Rule, RuleKind, Written};
use crate::config::{
    FieldSpec, InputBinding, InputRule, Limits, MapEntry, NO_TEXT, Outside, fitting_numbers,
};
use crate::device::{Element, Encoding, Kind, MAX_DIGITS, Overflow, Unreadable};
use crate::engine::rejection::Rejection;
use crate::image::{bind_to_variable, round};
use crate::sysvar::SysVar;
use crate::wire::scalar::{Scalar, ScalarType};

pub(crate) fn words_of(field: &FieldSpec) -> impl Iterator<Item = InputBind> + use<> {
    let mut words = [None; 3];
    let number = |is, number: f64| Some(Rule::new(is, number.to_bits()));
    match *field {
        FieldSpec::Limits(Limits { low, high, outside }) => {
            let clamps = (outside == Outside::Clamp).then_some(Rule::new(RuleKind::Clamps, 0));
            words = [clamps, number(RuleKind::Low, low), number(RuleKind::High, high)];
        }
        FieldSpec::Mapped(MapEntry { first, last, sent }) => {
            let value = |is, value: i64| Some(Rule::new(is, value.cast_unsigned()));
            words =
                [value(RuleKind::First, first), value(RuleKind::Last, last), number(RuleKind::Becomes, sent)];
        }
        FieldSpec::InputRule(rule) => {
            words[0] = match rule {
                InputRule::Int16 => Some(Rule::new(RuleKind::TwosComplement, 0)),
                InputRule::Comma => Some(Rule::new(RuleKind::Comma, 0)),
                InputRule::Else(becomes) => number(RuleKind::Else, becomes),
                InputRule::NoNumber(code) => number(RuleKind::NoNumber, code),
                InputRule::NoText(text) => {
                    let bytes = text.bytes();
                    let mut padded = [0; NO_TEXT];
                    padded.iter_mut().zip(bytes).for_each(|(slot, &byte)| *slot = byte);
                    Some(Rule::new(RuleKind::NoText(bytes.len() as u8), u64::from_le_bytes(padded)))
                }
                InputRule::ValidTo { var, bit } => {
                    let mask = bit.map_or(0, |bit| 1_u64.unbounded_shl(bit.into()));
                    Some(Rule::new(RuleKind::ValidTo, mask.unbounded_shl(32) | var.ordinal() as u64))
                }
            };
        }
        _ => {}
    }
    words.into_iter().flatten().map(Rule::to_bind)
}

/// The first word of a variable's rules.
pub(crate) fn scale_word(scale: f32, offset: f32) -> InputBind {
    let high = u64::from(scale.to_bits()).unbounded_shl(32);
    Rule::new(RuleKind::Scale, high | u64::from(offset.to_bits())).to_bind()
}

/// The verdict on the value of an input field that writes a variable.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Taken {
    /// The variable takes this value.
    Value(Scalar),
    /// The device says that it has no value now.
    NoValue,
    /// The field is rejected.
    Rejected(Rejection),
}

/// The verdict on the value of an input field. `fields` are the field, then its rules, `bytes` those of the field in
/// its frame, `value` the result of [`Encoding::read`]. Also returns the lowest and the highest number that is taken,
/// if not all are. `None` if the field writes no variable as a whole.
///
/// For tools that show frames; the engine does the same.
pub fn judge_field(
    fields: &[FieldSpec],
    value: Result<Scalar, Unreadable>,
    bytes: &[u8],
) -> Option<(Taken, Option<(f64, f64)>)> {
    let (to, element) = match *fields.first()? {
        FieldSpec::UserInput { to, .. } | FieldSpec::DeviceInput { to, .. } => {
            (to, fields.first()?.element()?)
        }
        _ => return None,
    };
    let InputBinding::Variable { var, scale, offset } = to else { return None };
    let mut words: Vec<InputBind, { u8::MAX as usize }> = Vec::new();
    words.push(scale_word(scale, offset)).ok()?;
    let behind = fields.iter().skip(1).take_while(|field| field.is_of_field_before());
    behind.flat_map(words_of).try_for_each(|word| words.push(word)).ok()?;
    let binding = InputBind::new(InputTo::Ruled { var, first: 0, count: words.len() as u8 }, element);
    let rules = Rules::of(&binding, &words)?;
    Some((rules.take(value, || Some(bytes)), rules.range()))
}

/// The variable of a field, and the range of numbers it takes.
pub(crate) fn allowed(binding: &InputBind, all: &[InputBind]) -> (Option<SysVar>, Option<(f64, f64)>) {
    if let Some(rules) = Rules::of(binding, all) {
        return (binding.to.variable(), rules.range());
    }
    match (binding.to, binding.element().encoding()) {
        (InputTo::Variable { var, scale, offset }, Some(encoding)) => {
            let wraps = matches!(binding.written, Written::Value { overflow: Overflow::Wrap, .. });
            let fitting = fitting_numbers(&encoding, (var, var.ty()), scale, offset);
            (Some(var), fitting.filter(|_| !wraps))
        }
        (InputTo::Variable { var, .. } | InputTo::Bits { var, .. }, _) => (Some(var), None),
        _ => (None, None),
    }
}

#[derive(Clone, Copy)]
pub(crate) struct Rules<'a> {
    words: &'a [InputBind],
    var: SysVar,
    encoding: Option<Encoding>,
    overflow: Overflow,
}

impl<'a> Rules<'a> {
    /// The rules of a field among the bindings of all ports; `None` if it has none.
    pub(crate) fn of(binding: &InputBind, all: &'a [InputBind]) -> Option<Self> {
        let InputTo::Ruled { var, first, count } = binding.to else { return None };
        let start = usize::from(first);
        let words = all.get(start..start.saturating_add(usize::from(count))).unwrap_or(&[]);
        let element = binding.element();
        let overflow = if let Element::Value { overflow, .. } = element { overflow } else { Overflow::Usual };
        Some(Self { words, var, encoding: element.encoding(), overflow })
    }

    fn iter(self) -> impl Iterator<Item = Rule> + 'a {
        self.words.iter().filter_map(|word| if let InputTo::Rule(rule) = word.to { Some(rule) } else { None })
    }

    fn find(self, kind: RuleKind) -> Option<Rule> {
        self.iter().find(|rule| rule.kind == kind)
    }

    /// The variable, or bits of it, that shows whether a value was taken.
    pub(crate) fn valid_to(self) -> Option<(SysVar, u8)> {
        let rule = self.find(RuleKind::ValidTo)?;
        let [mask, var] = rule.halves();
        SysVar::from_ordinal(var as usize).map(|var| (var, mask as u8))
    }

    /// The lowest and the highest number within the limits.
    pub(crate) fn limits(self) -> Option<(f64, f64)> {
        Some((self.find(RuleKind::Low)?.number(), self.find(RuleKind::High)?.number()))
    }

    /// The verdict on a number, or on bytes that are none. `bytes` are those of the field.
    pub(crate) fn take(
        self,
        value: Result<Scalar, Unreadable>,
        bytes: impl FnOnce() -> Option<&'a [u8]>,
    ) -> Taken {
        let needs_bytes = self.iter().any(|rule| matches!(rule.kind, RuleKind::NoText(_) | RuleKind::Comma));
        let bytes = if needs_bytes { bytes() } else { None };
        if bytes.is_some_and(|bytes| self.is_no_text(bytes)) {
            return Taken::NoValue;
        }
        let value = match self.find(RuleKind::Comma) {
            None => value,
            Some(_) => read_comma(self.encoding, bytes.unwrap_or(&[])),
        };
        let Ok(value) = value else { return Taken::Rejected(Rejection::Unreadable) };
        let number = value.as_f64();
        let is_single = self.encoding.is_some_and(|own| own.kind == Kind::Scalar(ScalarType::Float));
        let is_code = |rule: Rule| {
            let code = rule.number();
            let is_same = code == number || is_single && code as f32 == number as f32;
            rule.kind == RuleKind::NoNumber && (is_same || code.is_nan() && number.is_nan())
        };
        if self.iter().any(is_code) {
            return Taken::NoValue;
        }
        if !value.is_finite() {
            return Taken::Rejected(Rejection::NotFinite);
        }
        match self.becomes(number) {
            Some(value) => Taken::Value(value),
            None => Taken::Rejected(Rejection::OutOfRange),
        }
    }

    fn is_no_text(self, bytes: &[u8]) -> bool {
        let bytes = bytes.trim_ascii();
        self.iter().any(|rule| {
            let RuleKind::NoText(len) = rule.kind else { return false };
            rule.bits().to_le_bytes().get(..usize::from(len)) == Some(bytes)
        })
    }

    /// The value of the variable for a number.
    fn becomes(self, number: f64) -> Option<Scalar> {
        let number = match self.mapped(number) {
            Some(number) => number?,
            None => {
                let number = self.limited(number)?;
                let (scale, offset) = self.scale();
                number * f64::from(scale) + f64::from(offset)
            }
        };
        if self.find(RuleKind::TwosComplement).is_some() {
            let number = round(number);
            let is_short = (f64::from(i16::MIN)..=f64::from(i16::MAX)).contains(&number);
            return is_short.then(|| Scalar::Word((number as i16).cast_unsigned()));
        }
        let number = match self.overflow {
            Overflow::Wrap => Encoding::scalar(self.var.ty()).fit(number, Overflow::Wrap)?,
            Overflow::Usual => number,
        };
        bind_to_variable(self.var, Scalar::Double(number), 1.0, 0.0)
    }

    pub(crate) fn scale(self) -> (f32, f32) {
        self.find(RuleKind::Scale).map_or((1.0, 0.0), |rule| rule.halves().map(f32::from_bits).into())
    }

    fn limited(self, number: f64) -> Option<f64> {
        let (Some((low, high)), Some(encoding)) = (self.limits(), &self.encoding) else {
            return Some(number);
        };
        let outside = if self.find(RuleKind::Clamps).is_some() { Outside::Clamp } else { Outside::Refuse };
        let number = Limits { low, high, outside }.take(encoding, number);
        (!number.is_nan()).then_some(number)
    }

    /// The number's entry in the table; `None` without a table.
    fn mapped(self, number: f64) -> Option<Option<f64>> {
        let (mut first, mut last, mut is_table) = (0_i64, 0_i64, false);
        for rule in self.iter() {
            match rule.kind {
                RuleKind::First => first = rule.bits().cast_signed(),
                RuleKind::Last => last = rule.bits().cast_signed(),
                RuleKind::Becomes => {
                    is_table = true;
                    if (MapEntry { first, last, sent: 0.0 }).has(number) {
                        return Some(Some(rule.number()));
                    }
                }
                _ => {}
            }
        }
        is_table.then(|| self.find(RuleKind::Else).map(Rule::number))
    }

    /// The range of numbers that the variable takes, before scale and offset; `None` if it is not a single range.
    pub(crate) fn range(self) -> Option<(f64, f64)> {
        let is_table = self.find(RuleKind::Becomes).is_some();
        let of_limits = self.limits().filter(|_| self.find(RuleKind::Clamps).is_none());
        if is_table || self.overflow == Overflow::Wrap {
            return of_limits.filter(|_| !is_table);
        }
        let variable =
            if self.find(RuleKind::TwosComplement).is_some() { ScalarType::Short } else { self.var.ty() };
        let (scale, offset) = self.scale();
        let fitting = self
            .encoding
            .and_then(|encoding| fitting_numbers(&encoding, (self.var, variable), scale, offset));
        match (fitting, of_limits) {
            (Some((low, high)), Some((least, most))) => Some((low.max(least), high.min(most))),
            (fitting, limits) => fitting.or(limits),
        }
    }
}

/// Reads a decimal number with a comma instead of a point.
fn read_comma(encoding: Option<Encoding>, bytes: &[u8]) -> Result<Scalar, Unreadable> {
    let mut digits = [0; MAX_DIGITS];
    let digits = digits.get_mut(..bytes.len()).ok_or(Unreadable::TooLarge)?;
    for (slot, &byte) in digits.iter_mut().zip(bytes) {
        *slot = match byte {
            b',' => b'.',
            b'.' => return Err(Unreadable::NotADigit),
            byte => byte,
        };
    }
    encoding.ok_or(Unreadable::Length)?.read(digits)
}
