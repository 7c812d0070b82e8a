//! Functions of the functional inputs, and states that the functional outputs show (D27).

use proto_core::sysvar::VarBit;

use super::{BitGroup, InitialTarget};

/// Section `[functions]` of a controller file.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub struct Functions {
    /// Inputs that trigger a function with their rising edge, in file order.
    pub inputs: Vec<FunctionInput>,
    /// Outputs that show a state, in file order.
    pub outputs: Vec<FunctionOutput>,
    /// The program of [`Function::Start`].
    pub start: Option<String>,
}

impl Functions {
    /// The state that this output shows, under any of its names; `None` if it shows none.
    pub fn state_of(&self, item: InitialTarget) -> Option<ShownState> {
        let shown = self.outputs.iter().find(|output| output.item.is_same_bit(item));
        shown.map(|output| output.state)
    }
}

/// An input and its function.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct FunctionInput {
    /// The input; [`InitialTarget::triggers_functions`] is true.
    pub item: InitialTarget,
    /// Its function.
    pub function: Function,
}

/// An output and the state that it shows.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct FunctionOutput {
    /// The output; [`InitialTarget::shows_states`] is true.
    pub item: InitialTarget,
    /// The state.
    pub state: ShownState,
}

/// What an input does.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum Function {
    /// Starts the program of [`Functions::start`].
    Start,
    /// Ends the program.
    Stop,
    /// Pauses the program.
    Pause,
    /// Continues the program.
    Resume,
    /// Enables the robot.
    Enable,
    /// Disables the robot.
    Disable,
    /// Clears a safety stop and the error.
    Reset,
}

impl Function {
    /// Every function with its name in files. Of several functions at one instant the first is executed first: those
    /// that stop come before those that start.
    pub const ALL: [(&str, Self); 7] = [
        ("disable", Self::Disable),
        ("stop", Self::Stop),
        ("pause", Self::Pause),
        ("reset", Self::Reset),
        ("enable", Self::Enable),
        ("resume", Self::Resume),
        ("start", Self::Start),
    ];
}

/// A state that is true or false.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum ShownState {
    /// The power is on.
    Powered,
    /// The robot is enabled.
    Enabled,
    /// A program runs.
    Running,
    /// The program is paused.
    Paused,
    /// An error was not reset.
    Error,
    /// The emergency stop is active.
    EmergencyStop,
    /// The mode is not manual.
    Remote,
}

impl ShownState {
    /// Every state with the name used in files and programs.
    pub const ALL: [(&str, Self); 7] = [
        ("powered", Self::Powered),
        ("enabled", Self::Enabled),
        ("running", Self::Running),
        ("paused", Self::Paused),
        ("error", Self::Error),
        ("emergency_stop", Self::EmergencyStop),
        ("remote", Self::Remote),
    ];

    /// The state with this name; `None` if there is none.
    pub fn named(name: &str) -> Option<Self> {
        Self::ALL.into_iter().find(|(own, _)| *own == name).map(|(_, state)| state)
    }
}

impl InitialTarget {
    /// The bit of a system variable that this names; `None` for the tool's buttons and for items that are not bits. For
    /// an output that can be commanded, the command's bit.
    pub fn var_bit(self) -> Option<VarBit> {
        match self {
            Self::VarBit(bit) => Some(bit),
            Self::Bit { group, index } => group.var_bit(index),
            Self::Var(_) | Self::Analog { .. } => None,
        }
    }

    /// Whether both name the same bit: `FDI[1]` is `DigitalSignalStatus[7].0`.
    pub fn is_same_bit(self, other: Self) -> bool {
        self == other || self.var_bit().is_some_and(|bit| Some(bit) == other.var_bit())
    }

    /// Whether the item can trigger a function: a functional input, a functional bool register input, or a button of
    /// the tool.
    pub fn triggers_functions(self) -> bool {
        match self.var_bit() {
            Some(VarBit { var, .. }) => match var.group() {
                "BitInputReg" => var.index() <= 2,
                "DigitalSignalStatus" => var.index() == 7,
                _ => false,
            },
            None => matches!(self, Self::Bit { group: BitGroup::ToolButton, .. }),
        }
    }

    /// Whether the item can show a state: a functional output, or a functional bool register output.
    pub fn shows_states(self) -> bool {
        self.var_bit().is_some_and(|VarBit { var, .. }| match var.group() {
            "BitOutputReg" => var.index() <= 2,
            "DigitalSignalStatus" => var.index() == 8,
            _ => false,
        })
    }
}

/// What [`InitialTarget::triggers_functions`] allows, for messages.
pub const FUNCTION_INPUTS: &str =
    "FDI[1..8], ToolButton[1..2], bits of BitInputReg[1..2] such as BitInputReg[1].0";
/// What [`InitialTarget::shows_states`] allows, for messages.
pub const FUNCTION_OUTPUTS: &str = "FDO[1..8], bits of BitOutputReg[1..2] such as BitOutputReg[1].0";
