//! The compiled bindings of user-defined fields.

use heapless::{Vec, VecView};

use crate::config::{FieldSpec, Limits, MAX_SENDABLE, MapEntry, OutputBinding, Span};
use crate::device::{Element, Encoding, Length, Overflow, Text, wrap};
use crate::engine::io::ReplyCode;
use crate::engine::link::command::CommandLink;
use crate::image::{Image, bind_to_variable, saturate_to_field};
use crate::recipe::model::MAX_FIELDS;
use crate::sysvar::SysVar;
use crate::time::Instant;
use crate::wire::scalar::{Scalar, ScalarType};

/// How a field is encoded in a device frame: an [`Element`] without its constant, at half the size, because every field
/// of every port has one.
#[derive(Debug, Clone, Copy)]
pub(crate) enum Written {
    Value { encoding: Encoding, overflow: Overflow },
    Fixed { encoding: Encoding },
    Padding { len: u8, fill: u8 },
    Text(Text),
    Length(Length),
}

impl Written {
    pub(crate) const fn new(element: Element) -> Self {
        match element {
            Element::Value { encoding, overflow } => Self::Value { encoding, overflow },
            Element::Fixed { encoding, .. } => Self::Fixed { encoding },
            Element::Padding { len, fill } => Self::Padding { len, fill },
            Element::Text(text) => Self::Text(text),
            Element::Length(length) => Self::Length(length),
        }
    }

    const fn element(self, constant: i64) -> Element {
        match self {
            Self::Value { encoding, overflow } => Element::Value { encoding, overflow },
            Self::Fixed { encoding } => Element::Fixed { encoding, value: constant },
            Self::Padding { len, fill } => Element::Padding { len, fill },
            Self::Text(text) => Element::Text(text),
            Self::Length(length) => Element::Length(length),
        }
    }
}

/// An input field: where its value goes, and how it is encoded in a device frame.
#[derive(Debug, Clone, Copy)]
pub(crate) struct InputBind {
    pub to: InputTo,
    pub written: Written,
}

impl InputBind {
    pub(crate) fn new(to: InputTo, element: Element) -> Self {
        let to = match element {
            Element::Fixed { value, .. } => {
                InputTo::Fixed { high: value.unbounded_shr(32) as i32, low: value as u32 }
            }
            _ => to,
        };
        Self { to, written: Written::new(element) }
    }

    pub(crate) fn element(&self) -> Element {
        self.written.element(match self.to {
            InputTo::Fixed { high, low } => i64::from(high).unbounded_shl(32) | i64::from(low),
            _ => 0,
        })
    }
}

/// One word of the rules of a field: its meaning, and a number or bits.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Rule {
    pub kind: RuleKind,
    /// As bytes, which need no alignment, to keep a binding small.
    bits: [u8; 8],
}

/// The meaning of a word of a rule.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum RuleKind {
    /// Scale and offset.
    Scale,
    /// The variable takes the number in two's complement.
    TwosComplement,
    /// The lowest number; lower ones are rejected.
    Low,
    /// The highest number; higher ones are rejected.
    High,
    /// Numbers outside the limits become the nearest limit instead.
    Clamps,
    /// The first number of a map entry.
    First,
    /// The last number of a map entry.
    Last,
    /// The variable's value for numbers of the entry.
    Becomes,
    /// The variable's value for all other numbers.
    Else,
    /// A number that means "no value".
    NoNumber,
    /// A text that means "no value": its length; each word holds eight characters.
    NoText(u8),
    /// The digits have a decimal comma.
    Comma,
    /// The variable, or bits of it, that shows whether a value was taken.
    ValidTo,
}

impl Rule {
    pub(crate) const fn new(kind: RuleKind, number: u64) -> Self {
        Self { kind, bits: number.to_be_bytes() }
    }

    pub(crate) const fn bits(self) -> u64 {
        u64::from_be_bytes(self.bits)
    }

    pub(crate) const fn number(self) -> f64 {
        f64::from_bits(self.bits())
    }

    pub(crate) const fn halves(self) -> [u32; 2] {
        [self.bits().unbounded_shr(32) as u32, self.bits() as u32]
    }

    pub(crate) fn to_bind(self) -> InputBind {
        // A rule occupies no place in a frame.
        InputBind::new(InputTo::Rule(self), Element::Padding { len: 0, fill: 0 })
    }
}

/// Where the value of an input field goes.
#[derive(Debug, Clone, Copy)]
pub(crate) enum InputTo {
    Unused,
    Variable {
        var: SysVar,
        scale: f32,
        offset: f32,
    },
    /// Index of a command field of the command link.
    Command(u8),
    /// Bits of a byte variable: set unless the value is 0.
    Bits {
        var: SysVar,
        mask: u8,
    },
    /// Index of an alive counter.
    Counter(u8),
    /// A variable, by the rules at these places after the port's bindings.
    Ruled {
        var: SysVar,
        count: u8,
        first: u16,
    },
    /// A rule of such a field; not a field of a frame.
    Rule(Rule),
    /// A constant in halves, so that it needs no stricter alignment than the other variants.
    Fixed {
        high: i32,
        low: u32,
    },
}

