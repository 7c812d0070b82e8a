//! `check`: whether a file is valid, how busy its buses are, and what to set on the pendant.

use std::io::Write;
use std::path::{Path, PathBuf};

use clap::Args;
use proto_core::config::{Bus, GatewayConfig, MAX_PORTS, Parity, PartBudget, Rs485, can_frame_time};
use proto_core::engine::Engine;
use proto_core::recipe::model::Mode;
use proto_core::sysvar::{Direction, SysVar};
use proto_core::time::Duration;
use proto_core::wire::can::CanId;

use super::{Overrides, conversation, frame, plan, text, values};
use recipe_config::file::{self, Config, FileError};
use recipe_config::{
    AnyRecipe, DeviceRecipe, Function, Functions, ShownState, SimBus, SimConfig, SimField, SimParts, SimPort,
    SimRecipe, SimStreamPart,
};
use recipe_controller::{BuildError, Controller};

/// Arguments of `check`.
#[derive(Debug, Args)]
pub(super) struct CheckArgs {
    /// A gateway file or a controller file
    file: PathBuf,
    #[command(flatten)]
    overrides: Overrides,
}

pub(super) fn run(args: &CheckArgs, out: &mut dyn Write) -> Result<(), String> {
    let overrides = &args.overrides.set;
    let config = file::load(&args.file, overrides).map_err(|error| error.to_string())?;
    let recipes = file::load_recipes(&args.file, overrides).map_err(|error| error.to_string())?;
    match &config {
        Config::Gateway(config) => check_room(&args.file, overrides, config),
        Config::Controller(config) => check_build(&args.file, overrides, config),
    }
    .map_err(|error| error.to_string())?;
    let name = args.file.display();
    let report = match &config {
        Config::Gateway(config) => {
            let frames = file::load_frames(&args.file, overrides).map_err(|error| error.to_string())?;
            format!("{name}: a valid gateway file\n\n{}", gateway(config, &recipes, &frames))
        }
        Config::Controller(config) => format!("{name}: a valid controller file\n\n{}", controller(config)),
    };
    write!(out, "{report}").map_err(|error| error.to_string())
}

/// Loads a controller file and checks that its programs compile and its values fit.
pub(super) fn load_controller(path: &Path, overrides: &[String]) -> Result<SimConfig, FileError> {
    let config = file::load_controller(path, overrides)?;
    check_build(path, overrides, &config)?;
    Ok(config)
}

/// Loads a gateway file and checks that this host's engine has room for it.
pub(super) fn load_gateway(path: &Path, overrides: &[String]) -> Result<Box<GatewayConfig>, FileError> {
    let config = file::load_gateway(path, overrides)?;
    check_room(path, overrides, &config)?;
    Ok(config)
}

/// Checks what only the engine can refuse.
fn check_room(path: &Path, overrides: &[String], config: &GatewayConfig) -> Result<(), FileError> {
    match Engine::<MAX_PORTS>::new(config) {
        Ok(_) => Ok(()),
        Err(error) => Err(file::error_at(path, overrides, &["port"], error)),
    }
}

/// Checks what only the controller can refuse.
fn check_build(path: &Path, overrides: &[String], config: &SimConfig) -> Result<(), FileError> {
    let Err(error) = Controller::new(config) else { return Ok(()) };
    let at = |key: &[&str], message: &dyn std::fmt::Display| file::error_at(path, overrides, key, message);
    Err(match &error {
        BuildError::Program { program, error } => at(&["program", program, "script"], error),
        BuildError::Initial { target, reason } => at(&["initial", &target.to_string()], reason),
        BuildError::Function { reason, .. } => at(&["functions"], reason),
        BuildError::Port { port, error } => at(&["port", port, "recipe"], error),
        BuildError::SecondUdpServer { port } => at(&["port", port], &error),
        BuildError::Dialect(_) => at(&["robot", "dialect"], &error),
        _ => at(&["robot"], &error),
    })
}

