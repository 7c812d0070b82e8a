//! Checks of a single recipe: its parts, the bindings of its user fields, its trigger.

use super::check_exchange::ExchangeCheck;
use super::check_limits::{Behind, BehindInput};
use super::device::field_of;
use super::error::{ConfigError, ConfigErrorKind as Kind, Place, RecipeKey};
use super::rules::{Check, check_bit, check_new_name, check_pool, check_trigger, fail, is_marked, mark};
use super::{
    CanFramePart, CommandEntry, ConfigView, Constants, DeviceFrame, FieldSpec, InputBinding, LinkSource,
    MAX_COMMAND_TEXT, OutputBinding, Parts, Recipe, SendOn, Span, Words, placeholders,
};
use crate::command::Request;
use crate::device::{Boundary, Encoding, LayoutError, Overflow};
use crate::image::BitSet;
use crate::recipe::model::{Framing, MAX_STREAM_FRAME, Mode, Rules};
use crate::recipe::{CanLayout, PartError, StreamLayout};
use crate::sysvar::{COUNT, Direction, SysVar, VarBit};
use crate::wire::dialect::Dialect;
use crate::wire::scalar::{Scalar, ScalarType};

pub(super) struct RecipeCheck<'a> {
    config: ConfigView<'a>,
    index: u8,
    recipe: &'a Recipe,
}

impl<'a> RecipeCheck<'a> {
    pub(super) fn new(config: ConfigView<'a>, index: u8, recipe: &'a Recipe) -> Self {
        Self { config, index, recipe }
    }

    pub(super) fn check(&self) -> Check {
        let names = self.config.recipes.iter().map(|recipe| &recipe.name);
        check_new_name(self.at(RecipeKey::Name), &self.recipe.name, self.index, names)?;
        ExchangeCheck { config: self.config, index: self.index, recipe: self.recipe }.check()?;
        if !self.has(Direction::Input) && !self.has(Direction::Output) {
            return fail(self.at(RecipeKey::Whole), Kind::NoParts);
        }
        // UDP has the weakest requirements for a stream recipe, but does not support user-defined ones (D16).
        let framing = if self.recipe.mode == Mode::User { Framing::Bytes } else { Framing::Datagram };
        let is_device = self.config.is_device(self.recipe);
        for part in [Direction::Input, Direction::Output] {
            for (frame, span) in self.config.frames_of(self.recipe, part) {
                let place = Place::Frame { recipe: self.index, part, frame };
                check_pool(place, span, self.config.fields.len())?;
            }
            if is_device {
                self.check_framing(part)?;
                self.check_device_frames(part)?;
            } else if let Err(error) = check_layout(self.config, self.recipe, part, framing) {
                return fail(self.place_of(part, error), Kind::Part(error));
            }
            for (frame, field, spec) in self.config.fields_of(self.recipe, part) {
                let place = Place::Field { recipe: self.index, part, frame, field };
                self.check_field(place, part, spec)?;
            }
            match part {
                Direction::Input => self.check_rules()?,
                Direction::Output => self.check_sendable()?,
            }
        }
        if self.recipe.mode == Mode::User {
            self.check_written_once()?;
        }
        self.check_send()
    }

    fn has(&self, part: Direction) -> bool {
        self.config.has_frames(self.recipe, part)
    }

    fn at(&self, key: RecipeKey) -> Place {
        Place::Recipe { recipe: self.index, key }
    }

    fn place_of(&self, part: Direction, error: PartError) -> Place {
        let recipe = self.index;
        match (error.field(), error.frame()) {
            (Some(at), _) => Place::Field { recipe, part, frame: at.frame.unwrap_or(0), field: at.field },
            (None, Some(frame)) => Place::Frame { recipe, part, frame },
            (None, None) => Place::Part { recipe, part },
        }
    }

