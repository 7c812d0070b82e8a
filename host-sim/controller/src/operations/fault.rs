//! Faults as operations: of a server, a port, an item or the transitions.

use proto_core::modbus::Exception;
use proto_core::time::Duration;
use serde::{Deserialize, Serialize};

use super::{Refused, refused, time};
use crate::{Controller, Link};

/// A fault and its target.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Fault {
    /// The affected server.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub server: Option<Link>,
    /// Name of the affected recipe port.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub port: Option<String>,
    /// Name of the affected item.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub item: Option<String>,
    /// Additional time of transitions, in seconds.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub transitions: Option<f64>,
    /// What is wrong.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub kind: Option<FaultKind>,
    /// For `delay`.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub seconds: Option<f64>,
    /// For `exception`, 1 to 11.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub code: Option<u8>,
    /// For `cut`.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub bytes: Option<usize>,
    /// For `spoil`: a number, or `nan`, `inf`, `-inf`.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub value: Option<CorruptedValue>,
}

/// The kinds of faults.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename = "Kind", rename_all = "snake_case")]
pub enum FaultKind {
    /// Nothing is sent.
    Mute,
    /// Replies are delayed.
    Delay,
    /// New connections are closed.
    Refuse,
    /// All connections are closed, once.
    Disconnect,
    /// Random bytes are sent instead of the data.
    Garbage,
    /// Every Modbus request is answered with an exception.
    Exception,
    /// The same state packet is repeated.
    Freeze,
    /// One state packet is truncated.
    Cut,
    /// Another number is sent instead of the item's value.
    #[serde(rename = "spoil")]
    Corrupt,
}

impl FaultKind {
    const fn name(self) -> &'static str {
        match self {
            Self::Mute => "mute",
            Self::Delay => "delay",
            Self::Refuse => "refuse",
            Self::Disconnect => "disconnect",
            Self::Garbage => "garbage",
            Self::Exception => "exception",
            Self::Freeze => "freeze",
            Self::Cut => "cut",
            Self::Corrupt => "spoil",
        }
    }
}

/// What is sent instead of an item's value.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(untagged, expecting = "a number, \"nan\", \"inf\" or \"-inf\"")]
pub enum CorruptedValue {
    /// A number.
    Number(f32),
    /// NaN or an infinity.
    No(NoNumber),
}

/// A float that is not a number.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub enum NoNumber {
    /// NaN.
    #[serde(rename = "nan")]
    Nan,
    /// Infinity.
    #[serde(rename = "inf")]
    Inf,
    /// Minus infinity.
    #[serde(rename = "-inf")]
    NegInf,
}

impl CorruptedValue {
    fn value(self) -> f32 {
        match self {
            Self::Number(number) => number,
            Self::No(NoNumber::Nan) => f32::NAN,
            Self::No(NoNumber::Inf) => f32::INFINITY,
            Self::No(NoNumber::NegInf) => f32::NEG_INFINITY,
        }
    }
}

impl Controller {
    pub(super) fn begin_fault(&mut self, fault: &Fault) -> Result<(), Refused> {
        let Fault { server, port, item, transitions, kind, .. } = fault;
        check_arguments(fault)?;
        match (server, port, item, transitions, kind) {
            (Some(server), None, None, None, Some(kind)) => self.begin_server_fault(*server, *kind, fault),
            (None, Some(port), None, None, Some(kind)) => {
                let nth = self.port_index(port)?;
                match kind {
                    FaultKind::Mute => self.mute_port(nth),
                    FaultKind::Disconnect if self.ports.get(nth).is_some_and(|port| port.is_tcp_client()) => {
                        self.close_port(nth);
                    }
                    FaultKind::Disconnect => return refused(format!("{port} is no TCP client: only mute")),
                    _ => return refused(format!("kind: a port can mute or disconnect, not {}", kind.name())),
                }
                Ok(())
            }
            (None, None, Some(item), None, Some(FaultKind::Corrupt)) => {
                let Some(value) = fault.value else { return refused("value is missing") };
                self.corrupt(item, value.value()).map_err(|error| Refused(error.to_string()))
            }
            (None, None, Some(_), None, _) => refused("kind: an item can only spoil"),
            (None, None, None, Some(seconds), None) => {
                self.delay_transitions(time("transitions", *seconds)?);
                Ok(())
            }
            _ => refused(
                "a fault is on one of server, port and item, with its kind, or on transitions with seconds",
            ),
        }
    }

    fn begin_server_fault(&mut self, server: Link, kind: FaultKind, fault: &Fault) -> Result<(), Refused> {
        match (kind, server) {
            (FaultKind::Mute, _) => self.mute(server),
            (FaultKind::Refuse, _) => self.refuse(server),
            (FaultKind::Disconnect, _) => self.disconnect(server),
            (FaultKind::Garbage, _) => self.faults.set_garbage(server, true),
            (FaultKind::Delay, Link::Command | Link::Modbus) => {
                let Some(seconds) = fault.seconds else { return refused("seconds are missing") };
                self.delay_answers(server, time("seconds", seconds)?);
            }
            (FaultKind::Exception, Link::Modbus) => {
                let Some(code) = fault.code else { return refused("code is missing") };
                let Some(exception) = (1..=11).contains(&code).then(|| Exception::from_code(code)) else {
                    return refused(format!("code: {code} is not within 1 to 11"));
                };
                self.answer_modbus_with(Some(exception));
            }
            (FaultKind::Freeze, Link::State) => self.faults.freeze(true),
            (FaultKind::Cut, Link::State) => {
                let Some(bytes) = fault.bytes else { return refused("bytes are missing") };
                self.cut_next_state_packet(bytes);
            }
            _ => return refused(format!("{server} has no fault {}", kind.name())),
        }
        Ok(())
    }

    pub(super) fn heal_some(
        &mut self,
        server: Option<Link>,
        port: Option<&str>,
        item: Option<&str>,
        transitions: bool,
    ) -> Result<(), Refused> {
        let port = port.map(|name| self.port_index(name)).transpose()?;
        if let Some(item) = item {
            self.heal(item).map_err(|error| Refused(error.to_string()))?;
        }
        if let Some(port) = port {
            self.unmute_port(port);
        }
        if let Some(server) = server {
            self.faults.heal_server(server);
        }
        if transitions {
            self.delay_transitions(Duration::ZERO);
        }
        if server.is_none() && port.is_none() && item.is_none() && !transitions {
            self.faults.heal_all();
            self.machine.delay_transitions(Duration::ZERO);
        }
        Ok(())
    }
}

/// Refuses arguments that do not belong to the kind, which would have no effect.
fn check_arguments(fault: &Fault) -> Result<(), Refused> {
    let given = [
        ("seconds", fault.seconds.is_some(), FaultKind::Delay),
        ("code", fault.code.is_some(), FaultKind::Exception),
        ("bytes", fault.bytes.is_some(), FaultKind::Cut),
        ("value", fault.value.is_some(), FaultKind::Corrupt),
    ];
    for (name, is_given, kind) in given {
        if is_given && fault.kind != Some(kind) {
            return refused(format!("{name} belongs to the kind {}", kind.name()));
        }
    }
    Ok(())
}
