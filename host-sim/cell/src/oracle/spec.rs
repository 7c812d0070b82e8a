//! What the configuration specifies: owners, routes and sources (proto-core/docs/engine.md section 4), computed once.
//!
//! Written from that page, independent of the engine's plan.

pub(super) mod exchanges;
pub(super) mod frames;
pub(super) mod served;

use proto_core::config::{Bus, FieldSpec, GatewayConfig, InputRule, Parts, Recipe, SendOn};
use proto_core::device::Boundary;
use proto_core::engine::{LinkId, PortId};
use proto_core::recipe::model::Mode;
use proto_core::sysvar::{COUNT, Direction, ModbusPlace, SysVar};
use proto_core::time::Duration;

use super::Invariant;
use super::frame::{Frame, Raw, device_frame, frame};
use super::invariant::Wrong;
use exchanges::ExchangesSpec;
use served::ServedSpec;

/// The bits that one input frame writes in one byte.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Share {
    pub port: usize,
    pub frame: usize,
    pub var: SysVar,
    pub mask: u8,
    pub safe: Option<u8>,
}

/// The owner of a variable, and the route of its values to the controller.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Owned {
    /// The port's index in the configuration.
    pub port: usize,
    /// The input frame of the port that carries it.
    pub frame: usize,
    pub way: LinkId,
    pub safe: Option<Raw>,
}

/// The source of a variable that a port sends.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Origin {
    Field,
    Recipe,
    Modbus,
    State,
}

/// A field port.
#[derive(Debug, Clone)]
pub(super) struct PortSpec {
    pub is_field: bool,
    pub is_can: bool,
    pub mode: Mode,
    pub inputs: Vec<Frame>,
    pub outputs: Vec<Frame>,
    /// The variables that the input frames write, and the byte variables among them.
    pub written: Vec<SysVar>,
    pub written_bits: Vec<SysVar>,
    /// The variables in the output frames, and the variable of the bit that triggers these frames.
    pub needed: Vec<SysVar>,
    pub timeout: Duration,
    pub stale_after: Duration,
    pub stops_when_stale: bool,
    pub cycle: Duration,
    pub send: SendOn,
    pub idle_gap: Duration,
    pub turnaround: Duration,
    /// How the frames of the input part are told apart.
    pub framing: Boundary,
    /// The exchanges with slaves or devices. Their replies come after the other input frames.
    pub exchanges: Option<ExchangesSpec>,
    /// The blocks that a master on a Modbus line may access. The values it writes come after the other input frames.
    pub served: Option<ServedSpec>,
}

impl PortSpec {
    /// The variables in the port's output frames and requests.
    fn shown(&self) -> impl Iterator<Item = SysVar> {
        let fields = self.outputs.iter().flat_map(|frame| &frame.shown).copied();
        let rows = self.exchanges.iter().flat_map(|exchanges| &exchanges.rows);
        let asked = rows.flat_map(|row| row.shown().chain(row.rising.map(|(var, _)| var)));
        fields.chain(asked).chain(self.served.iter().flat_map(ServedSpec::shown))
    }
}

/// A recipe link.
#[derive(Debug, Clone)]
pub(super) struct LinkSpec {
    pub id: LinkId,
    pub is_datagram: bool,
    pub input: Option<Frame>,
    pub output: Option<Frame>,
    /// The variables that are sent in its frames are read back while their owners are overdue.
    pub reads_back: bool,
    /// How long sent data may be in flight. Unacknowledged data is given up after that, with its connection. Datagrams
    /// do not wait.
    pub not_after: Duration,
}

/// The specification of a whole gateway.
#[derive(Debug, Clone)]
pub(super) struct Spec {
    pub ports: Vec<PortSpec>,
    pub links: Vec<LinkSpec>,
    pub owned: [Option<Owned>; COUNT],
    pub origin: [Option<Origin>; COUNT],
    pub read_back: [bool; COUNT],
    /// The variables that are taken from the state stream.
    pub in_packet: Vec<SysVar>,
    /// The variables that have a safe value.
    pub safe_vars: Vec<SysVar>,
    /// The gateway has a state link.
    pub has_state: bool,
    /// The output that shows an input's value at the controller; `None` if the gateway does not receive it.
    pub witness: [Option<SysVar>; COUNT],
    /// At least one port sends on a rising bit.
    pub has_triggers: bool,
    /// The entries of all command tables.
    pub commands: Vec<Entry>,
    /// The bits that ports write one by one.
    pub shares: Vec<Share>,
}

