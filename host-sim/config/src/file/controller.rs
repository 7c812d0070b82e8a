//! A controller file: TOML to [`SimConfig`], checked.

use std::net::IpAddr;

use proto_core::recipe::model::{Framing, Mode};
use proto_core::wire::scalar::Scalar;

use super::document::SourceTree;
use super::functions;
use super::lines::read_line;
use super::model::{FileRecipe, Flavour};
use super::network::check_ipv4;
use super::reader::{Result, Spot, TableReader, TableValue};
use super::recipes;
use crate::TargetError;
use crate::functions::Functions;
use crate::keys;
use crate::keys::controller::{
    BUSES, BusKind, CLIENTS, COMMAND, COMMAND_CLIENTS, CONTROL, MODBUS, MODE, MODES, POWER, POWERS, STATE,
    UDP2011,
};
use crate::keys::gateway::{BITRATE, CYCLE};
use crate::sim::{Initial, Listen, Robot, SimBus, SimConfig, SimPort, SimProgram};
use crate::target::InitialTarget;

/// Reads the whole file and checks it.
pub(super) fn read(document: &SourceTree) -> Result<SimConfig> {
    let root = TableReader::root(document, &keys::top::CONTROLLER)?;
    let recipes = recipes::read_all(&root, Flavour::Controller)?;
    let programs = read_programs(&root)?;
    let functions = functions::read(&root, &programs)?;
    Ok(SimConfig {
        listen: read_listen(&root)?,
        robot: read_robot(&root)?,
        initial: read_initial(&root, &functions)?,
        functions,
        recipes: recipes.iter().map(FileRecipe::to_sim).collect(),
        ports: read_ports(&root, &recipes)?,
        programs,
    })
}

fn read_listen(root: &TableReader<'_>) -> Result<Listen> {
    let mut listen = Listen::default();
    let Some(item) = root.optional("listen") else { return Ok(listen) };
    let table = item.table(&keys::controller::LISTEN)?;
    if let Some(item) = table.optional("address") {
        let text = item.string()?;
        listen.address = text.parse::<IpAddr>().map_err(|_| {
            item.error(format!("{text:?} is not an IP address, such as 127.0.0.1 or 0.0.0.0"))
        })?;
    }
    for (key, target) in [
        (COMMAND, &mut listen.command),
        (STATE, &mut listen.state),
        (MODBUS, &mut listen.modbus),
        (UDP2011, &mut listen.udp2011),
        (CONTROL, &mut listen.control),
    ] {
        *target = table.integer_or(&key)?;
    }
    let tcp = [
        ("command", listen.command),
        ("state", listen.state),
        ("modbus", listen.modbus),
        ("control", listen.control),
    ];
    for (nth, (key, port)) in tcp.iter().enumerate() {
        if let Some((other, _)) = tcp.iter().take(nth).find(|(_, before)| *port != 0 && before == port) {
            let message = format!("port {port} is already used by {other}");
            return Err(table.optional(key).map_or(table.error(&message), |item| item.error(&message)));
        }
    }
    Ok(listen)
}

fn read_robot(root: &TableReader<'_>) -> Result<Robot> {
    let mut robot = Robot::default();
    let Some(item) = root.optional("robot") else { return Ok(robot) };
    let table = item.table(&keys::controller::ROBOT)?;
    if let Some(item) = table.optional("dialect") {
        robot.dialect = super::known_dialect(&item, item.string()?)?.to_owned();
    }
    robot.power = table.word_or(&POWER, &POWERS)?;
    robot.mode = table.word_or(&MODE, &MODES)?;
    robot.command_clients = table.word_or(&CLIENTS, &COMMAND_CLIENTS)?;
    Ok(robot)
}

fn read_initial(root: &TableReader<'_>, functions: &Functions) -> Result<Vec<Initial>> {
    let mut initial: Vec<Initial> = Vec::new();
    let Some(item) = root.optional("initial") else { return Ok(initial) };
    for (name, key_spot, item) in item.any_table()?.entries() {
        let target: InitialTarget =
            name.parse().map_err(|error: TargetError| key_spot.error(root.document, error.to_string()))?;
        if initial.iter().any(|before| before.target == target) {
            return Err(key_spot.error(root.document, format!("{target} already has an initial value")));
        }
        if functions.state_of(target).is_some() {
            let message = format!("{target} shows a state (functions.outputs); it takes no initial value");
            return Err(key_spot.error(root.document, message));
        }
        initial.push(Initial { target, value: read_value(target, &item)? });
    }
    Ok(initial)
}

fn read_value(target: InitialTarget, item: &TableValue<'_>) -> Result<f64> {
    match target {
        InitialTarget::Bit { .. } | InitialTarget::VarBit(_) => {
            item.bit().map(|bit| f64::from(u8::from(bit)))
        }
        InitialTarget::Analog { group, .. } => {
            let (low, high) = group.range();
            let value = item.number()?;
            if (low..=high).contains(&value) {
                Ok(value)
            } else {
                Err(item.error(format!("{value} is out of range; allowed: {low}..={high}")))
            }
        }
        InitialTarget::Var(var) => {
            let value = Scalar::from_f64(var.ty(), item.number()?).map_err(|error| item.error(error))?;
            match value {
                Scalar::Byte(bits) if bits & !var.valid_bits() != 0 => Err(item.error(format!(
                    "{bits} sets reserved bits; allowed for {var}: 0..={}",
                    var.valid_bits()
                ))),
                _ => Ok(value.as_f64()),
            }
        }
    }
}

