//! The program as users and scripts run it.

mod capturing;
mod cells;
mod checking;
mod command_line;
mod control;
mod exporting;
mod modbus_tcp;
mod output;
mod processes;
mod rejections;
mod service;
mod soak;

use recipe_test_kit::Binary;

const BINARY: Binary = Binary(env!("CARGO_BIN_EXE_host-sim"));