impl InputTo {
    /// The variable that takes the value as a whole.
    pub(crate) const fn variable(&self) -> Option<SysVar> {
        match *self {
            Self::Variable { var, .. } | Self::Ruled { var, .. } => Some(var),
            _ => None,
        }
    }

    /// The variable and its new value for a received value; `None` if the value does not fit or the binding is not to a
    /// variable.
    pub(crate) fn bound(&self, value: Scalar) -> Option<(SysVar, Scalar)> {
        match *self {
            Self::Variable { var, scale, offset } => {
                bind_to_variable(var, value, scale, offset).map(|bound| (var, bound))
            }
            _ => None,
        }
    }
}

/// Whether every value fits the variable it is bound to (D22).
pub(crate) fn fit(bindings: &[InputBind], values: impl Iterator<Item = Scalar>) -> bool {
    bindings.iter().zip(values).all(|(binding, value)| match binding.to {
        InputTo::Variable { .. } => binding.to.bound(value).is_some(),
        _ => true,
    })
}

/// The frame with these fields is overdue: the next values pick no commands, except in fields that keep their base.
pub(crate) fn silence_commands(bindings: &[InputBind], commands: Option<&mut CommandLink>, now: Instant) {
    let Some(link) = commands else { return };
    for binding in bindings {
        if let InputTo::Command(field) = binding.to {
            link.silent(field, now);
        }
    }
}

/// The device is gone: the next values pick no commands, they only set the base.
pub(crate) fn forget_commands(bindings: &[InputBind], commands: Option<&mut CommandLink>, now: Instant) {
    let Some(link) = commands else { return };
    for binding in bindings {
        if let InputTo::Command(field) = binding.to {
            link.forget(field, now);
        }
    }
}

/// An output field: its type, the source of its value, and how it is encoded in a device frame. Packed, because there
/// are many and the constant alone would raise the alignment.
#[derive(Debug, Clone, Copy)]
#[repr(C, packed(2))]
pub(crate) struct OutputBind {
    pub from: OutputBinding,
    pub ty: ScalarType,
    /// The place of its value among the image's extra values, if it has one there.
    pub extra: u8,
    /// Number of limits or map entries that restrict what it may send, and the first of them.
    pub sendable: u8,
    pub first_sendable: u8,
    pub written: Written,
}

#[derive(Debug, Clone, Copy)]
pub(crate) enum Sendable {
    Limits(Limits),
    Entry(MapEntry),
}

impl Sendable {
    pub(crate) const fn new(field: &FieldSpec) -> Option<Self> {
        match *field {
            FieldSpec::Limits(limits) => Some(Self::Limits(limits)),
            FieldSpec::Mapped(entry) => Some(Self::Entry(entry)),
            _ => None,
        }
    }
}

/// The output bindings of all ports, and what their fields may send.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Outputs<'a> {
    pub binds: &'a [OutputBind],
    pub sendable: &'a [Sendable],
}

impl<'a> Outputs<'a> {
    /// The bindings of one frame or port.
    pub(crate) fn of(self, span: Span) -> Self {
        Self { binds: span.of(self.binds), ..self }
    }

    /// Whether one of these fields is restricted in what it may send.
    pub(crate) fn are_limited(self, span: Span) -> bool {
        !self.sendable.is_empty() && span.of(self.binds).iter().any(|bind| bind.sendable > 0)
    }

    /// The number to send for `number`; NaN if there is none.
    fn sent(self, binding: &OutputBind, number: f64) -> f64 {
        let allowed = self.sendable.iter().skip(usize::from(binding.first_sendable));
        let mut sent = f64::NAN;
        for sendable in allowed.take(usize::from(binding.sendable)) {
            match sendable {
                Sendable::Limits(limits) => {
                    return binding.element().encoding().map_or(sent, |own| limits.apply(&own, number));
                }
                Sendable::Entry(entry) if entry.has(number) => sent = entry.sent,
                Sendable::Entry(_) => {}
            }
        }
        sent
    }
}

impl OutputBind {
    pub(crate) fn new(ty: ScalarType, from: OutputBinding, element: Element) -> Self {
        let from = match element {
            // Exact: constants have at most 53 bits.
            Element::Fixed { value, .. } => OutputBinding::Constant(value as f64),
            _ => from,
        };
        Self { ty, from, extra: 0, sendable: 0, first_sendable: 0, written: Written::new(element) }
    }

    pub(crate) fn element(&self) -> Element {
        self.written.element(match self.from {
            OutputBinding::Constant(value) => value as i64,
            _ => 0,
        })
    }
}

