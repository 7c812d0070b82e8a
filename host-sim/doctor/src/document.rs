//! Reads the document `status` of the API: what another gateway reports of itself.
//!
//! In: the document, and the configuration that the gateway runs. Out: a [`State`], as an engine there would report it.
//! The configuration supplies what the document does not have: where a link leads, and the numbers of ports. What
//! neither has is unknown. Ports and links that the configuration does not have are left out.

use std::collections::BTreeMap;

use proto_core::config::{Bus, GatewayConfig, MAX_PORTS};
use proto_core::engine::{
    BusState, Engine, FieldBus, LinkCounters, PeerCounters, PortCounters, PortId, PortState, ReplyCode,
};
use proto_core::link::LinkHistory;
use proto_core::schedule::Presence;
use proto_core::time::{Duration, Instant};
use proto_core::wire::state::{OperationMode, ProgramState, RobotState, SafetyState, States};
use serde::Deserialize;
use serde::de::IntoDeserializer;
use serde::de::value::{Error, StrDeserializer};

use crate::bytes::from_hex;
use crate::state::{FailedCommand, ObservedLink, ObservedPort, OtherText, Peer, Rejected, State, Withheld};

/// The document `status`.
#[derive(Debug, Clone, Deserialize)]
pub struct StatusDocument {
    /// The gateway's clock.
    pub time_us: u64,
    #[serde(default)]
    ports: BTreeMap<String, PortDocument>,
    #[serde(default)]
    links: BTreeMap<String, LinkDocument>,
    controller: Option<ControllerDocument>,
}

#[derive(Debug, Clone, Deserialize)]
struct PortDocument {
    bus_state: Option<String>,
    state: String,
    age_ms: Option<u64>,
    #[serde(default)]
    overdue: usize,
    #[serde(default)]
    reply: String,
    command: Option<String>,
    last_not_given: Option<NotGivenDocument>,
    last_failed: Option<FailedDocument>,
    last_rejection: Option<RejectionDocument>,
    #[serde(default)]
    peers: BTreeMap<String, PeerDocument>,
    #[serde(default)]
    counters: PortCounters,
}

#[derive(Debug, Clone, Deserialize)]
struct NotGivenDocument {
    #[serde(default)]
    why: String,
    text: String,
    #[serde(default)]
    value: i64,
    #[serde(default)]
    age_ms: u64,
}

#[derive(Debug, Clone, Deserialize)]
struct FailedDocument {
    command: String,
    #[serde(default)]
    age_ms: u64,
    controller: Option<ControllerDocument>,
}

#[derive(Debug, Clone, Deserialize)]
struct RejectionDocument {
    why: String,
    #[serde(default)]
    age_ms: u64,
    #[serde(default)]
    len: usize,
    #[serde(default)]
    bytes: String,
}

#[derive(Debug, Clone, Deserialize)]
struct PeerDocument {
    #[serde(default)]
    presence: String,
    #[serde(default)]
    counters: PeerCounters,
}

#[derive(Debug, Clone, Deserialize)]
struct LinkDocument {
    state: String,
    #[serde(default)]
    history: LinkHistory,
    #[serde(default)]
    counters: LinkCounters,
    other_text: Option<OtherTextDocument>,
}

#[derive(Debug, Clone, Deserialize)]
struct OtherTextDocument {
    text: String,
    age_ms: u64,
    command: Option<String>,
}

#[derive(Debug, Clone, Deserialize)]
struct ControllerDocument {
    mode: CodeDocument,
    robot: CodeDocument,
    program: CodeDocument,
    safety: CodeDocument,
}

#[derive(Debug, Clone, Copy, Deserialize)]
struct CodeDocument {
    code: u8,
}

impl StatusDocument {
    /// The counters of each port of the configuration, for its record.
    pub fn counters<'a>(
        &'a self,
        config: &'a GatewayConfig,
    ) -> impl Iterator<Item = (PortId, &'a PortCounters)> {
        let ports = config.view().field_ports();
        ports.filter_map(|(index, port, _)| {
            Some((PortId(index), &self.ports.get(port.name.as_str())?.counters))
        })
    }

    /// The links that are up, and how often each has come up.
    pub fn links_up(&self) -> impl Iterator<Item = (&str, u32)> {
        self.links
            .iter()
            .filter(|(_, link)| link.state == "up")
            .map(|(name, link)| (&**name, link.history.connects))
    }

    /// The reported state. `up_for` returns how long a link has been up, if known.
    pub fn state(
        &self,
        config: &GatewayConfig,
        up_for: impl Fn(&str) -> Duration,
    ) -> Result<State, proto_core::engine::BuildError> {
        let view = config.view();
        let ports = view.field_ports().filter_map(|(index, port, _)| {
            let name = port.name.as_str();
            Some(self.ports.get(name)?.port(PortId(index), name, &port.bus))
        });
        let ports = ports.collect();
        // An engine knows which links a configuration needs, and where they lead.
        let engine = Box::new(Engine::<MAX_PORTS>::new(config)?);
        let links = engine.links().filter_map(|info| {
            let shown = self.links.get(info.name)?;
            let is_up = matches!(shown.state.as_str(), "up" | "shared");
            Some(ObservedLink {
                id: info.id,
                name: info.name.to_owned(),
                kind: info.kind,
                transport: info.endpoint.transport,
                host: info.endpoint.host.to_owned(),
                is_up,
                up_for: if shown.state == "up" { up_for(info.name) } else { Duration::ZERO },
                history: shown.history,
                counters: shown.counters,
                other_text: shown.other_text.as_ref().map(|other| OtherText {
                    text: other.text.clone(),
                    age: Duration::from_millis(other.age_ms),
                    command: other.command.clone(),
                }),
            })
        });
        Ok(State {
            at: Instant::from_micros(self.time_us),
            ports,
            links: links.collect(),
            controller: self.controller.as_ref().map(ControllerDocument::states),
        })
    }
}

