//! Items named by a program or a test: system variables, inputs and outputs, states, and values of the state packet
//! (docs/simulated-controller.md section 4).

use proto_core::config::{StateValue, StateValueError};
use proto_core::wire::dialect::Dialect;
use proto_core::wire::scalar::Scalar;
use recipe_config::{InitialTarget, ShownState, TargetError};

use super::Controller;
use super::program::CallReply;
use super::registers::PacketItem;

/// An item with this name cannot be read, or cannot have this value.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct ItemError {
    /// The name.
    pub name: String,
    /// What is wrong.
    pub reason: String,
}

impl std::fmt::Display for ItemError {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "{}: {}", self.name, self.reason)
    }
}

impl std::error::Error for ItemError {}

/// Items by name, for tests.
impl Controller {
    /// An item's value: a system variable, an input or output, a state such as `running`, or an item of the
    /// state packet such as `drive_error[2]` (proto-core/docs/wire/state.md section 2), as the packet shows it
    /// without [`Self::corrupt`]. A bit and a state are 0 or 1.
    ///
    /// # Errors
    /// [`ItemError`] if there is no such item.
    pub fn item(&self, name: &str) -> Result<f64, ItemError> {
        if name.parse::<InitialTarget>().is_err()
            && let Some(item) = PacketItem::named(name)
        {
            return Ok(item.read(&self.registers.packet(self.dialect.global_speed)));
        }
        match self.read_item(name) {
            Ok(CallReply::Bit(on)) => Ok(f64::from(u8::from(on))),
            Ok(CallReply::Value(value)) => Ok(value.as_f64()),
            Ok(_) => Ok(0.0),
            Err(reason) => Err(ItemError {
                name: name.to_owned(),
                reason: reason.strip_prefix(&format!("{name}: ")).unwrap_or(&reason).to_owned(),
            }),
        }
    }

    /// Sets an item. A system variable, an input or an output is set as by [`Self::force`], for all interfaces. An item
    /// of the state packet, even a reserved one, has this value in packets and in `get` of a program until
    /// [`Self::release_item`] or a restart; other interfaces show the model's value.
    ///
    /// # Errors
    /// [`ItemError`] if there is no such item, or it cannot have the value; nothing changed.
    pub fn force_item(&mut self, name: &str, value: f64) -> Result<(), ItemError> {
        self.quiet.ends();
        let wrong = |reason: String| ItemError { name: name.to_owned(), reason };
        match name.parse::<InitialTarget>() {
            Ok(target) => self.force(target, value).map_err(|error| {
                let error = error.to_string();
                wrong(error.strip_prefix(&format!("{name} ")).unwrap_or(&error).to_owned())
            }),
            Err(error) => {
                let item = PacketItem::named(name).ok_or_else(|| match error {
                    TargetError::Variable(_) => {
                        wrong(format!("{error}; and items of the state packet, such as drive_error[1]"))
                    }
                    _ => wrong(error.to_string()),
                })?;
                let forced = self.registers.force_in_packet(item, value);
                forced.map_err(|error| wrong(error.to_string()))
            }
        }
    }

    /// Ends [`Self::force_item`] for an item of the state packet: the model's value is shown again.
    ///
    /// # Errors
    /// [`ItemError`] if the packet has no such item.
    pub fn release_item(&mut self, name: &str) -> Result<(), ItemError> {
        self.quiet.ends();
        let item = PacketItem::named(name).ok_or_else(|| ItemError {
            name: name.to_owned(),
            reason: "the state packet has no such item".to_owned(),
        })?;
        self.registers.release_in_packet(item);
        Ok(())
    }
}

impl Controller {
    /// The value of an item. A bit and a state are returned as bits, everything else as a number.
    ///
    /// # Errors
    /// The name, and what is wrong with it.
    pub(super) fn read_item(&self, name: &str) -> Result<CallReply, String> {
        match name.parse() {
            Ok(InitialTarget::Var(var)) => Ok(CallReply::Value(self.registers.var(var))),
            Ok(InitialTarget::Bit { group, index }) => Ok(CallReply::Bit(self.registers.bit(group, index))),
            Ok(target @ InitialTarget::VarBit(_)) => Ok(CallReply::Bit(self.registers.value(target) != 0.0)),
            Ok(target) => Ok(CallReply::Value(Scalar::Double(self.registers.value(target)))),
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

    fn read_state(&self, name: &str) -> Result<CallReply, StateValueError> {
        if let Some(state) = ShownState::named(name) {
            return Ok(CallReply::Bit(self.machine.is_in(state)));
        }
        let value = StateValue::parse(name)?;
        if value == StateValue::SPEED {
            return Ok(CallReply::Value(Scalar::Double(self.machine.speed_percent().into())));
        }
        // Rows other than the speed are the same in every dialect.
        let (offset, ty) = value.place(&Dialect::V2_3)?;
        let packet = self.registers.packet(None);
        let bytes = packet.get(usize::from(offset)..).unwrap_or(&[]);
        Ok(CallReply::Value(Scalar::decode(ty, bytes).unwrap_or(Scalar::Byte(0))))
    }
}
