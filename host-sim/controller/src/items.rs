//! Items that a program or a test names: system variables, inputs and outputs, states, and values of the state
//! packet (docs/simulated-controller.md section 4).

use proto_core::config::{StateValue, StateValueError};
use proto_core::wire::dialect::Dialect;
use proto_core::wire::scalar::Scalar;
use recipe_config::{InitialTarget, ShownState, TargetError};

use super::Controller;
use super::program::Answer;

impl Controller {
    /// The value of an item. A bit and a state are bits, everything else is a number.
    ///
    /// # Errors
    /// The name, and what is wrong with it.
    pub(super) fn read_item(&self, name: &str) -> Result<Answer, String> {
        match name.parse() {
            Ok(InitialTarget::Var(var)) => Ok(Answer::Value(self.registers.var(var))),
            Ok(InitialTarget::Bit { group, index }) => Ok(Answer::Bit(self.registers.bit(group, index))),
            Ok(target @ InitialTarget::VarBit(_)) => Ok(Answer::Bit(self.registers.value(target) != 0.0)),
            Ok(target) => Ok(Answer::Value(Scalar::Double(self.registers.value(target)))),
            Err(error @ TargetError::Variable(_)) => self.read_state(name).map_err(|own| match own {
                StateValueError::Unknown => {
                    let states: Vec<_> = ShownState::ALL.iter().map(|state| state.0).collect();
                    format!(
                        "{name}: {error}; and {}; and rows of the state packet such as robot_state",
                        states.join(", ")
                    )
                }
                other => format!("{name}: {other}"),
            }),
            Err(error) => Err(format!("{name}: {error}")),
        }
    }

    fn read_state(&self, name: &str) -> Result<Answer, StateValueError> {
        if let Some(state) = ShownState::named(name) {
            return Ok(Answer::Bit(self.machine.is_in(state)));
        }
        let value = StateValue::parse(name)?;
        if value == StateValue::SPEED {
            return Ok(Answer::Value(Scalar::Double(self.machine.speed_percent().into())));
        }
        // Rows other than the speed are the same in every dialect.
        let (offset, ty) = value.place(&Dialect::V2_3)?;
        let packet = self.registers.packet(None);
        let bytes = packet.get(usize::from(offset)..).unwrap_or(&[]);
        Ok(Answer::Value(Scalar::decode(ty, bytes).unwrap_or(Scalar::Byte(0))))
    }
}
