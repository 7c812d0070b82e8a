//! The checks that make a [`GatewayConfig`] fit for the engine.
//!
//! In: a configuration, from whatever file format. Out: nothing, or the first mistake with its
//! place. Order: controller, recipes, ports, then what concerns several of them (ownership and
//! ways up and down).

use super::check_recipe::RecipeCheck;
use super::error::{ConfigError, ConfigErrorKind as Kind, ControllerKey, Place, PortKey, RecipeKey};
use super::listen::listen_address;
use super::{
    Bus, FieldSpec, GatewayConfig, InputBinding, OutputBinding, Parts, Port, Recipe, Rs485, SendOn, Span,
};
use crate::recipe::model::{Field, Framing, Mode, Rules};
use crate::recipe::{CanLayout, PartError, StreamLayout};
use crate::sysvar::{COUNT, Direction, INPUT_COUNT, SysVar};
use crate::time::Duration;
use crate::wire::dialect::Dialect;
use crate::wire::scalar::Scalar;

/// The controller's fastest cycle, and a port's.
pub const MIN_CYCLE: Duration = Duration::from_millis(4);
/// Longest cycle, timeout or staleness that a configuration may ask for.
pub const MAX_TIME: Duration = Duration::from_secs(3_600);
/// Longest idle gap and turnaround of a serial line.
pub const MAX_LINE_TIME: Duration = Duration::from_secs(1);

pub(super) type Check = Result<(), ConfigError>;

impl GatewayConfig {
    /// Checks everything that can be checked without the controller.
    ///
    /// # Errors
    /// The first mistake, with its place and the numbers.
    pub fn validate(&self) -> Result<(), ConfigError> {
        self.check_controller()?;
        self.check_network()?;
        for (index, recipe) in (0..).zip(&self.recipes) {
            RecipeCheck::new(self, index, recipe).check()?;
        }
        for (index, port) in (0..).zip(&self.ports) {
            self.check_port(index, port)?;
        }
        self.check_owners()?;
        self.check_ways_up()?;
        self.check_sources()?;
        self.check_safe_values()
    }

    /// The recipes on the ways up: the recipe link's, then those of the listening ports.
    pub fn upstream_recipes(&self) -> impl Iterator<Item = (u8, &Recipe)> {
        let link = self.controller.recipe_link.map(|link| link.recipe);
        let ports = self.ports.iter().filter(|port| !port.bus.is_field()).map(|port| port.recipe);
        link.into_iter().chain(ports).filter_map(|index| Some((index, self.recipes.get(usize::from(index))?)))
    }

    /// The ports with devices behind them, with their indices and recipes.
    pub fn field_ports(&self) -> impl Iterator<Item = (u8, &Port, &Recipe)> {
        (0..)
            .zip(&self.ports)
            .filter(|(_, port)| port.bus.is_field())
            .filter_map(|(index, port)| Some((index, port, self.recipes.get(usize::from(port.recipe))?)))
    }