    fn check_field(&self, place: Place, part: Direction, spec: &FieldSpec) -> Check {
        match (self.recipe.mode, part, *spec) {
            (Mode::Realtime, _, FieldSpec::System(_)) => Ok(()),
            (Mode::User, Direction::Input, FieldSpec::UserInput { ty, to }) => {
                self.check_input(place, Numbers::of(ty), to)
            }
            (Mode::User, Direction::Output, FieldSpec::UserOutput { ty, from }) => {
                self.check_source(place, from)?;
                check_output(place, ty, from)
            }
            (Mode::User, Direction::Input, FieldSpec::DeviceInput { encoding, overflow, to }) => {
                let wraps = matches!(to, InputBinding::Variable { var, .. } if var.ty() != ScalarType::Float);
                if overflow == Overflow::Wrap && !wraps {
                    return fail(place, Kind::OnlyIntegersWrap);
                }
                self.check_input(place, Numbers::written(&encoding), to)
            }
            (Mode::User, Direction::Output, FieldSpec::DeviceOutput { encoding, overflow, from }) => {
                if overflow == Overflow::Wrap && !encoding.is_integer() {
                    return fail(place, Kind::OnlyIntegersWrap);
                }
                self.check_source(place, from)?;
                check_device_output(place, &encoding, from)
            }
            (
                Mode::User,
                _,
                FieldSpec::Fixed { .. }
                | FieldSpec::Padding { .. }
                | FieldSpec::Checksum(_)
                | FieldSpec::Length(_),
            )
            // Checked together with the frame.
            | (Mode::User, _, FieldSpec::Limits(_) | FieldSpec::Mapped(_))
            | (Mode::User, Direction::Input, FieldSpec::InputRule(_)) => Ok(()),
            (Mode::User, Direction::Input, FieldSpec::TextInput { to, length_to, count_to, .. }) => {
                let is_input = |var: SysVar| var.direction() == Direction::Input;
                let vars = to.iter().map(|words| words.first).chain(length_to).chain(count_to);
                if let Some(var) = vars.into_iter().find(|&var| !is_input(var)) {
                    return fail(place, Kind::NotAnInput { var });
                }
                check_words(place, to)?;
                check_word(place, length_to.into_iter().chain(count_to))
            }
            (Mode::User, Direction::Output, FieldSpec::TextOutput { from, length_from, .. }) => {
                check_words(place, Some(from))?;
                check_word(place, length_from)
            }
            (mode, part, _) => fail(place, Kind::WrongField { mode, part }),
        }
    }

    /// Checks what output fields may send.
    fn check_sendable(&self) -> Check {
        self.check_behind(Direction::Output, Behind::check)
    }

    /// Checks the rules of input fields.
    fn check_rules(&self) -> Check {
        self.check_behind(Direction::Input, BehindInput::check)
    }

