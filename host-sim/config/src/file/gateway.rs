//! A gateway file: TOML to [`GatewayConfig`], checked.

mod exchanges;

use std::collections::HashMap;

use heapless::Vec as Bounded;
use proto_core::config::{
    Bus, CanFramePart, CommandEntry, ConfigError, ConfigErrorKind, ControllerKey, ControllerLink, Delimiter,
    Echo, FieldSpec, GatewayConfig, InputBinding, MAX_ADDRESS, MAX_ALL_FIELDS, MAX_COMMAND_TEXT,
    MAX_COMMANDS, MAX_LISTEN, MAX_PORTS, MAX_RECIPES, MAX_SAFE_VALUES, NetworkKey, Parts, Place, Port,
    PortKey, Recipe, RecipeKey, RecipeLink, SafeValue, Span, StreamPart, check_address, check_bit,
};
use proto_core::recipe::model::{Framing, MAX_CAN_IDS};
use proto_core::sysvar::{Direction, ParseError, SysVar, VarBit};
use proto_core::wire::dialect::Dialect;
use proto_core::wire::scalar::Scalar;

use super::commands::FileCommand;
use super::document::{At, SourceTree};
use super::lines::{key_name, read_bitrate, read_cycle, read_line, read_rtu_line};
use super::model::{FileField, FileInput, FileRecipe, Flavour};
use super::names::meant_variable;
use super::network::{self, check_ipv4};
use super::reader::{Result, Spot, TableReader, TableValue};
use super::recipes;
use super::sources;
use crate::keys;
use crate::keys::gateway::{
    ABSENT, BUSES, BusKind, COMMAND, ECHO, ECHOES, LINK_UDP, MODBUS, REFRESH, SAFE_AT_START, STALE_AFTER,
    STATE, TIMEOUT, UDP2011,
};
use crate::keys::recipe::RecipeKind;

/// Reads the whole file and checks it.
pub(super) fn read(document: &SourceTree) -> Result<Box<GatewayConfig>> {
    let root = TableReader::root(document, &keys::top::GATEWAY)?;
    let recipes = recipes::read_all(&root, Flavour::Gateway)?;
    let mut builder = Builder::new(&root, &recipes)?;
    let ports = root.any_tables("port")?;
    ports.iter().try_for_each(|port| port.check(&keys::gateway::PORT))?;
    // Recipes may name ports.
    builder.port_names =
        ports.iter().filter_map(|port| port.optional("name")?.as_string()).map(str::to_owned).collect();
    for (index, recipe) in recipes.iter().enumerate() {
        builder.add_recipe(index, recipe)?;
    }
    for port in ports {
        builder.add_port(&port, &recipes)?;
    }
    builder.finish()
}

impl BusKind {
    /// A recipe of Modbus and its line go together.
    fn check_modbus(self, recipe: &FileRecipe) -> std::result::Result<(), String> {
        let wanted = match self {
            Self::ModbusMaster | Self::ModbusTcp => Some(RecipeKind::ModbusMaster),
            Self::ModbusSlave => Some(RecipeKind::ModbusSlave),
            _ => None,
        };
        let (name, kind) = (&recipe.name, recipe.kind.name());
        match wanted {
            Some(wanted) if recipe.kind != wanted => Err(format!(
                "recipe {name:?} has kind = {kind:?}; bus = {:?} takes only recipes with kind = {:?}",
                self.name(),
                wanted.name()
            )),
            None if recipe.kind.is_modbus() => Err(format!(
                "recipe {name:?} has kind = {kind:?}, which needs bus = {kind:?}{}; this port has bus = {:?}",
                if recipe.kind == RecipeKind::ModbusMaster { " or \"modbus-tcp\"" } else { "" },
                self.name()
            )),
            _ => Ok(()),
        }
    }
}

/// The configuration read so far, with the place of everything in it.
struct Builder<'a> {
    document: &'a SourceTree,
    config: Box<GatewayConfig>,
    spots: HashMap<Place, Spot>,
    /// The names of all ports, also of those that have not been read yet.
    port_names: Vec<String>,
}

