//! Codes of the four state machines (docs/wire/state.md section 4). They are the same in the state packet, in Modbus
//! holding registers 0..=3 and in the reply to `state`.

/// Defines an enum of codes with a variant for unknown ones, and both conversions from one table.
macro_rules! codes {
    ($(#[$meta:meta])* $name:ident { $($(#[$doc:meta])* $code:literal = $variant:ident,)* } $(also { $($(#[$also_doc:meta])* $also_code:literal = $also:ident,)* })?) => {
        $(#[$meta])*
        #[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
        #[cfg_attr(feature = "defmt", derive(defmt::Format))]
        pub enum $name {
            $($(#[$doc])* $variant,)*
            $($($(#[$also_doc])* $also,)*)?
            /// A code that is not in this table, kept as received.
            Unknown(u8),
        }

        impl $name {
            /// The state with this code.
            pub const fn from_code(code: u8) -> Self {
                match code {
                    $($code => Self::$variant,)*
                    other => Self::Unknown(other),
                }
            }

            /// The state's name, such as `PowerOff`; `Unknown` for a code that is not in this table.
            pub const fn name(self) -> &'static str {
                match self {
                    $(Self::$variant => stringify!($variant),)*
                    $($(Self::$also => stringify!($also),)*)?
                    Self::Unknown(_) => "Unknown",
                }
            }

            /// The state's code.
            pub const fn code(self) -> u8 {
                match self {
                    $(Self::$variant => $code,)*
                    $($(Self::$also => $also_code,)*)?
                    Self::Unknown(code) => code,
                }
            }
        }
    };
}

codes! {
    /// Who moves the robot.
    OperationMode {
        /// kManual: from the teach pendant.
        0 = Manual,
        /// kAuto: programs started on the pendant.
        1 = Auto,
        /// kRemote: commands from port 2000.
        2 = Remote,
    }
}

codes! {
    /// The robot's progress from boot to moving.
    RobotState {
        /// SR_Start: the software is starting.
        0 = Start,
        /// SR_Initialize.
        1 = Initialize,
        /// SR_Logout: nobody is logged in.
        2 = Logout,
        /// SR_Login.
        3 = Login,
        /// SR_PowerOff: the arm has no power.
        4 = PowerOff,
        /// SR_Disable, also called SR_PowerOn: powered, brakes closed.
        5 = Disable,
        /// SR_Enable: can move.
        6 = Enable,
    } also {
        /// SR_Update, in later controller versions (see
        /// [`Dialect::robot_state`](crate::wire::dialect::Dialect::robot_state)).
        7 = Update,
    }
}

codes! {
    /// What the program is doing.
    ProgramState {
        /// SP_Stopped.
        0 = Stopped,
        /// SP_Stopping.
        1 = Stopping,
        /// SP_Running.
        2 = Running,
        /// SP_Paused.
        3 = Paused,
        /// SP_Pausing.
        4 = Pausing,
        /// SP_TaskRunning.
        5 = TaskRunning,
    }
}

codes! {
    /// What the safety controller is doing.
    SafetyState {
        /// SS_INIT.
        0 = Init,
        /// SS_WAIT.
        2 = Wait,
        /// SS_CONFIG.
        3 = Config,
        /// SS_POWER_OFF.
        4 = PowerOff,
        /// SS_RUN: normal operation.
        5 = Run,
        /// SS_RECOVERY.
        6 = Recovery,
        /// SS_STOP2.
        7 = Stop2,
        /// SS_STOP1.
        8 = Stop1,
        /// SS_STOP0.
        9 = Stop0,
        /// SS_MODEL.
        10 = Model,
        /// SS_REDUCE: reduced speed.
        12 = Reduce,
        /// SS_BOOT.
        13 = Boot,
        /// SS_FAIL.
        14 = Fail,
        /// SS_UPDATE; other versions use another code (see
        /// [`Dialect::safety_state`](crate::wire::dialect::Dialect::safety_state)).
        15 = Update,
    }
}

/// The states of all four state machines.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct States {
    /// Operation mode.
    pub mode: OperationMode,
    /// Robot state.
    pub robot: RobotState,
    /// Program state.
    pub program: ProgramState,
    /// Safety state.
    pub safety: SafetyState,
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_code_survives_both_ways() {
        for code in 0..=u8::MAX {
            assert_eq!(OperationMode::from_code(code).code(), code);
            assert_eq!(RobotState::from_code(code).code(), code);
            assert_eq!(ProgramState::from_code(code).code(), code);
            assert_eq!(SafetyState::from_code(code).code(), code);
        }
        assert_eq!(SafetyState::from_code(1), SafetyState::Unknown(1));
        assert_eq!(SafetyState::from_code(11), SafetyState::Unknown(11));
        assert_eq!(RobotState::from_code(7), RobotState::Unknown(7));
    }
}