fn read_ports(root: &TableReader<'_>, recipes: &[FileRecipe]) -> Result<Vec<SimPort>> {
    let mut ports: Vec<SimPort> = Vec::new();
    let tables = root.any_tables("port")?;
    tables.iter().try_for_each(|table| table.check(&keys::controller::PORT))?;
    for table in tables {
        let (port, name_spot) = read_port(&table, recipes)?;
        if ports.iter().any(|before| before.name == port.name) {
            let message = format!("there is already a port {:?}; names must differ", port.name);
            return Err(name_spot.error(root.document, message));
        }
        if let Some(before) =
            ports.iter().find(|before| port.bus == SimBus::UdpServer && before.bus == SimBus::UdpServer)
        {
            return Err(
                table.error(format!("{:?} is already the UDP server; there is only one", before.name))
            );
        }
        ports.push(port);
    }
    Ok(ports)
}

fn read_port(table: &TableReader<'_>, recipes: &[FileRecipe]) -> Result<(SimPort, Spot)> {
    let (name, name_spot) = recipes::read_name(table)?;
    let kind = table.required("bus", "rs485, can, udp-server, tcp-client or udp-client")?.choice(&BUSES)?;
    let bus = match kind {
        BusKind::Rs485 => SimBus::Rs485(read_line(table, |line| line)?),
        BusKind::Can => SimBus::Can { bitrate: table.integer_or(&BITRATE)? },
        BusKind::UdpServer => SimBus::UdpServer,
        BusKind::TcpClient => SimBus::TcpClient { to: read_to(table)? },
        BusKind::UdpClient => SimBus::UdpClient { to: read_to(table)? },
    };
    let recipe = match table.optional("recipe") {
        Some(item) => {
            let index = recipes::find(recipes, &item)?;
            if let Some(recipe) = recipes.get(index) {
                check_recipe(kind, recipe).map_err(|message| item.error(message))?;
            }
            Some(index)
        }
        None => None,
    };
    Ok((SimPort { name, bus, recipe, cycle: table.time_or(&CYCLE)? }, name_spot))
}

/// Checks that a port can carry its recipe (D16, D18).
fn check_recipe(kind: BusKind, recipe: &FileRecipe) -> std::result::Result<(), String> {
    let name = &recipe.name;
    let is_can_port = kind == BusKind::Can;
    if recipe.is_can() && !is_can_port {
        return Err(format!("recipe {name:?} is a CAN recipe; only CAN ports take CAN recipes"));
    }
    if !recipe.is_can() && is_can_port {
        return Err(format!("recipe {name:?} is a stream recipe; a CAN port takes only CAN recipes"));
    }
    if recipe.mode == Mode::User && !matches!(kind, BusKind::Rs485 | BusKind::Can) {
        return Err(format!(
            "recipe {name:?} is user-defined; the controller's TCP and UDP ports take only realtime recipes"
        ));
    }
    match kind {
        BusKind::Rs485 | BusKind::TcpClient => recipe.check_framing(Framing::Bytes),
        BusKind::Can | BusKind::UdpServer | BusKind::UdpClient => Ok(()),
    }
}

fn read_to(table: &TableReader<'_>) -> Result<String> {
    let item = table.required("to", "HOST:PORT to connect to, such as \"127.0.0.1:50000\"")?;
    let text = item.string()?;
    let port = text.rsplit_once(':').and_then(|(host, port)| {
        let port = port.parse::<u16>().ok()?;
        (!host.is_empty() && port != 0).then_some(port)
    });
    match port {
        Some(_) => {
            let host = text.rsplit_once(':').map_or(text, |(host, _)| host);
            check_ipv4(host).map_err(|message| item.error(message))?;
            Ok(text.to_owned())
        }
        None => Err(item.error(format!("{text:?} is not HOST:PORT, such as \"127.0.0.1:50000\""))),
    }
}

fn read_programs(root: &TableReader<'_>) -> Result<Vec<SimProgram>> {
    let mut programs: Vec<SimProgram> = Vec::new();
    let tables = root.any_tables("program")?;
    tables.iter().try_for_each(|table| table.check(&keys::controller::PROGRAM))?;
    for table in tables {
        let item = table.required("name", "the name that run(NAME) uses")?;
        let name = item.string()?;
        if name.is_empty() || name.contains([',', '(', ')', '"', '\r', '\n', '\0']) {
            return Err(item.error(format!(
                "run(NAME) cannot name {name:?}; commas, parentheses, quotes, line ends and an empty name are not allowed"
            )));
        }
        if programs.iter().any(|before| before.name == name) {
            return Err(item.error(format!("there is already a program {name:?}; names must differ")));
        }
        let script = table.required("script", "the program's text")?.string()?.to_owned();
        programs.push(SimProgram { name: name.to_owned(), script });
    }
    Ok(programs)
}
