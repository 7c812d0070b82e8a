//! The fields of a recipe's part as written in a program.
//!
//! In: names such as `"ForceEnd[1..6]"`, variables, or user-defined fields with their bindings. Out: the same,
//! borrowed; [`GatewayConfig::add_recipe`](super::GatewayConfig::add_recipe) parses the names.

use super::error::ConfigErrorKind as Kind;
use super::{
    CommandWhen, FieldSpec, InputBinding, Limits, LinkSource, MapEntry, OutputBinding, Outside, PortValue,
    StateValue,
};
use crate::device::{Algorithm, Checksum, Encoding, Kind as EncodingKind, Overflow};
use crate::sysvar::{ParseError, SysVar, VarRange};
use crate::wire::can::CanId;
use crate::wire::scalar::ScalarType;

/// A system variable, by name or as a value.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Var<'a> {
    /// `RobotState[8]` or `__RobotState_8`.
    Name(&'a str),
    /// The variable.
    Var(SysVar),
}

impl Var<'_> {
    pub(super) fn read(self) -> Result<SysVar, ParseError> {
        match self {
            Self::Name(name) => SysVar::parse(name),
            Self::Var(var) => Ok(var),
        }
    }
}

impl<'a> From<&'a str> for Var<'a> {
    fn from(name: &'a str) -> Self {
        Self::Name(name)
    }
}

impl From<SysVar> for Var<'_> {
    fn from(var: SysVar) -> Self {
        Self::Var(var)
    }
}

/// The fields of a stream part or of one CAN frame, in order.
///
/// Made from `&["ForceEnd[1..6]"]`, from `&[var]`, from `&[InputField::...]`, from
/// `&[OutputField::...]`, or from `&[FieldSpec]`.
#[derive(Debug, Clone, Copy, PartialEq)]
#[non_exhaustive]
pub enum Fields<'a> {
    /// System variables and ranges of them, such as `RobotState[8..13]`.
    Names(&'a [&'a str]),
    /// System variables.
    Vars(&'a [SysVar]),
    /// Fields of the input part of a user-defined recipe.
    Inputs(&'a [InputField<'a>]),
    /// Fields of the output part of a user-defined recipe.
    Outputs(&'a [OutputField<'a>]),
    /// Fields in the configuration's form; command tables are ranges of its `commands`.
    Specs(&'a [FieldSpec]),
}

impl Fields<'_> {
    /// Number of fields and of commands; an invalid name counts as one field.
    pub(super) fn counts(&self) -> (usize, usize) {
        match self {
            Self::Names(names) => {
                let len = |name: &&str| VarRange::parse(name).map_or(1, |range| range.iter().len());
                (names.iter().map(len).fold(0, usize::saturating_add), 0)
            }
            Self::Vars(vars) => (vars.len(), 0),
            Self::Inputs(fields) => {
                (fields.len(), fields.iter().map(InputField::commands_len).fold(0, usize::saturating_add))
            }
            Self::Outputs(fields) => {
                (fields.iter().map(OutputField::specs_len).fold(0, usize::saturating_add), 0)
            }
            Self::Specs(fields) => (fields.len(), 0),
        }
    }
}

macro_rules! fields_from {
    ($($item:ty => $variant:ident),* $(,)?) => {$(
        impl<'a> From<&'a [$item]> for Fields<'a> {
            fn from(fields: &'a [$item]) -> Self {
                Self::$variant(fields)
            }
        }

        impl<'a, const N: usize> From<&'a [$item; N]> for Fields<'a> {
            fn from(fields: &'a [$item; N]) -> Self {
                Self::$variant(fields)
            }
        }
    )*};
}

fields_from! {
    &'a str => Names,
    SysVar => Vars,
    InputField<'a> => Inputs,
    OutputField<'a> => Outputs,
    FieldSpec => Specs,
}

