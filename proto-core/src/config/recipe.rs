//! Recipes in the configuration: parts, fields and their bindings, triggers.
//!
//! Plain data: nothing here is checked. Fields and commands are ranges of the configuration's lists.

use core::slice::Iter;

use heapless::{String, Vec};

use super::{Delimiter, InputRule, Limits, LinkSource, MapEntry, Name, PortValue, StateValue};
use crate::device::{Boundary, ByteOrder, Checksum, Encoding, Escape, Ignored, Length, Overflow, Text};
use crate::recipe::model::{Field, MAX_CAN_IDS, Mode};
use crate::sysvar::{Direction, SysVar, VarBit};
use crate::wire::can::CanId;
use crate::wire::scalar::ScalarType;

/// One recipe.
#[derive(Debug, Clone, PartialEq)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
#[non_exhaustive]
pub struct Recipe {
    /// Its name.
    pub name: Name,
    /// System variables, or user-defined fields.
    pub mode: Mode,
    /// Stream or CAN, with the parts.
    pub parts: Parts,
    /// What a port does while the sources of its output are stale.
    pub on_stale: OnStale,
    /// What makes a port send the output part.
    pub send: SendOn,
    /// The exchanges besides the parts, a range of [`GatewayConfig::exchanges`](super::GatewayConfig::exchanges). With
    /// exchanges, both parts of a stream may be absent.
    pub exchanges: Span,
}

impl Recipe {
    /// A recipe with these parts, sent every cycle, holding stale values.
    pub const fn new(name: Name, mode: Mode, parts: Parts) -> Self {
        let exchanges = Span { start: 0, len: 0 };
        Self { name, mode, parts, on_stale: OnStale::Hold, send: SendOn::Period, exchanges }
    }

    /// The field ranges of one part: one for a stream part, one for each CAN frame.
    pub(crate) fn part_frames(&self, part: Direction) -> PartFrames<'_> {
        let can: &[CanFramePart] = match (&self.parts, part) {
            (Parts::Stream { .. }, _) => &[],
            (Parts::Can { input, .. }, Direction::Input) => input,
            (Parts::Can { output, .. }, Direction::Output) => output,
        };
        PartFrames { stream: self.stream_part(part).map(|part| part.fields), can: can.iter() }
    }

    /// One part of a stream recipe.
    pub(crate) fn stream_part(&self, part: Direction) -> Option<&StreamPart> {
        match (&self.parts, part) {
            (Parts::Stream { input: stream, .. }, Direction::Input)
            | (Parts::Stream { output: stream, .. }, Direction::Output) => stream.as_ref(),
            (Parts::Can { .. }, _) => None,
        }
    }
}

/// A recipe's two parts. Either may be absent, or both if the recipe has exchanges.
#[derive(Debug, Clone, PartialEq)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
#[allow(clippy::large_enum_variant, reason = "without an allocator there is no box to put the larger one in")]
pub enum Parts {
    /// Byte streams and datagrams.
    Stream {
        /// User to robot.
        input: Option<StreamPart>,
        /// Robot to user.
        output: Option<StreamPart>,
    },
    /// CAN; an absent part has no frames.
    Can {
        /// User to robot.
        input: Vec<CanFramePart, MAX_CAN_IDS>,
        /// Robot to user.
        output: Vec<CanFramePart, MAX_CAN_IDS>,
    },
}

/// One part of a stream recipe.
#[derive(Debug, Clone, PartialEq)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
pub struct StreamPart {
    /// Bytes before the fields.
    pub head: Delimiter,
    /// Bytes after the fields.
    pub tail: Delimiter,
    /// The fields.
    pub fields: Span,
    /// How its frames are separated; only in recipes of devices.
    pub framing: Boundary,
    /// Its frames are marked and escaped, which also separates them.
    pub escape: Option<Escape>,
}

impl StreamPart {
    /// A part as in the controller's recipes.
    pub const fn new(head: Delimiter, tail: Delimiter, fields: Span) -> Self {
        Self { head, tail, fields, framing: Boundary::Fields, escape: None }
    }

    /// Whether the ends of frames are found by something else than their fields.
    pub(crate) fn is_cut(&self) -> bool {
        self.framing != Boundary::Fields || self.escape.is_some()
    }
}

/// One frame id of a CAN recipe's part.
#[derive(Debug, Clone, Copy, PartialEq)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
pub struct CanFramePart {
    /// The frame's id.
    pub id: CanId,
    /// The fields, at most 8 bytes together.
    pub fields: Span,
}

/// The field ranges of one part: one for a stream part, one for each CAN frame.
#[derive(Debug, Clone)]
pub(crate) struct PartFrames<'c> {
    pub(super) stream: Option<Span>,
    pub(super) can: Iter<'c, CanFramePart>,
}

