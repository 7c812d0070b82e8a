//! The route or source of each variable, as `check` prints it.

use proto_core::config::{Bus, FieldSpec, GatewayConfig, InputBinding, LinkSource, OutputBinding, SendOn};
use proto_core::engine::{LinkId, Plan, PortId, Route, Source};
use proto_core::sysvar::{Direction, ModbusPlace, SysVar, VarBit};
use serde::Serialize;

const STATE_STREAM: &str = "<- controller: state stream, 10 a second";

/// The route or source of variables of a port.
#[derive(Debug, Serialize)]
pub(super) struct VarRoute {
    port: String,
    /// Neighbours together: `WordInputReg[1..4]`, `BitInputReg[3].0,1`; or what else goes this way.
    what: String,
    /// With an arrow up or down.
    way: String,
}

/// The ways and sources of all field ports' variables, one for each run of neighbours.
pub(super) fn ways(config: &GatewayConfig) -> Vec<VarRoute> {
    // Cannot fail for a valid configuration.
    let Ok(plan) = Plan::new(config) else { return Vec::new() };
    let mut lines: Vec<(String, String, String)> = Vec::new();
    for (_, port, recipe) in config.view().field_ports() {
        let up = config.view().written_by(recipe).map(|var| (var, route(config, &plan, var)));
        add(&mut lines, &port.name, up);
        add_bits(&mut lines, &port.name, config.view().bits_written_by(recipe), |bit| {
            route(config, &plan, bit.var)
        });
        for (value, var) in port.health.iter() {
            let what = format!("{} in {var}", value.name());
            lines.push((port.name.to_string(), what, route(config, &plan, var)));
        }
        let commands: u16 = config
            .view()
            .fields_of(recipe, Direction::Input)
            .filter_map(|(_, _, field)| match field {
                FieldSpec::UserInput { to: InputBinding::Commands { table, .. }, .. }
                | FieldSpec::DeviceInput { to: InputBinding::Commands { table, .. }, .. } => Some(table.len),
                _ => None,
            })
            .sum();
        if commands > 0 {
            let way = "-> controller: command port".into();
            lines.push((port.name.to_string(), format!("{commands} commands"), way));
        }
        let trigger = match recipe.send {
            SendOn::Rising { var, .. } => Some(var),
            _ => None,
        };
        let fields = || config.view().fields_of(recipe, Direction::Output).map(|(_, _, field)| field);
        let shown = fields().filter(|field| field.bit().is_none()).flat_map(FieldSpec::variables);
        add(&mut lines, &port.name, shown.chain(trigger).map(|var| (var, source(config, &plan, var))));
        add_bits(&mut lines, &port.name, fields().filter_map(FieldSpec::bit), |bit| {
            // A bit that a port drives is shown as that port last sent it.
            match plan.bit_owner(bit) {
                Some(port) => format!("<- port {}", port_name(config, port)),
                None => source(config, &plan, bit.var),
            }
        });
        for (_, _, field) in config.view().fields_of(recipe, Direction::Output) {
            let (what, from) = match field.source() {
                Some(OutputBinding::State { value, .. }) => (value.to_string(), STATE_STREAM.into()),
                Some(OutputBinding::Port { port: None, value, .. }) => {
                    (format!("port.{}", value.name()), "<- this port".into())
                }
                Some(OutputBinding::Port { port: Some(of), value, .. }) => {
                    let from = format!("<- port {}", port_name(config, PortId(of)));
                    (format!("port.{}.{}", port_name(config, PortId(of)), value.name()), from)
                }
                Some(OutputBinding::Link { link, .. }) => {
                    let name = match link {
                        LinkSource::Listening(port) => port_name(config, PortId(port)),
                        _ => link.name().unwrap_or_default(),
                    };
                    (format!("link.{name}.up"), "<- the gateway".into())
                }
                _ => continue,
            };
            lines.push((port.name.to_string(), what, from));
        }
    }
    lines.into_iter().map(|(port, what, way)| VarRoute { port, what, way }).collect()
}