    /// The fields of one part of `recipe`, with the index of the CAN frame (0 in a stream) and the
    /// index of the field in it.
    pub fn fields_of<'a>(
        &'a self,
        recipe: &'a Recipe,
        part: Direction,
    ) -> impl Iterator<Item = (u8, u8, &'a FieldSpec)> {
        recipe.frames(part).flat_map(move |(frame, span)| {
            (0..).zip(span.of(&self.fields)).map(move |(index, field)| (frame, index, field))
        })
    }

    /// The input variables that a field port writes.
    pub fn written_by<'a>(&'a self, recipe: &'a Recipe) -> impl Iterator<Item = SysVar> + 'a {
        self.fields_of(recipe, Direction::Input).filter_map(|(_, _, field)| field.variable())
    }

    /// Whether a field port writes the variable.
    pub(super) fn is_owned(&self, var: SysVar) -> bool {
        self.field_ports().any(|(_, _, recipe)| self.written_by(recipe).any(|owned| owned == var))
    }

    fn check_controller(&self) -> Check {
        let controller = &self.controller;
        if Dialect::named(&controller.dialect).is_none() {
            return fail(Place::Controller(ControllerKey::Dialect), Kind::UnknownDialect);
        }
        if [controller.command_port, controller.state_port, controller.modbus_port].contains(&0) {
            return fail(Place::Controller(ControllerKey::Ports), Kind::ZeroPort);
        }
        let Some(link) = controller.recipe_link else { return Ok(()) };
        let place = Place::Controller(ControllerKey::RecipeLink);
        if link.udp_port == 0 {
            return fail(place, Kind::ZeroPort);
        }
        self.check_upstream_recipe(place, link.recipe)
    }

    fn check_network(&self) -> Check {
        let Some(network) = &self.network else { return Ok(()) };
        let checked = network.check(&self.controller.address);
        checked.map_err(|(key, kind)| ConfigError { place: Place::Network(key), kind })
    }

    /// The controller's TCP and UDP ports take realtime stream recipes only (D16).
    fn check_upstream_recipe(&self, place: Place, index: u8) -> Check {
        let recipe = self.recipe_at(place, index)?;
        if !matches!(recipe.parts, Parts::Stream { .. }) {
            return fail(place, Kind::NeedsStreamRecipe { recipe: index });
        }
        if recipe.mode != Mode::Realtime {
            return fail(place, Kind::NeedsRealtimeRecipe { recipe: index });
        }
        Ok(())
    }

    fn recipe_at(&self, place: Place, index: u8) -> Result<&Recipe, ConfigError> {
        let recipes = self.recipes.len() as u8;
        self.recipes
            .get(usize::from(index))
            .ok_or(ConfigError { place, kind: Kind::NoSuchRecipe { recipe: index, recipes } })
    }

    fn check_port(&self, index: u8, port: &Port) -> Check {
        let at = |key| Place::Port { port: index, key };
        check_name(at(PortKey::Name), &port.name, index, self.ports.iter().map(|port| &port.name))?;
        let recipe = self.recipe_at(at(PortKey::Recipe), port.recipe)?;
        let is_stream = matches!(recipe.parts, Parts::Stream { .. });
        match &port.bus {
            Bus::Rs485(line) => {
                line.check().map_err(|(key, kind)| ConfigError { place: at(key), kind })?;
                if !is_stream {
                    return fail(at(PortKey::Recipe), Kind::NeedsStreamRecipe { recipe: port.recipe });
                }
                self.check_framing(index, port.recipe, recipe)?;
            }
            Bus::Can { bitrate } => {
                check_bitrate(*bitrate).map_err(|kind| ConfigError { place: at(PortKey::Bitrate), kind })?;
                if is_stream {
                    return fail(at(PortKey::Recipe), Kind::NeedsCanRecipe { recipe: port.recipe });
                }
            }
            Bus::TcpListen { listen } | Bus::UdpListen { listen } => {
                self.check_upstream_recipe(at(PortKey::Recipe), port.recipe)?;
                if matches!(port.bus, Bus::TcpListen { .. }) {
                    self.check_framing(index, port.recipe, recipe)?;
                }
                self.check_listen(index, port, listen)?;
            }
        }
        check_cycle(port.cycle).map_err(|kind| ConfigError { place: at(PortKey::Cycle), kind })?;
        check_time(at(PortKey::Timeout), port.timeout, MAX_TIME)?;
        check_time(at(PortKey::StaleAfter), port.stale_after, MAX_TIME)?;
        check_pool(at(PortKey::OnTimeout), port.on_timeout, self.safe_values.len())
    }

    /// A byte stream needs a head or a tail to find frames by (D18); the rest holds on any line and
    /// was checked with the recipe.
    fn check_framing(&self, port: u8, index: u8, recipe: &Recipe) -> Check {
        for part in [Direction::Input, Direction::Output] {
            if let Err(error) = self.check_layout(recipe, part, Framing::Bytes) {
                let place = Place::Port { port, key: PortKey::Recipe };
                return fail(place, Kind::Framing { recipe: index, error });
            }
        }
        Ok(())
    }

    /// Compiles one part, if it is there, only to hear what is wrong with it.
    pub(super) fn check_layout(
        &self,
        recipe: &Recipe,
        part: Direction,
        framing: Framing,
    ) -> Result<(), PartError> {
        let rules = Rules { mode: recipe.mode, direction: part };
        let fields = |span: Span| span.of(&self.fields).iter().map(FieldSpec::field);
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

    fn check_listen(&self, index: u8, port: &Port, listen: &str) -> Check {
        let place = Place::Port { port: index, key: PortKey::Listen };
        let Some(address) = listen_address(listen) else {
            return fail(place, Kind::ListenAddress);
        };
        if address.port() == 0 {
            return Ok(());
        }
        let same = |before: &Port| match (&before.bus, &port.bus) {
            (Bus::TcpListen { listen: theirs }, Bus::TcpListen { .. })
            | (Bus::UdpListen { listen: theirs }, Bus::UdpListen { .. }) => {
                listen_address(theirs) == Some(address)
            }
            _ => false,
        };
        match (0..index).zip(&self.ports).find(|(_, before)| same(before)) {
            Some((other, _)) => fail(place, Kind::ListenTwice { other }),
            None => Ok(()),
        }
    }

    /// One owner a variable.
    fn check_owners(&self) -> Check {
        let mut owners = [None; INPUT_COUNT];
        for (index, _, recipe) in self.field_ports() {
            for var in self.written_by(recipe) {
                // An input variable's ordinal is below INPUT_COUNT; others were refused before.
                let Some(owner) = owners.get_mut(var.ordinal()) else { continue };
                match *owner {
                    Some(other) if other != index => {
                        let place = Place::Port { port: index, key: PortKey::Recipe };
                        return fail(place, Kind::OwnedTwice { var, other });
                    }
                    _ => *owner = Some(index),
                }
            }
        }
        Ok(())
    }

    /// Every variable a port writes can be carried, and everything that is carried has a value.
    fn check_ways_up(&self) -> Check {
        for (port, port_config, recipe) in self.field_ports() {
            for (frame, field, spec) in self.fields_of(recipe, Direction::Input) {
                let Some(var) = spec.variable() else { continue };
                if var.modbus().is_none() && !self.carried(Direction::Input, var) {
                    let recipe = port_config.recipe;
                    let place = Place::Field { recipe, part: Direction::Input, frame, field };
                    return fail(place, Kind::NoWayUp { var, port });
                }
            }
        }
        for (index, recipe) in self.upstream_recipes() {
            for (frame, field, spec) in self.fields_of(recipe, Direction::Input) {
                let Some(var) = spec.variable() else { continue };
                if var.stream().is_none() && var.modbus().is_none() && !self.is_owned(var) {
                    let place = Place::Field { recipe: index, part: Direction::Input, frame, field };
                    return fail(place, Kind::Unowned { var });
                }
            }
        }
        Ok(())
    }

    /// Every variable a port sends or triggers on is shown somewhere.
    fn check_sources(&self) -> Check {
        for (port, port_config, recipe) in self.field_ports() {
            let index = port_config.recipe;
            // An input variable can be shown as its owner last sent it.
            let is_shown = |var: SysVar| {
                var.stream().is_some()
                    || var.modbus().is_some()
                    || self.carried(Direction::Output, var)
                    || self.is_owned(var)
            };
            for (frame, field, spec) in self.fields_of(recipe, Direction::Output) {
                if let Some(var) = spec.variable().filter(|&var| !is_shown(var)) {
                    let place = Place::Field { recipe: index, part: Direction::Output, frame, field };
                    return fail(place, Kind::NoSource { var, port });
                }
            }
            if let SendOn::Rising { var, .. } = recipe.send
                && !is_shown(var)
            {
                let place = Place::Recipe { recipe: index, key: RecipeKey::Send };
                return fail(place, Kind::NoSource { var, port });
            }
        }
        Ok(())
    }

    /// Whether a way up carries `var` in its input part, or shows it in its output part.
    fn carried(&self, part: Direction, var: SysVar) -> bool {
        self.upstream_recipes()
            .flat_map(|(_, recipe)| self.fields_of(recipe, part))
            .any(|(_, _, spec)| *spec == FieldSpec::System(var))
    }

    fn check_safe_values(&self) -> Check {
        for (index, port) in (0..).zip(&self.ports) {
            let mut seen = [false; COUNT];
            for (entry, safe) in (port.on_timeout.start..).zip(port.on_timeout.of(&self.safe_values)) {
                let place = Place::SafeValue { entry };
                let var = safe.var;
                let owns = |(port, _, recipe): (u8, &Port, &Recipe)| {
                    port == index && self.written_by(recipe).any(|written| written == var)
                };
                if !self.field_ports().any(owns) {
                    return fail(place, Kind::NotOwned { var });
                }
                if safe.value.ty() != var.ty() {
                    return fail(place, Kind::SafeType { var, ty: safe.value.ty() });
                }
                let reserved = matches!(safe.value, Scalar::Byte(bits) if bits & !var.valid_bits() != 0);
                if reserved || !safe.value.is_finite() {
                    return fail(place, Kind::SafeValue { var });
                }
                if is_marked(&seen, var) {
                    return fail(place, Kind::SafeTwice { var });
                }
                mark(&mut seen, var);
            }
        }
        Ok(())
    }
}