pub(crate) fn values(
    bindings: &[OutputBind],
    image: &Image,
    frames_sent: u32,
    reply: ReplyCode,
) -> Vec<Scalar, MAX_FIELDS> {
    let mut values = Vec::new();
    for &OutputBind { ty, from, extra, .. } in bindings {
        let value = match from {
            OutputBinding::Variable { var, scale, offset } => {
                saturate_to_field(ty, image.value(var).as_f64(), scale, offset)
            }
            OutputBinding::Constant(value) => saturate_to_field(ty, value, 1.0, 0.0),
            OutputBinding::Counter => wrapping_count(ty, frames_sent),
            OutputBinding::CounterTo { max } => wrapping_count(ty, counted_to(frames_sent, max)),
            OutputBinding::Reply => saturate_to_field(ty, f64::from(reply as u8), 1.0, 0.0),
            OutputBinding::Port { value, .. } if value.is_count() => {
                wrapping_count(ty, image.extra(extra) as u32)
            }
            OutputBinding::State { scale, offset, .. }
            | OutputBinding::Port { scale, offset, .. }
            | OutputBinding::Link { scale, offset, .. } => {
                saturate_to_field(ty, image.extra(extra), scale, offset)
            }
            OutputBinding::Bit { var, bit } => saturate_to_field(ty, image.bit(var, bit), 1.0, 0.0),
        };
        // Cannot fail: a part has at most `MAX_FIELDS` fields.
        let _ = values.push(value);
    }
    values
}

/// The number that a device frame shows for one of these fields; NaN if there is none.
pub(crate) fn number_of(
    outputs: Outputs<'_>,
    binding: &OutputBind,
    image: &Image,
    frames_sent: u32,
    reply: ReplyCode,
) -> f64 {
    let number = source_of(binding, image, frames_sent, reply);
    if binding.sendable == 0 { number } else { outputs.sent(binding, number) }
}

fn source_of(binding: &OutputBind, image: &Image, frames_sent: u32, reply: ReplyCode) -> f64 {
    match binding.from {
        OutputBinding::Variable { var, scale, offset } => {
            image.value(var).as_f64() * f64::from(scale) + f64::from(offset)
        }
        OutputBinding::Constant(value) => value,
        OutputBinding::Counter => wrapping_number(binding, f64::from(frames_sent)),
        OutputBinding::CounterTo { max } => f64::from(counted_to(frames_sent, max)),
        OutputBinding::Reply => f64::from(reply as u8),
        OutputBinding::Port { value, .. } if value.is_count() => {
            wrapping_number(binding, image.extra(binding.extra))
        }
        OutputBinding::State { scale, offset, .. }
        | OutputBinding::Port { scale, offset, .. }
        | OutputBinding::Link { scale, offset, .. } => {
            image.extra(binding.extra) * f64::from(scale) + f64::from(offset)
        }
        OutputBinding::Bit { var, bit } => image.bit(var, bit),
    }
}

/// A count as a field of a device frame: it wraps before it would turn negative or saturate.
fn wrapping_number(binding: &OutputBind, count: f64) -> f64 {
    let high = binding.element().encoding().map_or(0.0, |encoding| encoding.range().1);
    wrap(count, 0.0, high.min(f64::from(u32::MAX))).unwrap_or(f64::NAN)
}

/// A count that wraps to 0 after `max`.
fn counted_to(count: u32, max: u32) -> u32 {
    max.checked_add(1).and_then(|numbers| count.checked_rem(numbers)).unwrap_or(count)
}

/// The bindings of all ports; ports refer to ranges of them.
pub(crate) struct Bindings<'e> {
    pub inputs: &'e mut VecView<InputBind>,
    pub outputs: &'e mut VecView<OutputBind>,
    pub sendable: &'e mut Vec<Sendable, MAX_SENDABLE>,
}

impl Bindings<'_> {
    pub(crate) fn outputs(&self) -> Outputs<'_> {
        Outputs { binds: self.outputs, sendable: self.sendable }
    }

    /// Restricts the output field that was added last; `None` if there are too many restrictions.
    pub(crate) fn may_send(&mut self, sendable: Sendable) -> Option<()> {
        let first = self.sendable.len() as u8;
        let field = self.outputs.last_mut()?;
        self.sendable.push(sendable).ok()?;
        if field.sendable == 0 {
            field.first_sendable = first;
        }
        field.sendable = field.sendable.saturating_add(1);
        Some(())
    }
}

/// The count in the field's type, wrapping.
pub(crate) fn wrapping_count(ty: ScalarType, count: u32) -> Scalar {
    match ty {
        ScalarType::Byte => Scalar::Byte(count as u8),
        ScalarType::Char => Scalar::Char((count & 0x7F) as i8),
        ScalarType::Word => Scalar::Word(count as u16),
        ScalarType::Short => Scalar::Short((count & 0x7FFF) as i16),
        ScalarType::Dword => Scalar::Dword(count),
        ScalarType::Int => Scalar::Int((count & 0x7FFF_FFFF) as i32),
        ScalarType::Float => Scalar::Float((count & 0x00FF_FFFF) as f32),
        ScalarType::Double => Scalar::Double(f64::from(count)),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_counter_wraps_in_its_field_and_never_turns_negative() {
        assert_eq!(wrapping_count(ScalarType::Byte, 256), Scalar::Byte(0));
        assert_eq!(wrapping_count(ScalarType::Char, 128), Scalar::Char(0));
        assert_eq!(wrapping_count(ScalarType::Short, 0x8001), Scalar::Short(1));
        assert_eq!(wrapping_count(ScalarType::Float, 0x0100_0001), Scalar::Float(1.0));
    }
}