impl<'a> Builder<'a> {
    fn new(root: &TableReader<'a>, recipes: &[FileRecipe]) -> Result<Self> {
        let table = root
            .required(
                "controller",
                "a gateway file needs the controller's address: [controller] address = \"...\"",
            )?
            .table(&keys::gateway::CONTROLLER)?;
        let mut spots = HashMap::new();
        for (key, name) in [
            (ControllerKey::Address, "address"),
            (ControllerKey::Dialect, "dialect"),
            (ControllerKey::Ports, "ports"),
            (ControllerKey::RecipeLink, "recipe_link"),
        ] {
            let spot = table.optional(name).map_or(table.spot.clone(), |item| item.spot);
            spots.insert(Place::Controller(key), spot);
        }
        let controller = read_controller(&table, recipes)?;
        let mut network = None;
        if let Some(item) = root.optional("network") {
            let table = item.table(&keys::gateway::NETWORK)?;
            for (key, name) in
                [(NetworkKey::Address, "address"), (NetworkKey::Router, "router"), (NetworkKey::Dns, "dns")]
            {
                let spot = table.optional(name).map_or(table.spot.clone(), |item| item.spot);
                spots.insert(Place::Network(key), spot);
            }
            network = Some(network::read(&table)?);
        }
        let mut config = Box::new(GatewayConfig::empty());
        config.controller = controller;
        config.network = network.into();
        Ok(Self { document: root.document, config, spots, port_names: Vec::new() })
    }

    fn error(&self, spot: &Spot, message: impl ToString) -> super::FileError {
        spot.error(self.document, message)
    }

    fn add_recipe(&mut self, index: usize, recipe: &FileRecipe) -> Result<()> {
        let Some(place) = u8::try_from(index).ok().filter(|_| index < MAX_RECIPES) else {
            return Err(self.error(&recipe.spot, format!("too many recipes; at most {MAX_RECIPES}")));
        };
        let sending = recipe.output.as_ref().map(|part| &part.sending);
        let send_spot = sending.and_then(|sending| sending.send_spot.as_ref()).unwrap_or(&recipe.spot);
        for (key, spot) in [
            (RecipeKey::Whole, &recipe.spot),
            (RecipeKey::Name, &recipe.name_spot),
            (RecipeKey::Send, send_spot),
        ] {
            self.spots.insert(Place::Recipe { recipe: place, key }, spot.clone());
        }
        let parts = if recipe.is_can() {
            Parts::Can {
                input: self.can_part(place, Direction::Input, recipe)?,
                output: self.can_part(place, Direction::Output, recipe)?,
            }
        } else {
            Parts::Stream {
                input: self.stream_part(place, Direction::Input, recipe)?,
                output: self.stream_part(place, Direction::Output, recipe)?,
            }
        };
        let exchanges = self.add_exchanges(place, recipe)?;
        let on_stale = recipe.on_stale;
        let mut recipe = Recipe::new(bounded(&recipe.name), recipe.mode, parts);
        recipe.exchanges = exchanges;
        recipe.on_stale = on_stale.unwrap_or(recipe.on_stale);
        if let Some(sending) = sending {
            recipe.on_stale = sending.on_stale;
            recipe.send = sending.send;
        }
        // There is room: the index was checked above.
        let _ = self.config.recipes.push(recipe);
        Ok(())
    }

    fn stream_part(&mut self, recipe: u8, part: Direction, from: &FileRecipe) -> Result<Option<StreamPart>> {
        let Some(file) = from.part(part) else { return Ok(None) };
        self.spots.insert(Place::Part { recipe, part }, file.spot.clone());
        let fields = self.add_fields(recipe, part, 0, file.fields())?;
        let mut stream = StreamPart::new(delimiter(&file.head), delimiter(&file.tail), fields);
        (stream.framing, stream.escape) = file.framing;
        Ok(Some(stream))
    }

    fn can_part(
        &mut self,
        recipe: u8,
        part: Direction,
        from: &FileRecipe,
    ) -> Result<Bounded<CanFramePart, MAX_CAN_IDS>> {
        let mut frames = Bounded::new();
        let Some(file) = from.part(part) else { return Ok(frames) };
        self.spots.insert(Place::Part { recipe, part }, file.spot.clone());
        // The layout accepted no more frames than there is room for.
        for (number, frame) in (0..).zip(&file.frames) {
            self.spots.insert(Place::Frame { recipe, part, frame: number }, frame.spot.clone());
            let fields = self.add_fields(recipe, part, number, &frame.fields)?;
            let _ = frames.push(CanFramePart { id: frame.id, fields });
        }
        Ok(frames)
    }

    fn add_fields(&mut self, recipe: u8, part: Direction, frame: u8, fields: &[FileField]) -> Result<Span> {
        let start = self.config.fields.len() as u16;
        for (number, field) in (0..).zip(fields) {
            self.spots.insert(Place::Field { recipe, part, frame, field: number }, field.spot.clone());
            let spec = self.field_spec(field)?;
            if self.config.fields.push(spec).is_err() {
                let message = format!("too many fields; at most {MAX_ALL_FIELDS} in all recipes together");
                return Err(self.error(&field.spot, message));
            }
        }
        Ok(Span { start, len: fields.len() as u16 })
    }