impl Iterator for PartFrames<'_> {
    type Item = Span;

    fn next(&mut self) -> Option<Span> {
        let can = self.can.next().map(|frame| frame.fields);
        can.or_else(|| self.stream.take())
    }
}

/// A range of one of the lists of [`GatewayConfig`](super::GatewayConfig).
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
pub struct Span {
    /// First index.
    pub start: u16,
    /// Number of entries.
    pub len: u16,
}

impl Span {
    /// The entries of `pool` in this range; empty if the range does not fit.
    pub fn of<T>(self, pool: &[T]) -> &[T] {
        let start = usize::from(self.start);
        pool.get(start..start.saturating_add(usize::from(self.len))).unwrap_or(&[])
    }

    /// The range between two lengths of a list. Lists are shorter than `u16::MAX`; longer ones are refused by the check
    /// of counts.
    pub(super) fn between(start: usize, end: usize) -> Self {
        Self { start: start as u16, len: end.saturating_sub(start) as u16 }
    }
}

/// A field, and its source or use.
#[derive(Debug, Clone, Copy, PartialEq)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
pub enum FieldSpec {
    /// A system variable of a realtime recipe.
    System(SysVar),
    /// A field of a user-defined recipe's input part.
    UserInput {
        /// The field's type on the wire.
        ty: ScalarType,
        /// What its value is used for.
        to: InputBinding,
    },
    /// A field of a user-defined recipe's output part.
    UserOutput {
        /// The field's type on the wire.
        ty: ScalarType,
        /// The source of its value.
        from: OutputBinding,
    },
    /// A field of a device's frame, in the input part of a user recipe.
    DeviceInput {
        /// How it is encoded.
        encoding: Encoding,
        /// What happens to a number out of the variable's range.
        overflow: Overflow,
        /// What its value is used for.
        to: InputBinding,
    },
    /// A field of a device's frame, in the output part of a user recipe.
    DeviceOutput {
        /// How it is encoded.
        encoding: Encoding,
        /// What happens to a number out of the field's range.
        overflow: Overflow,
        /// The source of its value.
        from: OutputBinding,
    },
    /// A constant integer; a received frame with another value is not this frame.
    Fixed {
        /// How it is encoded.
        encoding: Encoding,
        /// The integer.
        value: i64,
    },
    /// Bytes without meaning; any value is accepted.
    Padding {
        /// Number of bytes.
        len: u8,
        /// The byte that is sent.
        fill: u8,
    },
    /// The frame's checksum.
    Checksum(Checksum),
    /// A text of a device's input frame.
    TextInput {
        /// How it is encoded.
        text: Text,
        /// The registers that take the text, padded with zeros; a frame with a longer text is rejected.
        to: Option<Words>,
        /// The variable that gets the number of characters.
        length_to: Option<SysVar>,
        /// The variable that counts accepted frames, to show a repeated text.
        count_to: Option<SysVar>,
        /// A frame with one of these texts shows that the device is there; its values are ignored.
        ignored: Ignored,
    },
    /// A text of a device's output frame.
    TextOutput {
        /// How it is encoded.
        text: Text,
        /// The registers with the text.
        from: Words,
        /// The variable with the number of characters; without one the text ends before the first zero.
        length_from: Option<SysVar>,
    },
    /// The frame's length.
    Length(Length),
    /// What the previous output field may send, or which numbers the previous input field accepts. No bytes in the
    /// frame. Only in frames of devices.
    Limits(Limits),
    /// An entry of the previous field's table: what an output field sends, or the number for an input field's variable.
    /// No bytes in the frame. Only in frames of devices.
    Mapped(MapEntry),
    /// Another rule for the value of the previous input field. No bytes in the frame. Only in frames of devices.
    InputRule(InputRule),
}

/// Consecutive word variables that hold a text, two characters each.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
pub struct Words {
    /// The first variable.
    pub first: SysVar,
    /// Number of variables.
    pub count: u8,
    /// Big: the first character is the high byte. Little: the low byte.
    pub order: ByteOrder,
}

impl Words {
    /// The variables, in order.
    pub fn iter(self) -> impl Iterator<Item = SysVar> + Clone {
        let (first, end) = self.ordinals();
        (first..end).filter_map(SysVar::from_ordinal)
    }

    /// The ordinals of the first variable, and of the one after the last.
    const fn ordinals(self) -> (usize, usize) {
        let first = self.first.ordinal();
        (first, first.saturating_add(self.count as usize))
    }

    /// Maximum number of characters.
    pub const fn room(&self) -> usize {
        (self.count as usize).saturating_mul(2)
    }
}