/// A command for a range of values.
#[derive(Debug, Clone)]
pub(super) struct Entry {
    first: i64,
    last: i64,
    /// Empty if these values select no command.
    pub text: String,
}

impl Entry {
    pub(super) fn has(&self, value: i64) -> bool {
        (self.first..=self.last).contains(&value)
    }

    /// The text of the command, with the value inserted.
    pub(super) fn text_for(&self, value: i64) -> String {
        self.text.replace("{value}", &value.to_string())
    }
}

impl Spec {
    pub(super) fn new(config: &GatewayConfig) -> Self {
        let ports: Vec<PortSpec> = config.ports.iter().map(|port| port_spec(config, port)).collect();
        let mut links = links(config);
        let owned = owners(config, &ports, &links);
        let mut read_back = [false; COUNT];
        for link in &mut links {
            if !link.is_datagram {
                let owned = owned.iter().flatten().filter(|owned: &&Owned| owned.way == link.id);
                let timeouts = owned.map(|owned| ports[owned.port].timeout);
                link.not_after = timeouts.min().unwrap_or_default().max(Duration::from_millis(250));
            }
            link.reads_back = !is_one_frame(&ports, &owned, link);
            for var in link.input.iter().flat_map(|up| &up.written) {
                read_back[var.ordinal()] |= link.reads_back && var.stream().is_some();
            }
        }
        let mut origin = [None; COUNT];
        for port in &ports {
            let trigger = match port.send {
                SendOn::Rising { var, .. } => Some(var),
                SendOn::Period | SendOn::Change | SendOn::Frame => None,
            };
            for var in port.shown().chain(trigger) {
                let from_link =
                    links.iter().any(|link| link.output.as_ref().is_some_and(|down| down.shows(var)));
                origin[var.ordinal()] = Some(if owned[var.ordinal()].is_some() {
                    Origin::Field
                } else if from_link {
                    Origin::Recipe
                } else if by_modbus(var) {
                    Origin::Modbus
                } else {
                    Origin::State
                });
            }
        }
        let commands = config.commands.iter();
        let commands =
            commands.map(|c| Entry { first: c.first, last: c.last, text: c.text.as_str().to_owned() });
        let commands = commands.collect();
        let may_bring =
            |var: &SysVar| origin[var.ordinal()] == Some(Origin::State) || read_back[var.ordinal()];
        let in_packet: Vec<SysVar> = SysVar::all().filter(may_bring).collect();
        let has_state = !in_packet.is_empty();
        let is_safe = |var: &SysVar| owned[var.ordinal()].is_some_and(|owned: Owned| owned.safe.is_some());
        let safe_vars = SysVar::all().filter(is_safe).collect();
        let has_triggers = ports.iter().any(|port| matches!(port.send, SendOn::Rising { .. }));
        let witness = witnesses(&links, &origin);
        Self {
            shares: shares(config, &ports),
            ports,
            links,
            owned,
            origin,
            read_back,
            in_packet,
            safe_vars,
            has_state,
            witness,
            has_triggers,
            commands,
        }
    }

    /// Checks that a write is complete: if it has one register of a text, it needs all of them, and those that go with
    /// them.
    pub(super) fn has_whole_texts(&self, values: &[(SysVar, Raw)]) -> Result<(), Wrong> {
        let has = |var: SysVar| values.iter().any(|(own, _)| *own == var);
        let fields = self.ports.iter().flat_map(|port| &port.inputs).flat_map(|frame| &frame.fields);
        for field in fields.filter(|field| matches!(field, FieldSpec::TextInput { to: Some(_), .. })) {
            let FieldSpec::TextInput { to: Some(words), .. } = field else { continue };
            let there = words.iter().filter(|&var| has(var)).count();
            if there != 0 && there != usize::from(words.count) {
                let what = format!("{} alone of a text that begins at {}", there, words.first);
                return Err((Invariant::Ownership, what));
            }
        }
        Ok(())
    }

    pub(super) fn link(&self, id: LinkId) -> Option<&LinkSpec> {
        self.links.iter().find(|link| link.id == id)
    }

    /// Whether the controller shows the value of the variable anywhere.
    pub(super) fn can_be_shown(&self, var: SysVar) -> bool {
        self.has_state && var.stream().is_some() || self.witness[var.ordinal()].is_some()
    }
}

fn by_modbus(var: SysVar) -> bool {
    matches!(var.modbus(), Some(ModbusPlace::Coils { .. } | ModbusPlace::Register { .. }))
}