    fn field_spec(&mut self, field: &FileField) -> Result<FieldSpec> {
        let mut added = Ok(());
        let spec = field.bound_spec(|to| match to {
            FileInput::Commands(commands) => {
                let start = self.config.commands.len() as u16;
                added = commands.entries.iter().try_for_each(|entry| self.add_command(entry));
                let table = Span { start, len: commands.entries.len() as u16 };
                InputBinding::Commands { table, when: commands.when }
            }
            _ => to.without_commands(),
        });
        added?;
        match field.port_named() {
            Some((binding, name, spot)) => {
                let from = sources::of_port(binding, name, &self.port_names)
                    .map_err(|message| self.error(spot, message))?;
                Ok(match spec {
                    FieldSpec::UserOutput { ty, .. } => FieldSpec::UserOutput { ty, from },
                    FieldSpec::DeviceOutput { encoding, overflow, .. } => {
                        FieldSpec::DeviceOutput { encoding, overflow, from }
                    }
                    other => other,
                })
            }
            None => Ok(spec),
        }
    }

    fn add_command(&mut self, command: &FileCommand) -> Result<()> {
        let FileCommand { spot, first, last, text } = command;
        let Ok(bounded) = heapless::String::try_from(text.as_str()) else {
            let message = format!("the command has {} bytes; at most {MAX_COMMAND_TEXT}", text.len());
            return Err(self.error(spot, message));
        };
        let entry = self.config.commands.len() as u16;
        self.spots.insert(Place::Command { entry }, spot.clone());
        self.config.commands.push(CommandEntry { first: *first, last: *last, text: bounded }).map_err(|_| {
            self.error(spot, format!("too many commands; at most {MAX_COMMANDS} in all recipes together"))
        })
    }

    fn add_port(&mut self, table: &TableReader<'a>, recipes: &[FileRecipe]) -> Result<()> {
        let (name, _) = recipes::read_name(table)?;
        let kind = table
            .required(
                "bus",
                "rs485, modbus-rtu, modbus-rtu-slave, modbus-tcp, can, tcp-listen or udp-listen",
            )?
            .choice(&BUSES)?;
        let index = self.config.ports.len() as u8;
        if usize::from(index) == MAX_PORTS {
            return Err(table.error(format!("too many ports; at most {MAX_PORTS}")));
        }
        for key in PORT_PLACES {
            let spot = table.optional(key_name(key)).map_or(table.spot.clone(), |item| item.spot);
            self.spots.insert(Place::Port { port: index, key }, spot);
        }
        let bus = read_bus(table, kind)?;
        let item = table.required("recipe", "the name of a recipe of this file")?;
        let recipe = recipes::find(recipes, &item)?;
        if let Some(recipe) = recipes.get(recipe) {
            kind.check_modbus(recipe).map_err(|message| item.error(message))?;
        }
        // The check of the whole configuration refuses kinds of recipes that the bus does not take.
        let is_byte_stream = matches!(kind, BusKind::Rs485 | BusKind::TcpListen);
        if let Some(recipe) = recipes.get(recipe).filter(|recipe| is_byte_stream && !recipe.is_can()) {
            recipe.check_framing(Framing::Bytes).map_err(|message| item.error(message))?;
        }
        let mut port = Port::new(bounded(&name), bus, recipe as u8);
        port.cycle = read_cycle(table)?;
        let timeout = table.optional("timeout_ms");
        port.timeout = match timeout.as_ref().and_then(|item| item.as_string().map(|word| (item, word))) {
            Some((_, "never")) => Port::NEVER,
            Some((item, _)) => {
                return Err(item.error("expected a number or \"never\", for a device that sends only events"));
            }
            None => table.time_or(&TIMEOUT)?,
        };
        port.stale_after = table.time_or(&STALE_AFTER)?;
        port.on_timeout = self.add_safe_values(table)?;
        port.safe_at_start = table.flag(&SAFE_AT_START)?;
        port.refresh = table.time(&REFRESH)?;
        port.absent = table.time_or(&ABSENT)?;
        if let Some(item) = table.optional("health") {
            port.health = sources::read_health(&item)?;
        }
        // There is room: the count was checked above.
        let _ = self.config.ports.push(port);
        Ok(())
    }

