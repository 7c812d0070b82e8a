//! Shared by operations, conditions, events and faults. Does not know any of these.

use proto_core::wire::state::OperationMode;
use serde::{Deserialize, Serialize};
use serde_json::{Value, json};

/// One of the controller's TCP servers.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Link {
    /// Port 2000.
    Command,
    /// Port 2001.
    State,
    /// Modbus.
    Modbus,
}

impl std::fmt::Display for Link {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(match self {
            Self::Command => "command",
            Self::State => "state",
            Self::Modbus => "modbus",
        })
    }
}

/// The value of an item: a number, or a bit as a bool.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(untagged, expecting = "a number, true or false")]
pub enum Number {
    /// A bit.
    Bit(bool),
    /// A number.
    Number(f64),
}

impl Number {
    /// The value as a number.
    pub fn value(self) -> f64 {
        match self {
            Self::Bit(on) => f64::from(u8::from(on)),
            Self::Number(number) => number,
        }
    }
}

/// The operation mode.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Mode {
    /// Operated from the pendant.
    Manual,
    /// Programs started on the pendant.
    Auto,
    /// Commands from port 2000.
    Remote,
}

impl From<Mode> for OperationMode {
    fn from(mode: Mode) -> Self {
        match mode {
            Mode::Manual => Self::Manual,
            Mode::Auto => Self::Auto,
            Mode::Remote => Self::Remote,
        }
    }
}

/// Why an operation was refused: one line. Nothing has changed.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Refused(pub String);

impl std::fmt::Display for Refused {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(&self.0)
    }
}

impl std::error::Error for Refused {}

/// All kinds of events.
pub const KINDS: [&str; 18] = [
    "started",
    "connected",
    "disconnected",
    "command",
    "reply",
    "robot",
    "program_state",
    "safety",
    "mode",
    "speed",
    "program_started",
    "program_ended",
    "log",
    "error",
    "error_cleared",
    "write",
    "operation",
    "refused",
];

/// `PowerOff` as `power_off`.
pub(super) fn snake(name: &str) -> String {
    let mut text = String::new();
    for (nth, letter) in name.chars().enumerate() {
        if letter.is_ascii_uppercase() && nth > 0 {
            text.push('_');
        }
        text.push(letter.to_ascii_lowercase());
    }
    text
}

/// A number as JSON, without a fraction if it is whole, as registers and bits are.
pub(super) fn number(value: f64) -> Value {
    let is_whole = value.fract() == 0.0 && value.abs() < 9e15;
    if is_whole { json!(value as i64) } else { json!(value) }
}
