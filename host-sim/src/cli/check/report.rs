//! What `check` finds, as data: the text and the JSON are both made of it.
//!
//! In: nothing; others fill it. Out: text, and serde's data model. Its shape is in docs/checking.md.

use proto_core::config::{Echo, Parity, PartBudget, Rs485};
use proto_core::sysvar::Direction;
use proto_core::time::Duration;
use recipe_config::file::{FileError, Source};
use serde::Serialize;

use super::super::exchange_report::ExchangeReport;
use super::super::frame::Picture;
use super::super::plan::{self, VarRoute};
use super::super::values::{self, Picks, Times};
use super::bus::{self, Load};

/// The report on a file that is right.
#[derive(Debug, Serialize)]
pub(super) struct CheckReport {
    pub(super) ok: bool,
    pub(super) file: String,
    /// `gateway` or `controller`.
    pub(super) kind: &'static str,
    /// The servers: of the controller that a gateway talks to, or its own.
    pub(super) controller: Servers,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(super) network: Option<Network>,
    pub(super) ports: Vec<PortReport>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(super) ways: Option<Vec<VarRoute>>,
    pub(super) buses: Vec<Load>,
    /// What to set on the pendant, of a gateway's links.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(super) pendant: Option<Vec<PendantLink>>,
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub(super) programs: Vec<String>,
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub(super) functions: Vec<FunctionReport>,
    pub(super) warnings: Vec<MessageReport>,
    /// What means something else than in the version that was asked about.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(super) changes: Option<Vec<MessageReport>>,
}

/// Addresses and ports of the controller. Port 0 is any free one.
#[derive(Debug, Serialize)]
pub(super) struct Servers {
    pub(super) address: String,
    pub(super) dialect: String,
    pub(super) command: u16,
    pub(super) state: u16,
    pub(super) modbus: u16,
    /// Of a gateway file, only with a recipe link.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(super) udp: Option<u16>,
}

/// A board's own address.
#[derive(Debug, Serialize)]
pub(super) struct Network {
    pub(super) address: String,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(super) router: Option<String>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(super) dns: Option<String>,
}

/// A port of either kind of file.
#[derive(Debug, Serialize)]
pub(super) struct PortReport {
    pub(super) name: String,
    #[serde(flatten)]
    pub(super) bus: Bus,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(super) recipe: Option<String>,
    #[serde(serialize_with = "millis")]
    pub(super) cycle_ms: Duration,
    pub(super) parts: Vec<PartReport>,
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub(super) exchanges: Vec<ExchangeReport>,
    /// What all exchanges with a period take of the line.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(super) exchanges_percent: Option<u32>,
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub(super) commands: Vec<Picks>,
    #[serde(flatten)]
    pub(super) times: Times,
    pub(super) safe_at_start: bool,
    #[serde(skip_serializing_if = "Option::is_none", serialize_with = "millis_if_any")]
    pub(super) refresh_ms: Option<Duration>,
    /// The recipe as the pendant of a simulated controller shows it.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(super) pendant: Option<PendantRecipe>,
}

/// What a port is.
#[derive(Debug, Serialize)]
#[serde(tag = "bus", rename_all = "kebab-case")]
pub(super) enum Bus {
    Rs485 {
        baud: u32,
        parity: &'static str,
        stop_bits: u8,
        #[serde(serialize_with = "echo_setting")]
        echo: Echo,
    },
    Can {
        bitrate: u32,
    },
    ModbusTcp {
        host: String,
        tcp_port: u16,
    },
    TcpListen {
        address: String,
    },
    UdpListen {
        address: String,
    },
    UdpServer {
        udp_port: u16,
    },
    TcpClient {
        address: String,
    },
    UdpClient {
        address: String,
    },
}