impl PortDocument {
    fn port(&self, id: PortId, name: &str, bus: &Bus) -> ObservedPort {
        let bus_state = self.bus_state.as_deref();
        let states = [BusState::Active, BusState::Warning, BusState::Passive, BusState::BusOff];
        let state = states.into_iter().find(|state| Some(state.name()) == bus_state);
        let bus = match bus {
            Bus::Can { .. } => FieldBus::Can { state: state.unwrap_or(BusState::Active) },
            Bus::ModbusTcp { .. } => FieldBus::ModbusTcp,
            Bus::Rs485(_) | Bus::TcpListen { .. } | Bus::UdpListen { .. } => FieldBus::Rs485,
        };
        let states = [PortState::Working, PortState::Silent, PortState::BusOff, PortState::Gone];
        let state = states.into_iter().find(|state| state.name() == self.state);
        let peers = self.peers.iter().filter_map(|(number, peer)| {
            let all = [Presence::Up, Presence::Down];
            let presence = all.into_iter().find(|presence| presence.name() == peer.presence);
            Some(Peer {
                number: number.parse().ok()?,
                presence: presence.unwrap_or(Presence::Unknown),
                counters: peer.counters,
            })
        });
        let mut peers: Vec<_> = peers.collect();
        peers.sort_by_key(|peer| peer.number);
        ObservedPort {
            id,
            name: name.to_owned(),
            bus,
            state: state.unwrap_or(PortState::Working),
            age: self.age_ms.map(Duration::from_millis),
            overdue: self.overdue,
            reply: reply(&self.reply),
            command: self.command.clone(),
            not_given: self.last_not_given.as_ref().map(|last| Withheld {
                why: named(&last.why),
                text: last.text.clone(),
                value: last.value,
                age: Duration::from_millis(last.age_ms),
            }),
            failed: self.last_failed.as_ref().map(|failed| FailedCommand {
                command: failed.command.clone(),
                age: Duration::from_millis(failed.age_ms),
                controller: failed.controller.as_ref().map(ControllerDocument::states),
            }),
            rejection: self.last_rejection.as_ref().and_then(RejectionDocument::rejected),
            counters: self.counters,
            peers,
        }
    }
}

fn reply(name: &str) -> ReplyCode {
    use ReplyCode::{Fail, NoReply, NotSent, Other, Pending, Success};
    let all = [Pending, Success, Fail, Other, NoReply, NotSent];
    all.into_iter().find(|code| code.name() == name).unwrap_or_default()
}

/// The reason with this name; `None` if this program does not know it.
fn named<'de, T: Deserialize<'de>>(name: &'de str) -> Option<T> {
    let name: StrDeserializer<'de, Error> = name.into_deserializer();
    T::deserialize(name).ok()
}

impl RejectionDocument {
    /// `None` if this program does not know the reason.
    fn rejected(&self) -> Option<Rejected> {
        let (why, age) = (named(&self.why)?, Duration::from_millis(self.age_ms));
        Some(Rejected { why, age, len: self.len, bytes: from_hex(&self.bytes)? })
    }
}

impl ControllerDocument {
    fn states(&self) -> States {
        // The codes are those of the newest controller version, whatever version the controller has.
        States {
            mode: OperationMode::from_code(self.mode.code),
            robot: RobotState::from_code(self.robot.code),
            program: ProgramState::from_code(self.program.code),
            safety: SafetyState::from_code(self.safety.code),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_reply_is_read_back() {
        use ReplyCode::{Fail, NoReply, NotSent, Other, Pending, Success};
        for code in [ReplyCode::None, Pending, Success, Fail, Other, NoReply, NotSent] {
            assert_eq!(reply(code.name()), code);
        }
    }
}
