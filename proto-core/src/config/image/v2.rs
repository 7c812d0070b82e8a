//! Version 2: before there were frames of devices. Frozen: what it reads never changes.
//!
//! These are the configuration's types as they were then, each with `From` into today's. Numbers and
//! names that the specification fixes (types, variables, ids, times) are shared with today's.

use core::net::Ipv4Addr;

use heapless::{String, Vec};
use serde::Deserialize;

use super::{ConfigMut, ImageError, item, items};
use crate::config::error::Counted;
use crate::config::{self, Delimiter, MAX_ADDRESS, MAX_COMMAND_TEXT, MAX_LISTEN, Name};
use crate::recipe::model::{MAX_CAN_IDS, Mode};
use crate::sysvar::SysVar;
use crate::time::Duration;
use crate::wire::can::CanId;
use crate::wire::scalar::{Scalar, ScalarType};

pub(super) fn read_head(rest: &mut &[u8], config: &mut ConfigMut<'_>) -> Result<(), ImageError> {
    *config.controller = item::<ControllerLink>(rest)?.into();
    *config.network = item::<BoardAddress>(rest)?.into();
    Ok(())
}

/// The lists, which version 1 has too.
pub(super) static LISTS: [Counted; 5] =
    [Counted::Recipes, Counted::Ports, Counted::Fields, Counted::Commands, Counted::SafeValues];

pub(super) fn read_entries(
    list: Counted,
    count: usize,
    rest: &mut &[u8],
    config: &mut ConfigMut<'_>,
) -> Result<(), ImageError> {
    match list {
        Counted::Recipes => items::<Recipe, _>(rest, count, config.recipes),
        Counted::Ports => items::<Port, _>(rest, count, config.ports),
        Counted::Fields => items::<FieldSpec, _>(rest, count, config.fields),
        Counted::Commands => items::<CommandEntry, _>(rest, count, config.commands),
        _ => items::<SafeValue, _>(rest, count, config.safe_values),
    }
}

#[derive(Deserialize)]
pub(super) struct ControllerLink {
    address: String<MAX_ADDRESS>,
    dialect: String<16>,
    command_port: u16,
    state_port: u16,
    modbus_port: u16,
    recipe_link: Option<RecipeLink>,
}

impl From<ControllerLink> for config::ControllerLink {
    fn from(old: ControllerLink) -> Self {
        let ControllerLink { address, dialect, command_port, state_port, modbus_port, recipe_link } = old;
        let recipe_link = recipe_link.map(Into::into);
        Self { address, dialect, command_port, state_port, modbus_port, recipe_link }
    }
}

#[derive(Deserialize)]
struct RecipeLink {
    udp_port: u16,
    recipe: u8,
}

impl From<RecipeLink> for config::RecipeLink {
    fn from(RecipeLink { udp_port, recipe }: RecipeLink) -> Self {
        Self { udp_port, recipe }
    }
}

#[derive(Deserialize)]
enum BoardAddress {
    Dhcp,
    Static(Network),
}

impl From<BoardAddress> for config::BoardAddress {
    fn from(old: BoardAddress) -> Self {
        match old {
            BoardAddress::Dhcp => Self::Dhcp,
            BoardAddress::Static(network) => Self::Static(network.into()),
        }
    }
}

#[derive(Deserialize)]
struct Network {
    address: Ipv4Addr,
    prefix: u8,
    router: Option<Ipv4Addr>,
    dns: Option<Ipv4Addr>,
}

impl From<Network> for config::Network {
    fn from(Network { address, prefix, router, dns }: Network) -> Self {
        Self { address, prefix, router, dns }
    }
}

#[derive(Deserialize)]
struct Recipe {
    name: Name,
    mode: Mode,
    parts: Parts,
    on_stale: OnStale,
    send: SendOn,
}

impl From<Recipe> for config::Recipe {
    fn from(Recipe { name, mode, parts, on_stale, send }: Recipe) -> Self {
        Self { on_stale: on_stale.into(), send: send.into(), ..config::Recipe::new(name, mode, parts.into()) }
    }
}

#[derive(Deserialize)]
#[allow(clippy::large_enum_variant, reason = "without an allocator there is no box to put the larger one in")]
enum Parts {
    Stream { input: Option<StreamPart>, output: Option<StreamPart> },
    Can { input: Vec<CanFramePart, MAX_CAN_IDS>, output: Vec<CanFramePart, MAX_CAN_IDS> },
}

