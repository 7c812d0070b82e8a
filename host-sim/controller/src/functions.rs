//! Functions of functional inputs, and states on functional outputs (D27, docs/simulated-controller.md section 7).
//!
//! An input's rising edge has the effect of the command on port 2000, without a reply. Several edges at one instant are
//! executed in the order of [`Function::ALL`].

use proto_core::command::Action;
use proto_core::time::Instant;
use proto_core::wire::state::{OperationMode, ProgramState, RobotState, SafetyState};
use recipe_config::{Function, FunctionInput, InitialTarget, ShownState};

use super::Controller;
use super::machine::{ErrorId, Machine};

impl Controller {
    pub(super) fn execute_functions(&mut self, now: Instant) {
        let Some(risen) = self.registers.take_risen() else { return };
        let inputs = &self.config.functions.inputs;
        let due: Vec<FunctionInput> = Function::ALL
            .iter()
            .flat_map(|&(_, function)| inputs.iter().filter(move |input| input.function == function))
            .filter(|input| risen.has(input.item))
            .copied()
            .collect();
        for FunctionInput { item, function } in due {
            if self.execute_function(now, function).is_err() {
                self.name_input(item);
            }
            self.settle(now);
        }
    }

    fn execute_function(&mut self, now: Instant, function: Function) -> Result<(), ErrorId> {
        let action = match function {
            Function::Start => {
                let program = self.config.functions.start.clone().unwrap_or_default();
                return self.run(now, None, &program, None);
            }
            Function::Reset => {
                self.machine.reset(now);
                return Ok(());
            }
            Function::Stop => Action::Stop,
            Function::Pause => Action::Pause,
            Function::Resume => Action::Resume,
            Function::Enable => Action::Enable,
            Function::Disable => Action::Disable,
        };
        self.act(now, action).map(drop)
    }

    /// Adds the input's name to the error of the refused function.
    fn name_input(&mut self, item: InitialTarget) {
        if let Some(error) = self.machine.error() {
            let (id, message) = (error.id, format!("{item}: {}", error.message));
            self.machine.fail(id, message);
        }
    }

    pub(super) fn show_states(&mut self) {
        for output in &self.config.functions.outputs {
            self.registers.show_state(output.item, self.machine.is_in(output.state));
        }
    }
}

impl Machine {
    /// Whether the state holds now.
    pub fn is_in(&self, state: ShownState) -> bool {
        match state {
            ShownState::Powered => matches!(self.robot(), RobotState::Disable | RobotState::Enable),
            ShownState::Enabled => self.robot() == RobotState::Enable,
            ShownState::Running => self.program() == ProgramState::Running,
            ShownState::Paused => self.program() == ProgramState::Paused,
            ShownState::Error => self.robot_error().is_some(),
            ShownState::EmergencyStop => self.safety() == SafetyState::Stop0,
            ShownState::Remote => self.mode() != OperationMode::Manual,
        }
    }
}
