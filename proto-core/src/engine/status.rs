//! A snapshot of a running gateway, from which statistics, log lines, the status LED, an API and metrics are made.
//!
//! In: the engine, at one instant. Out: ports, links, variables, the controller's states, latency. It is a view: making
//! it costs a few pointers, and each part is computed on request. Unknown values are absent, never 0. Does not know how
//! it is shown.

use core::fmt;

use super::counters::PortCounters;
use super::field::bindings::InputBind;
use super::field::codec::Codec;
use super::field::health::PortsHealth;
use super::field::peer_counters::PeerCounters;
use super::field::port::FieldPort;
use super::field::rules::allowed;
use super::field::texts::TextBind;
use super::field::turns::PeerState;
use super::io::{BusState, LinkKind, PortId, PortState, ReplyCode};
use super::latency::Latency;
use super::link::dropped::DroppedCommand;
use super::link::failed::FailedCommand;
use super::link::links::{LinkInfo, LinksView};
use super::link::state::ControllerStatus;
use super::rejection::{LastRejection, RejectedField};
use super::values::bits::Bits;
use super::values::store::InputFrame;
use crate::config::{CommandText, Span};
use crate::image::{GroupId, Image};
use crate::link::LinkState;
use crate::schedule::Presence;
use crate::sysvar::{Direction, SysVar, VarBit};
use crate::time::{Duration, Instant};
use crate::wire::scalar::Scalar;

/// State and counters of a gateway at one instant; made by [`super::Engine::status`].
#[derive(Debug, Clone, Copy)]
pub struct Status<'a> {
    pub(super) at: Instant,
    pub(super) ports: &'a [FieldPort],
    pub(super) frames: &'a [InputFrame],
    pub(super) health: &'a PortsHealth,
    pub(super) image: &'a Image,
    /// The input bindings of all ports.
    pub(super) inputs: &'a [InputBind],
    pub(super) bits: &'a Bits,
    pub(super) links: LinksView<'a>,
    pub(super) latency: &'a Latency,
    pub(super) sleeps: u32,
    pub(super) peers: &'a [PeerState],
}

/// The bus of a field port.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
#[non_exhaustive]
pub enum FieldBus {
    /// A serial line.
    Rs485,
    /// A Modbus TCP connection.
    ModbusTcp,
    /// A CAN bus.
    Can {
        /// The CAN controller's error state.
        state: BusState,
    },
}

/// The gateway's condition for an indicator such as an LED, the worst first.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
#[non_exhaustive]
pub enum Health {
    /// There is no configuration, or it was refused: nothing runs.
    Idle,
    /// A link that the configuration needs is not up.
    NoController,
    /// All links are up; a field port is silent, gone or bus-off.
    PortSilent,
    /// Everything works.
    Running,
}

impl Health {
    /// One word, as in the documents of the API and in Sparkplug.
    pub const fn name(self) -> &'static str {
        match self {
            Self::Idle => "idle",
            Self::NoController => "no-controller",
            Self::PortSilent => "port-silent",
            Self::Running => "running",
        }
    }
}

/// State of a field port.
#[derive(Debug, Clone, Copy)]
#[non_exhaustive]
pub struct PortStatus<'a> {
    /// The port.
    pub id: PortId,
    /// Its name in the configuration.
    pub name: &'a str,
    /// Its bus.
    pub bus: FieldBus,
    /// Index of its recipe in the configuration.
    pub recipe: u8,
    /// Its health.
    pub state: PortState,
    /// Age of the newest accepted frame; for a CAN recipe, of any id. `None` before the first.
    pub age: Option<Duration>,
    /// Number of its input frames that are overdue or have never arrived.
    pub overdue: usize,
    /// Result of the newest command that its values picked.
    pub reply: ReplyCode,
    /// The newest command that its values picked, such as `run(pick.jspf)`.
    pub command: Option<CommandText<'a>>,
    /// The newest value that gave no command, and why.
    pub last_dropped: Option<&'a DroppedCommand>,
    /// The newest of its commands that the controller answered with a failure.
    pub last_failed: Option<FailedCommand<'a>>,
    /// The newest rejection. A CAN frame with an unknown id replaces no other rejection: on a shared bus it is for
    /// another node.
    pub last_rejection: Option<&'a LastRejection>,
    /// The rejected field, if `last_rejection` is that of a device frame's field.
    pub rejected_field: Option<RejectedField>,
    /// Counters since the start.
    pub counters: &'a PortCounters,
    peers: &'a [PeerState],
    /// The instant of the snapshot, for ages.
    #[cfg(feature = "serde")]
    pub(super) at: Instant,
}

