//! The exchanges of a recipe as `check` draws them: what is asked when, its bytes, and its time.

use proto_core::config::{AskWhen, Bus, Exchange, GatewayConfig, Port};
use proto_core::modbus::rtu::{BROADCAST, Operation, Table};
use proto_core::sysvar::Direction;
use recipe_config::{DeviceRecipe, ExchangeKind, NamedExchange, NamedFrame, function_name};

use super::{frame, text};

/// All exchanges of a port's recipe, and how much of the line they take together.
pub(super) fn show(config: &GatewayConfig, port: &Port, recipe: &DeviceRecipe) -> String {
    let exchanges =
        config.recipes.get(usize::from(port.recipe)).map(|recipe| config.view().exchanges_of(recipe));
    let mut report = String::new();
    for (nth, (exchange, named)) in (1..).zip(exchanges.unwrap_or(&[]).iter().zip(&recipe.exchanges)) {
        report += &show_one(config, port, nth, exchange, named);
    }
    if let Some(percent) = config.view().line_share(port) {
        let what = if matches!(port.bus, Bus::Can { .. }) { "bus" } else { "line" };
        report += &format!("  all of them with a period take {percent} % of the {what}\n");
    }
    report
}

fn show_one(
    config: &GatewayConfig,
    port: &Port,
    nth: usize,
    exchange: &Exchange,
    named: &NamedExchange,
) -> String {
    let what = match named.kind {
        ExchangeKind::Slave(_) => "block",
        _ => "exchange",
    };
    let mut report = format!("  {what} {nth}: {}{}\n", show_subject(named), show_when(exchange, named));
    let budget = config.view().exchange_budget(port, exchange);
    // A slave receives requests and sends replies.
    let (asks, answers) = match named.kind {
        ExchangeKind::Slave(_) => (Direction::Input, Direction::Output),
        _ => (Direction::Output, Direction::Input),
    };
    for (name, frame, part, len) in [
        ("request", &named.request, asks, Some(budget.request)),
        ("reply", &named.reply, answers, Some(budget.reply)),
        // Of Modbus it is always the same.
        ("refusal", &named.refusal, Direction::Input, None),
    ] {
        let Some(frame) = frame.as_ref().filter(|_| name != "refusal" || named.kind == ExchangeKind::Frames)
        else {
            continue;
        };
        let is_remote = named.remote && name == "request";
        report += &show_frame(name, frame, part, len, is_remote);
    }
    let micros = budget.time.as_micros();
    let own = exchange
        .when
        .every
        .map(|every| format!(", {} % of the time", (micros * 100).div_ceil(every.as_micros().max(1))));
    let lost = match budget.time_without_reply.as_micros() {
        longest if longest > micros => format!(", {} without a reply", show_time(longest)),
        _ => String::new(),
    };
    report += &format!("    takes {}{lost}{}\n", show_time(micros), own.unwrap_or_default());
    report
}

fn show_frame(
    name: &str,
    frame: &NamedFrame,
    part: Direction,
    len: Option<usize>,
    is_remote: bool,
) -> String {
    let id = frame.id.map_or(String::new(), |id| format!(", id {}", text::show_id(id)));
    let size = match len {
        _ if is_remote => ", remote".to_owned(),
        Some(1) => ", 1 byte".to_owned(),
        Some(len) => format!(", {len} bytes"),
        None => String::new(),
    };
    format!("   {name}{id}{size}\n{}", frame::show_bytes(frame, part))
}

/// Who is asked, and for what.
fn show_subject(named: &NamedExchange) -> String {
    let peer = named.peer;
    match &named.kind {
        ExchangeKind::Frames if peer == 0 => "own frames".to_owned(),
        ExchangeKind::Frames => format!("own frames, peer {peer}"),
        ExchangeKind::Master(operation) => {
            let slave = if peer == BROADCAST { "all slaves".to_owned() } else { format!("slave {peer}") };
            let function = format!("{} ({})", function_name(operation), operation.function());
            match *operation {
                Operation::ReadWriteRegisters { read_count, read_address, write_count, write_address } => {
                    format!(
                        "{slave}, {function}, {read_count} from {read_address:#06X}, {write_count} to {write_address:#06X}"
                    )
                }
                _ => {
                    let (_, address, count) = operation.place();
                    format!("{slave}, {function}, {count} at {address:#06X}")
                }
            }
        }
        ExchangeKind::Slave(operation) => {
            let (table, address, count) = operation.place();
            let name = match table {
                Table::Coils => "coils",
                Table::DiscreteInputs => "discrete inputs",
                Table::HoldingRegisters => "holding registers",
                Table::InputRegisters => "input registers",
            };
            let who = if operation.reads() { "read" } else { "written" };
            let last = u32::from(address) + u32::from(count) - 1;
            match count {
                1 => format!("{name} {address:#06X}, {who} by the master"),
                _ => format!("{name} {address:#06X}..{last:#06X}, {who} by the master"),
            }
        }
    }
}

fn show_when(exchange: &Exchange, named: &NamedExchange) -> String {
    let AskWhen { every, start, change, rising } = exchange.when;
    let mut times = Vec::new();
    times.extend(every.map(|every| format!("every {every}")));
    times.extend(start.then(|| "at the start".to_owned()));
    times.extend(change.then(|| "on change".to_owned()));
    times.extend(rising.map(|(var, bit)| format!("when {var}.{bit} rises")));
    match named.kind {
        ExchangeKind::Slave(_) => String::new(),
        _ if times.is_empty() => ", comes unasked".to_owned(),
        _ => format!(", {}", times.join(", ")),
    }
}

fn show_time(micros: u64) -> String {
    format!("{}.{:03} ms", micros / 1000, micros % 1000)
}
