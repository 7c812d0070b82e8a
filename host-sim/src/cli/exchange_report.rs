//! The exchanges of a recipe as `check` draws them: what is asked when, its bytes, and its time.

use proto_core::config::{self, Exchange, GatewayConfig, Port, Triggers, register_bits};
use proto_core::device::Carrier;
use proto_core::engine::{Plan, Source};
use proto_core::modbus::rtu::{BROADCAST, Operation, Table};
use proto_core::sysvar::Direction;
use proto_core::time::Duration;
use recipe_config::{DeviceRecipe, ExchangeKind, NamedExchange, function_name};
use serde::Serialize;

use super::frame::{self, FrameRow};
use super::text;

/// One exchange, or one block of a slave.
#[derive(Debug, Serialize)]
pub(super) struct ExchangeReport {
    /// From 1.
    number: usize,
    /// `exchange` or `block`.
    kind: &'static str,
    /// Who is asked, and for what.
    what: String,
    /// When it is asked.
    when: String,
    frames: Vec<FrameReport>,
    /// On the line, with silences and pause.
    takes_us: u64,
    #[serde(skip_serializing_if = "Option::is_none")]
    without_reply_us: Option<u64>,
    /// How long behind a request without a reply these exchanges wait, by their numbers.
    #[serde(skip_serializing_if = "Option::is_none")]
    late_ms: Option<f64>,
    #[serde(skip_serializing_if = "Vec::is_empty")]
    held_back: Vec<usize>,
    /// The shortest pulse of its bit that is seen for sure.
    #[serde(skip_serializing_if = "Option::is_none")]
    pulse_ms: Option<f64>,
    /// Bits of a register that it writes as 0, because they have no field.
    #[serde(skip_serializing_if = "Option::is_none")]
    zeroed_bits: Option<String>,
    /// It is an event on CAN: Linux' own driver cannot take a frame back that waits in the adapter.
    #[serde(skip_serializing_if = "std::ops::Not::not")]
    may_leave_late: bool,
    /// Of the line, if it has a period.
    #[serde(skip_serializing_if = "Option::is_none")]
    percent: Option<u64>,
}

#[derive(Debug, Serialize)]
struct FrameReport {
    /// `request`, `reply`, `pending` or `refusal`.
    frame: &'static str,
    #[serde(skip_serializing_if = "Option::is_none")]
    id: Option<String>,
    #[serde(skip_serializing_if = "Option::is_none")]
    bytes: Option<usize>,
    remote: bool,
    rows: Vec<FrameRow>,
}

/// All exchanges of a port's recipe.
pub(super) fn all(config: &GatewayConfig, port: &Port, recipe: &DeviceRecipe) -> Vec<ExchangeReport> {
    let exchanges =
        config.recipes.get(usize::from(port.recipe)).map(|recipe| config.view().exchanges_of(recipe));
    let pairs = exchanges.unwrap_or(&[]).iter().zip(&recipe.exchanges);
    (1..)
        .zip(pairs)
        .map(|(number, (exchange, named))| ExchangeReport::new(config, port, number, exchange, named))
        .collect()
}

impl ExchangeReport {
    fn new(
        config: &GatewayConfig,
        port: &Port,
        number: usize,
        exchange: &Exchange,
        named: &NamedExchange,
    ) -> Self {
        let kind = match named.kind {
            ExchangeKind::Slave(_) => "block",
            _ => "exchange",
        };
        let is_tcp = port.bus.is_modbus_tcp();
        let budget = config.view().exchange_budget(port, exchange);
        // A slave receives requests and sends replies.
        let (asks, answers) = match named.kind {
            ExchangeKind::Slave(_) => (Direction::Input, Direction::Output),
            _ => (Direction::Output, Direction::Input),
        };
        let mut frames = Vec::new();
        for (name, frame, part, len) in [
            ("request", &named.request, asks, Some(budget.request)),
            ("reply", &named.reply, answers, Some(budget.reply)),
            ("pending", &named.pending, answers, None),
            // Of Modbus it is always the same.
            ("refusal", &named.refusal, answers, None),
        ] {
            let is_shown = name != "refusal" || named.kind == ExchangeKind::Frames;
            let Some(frame) = frame.as_ref().filter(|_| is_shown) else { continue };
            let remote = named.remote && name == "request";
            let carrier = if frame.id.is_some() { Carrier::Can } else { Carrier::Stream };
            let rows = frame::rows(frame, carrier, part);
            frames.push(FrameReport {
                frame: name,
                id: frame.id.map(text::show_id),
                bytes: len.filter(|_| !remote),
                remote,
                rows: if is_tcp { frame::over_tcp(rows) } else { rows },
            });
        }
        let recipe = config.recipes.get(usize::from(port.recipe));
        // A transaction id tells all replies apart.
        let recipe = recipe.filter(|_| !is_tcp);
        let held = recipe.map_or(0, |recipe| config.view().held_back_by(recipe, exchange));
        let held_back: Vec<usize> = (1..=64).filter(|nth| held >> (nth - 1) & 1 == 1).collect();
        let millis = |time: Duration| time.as_micros() as f64 / 1e3;
        let takes_us = budget.time.as_micros();
        let longest = budget.time_without_reply.as_micros();
        Self {
            number,
            kind,
            what: subject(named),
            when: times(exchange, named),
            frames,
            takes_us,
            without_reply_us: (longest > takes_us).then_some(longest),
            late_ms: (!held_back.is_empty()).then(|| millis(exchange.late())),
            held_back,
            pulse_ms: shortest_pulse(config, port, exchange).map(millis),
            zeroed_bits: zeroed_bits(config, exchange).map(|bits| format!("{bits:#06X}")),
            may_leave_late: exchange.when.rising.is_some() && port.bus.is_can(),
            percent: exchange
                .when
                .every
                .filter(|_| !is_tcp)
                .map(|every| (takes_us * 100).div_ceil(every.as_micros().max(1))),
        }
    }