    /// Checks each field of a part with the entries that follow it; each frame starts with a new state.
    fn check_behind<B: Default>(
        &self,
        part: Direction,
        check: impl Fn(&mut B, Place, &'a [FieldSpec]) -> Check,
    ) -> Check {
        let recipe = self.index;
        for (frame, span) in self.config.frames_of(self.recipe, part) {
            let mut behind = B::default();
            let mut rest = span.of(self.config.fields);
            let mut field = 0_u8;
            while let Some((_, after)) = rest.split_first() {
                check(&mut behind, Place::Field { recipe, part, frame, field }, rest)?;
                (rest, field) = (after, field.saturating_add(1));
            }
        }
        Ok(())
    }

    fn check_input(&self, place: Place, numbers: Numbers, to: InputBinding) -> Check {
        match to {
            InputBinding::Unused => Ok(()),
            InputBinding::Counter { max } => check_counter(place, numbers, max),
            InputBinding::Variable { var, scale, offset } => {
                if var.direction() != Direction::Input {
                    return fail(place, Kind::NotAnInput { var });
                }
                check_scale(place, scale, offset)
            }
            InputBinding::Bit { var, bit } => {
                if var.direction() != Direction::Input {
                    return fail(place, Kind::NotAnInput { var });
                }
                check_bit(VarBit { var, bit }).map_err(|kind| ConfigError { place, kind })?;
                match numbers.ty {
                    _ if numbers.integers => Ok(()),
                    Some(ty) => fail(place, Kind::NeedsInteger { ty }),
                    None => fail(place, Kind::NeedsIntegers),
                }
            }
            InputBinding::Commands { table, .. } => {
                if !numbers.integers {
                    return fail(
                        place,
                        numbers.ty.map_or(Kind::NeedsIntegers, |ty| Kind::NeedsInteger { ty }),
                    );
                }
                self.check_commands(place, numbers, table)
            }
        }
    }

    /// Checks sources that are not variables, for any kind of field.
    fn check_source(&self, place: Place, from: OutputBinding) -> Check {
        match from {
            OutputBinding::State { value, scale, offset } => {
                // An unknown dialect has already been refused.
                let dialect = Dialect::named(&self.config.controller.dialect).unwrap_or(Dialect::V2_3);
                if let Err(error) = value.place(&dialect) {
                    return fail(place, Kind::StateValue(error));
                }
                check_scale(place, scale, offset)
            }
            OutputBinding::Port { port, value, scale, offset } => {
                if let Some(port) = port
                    && !self.config.field_ports().any(|(index, _, _)| index == port)
                {
                    return fail(place, Kind::NoFieldPort { port });
                }
                if value.is_count() && (scale, offset) != (1.0, 0.0) {
                    return fail(place, Kind::ScaledCount);
                }
                check_scale(place, scale, offset)
            }
            OutputBinding::Link { link, scale, offset } => {
                let is_there = match link {
                    LinkSource::RecipeUdp => self.config.controller.recipe_link.is_some(),
                    LinkSource::Listening(port) => {
                        let port = self.config.ports.get(usize::from(port));
                        port.is_some_and(|port| !port.bus.is_field())
                    }
                    LinkSource::Command | LinkSource::Urgent | LinkSource::State | LinkSource::Modbus => true,
                };
                if !is_there {
                    return fail(place, Kind::NoLink { link });
                }
                check_scale(place, scale, offset)
            }
            OutputBinding::Bit { var, bit } => {
                check_bit(VarBit { var, bit }).map_err(|kind| ConfigError { place, kind }).map(|_| ())
            }
            _ => Ok(()),
        }
    }

    fn check_commands(&self, place: Place, numbers: Numbers, table: Span) -> Check {
        let commands = self.config.commands;
        check_pool(place, table, commands.len())?;
        if table.of(commands).iter().all(CommandEntry::is_idle) {
            return fail(place, Kind::EmptyTable);
        }
        let entries = || (table.start..).zip(table.of(commands));
        for (entry, command) in entries() {
            let place = Place::Command { entry };
            let &CommandEntry { first, last, .. } = command;
            if first > last {
                return fail(place, Kind::BackwardRange { first, last });
            }
            check_command_text(place, command)?;
            let Numbers { low, high, ty, .. } = numbers;
            for end in [first, last] {
                let value = end as f64;
                if !(low..=high).contains(&value) {
                    let written = Kind::NotInField { value, low, high };
                    return fail(place, ty.map_or(written, |ty| Kind::CommandValue { value: end, ty }));
                }
            }
            let earlier = entries().take_while(|(other, _)| *other < entry);
            let mut common = earlier.map(|(_, before)| (first.max(before.first), last.min(before.last)));
            if let Some((value, _)) = common.find(|(first, last)| first <= last) {
                return fail(place, Kind::DuplicateCommand { value });
            }
        }
        Ok(())
    }

    /// Checks how the frames of a stream part are separated.
    fn check_framing(&self, part: Direction) -> Check {
        let Some(stream) = self.recipe.stream_part(part).filter(|stream| stream.is_cut()) else {
            return Ok(());
        };
        let place = Place::Part { recipe: self.index, part };
        let kind = match (stream.framing, stream.escape) {
            _ if self.recipe.mode != Mode::User => Kind::FramingNeedsUser,
            (Boundary::Tail | Boundary::Silence, Some(_)) => Kind::TwoFramings,
            (Boundary::Tail, None) if stream.tail.is_empty() => Kind::NoTail,
            _ => return Ok(()),
        };
        fail(place, kind)
    }

    fn check_device_frames(&self, part: Direction) -> Check {
        let recipe = self.index;
        for frame in self.config.device_frames(self.recipe, part) {
            let error = match DeviceFrame::new(frame.carrier, part, frame.delimiters, frame.fields) {
                Err(error) => error,
                Ok(device) => {
                    let escape = self.recipe.stream_part(part).and_then(|stream| stream.escape);
                    let len = escape.map_or(0, |escape| escape.longest(device.layout.lengths().1));
                    if part == Direction::Input || len <= MAX_STREAM_FRAME {
                        continue;
                    }
                    LayoutError::TooLong { len, room: MAX_STREAM_FRAME }
                }
            };
            let place = match field_of(frame.fields, error) {
                Some(field) => Place::Field { recipe, part, frame: frame.nth, field },
                None => Place::Frame { recipe, part, frame: frame.nth },
            };
            return fail(place, Kind::Layout(error));
        }
        match &self.recipe.parts {
            Parts::Can { input, output } => {
                let frames = if part == Direction::Input { input } else { output };
                self.check_ids(part, frames)
            }
            Parts::Stream { .. } => Ok(()),
        }
    }

    /// The layout checks this for recipes that are not a device's.
    fn check_ids(&self, part: Direction, frames: &[CanFramePart]) -> Check {
        let recipe = self.index;
        let constants = |frame: &CanFramePart| Constants::of(frame.fields.of(self.config.fields), part);
        for (nth, frame) in (0..).zip(frames) {
            let id = frame.id;
            let same_id = |(_, earlier): &(u8, &CanFramePart)| earlier.id == id;
            let is_same = |(_, earlier): &(u8, &CanFramePart)| !constants(earlier).differ(&constants(frame));
            let earlier = (0..nth).zip(frames).filter(same_id).find(is_same);
            let error = match earlier {
                _ if !id.is_valid() => PartError::InvalidId { frame: nth, id },
                Some((first, _)) => PartError::Indistinguishable { frame: nth, first, id },
                None => continue,
            };
            return fail(Place::Frame { recipe, part, frame: nth }, Kind::Part(error));
        }
        Ok(())
    }

    /// The layout checks this for realtime recipes.
    fn check_written_once(&self) -> Check {
        let mut seen = [false; COUNT];
        let mut bits = BitSet::EMPTY;
        for (frame, field, spec) in self.config.fields_of(self.recipe, Direction::Input) {
            let place = Place::Field { recipe: self.index, part: Direction::Input, frame, field };
            if let Some(bit) = spec.bit() {
                let own = BitSet::of(bit.var, bit.mask().unwrap_or(0));
                if is_marked(&seen, bit.var) {
                    return fail(place, Kind::WholeAndBit { bit });
                }
                if !bits.and(own).is_empty() {
                    return fail(place, Kind::BitWrittenTwice { bit });
                }
                bits = bits.or(own);
            }
            for var in spec.variables() {
                if is_marked(&seen, var) {
                    return fail(place, Kind::WrittenTwice { var });
                }
                let before = bits.byte(var);
                if before != 0 {
                    let bit = VarBit { var, bit: before.trailing_zeros() as u8 };
                    return fail(place, Kind::WholeAndBit { bit });
                }
                mark(&mut seen, var);
            }
        }
        Ok(())
    }

    fn check_send(&self) -> Check {
        let place = self.at(RecipeKey::Send);
        let recipe = self.recipe;
        if recipe.send == SendOn::Period {
            return Ok(());
        }
        if recipe.mode == Mode::Realtime {
            return fail(place, Kind::RealtimeSendsByPeriod);
        }
        if recipe.part_frames(Direction::Output).next().is_none() {
            return fail(place, Kind::NothingToSend);
        }
        match recipe.send {
            SendOn::Period | SendOn::Change => Ok(()),
            SendOn::Frame if self.has(Direction::Input) => Ok(()),
            SendOn::Frame => fail(place, Kind::NoInputToAnswer),
            SendOn::Rising { var, bit } => check_trigger(place, var, bit),
        }
    }
}

/// The range of a field's numbers.
#[derive(Clone, Copy)]
struct Numbers {
    low: f64,
    high: f64,
    integers: bool,
    /// The type, if it is one of the recipes' own.
    ty: Option<ScalarType>,
}

impl Numbers {
    fn of(ty: ScalarType) -> Self {
        Self { ty: Some(ty), ..Self::written(&Encoding::scalar(ty)) }
    }

