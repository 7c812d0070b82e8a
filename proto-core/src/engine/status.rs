//! One snapshot of everything that a person or a program asks about a running gateway: statistics, log
//! lines, the status LED, an API and metrics are all made from it.
//!
//! In: the engine, at one instant. Out: ports, links, variables, the controller's
//! states, latency. It is a view: making it costs a few pointers, and each part is worked out when asked.
//! What is unknown is absent, never 0.

use super::counters::PortCounters;
use super::field_port::{Codec, FieldPort};
use super::io::{BusState, PortId, PortState, ReplyCode};
use super::latency::Latency;
use super::links::{LinkInfo, LinksView};
use super::rejection::LastRejection;
use super::store::InputFrame;
use crate::image::{GroupId, Image};
use crate::link::LinkState;
use crate::sysvar::{Direction, SysVar};
use crate::time::{Duration, Instant};
use crate::wire::scalar::Scalar;
use crate::wire::state::States;

/// What a gateway is and did, at one instant. [`super::Engine::status`] makes it.
#[derive(Debug, Clone, Copy)]
pub struct Status<'a> {
    pub(super) at: Instant,
    pub(super) ports: &'a [FieldPort],
    pub(super) frames: &'a [InputFrame],
    pub(super) image: &'a Image,
    pub(super) links: LinksView<'a>,
    pub(super) latency: &'a Latency,
    pub(super) sleeps: u32,
}

/// The bus of a field port.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
#[non_exhaustive]
pub enum FieldBus {
    /// A serial line.
    Rs485,
    /// A CAN bus.
    Can {
        /// The CAN controller's error state.
        state: BusState,
    },
}

/// What a person who sees only a lamp has to know, the worst first.
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

/// State of a field port.
#[derive(Debug, Clone, Copy)]
#[non_exhaustive]
pub struct PortStatus<'a> {
    /// The port.
    pub id: PortId,
    /// Its name in the configuration.
    pub name: &'a str,
    /// What it is.
    pub bus: FieldBus,
    /// Its recipe's place in the configuration.
    pub recipe: u8,
    /// Whether it works.
    pub state: PortState,
    /// How old the newest accepted frame is; of a CAN recipe, that of the id heard last. `None` before
    /// the first.
    pub age: Option<Duration>,
    /// How many of its input frames are overdue or have never come.
    pub overdue: usize,
    /// The outcome of the newest command that one of its values picked.
    pub reply: ReplyCode,
    /// The text of that command, such as `run(pick.jspf)`.
    pub command: Option<&'a str>,
    /// The newest frame or bytes that were rejected.
    pub last_rejection: Option<&'a LastRejection>,
    /// What happened since the start.
    pub counters: &'a PortCounters,
}

/// The value of a variable that is known.
#[derive(Debug, Clone, Copy, PartialEq)]
#[non_exhaustive]
pub struct VariableStatus<'a> {
    /// The variable.
    pub var: SysVar,
    /// Its value.
    pub value: Scalar,
    /// Time since it was received.
    pub age: Duration,
    /// The field port whose recipe sends an input variable; `None` for what the controller shows.
    pub owner: Option<&'a str>,
}

/// What the controller said of itself in the newest state packet.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[non_exhaustive]
pub struct ControllerStatus {
    /// Mode, and robot, program and safety state.
    pub states: States,
    /// Time since that packet.
    pub age: Duration,
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
        self.links.infos()
    }

    /// The variables whose value is known, in the order of the table.
    pub fn variables(self) -> impl Iterator<Item = VariableStatus<'a>> {
        SysVar::all().filter_map(move |var| {
            let age = self.image.age(var, self.at)?;
            self.image.is_readable(var).then(|| VariableStatus {
                var,
                value: self.image.value(var),
                age,
                owner: self.owner(var),
            })
        })
    }

    /// Mode and states of the controller; `None` without a state link or before its first packet.
    pub fn controller(&self) -> Option<ControllerStatus> {
        let link = self.links.state?;
        let at = self.image.stamp_of(link.group)?;
        let states = States::from_codes(link.codes, &link.dialect);
        Some(ControllerStatus { states, age: self.at.saturating_since(at) })
    }

    /// The worst of everything.
    pub fn health(&self) -> Health {
        // Another link does the work of one that is shared.
        let is_up = |link: LinkInfo<'_>| matches!(link.state, LinkState::Up { .. } | LinkState::Shared);
        if self.ports.is_empty() && self.links().next().is_none() {
            Health::Idle
        } else if !self.links().all(is_up) {
            Health::NoController
        } else if !self.ports().all(|port| port.state == PortState::Working) {
            Health::PortSilent
        } else {
            Health::Running
        }
    }

    /// How long things took since the start.
    pub fn latency(&self) -> &'a Latency {
        self.latency
    }

    /// Times the gateway itself slept; see [`super::Engine::sleeps`].
    pub fn sleeps(&self) -> u32 {
        self.sleeps
    }

    /// The field port that sends an input variable.
    fn owner(&self, var: SysVar) -> Option<&'a str> {
        if var.direction() != Direction::Input {
            return None;
        }
        let frame = self.frames.iter().find(|frame| frame.set.contains(var))?;
        self.ports.get(usize::from(frame.port)).map(|port| port.name.as_str())
    }

    fn port(&self, index: usize, port: &'a FieldPort) -> PortStatus<'a> {
        let own = |frame: &&InputFrame| usize::from(frame.port) == index;
        let groups = (0..).zip(self.frames).filter(|(_, frame)| own(frame)).map(|(group, _)| group);
        let heard_at = groups.filter_map(|group| self.image.stamp_of(GroupId(group))).max();
        let overdue = self.frames.iter().filter(own).filter(|frame| frame.overdue_at == Instant::NEVER);
        let bus = match port.codec {
            Codec::Stream { .. } => FieldBus::Rs485,
            Codec::Can { .. } => FieldBus::Can { state: port.bus },
        };
        PortStatus {
            id: port.id,
            name: &port.name,
            bus,
            recipe: port.recipe,
            state: port.state(self.frames.iter().filter(own)),
            age: heard_at.map(|at| self.at.saturating_since(at)),
            overdue: overdue.count(),
            reply: port.reply,
            command: self.links.command.and_then(|link| link.newest_of(port.id)),
            last_rejection: port.last_rejection.as_ref(),
            counters: &port.counters,
        }
    }
}