impl FieldSpec {
    /// The field as in the controller's recipes; `None` if only frames of devices have it.
    pub fn field(&self) -> Option<Field> {
        match *self {
            Self::System(var) => Some(Field::System(var)),
            Self::UserInput { ty, .. } | Self::UserOutput { ty, .. } => Some(Field::User(ty)),
            _ => None,
        }
    }

    /// Whether this is a limit, a table entry or a rule of the previous field.
    pub const fn is_of_field_before(&self) -> bool {
        matches!(self, Self::Limits(_) | Self::Mapped(_) | Self::InputRule(_))
    }

    /// The bit that the field is bound to.
    pub const fn bit(&self) -> Option<VarBit> {
        match *self {
            Self::UserInput { to: InputBinding::Bit { var, bit }, .. }
            | Self::DeviceInput { to: InputBinding::Bit { var, bit }, .. }
            | Self::UserOutput { from: OutputBinding::Bit { var, bit }, .. }
            | Self::DeviceOutput { from: OutputBinding::Bit { var, bit }, .. } => Some(VarBit { var, bit }),
            Self::InputRule(rule) => rule.bit(),
            _ => None,
        }
    }

    /// The source of a user-defined output field.
    pub fn source(&self) -> Option<OutputBinding> {
        match *self {
            Self::UserOutput { from, .. } | Self::DeviceOutput { from, .. } => Some(from),
            _ => None,
        }
    }

    /// The source of a user-defined output field, mutable.
    pub fn source_mut(&mut self) -> Option<&mut OutputBinding> {
        match self {
            Self::UserOutput { from, .. } | Self::DeviceOutput { from, .. } => Some(from),
            _ => None,
        }
    }

    /// The binding of a user-defined input field.
    pub fn target(&self) -> Option<InputBinding> {
        match *self {
            Self::UserInput { to, .. } | Self::DeviceInput { to, .. } => Some(to),
            _ => None,
        }
    }

    /// The binding of a user-defined input field, mutable.
    pub fn target_mut(&mut self) -> Option<&mut InputBinding> {
        match self {
            Self::UserInput { to, .. } | Self::DeviceInput { to, .. } => Some(to),
            _ => None,
        }
    }

    /// The system variable of the field: the field itself, the one that an input field writes as a whole, or the one
    /// whose value or bit an output field shows. Texts have several; see [`Self::variables`].
    pub fn variable(&self) -> Option<SysVar> {
        match *self {
            Self::System(var) => Some(var),
            Self::UserInput { to, .. } | Self::DeviceInput { to, .. } => match to {
                InputBinding::Variable { var, .. } => Some(var),
                InputBinding::Unused
                | InputBinding::Commands { .. }
                | InputBinding::Bit { .. }
                | InputBinding::Counter { .. } => None,
            },
            Self::UserOutput { from, .. } | Self::DeviceOutput { from, .. } => match from {
                OutputBinding::Variable { var, .. } | OutputBinding::Bit { var, .. } => Some(var),
                _ => None,
            },
            Self::InputRule(rule) => rule.variable(),
            _ => None,
        }
    }

    /// All system variables that the field is bound to.
    pub fn variables(&self) -> impl Iterator<Item = SysVar> + Clone + use<> {
        self.all_variables()
    }

    pub(super) fn all_variables(&self) -> Variables {
        let (words, others) = match *self {
            Self::TextInput { to, length_to, count_to, .. } => (to, [length_to, count_to]),
            Self::TextOutput { from, length_from, .. } => (Some(from), [length_from, None]),
            _ => (None, [self.variable(), None]),
        };
        Variables { words: words.map_or((0, 0), Words::ordinals), others }
    }

    /// Whether the variable is one of [`Self::variables`].
    pub(crate) fn is_bound_to(&self, var: SysVar) -> bool {
        match *self {
            Self::System(own) => own == var,
            Self::TextInput { .. } | Self::TextOutput { .. } => self.variables().any(|bound| bound == var),
            _ => self.variable() == Some(var),
        }
    }
}

/// The variables of a field: consecutive words, then single variables.
#[derive(Debug, Clone)]
pub(super) struct Variables {
    /// Ordinals of the remaining words: the first, and the one after the last.
    pub(super) words: (usize, usize),
    pub(super) others: [Option<SysVar>; 2],
}

impl Variables {
    pub(super) const NONE: Self = Self { words: (0, 0), others: [None; 2] };
}

impl Iterator for Variables {
    type Item = SysVar;

    fn next(&mut self) -> Option<SysVar> {
        let (next, end) = &mut self.words;
        while next < end {
            let word = SysVar::from_ordinal(*next);
            *next = next.saturating_add(1);
            if word.is_some() {
                return word;
            }
        }
        let [first, second] = &mut self.others;
        first.take().or_else(|| second.take())
    }
}