    /// As text.
    pub(super) fn show(&self) -> String {
        let when = if self.when.is_empty() { String::new() } else { format!(", {}", self.when) };
        let mut report = format!("  {} {}: {}{when}\n", self.kind, self.number, self.what);
        report.extend(self.frames.iter().map(FrameReport::show));
        let lost = self.without_reply_us.map(|longest| format!(", {} without a reply", show_time(longest)));
        let own = self.percent.map(|percent| format!(", {percent} % of the time"));
        // A network takes what it takes.
        let takes = if self.takes_us > 0 { show_time(self.takes_us) } else { "no time of a line".to_owned() };
        report += &format!("    takes {}{}{}\n", takes, lost.unwrap_or_default(), own.unwrap_or_default());
        if let Some(late) = self.late_ms.filter(|late| *late > 0.0) {
            let numbers: Vec<_> = self.held_back.iter().map(usize::to_string).collect();
            let others = if numbers.len() == 1 { "exchange" } else { "exchanges" };
            report += &format!(
                "    a reply that does not come holds {others} {} back for {late} ms\n",
                numbers.join(", ")
            );
        }
        if let Some(pulse) = self.pulse_ms {
            report += &format!("    a pulse of {pulse} ms or more is seen for sure\n");
        }
        if let Some(bits) = &self.zeroed_bits {
            report +=
                &format!("    bits {bits} are written as 0; mask-write-register leaves them as they are\n");
        }
        if self.may_leave_late {
            report += "    with socketcan:, a frame that waits in the adapter leaves late\n";
        }
        report
    }
}

impl FrameReport {
    fn show(&self) -> String {
        let id = self.id.as_ref().map_or(String::new(), |id| format!(", id {id}"));
        let size = match self.bytes {
            _ if self.remote => ", remote".to_owned(),
            Some(1) => ", 1 byte".to_owned(),
            Some(len) => format!(", {len} bytes"),
            None => String::new(),
        };
        format!("   {}{id}{size}\n{}", self.frame, frame::show_rows(&self.rows))
    }
}

/// Who is asked, and for what.
fn subject(named: &NamedExchange) -> String {
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
                Operation::MaskWriteRegister { address, mask } => {
                    format!("{slave}, {function}, bits {mask:#06X} at {address:#06X}")
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

fn times(exchange: &Exchange, named: &NamedExchange) -> String {
    let Triggers { every, start, change, rising } = exchange.when;
    let mut times = Vec::new();
    times.extend(every.map(|every| format!("every {every}")));
    times.extend(start.then(|| "at the start".to_owned()));
    times.extend(change.then(|| "on change".to_owned()));
    times.extend(rising.map(|(var, bit)| format!("when {var}.{bit} rises")));
    match named.kind {
        ExchangeKind::Slave(_) => String::new(),
        _ if times.is_empty() => "comes unasked".to_owned(),
        _ => times.join(", "),
    }
}

/// The bits of one register that have no field, if others have.
fn zeroed_bits(config: &GatewayConfig, exchange: &Exchange) -> Option<u16> {
    let config::Transaction::Rtu { operation, written, .. } = exchange.transaction else { return None };
    let is_one =
        matches!(operation, Operation::WriteRegister { .. } | Operation::WriteRegisters { count: 1, .. });
    let bits = !register_bits(written.of(&config.fields));
    (is_one && !matches!(bits, 0 | u16::MAX)).then_some(bits)
}

/// The shortest pulse of the bit of an exchange that is read as 1, whenever it comes: two readings, of which one may be
/// a little late. Not of a bit that another device sends.
fn shortest_pulse(config: &GatewayConfig, port: &Port, exchange: &Exchange) -> Option<Duration> {
    let (var, _) = exchange.when.rising?;
    let reading = match Plan::new(config).ok()?.source(var)? {
        Source::Modbus => port.cycle,
        Source::Recipe(_) => Duration::from_millis(4),
        Source::State => Duration::from_millis(100),
        Source::Field(_) => return None,
    };
    Some(reading.saturating_mul(2))
}

fn show_time(micros: u64) -> String {
    format!("{}.{:03} ms", micros / 1000, micros % 1000)
}
