//! What a gateway publishes: a [`Catalog`] of its configuration, and samples of its [`Status`].
//!
//! In: a configuration, and a status for each sample. Out: metrics and values. The node has the health of the gateway,
//! its links, the states of the controller, and those variables of the controller that field ports send or the settings
//! name. Each field port is a device with the variables that it writes. The device is alive while the port works.

use core::ops::Range;

use heapless::{String, Vec};
use proto_core::config::{ConfigView, MAX_PORTS};
use proto_core::engine::{PortState, Status};
use proto_core::link::LinkState;
use proto_core::sysvar::{Direction, SysVar, VarRange};
use proto_core::time::Duration;
use proto_core::wire::scalar::{Scalar, ScalarType};

use crate::catalog::{Catalog, MAX_NAME, Metric, Owner, Report};
use crate::node::NodeCounters;
use crate::topic::MAX_ID;
use crate::value::{DataType, Value};

/// Stands for no rule.
const NO_RULE: u8 = u8::MAX;

/// Maximum number of links of a gateway.
const MAX_LINKS: usize = 16;

/// A value of the controller that is older than this is published as unknown.
pub const MAX_AGE: Duration = Duration::from_secs(5);

/// When changes are published, and which variables are published in addition.
#[derive(Debug, Clone, Copy)]
pub struct Rates<'c> {
    /// The shortest time between two values of a variable or a state.
    pub min_interval: Duration,
    /// The shortest time between two values of a counter or of the uptime, which always change.
    pub counter_interval: Duration,
    /// Rules for single variables. If several contain a variable, the last one counts.
    pub rules: &'c [PublishRule],
    /// Variables of the controller that are published although no port sends them.
    pub values: &'c [VarRange],
}

/// How some variables are published.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PublishRule {
    /// The variables.
    pub vars: VarRange,
    /// A number is published if it differs by more than this from the last published one.
    pub dead_band: f64,
    /// The shortest time between two values; `None`: as for all variables.
    pub min_interval: Option<Duration>,
}

/// The catalog of a gateway.
#[derive(Debug, Clone)]
pub struct GatewayCatalog<'c, const METRICS: usize> {
    rates: Rates<'c>,
    version: &'static str,
    ports: Vec<NodeDevice, MAX_PORTS>,
    links: Vec<DeviceName, MAX_LINKS>,
    items: Vec<MetricItem, METRICS>,
    /// Where the items of the node and of each port begin; the last entry is the end.
    starts: Vec<usize, { MAX_PORTS + 2 }>,
}

type DeviceName = String<MAX_ID>;

/// The source of a metric, and the number of its rule.
#[derive(Debug, Clone, Copy)]
struct MetricItem {
    item: MetricSource,
    /// [`NO_RULE`] if there is none.
    rule: u8,
}