/// A checksum, by its name in files or with its parameters.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Sum<'a> {
    /// A name such as `crc16-modbus`, with the parameters of its standard.
    Name(&'a str),
    /// The checksum.
    Checksum(Checksum),
}

impl<'a> From<&'a str> for Sum<'a> {
    fn from(name: &'a str) -> Self {
        Self::Name(name)
    }
}

impl From<Checksum> for Sum<'_> {
    fn from(sum: Checksum) -> Self {
        Self::Checksum(sum)
    }
}

/// The encoding of a field.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) enum OnWire<'a> {
    Value(Encoding, Overflow),
    Fixed(Encoding, i64),
    Padding { len: u8, fill: u8 },
    Checksum(Sum<'a>),
}

impl OnWire<'_> {
    fn value(encoding: impl Into<Encoding>) -> Self {
        Self::Value(encoding.into(), Overflow::Usual)
    }

    fn wrapping(self) -> Self {
        if let Self::Value(encoding, _) = self { Self::Value(encoding, Overflow::Wrap) } else { self }
    }

    /// The configuration's field; `with_value` makes one with a value.
    pub(super) fn spec(
        self,
        with_value: impl FnOnce(Encoding, Overflow) -> Result<FieldSpec, Kind>,
    ) -> Result<FieldSpec, Kind> {
        match self {
            Self::Value(encoding, overflow) => with_value(encoding, overflow),
            Self::Fixed(encoding, value) => Ok(FieldSpec::Fixed { encoding, value }),
            Self::Padding { len, fill } => Ok(FieldSpec::Padding { len, fill }),
            Self::Checksum(Sum::Checksum(sum)) => Ok(FieldSpec::Checksum(sum)),
            Self::Checksum(Sum::Name(name)) => {
                let algorithm = Algorithm::named(name).ok_or(Kind::UnknownChecksum)?;
                Ok(FieldSpec::Checksum(Checksum::standard(algorithm)))
            }
        }
    }
}

/// The type of a value that recipes of the controller can also have.
fn plain(encoding: Encoding, overflow: Overflow) -> Option<ScalarType> {
    match encoding.kind {
        EncodingKind::Scalar(ty) if encoding == Encoding::scalar(ty) && overflow == Overflow::Usual => {
            Some(ty)
        }
        _ => None,
    }
}

impl FieldSpec {
    /// A field of an input part; a device's field only if the controller's recipes cannot have it.
    pub fn input(encoding: Encoding, overflow: Overflow, to: InputBinding) -> Self {
        match plain(encoding, overflow) {
            Some(ty) => Self::UserInput { ty, to },
            None => Self::DeviceInput { encoding, overflow, to },
        }
    }

    /// A field of an output part; a device's field only if the controller's recipes cannot have it.
    pub fn output(encoding: Encoding, overflow: Overflow, from: OutputBinding) -> Self {
        match plain(encoding, overflow) {
            Some(ty) => Self::UserOutput { ty, from },
            None => Self::DeviceOutput { encoding, overflow, from },
        }
    }
}

/// A field of a user-defined recipe's input part.
///
/// A type such as `ScalarType::Word` is a value as in the controller's own recipes. An [`Encoding`] is for values that
/// only devices have: big-endian numbers, bits, digits. A recipe with such a field, a constant, padding or a checksum
/// is a device's recipe, which is for field ports.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct InputField<'a> {
    pub(super) on_wire: OnWire<'a>,
    pub(super) does: Does<'a>,
}

#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) enum Does<'a> {
    Nothing,
    Writes { var: Var<'a>, scale: f32, offset: f32 },
    WritesBit { name: &'a str },
    Commands { entries: Entries<'a>, when: CommandWhen, idle: Option<i64> },
    Counter { max: u32 },
}

#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) enum Entries<'a> {
    Values(&'a [(i64, &'a str)]),
    Ranges(&'a [(i64, i64, &'a str)]),
}

