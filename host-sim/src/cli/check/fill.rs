//! From a checked file to the report on it.

use proto_core::config::{Bus, GatewayConfig, PartBudget, Port, Transaction, Warning, can_frame_time};
use proto_core::device::{Boundary, Carrier};
use proto_core::recipe::model::{Field, Mode};
use proto_core::sysvar::{Direction, SysVar};
use proto_core::time::Duration;
use proto_core::wire::can::CanId;
use recipe_config::{
    AnyRecipe, DeviceRecipe, FrameEnds, Function, Functions, ShownState, SimBus, SimConfig, SimField,
    SimParts, SimPort, SimRecipe,
};

use super::super::values::Times;
use super::super::{exchange_report, frame, plan, text, values};
use super::report::{
    self, CheckReport, PartReport, PendantLink, PendantPart, PendantRecipe, Servers, name_of,
};

/// A key as a path, and a sentence.
pub(super) type Placed = (Vec<String>, String);

/// The report on a gateway file, without its buses and warnings.
pub(super) fn gateway(
    file: String,
    config: &GatewayConfig,
    recipes: &[AnyRecipe],
    frames: &[Option<DeviceRecipe>],
) -> CheckReport {
    let link = &config.controller;
    let controller = Servers {
        address: link.address.to_string(),
        dialect: link.dialect.to_string(),
        command: link.command_port,
        state: link.state_port,
        modbus: link.modbus_port,
        udp: link.recipe_link.map(|link| link.udp_port),
    };
    let network = config.network.fixed().map(|network| report::Network {
        address: network.to_string(),
        router: network.router.map(|at| at.to_string()),
        dns: network.dns.map(|at| at.to_string()),
    });
    let ports = config.ports.iter().map(|port| {
        let of = frames.get(usize::from(port.recipe)).and_then(Option::as_ref);
        gateway_port(config, port, recipes.get(usize::from(port.recipe)), of)
    });
    CheckReport {
        ok: true,
        file,
        kind: "gateway",
        controller,
        network,
        ports: ports.collect(),
        ways: Some(plan::ways(config)),
        buses: Vec::new(),
        pendant: Some(pendant_of_gateway(config, recipes)),
        programs: Vec::new(),
        functions: Vec::new(),
        warnings: Vec::new(),
        changes: None,
    }
}

fn gateway_port(
    config: &GatewayConfig,
    port: &Port,
    recipe: Option<&AnyRecipe>,
    frames: Option<&DeviceRecipe>,
) -> report::PortReport {
    let bus = match &port.bus {
        Bus::Rs485(line) => report::Bus::of_line(line),
        Bus::ModbusTcp { host, port } => report::Bus::ModbusTcp { host: host.to_string(), tcp_port: *port },
        Bus::Can { bitrate } => report::Bus::Can { bitrate: *bitrate },
        Bus::TcpListen { listen } => report::Bus::TcpListen { address: listen.to_string() },
        Bus::UdpListen { listen } => report::Bus::UdpListen { address: listen.to_string() },
    };
    // On a field port input comes from the devices, on a listening port from the controller.
    let parts = [Direction::Input, Direction::Output].into_iter().filter_map(|part| {
        let mut shown = PartReport::new(part, config.view().budget(port, part)?, port.cycle);
        shown.picture = frames.map(|recipe| frame::picture(recipe, part));
        shown.least_bytes =
            frames.and_then(|recipe| shortest(recipe, part)).filter(|least| *least < shown.bytes);
        Some(shown)
    });
    let is_tcp = port.bus.is_modbus_tcp();
    report::PortReport {
        name: port.name.to_string(),
        bus,
        recipe: Some(recipe.map_or("", |recipe| recipe.name()).to_owned()),
        cycle_ms: port.cycle,
        parts: parts.collect(),
        exchanges: frames.map_or_else(Vec::new, |recipe| exchange_report::all(config, port, recipe)),
        exchanges_percent: config.view().line_share(port).filter(|_| frames.is_some() && !is_tcp),
        commands: frames.map_or_else(Vec::new, values::commands),
        times: values::times(config, port),
        safe_at_start: port.safe_at_start,
        refresh_ms: port.refresh,
        pendant: None,
    }
}

/// The bytes of the shortest frame on the line, with what escapes need at least.
fn shortest(recipe: &DeviceRecipe, part: Direction) -> Option<usize> {
    let FrameEnds { boundary, escape } = recipe.ends(part);
    let carrier = match (recipe.carrier, boundary, escape) {
        (Carrier::Stream, Boundary::Fields, None) => Carrier::Stream,
        (Carrier::Can, ..) => return None,
        _ => Carrier::Whole,
    };
    // Cannot fail: reading the file laid out the same frames.
    let (shortest, _) = recipe.part(part).first()?.lay_out(carrier, part).ok()?.layout.lengths();
    Some(shortest + escape.map_or(0, |escape| escape.longest(0)))
}