#[derive(Debug, Clone)]
struct NodeDevice {
    /// Index of the port in the configuration.
    index: u8,
    /// Name of the port, as a part of a topic.
    device: DeviceName,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum MetricSource {
    Version,
    Uptime,
    Condition,
    Sleeps,
    Lost,
    Refused,
    /// Whether a port works, by its number among the devices.
    Alive(u8),
    /// The state of a link, by its number.
    Link(u8),
    Mode,
    Robot,
    Program,
    Safety,
    State,
    FramesIn,
    FramesOut,
    Rejected,
    Timeouts,
    Var(SysVar),
    Bit(SysVar, u8),
}

/// There are more metrics than there is room for.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct NoRoom;

impl<'c, const METRICS: usize> GatewayCatalog<'c, METRICS> {
    /// The catalog of a gateway that runs this configuration. `status` is from that gateway, at any time; `version` is
    /// the version of the program.
    ///
    /// # Errors
    /// If there are more metrics than there is room for.
    pub fn new(
        config: ConfigView<'_>,
        status: Status<'_>,
        rates: Rates<'c>,
        version: &'static str,
    ) -> Result<Self, NoRoom> {
        let mut catalog = Self {
            rates,
            version,
            ports: Vec::new(),
            links: Vec::new(),
            items: Vec::new(),
            starts: Vec::new(),
        };
        for (index, port, _) in config.field_ports() {
            catalog
                .ports
                .push(NodeDevice { index, device: part_of_topic(&port.name) })
                .map_err(|_| NoRoom)?;
        }
        catalog.begin_owner()?;
        for item in [
            MetricSource::Version,
            MetricSource::Uptime,
            MetricSource::Condition,
            MetricSource::Sleeps,
            MetricSource::Lost,
            MetricSource::Refused,
        ] {
            catalog.add(item)?;
        }
        for nth in (0..).take(catalog.ports.len()) {
            catalog.add(MetricSource::Alive(nth))?;
        }
        for (nth, link) in (0..).zip(status.links()) {
            catalog.links.push(part_of_topic(link.name)).map_err(|_| NoRoom)?;
            catalog.add(MetricSource::Link(nth))?;
        }
        for item in [MetricSource::Mode, MetricSource::Robot, MetricSource::Program, MetricSource::Safety] {
            catalog.add(item)?;
        }
        for var in SysVar::all().filter(|var| var.direction() == Direction::Output) {
            let is_sent = config.field_ports().any(|(_, _, recipe)| {
                let mut fields = config.fields_of(recipe, Direction::Output);
                fields.any(|(_, _, field)| field.variables().any(|used| used == var))
            });
            let is_asked = || rates.values.iter().any(|vars| vars.iter().any(|asked| asked == var));
            if is_sent || is_asked() {
                catalog.add(MetricSource::Var(var))?;
            }
        }
        for (_, port, recipe) in config.field_ports() {
            catalog.begin_owner()?;
            for item in [
                MetricSource::State,
                MetricSource::FramesIn,
                MetricSource::FramesOut,
                MetricSource::Rejected,
                MetricSource::Timeouts,
            ] {
                catalog.add(item)?;
            }
            for var in config.owned_by(port, recipe) {
                catalog.add_once(MetricSource::Var(var))?;
            }
            for bit in config.bits_written_by(recipe) {
                catalog.add_once(MetricSource::Bit(bit.var, bit.bit))?;
            }
        }
        catalog.begin_owner()?;
        Ok(catalog)
    }

    /// Writes all values of the gateway into `values`, by their places. Returns the ports that work: bit n is device n.
    /// `uptime` and `node` come from the program.
    pub fn sample(
        &self,
        status: Status<'_>,
        uptime: Duration,
        node: &NodeCounters,
        values: &mut [Option<Value>],
    ) -> u32 {
        self.sample_part(status, uptime, node, 0..self.items.len(), values);
        self.alive(status)
    }

    /// The ports that work: bit n is device n.
    pub fn alive(&self, status: Status<'_>) -> u32 {
        let mut alive = 0_u32;
        for port in status.ports().filter(|port| port.state == PortState::Working) {
            let nth = (0_u32..).zip(&self.ports).find(|(_, known)| known.index == port.id.0);
            alive |= nth.and_then(|(nth, _)| 1_u32.checked_shl(nth)).unwrap_or(0);
        }
        alive
    }

