//! Adds recipes and ports to a configuration.
//!
//! In: what a program wrote ([`RecipeBuilder`], [`PortBuilder`]). Out: entries in the configuration's lists with their
//! ranges, or an error and its place. A refused recipe or port changes nothing. [`ConfigView::validate`] checks whether
//! everything fits together.

use heapless::{String, Vec};

use super::add_exchange::FrameNumbers;
use super::draft::{
    ControllerBuilder, DraftTrigger, ListDemand, PartFields, PortBuilder, PortBus, RecipeBuilder,
};
use super::error::{ConfigError, ConfigErrorKind as Kind, ControllerKey, Counted, Place, PortKey, RecipeKey};
use super::exchange_builder::ExchangeBuilder;
use super::fields::{CanFields, Does, Entries, Fields, InputField, OutputField, Sends};
use super::rules::{check_bit, check_name, check_room, text};
use super::view::ConfigMut;
use super::{
    CanFramePart, CommandEntry, ControllerLink, Delimiter, FieldSpec, GatewayConfig, InputBinding, Name,
    OutputBinding, Parts, Port, Recipe, RecipeLink, SafeValue, SafeValues, SendOn, Span, StreamPart,
};
use crate::command::ParseError;
use crate::recipe::model::{MAX_CAN_IDS, MAX_DELIMITER};
use crate::sysvar::{Direction, ParseError as VarError, SysVar, VarBit, VarRange};
use crate::wire::dialect::Dialect;
use crate::wire::scalar::Scalar;

impl<
    const PORTS: usize,
    const RECIPES: usize,
    const ALL_FIELDS: usize,
    const COMMANDS: usize,
    const SAFE_VALUES: usize,
    const EXCHANGES: usize,
> GatewayConfig<PORTS, RECIPES, ALL_FIELDS, COMMANDS, SAFE_VALUES, EXCHANGES>
{
    /// Sets the controller's address, ports and dialect; the recipe link stays.
    ///
    /// # Errors
    /// An address that is too long, or an unknown dialect; nothing was changed then.
    pub fn set_controller<'a>(
        &mut self,
        controller: impl Into<ControllerBuilder<'a>>,
    ) -> Result<(), ConfigError> {
        self.view_mut().set_controller(&controller.into())
    }

    /// Adds a recipe and returns its index.
    ///
    /// # Errors
    /// An invalid name, an unknown variable, or too little space; nothing was added then.
    pub fn add_recipe(&mut self, recipe: &RecipeBuilder<'_>) -> Result<u8, ConfigError> {
        self.view_mut().add_recipe(recipe)
    }

    /// Adds a port and returns its index. Its recipe must be added first.
    ///
    /// # Errors
    /// An invalid name, an unknown recipe, safe values that do not fit, or too little space; nothing was added then.
    pub fn add_port<B: PortBus>(&mut self, port: &PortBuilder<'_, B>) -> Result<u8, ConfigError> {
        self.view_mut().add_port(port)
    }

    /// Declares that the controller's UDP server at this port, normally 2011, is set to this recipe, which must be
    /// added first.
    ///
    /// # Errors
    /// No recipe has this name.
    pub fn set_recipe_link(&mut self, recipe: &str, udp_port: u16) -> Result<(), ConfigError> {
        self.view_mut().set_recipe_link(recipe, udp_port)
    }
}

