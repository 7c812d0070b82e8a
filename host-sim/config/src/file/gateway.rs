//! A gateway file: TOML to [`GatewayConfig`], checked.

mod assemble;
mod places;

use proto_core::config::{
    Bus, ConfigError, ConfigErrorKind, ControllerLink, Counted, Echo, GatewayConfig, MAX_ADDRESS, MAX_LISTEN,
    MAX_PORTS, MAX_SAFE_VALUES, Place, Port, RecipeLink, Rs485, check_address,
};
use proto_core::recipe::model::Framing;
use proto_core::sysvar::VarBit;
use proto_core::time::Duration;
use proto_core::wire::dialect::Dialect;

use super::FileError;
use super::document::{At, SourceTree};
use super::lines::read_line;
use super::model::{FileRecipe, Flavour};
use super::names::meant_variable;
use super::network::{self, check_ipv4};
use super::reader::{Result, Spot, TableReader, TableValue};
use super::recipes;
use super::sources;
use crate::keys;
use crate::keys::gateway::{
    ABSENT, BITRATE, BUSES, BusKind, COMMAND, CYCLE, ECHO, ECHOES, LINK_UDP, MODBUS, REFRESH, SAFE_AT_START,
    STALE_AFTER, STATE, TIMEOUT, UDP2011,
};
use crate::keys::recipe::RecipeKind;

/// Reads the whole file and checks it.
pub(super) fn read(document: &SourceTree) -> Result<Box<GatewayConfig>> {
    let root = TableReader::root(document, &keys::top::GATEWAY)?;
    let recipes = recipes::read_all(&root, Flavour::Gateway)?;
    let mut config = Box::new(GatewayConfig::empty());
    config.controller = read_controller(&root, &recipes)?;
    if let Some(item) = root.optional("network") {
        config.network = Some(network::read(&item.table(&keys::gateway::NETWORK)?)?).into();
    }
    let ports = root.any_tables("port")?;
    ports.iter().try_for_each(|port| port.check(&keys::gateway::PORT))?;
    // The names of all ports are needed first, because recipes may refer to any port.
    let port_names = ports.iter().filter_map(|port| port.optional("name")?.as_string()).map(str::to_owned);
    let mut assembly = Assembly {
        root: &root,
        recipes: &recipes,
        ports: &ports,
        port_names: port_names.collect(),
        config,
        commands: Vec::new(),
        safe_values: Vec::new(),
    };
    recipes.iter().try_for_each(|recipe| assembly.add_recipe(recipe))?;
    ports.iter().try_for_each(|port| assembly.add_port(port))?;
    match assembly.config.validate() {
        Ok(()) => Ok(assembly.config),
        Err(error) => Err(assembly.refused(error)),
    }
}

impl BusKind {
    /// Checks that Modbus recipes are used on Modbus lines, and only there.
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

/// The configuration so far, and its sources.
struct Assembly<'a> {
    root: &'a TableReader<'a>,
    recipes: &'a [FileRecipe],
    ports: &'a [TableReader<'a>],
    /// Names of all ports, including those that have not been added yet.
    port_names: Vec<String>,
    config: Box<GatewayConfig>,
    /// The places of the configuration's commands, and of its safe values.
    commands: Vec<Spot>,
    safe_values: Vec<Spot>,
}