    /// As [`Self::sample`], for a range of places, so that a driver can run other tasks in between. `values` holds only
    /// the values of that range.
    pub fn sample_part(
        &self,
        status: Status<'_>,
        uptime: Duration,
        node: &NodeCounters,
        part: Range<usize>,
        values: &mut [Option<Value>],
    ) {
        let alive = self.alive(status);
        for (owner, places) in self.owners() {
            let port = match owner {
                Owner::Node => None,
                Owner::Device(nth) => self.ports.get(usize::from(nth)),
            };
            let places = places.start.max(part.start)..places.end.min(part.end);
            if places.is_empty() {
                continue;
            }
            let port = port.and_then(|port| status.ports().find(|status| status.id.0 == port.index));
            for place in places {
                let (Some(told), Some(value)) =
                    (self.items.get(place), values.get_mut(place.saturating_sub(part.start)))
                else {
                    break;
                };
                let item = told.item;
                *value = match item {
                    MetricSource::Version => Some(Value::Word(self.version)),
                    MetricSource::Uptime => Some(Value::UInt64(uptime.as_millis() / 1_000)),
                    MetricSource::Condition => Some(Value::Word(status.health().name())),
                    MetricSource::Sleeps => Some(Value::UInt32(status.sleeps())),
                    MetricSource::Lost => Some(Value::UInt64(node.lost)),
                    MetricSource::Refused => Some(Value::UInt32(node.refused)),
                    MetricSource::Alive(nth) => {
                        Some(Value::Boolean(alive.checked_shr(nth.into()).unwrap_or(0) & 1 != 0))
                    }
                    MetricSource::Link(nth) => status.links().nth(nth.into()).map(|link| {
                        // Another link carries the traffic of a shared one.
                        Value::Boolean(matches!(link.state, LinkState::Up { .. } | LinkState::Shared))
                    }),
                    MetricSource::Mode
                    | MetricSource::Robot
                    | MetricSource::Program
                    | MetricSource::Safety => state_of(status, item),
                    MetricSource::State => port.map(|port| Value::Word(port.state.name())),
                    MetricSource::FramesIn => port.map(|port| Value::UInt32(port.counters.frames_in)),
                    MetricSource::FramesOut => port.map(|port| Value::UInt32(port.counters.frames_out)),
                    MetricSource::Rejected => port.map(|port| Value::UInt32(port.counters.rejected())),
                    MetricSource::Timeouts => port.map(|port| Value::UInt32(port.counters.timeouts)),
                    MetricSource::Var(var) => {
                        let known = status.variable(var);
                        let is_of_now = |age| var.direction() == Direction::Input || age <= MAX_AGE;
                        known.filter(|known| is_of_now(known.age)).map(|known| value_of(known.value))
                    }
                    // Set below if the bit is known.
                    MetricSource::Bit(..) => None,
                };
            }
        }
        let here = || self.items.iter().enumerate().take(part.end).skip(part.start);
        if !here().any(|(_, told)| matches!(told.item, MetricSource::Bit(..))) {
            return;
        }
        for known in status.bits() {
            let Some(bit) = known.bit else { continue };
            let wanted = MetricSource::Bit(known.var, bit);
            for (place, _) in here().filter(|(_, told)| told.item == wanted) {
                if let (Some(value), Scalar::Byte(byte)) =
                    (values.get_mut(place.saturating_sub(part.start)), known.value)
                {
                    *value = Some(Value::Boolean(byte != 0));
                }
            }
        }
    }

    /// The number of metrics, which is also the number of values of a sample.
    pub fn len(&self) -> usize {
        self.items.len()
    }

    /// Always `false`: the health of the gateway is always there.
    pub fn is_empty(&self) -> bool {
        self.items.is_empty()
    }

    fn begin_owner(&mut self) -> Result<(), NoRoom> {
        self.starts.push(self.items.len()).map_err(|_| NoRoom)
    }

    fn add(&mut self, item: MetricSource) -> Result<(), NoRoom> {
        let rule = match item {
            MetricSource::Var(var) => {
                let mut rules = (0_u8..NO_RULE).zip(self.rates.rules);
                let last =
                    rules.by_ref().filter(|(_, rule)| rule.vars.iter().any(|known| known == var)).last();
                last.map_or(NO_RULE, |(nth, _)| nth)
            }
            _ => NO_RULE,
        };
        self.items.push(MetricItem { item, rule }).map_err(|_| NoRoom)
    }