impl ConfigMut<'_> {
    /// See [`GatewayConfig::set_controller`].
    pub(crate) fn set_controller(&mut self, from: &ControllerBuilder<'_>) -> Result<(), ConfigError> {
        let at = |key| move |kind| ConfigError { place: Place::Controller(key), kind };
        let address = text(from.address).map_err(at(ControllerKey::Address))?;
        let mut link = ControllerLink { address, ..ControllerLink::default() };
        if let Some(name) = from.dialect {
            let dialect = Dialect::named(name).ok_or(Kind::UnknownDialect);
            link.set_dialect(dialect.map_err(at(ControllerKey::Dialect))?);
        }
        for (port, given) in [
            (&mut link.command_port, from.command_port),
            (&mut link.state_port, from.state_port),
            (&mut link.modbus_port, from.modbus_port),
        ] {
            *port = given.unwrap_or(*port);
        }
        link.recipe_link = self.controller.recipe_link;
        *self.controller = link;
        Ok(())
    }

    /// See [`GatewayConfig::set_recipe_link`].
    pub(crate) fn set_recipe_link(&mut self, recipe: &str, udp_port: u16) -> Result<(), ConfigError> {
        let recipe = self.recipe_named(recipe, Place::Controller(ControllerKey::RecipeLink))?;
        self.controller.recipe_link = Some(RecipeLink { udp_port, recipe });
        Ok(())
    }

    /// See [`GatewayConfig::add_recipe`].
    pub(crate) fn add_recipe(&mut self, from: &RecipeBuilder<'_>) -> Result<u8, ConfigError> {
        let (fields, commands) = (self.fields.len(), self.commands.len());
        let (exchanges, frames) = (self.exchanges.len(), self.frames.len());
        let added = self.try_add_recipe(from);
        if added.is_err() {
            self.fields.truncate(fields);
            self.commands.truncate(commands);
            self.exchanges.truncate(exchanges);
            self.frames.truncate(frames);
        }
        added
    }

    fn try_add_recipe(&mut self, from: &RecipeBuilder<'_>) -> Result<u8, ConfigError> {
        let recipe = self.recipes.len() as u8;
        let at = |key| Place::Recipe { recipe, key };
        let name = name(from.name, at(RecipeKey::Name))?;
        let ListDemand { fields, commands, exchanges, frames } = from.counts();
        for (what, needed, room) in [
            (Counted::Recipes, self.recipes.len().saturating_add(1), self.recipes.capacity()),
            (Counted::Fields, self.fields.len().saturating_add(fields), self.fields.capacity()),
            (Counted::Commands, self.commands.len().saturating_add(commands), self.commands.capacity()),
            (Counted::Exchanges, self.exchanges.len().saturating_add(exchanges), self.exchanges.capacity()),
            (Counted::ExchangeFrames, self.frames.len().saturating_add(frames), self.frames.capacity()),
        ] {
            check_room(at(RecipeKey::Whole), what, needed, room)?;
        }
        let parts = match (&from.input, &from.output) {
            (PartFields::Can(input), PartFields::Can(output)) => Parts::Can {
                input: self.can_part(recipe, Direction::Input, input)?,
                output: self.can_part(recipe, Direction::Output, output)?,
            },
            (PartFields::Can(input), PartFields::Absent) => {
                Parts::Can { input: self.can_part(recipe, Direction::Input, input)?, output: Vec::new() }
            }
            (PartFields::Absent, PartFields::Can(output)) => {
                Parts::Can { input: Vec::new(), output: self.can_part(recipe, Direction::Output, output)? }
            }
            (PartFields::Can(_), PartFields::Stream { .. })
            | (PartFields::Stream { .. }, PartFields::Can(_)) => {
                return Err(ConfigError { place: at(RecipeKey::Whole), kind: Kind::MixedParts });
            }
            (PartFields::Absent, PartFields::Absent)
                if from.exchanges.iter().any(ExchangeBuilder::is_can) =>
            {
                Parts::Can { input: Vec::new(), output: Vec::new() }
            }
            (input, output) => Parts::Stream {
                input: self.stream_part(recipe, Direction::Input, input)?,
                output: self.stream_part(recipe, Direction::Output, output)?,
            },
        };
        let send = match from.trigger {
            DraftTrigger::On(send) => send,
            DraftTrigger::Rising(var, bit) => {
                let place = at(RecipeKey::Send);
                let var = var.read().map_err(|error| ConfigError { place, kind: Kind::Variable(error) })?;
                SendOn::Rising { var, bit }
            }
        };
        let mut added = Recipe { on_stale: from.on_stale, send, ..Recipe::new(name, from.mode, parts) };
        let frames = |part| added.part_frames(part).count() as u8;
        let frames = FrameNumbers { input: frames(Direction::Input), output: frames(Direction::Output) };
        added.exchanges = self.add_exchanges(recipe, from.exchanges, frames)?;
        // Cannot fail: space was checked above.
        let _ = self.recipes.push(added);
        Ok(recipe)
    }

    fn stream_part(
        &mut self,
        recipe: u8,
        part: Direction,
        from: &PartFields<'_>,
    ) -> Result<Option<StreamPart>, ConfigError> {
        let PartFields::Stream { head, tail, fields, ends } = from else { return Ok(None) };
        let place = Place::Part { recipe, part };
        let bytes = |bytes: &[u8]| {
            let too_long = Kind::TooLong { len: bytes.len(), longest: MAX_DELIMITER };
            Delimiter::from_slice(bytes).map_err(|_| ConfigError { place, kind: too_long })
        };
        let (head, tail) = (bytes(head)?, bytes(tail)?);
        let fields = self.fields_of_part(recipe, part, 0, fields)?;
        let (framing, escape) = *ends;
        Ok(Some(StreamPart { framing, escape, ..StreamPart::new(head, tail, fields) }))
    }

    fn can_part(
        &mut self,
        recipe: u8,
        part: Direction,
        from: &[CanFields<'_>],
    ) -> Result<Vec<CanFramePart, MAX_CAN_IDS>, ConfigError> {
        check_room(Place::Part { recipe, part }, Counted::CanFrames, from.len(), MAX_CAN_IDS)?;
        let mut frames = Vec::new();
        for (number, frame) in (0..).zip(from) {
            let fields = self.fields_of_part(recipe, part, number, &frame.fields)?;
            // Cannot fail: space was checked above.
            let _ = frames.push(CanFramePart { id: frame.id, fields });
        }
        Ok(frames)
    }

    pub(super) fn fields_of_part(
        &mut self,
        recipe: u8,
        part: Direction,
        frame: u8,
        from: &Fields<'_>,
    ) -> Result<Span, ConfigError> {
        let start = self.fields.len();
        let at = |field: usize| Place::Field { recipe, part, frame, field: field as u8 };
        match *from {
            Fields::Names(names) => {
                for (nth, name) in names.iter().enumerate() {
                    let range = VarRange::parse(name)
                        .map_err(|error| ConfigError { place: at(nth), kind: Kind::Variable(error) })?;
                    range.iter().for_each(|var| self.push_field(FieldSpec::System(var)));
                }
            }
            Fields::Vars(vars) => vars.iter().for_each(|&var| self.push_field(FieldSpec::System(var))),
            Fields::Inputs(fields) => {
                for (nth, field) in fields.iter().enumerate() {
                    let spec = self.input_spec(field).map_err(|kind| ConfigError { place: at(nth), kind })?;
                    self.push_field(spec);
                }
            }
            Fields::Outputs(fields) => {
                for (nth, field) in fields.iter().enumerate() {
                    let spec = output_spec(field).map_err(|kind| ConfigError { place: at(nth), kind })?;
                    self.push_field(spec);
                    field.allowed.specs().for_each(|spec| self.push_field(spec));
                }
            }
            Fields::Specs(fields) => fields.iter().for_each(|&field| self.push_field(field)),
        }
        Ok(Span::between(start, self.fields.len()))
    }

    /// Cannot fail: space was checked at the beginning of the recipe.
    fn push_field(&mut self, field: FieldSpec) {
        let _ = self.fields.push(field);
    }

    fn input_spec(&mut self, field: &InputField<'_>) -> Result<FieldSpec, Kind> {
        field.on_wire.spec(|encoding, overflow| {
            let to = match field.does {
                Does::Nothing => InputBinding::Unused,
                Does::Counter { max } => InputBinding::Counter { max },
                Does::Writes { var, scale, offset } => {
                    InputBinding::Variable { var: var.read().map_err(Kind::Variable)?, scale, offset }
                }
                Does::WritesBit { name } => {
                    let VarBit { var, bit } = read_bit(name)?;
                    InputBinding::Bit { var, bit }
                }
                Does::Commands { entries, when, idle } => {
                    InputBinding::Commands { table: self.add_commands(entries, idle)?, when }
                }
            };
            Ok(FieldSpec::input(encoding, overflow, to))
        })
    }

    /// Space was checked at the beginning of the recipe.
    fn add_commands(&mut self, entries: Entries<'_>, idle: Option<i64>) -> Result<Span, Kind> {
        let start = self.commands.len();
        for (first, last, command) in entries.iter() {
            if command.is_empty() {
                return Err(Kind::Command(ParseError::Empty));
            }
            let _ = self.commands.push(CommandEntry { first, last, text: text(command)? });
        }
        if let Some(value) = idle {
            let _ = self.commands.push(CommandEntry::new(value, String::new()));
        }
        Ok(Span::between(start, self.commands.len()))
    }

    /// See [`GatewayConfig::add_port`].
    pub(crate) fn add_port<B: PortBus>(&mut self, from: &PortBuilder<'_, B>) -> Result<u8, ConfigError> {
        let index = self.ports.len() as u8;
        let at = |key| Place::Port { port: index, key };
        let name = name(from.name, at(PortKey::Name))?;
        let bus = from.bus.bus().map_err(|kind| ConfigError { place: at(PortKey::Listen), kind })?;
        let recipe = self.recipe_named(from.recipe, at(PortKey::Recipe))?;
        let mut port = Port::new(name, bus, recipe);
        port.cycle = from.cycle.unwrap_or(port.cycle);
        port.timeout = from.timeout.unwrap_or(port.timeout);
        port.stale_after = from.stale_after.unwrap_or(port.stale_after);
        (port.health, port.safe_at_start, port.refresh) = (from.health, from.safe_at_start, from.refresh);
        port.absent = from.absent.unwrap_or(port.absent);
        self.put_port(port, &from.safe)
    }

    fn put_port(&mut self, mut port: Port, safe: &SafeValues<'_>) -> Result<u8, ConfigError> {
        let index = self.ports.len() as u8;
        let (ports, values) = (self.ports.len(), self.safe_values.len());
        for (key, what, needed, room) in [
            (PortKey::Name, Counted::Ports, ports.saturating_add(1), self.ports.capacity()),
            (
                PortKey::OnTimeout,
                Counted::SafeValues,
                values.saturating_add(safe.len()),
                self.safe_values.capacity(),
            ),
        ] {
            check_room(Place::Port { port: index, key }, what, needed, room)?;
        }
        let added = match *safe {
            SafeValues::Names(named) => {
                self.add_safe_values(named.iter().map(|&(name, value)| match VarBit::parse(name) {
                    Some(bit) => bit.map_err(Kind::Variable).and_then(|bit| safe_bit(bit, value)),
                    None => {
                        SysVar::parse(name).map_err(Kind::Variable).and_then(|var| safe_value(var, value))
                    }
                }))
            }
            SafeValues::Vars(vars) => {
                self.add_safe_values(vars.iter().map(|&(var, value)| safe_value(var, value)))
            }
            SafeValues::Values(values) => self.add_safe_values(values.iter().map(|&value| Ok(value))),
        };
        added.inspect_err(|_| self.safe_values.truncate(values))?;
        port.on_timeout = Span::between(values, self.safe_values.len());
        // Cannot fail: space was checked above.
        let _ = self.ports.push(port);
        Ok(index)
    }

    /// Space was checked by the caller.
    fn add_safe_values(
        &mut self,
        values: impl Iterator<Item = Result<SafeValue, Kind>>,
    ) -> Result<(), ConfigError> {
        for value in values {
            let place = Place::SafeValue { entry: self.safe_values.len() as u16 };
            let _ = self.safe_values.push(value.map_err(|kind| ConfigError { place, kind })?);
        }
        Ok(())
    }

    fn recipe_named(&self, name: &str, place: Place) -> Result<u8, ConfigError> {
        let named = (0..).zip(self.recipes.iter()).find(|(_, recipe)| recipe.name == name);
        named.map(|(index, _)| index).ok_or(ConfigError { place, kind: Kind::NoSuchName })
    }
}

