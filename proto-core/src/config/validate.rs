//! The checks that a configuration must pass before the engine takes it.
//!
//! In: a configuration from any file format. Out: nothing, or the first error with its place. Order: controller,
//! recipes, ports, then checks across them (owners, routes and sources).

use super::check_recipe::{RecipeCheck, check_layout};
use super::error::{
    ConfigError, ConfigErrorKind as Kind, ControllerKey, Counted, ExchangeKey, Place, PortKey, RecipeKey,
};
use super::listen::listen_address;
use super::rules::{
    Check, MAX_TIME, check_address, check_bitrate, check_cycle, check_new_name, check_pool, check_room,
    check_time, fail, is_marked, mark,
};
use super::{
    Bus, ConfigView, Echo, ExchangeError, MAX_ALL_FIELDS, MAX_COMMANDS, MAX_EXCHANGES, MAX_PORTS,
    MAX_RECIPES, MAX_SAFE_VALUES, Parts, Port, PortHealth, Recipe, SafeValue, SendOn, Transaction,
};
use crate::image::BitSet;
use crate::modbus::rtu::BROADCAST;
use crate::recipe::model::{Framing, Mode};
use crate::sysvar::{COUNT, Direction, INPUT_COUNT, SysVar, VarBit};
use crate::wire::dialect::Dialect;
use crate::wire::scalar::Scalar;

impl<'c> ConfigView<'c> {
    /// Checks everything that can be checked without the controller.
    ///
    /// # Errors
    /// The first error, with its place and numbers.
    pub fn validate(self) -> Result<(), ConfigError> {
        self.check_counts()?;
        self.check_controller()?;
        self.check_network()?;
        for (index, recipe) in (0..).zip(self.recipes) {
            RecipeCheck::new(self, index, recipe).check()?;
        }
        for (index, port) in (0..).zip(self.ports) {
            self.check_port(index, port)?;
        }
        self.check_owners()?;
        self.check_routes()?;
        self.check_sources()?;
        self.check_safe_values()
    }

    /// Engine and image hold at most the maximum of a file.
    fn check_counts(&self) -> Check {
        for (what, needed, room) in [
            (Counted::Ports, self.ports.len(), MAX_PORTS),
            (Counted::Recipes, self.recipes.len(), MAX_RECIPES),
            (Counted::Fields, self.fields.len(), MAX_ALL_FIELDS),
            (Counted::Commands, self.commands.len(), MAX_COMMANDS),
            (Counted::SafeValues, self.safe_values.len(), MAX_SAFE_VALUES),
            (Counted::Exchanges, self.exchanges.len(), MAX_EXCHANGES),
            (Counted::ExchangeFrames, self.frames.len(), MAX_EXCHANGES),
        ] {
            check_room(Place::Whole, what, needed, room)?;
        }
        Ok(())
    }

    fn check_controller(&self) -> Check {
        let controller = self.controller;
        if !controller.address.is_empty() {
            let place = Place::Controller(ControllerKey::Address);
            check_address(&controller.address).map_err(|kind| ConfigError { place, kind })?;
        }
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
        let Some(network) = self.network else { return Ok(()) };
        let checked = network.check(&self.controller.address);
        checked.map_err(|(key, kind)| ConfigError { place: Place::Network(key), kind })
    }

    /// The controller's TCP and UDP ports support only realtime stream recipes (D16).
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

