//! The state of a gateway, taken from an engine or read from documents of the API.

use proto_core::engine::{
    DropReason, FieldBus, LinkCounters, LinkId, LinkKind, PeerCounters, PortCounters, PortId, PortState,
    Rejection, ReplyCode, Status, Transport,
};
use proto_core::link::{LinkHistory, LinkState};
use proto_core::schedule::Presence;
use proto_core::time::{Duration, Instant};
use proto_core::wire::state::States;

/// State and counters of a gateway at one instant.
#[derive(Debug, Clone)]
pub struct State {
    pub(crate) at: Instant,
    pub(crate) ports: Vec<ObservedPort>,
    pub(crate) links: Vec<ObservedLink>,
    /// The controller's states in the newest state packet.
    pub(crate) controller: Option<States>,
}

#[derive(Debug, Clone)]
pub(crate) struct ObservedPort {
    pub(crate) id: PortId,
    pub(crate) name: String,
    pub(crate) bus: FieldBus,
    pub(crate) state: PortState,
    pub(crate) age: Option<Duration>,
    /// Number of input frames that are overdue or have never arrived.
    pub(crate) overdue: usize,
    pub(crate) reply: ReplyCode,
    /// The newest command that a value picked, such as `run(pick.jspf)`.
    pub(crate) command: Option<String>,
    pub(crate) not_given: Option<Withheld>,
    pub(crate) failed: Option<FailedCommand>,
    pub(crate) rejection: Option<Rejected>,
    pub(crate) counters: PortCounters,
    pub(crate) peers: Vec<Peer>,
}

/// A value that gave no command.
#[derive(Debug, Clone)]
pub(crate) struct Withheld {
    /// The reason, if this program knows it.
    pub(crate) why: Option<DropReason>,
    pub(crate) text: String,
    pub(crate) value: i64,
    pub(crate) age: Duration,
}

/// A command whose reply was a failure.
#[derive(Debug, Clone)]
pub(crate) struct FailedCommand {
    pub(crate) command: String,
    /// Time since the reply.
    pub(crate) age: Duration,
    pub(crate) controller: Option<States>,
}

/// The newest rejection of a port.
#[derive(Debug, Clone)]
pub(crate) struct Rejected {
    pub(crate) why: Rejection,
    pub(crate) age: Duration,
    /// Length of the rejected data.
    pub(crate) len: usize,
    /// The first rejected bytes.
    pub(crate) bytes: Vec<u8>,
}

/// A slave or another peer of a port's exchanges.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Peer {
    pub(crate) number: u8,
    pub(crate) presence: Presence,
    pub(crate) counters: PeerCounters,
}

#[derive(Debug, Clone)]
pub(crate) struct ObservedLink {
    pub(crate) id: LinkId,
    pub(crate) name: String,
    pub(crate) kind: LinkKind,
    pub(crate) transport: Transport,
    pub(crate) host: String,
    pub(crate) is_up: bool,
    /// How long the link has been up, if known.
    pub(crate) up_for: Duration,
    pub(crate) history: LinkHistory,
    pub(crate) counters: LinkCounters,
    /// The newest text of the command port that was not the reply to a command.
    pub(crate) other_text: Option<OtherText>,
}

/// A text that was not the reply to a command.
#[derive(Debug, Clone)]
pub(crate) struct OtherText {
    pub(crate) text: String,
    pub(crate) age: Duration,
    /// The unanswered command that the text may be the reply to.
    pub(crate) command: Option<String>,
}

impl From<Status<'_>> for State {
    fn from(status: Status<'_>) -> Self {
        let at = status.at();
        let ports = status.ports().map(|port| ObservedPort {
            id: port.id,
            name: port.name.to_owned(),
            bus: port.bus,
            state: port.state,
            age: port.age,
            overdue: port.overdue,
            reply: port.reply,
            command: port.command.map(|command| command.to_string()),
            not_given: port.last_dropped.map(|last| Withheld {
                why: Some(last.why),
                text: last.why.text().to_owned(),
                value: last.value,
                age: at.saturating_since(last.at),
            }),
            failed: port.last_failed.map(|failed| FailedCommand {
                command: failed.command.to_string(),
                age: at.saturating_since(failed.at),
                controller: failed.controller.map(|controller| controller.states),
            }),
            rejection: port.last_rejection.map(|last| Rejected {
                why: last.why,
                age: Duration::from_millis(at.saturating_since(last.at).as_millis()),
                len: last.len,
                bytes: last.bytes().to_vec(),
            }),
            counters: *port.counters,
            peers: port
                .peers()
                .map(|peer| Peer { number: peer.number, presence: peer.presence, counters: peer.counters })
                .collect(),
        });
        let links = status.links().map(|link| ObservedLink {
            id: link.id,
            name: link.name.to_owned(),
            kind: link.kind,
            transport: link.endpoint.transport,
            host: link.endpoint.host.to_owned(),
            is_up: matches!(link.state, LinkState::Up { .. } | LinkState::Shared),
            up_for: match link.state {
                LinkState::Up { since } => at.saturating_since(since),
                _ => Duration::ZERO,
            },
            history: *link.history,
            counters: *link.counters,
            other_text: link.other_text.map(|other| OtherText {
                text: other.text.to_owned(),
                age: at.saturating_since(other.at),
                command: other.command.map(|command| command.to_string()),
            }),
        });
        Self {
            at,
            ports: ports.collect(),
            links: links.collect(),
            controller: status.controller().map(|controller| controller.states),
        }
    }
}