fn read_bit(name: &str) -> Result<VarBit, Kind> {
    VarBit::parse(name).unwrap_or(Err(VarError::Syntax)).map_err(Kind::Variable)
}

fn output_spec(field: &OutputField<'_>) -> Result<FieldSpec, Kind> {
    field.on_wire.spec(|encoding, overflow| {
        let from = match field.sends {
            Sends::Variable { var, scale, offset } => {
                OutputBinding::Variable { var: var.read().map_err(Kind::Variable)?, scale, offset }
            }
            Sends::Bit { name } => {
                let VarBit { var, bit } = read_bit(name)?;
                OutputBinding::Bit { var, bit }
            }
            Sends::Constant(value) => OutputBinding::Constant(value),
            Sends::Counter => OutputBinding::Counter,
            Sends::CounterTo { max } => OutputBinding::CounterTo { max },
            Sends::Reply => OutputBinding::Reply,
            Sends::State { value, scale, offset } => OutputBinding::State { value, scale, offset },
            Sends::Health { port, value, scale, offset } => {
                OutputBinding::Port { port, value, scale, offset }
            }
            Sends::Link { link, scale, offset } => OutputBinding::Link { link, scale, offset },
        };
        Ok(FieldSpec::output(encoding, overflow, from))
    })
}

fn safe_value(var: SysVar, value: f64) -> Result<SafeValue, Kind> {
    let value = Scalar::from_f64(var.ty(), value).map_err(Kind::Constant)?;
    Ok(SafeValue::new(var, value))
}

/// A safe value of a bit must be 0 or 1.
fn safe_bit(bit: VarBit, value: f64) -> Result<SafeValue, Kind> {
    check_bit(bit)?;
    if value != 0.0 && value != 1.0 {
        return Err(Kind::NotInField { value, low: 0.0, high: 1.0 });
    }
    Ok(SafeValue::bit(bit, value != 0.0))
}

fn name(given: &str, place: Place) -> Result<Name, ConfigError> {
    check_name(given).and_then(|()| text(given)).map_err(|kind| ConfigError { place, kind })
}