    /// Adds an item unless the current owner has it already.
    fn add_once(&mut self, item: MetricSource) -> Result<(), NoRoom> {
        let start = self.starts.last().copied().unwrap_or(0);
        match self.items.iter().skip(start).any(|known| known.item == item) {
            true => Ok(()),
            false => self.add(item),
        }
    }

    fn owners(&self) -> impl Iterator<Item = (Owner, Range<usize>)> {
        let owners = core::iter::once(Owner::Node).chain((0..).map(Owner::Device));
        let ranges = self.starts.iter().zip(self.starts.iter().skip(1));
        owners.zip(ranges.map(|(start, end)| *start..*end))
    }
}

impl<const METRICS: usize> Catalog for GatewayCatalog<'_, METRICS> {
    fn devices(&self) -> usize {
        self.ports.len()
    }

    fn device(&self, nth: usize) -> &str {
        self.ports.get(nth).map_or("", |port| &port.device)
    }

    fn metrics(&self, owner: Owner) -> usize {
        let range = self.owners().find(|(other, _)| *other == owner);
        range.map_or(0, |(_, range)| range.len())
    }

    fn metric(&self, place: usize) -> Option<Metric<'_>> {
        let item = self.items.get(place)?.item;
        let is_nodes = self.starts.get(1).is_some_and(|end| place < *end);
        let plain = |name: &str, data_type, unit, description| Metric {
            name: joined(&[name]),
            data_type,
            unit,
            range: None,
            description,
        };
        let text = |name, description| plain(name, DataType::String, "", description);
        let count = |name, description| plain(name, DataType::UInt32, "", description);
        Some(match item {
            MetricSource::Version => text("Node Info/Version", "version of the gateway's program"),
            MetricSource::Uptime => {
                plain("Node Info/Uptime", DataType::UInt64, "s", "time since the program started")
            }
            MetricSource::Condition => text("gateway/health", "the worst present condition"),
            MetricSource::Sleeps => count("gateway/sleeps", "times that the gateway itself did not run"),
            MetricSource::Lost => {
                plain("gateway/values_lost", DataType::UInt64, "", "values that were never told")
            }
            MetricSource::Refused => {
                count("gateway/commands_refused", "writes by commands, which are never obeyed")
            }
            MetricSource::Alive(nth) => Metric {
                name: joined(&["port/", self.device(nth.into()), "/alive"]),
                ..plain("", DataType::Boolean, "", "the field port works")
            },
            MetricSource::Link(nth) => Metric {
                name: joined(&["link/", self.links.get(usize::from(nth))?, "/up"]),
                ..plain("", DataType::Boolean, "", "the link to the controller is up")
            },
            MetricSource::Mode => text("controller/mode", "operation mode of the controller"),
            MetricSource::Robot => text("controller/robot", "robot state of the controller"),
            MetricSource::Program => text("controller/program", "program state of the controller"),
            MetricSource::Safety => text("controller/safety", "safety state of the controller"),
            MetricSource::State => text("state", "health of the field port"),
            MetricSource::FramesIn => count("frames/in", "frames accepted"),
            MetricSource::FramesOut => count("frames/out", "frames sent"),
            MetricSource::Rejected => {
                count("frames/rejected", "frames rejected, without those for other nodes of a CAN bus")
            }
            MetricSource::Timeouts => count("frames/timeouts", "times that a frame became overdue"),
            MetricSource::Var(var) => {
                let folder = if is_nodes { "controller/" } else { "" };
                let mut name = joined(&[folder, var.group(), "/"]);
                push_number(&mut name, var.index());
                let data_type = data_type_of(var.ty());
                let is_float = matches!(data_type, DataType::Float | DataType::Double);
                let range = Some(var.ty().range()).filter(|_| !is_float);
                Metric { name, data_type, unit: unit_of(var), range, description: var.span().interface }
            }
            MetricSource::Bit(var, bit) => {
                let mut name = joined(&[var.group(), "/"]);
                push_number(&mut name, var.index());
                let _ = name.push('/');
                push_number(&mut name, bit);
                Metric { name, ..plain("", DataType::Boolean, "", var.span().interface) }
            }
        })
    }

    fn report(&self, place: usize) -> Report {
        let usual = Report { dead_band: 0.0, min_interval: self.rates.min_interval };
        let Some(MetricItem { item, rule }) = self.items.get(place).copied() else { return usual };
        if matches!(
            item,
            MetricSource::Uptime
                | MetricSource::FramesIn
                | MetricSource::FramesOut
                | MetricSource::Rejected
                | MetricSource::Timeouts
        ) {
            return Report { min_interval: self.rates.counter_interval, ..usual };
        }
        self.rates.rules.get(usize::from(rule)).map_or(usual, |rule| Report {
            dead_band: rule.dead_band,
            min_interval: rule.min_interval.unwrap_or(usual.min_interval),
        })
    }
}