fn frames(config: &GatewayConfig, recipe: &Recipe, direction: Direction) -> Vec<Frame> {
    let frame = if config.view().is_device(recipe) { device_frame } else { frame };
    match (&recipe.parts, direction) {
        (Parts::Stream { input: part, .. }, Direction::Input)
        | (Parts::Stream { output: part, .. }, Direction::Output) => {
            let part = part.iter();
            part.map(|part| frame(&part.head, &part.tail, None, part.fields.of(&config.fields))).collect()
        }
        (Parts::Can { input: parts, .. }, Direction::Input)
        | (Parts::Can { output: parts, .. }, Direction::Output) => {
            let parts = parts.iter();
            parts.map(|part| frame(&[], &[], Some(part.id), part.fields.of(&config.fields))).collect()
        }
    }
}

fn port_spec(config: &GatewayConfig, port: &proto_core::config::Port) -> PortSpec {
    let recipe = &config.recipes[usize::from(port.recipe)];
    let mut inputs = frames(config, recipe, Direction::Input);
    let (mut exchanges, mut served) = (None, None);
    let (idle_gap, turnaround) = match port.bus {
        Bus::Rs485(line) => {
            // 3.5 characters, each with a start bit, eight bits, parity and stop bits (D19).
            let parity = u64::from(line.parity != proto_core::config::Parity::None);
            let half_bits = 7 * (9 + parity + u64::from(line.stop_bits));
            let characters = (half_bits * 1_000_000).div_ceil(2 * u64::from(line.baud));
            let characters = Duration::from_micros(characters);
            let silence = line.turnaround.max(characters);
            exchanges = ExchangesSpec::new(config, recipe, (port, Some(&line), silence), &mut inputs);
            served = ServedSpec::new(config, recipe, line, &mut inputs);
            (line.idle_gap.max(characters), line.turnaround)
        }
        Bus::Can { .. } => {
            exchanges = ExchangesSpec::new(config, recipe, (port, None, Duration::ZERO), &mut inputs);
            (Duration::MAX, Duration::ZERO)
        }
        Bus::TcpListen { .. } | Bus::UdpListen { .. } | Bus::ModbusTcp { .. } => {
            (Duration::MAX, Duration::ZERO)
        }
    };
    let outputs = frames(config, recipe, Direction::Output);
    let written: Vec<SysVar> = inputs.iter().flat_map(|frame| &frame.written).copied().collect();
    let trigger = match recipe.send {
        SendOn::Rising { var, .. } => Some(var),
        SendOn::Period | SendOn::Change | SendOn::Frame => None,
    };
    PortSpec {
        written_bits: written.iter().copied().filter(|var| var.is_bits()).collect(),
        written,
        needed: outputs.iter().flat_map(|frame| &frame.shown).copied().chain(trigger).collect(),
        is_field: port.bus.is_field(),
        is_can: port.bus.is_can(),
        mode: recipe.mode,
        inputs,
        outputs,
        timeout: port.timeout,
        stale_after: port.stale_after,
        stops_when_stale: recipe.on_stale == proto_core::config::OnStale::Stop,
        cycle: port.cycle,
        send: recipe.send,
        idle_gap,
        turnaround,
        framing: match &recipe.parts {
            Parts::Stream { input: Some(part), .. } => part.framing,
            _ => Boundary::Fields,
        },
        exchanges,
        served,
    }
}

/// The recipe links; that of the UDP server comes first.
fn links(config: &GatewayConfig) -> Vec<LinkSpec> {
    let mut links: Vec<LinkSpec> = Vec::new();
    if let Some(own) = config.controller.recipe_link {
        let recipe = &config.recipes[usize::from(own.recipe)];
        links.push(link_spec(config, LinkId::RECIPE_UDP, recipe, true));
    }
    for (nth, port) in config.ports.iter().enumerate() {
        let recipe = &config.recipes[usize::from(port.recipe)];
        let id = LinkId::of_port(PortId(nth as u8));
        match port.bus {
            Bus::TcpListen { .. } => links.push(link_spec(config, id, recipe, false)),
            Bus::UdpListen { .. } => links.push(link_spec(config, id, recipe, true)),
            Bus::Rs485(_) | Bus::Can { .. } | Bus::ModbusTcp { .. } => {}
        }
    }
    links
}