    fn recipe_at(&self, place: Place, index: u8) -> Result<&'c Recipe, ConfigError> {
        let recipes = self.recipes.len() as u8;
        self.recipes
            .get(usize::from(index))
            .ok_or(ConfigError { place, kind: Kind::NoSuchRecipe { recipe: index, recipes } })
    }

    fn check_port(&self, index: u8, port: &Port) -> Check {
        let at = |key| Place::Port { port: index, key };
        check_new_name(at(PortKey::Name), &port.name, index, self.ports.iter().map(|port| &port.name))?;
        let recipe = self.recipe_at(at(PortKey::Recipe), port.recipe)?;
        let is_stream = matches!(recipe.parts, Parts::Stream { .. });
        match &port.bus {
            Bus::Rs485(line) => {
                line.check().map_err(|(key, kind)| ConfigError { place: at(key), kind })?;
                if !is_stream {
                    return fail(at(PortKey::Recipe), Kind::NeedsStreamRecipe { recipe: port.recipe });
                }
                self.check_framing(index, port.recipe, recipe)?;
                if line.echo == Echo::Yes && recipe.exchanges.len == 0 {
                    return fail(at(PortKey::Echo), Kind::EchoNeedsExchanges);
                }
            }
            Bus::Can { bitrate } => {
                check_bitrate(*bitrate).map_err(|kind| ConfigError { place: at(PortKey::Bitrate), kind })?;
                if is_stream {
                    return fail(at(PortKey::Recipe), Kind::NeedsCanRecipe { recipe: port.recipe });
                }
            }
            Bus::ModbusTcp { host, port: tcp_port } => {
                check_address(host).map_err(|kind| ConfigError { place: at(PortKey::To), kind })?;
                if *tcp_port == 0 {
                    return fail(at(PortKey::To), Kind::ZeroPort);
                }
                self.check_master(at(PortKey::Recipe), port.recipe, recipe)?;
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
        if port.timeout != Port::NEVER {
            check_time(at(PortKey::Timeout), port.timeout, MAX_TIME)?;
        }
        check_time(at(PortKey::StaleAfter), port.stale_after, MAX_TIME)?;
        check_time(at(PortKey::Absent), port.absent, MAX_TIME)?;
        check_pool(at(PortKey::OnTimeout), port.on_timeout, self.safe_values.len())?;
        if port.safe_at_start && port.on_timeout.len == 0 {
            return fail(at(PortKey::SafeAtStart), Kind::NoSafeValues);
        }
        if let Some(refresh) = port.refresh {
            check_time(at(PortKey::Refresh), refresh, MAX_TIME)?;
            if recipe.send != SendOn::Change {
                return fail(at(PortKey::Refresh), Kind::OnlyChangesRefresh);
            }
        }
        for (_, var) in port.health.iter() {
            if !port.bus.is_field() {
                return fail(at(PortKey::Health), Kind::OnlyFieldPorts);
            }
            if !PortHealth::can_write(var) {
                return fail(at(PortKey::Health), Kind::NotForHealth { var });
            }
        }
        Ok(())
    }

    /// A recipe for Modbus TCP must be a Modbus master's, without broadcasts.
    fn check_master(&self, place: Place, index: u8, recipe: &Recipe) -> Check {
        let exchanges = self.exchanges_of(recipe);
        if exchanges.is_empty()
            || exchanges.iter().any(|one| !matches!(one.transaction, Transaction::Rtu { .. }))
        {
            return fail(place, Kind::NeedsModbusMaster { recipe: index });
        }
        let to_all = (0..).zip(exchanges).find(|(_, one)| one.peer == BROADCAST);
        to_all.map_or(Ok(()), |(exchange, _)| {
            let place = Place::Exchange { recipe: index, exchange, key: ExchangeKey::Peer };
            fail(place, Kind::Exchange(ExchangeError::BroadcastOverTcp))
        })
    }

    /// A byte stream needs a head or a tail to find its frames (D18); everything else is valid on any line and was
    /// checked with the recipe.
    fn check_framing(&self, port: u8, index: u8, recipe: &Recipe) -> Check {
        // The layout of a device's frames is checked with the recipe, for any line.
        if self.is_device(recipe) {
            return Ok(());
        }
        for part in [Direction::Input, Direction::Output] {
            if let Err(error) = check_layout(*self, recipe, part, Framing::Bytes) {
                let place = Place::Port { port, key: PortKey::Recipe };
                return fail(place, Kind::Framing { recipe: index, error });
            }
        }
        Ok(())
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
        match (0..index).zip(self.ports).find(|(_, before)| same(before)) {
            Some((other, _)) => fail(place, Kind::ListenTwice { other }),
            None => Ok(()),
        }
    }

    /// Each variable, or each of its bits, has one owner.
    fn check_owners(&self) -> Check {
        let mut owners = [None; INPUT_COUNT];
        let has_bits = self.fields.iter().any(|field| field.bit().is_some());
        for (index, port, recipe) in self.field_ports() {
            if has_bits {
                self.check_bit_owners(index, recipe)?;
            }
            for var in self.written_by(recipe) {
                // An input variable's ordinal is below INPUT_COUNT; others have already been refused.
                let Some(owner) = owners.get_mut(var.ordinal()) else { continue };
                match *owner {
                    Some(other) if other != index => {
                        let place = Place::Port { port: index, key: PortKey::Recipe };
                        return fail(place, Kind::OwnedTwice { var, other });
                    }
                    _ => *owner = Some(index),
                }
            }
            for (place, var) in self.status_variables(index, port, recipe) {
                match owners.get_mut(var.ordinal()) {
                    Some(Some(other)) if *other == index => return fail(place, Kind::HealthTwice { var }),
                    Some(Some(other)) => return fail(place, Kind::OwnedTwice { var, other: *other }),
                    Some(owner) => *owner = Some(index),
                    None => {}
                }
            }
        }
        Ok(())
    }

    /// Checks that no earlier port writes the same bit, the variable of a bit, or a bit of a variable that the port
    /// writes.
    fn check_bit_owners(&self, index: u8, recipe: &Recipe) -> Check {
        let place = Place::Port { port: index, key: PortKey::Recipe };
        for (other, _, earlier) in self.field_ports().take_while(|(other, ..)| *other < index) {
            for bit in self.bits_written_by(recipe) {
                if self.bits_written_by(earlier).any(|before| before == bit) {
                    return fail(place, Kind::BitOwnedTwice { bit, other });
                }
                if self.carries(earlier, Direction::Input, bit.var) {
                    return fail(place, Kind::OwnedAndShared { bit, other });
                }
            }
            for bit in self.bits_written_by(earlier) {
                if self.carries(recipe, Direction::Input, bit.var) {
                    return fail(place, Kind::OwnedAndShared { bit, other });
                }
            }
        }
        Ok(())
    }

    /// Checks that every variable that a port writes has a route, and that every variable on a route has a value.
    fn check_routes(&self) -> Check {
        for (port, port_config, recipe) in self.field_ports() {
            for (frame, field, spec) in self.fields_of(recipe, Direction::Input) {
                let is_lost = |var: &SysVar| var.modbus().is_none() && !self.carried(Direction::Input, *var);
                if let Some(var) = spec.variables().find(is_lost) {
                    let recipe = port_config.recipe;
                    let place = Place::Field { recipe, part: Direction::Input, frame, field };
                    return fail(place, Kind::NoRoute { var, port });
                }
            }
        }
        for (port, port_config, recipe) in self.field_ports() {
            for (place, var) in self.status_variables(port, port_config, recipe) {
                if var.modbus().is_none() && !self.carried(Direction::Input, var) {
                    return fail(place, Kind::NoRoute { var, port });
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

    /// Checks that every variable that a port sends or triggers on has a source.
    fn check_sources(&self) -> Check {
        for (port, port_config, recipe) in self.field_ports() {
            let index = port_config.recipe;
            // An input variable can be shown as last sent by its owner.
            let is_shown = |var: SysVar| {
                var.stream().is_some()
                    || var.modbus().is_some()
                    || self.carried(Direction::Output, var)
                    || self.is_owned(var)
            };
            for (frame, field, spec) in self.fields_of(recipe, Direction::Output) {
                if let Some(var) = spec.variables().find(|&var| !is_shown(var)) {
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

    /// Whether a route carries `var` in its input part, or shows it in its output part.
    fn carried(&self, part: Direction, var: SysVar) -> bool {
        self.upstream_recipes().any(|(_, recipe)| self.carries(recipe, part, var))
    }

    fn check_safe_values(&self) -> Check {
        for (index, port) in (0..).zip(self.ports) {
            let mut seen = [false; COUNT];
            let mut bits = BitSet::EMPTY;
            for (entry, safe) in (port.on_timeout.start..).zip(port.on_timeout.of(self.safe_values)) {
                let place = Place::SafeValue { entry };
                let var = safe.var;
                if !safe.is_whole() {
                    self.check_safe_bits(index, place, safe, &mut bits)?;
                    continue;
                }
                let owns = |(port, _, recipe): (u8, &Port, &Recipe)| {
                    port == index && self.carries(recipe, Direction::Input, var)
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

    fn check_safe_bits(&self, index: u8, place: Place, safe: &SafeValue, seen: &mut BitSet) -> Check {
        let &SafeValue { var, value, mask } = safe;
        let mut owned = 0;
        for (_, _, recipe) in self.field_ports().filter(|(port, ..)| *port == index) {
            let bits = self.bits_written_by(recipe).filter(|bit| bit.var == var);
            owned |= bits.filter_map(VarBit::mask).fold(0, |all, mask| all | mask);
        }
        let Scalar::Byte(value) = value else {
            return fail(place, Kind::SafeType { var, ty: value.ty() });
        };
        if mask == 0 || mask & !owned != 0 {
            return fail(place, Kind::BitsNotOwned { var, mask: mask & !owned });
        }
        if value & !mask != 0 {
            return fail(place, Kind::SafeValue { var });
        }
        if seen.byte(var) & mask != 0 {
            return fail(place, Kind::SafeTwice { var });
        }
        *seen = seen.or(BitSet::of(var, mask));
        Ok(())
    }
}