/// What a received user-defined value is used for.
#[derive(Debug, Clone, Copy, PartialEq)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
pub enum InputBinding {
    /// Ignored.
    Unused,
    /// `value * scale + offset` becomes the variable's value.
    Variable {
        /// An input variable.
        var: SysVar,
        /// Scale.
        scale: f32,
        /// Offset, added after scaling.
        offset: f32,
    },
    /// The value selects a port-2000 command from a table. A value that is not in the table does nothing; it is
    /// counted, unless it is 0 and the table has no idle values.
    Commands {
        /// The table, in [`GatewayConfig::commands`](super::GatewayConfig::commands).
        table: Span,
        /// When a value takes effect.
        when: CommandWhen,
    },
    /// One bit of a byte variable: off for 0, on for any other integer. Other bits of the byte may have other owners.
    Bit {
        /// An input variable made of bits.
        var: SysVar,
        /// Bit 0..=7.
        bit: u8,
    },
    /// An alive counter, which increases by one with every frame and wraps from `max` to 0. A frame with the same
    /// number as the previous one is a repetition and is not applied. Only in frames of devices.
    Counter {
        /// The highest number.
        max: u32,
    },
}

/// When a value that selects a command takes effect.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
pub enum CommandWhen {
    /// When it differs from the previous frame; the first frame after silence only sets the value to compare with.
    #[default]
    Change,
    /// With every accepted frame: for devices that send a frame only for a command.
    Frame,
    /// When it differs from the previous frame, even after silence: for devices that send a frame only on change. After
    /// a lost device, bus-off or sleep, the first frame only sets the value to compare with.
    Kept,
}

/// The source of a user-defined output value.
#[derive(Debug, Clone, Copy, PartialEq)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
pub enum OutputBinding {
    /// `variable * scale + offset`, saturated to the field's type.
    Variable {
        /// Any variable that the controller shows.
        var: SysVar,
        /// Scale.
        scale: f32,
        /// Offset, added after scaling.
        offset: f32,
    },
    /// A constant.
    Constant(f64),
    /// Number of frames sent, wrapping in the field's type.
    Counter,
    /// The result of this port's newest command: see [`crate::engine::ReplyCode`].
    Reply,
    /// `value * scale + offset` of the controller's newest state packet, saturated to the field's type.
    State {
        /// The value.
        value: StateValue,
        /// Scale.
        scale: f32,
        /// Offset, added after scaling.
        offset: f32,
    },
    /// The health of a field port. Counts wrap in the field's type, and have no scale and offset; other values are
    /// `value * scale + offset`, saturated.
    Port {
        /// Index of the port in the configuration; `None` is the port that sends the field.
        port: Option<u8>,
        /// The value.
        value: PortValue,
        /// Scale.
        scale: f32,
        /// Offset, added after scaling.
        offset: f32,
    },
    /// One bit of a byte variable, 0 or 1.
    Bit {
        /// Any variable made of bits that the controller shows.
        var: SysVar,
        /// Bit 0..=7.
        bit: u8,
    },
    /// Number of frames sent; `max` is followed by 0.
    CounterTo {
        /// The highest number.
        max: u32,
    },
    /// `value * scale + offset`, saturated, where the value is 1 while the link is up and 0 otherwise, even if the
    /// gateway does not need the link.
    Link {
        /// The link.
        link: LinkSource,
        /// Scale.
        scale: f32,
        /// Offset, added after scaling.
        offset: f32,
    },
}

/// One entry of a command table.
#[derive(Debug, Clone, PartialEq)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
pub struct CommandEntry {
    /// The first field value that selects the command.
    pub first: i64,
    /// The last field value; equal to the first for a single value.
    pub last: i64,
    /// The command for port 2000, such as `run(pick.jspf,50)`. `{value}` is replaced by the field's value. If empty,
    /// the values are idle: they select nothing, and are not counted as unknown.
    pub text: String<MAX_COMMAND_TEXT>,
}

/// What a port does while the sources of its output are older than `stale_after`.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
pub enum OnStale {
    /// Keep sending the last values.
    #[default]
    Hold,
    /// Send nothing.
    Stop,
}

/// What makes a port send its output part.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
pub enum SendOn {
    /// The port's cycle; the only choice for realtime recipes.
    #[default]
    Period,
    /// Each cycle in which a value changed.
    Change,
    /// With every accepted input frame: request and response.
    Frame,
    /// When a bit changes from 0 to 1.
    Rising {
        /// A bit variable that the controller shows.
        var: SysVar,
        /// Bit 0..=7.
        bit: u8,
    },
}

/// Maximum length of a command in a table, in bytes; well below the controller's limit (D5).
pub const MAX_COMMAND_TEXT: usize = 96;