/// A slave or other peer of a port's exchanges.
#[derive(Debug, Clone, Copy)]
#[non_exhaustive]
pub struct PeerStatus {
    /// Its address, or its number in the configuration; on Modbus, 0 stands for all slaves.
    pub number: u8,
    /// Whether it answers; [`Presence::Unknown`] if it is never asked for a reply.
    pub presence: Presence,
    /// Periods missed while it was not down, because the line was overloaded.
    pub missed_periods: u32,
    /// Counters since the start.
    pub counters: PeerCounters,
}

impl<'a> PortStatus<'a> {
    /// The same status without its peers, of which there may be dozens, for documents that are written in pieces.
    pub fn without_peers(self) -> Self {
        Self { peers: &[], ..self }
    }

    /// The peers of the port's exchanges.
    pub fn peers(&self) -> impl Iterator<Item = PeerStatus> + use<'a> {
        self.peers.iter().map(|peer| PeerStatus {
            number: peer.number,
            presence: peer.presence(),
            missed_periods: peer.missed(),
            counters: peer.counters,
        })
    }
}

/// A known variable and its value.
#[derive(Debug, Clone, Copy, PartialEq)]
#[non_exhaustive]
pub struct VariableStatus<'a> {
    /// The variable.
    pub var: SysVar,
    /// Its value.
    pub value: Scalar,
    /// Time since it was received.
    pub age: Duration,
    /// The field port that owns an input variable; `None` for a value from the controller.
    pub owner: Option<&'a str>,
    /// The bit that value and owner belong to, if the bits of the variable have owners.
    pub bit: Option<u8>,
}

impl VariableStatus<'_> {
    /// The name of the variable or bit.
    pub fn name(&self) -> impl fmt::Display + use<> {
        let &Self { var, bit, .. } = self;
        Name { var, bit }
    }
}

struct Name {
    var: SysVar,
    bit: Option<u8>,
}

impl fmt::Display for Name {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self.bit {
            Some(bit) => VarBit { var: self.var, bit }.fmt(f),
            None => self.var.fmt(f),
        }
    }
}

impl<'a> Status<'a> {
    /// The instant of the snapshot.
    pub fn at(&self) -> Instant {
        self.at
    }

