//! Builds the initial state from a configuration.

use proto_core::wire::dialect::Dialect;
use proto_core::wire::state::OperationMode;

use super::motion::{self, Arm};
use super::ports::RecipeError;
use super::program::ScriptError;
use super::registers::Registers;
use recipe_config::{Function, Functions, InitialTarget, RobotMode, SimConfig};

/// Why a configuration is refused.
#[derive(Debug, Clone, PartialEq, Eq)]
#[non_exhaustive]
pub enum BuildError {
    /// There is no dialect of this name.
    Dialect(String),
    /// The port cannot carry its recipe.
    Port {
        /// The port's name.
        port: String,
        /// The reason.
        error: RecipeError,
    },
    /// More than one port is the UDP server.
    SecondUdpServer {
        /// The second one's name.
        port: String,
    },
    /// A program does not compile.
    Program {
        /// Its name.
        program: String,
        /// The reason.
        error: ScriptError,
    },
    /// A function has an item or a program that it cannot have.
    Function {
        /// The item, or `start`.
        item: String,
        /// The reason.
        reason: String,
    },
    /// An initial value is out of range.
    Initial {
        /// The target.
        target: InitialTarget,
        /// The reason.
        reason: String,
    },
}

impl std::fmt::Display for BuildError {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            Self::Dialect(name) => {
                write!(f, "there is no dialect {name}; there are {}", Dialect::NAMES.join(", "))
            }
            Self::Port { port, error } => write!(f, "port {port}: {error}"),
            Self::SecondUdpServer { port } => {
                write!(f, "port {port}: another port is the UDP server already")
            }
            Self::Program { program, error } => write!(f, "program {program}: {error}"),
            Self::Function { item, reason } => write!(f, "functions: {item}: {reason}"),
            Self::Initial { target, reason } => write!(f, "{target}: {reason}"),
        }
    }
}

impl std::error::Error for BuildError {}

/// The registers and the arm with the configuration's initial values.
pub(super) fn start_values(config: &SimConfig) -> Result<(Registers, Arm), BuildError> {
    let mut registers = Registers::default();
    for output in &config.functions.outputs {
        registers.show_state(output.item, false);
    }
    let mut joints = motion::HOME;
    let mut pose = [None; 6];
    for initial in &config.initial {
        registers
            .force(initial.target, initial.value)
            .map_err(|error| BuildError::Initial { target: initial.target, reason: error.to_string() })?;
        let InitialTarget::Var(var) = initial.target else { continue };
        if var.group() != "RobotState" {
            continue;
        }
        match usize::from(var.index()) {
            nth @ 1..=6 if initial.value.abs() <= motion::JOINT_RANGE_RAD => joints[nth - 1] = initial.value,
            1..=6 => {
                let reason = format!("a joint position is within ±{:.4} rad", motion::JOINT_RANGE_RAD);
                return Err(BuildError::Initial { target: initial.target, reason });
            }
            nth @ 8..=13 => pose[nth - 8] = Some(initial.value),
            _ => {}
        }
    }
    // An input that is on at the start has no rising edge.
    registers.take_risen();
    let mut arm = Arm::at(joints);
    arm.calibrate(pose, &registers.tool());
    Ok((registers, arm))
}

/// Checks the functions, which the file's reader has already checked.
pub(super) fn check_functions(config: &SimConfig) -> Result<(), BuildError> {
    let Functions { inputs, outputs, start } = &config.functions;
    let wrong = |item: &dyn std::fmt::Display, reason: &str| {
        Err(BuildError::Function { item: item.to_string(), reason: reason.to_owned() })
    };
    if let Some(input) = inputs.iter().find(|input| !input.item.triggers_functions()) {
        return wrong(&input.item, "it cannot trigger a function");
    }
    if let Some(output) = outputs.iter().find(|output| !output.item.shows_states()) {
        return wrong(&output.item, "it cannot show a state");
    }
    let starts = inputs.iter().any(|input| input.function == Function::Start);
    match start {
        None if starts => wrong(&"start", "no program to start"),
        Some(name) if !config.programs.iter().any(|program| program.name == *name) => {
            wrong(&"start", &format!("there is no program {name}"))
        }
        _ => Ok(()),
    }
}

pub(super) fn mode(config: &SimConfig) -> OperationMode {
    match config.robot.mode {
        RobotMode::Manual => OperationMode::Manual,
        RobotMode::Auto => OperationMode::Auto,
        RobotMode::Remote => OperationMode::Remote,
    }
}