impl From<Parts> for config::Parts {
    fn from(old: Parts) -> Self {
        match old {
            Parts::Stream { input, output } => {
                Self::Stream { input: input.map(Into::into), output: output.map(Into::into) }
            }
            Parts::Can { input, output } => Self::Can { input: frames(&input), output: frames(&output) },
        }
    }
}

/// Not collected: that can panic.
fn frames(old: &[CanFramePart]) -> Vec<config::CanFramePart, MAX_CAN_IDS> {
    let mut frames = Vec::new();
    for &frame in old {
        // There is as much room as before.
        let _ = frames.push(frame.into());
    }
    frames
}

#[derive(Deserialize)]
struct StreamPart {
    head: Delimiter,
    tail: Delimiter,
    fields: Span,
}

impl From<StreamPart> for config::StreamPart {
    fn from(StreamPart { head, tail, fields }: StreamPart) -> Self {
        Self::new(head, tail, fields.into())
    }
}

#[derive(Clone, Copy, Deserialize)]
struct CanFramePart {
    id: CanId,
    fields: Span,
}

impl From<CanFramePart> for config::CanFramePart {
    fn from(CanFramePart { id, fields }: CanFramePart) -> Self {
        Self { id, fields: fields.into() }
    }
}

#[derive(Clone, Copy, Deserialize)]
struct Span {
    start: u16,
    len: u16,
}

impl From<Span> for config::Span {
    fn from(Span { start, len }: Span) -> Self {
        Self { start, len }
    }
}

#[derive(Deserialize)]
enum FieldSpec {
    System(SysVar),
    UserInput { ty: ScalarType, to: InputBinding },
    UserOutput { ty: ScalarType, from: OutputBinding },
}

impl From<FieldSpec> for config::FieldSpec {
    fn from(old: FieldSpec) -> Self {
        match old {
            FieldSpec::System(var) => Self::System(var),
            FieldSpec::UserInput { ty, to } => Self::UserInput { ty, to: to.into() },
            FieldSpec::UserOutput { ty, from } => Self::UserOutput { ty, from: from.into() },
        }
    }
}

#[derive(Deserialize)]
enum InputBinding {
    Unused,
    Variable { var: SysVar, scale: f32, offset: f32 },
    Commands { table: Span, when: CommandWhen },
}

impl From<InputBinding> for config::InputBinding {
    fn from(old: InputBinding) -> Self {
        match old {
            InputBinding::Unused => Self::Unused,
            InputBinding::Variable { var, scale, offset } => Self::Variable { var, scale, offset },
            InputBinding::Commands { table, when } => {
                Self::Commands { table: table.into(), when: when.into() }
            }
        }
    }
}

#[derive(Deserialize)]
enum CommandWhen {
    Change,
    Frame,
}

impl From<CommandWhen> for config::CommandWhen {
    fn from(old: CommandWhen) -> Self {
        match old {
            CommandWhen::Change => Self::Change,
            CommandWhen::Frame => Self::Frame,
        }
    }
}

#[derive(Deserialize)]
enum OutputBinding {
    Variable { var: SysVar, scale: f32, offset: f32 },
    Constant(f64),
    Counter,
    Reply,
}

impl From<OutputBinding> for config::OutputBinding {
    fn from(old: OutputBinding) -> Self {
        match old {
            OutputBinding::Variable { var, scale, offset } => Self::Variable { var, scale, offset },
            OutputBinding::Constant(value) => Self::Constant(value),
            OutputBinding::Counter => Self::Counter,
            OutputBinding::Reply => Self::Reply,
        }
    }
}

#[derive(Deserialize)]
struct CommandEntry {
    value: i64,
    text: String<MAX_COMMAND_TEXT>,
}

impl From<CommandEntry> for config::CommandEntry {
    fn from(CommandEntry { value, text }: CommandEntry) -> Self {
        Self { first: value, last: value, text }
    }
}

#[derive(Deserialize)]
enum OnStale {
    Hold,
    Stop,
}

impl From<OnStale> for config::OnStale {
    fn from(old: OnStale) -> Self {
        match old {
            OnStale::Hold => Self::Hold,
            OnStale::Stop => Self::Stop,
        }
    }
}