/// The unit of a variable. A row with two units has three quantities of each, such as a pose.
fn unit_of(var: SysVar) -> &'static str {
    let unit = var.unit();
    // The text search of `core` has panics that the optimiser does not remove.
    let comma = unit.bytes().position(|byte| byte == b',');
    match comma.and_then(|at| Some((unit.get(..at)?, unit.get(at.saturating_add(2)..)?))) {
        None => unit,
        Some((first, _)) if var.index().saturating_sub(var.span().first) < 3 => first,
        Some((_, second)) => second,
    }
}

/// The metric type of the values of a variable.
const fn data_type_of(ty: ScalarType) -> DataType {
    match ty {
        ScalarType::Byte => DataType::UInt8,
        ScalarType::Word => DataType::UInt16,
        ScalarType::Dword => DataType::UInt32,
        ScalarType::Char | ScalarType::Short | ScalarType::Int => DataType::Int64,
        ScalarType::Float => DataType::Float,
        ScalarType::Double => DataType::Double,
    }
}

/// Converts a value of a variable to the type of [`data_type_of`].
fn value_of(scalar: Scalar) -> Value {
    match scalar {
        Scalar::Byte(value) => Value::UInt8(value),
        Scalar::Word(value) => Value::UInt16(value),
        Scalar::Dword(value) => Value::UInt32(value),
        Scalar::Char(value) => Value::Int64(value.into()),
        Scalar::Short(value) => Value::Int64(value.into()),
        Scalar::Int(value) => Value::Int64(value.into()),
        Scalar::Float(value) => Value::Float(value),
        Scalar::Double(value) => Value::Double(value),
    }
}

fn state_of(status: Status<'_>, item: MetricSource) -> Option<Value> {
    let controller = status.controller().filter(|controller| controller.age <= MAX_AGE)?;
    let states = controller.states;
    Some(Value::Word(match item {
        MetricSource::Mode => states.mode.name(),
        MetricSource::Robot => states.robot.name(),
        MetricSource::Program => states.program.name(),
        _ => states.safety.name(),
    }))
}

/// Replaces characters that have a meaning in topics by `_`.
fn part_of_topic(name: &str) -> DeviceName {
    let mut part = DeviceName::new();
    for character in name.chars() {
        let is_reserved = matches!(character, '+' | '/' | '#') || character.is_control();
        let _ = part.push(if is_reserved { '_' } else { character });
    }
    part
}

fn joined(parts: &[&str]) -> String<MAX_NAME> {
    let mut name = String::new();
    for part in parts {
        let _ = name.push_str(part);
    }
    name
}

/// Appends a number in decimal.
fn push_number(name: &mut String<MAX_NAME>, number: u8) {
    let mut rest = number;
    for power in [100_u8, 10, 1] {
        let digit = rest.checked_div(power).unwrap_or(0);
        rest = rest.checked_rem(power).unwrap_or(0);
        if number >= power || power == 1 {
            let _ = name.push(char::from(digit.saturating_add(b'0')));
        }
    }
}