/// The report on a gateway file.
fn gateway(config: &GatewayConfig, recipes: &[AnyRecipe], frames: &[Option<DeviceRecipe>]) -> String {
    let link = &config.controller;
    let mut report = format!(
        "controller {} ({}): command {}, state {}, Modbus {}\n",
        link.address, link.dialect, link.command_port, link.state_port, link.modbus_port
    );
    if let Some(network) = config.network.fixed() {
        let others = [("router", network.router), ("name server", network.dns)];
        let others = others.iter().filter_map(|(what, at)| Some(format!(", {what} {}", at.as_ref()?)));
        report +=
            &format!("a board's address is {network}{}; a host has its own\n", others.collect::<String>());
    }
    for port in &config.ports {
        let recipe = recipes.get(usize::from(port.recipe));
        let name = recipe.map_or("", |recipe| recipe.name());
        let bus = match &port.bus {
            Bus::Rs485(line) => show_line(line),
            Bus::Can { bitrate } => show_can_bus(*bitrate),
            Bus::TcpListen { listen } => format!("the controller's TCP client connects to {listen}"),
            Bus::UdpListen { listen } => format!("the controller's UDP client sends to {listen}"),
        };
        report += &format!("\nport {}: {bus}, recipe {name}\n", port.name);
        let frames = frames.get(usize::from(port.recipe)).and_then(Option::as_ref);
        // On a field port input comes from the devices, on a listening port from the controller.
        for part in [Direction::Input, Direction::Output] {
            if let Some(budget) = config.view().budget(port, part) {
                report += &show_budget(part, budget, port.cycle);
                if let Some(recipe) = frames {
                    report += &frame::show(recipe, part);
                }
            }
        }
        if let Some(recipe) = frames {
            report += &conversation::show(config, port, recipe);
            report += &values::show_commands(recipe);
        }
        report += &values::show_times(config, port);
        if port.safe_at_start {
            report += "  safe values from the start until the device speaks\n";
        }
        if let Some(refresh) = port.refresh {
            report += &format!("  output sent on change, and after {refresh} without one\n");
        }
    }
    report += &plan::show(config);
    report += &pendant_of_gateway(config, recipes);
    let warnings: Vec<_> = config
        .view()
        .warnings()
        .map(|warning| format!("  {}\n", config.view().describe_warning(warning)))
        .collect();
    if !warnings.is_empty() {
        report += &format!("\nwarnings\n{}", warnings.concat());
    }
    report
}

/// The report on a controller file.
fn controller(config: &SimConfig) -> String {
    let listen = &config.listen;
    let any = |port: u16| if port == 0 { "any".to_owned() } else { port.to_string() };
    let mut report = format!(
        "listens on {} ({}): command {}, state {}, Modbus {}, UDP server {}\n",
        listen.address,
        config.robot.dialect,
        any(listen.command),
        any(listen.state),
        any(listen.modbus),
        any(listen.udp2011)
    );
    for port in &config.ports {
        report += &format!("\nport {}: {}\n", port.name, show_sim_bus(&port.bus, listen.udp2011));
        let Some(recipe) = port.recipe.and_then(|index| config.recipes.get(index)) else {
            report += "  no recipe: idle\n";
            continue;
        };
        for part in [Direction::Input, Direction::Output] {
            if let Some(budget) = sim_budget(port, recipe, part) {
                report += &show_budget(part, budget, port.cycle);
                if part == Direction::Output && recipe.mode == Mode::Realtime && budget.time > port.cycle {
                    report += &format!(
                        "  warning: does not fit the cycle of {}; the shortest possible is {}\n",
                        port.cycle, budget.time
                    );
                }
            }
        }
        report += &show_pendant(recipe);
    }
    if !config.programs.is_empty() {
        let names: Vec<_> = config.programs.iter().map(|program| program.name.as_str()).collect();
        report += &format!("\nprograms: {}\n", names.join(", "));
    }
    report += &show_functions(&config.functions);
    report
}

/// What functional inputs do and functional outputs show.
fn show_functions(functions: &Functions) -> String {
    let mut report = String::new();
    for input in &functions.inputs {
        let name = Function::ALL.iter().find(|known| known.1 == input.function).map_or("", |known| known.0);
        let program = functions.start.as_deref().filter(|_| input.function == Function::Start);
        report += &format!("  {} -> {name}", input.item);
        report += &program.map_or_else(|| "\n".to_owned(), |program| format!(" {program}\n"));
    }
    for output in &functions.outputs {
        let name = ShownState::ALL.iter().find(|known| known.1 == output.state).map_or("", |known| known.0);
        report += &format!("  {name} -> {}\n", output.item);
    }
    if report.is_empty() { report } else { format!("\nfunctions\n{report}") }
}