#[derive(Deserialize)]
enum SendOn {
    Period,
    Change,
    Frame,
    Rising { var: SysVar, bit: u8 },
}

impl From<SendOn> for config::SendOn {
    fn from(old: SendOn) -> Self {
        match old {
            SendOn::Period => Self::Period,
            SendOn::Change => Self::Change,
            SendOn::Frame => Self::Frame,
            SendOn::Rising { var, bit } => Self::Rising { var, bit },
        }
    }
}

#[derive(Deserialize)]
struct Port {
    name: Name,
    bus: Bus,
    recipe: u8,
    cycle: Duration,
    timeout: Duration,
    on_timeout: Span,
    stale_after: Duration,
}

impl From<Port> for config::Port {
    fn from(Port { name, bus, recipe, cycle, timeout, on_timeout, stale_after }: Port) -> Self {
        Self {
            cycle,
            timeout,
            on_timeout: on_timeout.into(),
            stale_after,
            ..config::Port::new(name, bus.into(), recipe)
        }
    }
}

#[derive(Deserialize)]
enum Bus {
    Rs485(Rs485),
    Can { bitrate: u32 },
    TcpListen { listen: String<MAX_LISTEN> },
    UdpListen { listen: String<MAX_LISTEN> },
}

impl From<Bus> for config::Bus {
    fn from(old: Bus) -> Self {
        match old {
            Bus::Rs485(line) => Self::Rs485(line.into()),
            Bus::Can { bitrate } => Self::Can { bitrate },
            Bus::TcpListen { listen } => Self::TcpListen { listen },
            Bus::UdpListen { listen } => Self::UdpListen { listen },
        }
    }
}

#[derive(Deserialize)]
struct Rs485 {
    baud: u32,
    parity: Parity,
    stop_bits: u8,
    idle_gap: Duration,
    turnaround: Duration,
}

impl From<Rs485> for config::Rs485 {
    fn from(Rs485 { baud, parity, stop_bits, idle_gap, turnaround }: Rs485) -> Self {
        Self { baud, parity: parity.into(), stop_bits, idle_gap, turnaround, echo: config::Echo::No }
    }
}

#[derive(Deserialize)]
enum Parity {
    None,
    Even,
    Odd,
}

impl From<Parity> for config::Parity {
    fn from(old: Parity) -> Self {
        match old {
            Parity::None => Self::None,
            Parity::Even => Self::Even,
            Parity::Odd => Self::Odd,
        }
    }
}

#[derive(Deserialize)]
struct SafeValue {
    var: SysVar,
    value: Scalar,
}

impl From<SafeValue> for config::SafeValue {
    fn from(SafeValue { var, value }: SafeValue) -> Self {
        Self::new(var, value)
    }
}

#[cfg(test)]
mod tests {
    use std::format;

    use serde_reflection::{Samples, Tracer, TracerConfig};

    use super::*;

    /// Every type, field and variant, beside those that version 2 wrote when it was the newest.
    #[test]
    fn the_types_are_still_those_of_the_version() {
        let mut tracer = Tracer::new(TracerConfig::default());
        let samples = Samples::new();
        macro_rules! trace {
            ($($kind:ty),* $(,)?) => { $(tracer.trace_type::<$kind>(&samples).unwrap();)* };
        }
        // Every enum for itself, or the tracer sees only some of its variants.
        trace!(
            BoardAddress,
            Bus,
            CanId,
            CommandWhen,
            FieldSpec,
            InputBinding,
            Mode,
            OnStale,
            OutputBinding,
            Parity,
            Parts,
            Scalar,
            ScalarType,
            SendOn,
            CommandEntry,
            ControllerLink,
            Port,
            Recipe,
            SafeValue,
        );
        let kept = include_str!("../../../tests/golden/v2/types.txt");
        let registry = tracer.registry().unwrap();
        for (name, format) in &registry {
            let said = format!("{name}: {format:#?}\n");
            assert!(kept.contains(&said), "{said}");
        }
        // The whole configuration is no type here: its parts are read one by one.
        let kept_types = kept
            .lines()
            .filter(|line| line.starts_with(char::is_uppercase) && !line.starts_with("GatewayConfig"));
        assert_eq!(kept_types.count(), registry.len());
        for (ordinal, var) in SysVar::all().enumerate() {
            assert!(kept.contains(&format!("variable {ordinal}: {var}\n")), "{var}");
        }
    }
}