impl Recipe {
    /// The field ranges of one part: one for a stream part, one for each CAN frame.
    pub fn frames(&self, part: Direction) -> impl Iterator<Item = (u8, Span)> + '_ {
        let (stream, can) = match (&self.parts, part) {
            (Parts::Stream { input, .. }, Direction::Input) => (input.as_ref(), None),
            (Parts::Stream { output, .. }, Direction::Output) => (output.as_ref(), None),
            (Parts::Can { input, .. }, Direction::Input) => (None, Some(input)),
            (Parts::Can { output, .. }, Direction::Output) => (None, Some(output)),
        };
        let can = can.into_iter().flatten().map(|frame| frame.fields);
        (0..).zip(stream.map(|part| part.fields).into_iter().chain(can))
    }

    /// Whether the recipe has this part.
    pub fn has(&self, part: Direction) -> bool {
        self.frames(part).next().is_some()
    }
}

impl FieldSpec {
    /// What the field is on the wire.
    pub fn field(&self) -> Field {
        match *self {
            Self::System(var) => Field::System(var),
            Self::UserInput { ty, .. } | Self::UserOutput { ty, .. } => Field::User(ty),
        }
    }

    /// The system variable that the field is, is written to, or is read from.
    pub fn variable(&self) -> Option<SysVar> {
        match *self {
            Self::System(var)
            | Self::UserInput { to: InputBinding::Variable { var, .. }, .. }
            | Self::UserOutput { from: OutputBinding::Variable { var, .. }, .. } => Some(var),
            Self::UserInput { .. } | Self::UserOutput { .. } => None,
        }
    }
}

