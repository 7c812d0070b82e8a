#![doc = include_str!("../README.md")]
//!
//! # The parts
//!
//! In: TOML text and `--set` overrides. Out: [`SimConfig`] for the simulated controller, or
//! `proto_core::config::GatewayConfig` for the gateway. Nothing here opens a device or a socket.

mod advice;
pub mod board;
mod device;
pub mod file;
mod functions;
pub mod keys;
mod schema;
mod sim;
mod since;
mod target;

pub use advice::{negative_numbers, orders_before_values};
pub use device::{
    AnyRecipe, DeviceField, DeviceRecipe, ExchangeKind, FieldCommands, FrameEnds, NamedExchange, NamedFrame,
};
pub use file::function_name;
pub use functions::{
    FUNCTION_INPUTS, FUNCTION_OUTPUTS, Function, FunctionInput, FunctionOutput, Functions, ShownState,
};
pub use schema::{FileKind, schema};
pub use sim::{
    CommandClients, Initial, Listen, Power, Robot, RobotMode, SimBus, SimCanFrame, SimConfig, SimField,
    SimParts, SimPort, SimProgram, SimRecipe, SimStreamPart,
};
pub use since::changes_since_0_2;
pub use target::{AnalogInput, BitGroup, InitialTarget, TargetError};

/// The example of README.md is a test.
#[cfg(doctest)]
#[doc = include_str!("../README.md")]
struct Readme;