/// What to set on the controller's pendant for the gateway's recipe links.
fn pendant_of_gateway(config: &GatewayConfig, recipes: &[AnyRecipe]) -> String {
    let mut report = String::new();
    let mut add = |what: String, recipe: u8| {
        // The check of the file let no device's recipe come here.
        if let Some(recipe) = recipes.get(usize::from(recipe)).and_then(AnyRecipe::plain) {
            report += &format!("  {what}: recipe {}\n{}", recipe.name, show_pendant(recipe));
        }
    };
    if let Some(link) = config.controller.recipe_link {
        add(format!("UDP server {}", link.udp_port), link.recipe);
    }
    for port in &config.ports {
        match &port.bus {
            Bus::TcpListen { listen } => add(format!("TCP client to this gateway, {listen}"), port.recipe),
            Bus::UdpListen { listen } => add(format!("UDP client to this gateway, {listen}"), port.recipe),
            Bus::Rs485(_) | Bus::Can { .. } => {}
        }
    }
    if report.is_empty() {
        "\non the pendant: nothing; Modbus and the state stream are always there\n".into()
    } else {
        format!("\non the pendant\n{report}")
    }
}

fn show_line(line: &Rs485) -> String {
    let parity = match line.parity {
        Parity::None => 'N',
        Parity::Even => 'E',
        Parity::Odd => 'O',
    };
    let echo = if line.echo { ", with echo" } else { "" };
    format!("rs485, {} baud 8{parity}{}{echo}", line.baud, line.stop_bits)
}

fn show_can_bus(bitrate: u32) -> String {
    format!("can, {bitrate} bit/s")
}

fn show_sim_bus(bus: &SimBus, udp2011: u16) -> String {
    match bus {
        SimBus::Rs485(line) => show_line(line),
        SimBus::Can { bitrate } => show_can_bus(*bitrate),
        SimBus::UdpServer => format!("UDP server {udp2011}"),
        SimBus::TcpClient { to } => format!("TCP client to {to}"),
        SimBus::UdpClient { to } => format!("UDP client to {to}"),
    }
}

/// One line: size and time of a part, how often it can be sent, and its share of the cycle.
fn show_budget(part: Direction, budget: PartBudget, cycle: Duration) -> String {
    let name = match part {
        Direction::Input => "input ",
        Direction::Output => "output",
    };
    let frames = if budget.frames == 1 { String::new() } else { format!(" in {} frames", budget.frames) };
    let size = format!("{} byte{}{frames}", budget.bytes, if budget.bytes == 1 { "" } else { "s" });
    let micros = budget.time.as_micros();
    if micros == 0 {
        return format!("  {name}  {size}\n");
    }
    let rest = match part {
        Direction::Input => format!("at most {} a second", 1_000_000 / micros),
        Direction::Output => format!("{} % of a cycle of {cycle}", micros * 100 / cycle.as_micros().max(1)),
    };
    format!("  {name}  {size}, {}.{:03} ms on the line, {rest}\n", micros / 1000, micros % 1000)
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
fn show_pendant(recipe: &SimRecipe) -> String {
    let kind = match recipe.mode {
        Mode::Realtime => "system data",
        Mode::User => "user-defined",
    };
    let mut report = format!("    {kind}\n");
    match &recipe.parts {
        SimParts::Stream { input, output } => {
            for (name, part) in [("input ", input), ("output", output)] {
                let Some(SimStreamPart { head, tail, fields }) = part else { continue };
                report += &format!(
                    "    {name}  head {}, tail {}\n            {}\n",
                    decimal(head),
                    decimal(tail),
                    show_fields(fields)
                );
            }
        }
        SimParts::Can { input, output } => {
            for (name, frames) in [("input ", input), ("output", output)] {
                for frame in frames {
                    let id = match frame.id {
                        CanId::Standard(id) => u32::from(id),
                        CanId::Extended(id) => id,
                    };
                    let hex = text::show_id(frame.id);
                    report += &format!("    {name}  id {id} ({hex}): {}\n", show_fields(&frame.fields));
                }
            }
        }
    }
    report
}

fn decimal(bytes: &[u8]) -> String {
    if bytes.is_empty() {
        return "none".into();
    }
    bytes.iter().map(u8::to_string).collect::<Vec<_>>().join(" ")
}

fn show_fields(fields: &[SimField]) -> String {
    let show = |field: &SimField| match SysVar::parse(&field.name) {
        Ok(var) if matches!(field.field, proto_core::recipe::model::Field::System(_)) => {
            format!("__{}_{}", var.group(), var.index())
        }
        _ => format!("{} ({})", field.name, field.field.ty()),
    };
    fields.iter().map(show).collect::<Vec<_>>().join(", ")
}
