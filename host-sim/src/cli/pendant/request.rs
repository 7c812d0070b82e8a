//! The commands of `pendant`, and the request that each makes.

use std::path::PathBuf;
use std::time::Duration;

use clap::{Args, Subcommand, ValueEnum};
use serde_json::{Map, Value, json};

use super::bare;
use super::condition::{self, number};
use crate::cli::run::parse_time;

/// A command.
#[derive(Debug, Subcommand)]
pub(in crate::cli) enum Act {
    /// Show the state of the robot, its programs, ports and faults
    State {
        /// Repeat until Ctrl-C, every 500ms or at this interval, such as --watch=2s
        #[arg(long, value_name = "TIME", num_args = 0..=1, require_equals = true,
            default_missing_value = "500ms", value_parser = parse_time)]
        watch: Option<Duration>,
    },
    /// Show the values of items, such as DI[3] DO[1] FloatInputReg[2] BitInputReg[3].4
    Get {
        /// Names of items
        #[arg(required = true)]
        items: Vec<String>,
    },
    /// Set inputs, tool inputs, tool buttons and registers; if one is wrong, none is set
    Set {
        /// NAME=VALUE, such as DI[3]=1, DI[4]=off, AI_V[2]=3.5
        #[arg(required = true, value_name = "NAME=VALUE")]
        items: Vec<String>,
    },
    /// Turn the key switch to a mode
    Mode {
        /// The mode
        mode: ModeName,
    },
    /// Press the emergency stop
    EmergencyStop,
    /// Open a safety door (protective stop)
    ProtectiveStop,
    /// Make the arm collide, which pauses the program
    Collide {
        /// Where: joint 1 to 6; base sensor 11 to 16 (X, Y, Z, Rx, Ry, Rz); end sensor 20
        axis: u8,
    },
    /// Release the stop and acknowledge it; the robot stays disabled
    Clear,
    /// Make the safety controller stop monitoring the robot, which ends the program, or resume
    Hold {
        /// The safety state to hold
        safety: HoldName,
    },
    /// Enter or leave the zone of reduced speed
    Reduced {
        /// Whether somebody is in the zone
        on: Switch,
    },
    /// Raise an error; the state stream and getlasterror show it
    RaiseError {
        /// Error number, such as 4098 or 0x1002
        #[arg(value_parser = parse_code)]
        code: u32,
        /// Error text
        #[arg(default_value = "")]
        text: String,
    },
    /// Acknowledge the error
    ClearError,
    /// Switch the drives' power on; returns at once, see `wait`
    PowerOn,
    /// Switch the drives' power off
    PowerOff,
    /// Enable the robot
    Enable,
    /// Disable the robot
    Disable,
    /// Start a program, also in manual mode
    Run {
        /// Name of the program
        program: String,
        /// Speed in percent, above 0 and at most 100
        #[arg(long, value_name = "PERCENT")]
        speed: Option<f32>,
    },
    /// Stop the program
    Stop,
    /// Pause the program
    Pause,
    /// Resume the program
    Resume,
    /// Add or replace a program
    Upload {
        /// File with the script
        file: PathBuf,
        /// Name of the program [default: that of the file]
        #[arg(long)]
        name: Option<String>,
    },
    /// Remove a program
    Remove {
        /// Name of the program
        program: String,
    },
    /// List the programs
    Programs,
    /// Assign a recipe of the controller file to a port
    Recipe {
        /// Name of the port
        port: String,
        /// Name of the recipe; without it, the port gets none
        recipe: Option<String>,
    },
    /// Set the cycle time of a port
    Cycle {
        /// Name of the port
        port: String,
        /// Cycle time in milliseconds, at least 4
        ms: f64,
    },
    /// Switch the controller off and on again
    Restart {
        /// Set all registers to 0 instead of to the file's values
        #[arg(long)]
        cleared: bool,
    },
    /// Inject a fault, which lasts until `heal`
    Fault {
        /// What it is on
        #[command(subcommand)]
        on: FaultOn,
    },
    /// End all faults, or those of a server, a port or an item
    Heal {
        /// What they are on
        #[command(subcommand)]
        on: Option<HealOn>,
    },
    /// Advance the clock of --time stepped, and wait until it is there
    Advance {
        /// Number of seconds
        seconds: f64,
    },
    /// Wait until all conditions hold, such as robot=enable program=none DO[1]=1 coil:192=1 register:5=17
    /// event=program_ended event.program=pick.jspf
    Wait {
        /// robot, program-state, safety, mode, program, an item, coil:ADDRESS, register:ADDRESS, event or
        /// event.KEY, each with =VALUE
        #[arg(required = true, value_name = "KEY=VALUE")]
        until: Vec<String>,
        /// Fail after this many seconds of the controller's clock
        #[arg(long, value_name = "SECONDS", default_value_t = 5.0)]
        timeout: f64,
    },
    /// Show recorded events, or follow new ones
    Events {
        /// First event number to show
        #[arg(long, value_name = "N", default_value_t = 0)]
        since: u64,
        /// Only these kinds, separated by commas, such as command,reply
        #[arg(long, value_name = "KINDS", value_delimiter = ',')]
        kind: Vec<String>,
        /// Number of events at most
        #[arg(long, value_name = "N", default_value_t = 1_000)]
        max: usize,
        /// Show each new event, until Ctrl-C
        #[arg(long, short, conflicts_with_all = ["since", "max"])]
        follow: bool,
    },
    /// Show the counters of the servers and ports
    Counters,
    /// Send a request in JSON (docs/control.md), such as '{"do": "state"}'
    Do {
        /// The JSON object
        request: String,
    },
}