/// The owners of variables.
fn owners(config: &GatewayConfig, ports: &[PortSpec], links: &[LinkSpec]) -> [Option<Owned>; COUNT] {
    let mut owned = [None; COUNT];
    for (nth, port) in ports.iter().enumerate().filter(|(_, port)| port.is_field) {
        for (frame, part) in port.inputs.iter().enumerate() {
            for &var in &part.written {
                let carries = |link: &&LinkSpec| link.input.as_ref().is_some_and(|up| up.has(var));
                let way = links.iter().find(carries).map_or(LinkId::MODBUS, |link| link.id);
                let safe = config.ports[nth].on_timeout.of(&config.safe_values);
                let safe = safe.iter().find(|safe| safe.var == var).map(|safe| {
                    let mut raw = Raw::default();
                    safe.value.encode(&mut raw);
                    raw
                });
                let shows_validity =
                    |field: &FieldSpec| *field == FieldSpec::InputRule(InputRule::ValidTo { var, bit: None });
                let safe = safe.or_else(|| part.fields.iter().any(shows_validity).then(Raw::default));
                owned[var.ordinal()] = Some(Owned { port: nth, frame, way, safe });
            }
        }
    }
    owned
}

/// The outputs that show an input's value at the controller.
fn witnesses(links: &[LinkSpec], origin: &[Option<Origin>; COUNT]) -> [Option<SysVar>; COUNT] {
    let brings = |link: &LinkSpec, var| link.output.as_ref().is_some_and(|down| down.shows(var));
    let mut witness = [None; COUNT];
    for nth in 1..=3 {
        let both = [format!("DigitalOutputCommand[{nth}]"), format!("DigitalSignalStatus[{}]", nth + 3)];
        let [Ok(input), Ok(output)] = both.map(|name| SysVar::parse(&name)) else { continue };
        let is_there = origin[output.ordinal()].is_some() || links.iter().any(|link| brings(link, output));
        witness[input.ordinal()] = is_there.then_some(output);
    }
    witness
}

fn link_spec(config: &GatewayConfig, id: LinkId, recipe: &Recipe, is_datagram: bool) -> LinkSpec {
    let part = |direction| frames(config, recipe, direction).into_iter().next();
    let (input, output) = (part(Direction::Input), part(Direction::Output));
    LinkSpec { id, is_datagram, input, output, reads_back: false, not_after: Duration::ZERO }
}

/// Whether one field frame has all variables of the link's frame, with safe values for all of them or for none.
fn is_one_frame(ports: &[PortSpec], owned: &[Option<Owned>; COUNT], link: &LinkSpec) -> bool {
    let Some(up) = &link.input else { return true };
    ports.iter().enumerate().filter(|(_, port)| port.is_field).any(|(nth, port)| {
        (0..port.inputs.len()).any(|frame| {
            let owners: Vec<_> = up.written.iter().map(|var| owned[var.ordinal()]).collect();
            let brought = owners.iter().all(|o| o.is_some_and(|o| (o.port, o.frame) == (nth, frame)));
            let safe: Vec<bool> = owners.iter().map(|o| o.is_some_and(|o| o.safe.is_some())).collect();
            brought && (safe.iter().all(|safe| *safe) || safe.iter().all(|safe| !safe))
        })
    })
}

/// The shares of all field ports, in the order of their first fields.
fn shares(config: &GatewayConfig, ports: &[PortSpec]) -> Vec<Share> {
    let mut shares: Vec<Share> = Vec::new();
    for (port, spec) in ports.iter().enumerate().filter(|(_, port)| port.is_field) {
        for (frame, part) in spec.inputs.iter().enumerate() {
            for bit in part.fields.iter().filter_map(|field| field.bit()) {
                let own = 1 << bit.bit;
                let is_it =
                    |share: &&mut Share| (share.port, share.frame, share.var) == (port, frame, bit.var);
                match shares.iter_mut().find(is_it) {
                    Some(share) => share.mask |= own,
                    None => shares.push(Share { port, frame, var: bit.var, mask: own, safe: None }),
                }
            }
        }
        let safe = config.ports[port].on_timeout.of(&config.safe_values);
        for share in shares.iter_mut().filter(|share| share.port == port) {
            let of = |safe: &&proto_core::config::SafeValue| !safe.is_whole() && safe.var == share.var;
            let values = safe.iter().filter(of).map(|safe| (safe.mask, safe.value.as_f64() as u8));
            let (mask, on) = values.fold((0, 0), |all, one| (all.0 | one.0, all.1 | one.1));
            share.safe = (mask & share.mask == share.mask).then_some(on & share.mask);
        }
    }
    shares
}
