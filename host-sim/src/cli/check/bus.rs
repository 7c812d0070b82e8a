//! How full CAN buses are, with all that several ports put on them.
//!
//! In: a checked configuration, and which ports share a bus. Out: a load in percent for each bus, and what cannot go
//! together on one. Only frames with a period count: an input part counts as one frame of each id a cycle.

use proto_core::config::{Bus, GatewayConfig, Parts, Port, SendOn, Transaction};
use proto_core::device::Carrier;
use proto_core::sysvar::Direction;
use proto_core::time::Duration;
use proto_core::wire::can::CanId;
use recipe_config::{AnyRecipe, SimCanFrame, SimParts};
use serde::Serialize;

use super::super::text;

/// One bus.
#[derive(Debug, Serialize)]
pub(super) struct Load {
    ports: Vec<String>,
    bitrate: u32,
    frames_per_second: f64,
    /// Of the bus, with one stuffed bit in 30 as random data have it.
    average_percent: f64,
    /// Of the bus, with as many stuffed bits as there can be.
    worst_percent: f64,
    /// What has no period and is not counted.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    not_counted: Vec<String>,
}

/// What is wrong with a bus: the port, and a sentence.
pub(super) type Trouble = (String, String);

/// A frame that comes again and again.
struct Periodic {
    id: CanId,
    bytes: usize,
    every: Duration,
}

impl Periodic {
    /// Bits with so many stuffed ones, and the space between frames.
    fn bits(&self, stuffed: impl Fn(u64) -> f64) -> f64 {
        // Identifier and control bits, data and checksum can be stuffed; delimiters, end and space cannot.
        let header = if matches!(self.id, CanId::Extended(_)) { 54 } else { 34 };
        let bits = header + 8 * self.bytes as u64;
        bits as f64 + stuffed(bits) + 13.0
    }

    fn per_second(&self) -> f64 {
        1e6 / self.every.as_micros().max(1) as f64
    }
}

/// The buses of a configuration. `shared` has lists of ports that are on one bus; any other port has its own.
///
/// # Errors
/// A name that is no CAN port, or is there twice.
pub(super) fn loads(
    config: &GatewayConfig,
    recipes: &[AnyRecipe],
    shared: &[Vec<String>],
) -> Result<(Vec<Load>, Vec<Trouble>), String> {
    let can: Vec<&Port> = config.ports.iter().filter(|port| port.bus.is_can()).collect();
    let mut groups: Vec<Vec<&Port>> = Vec::new();
    let mut named: Vec<&str> = Vec::new();
    for names in shared {
        let mut group = Vec::new();
        for name in names {
            let Some(port) = can.iter().find(|port| port.name == name.as_str()) else {
                let known: Vec<_> = can.iter().map(|port| port.name.as_str()).collect();
                return Err(format!(
                    "--same-bus: there is no CAN port {name:?}; there are: {}",
                    known.join(", ")
                ));
            };
            if named.contains(&name.as_str()) {
                return Err(format!("--same-bus: {name:?} is there twice; a port is on one bus"));
            }
            named.push(name);
            group.push(*port);
        }
        groups.push(group);
    }
    groups.extend(can.iter().filter(|port| !named.contains(&port.name.as_str())).map(|port| vec![*port]));
    let mut troubles = collisions(config, &groups);
    let loads = groups
        .iter()
        .filter(|group| !group.is_empty())
        .map(|group| {
            let load = load(config, recipes, group);
            troubles.extend(wrong(config, group, &load));
            load
        })
        .collect();
    Ok((loads, troubles))
}

fn load(config: &GatewayConfig, recipes: &[AnyRecipe], ports: &[&Port]) -> Load {
    let bitrate = ports.iter().find_map(|port| bitrate(port)).unwrap_or(1);
    let (mut frames, mut not_counted) = (Vec::new(), Vec::new());
    for port in ports {
        let recipe = recipes.get(usize::from(port.recipe));
        add_parts(config, port, recipe, &mut frames, &mut not_counted);
        add_exchanges(config, port, &mut frames, &mut not_counted);
    }
    let sum = |bits: &dyn Fn(&Periodic) -> f64| {
        let all: f64 = frames.iter().map(|frame| bits(frame) * frame.per_second()).sum();
        tenths(100.0 * all / f64::from(bitrate))
    };
    Load {
        ports: ports.iter().map(|port| port.name.to_string()).collect(),
        bitrate,
        frames_per_second: tenths(frames.iter().map(Periodic::per_second).sum()),
        average_percent: sum(&|frame| frame.bits(|bits| bits as f64 / 30.0)),
        worst_percent: sum(&|frame| frame.bits(|bits| (bits.saturating_sub(1) / 4) as f64)),
        not_counted,
    }
}