/// A part of a port's recipe.
#[derive(Debug, Serialize)]
pub(super) struct PartReport {
    /// `input` or `output`.
    pub(super) part: &'static str,
    pub(super) frames: usize,
    /// Of the longest frame, with its head, tail and all escape bytes that it may need.
    pub(super) bytes: usize,
    /// Of the shortest, if the length of its frames varies.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(super) least_bytes: Option<usize>,
    /// On the line, of the longest; 0 where there is none.
    pub(super) time_us: u64,
    /// How often an input part can come at most, the longest frame if its length varies.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(super) most_per_second: Option<u64>,
    /// What an output part takes of its cycle.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(super) cycle_percent: Option<u64>,
    /// Its bytes, of a user recipe in a gateway file.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(super) picture: Option<Picture>,
    #[serde(skip)]
    pub(super) cycle: Duration,
    /// It does not fit its cycle; of a controller's port.
    #[serde(skip)]
    pub(super) shortest: Option<Duration>,
}

/// A recipe that has to be set on the pendant, and where.
#[derive(Debug, Serialize)]
pub(super) struct PendantLink {
    /// Which of the controller's ports.
    pub(super) port: String,
    pub(super) recipe: String,
    #[serde(flatten)]
    pub(super) content: PendantRecipe,
}

/// A recipe as the pendant shows it.
#[derive(Debug, Serialize)]
pub(super) struct PendantRecipe {
    /// `system data` or `user-defined`.
    pub(super) data: &'static str,
    pub(super) parts: Vec<PendantPart>,
}

/// A stream part, or a frame of a CAN part.
#[derive(Debug, Serialize)]
pub(super) struct PendantPart {
    pub(super) part: &'static str,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(super) id: Option<u32>,
    /// The id once more, as candump has it.
    #[serde(skip_serializing_if = "String::is_empty")]
    pub(super) hex_id: String,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(super) head: Option<Vec<u8>>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(super) tail: Option<Vec<u8>>,
    pub(super) fields: Vec<String>,
}

/// A functional input or output of a controller.
#[derive(Debug, Serialize)]
pub(super) struct FunctionReport {
    /// The input or output.
    pub(super) item: String,
    /// What it triggers, or shows.
    pub(super) function: &'static str,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(super) program: Option<String>,
    pub(super) is_input: bool,
}

/// A mistake or a warning, with its place.
#[derive(Debug, Serialize)]
pub(super) struct MessageReport {
    #[serde(skip_serializing_if = "Option::is_none")]
    file: Option<String>,
    #[serde(skip_serializing_if = "Option::is_none")]
    line: Option<usize>,
    #[serde(skip_serializing_if = "Option::is_none")]
    column: Option<usize>,
    /// The override that it is in, instead of file, line and column.
    #[serde(skip_serializing_if = "Option::is_none")]
    set: Option<String>,
    key: String,
    pub(super) message: String,
}

impl From<FileError> for MessageReport {
    fn from(error: FileError) -> Self {
        let FileError { source, key, message } = error;
        let (file, place, set) = match source {
            Source::File { file, line, column } => (Some(file), Some((line, column)), None),
            Source::WholeFile { file } => (Some(file), None, None),
            Source::Override { text } => (None, None, Some(text)),
        };
        let (line, column) = place.unzip();
        Self { file, line, column, set, key, message }
    }
}

/// What is printed of a file that is wrong.
#[derive(Debug, Serialize)]
pub(super) struct Refusal {
    pub(super) ok: bool,
    pub(super) errors: Vec<MessageReport>,
}

impl Refusal {
    pub(super) fn new(error: FileError) -> Self {
        Self { ok: false, errors: vec![error.into()] }
    }
}

/// As the file has it: `true`, `false` or `"auto"`.
fn echo_setting<S: serde::Serializer>(echo: &Echo, to: S) -> Result<S::Ok, S::Error> {
    match echo {
        Echo::No => to.serialize_bool(false),
        Echo::Yes => to.serialize_bool(true),
        Echo::Auto => to.serialize_str("auto"),
    }
}

fn millis<S: serde::Serializer>(time: &Duration, to: S) -> Result<S::Ok, S::Error> {
    to.serialize_f64(time.as_micros() as f64 / 1e3)
}

fn millis_if_any<S: serde::Serializer>(time: &Option<Duration>, to: S) -> Result<S::Ok, S::Error> {
    time.map(|time| time.as_micros() as f64 / 1e3).serialize(to)
}