    fn add_safe_values(&mut self, table: &TableReader<'a>) -> Result<Span> {
        let start = self.config.safe_values.len() as u16;
        let Some(item) = table.optional("on_timeout") else { return Ok(Span { start, len: 0 }) };
        if !item.is_table() {
            return match item.as_string() {
                Some("hold") => Ok(Span { start, len: 0 }),
                _ => Err(item.error(
                    "allowed: \"hold\", or a table of safe values such as { \"DigitalOutputCommand[1]\" = 0 }",
                )),
            };
        }
        for (name, key_spot, item) in item.any_table()?.entries() {
            let value = match VarBit::parse(name) {
                Some(bit) => self.safe_bit(bit, &key_spot, &item)?,
                None => {
                    let var = SysVar::parse(name)
                        .map_err(|error| self.error(&key_spot, format!("{error}{}", meant_variable(name))))?;
                    let value =
                        Scalar::from_f64(var.ty(), item.number()?).map_err(|error| item.error(error))?;
                    SafeValue::new(var, value)
                }
            };
            let entry = self.config.safe_values.len() as u16;
            self.spots.insert(Place::SafeValue { entry }, item.spot.clone());
            if self.config.safe_values.push(value).is_err() {
                let message =
                    format!("too many safe values; at most {MAX_SAFE_VALUES} on all ports together");
                return Err(self.error(&key_spot, message));
            }
        }
        let len = self.config.safe_values.len() as u16 - start;
        Ok(Span { start, len })
    }

    fn safe_bit(
        &self,
        bit: std::result::Result<VarBit, ParseError>,
        key_spot: &Spot,
        item: &TableValue<'_>,
    ) -> Result<SafeValue> {
        let bit = bit.map_err(|error| self.error(key_spot, error))?;
        check_bit(bit).map_err(|kind| self.error(key_spot, self.config.view().describe_kind(kind)))?;
        Ok(SafeValue::bit(bit, item.bit()?))
    }

    fn finish(self) -> Result<Box<GatewayConfig>> {
        match self.config.validate() {
            Ok(()) => Ok(self.config),
            Err(ConfigError { place, kind }) => {
                let message = self.config.view().describe_kind(kind).to_string();
                Err(match self.spots.get(&place) {
                    Some(spot) => self.error(spot, message),
                    None => self.document.whole_file_error(format!("{place:?}: {message}")),
                })
            }
        }
    }
}

const PORT_PLACES: [PortKey; 17] = [
    PortKey::Name,
    PortKey::Recipe,
    PortKey::Cycle,
    PortKey::Timeout,
    PortKey::OnTimeout,
    PortKey::StaleAfter,
    PortKey::Baud,
    PortKey::StopBits,
    PortKey::IdleGap,
    PortKey::Turnaround,
    PortKey::Echo,
    PortKey::Bitrate,
    PortKey::Listen,
    PortKey::To,
    PortKey::Health,
    PortKey::SafeAtStart,
    PortKey::Refresh,
];

fn read_controller(table: &TableReader<'_>, recipes: &[FileRecipe]) -> Result<ControllerLink> {
    let address = table.required("address", "the controller's IP address or host name")?;
    let mut link = ControllerLink::default();
    link.address = read_address(&address)?;
    if let Some(item) = table.optional("dialect") {
        let name = item.string()?;
        if let Some(dialect) = Dialect::named(super::known_dialect(&item, name)?) {
            link.set_dialect(dialect);
        }
    }
    let mut udp_port = 2011;
    let mut udp_item = None;
    if let Some(ports) = table.optional("ports") {
        let ports = ports.table(&keys::gateway::PORTS)?;
        for (key, target) in [
            (COMMAND, &mut link.command_port),
            (STATE, &mut link.state_port),
            (MODBUS, &mut link.modbus_port),
            (UDP2011, &mut udp_port),
        ] {
            *target = ports.integer_or(&key)?;
        }
        udp_item = ports.optional(UDP2011.name);
    }
    if let Some(item) = table.optional("recipe_link") {
        let table = item.table(&keys::gateway::RECIPE_LINK)?;
        if let Some(port) = table.integer(&LINK_UDP)? {
            let is_set = |spot: &Spot| matches!(spot.at, At::Override(_));
            let link_is_set = table.optional(LINK_UDP.name).is_some_and(|item| is_set(&item.spot));
            match udp_item.filter(|_| port != udp_port) {
                // What is set for this run counts.
                Some(item) if is_set(&item.spot) && !link_is_set => {}
                Some(item) if is_set(&item.spot) == link_is_set => {
                    return Err(item.error(format!(
                        "{udp_port} is not the port of controller.recipe_link.udp, {port}; write it in one of the two"
                    )));
                }
                _ => udp_port = port,
            }
        }
        let recipe = table.required("recipe", "the recipe that the controller's UDP 2011 port is set to")?;
        let recipe = recipes::find(recipes, &recipe)? as u8;
        link.recipe_link = Some(RecipeLink { udp_port, recipe });
    }
    Ok(link)
}