/// The ways as text.
pub(super) fn show(ways: &[VarRoute]) -> String {
    let mut report = String::from("\nways\n");
    let width = |column: fn(&VarRoute) -> &String| {
        ways.iter().map(|way| column(way).chars().count()).max().unwrap_or(0)
    };
    let (ports, variables) = (width(|way| &way.port), width(|way| &way.what));
    for VarRoute { port, what, way } in ways {
        report += &format!("  {port:ports$}  {what:variables$}  {way}\n");
    }
    if ways.is_empty() {
        report += "  no port writes or shows a variable\n";
    }
    report
}

/// Adds one line per run of neighbours with the same way or source.
fn add(lines: &mut Vec<(String, String, String)>, port: &str, ways: impl Iterator<Item = (SysVar, String)>) {
    let mut runs: Vec<(SysVar, SysVar, String)> = Vec::new();
    for (var, way) in ways {
        match runs.last_mut() {
            Some((_, last, same))
                if *same == way && last.group() == var.group() && last.ordinal() + 1 == var.ordinal() =>
            {
                *last = var;
            }
            _ => runs.push((var, var, way)),
        }
    }
    for (first, last, way) in runs {
        let name = if first == last {
            first.to_string()
        } else {
            format!("{}[{}..{}]", first.group(), first.index(), last.index())
        };
        lines.push((port.to_owned(), name, way));
    }
}

/// Adds one line for the bits of each byte that go the same way.
fn add_bits(
    lines: &mut Vec<(String, String, String)>,
    port: &str,
    bits: impl Iterator<Item = VarBit>,
    way: impl Fn(VarBit) -> String,
) {
    let mut bytes: Vec<(SysVar, String, Vec<u8>)> = Vec::new();
    for bit in bits {
        let way = way(bit);
        match bytes.iter_mut().find(|(var, other, _)| *var == bit.var && *other == way) {
            Some((_, _, bits)) => bits.push(bit.bit),
            None => bytes.push((bit.var, way, vec![bit.bit])),
        }
    }
    for (var, way, mut bits) in bytes {
        bits.sort_unstable();
        bits.dedup();
        let bits: Vec<_> = bits.iter().map(u8::to_string).collect();
        lines.push((port.to_owned(), format!("{var}.{}", bits.join(",")), way));
    }
}

fn route(config: &GatewayConfig, plan: &Plan, var: SysVar) -> String {
    match plan.route(var) {
        Some(Route::Recipe(link)) => format!("-> controller: {}", link_name(config, link)),
        Some(Route::Modbus) => format!("-> controller: Modbus {}", modbus_kind(var)),
        None => "-> nowhere".into(),
    }
}

fn source(config: &GatewayConfig, plan: &Plan, var: SysVar) -> String {
    match plan.source(var) {
        Some(Source::Recipe(link)) => format!("<- controller: {}", link_name(config, link)),
        Some(Source::Modbus) => format!("<- controller: Modbus {}", modbus_kind(var)),
        Some(Source::State) => STATE_STREAM.into(),
        Some(Source::Field(port)) => format!("<- port {}", port_name(config, port)),
        None => "<- nowhere".into(),
    }
}

fn modbus_kind(var: SysVar) -> &'static str {
    match var.modbus() {
        Some(ModbusPlace::Coils { .. }) => "coils",
        _ => "registers",
    }
}

fn link_name(config: &GatewayConfig, link: LinkId) -> String {
    if link == LinkId::RECIPE_UDP {
        let port = config.controller.recipe_link.map_or(0, |link| link.udp_port);
        return format!("recipe link, UDP {port}");
    }
    let listening = (0..).zip(&config.ports).find(|&(index, _)| LinkId::of_port(PortId(index)) == link);
    match listening.map(|(_, port)| (&port.bus, &port.name)) {
        Some((Bus::TcpListen { .. }, name)) => format!("its TCP client, port {name}"),
        Some((_, name)) => format!("its UDP client, port {name}"),
        None => "a link".into(),
    }
}

fn port_name(config: &GatewayConfig, port: PortId) -> &str {
    config.ports.get(usize::from(port.0)).map_or("", |port| &port.name)
}