impl Bus {
    pub(super) fn of_line(line: &Rs485) -> Self {
        let parity = match line.parity {
            Parity::None => "none",
            Parity::Even => "even",
            Parity::Odd => "odd",
        };
        Self::Rs485 { baud: line.baud, parity, stop_bits: line.stop_bits, echo: line.echo }
    }

    fn show(&self) -> String {
        match self {
            Self::Rs485 { baud, parity, stop_bits, echo } => {
                let parity = parity.chars().next().unwrap_or(' ').to_ascii_uppercase();
                let echo = if *echo == Echo::Yes { ", with echo" } else { "" };
                format!("rs485, {baud} baud 8{parity}{stop_bits}{echo}")
            }
            Self::Can { bitrate } => format!("can, {bitrate} bit/s"),
            Self::ModbusTcp { host, tcp_port } => format!("modbus-tcp, {host} port {tcp_port}"),
            Self::TcpListen { address } => format!("the controller's TCP client connects to {address}"),
            Self::UdpListen { address } => format!("the controller's UDP client sends to {address}"),
            Self::UdpServer { udp_port } => format!("UDP server {udp_port}"),
            Self::TcpClient { address } => format!("TCP client to {address}"),
            Self::UdpClient { address } => format!("UDP client to {address}"),
        }
    }
}

impl PartReport {
    pub(super) fn new(part: Direction, budget: PartBudget, cycle: Duration) -> Self {
        let micros = budget.time.as_micros();
        let is_input = part == Direction::Input;
        Self {
            part: name_of(part),
            frames: budget.frames,
            bytes: budget.bytes,
            least_bytes: None,
            time_us: micros,
            most_per_second: (is_input && micros > 0).then(|| 1_000_000 / micros),
            cycle_percent: (!is_input && micros > 0).then(|| micros * 100 / cycle.as_micros().max(1)),
            picture: None,
            cycle,
            shortest: None,
        }
    }

    /// One line: size and time of a part, how often it can be sent, and its share of the cycle; then its bytes.
    fn show(&self) -> String {
        let frames = if self.frames == 1 { String::new() } else { format!(" in {} frames", self.frames) };
        let least = self.least_bytes.map_or_else(String::new, |least| format!("{least} to "));
        let size = format!("{least}{} byte{}{frames}", self.bytes, if self.bytes == 1 { "" } else { "s" });
        let (longest, such) = if least.is_empty() { ("", "") } else { (" the longest", " of these") };
        let rest = match (self.most_per_second, self.cycle_percent) {
            (Some(most), _) => format!("at most {most}{such} a second"),
            (_, Some(percent)) => format!("{percent} % of a cycle of {}", self.cycle),
            _ => String::new(),
        };
        let mut report = format!("  {:6}  {size}", self.part);
        if self.time_us > 0 {
            let (millis, micros) = (self.time_us / 1000, self.time_us % 1000);
            report += &format!(",{longest} {millis}.{micros:03} ms on the line, {rest}");
        }
        report.push('\n');
        report += &self.picture.as_ref().map_or_else(String::new, Picture::show);
        report
    }
}

/// As files have it.
pub(super) fn name_of(part: Direction) -> &'static str {
    match part {
        Direction::Input => "input",
        Direction::Output => "output",
    }
}

impl PortReport {
    fn show(&self, is_gateway: bool) -> String {
        let recipe = match &self.recipe {
            Some(recipe) if is_gateway => format!(", recipe {recipe}"),
            _ => String::new(),
        };
        let mut report = format!("\nport {}: {}{recipe}\n", self.name, self.bus.show());
        if self.recipe.is_none() {
            report += "  no recipe: idle\n";
        }
        report.extend(self.parts.iter().map(PartReport::show));
        report.extend(self.exchanges.iter().map(ExchangeReport::show));
        if let Some(percent) = self.exchanges_percent {
            let what = if matches!(self.bus, Bus::Can { .. }) { "bus" } else { "line" };
            report += &format!("  all of them with a period take {percent} % of the {what}\n");
        }
        report += &values::show_commands(&self.commands);
        report += &self.times.show();
        if self.safe_at_start {
            report += "  safe values from the start until the device speaks\n";
        }
        if let Some(refresh) = self.refresh_ms {
            report += &format!("  output sent on change, and after {refresh} without one\n");
        }
        report += &self.pendant.as_ref().map_or_else(String::new, PendantRecipe::show);
        report
    }
}

