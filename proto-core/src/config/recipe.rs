//! Recipes as the configuration has them: parts, fields and their bindings, triggers.
//!
//! Plain data: nothing here has been checked. Fields and commands are ranges of the configuration's
//! lists.

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
    /// What is asked beside the parts, a range of
    /// [`GatewayConfig::exchanges`](super::GatewayConfig::exchanges); the parts of a stream may then
    /// both be absent.
    pub exchanges: Span,
}

impl Recipe {
    /// A recipe with these parts that is sent every cycle and holds stale values.
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

/// A recipe's two parts; either may be absent, and both if it has exchanges.
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
    /// What tells its frames apart; only in recipes of devices.
    pub framing: Boundary,
    /// Its frames stand between escape bytes, which then tell them apart.
    pub escape: Option<Escape>,
}

impl StreamPart {
    /// A part as the controller's recipes have it.
    pub const fn new(head: Delimiter, tail: Delimiter, fields: Span) -> Self {
        Self { head, tail, fields, framing: Boundary::Fields, escape: None }
    }

    /// Whether something else than its fields tells where frames end.
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

/// A range of one of the pools of [`GatewayConfig`](super::GatewayConfig).
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
pub struct Span {
    /// First index.
    pub start: u16,
    /// Number of entries.
    pub len: u16,
}

impl Span {
    /// The part of `pool` that this range covers; empty if it does not fit.
    pub fn of<T>(self, pool: &[T]) -> &[T] {
        let start = usize::from(self.start);
        pool.get(start..start.saturating_add(usize::from(self.len))).unwrap_or(&[])
    }

    /// The range between two lengths of a list. Lists are shorter than `u16::MAX`; the check of the counts refuses others.
    pub(super) fn between(start: usize, end: usize) -> Self {
        Self { start: start as u16, len: end.saturating_sub(start) as u16 }
    }
}

/// One field, and what the gateway does with it.
#[derive(Debug, Clone, Copy, PartialEq)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
pub enum FieldSpec {
    /// A system variable of a realtime recipe.
    System(SysVar),
    /// A field of a user-defined recipe's input part.
    UserInput {
        /// The field's type on the wire.
        ty: ScalarType,
        /// What is done with its value.
        to: InputBinding,
    },
    /// A field of a user-defined recipe's output part.
    UserOutput {
        /// The field's type on the wire.
        ty: ScalarType,
        /// Where its value comes from.
        from: OutputBinding,
    },
    /// A field of a device's frame, in the input part of a user recipe.
    DeviceInput {
        /// How it is written.
        encoding: Encoding,
        /// What becomes of a number that its variable cannot hold.
        overflow: Overflow,
        /// What is done with its value.
        to: InputBinding,
    },
    /// A field of a device's frame, in the output part of a user recipe.
    DeviceOutput {
        /// How it is written.
        encoding: Encoding,
        /// What becomes of a number that it cannot hold.
        overflow: Overflow,
        /// Where its value comes from.
        from: OutputBinding,
    },
    /// An integer that is the same in every frame; a received frame with another one is not this
    /// frame.
    Fixed {
        /// How it is written.
        encoding: Encoding,
        /// The integer.
        value: i64,
    },
    /// Bytes without a meaning: any are accepted.
    Padding {
        /// Number of bytes.
        len: u8,
        /// What is sent.
        fill: u8,
    },
    /// The frame's checksum stands here.
    Checksum(Checksum),
    /// A text of a device's input frame.
    TextInput {
        /// How it is written.
        text: Text,
        /// The registers that take it, zeros behind its end; a frame with a longer one is rejected.
        to: Option<Words>,
        /// The variable that becomes its number of characters.
        length_to: Option<SysVar>,
        /// The variable that counts the frames accepted, so that the same text twice is seen.
        count_to: Option<SysVar>,
        /// A frame with one of these shows that the device is there; nothing of it is taken.
        ignored: Ignored,
    },
    /// A text of a device's output frame.
    TextOutput {
        /// How it is written.
        text: Text,
        /// The registers that have it.
        from: Words,
        /// The variable that has its number of characters; without one it ends before the first
        /// zero.
        length_from: Option<SysVar>,
    },
    /// The frame's length stands here.
    Length(Length),
    /// What the output field before this may send, or which numbers the input field before it takes; nothing stands in
    /// the frame. Only in frames of devices.
    Limits(Limits),
    /// An entry of the table of what the output field before this sends, or of what the variable of the input field before
    /// it becomes; nothing stands in the frame. Only in frames of devices.
    Mapped(MapEntry),
    /// What else becomes of the value of the input field before this; nothing stands in the frame. Only in frames of
    /// devices.
    InputRule(InputRule),
}

/// A run of word variables that holds a text, two characters each.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
pub struct Words {
    /// The first of them.
    pub first: SysVar,
    /// How many.
    pub count: u8,
    /// Big: the first character is the high byte. Little: the low one.
    pub order: ByteOrder,
}

impl Words {
    /// The variables, in order.
    pub fn iter(self) -> impl Iterator<Item = SysVar> + Clone {
        let (first, end) = self.ordinals();
        (first..end).filter_map(SysVar::from_ordinal)
    }