/// What is valid but may not do what was intended, with its place.
pub(super) fn warnings(config: &GatewayConfig) -> Vec<Placed> {
    let view = config.view();
    let port = |nth: u8, key: &str| {
        let name = config.ports.get(usize::from(nth)).map_or("", |port| &port.name);
        ["port", name, key].map(str::to_owned).to_vec()
    };
    let recipe = |nth: u8| {
        let name = config.recipes.get(usize::from(nth)).map_or("", |recipe| &recipe.name);
        ["recipe", name].map(str::to_owned).to_vec()
    };
    let place = |warning: Warning| match warning {
        Warning::DoesNotFit { port: nth, .. } => port(nth, "cycle_ms"),
        Warning::LineFull { port: nth, .. } => port(nth, "recipe"),
        Warning::AskedRarely { port: nth, .. }
        | Warning::ForgetsBase { port: nth, .. }
        | Warning::ShortTimeout { port: nth, .. } => port(nth, "timeout_ms"),
        Warning::ManualAddress { recipe: nth, exchange, .. } => {
            let of = config.recipes.get(usize::from(nth)).map(|recipe| view.exchanges_of(recipe));
            let exchanged = of.and_then(|of| of.get(usize::from(exchange)));
            let list = if exchanged.is_some_and(|one| matches!(one.transaction, Transaction::Served { .. })) {
                "block"
            } else {
                "exchange"
            };
            let number = (u16::from(exchange) + 1).to_string();
            [recipe(nth), [list, &number, "address"].map(str::to_owned).to_vec()].concat()
        }
        Warning::EchoUnknown { port: nth } => port(nth, "echo"),
        Warning::SlowReply { port: nth, exchange, .. } => {
            let of = config.ports.get(usize::from(nth)).map_or(0, |port| port.recipe);
            let number = (u16::from(exchange) + 1).to_string();
            [recipe(of), ["exchange", &number].map(str::to_owned).to_vec()].concat()
        }
        Warning::RepeatedEvent { recipe: nth, exchange }
        | Warning::NoStop { recipe: nth, exchange, .. }
        | Warning::NeverLookedFor { recipe: nth, exchange, .. } => {
            let number = (u16::from(exchange) + 1).to_string();
            [recipe(nth), ["exchange", &number].map(str::to_owned).to_vec()].concat()
        }
        Warning::StopOnEdge { recipe: nth, .. }
        | Warning::ReadBack { recipe: nth, .. }
        | Warning::Unused { recipe: nth } => recipe(nth),
        _ => Vec::new(),
    };
    view.warnings().map(|warning| (place(warning), view.describe_warning(warning).to_string())).collect()
}

/// The report on a controller file, without its warnings.
pub(super) fn controller(file: String, config: &SimConfig) -> CheckReport {
    let listen = &config.listen;
    let controller = Servers {
        address: listen.address.to_string(),
        dialect: config.robot.dialect.clone(),
        command: listen.command,
        state: listen.state,
        modbus: listen.modbus,
        udp: Some(listen.udp2011),
    };
    CheckReport {
        ok: true,
        file,
        kind: "controller",
        controller,
        network: None,
        ports: config.ports.iter().map(|port| controller_port(config, port)).collect(),
        ways: None,
        buses: Vec::new(),
        pendant: None,
        programs: config.programs.iter().map(|program| program.name.clone()).collect(),
        functions: functions(&config.functions),
        warnings: Vec::new(),
        changes: None,
    }
}

fn controller_port(config: &SimConfig, port: &SimPort) -> report::PortReport {
    let bus = match &port.bus {
        SimBus::Rs485(line) => report::Bus::of_line(line),
        SimBus::Can { bitrate } => report::Bus::Can { bitrate: *bitrate },
        SimBus::UdpServer => report::Bus::UdpServer { udp_port: config.listen.udp2011 },
        SimBus::TcpClient { to } => report::Bus::TcpClient { address: to.clone() },
        SimBus::UdpClient { to } => report::Bus::UdpClient { address: to.clone() },
    };
    let recipe = port.recipe.and_then(|index| config.recipes.get(index));
    let parts = [Direction::Input, Direction::Output].into_iter().filter_map(|part| {
        let budget = sim_budget(port, recipe?, part)?;
        let mut shown = PartReport::new(part, budget, port.cycle);
        let is_cyclic = part == Direction::Output && recipe?.mode == Mode::Realtime;
        shown.shortest = Some(budget.time).filter(|time| is_cyclic && *time > port.cycle);
        Some(shown)
    });
    report::PortReport {
        name: port.name.clone(),
        bus,
        recipe: recipe.map(|recipe| recipe.name.clone()),
        cycle_ms: port.cycle,
        parts: parts.collect(),
        exchanges: Vec::new(),
        exchanges_percent: None,
        commands: Vec::new(),
        times: Times::NONE,
        safe_at_start: false,
        refresh_ms: None,
        pendant: recipe.map(pendant),
    }
}