impl PendantRecipe {
    /// Decimal bytes, as the pendant has them.
    fn show(&self) -> String {
        let mut report = format!("    {}\n", self.data);
        for part in &self.parts {
            let fields = part.fields.join(", ");
            report += &match (part.id, &part.head, &part.tail) {
                (Some(id), ..) => format!("    {:6}  id {id} ({}): {fields}\n", part.part, part.hex_id),
                (None, head, tail) => format!(
                    "    {:6}  head {}, tail {}\n            {fields}\n",
                    part.part,
                    decimal(head.as_deref().unwrap_or_default()),
                    decimal(tail.as_deref().unwrap_or_default())
                ),
            };
        }
        report
    }
}

fn decimal(bytes: &[u8]) -> String {
    if bytes.is_empty() {
        return "none".into();
    }
    bytes.iter().map(u8::to_string).collect::<Vec<_>>().join(" ")
}

impl CheckReport {
    /// As text.
    pub(super) fn show(&self) -> String {
        let is_gateway = self.kind == "gateway";
        let mut report =
            format!("{}: a valid {} file\n\n{}", self.file, self.kind, self.controller.show(is_gateway));
        if let Some(Network { address, router, dns }) = &self.network {
            let others = [("router", router), ("name server", dns)];
            let others = others.iter().filter_map(|(what, at)| Some(format!(", {what} {}", at.as_ref()?)));
            report += &format!(
                "a board's address is {address}{}; a host has its own\n",
                others.collect::<String>()
            );
        }
        report.extend(self.ports.iter().map(|port| port.show(is_gateway)));
        report += &bus::show(&self.buses);
        report += &self.ways.as_ref().map_or_else(String::new, |ways| plan::show(ways));
        report += &self.pendant.as_ref().map_or_else(String::new, |links| show_links(links));
        if !self.programs.is_empty() {
            report += &format!("\nprograms: {}\n", self.programs.join(", "));
        }
        report += &show_functions(&self.functions);
        if !self.warnings.is_empty() {
            report += "\nwarnings\n";
            report.extend(self.warnings.iter().map(|warning| format!("  {}\n", warning.message)));
        }
        if let Some(changes) = &self.changes {
            report += "\nchanged since 0.2\n";
            report.extend(changes.iter().map(|change| format!("  {}\n", change.message)));
            if changes.is_empty() {
                report += "  nothing in this file\n";
            }
        }
        report
    }
}

impl Servers {
    fn show(&self, is_gateway: bool) -> String {
        let Self { address, dialect, command, state, modbus, udp } = self;
        if is_gateway {
            return format!(
                "controller {address} ({dialect}): command {command}, state {state}, Modbus {modbus}\n"
            );
        }
        let any = |port: u16| if port == 0 { "any".to_owned() } else { port.to_string() };
        format!(
            "listens on {address} ({dialect}): command {}, state {}, Modbus {}, UDP server {}\n",
            any(*command),
            any(*state),
            any(*modbus),
            any(udp.unwrap_or(0))
        )
    }
}

/// What to set on the controller's pendant for the gateway's recipe links.
fn show_links(links: &[PendantLink]) -> String {
    if links.is_empty() {
        return "\non the pendant: nothing; Modbus and the state stream are always there\n".into();
    }
    let show =
        |link: &PendantLink| format!("  {}: recipe {}\n{}", link.port, link.recipe, link.content.show());
    format!("\non the pendant\n{}", links.iter().map(show).collect::<String>())
}

/// What functional inputs do and functional outputs show.
fn show_functions(functions: &[FunctionReport]) -> String {
    let show = |FunctionReport { item, function, program, is_input }: &FunctionReport| match is_input {
        true => {
            let program = program.as_ref().map_or(String::new(), |program| format!(" {program}"));
            format!("  {item} -> {function}{program}\n")
        }
        false => format!("  {function} -> {item}\n"),
    };
    if functions.is_empty() {
        return String::new();
    }
    format!("\nfunctions\n{}", functions.iter().map(show).collect::<String>())
}
