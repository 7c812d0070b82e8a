//! Operations at run time (docs/control.md section 2): effects on the controller by a person at the pendant, a broken
//! cable, or a test.
//!
//! In: an [`Operation`], as JSON by serde. Out: its result as JSON, or why it was refused; a refused operation has
//! changed nothing. Does not know where the operation came from.

mod execute;
mod fault;

use std::collections::BTreeMap;

use proto_core::time::Duration;
use serde::{Deserialize, Serialize};
use serde_json::{Map, Value};

use super::common::{KINDS, Link};
pub use super::common::{Mode, Number, Refused};
use super::condition::Condition;
use super::machine::SafetyHold;
pub use fault::{CorruptedValue, Fault, FaultKind, NoNumber};

/// An operation. In JSON its name is the value of `do`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(tag = "do", rename_all = "snake_case", deny_unknown_fields)]
#[non_exhaustive]
pub enum Operation {
    /// The state (docs/control.md section 3).
    State {},
    /// The values of these items.
    Get {
        /// Their names.
        items: Vec<String>,
    },
    /// The counters of `--stats`.
    Counters {},
    /// The programs' names.
    Programs {},
    /// The kept events.
    Events {
        /// Starting with this number.
        #[serde(default)]
        since: u64,
        /// Only these kinds; empty: all.
        #[serde(default)]
        kinds: Vec<String>,
        /// Maximum number.
        #[serde(default = "default_max")]
        max: usize,
    },
    /// Reports each event from now on. [`Controller::operate`](crate::Controller::operate) refuses this: the caller
    /// follows.
    Follow {
        /// Only these kinds; empty: all.
        #[serde(default)]
        kinds: Vec<String>,
    },
    /// Sets all of these items, or none.
    Set {
        /// Name and value of each.
        items: BTreeMap<String, Number>,
    },
    /// Turns the key switch.
    Mode {
        /// The mode.
        mode: Mode,
    },
    /// Presses the emergency stop.
    EmergencyStop {},
    /// Opens a safety door.
    ProtectiveStop {},
    /// Makes the arm collide.
    Collide {
        /// The joint, 1 to 6; 11 to 16: an axis of the base's force sensor; 20: the end's force sensor.
        axis: u8,
    },
    /// Releases and acknowledges a stop.
    Clear {},
    /// Makes the safety controller stop or resume monitoring the robot.
    Hold {
        /// Why it does not monitor; `None`: it does.
        safety: Option<SafetyHold>,
    },
    /// A person enters or leaves a zone of reduced speed.
    Reduced {
        /// Whether a person is in the zone.
        on: bool,
    },
    /// Shows an error.
    RaiseError {
        /// Its number; not 0.
        code: u32,
        /// Its text.
        #[serde(default)]
        text: String,
    },
    /// Acknowledges the shown error.
    ClearError {},
    /// Presses the pendant's button.
    PowerOn {},
    /// Presses the pendant's button.
    PowerOff {},
    /// Presses the pendant's button.
    Enable {},
    /// Presses the pendant's button.
    Disable {},
    /// Starts a program.
    Run {
        /// Its name.
        program: String,
        /// The speed; the present speed if absent.
        #[serde(default, skip_serializing_if = "Option::is_none")]
        speed_percent: Option<f32>,
    },
    /// Stops the program.
    Stop {},
    /// Pauses the program.
    Pause {},
    /// Resumes the program.
    Resume {},
    /// Adds or replaces a program.
    Upload {
        /// Its name.
        program: String,
        /// Its text.
        script: String,
    },
    /// Removes a program.
    Remove {
        /// Its name.
        program: String,
    },
    /// Assigns a recipe to a port.
    Recipe {
        /// The port's name.
        port: String,
        /// The recipe's name; `None` for no recipe.
        recipe: Option<String>,
    },
    /// Sets a port's cycle.
    Cycle {
        /// The port's name.
        port: String,
        /// Milliseconds, at least 4.
        ms: f64,
    },
    /// Switches the controller off and on.
    Restart {
        /// The registers after it.
        #[serde(default)]
        registers: AfterRestart,
    },
    /// Begins a fault.
    Fault(Fault),
    /// Ends all faults, or those on this server, port or item.
    Heal {
        /// The server.
        #[serde(default, skip_serializing_if = "Option::is_none")]
        server: Option<Link>,
        /// The port's name.
        #[serde(default, skip_serializing_if = "Option::is_none")]
        port: Option<String>,
        /// The item's name.
        #[serde(default, skip_serializing_if = "Option::is_none")]
        item: Option<String>,
        /// Whether to end the longer transitions.
        #[serde(default, skip_serializing_if = "std::ops::Not::not")]
        transitions: bool,
    },
    /// Moves a stepped clock. [`Controller::operate`](crate::Controller::operate) refuses this: the clock is the
    /// caller's.
    Advance {
        /// Number of seconds.
        seconds: f64,
    },
    /// Waits. [`Controller::operate`](crate::Controller::operate) refuses this: the clock is the caller's.
    Wait {
        /// The condition to wait for.
        until: Condition,
        /// Timeout in seconds.
        #[serde(default = "default_timeout")]
        timeout_s: f64,
    },
}

/// The registers after a restart.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum AfterRestart {
    /// The file's initial values.
    #[default]
    Initial,
    /// 0.
    Cleared,
}

type Done = Result<Value, Refused>;

fn refused<T>(why: impl Into<String>) -> Result<T, Refused> {
    Err(Refused(why.into()))
}

impl Operation {
    /// Parses a JSON object whose `do` is the operation's name.
    ///
    /// # Errors
    /// [`Refused`]: what is wrong, and what is allowed.
    pub fn from_json(object: Map<String, Value>) -> Result<Self, Refused> {
        if !object.contains_key("do") {
            return refused("`do` is missing: it names the operation, such as \"state\"");
        }
        Self::deserialize(Value::Object(object)).map_err(|error| Refused(error.to_string()))
    }

    /// Whether the operation only reads or waits.
    pub const fn is_reading(&self) -> bool {
        matches!(
            self,
            Self::State {}
                | Self::Get { .. }
                | Self::Counters {}
                | Self::Programs {}
                | Self::Events { .. }
                | Self::Follow { .. }
                | Self::Advance { .. }
                | Self::Wait { .. }
        )
    }
}

/// Checks that all kinds exist.
///
/// # Errors
/// The first unknown kind, and the known ones.
pub fn check_kinds(kinds: &[String]) -> Result<(), Refused> {
    match kinds.iter().find(|kind| !KINDS.contains(&kind.as_str())) {
        Some(wrong) => refused(format!("kinds: there are no events {wrong}; there are {}", KINDS.join(", "))),
        None => Ok(()),
    }
}

/// The time in seconds of the key `name`.
///
/// # Errors
/// The time is not within 0 to a day.
pub fn time(name: &str, seconds: f64) -> Result<Duration, Refused> {
    if !(0.0..=MAX_SECONDS).contains(&seconds) {
        return refused(format!("{name}: {seconds} is not within 0 to {MAX_SECONDS}"));
    }
    Ok(Duration::from_micros((seconds * 1e6).round() as u64))
}

/// Maximum time of a wait, a delay or a step.
const MAX_SECONDS: f64 = 86_400.0;

const fn default_max() -> usize {
    1_000
}

const fn default_timeout() -> f64 {
    5.0
}
