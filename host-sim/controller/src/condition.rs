//! Conditions of `wait` and of timelines (docs/control.md section 4).

use std::collections::BTreeMap;

use proto_core::modbus::map::{COILS, HOLDING};
use proto_core::modbus::server::RegisterBank;
use serde::{Deserialize, Deserializer, Serialize};
use serde_json::{Map, Value};

use super::Controller;
use super::common::{KINDS, Mode, Number, Refused, snake};

/// A condition to wait for. All given keys must hold.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Condition {
    /// The robot state's name.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub robot: Option<String>,
    /// The program state's name.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub program_state: Option<String>,
    /// The safety state's name.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub safety: Option<String>,
    /// The mode.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub mode: Option<Mode>,
    /// The running or paused program; `Some(None)`: there is none.
    #[serde(skip_serializing_if = "Option::is_none", deserialize_with = "given")]
    pub program: Option<Option<String>>,
    /// The values of items.
    #[serde(skip_serializing_if = "BTreeMap::is_empty")]
    pub items: BTreeMap<String, Number>,
    /// The values of coils, by their address.
    #[serde(skip_serializing_if = "BTreeMap::is_empty")]
    pub coil: BTreeMap<String, Number>,
    /// The values of holding registers, by their address.
    #[serde(skip_serializing_if = "BTreeMap::is_empty")]
    pub register: BTreeMap<String, Number>,
    /// The keys and values of an event that has occurred.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub event: Option<Map<String, Value>>,
}

/// Distinguishes null from an absent value.
fn given<'de, D: Deserializer<'de>>(from: D) -> Result<Option<Option<String>>, D::Error> {
    Option::<String>::deserialize(from).map(Some)
}

impl Condition {
    /// Whether the condition can ever hold. Does not check the names of items, which [`Controller::holds`] knows.
    ///
    /// # Errors
    /// An unknown name or kind.
    pub fn check(&self) -> Result<(), Refused> {
        let known = |key: &str, name: &Option<String>, names: &[&str]| match name {
            Some(name) if !names.contains(&name.as_str()) => {
                Err(Refused(format!("{key}: there is no state {name}; there are {}", names.join(", "))))
            }
            _ => Ok(()),
        };
        known("robot", &self.robot, &ROBOT_STATES)?;
        known("program_state", &self.program_state, &PROGRAM_STATES)?;
        known("safety", &self.safety, &SAFETY_STATES)?;
        for (key, addresses, count) in [("coil", &self.coil, COILS), ("register", &self.register, HOLDING)] {
            for text in addresses.keys() {
                address(key, text, count)?;
            }
        }
        if let Some(event) = &self.event {
            match event.get("event").and_then(Value::as_str) {
                Some(kind) if KINDS.contains(&kind) => {}
                Some(kind) => {
                    let kinds = KINDS.join(", ");
                    return Err(Refused(format!("event: there are no events {kind}; there are {kinds}")));
                }
                None => return Err(Refused("event: its key `event` is missing".to_owned())),
            }
        }
        if *self == Self::default() {
            return Err(Refused("the condition is empty: it names nothing to wait for".to_owned()));
        }
        Ok(())
    }
}

impl Controller {
    /// Whether the condition holds now; an event counts if its number is `since` or later.
    ///
    /// # Errors
    /// As [`Condition::check`], or an item that does not exist.
    pub fn holds(&self, condition: &Condition, since: u64) -> Result<bool, Refused> {
        condition.check()?;
        let is = |name: &Option<String>, now: &str| name.as_ref().is_none_or(|name| *name == snake(now));
        let machine = self.machine();
        let states = is(&condition.robot, machine.robot().name())
            && is(&condition.program_state, machine.program().name())
            && is(&condition.safety, machine.safety().name())
            && condition.mode.is_none_or(|mode| machine.mode() == mode.into())
            && condition.program.as_ref().is_none_or(|program| program.as_deref() == self.program_name());
        if !states {
            return Ok(false);
        }
        for (name, value) in &condition.items {
            if self.item(name).map_err(|error| Refused(error.to_string()))? != value.value() {
                return Ok(false);
            }
        }
        for (text, value) in &condition.coil {
            let mut bits = [0];
            let read = self.registers.read_coils(address("coil", text, COILS)?, 1, &mut bits);
            if read.is_err() || f64::from(bits[0] & 1) != value.value() {
                return Ok(false);
            }
        }
        for (text, value) in &condition.register {
            let mut words = [[0; 2]];
            let read = self.registers.read_holding(address("register", text, HOLDING)?, &mut words);
            if read.is_err() || f64::from(u16::from_be_bytes(words[0])) != value.value() {
                return Ok(false);
            }
        }
        Ok(condition.event.as_ref().is_none_or(|wanted| self.has_occurred(wanted, since)))
    }

    fn has_occurred(&self, wanted: &Map<String, Value>, since: u64) -> bool {
        let kind = wanted.get("event").and_then(Value::as_str);
        let mut events = self.events_since(since).filter(|event| Some(event.what.kind()) == kind);
        events.any(|event| match serde_json::to_value(event) {
            Ok(Value::Object(event)) => {
                wanted.iter().all(|(key, value)| event.get(key).is_some_and(|own| same(own, value)))
            }
            _ => false,
        })
    }
}

/// Whether two values are equal, with or without a fraction.
fn same(own: &Value, wanted: &Value) -> bool {
    match (own.as_f64(), wanted.as_f64()) {
        (Some(own), Some(wanted)) => own == wanted,
        _ => own == wanted,
    }
}

fn address(key: &str, text: &str, count: u16) -> Result<u16, Refused> {
    let last = count - 1;
    let address = text.parse().ok().filter(|address| *address <= last);
    address.ok_or_else(|| Refused(format!("{key}: {text} is no address; allowed: 0..={last}")))
}

const ROBOT_STATES: [&str; 8] =
    ["start", "initialize", "logout", "login", "power_off", "disable", "enable", "update"];
const PROGRAM_STATES: [&str; 6] = ["stopped", "stopping", "running", "paused", "pausing", "task_running"];
const SAFETY_STATES: [&str; 14] = [
    "init",
    "wait",
    "config",
    "power_off",
    "run",
    "recovery",
    "stop2",
    "stop1",
    "stop0",
    "model",
    "reduce",
    "boot",
    "fail",
    "update",
];