impl<'a> Entries<'a> {
    /// First value, last value and text of each entry.
    pub(super) fn iter(self) -> impl Iterator<Item = (i64, i64, &'a str)> {
        let (values, ranges) = match self {
            Self::Values(values) => (values, &[][..]),
            Self::Ranges(ranges) => (&[][..], ranges),
        };
        let values = values.iter().map(|&(value, text)| (value, value, text));
        values.chain(ranges.iter().copied())
    }
}

impl<'a> InputField<'a> {
    /// A field whose value is ignored.
    pub fn unused(encoding: impl Into<Encoding>) -> Self {
        Self { on_wire: OnWire::value(encoding), does: Does::Nothing }
    }

    /// A field whose value is written to an input variable.
    pub fn variable(encoding: impl Into<Encoding>, var: impl Into<Var<'a>>) -> Self {
        let does = Does::Writes { var: var.into(), scale: 1.0, offset: 0.0 };
        Self { on_wire: OnWire::value(encoding), does }
    }

    /// A field for one bit of an input variable, such as `BitInputReg[3].4`: off for 0, on for any other value. Integer
    /// types only.
    pub fn bit(encoding: impl Into<Encoding>, name: &'a str) -> Self {
        Self { on_wire: OnWire::value(encoding), does: Does::WritesBit { name } }
    }

    /// A field whose value selects a command of port 2000 when it changes. The entries are pairs of value and command,
    /// such as `(1, "run(pick.jspf,50)")`. Integer types only.
    pub fn commands(encoding: impl Into<Encoding>, entries: &'a [(i64, &'a str)]) -> Self {
        let does =
            Does::Commands { entries: Entries::Values(entries), when: CommandWhen::Change, idle: None };
        Self { on_wire: OnWire::value(encoding), does }
    }

    /// Like [`Self::commands`], with ranges of values. The entries are first value, last value and command, such as
    /// `(1, 100, "speed({value})")`; `{value}` is replaced by the field's value.
    pub fn command_ranges(encoding: impl Into<Encoding>, entries: &'a [(i64, i64, &'a str)]) -> Self {
        let does =
            Does::Commands { entries: Entries::Ranges(entries), when: CommandWhen::Change, idle: None };
        Self { on_wire: OnWire::value(encoding), does }
    }

    /// An alive counter, which wraps from `max` to 0. A frame with the same number as the previous one is not applied,
    /// so a frozen device becomes overdue.
    pub fn counter(encoding: impl Into<Encoding>, max: u32) -> Self {
        Self { on_wire: OnWire::value(encoding), does: Does::Counter { max } }
    }

    /// A constant integer; a frame with another value is not this frame.
    pub fn constant(encoding: impl Into<Encoding>, value: i64) -> Self {
        Self { on_wire: OnWire::Fixed(encoding.into(), value), does: Does::Nothing }
    }

    /// Bytes without meaning.
    pub const fn padding(len: u8) -> Self {
        Self { on_wire: OnWire::Padding { len, fill: 0 }, does: Does::Nothing }
    }

    /// The frame's checksum: its name in files, such as `"crc16-modbus"`, or a [`Checksum`].
    pub fn checksum(sum: impl Into<Sum<'a>>) -> Self {
        Self { on_wire: OnWire::Checksum(sum.into()), does: Does::Nothing }
    }

    /// Makes numbers out of the variable's range wrap around, instead of rejecting the frame. Integers only.
    pub fn wrapping(self) -> Self {
        Self { on_wire: self.on_wire.wrapping(), ..self }
    }

    /// Makes the variable `value * scale + offset`. No effect on other fields.
    pub fn scaled(mut self, scale: f32, offset: f32) -> Self {
        if let Does::Writes { scale: own_scale, offset: own_offset, .. } = &mut self.does {
            (*own_scale, *own_offset) = (scale, offset);
        }
        self
    }

    /// Sets when a value picks its command. No effect on other fields.
    pub fn when(mut self, when: CommandWhen) -> Self {
        if let Does::Commands { when: own, .. } = &mut self.does {
            *own = when;
        }
        self
    }

    /// Sets the idle value, 0 by default, at which the device requests nothing: any other value that selects no command
    /// is counted as unknown. No effect on other fields.
    pub fn idle(mut self, value: i64) -> Self {
        if let Does::Commands { idle, .. } = &mut self.does {
            *idle = Some(value);
        }
        self
    }

    fn commands_len(&self) -> usize {
        match self.does {
            Does::Commands { entries, idle, .. } => {
                entries.iter().count().saturating_add(usize::from(idle.is_some()))
            }
            Does::Nothing | Does::Writes { .. } | Does::WritesBit { .. } | Does::Counter { .. } => 0,
        }
    }
}