fn add_parts(
    config: &GatewayConfig,
    port: &Port,
    recipe: Option<&AnyRecipe>,
    frames: &mut Vec<Periodic>,
    not_counted: &mut Vec<String>,
) {
    let periodic = |(id, bytes)| Periodic { id, bytes, every: port.cycle };
    let [input, output] = [Direction::Input, Direction::Output]
        .map(|part| recipe.map_or_else(Vec::new, |recipe| sizes(recipe, part)));
    frames.extend(input.into_iter().map(periodic));
    match config.recipes.get(usize::from(port.recipe)).map(|recipe| recipe.send) {
        Some(SendOn::Frame | SendOn::Rising { .. }) if !output.is_empty() => {
            not_counted.push(format!("output of {}, which is sent for each frame or rising bit", port.name));
        }
        _ => frames.extend(output.into_iter().map(periodic)),
    }
}

/// The ids and the bytes of the frames of a part.
fn sizes(recipe: &AnyRecipe, part: Direction) -> Vec<(CanId, usize)> {
    let plain =
        |frame: &SimCanFrame| (frame.id, frame.fields.iter().map(|field| field.field.ty().size()).sum());
    match recipe {
        AnyRecipe::Device(recipe) => {
            let frames = recipe.part(part).iter();
            let size = |frame: &recipe_config::NamedFrame| {
                // Cannot fail: reading the file laid out the same frames.
                let bytes = frame.lay_out(Carrier::Can, part).map_or(8, |frame| frame.layout.lengths().1);
                Some((frame.id?, bytes))
            };
            frames.filter_map(size).collect()
        }
        AnyRecipe::Plain(recipe) => match (&recipe.parts, part) {
            (SimParts::Can { input, .. }, Direction::Input) => input.iter().map(plain).collect(),
            (SimParts::Can { output, .. }, Direction::Output) => output.iter().map(plain).collect(),
            (SimParts::Stream { .. }, _) => Vec::new(),
        },
    }
}

fn add_exchanges(
    config: &GatewayConfig,
    port: &Port,
    frames: &mut Vec<Periodic>,
    not_counted: &mut Vec<String>,
) {
    let Some(recipe) = config.recipes.get(usize::from(port.recipe)) else { return };
    for (number, exchange) in (1..).zip(config.view().exchanges_of(recipe)) {
        let Some(every) = exchange.when.every else {
            not_counted.push(format!("exchange {number} of {}, which has no period", port.name));
            continue;
        };
        let Transaction::Frames { request, reply, .. } = exchange.transaction else { continue };
        let budget = config.view().exchange_budget(port, exchange);
        let id = |nth: Option<u8>| config.frames.get(usize::from(nth?))?.id;
        let both = [(id(request), budget.request), (id(reply), budget.reply)];
        frames.extend(both.into_iter().filter_map(|(id, bytes)| Some(Periodic { id: id?, bytes, every })));
    }
}

fn bitrate(port: &Port) -> Option<u32> {
    match port.bus {
        Bus::Can { bitrate } => Some(bitrate),
        _ => None,
    }
}

/// What cannot go together, and a bus that is full.
fn wrong(config: &GatewayConfig, ports: &[&Port], load: &Load) -> Vec<Trouble> {
    let mut troubles = Vec::new();
    let first = ports.first().map_or("", |port| port.name.as_str());
    for (nth, port) in ports.iter().enumerate() {
        let name = port.name.to_string();
        if bitrate(port) != Some(load.bitrate) {
            let other = bitrate(port).unwrap_or_default();
            troubles.push((
                name.clone(),
                format!(
                    "port {name:?} has {other} bit/s, but is on one bus with {first:?}, which has {}",
                    load.bitrate
                ),
            ));
        }
        for id in sent(config, port) {
            let other = ports.iter().take(nth).find(|other| sent(config, other).any(|sent| sent == id));
            if let Some(other) = other {
                troubles.push((
                    name.clone(),
                    format!(
                        "port {name:?} and port {:?} both send id {}: two frames with one id at the same time \
                         destroy each other",
                        other.name,
                        text::show_id(id)
                    ),
                ));
            }
        }
    }
    if load.worst_percent > 100.0 {
        troubles.push((
            first.to_owned(),
            format!(
                "bus of {}: {} % in the worst case of stuffed bits, so frames are late or lost; set a longer cycle_ms \
                 or a higher bitrate",
                load.ports.join(", "),
                load.worst_percent
            ),
        ));
    }
    troubles
}

