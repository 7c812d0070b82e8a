//! The 1468-byte state packet of port 2001 (docs/wire/state.md).

mod codes;

pub use codes::{OperationMode, ProgramState, RobotState, SafetyState};