impl Assembly<'_> {
    fn error(&self, spot: &Spot, message: impl ToString) -> FileError {
        spot.error(self.root.document, message)
    }

    /// An error of the configuration's own checks, with its place in the file.
    fn refused(&self, ConfigError { place, kind }: ConfigError) -> FileError {
        let message = self.config.view().describe_kind(kind).to_string();
        match self.spot(place) {
            Some(spot) => self.error(&spot, message),
            None => self.root.document.whole_file_error(format!("{place:?}: {message}")),
        }
    }

    fn add_port(&mut self, table: &TableReader<'_>) -> Result<()> {
        let recipes = self.recipes;
        let (name, _) = recipes::read_name(table)?;
        let kind = table
            .required(
                "bus",
                "rs485, modbus-rtu, modbus-rtu-slave, modbus-tcp, can, tcp-listen or udp-listen",
            )?
            .choice(&BUSES)?;
        if self.config.ports.is_full() {
            return Err(table.error(format!("too many ports; at most {MAX_PORTS}")));
        }
        let bus = read_bus(table, kind)?;
        let item = table.required("recipe", "the name of a recipe of this file")?;
        let recipe = &recipes[recipes::find(recipes, &item)?];
        kind.check_modbus(recipe).map_err(|message| item.error(message))?;
        // The check of the whole configuration refuses kinds of recipes that the bus does not support.
        if matches!(kind, BusKind::Rs485 | BusKind::TcpListen) && !recipe.is_can() {
            recipe.check_framing(Framing::Bytes).map_err(|message| item.error(message))?;
        }
        let mut port = Port::on(&name, &recipe.name, bus).cycle(table.time_or(&CYCLE)?);
        port = port.timeout(read_timeout(table)?).stale_after(table.time_or(&STALE_AFTER)?);
        let safe = read_safe_values(table)?;
        let values: Vec<_> =
            safe.iter().map(|value| (value.name, value.number().unwrap_or(f64::NAN))).collect();
        port = port.safe(&values[..]);
        if table.flag(&SAFE_AT_START)? {
            port = port.safe_at_start();
        }
        if let Some(refresh) = table.time(&REFRESH)? {
            port = port.refresh(refresh);
        }
        port = port.absent(table.time_or(&ABSENT)?);
        if let Some(item) = table.optional("health") {
            port = port.health(sources::read_health(&item)?);
        }
        let first = self.config.safe_values.len();
        self.safe_values.extend(safe.iter().map(|value| value.item.spot.clone()));
        self.config.add_port(&port).map(|_| ()).map_err(|error| {
            let entry = match (error.place, error.kind) {
                (_, ConfigErrorKind::TooMany { what: Counted::SafeValues, .. }) => MAX_SAFE_VALUES,
                (Place::SafeValue { entry }, _) => usize::from(entry),
                _ => return self.refused(error),
            };
            safe.get(entry - first)
                .map_or_else(|| self.refused(error), |value| self.refused_value(value, error.kind))
        })
    }

    fn refused_value(&self, value: &NamedValue<'_>, kind: ConfigErrorKind) -> FileError {
        let NamedValue { name, key, item } = value;
        match kind {
            ConfigErrorKind::TooMany { room, .. } => {
                self.error(key, format!("too many safe values; at most {room} on all ports together"))
            }
            ConfigErrorKind::Variable(wrong) if VarBit::parse(name).is_none() => {
                self.error(key, format!("{wrong}{}", meant_variable(name)))
            }
            ConfigErrorKind::Constant(_) | ConfigErrorKind::NotInField { .. } => {
                value.number().err().unwrap_or_else(|| item.error(kind))
            }
            _ => self.error(key, self.config.view().describe_kind(kind)),
        }
    }
}

/// A safe value of a port.
struct NamedValue<'a> {
    name: &'a str,
    key: Spot,
    item: TableValue<'a>,
}

impl NamedValue<'_> {
    fn number(&self) -> Result<f64> {
        match VarBit::parse(self.name) {
            Some(_) => self.item.bit().map(|bit| f64::from(u8::from(bit))),
            None => self.item.number(),
        }
    }
}

fn read_safe_values<'a>(table: &TableReader<'a>) -> Result<Vec<NamedValue<'a>>> {
    let Some(item) = table.optional("on_timeout") else { return Ok(Vec::new()) };
    if item.is_table() {
        let values = item.any_table()?;
        return Ok(values.entries().map(|(name, key, item)| NamedValue { name, key, item }).collect());
    }
    match item.as_string() {
        Some("hold") => Ok(Vec::new()),
        _ => Err(item.error(
            "allowed: \"hold\", or a table of safe values such as { \"DigitalOutputCommand[1]\" = 0 }",
        )),
    }
}

fn read_timeout(table: &TableReader<'_>) -> Result<Duration> {
    let Some(item) = table.optional("timeout_ms") else { return table.time_or(&TIMEOUT) };
    match item.as_string() {
        Some("never") => Ok(Port::NEVER),
        Some(_) => Err(item.error("expected a number or \"never\", for a device that sends only events")),
        None => item.time(&TIMEOUT),
    }
}

fn read_controller(root: &TableReader<'_>, recipes: &[FileRecipe]) -> Result<ControllerLink> {
    let table = root
        .required(
            "controller",
            "a gateway file needs the controller's address: [controller] address = \"...\"",
        )?
        .table(&keys::gateway::CONTROLLER)?;
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
                // An override for this run wins.
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
                BusKind::ModbusMaster => read_line(table, Rs485::with_rtu_turnaround)?,
                BusKind::ModbusSlave => read_line(table, Rs485::with_rtu_silence)?,
                _ => read_line(table, |line| line)?,
            };
            line.echo = table.optional(ECHO.name).map_or(Ok(Echo::Auto), |item| read_echo(&item))?;
            Bus::Rs485(line)
        }
        BusKind::ModbusTcp => read_modbus_tcp(table)?,
        BusKind::Can => Bus::Can { bitrate: table.integer_or(&BITRATE)? },
        BusKind::TcpListen => Bus::TcpListen { listen: listen()? },
        BusKind::UdpListen => Bus::UdpListen { listen: listen()? },
    })
}

/// The address of the devices of Modbus TCP: a host, and optionally a port.
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

/// Copies a string whose length was checked when it was read.
fn bounded<const N: usize>(text: &str) -> heapless::String<N> {
    heapless::String::try_from(text).unwrap_or_default()
}
