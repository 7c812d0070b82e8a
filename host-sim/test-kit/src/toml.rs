//! Configurations that several tests use, and functions that read them.

use proto_core::config::GatewayConfig;
use recipe_config::SimConfig;
use recipe_config::file::{FileError, Text, parse_controller, parse_gateway};

/// The gateway configuration in this text.
///
/// # Panics
/// If the text has a mistake; the message names the first one.
#[track_caller]
pub fn gateway(toml: &str) -> Box<GatewayConfig> {
    right(parse_gateway(Text { name: "gateway.toml", toml }, &[]))
}

/// The controller configuration in this text.
///
/// # Panics
/// If the text has a mistake; the message names the first one.
#[track_caller]
pub fn controller(toml: &str) -> SimConfig {
    right(parse_controller(Text { name: "controller.toml", toml }, &[]))
}

#[track_caller]
fn right<T>(read: Result<T, FileError>) -> T {
    read.unwrap_or_else(|error| panic!("{error}"))
}

/// A gateway with one field port, `device`, for a panel that sends `FF FF order outputs EE EE`. A changed
/// order sends one of `commands`, such as `1 = "stop"`. The outputs are DO1 to DO8; if the panel is silent
/// for `timeout_ms`, only DO8 is on.
pub fn panel(commands: &str, timeout_ms: u32) -> String {
    format!(
        r#"
[controller]
address = "127.0.0.1"

[[recipe]]
name = "panel"
kind = "stream"
mode = "user"
[recipe.input]
head = [255, 255]
tail = [238, 238]
fields = [
    {{ name = "order", type = "byte", commands = {{ {commands} }} }},
    {{ name = "outputs", type = "byte", to = "DigitalOutputCommand[1]" }},
]

[[port]]
name = "device"
bus = "rs485"
recipe = "panel"
timeout_ms = {timeout_ms}
on_timeout = {{ "DigitalOutputCommand[1]" = 128 }}
"#
    )
}

/// Pieces of configuration files, valid and harmful ones. Inputs of a fuzzer refer to them by index: add new
/// ones at the end.
pub const PIECES: [&str; 74] = [
    "[",
    "]",
    "[[",
    "{",
    "}",
    "=",
    ",",
    "\n",
    "\"",
    "'''",
    "0",
    "-1",
    "1e308",
    "nan",
    "inf",
    "0x1FFFFFFF",
    "99999999999999999999",
    "true",
    "é",
    "\u{0}",
    "..",
    "RobotState[1..32]",
    "ForceEnd[1]",
    "__RobotState_8",
    "head = [1]",
    "fields = []",
    "[[port]]\n",
    "[[recipe]]\n",
    "\"rising:BitOutputReg[3].7\"",
    "1979-05-27",
    "name = \"\"",
    "\"a\\nb\" = 1",
    "name = \"a\\nb\"",
    "type = \"double\"",
    "extended = true",
    "value = 1.5",
    "{ 1 = \"stop\" }",
    "bus = \"can\"",
    "mode = \"user\"",
    "cycle_ms = 5",
    "baud = 9600",
    "\u{7F}",
    "\u{85}",
    "on_timeout = { \"DI[1]\" = 1 }",
    "to = \"WordInputReg[1]\"",
    "from = \"counter\"",
    "send = \"frame\"",
    "#",
    "endian = \"big\"",
    "word_order = \"low-first\"",
    "checksum = { kind = \"crc16-modbus\" }",
    "over = \"1..\"",
    "at = 4",
    "bits = \"4..7\"",
    "bits = 3",
    "equals = 9",
    "{ pad = 3 }",
    "{ text = \"ST,\" }",
    "overflow = \"wrap\"",
    "type = \"decimal\"",
    "until = \",\"",
    "width = 4",
    "[[recipe.exchange]]\n",
    "[[recipe.block]]\n",
    "kind = \"modbus-rtu\"",
    "bus = \"modbus-rtu-slave\"",
    "slave = 0",
    "function = 23",
    "address = 0xFFFF",
    "read = [{ pad = 3 }]",
    "write = [{ name = \"x\", value = 1 }]",
    "on = [\"start\", \"change\"]",
    "every_ms = 1",
    "reply = { fields = [] }",
];