    /// The ordinals of the first one, and of the first behind them.
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
    /// The field as the controller's recipes have it; `None` if only frames of devices have it.
    pub fn field(&self) -> Option<Field> {
        match *self {
            Self::System(var) => Some(Field::System(var)),
            Self::UserInput { ty, .. } | Self::UserOutput { ty, .. } => Some(Field::User(ty)),
            _ => None,
        }
    }

    /// Whether it only says what the field before it may send, or what becomes of its value.
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

    /// Where the value of a user-defined output field comes from.
    pub fn source(&self) -> Option<OutputBinding> {
        match *self {
            Self::UserOutput { from, .. } | Self::DeviceOutput { from, .. } => Some(from),
            _ => None,
        }
    }

    /// The same, to change it.
    pub fn source_mut(&mut self) -> Option<&mut OutputBinding> {
        match self {
            Self::UserOutput { from, .. } | Self::DeviceOutput { from, .. } => Some(from),
            _ => None,
        }
    }

    /// What is done with the value of a user-defined input field.
    pub fn target(&self) -> Option<InputBinding> {
        match *self {
            Self::UserInput { to, .. } | Self::DeviceInput { to, .. } => Some(to),
            _ => None,
        }
    }

    /// The same, to change it.
    pub fn target_mut(&mut self) -> Option<&mut InputBinding> {
        match self {
            Self::UserInput { to, .. } | Self::DeviceInput { to, .. } => Some(to),
            _ => None,
        }
    }

    /// The system variable that the field is, that an input field's value becomes as a whole, or of
    /// which an output field shows the value or a bit; texts have several, see [`Self::variables`].
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

/// The variables of a field: words that follow each other, then single ones.
#[derive(Debug, Clone)]
pub(super) struct Variables {
    /// Ordinals of the words that are left: the first, and the first behind them.
    pub(super) words: (usize, usize),
    pub(super) others: [Option<SysVar>; 2],
}

impl Variables {
    /// None at all.
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

/// What is done with a received user-defined value.
#[derive(Debug, Clone, Copy, PartialEq)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
pub enum InputBinding {
    /// It is ignored.
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
    /// The value picks a port-2000 command from a table. A value that is not in the table does
    /// nothing; it is counted, unless it is 0 and the table names no idle values.
    Commands {
        /// The table, in [`GatewayConfig::commands`](super::GatewayConfig::commands).
        table: Span,
        /// When a value takes effect.
        when: CommandWhen,
    },
    /// One bit of a byte variable: off for 0, on for any other integer. Other bits of the byte may
    /// have other owners.
    Bit {
        /// An input variable made of bits.
        var: SysVar,
        /// Bit 0..=7.
        bit: u8,
    },
    /// It goes up by one with every frame, and from `max` to 0: a frame with the number of the one
    /// before is a repeat, and not taken. Only in frames of devices.
    Counter {
        /// The highest number.
        max: u32,
    },
}

/// When a value that picks a command takes effect.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
pub enum CommandWhen {
    /// When it differs from the previous frame; the first frame after silence only sets the base.
    #[default]
    Change,
    /// With every accepted frame: for devices that send a frame only when they mean it.
    Frame,
    /// When it differs from the previous frame, also after silence: for devices that send a frame
    /// only when something changes. After a lost device, bus-off or sleep, the first frame only
    /// sets the base.
    Kept,
}

/// Where a user-defined output value comes from.
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
    /// Frames sent so far, wrapping in the field's type.
    Counter,
    /// The result of this port's newest command: see [`crate::engine::ReplyCode`].
    Reply,
    /// `value * scale + offset` of the controller's newest state packet, saturated to the field's
    /// type.
    State {
        /// The value.
        value: StateValue,
        /// Scale.
        scale: f32,
        /// Offset, added after scaling.
        offset: f32,
    },
    /// The health of a field port. Counts wrap in the field's type, and take no scale and offset;
    /// the others are `value * scale + offset`, saturated.
    Port {
        /// Index of the port in the configuration; `None` is the port that sends the field.
        port: Option<u8>,
        /// What is sent.
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
    /// Frames sent so far; `max` is followed by 0.
    CounterTo {
        /// The highest number.
        max: u32,
    },
    /// `value * scale + offset`, saturated, of 1 while the link is up and 0 otherwise, also if the
    /// gateway does not need it.
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
    /// The first of the field's values that pick the command.
    pub first: i64,
    /// The last of them; the same as the first for a single value.
    pub last: i64,
    /// The command as port 2000 takes it, such as `run(pick.jspf,50)`. `{value}` in it stands for
    /// the field's value. If empty, the values are idle: they pick nothing, and are not counted as
    /// unknown.
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
    /// Every accepted input frame: request and response.
    Frame,
    /// A bit going from 0 to 1.
    Rising {
        /// A bit variable that the controller shows.
        var: SysVar,
        /// Bit 0..=7.
        bit: u8,
    },
}

/// Maximum length of a command in a table, in bytes; well below the controller's limit (D5).
pub const MAX_COMMAND_TEXT: usize = 96;
