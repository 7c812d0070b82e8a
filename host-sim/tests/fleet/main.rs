//! Edge nodes against Debian's mosquitto, read by programs that others wrote (docs/fleet.md).
//!
//! `apt-get install mosquitto mosquitto-clients openssl`, then
//! `HOST_SIM_FIRMWARE=ELF cargo test -p host-sim --test fleet -- --include-ignored`
//!
//! The ELF is the firmware for QEMU (firmware/README.md), which needs Debian's qemu-system-arm. `HOST_SIM_LOAD_SECONDS` is
//! the length of each run under full load (default 3).

mod broker;
mod cell;
mod load;
mod many;
mod on_board;
mod reader;
mod wrong;

// A board in its cell, as the session has it.
#[allow(dead_code, reason = "the session needs more of it")]
#[path = "../session/board.rs"]
mod board;
#[path = "../session/ctl.rs"]
#[allow(dead_code, reason = "the session needs more of it")]
mod ctl;
#[path = "../session/panel.rs"]
mod panel;
#[path = "../session/qemu.rs"]
mod qemu;
#[path = "../session/robot.rs"]
mod robot;
#[allow(dead_code, reason = "the session needs more of it")]
#[path = "../session/target.rs"]
mod target;

// The load of the scenarios.
#[allow(dead_code, reason = "the scenarios need more of it")]
#[path = "../scenarios/field.rs"]
mod field;
#[path = "../scenarios/traffic.rs"]
mod traffic;

pub(crate) use cell::BINARY;