/// The same of a controller file.
pub(super) fn controller_warnings(report: &CheckReport) -> Vec<Placed> {
    let slow = report.ports.iter().flat_map(|port| port.parts.iter().map(move |part| (port, part)));
    slow.filter_map(|(port, part)| {
        let place = ["port", &port.name, "cycle_ms"].map(str::to_owned).to_vec();
        let shortest = part.shortest?;
        let said = format!(
            "port {:?}: the output does not fit the cycle of {}; the shortest possible is {shortest}",
            port.name, part.cycle
        );
        Some((place, said))
    })
    .collect()
}

fn functions(functions: &Functions) -> Vec<report::FunctionReport> {
    let inputs = functions.inputs.iter().map(|input| report::FunctionReport {
        item: input.item.to_string(),
        function: Function::ALL.iter().find(|known| known.1 == input.function).map_or("", |known| known.0),
        program: functions.start.clone().filter(|_| input.function == Function::Start),
        is_input: true,
    });
    let outputs = functions.outputs.iter().map(|output| report::FunctionReport {
        item: output.item.to_string(),
        function: ShownState::ALL.iter().find(|known| known.1 == output.state).map_or("", |known| known.0),
        program: None,
        is_input: false,
    });
    inputs.chain(outputs).collect()
}

/// What to set on the controller's pendant for the gateway's recipe links.
fn pendant_of_gateway(config: &GatewayConfig, recipes: &[AnyRecipe]) -> Vec<PendantLink> {
    let mut links = Vec::new();
    let mut add = |port: String, recipe: u8| {
        // The check of the file let no device's recipe come here.
        if let Some(recipe) = recipes.get(usize::from(recipe)).and_then(AnyRecipe::plain) {
            links.push(PendantLink { port, recipe: recipe.name.clone(), content: pendant(recipe) });
        }
    };
    if let Some(link) = config.controller.recipe_link {
        add(format!("UDP server {}", link.udp_port), link.recipe);
    }
    for port in &config.ports {
        match &port.bus {
            Bus::TcpListen { listen } => add(format!("TCP client to this gateway, {listen}"), port.recipe),
            Bus::UdpListen { listen } => add(format!("UDP client to this gateway, {listen}"), port.recipe),
            Bus::Rs485(_) | Bus::Can { .. } | Bus::ModbusTcp { .. } => {}
        }
    }
    links
}

fn sim_budget(port: &SimPort, recipe: &SimRecipe, part: Direction) -> Option<PartBudget> {
    let bytes_of = |fields: &[SimField]| fields.iter().map(|field| field.field.ty().size()).sum::<usize>();
    match &recipe.parts {
        SimParts::Stream { input, output } => {
            let part = if part == Direction::Input { input } else { output }.as_ref()?;
            let bytes = bytes_of(&part.fields) + part.head.len() + part.tail.len();
            let time = match &port.bus {
                SimBus::Rs485(line) => line.time_on_line(bytes),
                _ => Duration::ZERO,
            };
            Some(PartBudget { frames: 1, bytes, time })
        }
        SimParts::Can { input, output } => {
            let frames = if part == Direction::Input { input } else { output };
            let bitrate = match port.bus {
                SimBus::Can { bitrate } => bitrate,
                _ => return None,
            };
            let times = frames.iter().map(|frame| can_frame_time(frame.id, bytes_of(&frame.fields), bitrate));
            let time = times.fold(Duration::ZERO, |sum, time| sum + time);
            let bytes = frames.iter().map(|frame| bytes_of(&frame.fields)).sum();
            (!frames.is_empty()).then_some(PartBudget { frames: frames.len(), bytes, time })
        }
    }
}

/// A recipe as the pendant shows it: decimal bytes, `__RobotState_8`.
fn pendant(recipe: &SimRecipe) -> PendantRecipe {
    let data = match recipe.mode {
        Mode::Realtime => "system data",
        Mode::User => "user-defined",
    };
    let names = [name_of(Direction::Input), name_of(Direction::Output)];
    let mut parts = Vec::new();
    match &recipe.parts {
        SimParts::Stream { input, output } => {
            for (part, stream) in names.into_iter().zip([input, output]) {
                let Some(stream) = stream else { continue };
                parts.push(PendantPart {
                    part,
                    id: None,
                    hex_id: String::new(),
                    head: Some(stream.head.clone()),
                    tail: Some(stream.tail.clone()),
                    fields: stream.fields.iter().map(show_field).collect(),
                });
            }
        }
        SimParts::Can { input, output } => {
            for (part, frames) in names.into_iter().zip([input, output]) {
                parts.extend(frames.iter().map(|frame| PendantPart {
                    part,
                    id: Some(match frame.id {
                        CanId::Standard(id) => u32::from(id),
                        CanId::Extended(id) => id,
                    }),
                    hex_id: text::show_id(frame.id),
                    head: None,
                    tail: None,
                    fields: frame.fields.iter().map(show_field).collect(),
                }));
            }
        }
    }
    PendantRecipe { data, parts }
}

fn show_field(field: &SimField) -> String {
    match SysVar::parse(&field.name) {
        Ok(var) if matches!(field.field, Field::System(_)) => format!("__{}_{}", var.group(), var.index()),
        _ => format!("{} ({})", field.name, field.field.ty()),
    }
}