    fn written(encoding: &Encoding) -> Self {
        let (low, high) = encoding.range();
        Self { low, high, integers: encoding.is_integer(), ty: None }
    }
}

/// The field of an alive counter must have unsigned integers.
fn check_counter(place: Place, numbers: Numbers, max: u32) -> Check {
    let is_unsigned = numbers.integers && numbers.low == 0.0;
    let high = if is_unsigned { numbers.high.min(f64::from(u32::MAX)) } else { -1.0 };
    let is_in_range = max > 0 && f64::from(max) <= high;
    if is_in_range { Ok(()) } else { fail(place, Kind::Counter { max, high }) }
}

fn check_device_output(place: Place, encoding: &Encoding, from: OutputBinding) -> Check {
    let (low, high) = encoding.range();
    match from {
        OutputBinding::Variable { scale, offset, .. } => check_scale(place, scale, offset),
        OutputBinding::Constant(value) => {
            if !(low..=high).contains(&value) {
                return fail(place, Kind::NotInField { value, low, high });
            }
            let is_whole = encoding.fit(value, Overflow::Usual) == Some(value);
            if is_whole { Ok(()) } else { fail(place, Kind::NeedsIntegers) }
        }
        OutputBinding::Counter if !encoding.is_integer() => fail(place, Kind::NeedsIntegers),
        OutputBinding::CounterTo { max } => check_counter(place, Numbers::written(encoding), max),
        OutputBinding::Port { value, .. } if value.is_count() && !encoding.is_integer() => {
            fail(place, Kind::NeedsIntegers)
        }
        _ => Ok(()),
    }
}

/// The words of a text must be word variables of one group.
fn check_words(place: Place, words: Option<Words>) -> Check {
    let Some(words @ Words { first, count, order }) = words else { return Ok(()) };
    let is_one_run = words.iter().all(|var| var.group() == first.group() && var.ty() == ScalarType::Word);
    if !is_one_run || words.iter().count() != usize::from(count) || count == 0 {
        return fail(place, Kind::NotWords { var: first, count });
    }
    if order.swaps_words() { fail(place, Kind::TextOrder) } else { Ok(()) }
}

fn check_word(place: Place, vars: impl IntoIterator<Item = SysVar>) -> Check {
    let other = vars.into_iter().find(|var| var.ty() != ScalarType::Word);
    other.map_or(Ok(()), |var| fail(place, Kind::NotWords { var, count: 1 }))
}

/// Checks a command with its first and its last value; if both are valid, all are.
fn check_command_text(place: Place, command: &CommandEntry) -> Check {
    if command.is_idle() {
        return Ok(());
    }
    for value in [command.first, command.last] {
        let Some(text) = command.text_for(value) else {
            let (len, longest) = (command.len_for(value), MAX_COMMAND_TEXT);
            return fail(place, Kind::TooLong { len, longest });
        };
        if let Err(error) = Request::parse_strict(text.as_bytes()) {
            let kind = match placeholders(&command.text) {
                0 => Kind::Command(error),
                _ => Kind::CommandFor { value, error },
            };
            return fail(place, kind);
        }
    }
    Ok(())
}

fn check_scale(place: Place, scale: f32, offset: f32) -> Check {
    if scale.is_finite() && scale != 0.0 && offset.is_finite() {
        Ok(())
    } else {
        fail(place, Kind::BadScale { scale, offset })
    }
}

fn check_output(place: Place, ty: ScalarType, from: OutputBinding) -> Check {
    match from {
        OutputBinding::Variable { scale, offset, .. } => check_scale(place, scale, offset),
        OutputBinding::Constant(value) => match Scalar::from_f64(ty, value) {
            Ok(_) => Ok(()),
            Err(error) => fail(place, Kind::Constant(error)),
        },
        OutputBinding::CounterTo { max } => check_counter(place, Numbers::of(ty), max),
        OutputBinding::Counter if matches!(ty, ScalarType::Float | ScalarType::Double) => {
            fail(place, Kind::NeedsInteger { ty })
        }
        OutputBinding::Port { value, .. }
            if value.is_count() && matches!(ty, ScalarType::Float | ScalarType::Double) =>
        {
            fail(place, Kind::NeedsInteger { ty })
        }
        _ => Ok(()),
    }
}

/// Compiles one part of a recipe that is not a device's, only to find errors.
pub(super) fn check_layout(
    config: ConfigView<'_>,
    recipe: &Recipe,
    part: Direction,
    framing: Framing,
) -> Result<(), PartError> {
    let rules = Rules { mode: recipe.mode, direction: part };
    let fields = |span: Span| span.of(config.fields).iter().filter_map(FieldSpec::field);
    match &recipe.parts {
        Parts::Stream { input, output } => {
            let part = if part == Direction::Input { input } else { output };
            part.as_ref().map_or(Ok(()), |part| {
                StreamLayout::new(rules, &part.head, &part.tail, fields(part.fields), framing).map(|_| ())
            })
        }
        Parts::Can { input, output } => {
            let frames = if part == Direction::Input { input } else { output };
            if frames.is_empty() {
                return Ok(());
            }
            CanLayout::new(rules, frames.iter().map(|frame| (frame.id, fields(frame.fields)))).map(|_| ())
        }
    }
}