/// What the safety controller does in place of watching.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub(in crate::cli) enum HoldName {
    /// SS_WAIT
    Wait,
    /// SS_CONFIG: its parameters are being changed
    Config,
    /// SS_MODEL
    Model,
    /// SS_UPDATE: its firmware is being updated
    Update,
    /// SS_FAIL: it has failed
    Fail,
    /// It monitors the robot again
    None,
}

impl HoldName {
    fn state(self) -> Option<&'static str> {
        match self {
            Self::Wait => Some("wait"),
            Self::Config => Some("config"),
            Self::Model => Some("model"),
            Self::Update => Some("update"),
            Self::Fail => Some("fail"),
            Self::None => None,
        }
    }
}

#[derive(Debug, Clone, Copy, ValueEnum)]
pub(in crate::cli) enum ModeName {
    Manual,
    Auto,
    Remote,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub(in crate::cli) enum Switch {
    On,
    Off,
}

#[derive(Debug, Subcommand)]
pub(in crate::cli) enum FaultOn {
    /// Inject a fault at the command port, 2000
    Command(ServerFault),
    /// Inject a fault at the state stream, port 2001
    State(ServerFault),
    /// Inject a fault at the Modbus server
    Modbus(ServerFault),
    /// Silence a recipe port, or disconnect it once if it is a TCP client
    Port {
        /// Name of the port
        name: String,
        /// The fault
        kind: PortFault,
    },
    /// Send another number instead of an item's value
    Item {
        /// Name of the item, such as RobotState[8]
        name: String,
        /// What to send: a number, nan, inf or -inf
        #[arg(allow_hyphen_values = true)]
        value: String,
    },
    /// Make power, enable, stop and pause take longer
    Transitions {
        /// By this many seconds
        seconds: f64,
    },
}

#[derive(Debug, Args)]
pub(in crate::cli) struct ServerFault {
    /// The fault
    kind: ServerKind,
    /// For delay: seconds; for exception: its code, 1 to 11; for cut: number of bytes
    value: Option<f64>,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub(in crate::cli) enum ServerKind {
    /// Executes requests, but does not answer
    Mute,
    /// Answers late (command, modbus)
    Delay,
    /// Closes each new connection at once
    Refuse,
    /// Closes all connections, once
    Disconnect,
    /// Sends random bytes instead of answers or packets
    Garbage,
    /// Answers each request with this exception (modbus)
    Exception,
    /// Sends the same packet again and again (state)
    Freeze,
    /// Sends the first bytes of a packet, then closes; once (state)
    Cut,
}

#[derive(Debug, Clone, Copy, ValueEnum)]
pub(in crate::cli) enum PortFault {
    Mute,
    Disconnect,
}

#[derive(Debug, Subcommand)]
pub(in crate::cli) enum HealOn {
    /// End the faults at the command port
    Command,
    /// End the faults at the state stream
    State,
    /// End the faults at the Modbus server
    Modbus,
    /// End the faults at a recipe port
    Port {
        /// Name of the port
        name: String,
    },
    /// End the fault of an item
    Item {
        /// Name of the item
        name: String,
    },
    /// End the delay of power, enable, stop and pause
    Transitions,
}

impl Act {
    /// The request.
    ///
    /// # Errors
    /// What is wrong with an argument.
    pub(super) fn request(&self) -> Result<Value, String> {
        Ok(match self {
            Self::State { .. } => bare("state"),
            Self::Get { items } => json!({ "do": "get", "items": items }),
            Self::Set { items } => json!({ "do": "set", "items": pairs(items)? }),
            Self::Mode { mode } => json!({ "do": "mode", "mode": name_of(mode) }),
            Self::EmergencyStop => bare("emergency_stop"),
            Self::ProtectiveStop => bare("protective_stop"),
            Self::Collide { axis } => json!({ "do": "collide", "axis": axis }),
            Self::Clear => bare("clear"),
            Self::Hold { safety } => json!({ "do": "hold", "safety": safety.state() }),
            Self::Reduced { on } => json!({ "do": "reduced", "on": *on == Switch::On }),
            Self::RaiseError { code, text } => json!({ "do": "raise_error", "code": code, "text": text }),
            Self::ClearError => bare("clear_error"),
            Self::PowerOn => bare("power_on"),
            Self::PowerOff => bare("power_off"),
            Self::Enable => bare("enable"),
            Self::Disable => bare("disable"),
            Self::Run { program, speed: None } => json!({ "do": "run", "program": program }),
            Self::Run { program, speed } => {
                json!({ "do": "run", "program": program, "speed_percent": speed })
            }
            Self::Stop => bare("stop"),
            Self::Pause => bare("pause"),
            Self::Resume => bare("resume"),
            Self::Upload { file, name } => {
                let script = std::fs::read_to_string(file);
                let script = script.map_err(|error| format!("{}: {error}", file.display()))?;
                let own = file.file_name().map(|name| name.to_string_lossy().into_owned());
                json!({ "do": "upload", "program": name.clone().or(own), "script": script })
            }
            Self::Remove { program } => json!({ "do": "remove", "program": program }),
            Self::Programs => bare("programs"),
            Self::Recipe { port, recipe } => json!({ "do": "recipe", "port": port, "recipe": recipe }),
            Self::Cycle { port, ms } => json!({ "do": "cycle", "port": port, "ms": ms }),
            Self::Restart { cleared } => {
                json!({ "do": "restart", "registers": if *cleared { "cleared" } else { "initial" } })
            }
            Self::Fault { on } => on.request()?,
            Self::Heal { on } => HealOn::request(on.as_ref()),
            Self::Advance { seconds } => json!({ "do": "advance", "seconds": seconds }),
            Self::Wait { until, timeout } => {
                json!({ "do": "wait", "until": condition::parse(until)?, "timeout_s": timeout })
            }
            Self::Events { kind, follow: true, .. } => json!({ "do": "follow", "kinds": kind }),
            Self::Events { since, kind, max, .. } => {
                json!({ "do": "events", "since": since, "kinds": kind, "max": max })
            }
            Self::Counters => bare("counters"),
            Self::Do { request } => match serde_json::from_str(request) {
                Ok(request @ Value::Object(_)) => request,
                _ => {
                    return Err(format!("{request:?} is not a JSON object, such as '{{\"do\": \"state\"}}'"));
                }
            },
        })
    }
}

impl FaultOn {
    fn request(&self) -> Result<Value, String> {
        Ok(match self {
            Self::Command(fault) => fault.request("command")?,
            Self::State(fault) => fault.request("state")?,
            Self::Modbus(fault) => fault.request("modbus")?,
            Self::Port { name, kind } => json!({ "do": "fault", "port": name, "kind": name_of(kind) }),
            Self::Item { name, value } => {
                let value = match value.as_str() {
                    "nan" | "inf" | "-inf" => json!(value),
                    _ => number(value).map_err(|_| format!("{value:?} is not a number, nan, inf or -inf"))?,
                };
                json!({ "do": "fault", "item": name, "kind": "spoil", "value": value })
            }
            Self::Transitions { seconds } => json!({ "do": "fault", "transitions": seconds }),
        })
    }
}

impl ServerFault {
    fn request(&self, server: &str) -> Result<Value, String> {
        let mut request = json!({ "do": "fault", "server": server, "kind": name_of(&self.kind) });
        let argument = match self.kind {
            ServerKind::Delay => Some(("seconds", "seconds")),
            ServerKind::Exception => Some(("code", "a code, 1 to 11")),
            ServerKind::Cut => Some(("bytes", "a number of bytes")),
            _ => None,
        };
        match (argument, self.value) {
            (Some(("seconds", _)), Some(value)) => request["seconds"] = json!(value),
            (Some((key, what)), Some(value)) => {
                if value.fract() != 0.0 || !(0.0..1e9).contains(&value) {
                    return Err(format!("{value} is not {what}"));
                }
                request[key] = json!(value as u64);
            }
            (Some((_, what)), None) => return Err(format!("{} needs {what}", name_of(&self.kind))),
            (None, Some(value)) => return Err(format!("{} takes no number: {value}", name_of(&self.kind))),
            (None, None) => {}
        }
        Ok(request)
    }
}

impl HealOn {
    fn request(on: Option<&Self>) -> Value {
        match on {
            None => bare("heal"),
            Some(Self::Command) => json!({ "do": "heal", "server": "command" }),
            Some(Self::State) => json!({ "do": "heal", "server": "state" }),
            Some(Self::Modbus) => json!({ "do": "heal", "server": "modbus" }),
            Some(Self::Port { name }) => json!({ "do": "heal", "port": name }),
            Some(Self::Item { name }) => json!({ "do": "heal", "item": name }),
            Some(Self::Transitions) => json!({ "do": "heal", "transitions": true }),
        }
    }
}

fn name_of(value: &impl ValueEnum) -> String {
    value.to_possible_value().map_or_else(String::new, |value| value.get_name().to_owned())
}

fn pairs(words: &[String]) -> Result<Value, String> {
    let mut items = Map::new();
    for word in words {
        let Some((name, value)) = word.split_once('=') else {
            return Err(format!("{word:?}: no '='; write NAME=VALUE, such as DI[3]=1"));
        };
        items.insert(name.to_owned(), number(value).map_err(|error| format!("{name}: {error}"))?);
    }
    Ok(Value::Object(items))
}

fn parse_code(text: &str) -> Result<u32, String> {
    let number = match text.strip_prefix("0x") {
        Some(digits) => u32::from_str_radix(digits, 16),
        None => text.parse(),
    };
    number.map_err(|_| format!("{text:?} is not a number, such as 4098 or 0x1002"))
}

#[cfg(test)]
#[path = "request_tests.rs"]
mod tests;
