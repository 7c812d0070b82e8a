//! Serializes a [`Status`] as an object, for statistics, an API and a metrics page.
//!
//! ```text
//! { "time_us", "sleeps",
//!   "ports": { NAME: { "bus", "bus_state"?, "recipe", "state", "age_ms"?, "overdue", "reply",
//!                      "command"?, "last_not_given"?, "last_failed"?,
//!                      "last_rejection"?: { "why", "text", "age_ms", "can_id"?, "len", "bytes",
//!                                           "field"?: { "frame", "field", "to"?, "value"?, "allowed"? } },
//!                      "peers"?: { NUMBER: { "presence", "missed_periods", "counters" } },
//!                      "counters" } },
//!   "links": { NAME: { "kind", "state", "history", "other_text"?, "counters" } },
//!   "controller"?: { "mode", "robot", "program", "safety", "age_ms" },
//!   "values": { VARIABLE: { "value", "age_ms", "owner"? } },
//!   "latency" }
//! ```
//!
//! Unknown values are absent. Ages are in milliseconds, times in microseconds.

use core::fmt;

use serde::ser::{Serialize, SerializeMap, Serializer};

use super::link::dropped::DroppedCommand;
use super::link::failed::FailedCommand;
use super::link::links::LinkInfo;
use super::link::other_text::OtherText;
use super::link::state::ControllerStatus;
use super::rejection::{LastRejection, RejectedField};
use super::status::{FieldBus, PeerStatus, PortStatus, Status, VariableStatus};
use crate::time::Instant;
use crate::wire::scalar::Scalar;

/// A map whose entries come from an iterator.
struct Map<F>(F);

impl<K: Serialize, V: Serialize, I: Iterator<Item = (K, V)>, F: Fn() -> I> Serialize for Map<F> {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        let mut map = serializer.serialize_map(None)?;
        for (key, value) in (self.0)() {
            map.serialize_entry(&key, &value)?;
        }
        map.end()
    }
}

/// A value as its displayed text.
struct AsText<T>(T);

impl<T: fmt::Display> Serialize for AsText<T> {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        serializer.collect_str(&self.0)
    }
}

/// Bytes in hexadecimal, such as `48 AA`.
struct Hex<'a>(&'a [u8]);

impl fmt::Display for Hex<'_> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        for (nth, byte) in self.0.iter().enumerate() {
            let space = if nth == 0 { "" } else { " " };
            write!(f, "{space}{byte:02X}")?;
        }
        Ok(())
    }
}

/// A field's number: whole numbers as integers, others in 32 bits, because the code for 64 bits is much longer on a
/// board.
struct Number(f64);

impl Serialize for Number {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        let whole = self.0 as i64;
        if whole as f64 == self.0 {
            serializer.serialize_i64(whole)
        } else {
            serializer.serialize_f32(self.0 as f32)
        }
    }
}

struct Field(RejectedField);

impl Serialize for Field {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        let Self(field) = self;
        let mut map = serializer.serialize_map(None)?;
        map.serialize_entry("frame", &field.frame)?;
        map.serialize_entry("field", &field.field)?;
        if let Some(var) = field.var {
            map.serialize_entry("to", &AsText(var))?;
        }
        if let Some(value) = field.value.filter(|value| value.is_finite()) {
            map.serialize_entry("value", &Number(value))?;
        }
        if let Some((low, high)) = field.allowed {
            map.serialize_entry("allowed", &(Number(low), Number(high)))?;
        }
        map.end()
    }
}

/// A rejection and its field, with the instant of the status.
struct Rejected<'a>(&'a LastRejection, Option<RejectedField>, Instant);

impl Serialize for Rejected<'_> {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        let &Self(rejection, field, at) = self;
        let mut map = serializer.serialize_map(None)?;
        map.serialize_entry("why", &rejection.why)?;
        map.serialize_entry("text", rejection.why.text())?;
        map.serialize_entry("age_ms", &at.saturating_since(rejection.at).as_millis())?;
        if let Some(id) = rejection.can_id {
            map.serialize_entry("can_id", &AsText(id))?;
        }
        map.serialize_entry("len", &rejection.len)?;
        if let Some(field) = field {
            map.serialize_entry("field", &Field(field))?;
        }
        map.serialize_entry("bytes", &AsText(Hex(rejection.bytes())))?;
        map.end()
    }
}

impl Serialize for Status<'_> {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        let mut map = serializer.serialize_map(None)?;
        map.serialize_entry("time_us", &self.at().as_micros())?;
        map.serialize_entry("sleeps", &self.sleeps())?;
        map.serialize_entry("ports", &Map(|| self.ports().map(|port| (port.name, port))))?;
        map.serialize_entry("links", &Map(|| self.links().map(|link| (link.name, link))))?;
        if let Some(controller) = self.controller() {
            map.serialize_entry("controller", &controller)?;
        }
        map.serialize_entry("values", &Map(|| self.variables().map(|known| (AsText(known.name()), known))))?;
        map.serialize_entry("latency", self.latency())?;
        map.end()
    }
}