/// A field of a user-defined recipe's output part; [`InputField`] explains types and encodings.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct OutputField<'a> {
    pub(super) on_wire: OnWire<'a>,
    pub(super) sends: Sends<'a>,
    pub(super) allowed: Allowed<'a>,
}

/// The numbers that a field may send.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) enum Allowed<'a> {
    All,
    Inside(Limits),
    Mapped(&'a [(i64, i64, f64)]),
}

impl<'a> Allowed<'a> {
    /// The entries that follow the field in the configuration.
    pub(super) fn specs(self) -> impl Iterator<Item = FieldSpec> + use<'a> {
        let (limits, entries) = match self {
            Self::All => (None, &[][..]),
            Self::Inside(limits) => (Some(FieldSpec::Limits(limits)), &[][..]),
            Self::Mapped(entries) => (None, entries),
        };
        let mapped = |&(first, last, sent)| FieldSpec::Mapped(MapEntry { first, last, sent });
        limits.into_iter().chain(entries.iter().map(mapped))
    }
}

#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) enum Sends<'a> {
    Variable { var: Var<'a>, scale: f32, offset: f32 },
    Bit { name: &'a str },
    Constant(f64),
    Counter,
    CounterTo { max: u32 },
    Reply,
    State { value: StateValue, scale: f32, offset: f32 },
    Health { port: Option<u8>, value: PortValue, scale: f32, offset: f32 },
    Link { link: LinkSource, scale: f32, offset: f32 },
}

impl<'a> OutputField<'a> {
    /// A variable's value, saturated to the field's type.
    pub fn variable(encoding: impl Into<Encoding>, var: impl Into<Var<'a>>) -> Self {
        Self::new(encoding, Sends::Variable { var: var.into(), scale: 1.0, offset: 0.0 })
    }

    /// One bit of a variable, such as `DigitalOutputCommand[1].0`, as 0 or 1.
    pub fn bit(encoding: impl Into<Encoding>, name: &'a str) -> Self {
        Self::new(encoding, Sends::Bit { name })
    }

    /// A constant.
    pub fn constant(encoding: impl Into<Encoding>, value: f64) -> Self {
        Self::new(encoding, Sends::Constant(value))
    }

    /// The number of frames sent so far, wrapping in the field's type. Integer types only.
    pub fn counter(encoding: impl Into<Encoding>) -> Self {
        Self::new(encoding, Sends::Counter)
    }

    /// The number of frames sent so far; `max` is followed by 0.
    pub fn counter_to(encoding: impl Into<Encoding>, max: u32) -> Self {
        Self::new(encoding, Sends::CounterTo { max })
    }

    /// The result of the port's newest command: see [`crate::engine::ReplyCode`].
    pub fn reply(encoding: impl Into<Encoding>) -> Self {
        Self::new(encoding, Sends::Reply)
    }

    /// This many bytes with this value.
    pub const fn padding(len: u8, fill: u8) -> Self {
        Self { on_wire: OnWire::Padding { len, fill }, sends: Sends::Constant(0.0), allowed: Allowed::All }
    }

    /// The frame's checksum: its name in files, such as `"crc16-modbus"`, or a [`Checksum`].
    pub fn checksum(sum: impl Into<Sum<'a>>) -> Self {
        Self { on_wire: OnWire::Checksum(sum.into()), sends: Sends::Constant(0.0), allowed: Allowed::All }
    }

    fn new(encoding: impl Into<Encoding>, sends: Sends<'a>) -> Self {
        Self { on_wire: OnWire::value(encoding), sends, allowed: Allowed::All }
    }

    /// Makes numbers out of the field's range wrap around, instead of saturating. Integers only.
    pub fn wrapping(self) -> Self {
        Self { on_wire: self.on_wire.wrapping(), ..self }
    }

    /// Limits the number after scale and offset: the frame is not sent if it is not in `low..=high`. Makes the field a
    /// device's.
    pub fn limited(self, low: f64, high: f64) -> Self {
        Self { allowed: Allowed::Inside(Limits { low, high, outside: Outside::Refuse }), ..self }
    }

    /// Like [`Self::limited`], but sends the nearer limit instead.
    pub fn clamped(self, low: f64, high: f64) -> Self {
        Self { allowed: Allowed::Inside(Limits { low, high, outside: Outside::Clamp }), ..self }
    }

    /// Sends numbers of a table. The entries are first and last value of the source, and the number sent for them, such
    /// as `(1, 4, 0.0)`. For other values the frame is not sent. Makes the field a device's; it has no scale and offset.
    pub fn mapped(self, entries: &'a [(i64, i64, f64)]) -> Self {
        Self { allowed: Allowed::Mapped(entries), ..self }
    }

    /// Number of entries in the configuration.
    fn specs_len(&self) -> usize {
        self.allowed.specs().count().saturating_add(1)
    }

    /// A value of the controller's state packet, saturated to the field's type; see [`StateValue::parse`].
    pub fn state(encoding: impl Into<Encoding>, value: StateValue) -> Self {
        Self::new(encoding, Sends::State { value, scale: 1.0, offset: 0.0 })
    }

    /// The health of the port that sends the field, or of the port with this index. Counts wrap in
    /// the field's type and need an integer type; the others saturate.
    pub fn health(encoding: impl Into<Encoding>, port: Option<u8>, value: PortValue) -> Self {
        Self::new(encoding, Sends::Health { port, value, scale: 1.0, offset: 0.0 })
    }

    /// 1 while a link to the controller is up, otherwise 0.
    pub fn link_up(encoding: impl Into<Encoding>, link: LinkSource) -> Self {
        Self::new(encoding, Sends::Link { link, scale: 1.0, offset: 0.0 })
    }

    /// Sends `value * scale + offset` for a variable, a value of the state packet, a port's health or a link's state;
    /// refused for counts. No effect on other fields.
    pub fn scaled(mut self, scale: f32, offset: f32) -> Self {
        if let Sends::Variable { scale: own_scale, offset: own_offset, .. }
        | Sends::State { scale: own_scale, offset: own_offset, .. }
        | Sends::Link { scale: own_scale, offset: own_offset, .. }
        | Sends::Health { scale: own_scale, offset: own_offset, .. } = &mut self.sends
        {
            (*own_scale, *own_offset) = (scale, offset);
        }
        self
    }
}

/// One frame of a CAN recipe's part.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct CanFields<'a> {
    pub(super) id: CanId,
    pub(super) fields: Fields<'a>,
}

impl<'a> CanFields<'a> {
    /// A frame with this id and these fields, at most 8 bytes together.
    pub fn new(id: CanId, fields: impl Into<Fields<'a>>) -> Self {
        Self { id, fields: fields.into() }
    }

    /// A frame with an id of 11 bits, 0..=0x7FF.
    pub fn standard(id: u16, fields: impl Into<Fields<'a>>) -> Self {
        Self::new(CanId::Standard(id), fields)
    }

    /// A frame with an id of 29 bits, 0..=0x1FFF_FFFF.
    pub fn extended(id: u32, fields: impl Into<Fields<'a>>) -> Self {
        Self::new(CanId::Extended(id), fields)
    }
}