impl Rs485 {
    /// Whether the settings are within their ranges (D21).
    ///
    /// # Errors
    /// The key and what is wrong with it.
    pub fn check(&self) -> Result<(), (PortKey, Kind)> {
        if !(1_200..=4_000_000).contains(&self.baud) {
            return Err((PortKey::Baud, Kind::BaudOutOfRange { baud: self.baud }));
        }
        if !(1..=2).contains(&self.stop_bits) {
            return Err((PortKey::StopBits, Kind::StopBits { stop_bits: self.stop_bits }));
        }
        if self.idle_gap == Duration::ZERO {
            return Err((PortKey::IdleGap, Kind::ZeroTime));
        }
        for (key, time) in [(PortKey::IdleGap, self.idle_gap), (PortKey::Turnaround, self.turnaround)] {
            if time > MAX_LINE_TIME {
                return Err((key, Kind::TimeTooLong { time, longest: MAX_LINE_TIME }));
            }
        }
        Ok(())
    }
}

/// Whether a CAN bus can run at `bitrate` bit/s (D21).
///
/// # Errors
/// [`ConfigErrorKind::BitrateOutOfRange`](Kind::BitrateOutOfRange).
pub fn check_bitrate(bitrate: u32) -> Result<(), Kind> {
    if (10_000..=1_000_000).contains(&bitrate) { Ok(()) } else { Err(Kind::BitrateOutOfRange { bitrate }) }
}

/// Whether a port can have this cycle: from the controller's fastest to [`MAX_TIME`].
///
/// # Errors
/// [`ConfigErrorKind::CycleTooShort`](Kind::CycleTooShort) or
/// [`ConfigErrorKind::TimeTooLong`](Kind::TimeTooLong).
pub fn check_cycle(cycle: Duration) -> Result<(), Kind> {
    match cycle {
        _ if cycle < MIN_CYCLE => Err(Kind::CycleTooShort { cycle }),
        _ if cycle > MAX_TIME => Err(Kind::TimeTooLong { time: cycle, longest: MAX_TIME }),
        _ => Ok(()),
    }
}

pub(super) fn fail(place: Place, kind: Kind) -> Check {
    Err(ConfigError { place, kind })
}

pub(super) fn check_name<'a>(
    place: Place,
    name: &str,
    index: u8,
    all: impl Iterator<Item = &'a super::Name>,
) -> Check {
    if name.is_empty() {
        return fail(place, Kind::EmptyName);
    }
    match (0..index).zip(all).find(|(_, before)| *before == name) {
        Some((other, _)) => fail(place, Kind::DuplicateName { other }),
        None => Ok(()),
    }
}

pub(super) fn check_pool(place: Place, span: Span, len: usize) -> Check {
    let end = u32::from(span.start).saturating_add(u32::from(span.len));
    let len = len as u32;
    if end <= len { Ok(()) } else { fail(place, Kind::OutsidePool { end, len }) }
}

fn check_time(place: Place, time: Duration, longest: Duration) -> Check {
    if time == Duration::ZERO {
        return fail(place, Kind::ZeroTime);
    }
    if time > longest {
        return fail(place, Kind::TimeTooLong { time, longest });
    }
    Ok(())
}

pub(super) fn mark(set: &mut [bool; COUNT], var: SysVar) {
    if let Some(place) = set.get_mut(var.ordinal()) {
        *place = true;
    }
}

pub(super) fn is_marked(set: &[bool; COUNT], var: SysVar) -> bool {
    set.get(var.ordinal()).copied().unwrap_or(false)
}