/// A part of a status, with the instant of the status.
struct At<T>(T, Instant);

impl Serialize for PortStatus<'_> {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        let (port, at) = (self, self.at);
        let mut map = serializer.serialize_map(None)?;
        match port.bus {
            FieldBus::Rs485 => map.serialize_entry("bus", "rs485")?,
            FieldBus::ModbusTcp => map.serialize_entry("bus", "modbus-tcp")?,
            FieldBus::Can { state } => {
                map.serialize_entry("bus", "can")?;
                map.serialize_entry("bus_state", state.name())?;
            }
        }
        map.serialize_entry("recipe", &port.recipe)?;
        map.serialize_entry("state", port.state.name())?;
        if let Some(age) = port.age {
            map.serialize_entry("age_ms", &age.as_millis())?;
        }
        map.serialize_entry("overdue", &port.overdue)?;
        map.serialize_entry("reply", port.reply.name())?;
        if let Some(command) = port.command {
            map.serialize_entry("command", &AsText(command))?;
        }
        if let Some(last) = port.last_dropped {
            map.serialize_entry("last_not_given", &At(last, at))?;
        }
        if let Some(failed) = &port.last_failed {
            map.serialize_entry("last_failed", &At(failed, at))?;
        }
        if let Some(rejection) = port.last_rejection {
            map.serialize_entry("last_rejection", &Rejected(rejection, port.rejected_field, at))?;
        }
        if port.peers().next().is_some() {
            map.serialize_entry("peers", &Map(|| port.peers().map(|peer| (peer.number, peer))))?;
        }
        map.serialize_entry("counters", port.counters)?;
        map.end()
    }
}

impl Serialize for PeerStatus {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        let mut map = serializer.serialize_map(None)?;
        map.serialize_entry("presence", self.presence.name())?;
        map.serialize_entry("missed_periods", &self.missed_periods)?;
        map.serialize_entry("counters", &self.counters)?;
        map.end()
    }
}

impl Serialize for At<&DroppedCommand> {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        let &Self(last, at) = self;
        let mut map = serializer.serialize_map(None)?;
        map.serialize_entry("why", &last.why)?;
        map.serialize_entry("text", last.why.text())?;
        map.serialize_entry("age_ms", &at.saturating_since(last.at).as_millis())?;
        map.serialize_entry("frame", &last.frame)?;
        map.serialize_entry("field", &last.field)?;
        map.serialize_entry("value", &last.value)?;
        map.end()
    }
}

impl Serialize for At<&FailedCommand<'_>> {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        let &Self(failed, at) = self;
        let mut map = serializer.serialize_map(None)?;
        map.serialize_entry("command", &AsText(failed.command))?;
        map.serialize_entry("age_ms", &at.saturating_since(failed.at).as_millis())?;
        if let Some(controller) = &failed.controller {
            map.serialize_entry("controller", controller)?;
        }
        map.end()
    }
}

impl Serialize for LinkInfo<'_> {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        let mut map = serializer.serialize_map(None)?;
        map.serialize_entry("kind", self.kind.name())?;
        map.serialize_entry("state", self.state.name())?;
        map.serialize_entry("history", self.history)?;
        if let Some(other) = &self.other_text {
            map.serialize_entry("other_text", &At(other, self.at))?;
        }
        map.serialize_entry("counters", self.counters)?;
        map.end()
    }
}

impl Serialize for At<&OtherText<'_>> {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        let &Self(other, at) = self;
        let mut map = serializer.serialize_map(None)?;
        map.serialize_entry("text", other.text)?;
        map.serialize_entry("age_ms", &at.saturating_since(other.at).as_millis())?;
        if let Some(command) = other.command {
            map.serialize_entry("command", &AsText(command))?;
        }
        map.end()
    }
}

impl Serialize for ControllerStatus {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        let states = [
            ("mode", (self.states.mode.code(), self.states.mode.name())),
            ("robot", (self.states.robot.code(), self.states.robot.name())),
            ("program", (self.states.program.code(), self.states.program.name())),
            ("safety", (self.states.safety.code(), self.states.safety.name())),
        ];
        let mut map = serializer.serialize_map(None)?;
        for (key, (code, name)) in states {
            map.serialize_entry(key, &State { code, name })?;
        }
        map.serialize_entry("age_ms", &self.age.as_millis())?;
        map.end()
    }
}

/// One of the controller's states.
#[derive(serde::Serialize)]
struct State {
    code: u8,
    name: &'static str,
}

impl Serialize for VariableStatus<'_> {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        let mut map = serializer.serialize_map(None)?;
        match self.value {
            Scalar::Float(value) => map.serialize_entry("value", &value)?,
            value => map.serialize_entry("value", &(value.as_f64() as i64))?,
        }
        map.serialize_entry("age_ms", &self.age.as_millis())?;
        if let Some(owner) = self.owner {
            map.serialize_entry("owner", owner)?;
        }
        map.end()
    }
}