fn read_address(item: &TableValue<'_>) -> Result<heapless::String<MAX_ADDRESS>> {
    let text = item.string()?;
    check_address(text).map_err(|kind| item.error(format!("{text:?} is {kind}")))?;
    check_ipv4(text).map_err(|message| item.error(message))?;
    Ok(bounded(text))
}

fn read_echo(item: &TableValue<'_>) -> Result<Echo> {
    let word = item.as_string().and_then(|text| ECHOES.iter().find(|(word, _)| *word == text));
    match (item.as_bool(), word) {
        (Some(true), _) => Ok(Echo::Yes),
        (Some(false), _) => Ok(Echo::No),
        (None, Some((_, echo))) => Ok(*echo),
        (None, None) => Err(match item.as_string() {
            Some(text) => item.error(format!("{text:?} is unknown; allowed: true, false, \"auto\"")),
            None => item.wrong_kind("true, false or \"auto\""),
        }),
    }
}

fn read_bus(table: &TableReader<'_>, kind: BusKind) -> Result<Bus> {
    let listen = || -> Result<heapless::String<MAX_LISTEN>> {
        let item = table.required("listen", "an IP address and a port, such as \"0.0.0.0:50000\"")?;
        heapless::String::try_from(item.string()?)
            .map_err(|_| item.error(format!("longer than {MAX_LISTEN} bytes")))
    };
    Ok(match kind {
        BusKind::Rs485 | BusKind::ModbusMaster | BusKind::ModbusSlave => {
            let mut line = match kind {
                BusKind::Rs485 => read_line(table)?,
                _ => read_rtu_line(table, kind == BusKind::ModbusMaster)?,
            };
            line.echo = table.optional(ECHO.name).map_or(Ok(Echo::Auto), |item| read_echo(&item))?;
            Bus::Rs485(line)
        }
        BusKind::ModbusTcp => read_modbus_tcp(table)?,
        BusKind::Can => Bus::Can { bitrate: read_bitrate(table)? },
        BusKind::TcpListen => Bus::TcpListen { listen: listen()? },
        BusKind::UdpListen => Bus::UdpListen { listen: listen()? },
    })
}

/// Where the devices of Modbus TCP are: a host, and perhaps a port.
fn read_modbus_tcp(table: &TableReader<'_>) -> Result<Bus> {
    let item = table.required("to", "the device's IP address or host name, such as \"192.168.1.50\"")?;
    let text = item.string()?;
    let wrong = || item.error(format!("{text:?} is not HOST or HOST:PORT, such as \"192.168.1.50:502\""));
    // An IPv6 address has colons of its own.
    let (host, port) = match text.strip_prefix('[').and_then(|rest| rest.split_once(']')) {
        Some((host, "")) => (host, None),
        Some((host, rest)) => (host, Some(rest.strip_prefix(':').ok_or_else(wrong)?)),
        None if text.matches(':').count() > 1 => (text, None),
        None => text.split_once(':').map_or((text, None), |(host, port)| (host, Some(port))),
    };
    let digits =
        |port: &str| port.bytes().all(|byte| byte.is_ascii_digit()).then(|| port.parse().ok()).flatten();
    let port = match port {
        Some(port) => digits(port).filter(|port| *port != 0).ok_or_else(wrong)?,
        None => Bus::MODBUS_TCP,
    };
    check_address(host).map_err(|kind| match kind {
        ConfigErrorKind::Address => wrong(),
        kind => item.error(format!("{host:?} is {kind}")),
    })?;
    check_ipv4(host).map_err(|message| item.error(message))?;
    Ok(Bus::ModbusTcp { host: bounded(host), port })
}

/// The layout accepted no more bytes than there is room for.
fn delimiter(bytes: &[u8]) -> Delimiter {
    Delimiter::from_slice(bytes).unwrap_or_default()
}

/// Read with the same limit.
fn bounded<const N: usize>(text: &str) -> heapless::String<N> {
    heapless::String::try_from(text).unwrap_or_default()
}