    /// The field ports, in configuration order.
    pub fn ports(self) -> impl Iterator<Item = PortStatus<'a>> {
        self.ports.iter().enumerate().map(move |(index, port)| self.port(index, port))
    }

    /// The links that the configuration needs.
    pub fn links(self) -> impl Iterator<Item = LinkInfo<'a>> {
        self.links.infos().map(move |link| LinkInfo {
            #[cfg(feature = "serde")]
            at: self.at,
            ..link
        })
    }

    /// The known variables, in the order of the table; then the known bits with owners.
    pub fn variables(self) -> impl Iterator<Item = VariableStatus<'a>> {
        self.whole_variables().chain(self.bits())
    }

    /// The known bits with owners.
    pub fn bits(self) -> impl Iterator<Item = VariableStatus<'a>> {
        self.bits.shares().iter().flat_map(move |share| {
            let at = self.image.stamp_of(share.group());
            let owner = self.ports.get(usize::from(share.port)).map(|port| port.name.as_str());
            let value = self.image.byte(share.var);
            (0..8).filter_map(move |bit| {
                let mask = 1_u8.checked_shl(bit.into()).filter(|mask| share.mask & mask != 0)?;
                Some(VariableStatus {
                    var: share.var,
                    value: Scalar::Byte(u8::from(value & mask != 0)),
                    age: self.at.saturating_since(at?),
                    owner,
                    bit: Some(bit),
                })
            })
        })
    }

    fn whole_variables(self) -> impl Iterator<Item = VariableStatus<'a>> {
        SysVar::all().filter_map(move |var| self.variable(var))
    }

    /// A variable as a whole; `None` if it is unknown or unreadable.
    pub fn variable(self, var: SysVar) -> Option<VariableStatus<'a>> {
        let age = self.image.age(var, self.at)?;
        self.image.is_readable(var).then(|| VariableStatus {
            var,
            value: self.image.value(var),
            age,
            owner: self.owner(var),
            bit: None,
        })
    }

    /// Mode and states of the controller; `None` without a state link or before its first packet.
    pub fn controller(&self) -> Option<ControllerStatus> {
        let link = self.links.state?;
        let at = self.image.stamp_of(link.group)?;
        let states = link.dialect.states(link.codes);
        Some(ControllerStatus { states, age: self.at.saturating_since(at) })
    }

    /// The gateway's present condition.
    pub fn health(&self) -> Health {
        // Another link carries the traffic of a shared one.
        let is_up = |link: LinkInfo<'_>| matches!(link.state, LinkState::Up { .. } | LinkState::Shared);
        let is_controllers = |link: &LinkInfo<'_>| !matches!(link.kind, LinkKind::ModbusDevice { .. });
        if self.ports.is_empty() && self.links().next().is_none() {
            Health::Idle
        } else if !self.links().filter(is_controllers).all(is_up) {
            Health::NoController
        } else if !self.ports().all(|port| port.state == PortState::Working) {
            Health::PortSilent
        } else {
            Health::Running
        }
    }

    /// The latencies since the start.
    pub fn latency(&self) -> &'a Latency {
        self.latency
    }

    /// How often the gateway itself slept; see [`super::Engine::sleeps`].
    pub fn sleeps(&self) -> u32 {
        self.sleeps
    }

    /// The field port that owns an input variable.
    fn owner(&self, var: SysVar) -> Option<&'a str> {
        if var.direction() != Direction::Input || self.bits.bytes.contains(var) {
            return None;
        }
        let frame = self.frames.iter().find(|frame| frame.set.contains(var) || self.has_field(frame, var));
        let port = frame.map(|frame| frame.port).or_else(|| self.health.owner(var))?;
        self.ports.get(usize::from(port)).map(|port| port.name.as_str())
    }

    /// Whether a field of the frame writes this variable, which left the frame because the field was rejected.
    fn has_field(&self, frame: &InputFrame, var: SysVar) -> bool {
        if !self.image.withheld().contains(var) {
            return false;
        }
        let is_written =
            frame.bindings.of(self.inputs).iter().any(|binding| binding.to.variable() == Some(var));
        let texts = self.texts(usize::from(frame.port));
        is_written
            || texts.iter().any(|text| text.is_in(frame.bindings) && text.variables().any(|own| own == var))
    }

    /// The texts of a port's frames.
    fn texts(&self, port: usize) -> &'a [TextBind] {
        match self.ports.get(port).map(|port| &port.codec) {
            Some(Codec::Device(device)) => &device.texts,
            _ => &[],
        }
    }

    /// The rejected field of a port's rejection, if it was one.
    fn rejected(&self, port: usize, last: &LastRejection) -> Option<RejectedField> {
        let rejected = last.field?;
        let own = self.frames.iter().filter(|frame| usize::from(frame.port) == port);
        let place = |span: Span| rejected.binding.checked_sub(span.start).filter(|&nth| nth < span.len);
        let (frame, field) = (0..).zip(own).find_map(|(nth, frame)| Some((nth, place(frame.bindings)?)))?;
        let (var, allowed) = allowed(self.inputs.get(usize::from(rejected.binding))?, self.inputs);
        let of_text = self.texts(port).iter().find(|text| text.is_input(rejected.binding));
        let var = var.or_else(|| of_text.and_then(|text| text.variables().next()));
        let value = (!rejected.value.is_nan()).then_some(rejected.value);
        Some(RejectedField { frame, field: field as u8, var, value, allowed })
    }

    fn last_failed(&self, port: PortId) -> Option<FailedCommand<'a>> {
        let link = self.links.command?;
        let failed = link.failed.of(port)?;
        let command = link.text(failed.entry, failed.value)?;
        let state = self.links.state;
        let controller = state.and_then(|link| failed.states(&link.dialect));
        Some(FailedCommand { at: failed.at, command, controller })
    }

    fn port(&self, index: usize, port: &'a FieldPort) -> PortStatus<'a> {
        let (mut heard_at, mut overdue) = (None, 0_usize);
        for (group, frame) in (0..).zip(self.frames).filter(|(_, frame)| usize::from(frame.port) == index) {
            heard_at = heard_at.max(self.image.stamp_of(GroupId(group)));
            overdue = overdue.saturating_add(usize::from(frame.is_overdue()));
        }
        let peers = port.line().map_or(&[][..], |line| line.peers.of(self.peers));
        let is_can = match &port.codec {
            Codec::Stream { .. } => false,
            Codec::Can { .. } => true,
            Codec::Device(device) => device.reader.is_none(),
        };
        let bus = match port.line() {
            _ if is_can => FieldBus::Can { state: port.bus },
            Some(line) if line.transactions.is_some() => FieldBus::ModbusTcp,
            _ => FieldBus::Rs485,
        };
        PortStatus {
            id: port.id,
            name: &port.name,
            bus,
            recipe: port.recipe,
            state: port.state(overdue > 0 || peers.iter().any(PeerState::is_away)),
            age: heard_at.map(|at| self.at.saturating_since(at)),
            overdue,
            reply: port.reply,
            command: self.links.command.and_then(|link| link.newest_of(port.id)),
            last_dropped: self.links.command.and_then(|link| link.dropped_by(port.id)),
            last_failed: self.last_failed(port.id),
            last_rejection: port.last_rejection.as_ref(),
            rejected_field: port.last_rejection.as_ref().and_then(|last| self.rejected(index, last)),
            counters: &port.counters,
            peers,
            #[cfg(feature = "serde")]
            at: self.at,
        }
    }
}