/// Ids that collide, within a port and, if the ports are on one bus, between them. What ports that are on one bus
/// both send is reported with it.
fn collisions(config: &GatewayConfig, groups: &[Vec<&Port>]) -> Vec<Trouble> {
    let ports: Vec<(usize, &Port)> =
        (0..).zip(groups).flat_map(|(group, ports)| ports.iter().map(move |port| (group, *port))).collect();
    let mut troubles = Vec::new();
    for (nth, &(group, port)) in ports.iter().enumerate() {
        let name = port.name.as_str();
        let mut say = |port: &str, said: String| troubles.push((port.to_owned(), said));
        if let Some(id) = shared(sent(config, port), received(config, port)) {
            say(
                name,
                format!(
                    "port {name:?} sends id {} and receives it: on one bus, two nodes that send one id at the same time \
                     destroy each other's frames",
                    text::show_id(id)
                ),
            );
        }
        for &(other_group, other) in ports.iter().take(nth) {
            let is_one = group == other_group;
            let condition = if is_one { "" } else { "; if both are on one bus" };
            let end = "two frames with one id at the same time destroy each other";
            if !is_one && let Some(id) = shared(sent(config, other), sent(config, port)) {
                let (first, id) = (&other.name, text::show_id(id));
                say(name, format!("port {first:?} and port {name:?} both send id {id}{condition}, {end}"));
            }
            let from_other = shared(sent(config, other), received(config, port)).map(|id| (other, port, id));
            let from_this = shared(sent(config, port), received(config, other)).map(|id| (port, other, id));
            for (sender, receiver, id) in from_other.into_iter().chain(from_this) {
                let (sender, receiver, id) = (&sender.name, &receiver.name, text::show_id(id));
                let what =
                    format!("port {sender:?} sends id {id}, which port {receiver:?} receives from a device");
                say(name, format!("{what}{condition}, {end}"));
            }
        }
    }
    troubles
}

/// The first id that is in both.
fn shared(one: impl Iterator<Item = CanId>, other: impl Iterator<Item = CanId>) -> Option<CanId> {
    let other: Vec<_> = other.collect();
    one.into_iter().find(|id| other.contains(id))
}

/// The ids that devices send on a port.
fn received(config: &GatewayConfig, port: &Port) -> impl Iterator<Item = CanId> {
    let recipe = config.recipes.get(usize::from(port.recipe));
    let input = match recipe.map(|recipe| &recipe.parts) {
        Some(Parts::Can { input, .. }) => &input[..],
        _ => &[],
    };
    let exchanges = recipe.map_or(&[][..], |recipe| config.view().exchanges_of(recipe));
    let replies = exchanges.iter().flat_map(|exchange| match exchange.transaction {
        // A remote request has the id of its reply.
        Transaction::Frames { request, reply, refusal } if !is_remote(config, request) => {
            [reply, exchange.pending, refusal]
        }
        _ => [None; 3],
    });
    let replies = replies.flatten().filter_map(|nth| config.frames.get(usize::from(nth))?.id);
    input.iter().map(|frame| frame.id).chain(replies)
}

fn is_remote(config: &GatewayConfig, request: Option<u8>) -> bool {
    request.and_then(|nth| config.frames.get(usize::from(nth))).is_some_and(|frame| frame.remote)
}

/// The ids of the data frames that the gateway sends on a port.
fn sent(config: &GatewayConfig, port: &Port) -> impl Iterator<Item = CanId> {
    let recipe = config.recipes.get(usize::from(port.recipe));
    let parts = recipe.map(|recipe| &recipe.parts);
    let output = match parts {
        Some(Parts::Can { output, .. }) => &output[..],
        _ => &[],
    };
    let view = config.view();
    let exchanges = recipe.map_or(&[][..], |recipe| view.exchanges_of(recipe));
    let requests = exchanges.iter().filter_map(|exchange| match exchange.transaction {
        Transaction::Frames { request, .. } if !is_remote(config, request) => {
            config.frames.get(usize::from(request?))?.id
        }
        _ => None,
    });
    output.iter().map(|frame| frame.id).chain(requests)
}

fn tenths(value: f64) -> f64 {
    (value * 10.0).round() / 10.0
}

/// All buses as text; empty without one.
pub(super) fn show(loads: &[Load]) -> String {
    let mut report = String::new();
    for load in loads {
        report += &format!(
            "  {}: {} frames a second, {} % of {} bit/s on average, {} % with all stuffed bits\n",
            load.ports.join(", "),
            load.frames_per_second,
            load.average_percent,
            load.bitrate,
            load.worst_percent
        );
        for what in &load.not_counted {
            report += &format!("    not counted: {what}\n");
        }
    }
    if report.is_empty() {
        report
    } else {
        format!("\nCAN buses, if devices send each input once in the port's cycle_ms\n{report}")
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn frame(bytes: usize) -> Periodic {
        Periodic { id: CanId::Standard(1), bytes, every: Duration::from_millis(4) }
    }

    #[test]
    fn bits_of_a_frame_are_those_of_the_wire() {
        let worst = |bits: u64| (bits.saturating_sub(1) / 4) as f64;
        // 135 and 111 bits: the known maximum and minimum of eight data bytes, with the space between frames.
        assert_eq!(frame(8).bits(worst), 135.0);
        assert_eq!(frame(8).bits(|_| 0.0), 111.0);
        assert_eq!(frame(8).per_second(), 250.0);
        let extended = Periodic { id: CanId::Extended(1), ..frame(8) };
        assert_eq!(extended.bits(worst), 160.0);
    }
}
