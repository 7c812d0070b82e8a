//! Differences between controller versions, as data (docs/wire/command.md section 7, docs/wire/state.md section 6).
//!
//! In: a version's name. Out: a [`Dialect`], a plain struct of choices. Does not know connections: a dialect is
//! configured, never guessed from the controller's answers.

use super::codes::{OperationMode, ProgramState, RobotState, SafetyState, States};

/// What ends a text on port 2000.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum Terminator {
    /// Nothing: the text is sent as it is.
    None,
    /// Line feed.
    Lf,
    /// Carriage return and line feed.
    CrLf,
}

impl Terminator {
    /// The bytes that are appended.
    pub const fn text(self) -> &'static str {
        match self {
            Self::None => "",
            Self::Lf => "\n",
            Self::CrLf => "\r\n",
        }
    }
}

/// Whether a client writes an empty pair of parentheses after a bare keyword.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum Parentheses {
    /// `poweron`
    Omitted,
    /// `poweron()`
    Empty,
}

/// Whether a client puts the program's name in double quotes.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum Quotes {
    /// `run(a.jspf)`
    None,
    /// `run("a.jspf")`
    Double,
}

/// A controller's answer to a `run` that it executes.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum RunReply {
    /// `run start`
    Start,
    /// `run success`
    Success,
}

/// A controller's answer to a `speed` that it executes.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum SpeedReply {
    /// `set success`
    Success,
    /// `set speed 50%`
    Percent,
}

/// A controller's answer to `poweron`, `poweroff`, `enable` or `disable` in a state in which nothing remains to be
/// done.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum RepeatReply {
    /// `poweron fail`
    Fail,
    /// `already poweron`
    Already,
}

/// Whether a controller notifies its command clients when a program has ended.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum FinishNotice {
    /// No; clients ask with `isprogfinish`.
    Silent,
    /// `script finish`, to the client that started the program, without being asked.
    ScriptFinish,
}

/// How holding register 0 encodes the operation mode.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum ModeRegister {
    /// The register is the mode's code.
    Code,
    /// The units digit is the mode's code; a hundreds digit of 1 says that motion is simulated.
    UnitsDigit,
}

/// Whether a controller moves its arm or only simulates.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum Motion {
    /// The arm moves.
    #[default]
    Real,
    /// The controller is in its simulation mode.
    Simulated,
}

/// The choices of one controller version.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct Dialect {
    /// The name used in configuration files.
    pub name: &'static str,
    /// Terminator of a client's commands. A server accepts all of them (D2).
    pub terminator: Terminator,
    /// Whether a client writes parentheses after a bare keyword. A server accepts both (D2).
    pub parentheses: Parentheses,
    /// How a client writes the program's name. A server accepts both (D3).
    pub quotes: Quotes,
    /// Terminator of a server's replies. A client accepts all of them (D4).
    pub reply_terminator: Terminator,
    /// A server's answer to a good `run`. A client accepts both.
    pub run_reply: RunReply,
    /// A server's answer to a good `speed`. A client accepts both.
    pub speed_reply: SpeedReply,
    /// A server's answer to a command for the state that is already reached. A client accepts both.
    pub repeat_reply: RepeatReply,
    /// Whether a server sends `script finish`. A client always accepts it.
    pub finish_notice: FinishNotice,
    /// The safety state's code for "updating firmware" (SS_UPDATE): 15 or 99.
    pub safety_update: u8,
    /// The robot state's code for "updating" (SR_Update), where the version has one.
    pub robot_update: Option<u8>,
    /// How holding register 0 encodes the mode.
    pub mode_register: ModeRegister,
    /// TCP port of the Modbus server unless the configuration says otherwise.
    pub modbus_port: u16,
    /// Unit id that a client sends.
    pub modbus_unit: u8,
    /// Offset in the state packet of the global speed percentage (one byte), where it is sent.
    pub global_speed: Option<u16>,
}

impl Dialect {
    /// Controller software V2.3, as in its interface description V1.5.
    pub const V2_3: Self = Self {
        name: "v2.3",
        terminator: Terminator::None,
        parentheses: Parentheses::Omitted,
        quotes: Quotes::None,
        reply_terminator: Terminator::None,
        run_reply: RunReply::Start,
        speed_reply: SpeedReply::Success,
        repeat_reply: RepeatReply::Fail,
        finish_notice: FinishNotice::Silent,
        safety_update: 15,
        robot_update: None,
        mode_register: ModeRegister::Code,
        modbus_port: 502,
        modbus_unit: 1,
        global_speed: None,
    };

    /// Everything reported of later versions. No single release is known to have all of it; for a client it is as safe
    /// as V2.3, because a client accepts every form of a reply.
    pub const V2_6: Self = Self {
        name: "v2.6",
        terminator: Terminator::CrLf,
        parentheses: Parentheses::Empty,
        quotes: Quotes::Double,
        reply_terminator: Terminator::CrLf,
        run_reply: RunReply::Success,
        speed_reply: SpeedReply::Percent,
        repeat_reply: RepeatReply::Already,
        finish_notice: FinishNotice::ScriptFinish,
        safety_update: 99,
        robot_update: Some(7),
        mode_register: ModeRegister::UnitsDigit,
        modbus_port: 502,
        modbus_unit: 1,
        global_speed: Some(660),
    };

    /// All dialects.
    pub const ALL: [Self; 2] = [Self::V2_3, Self::V2_6];

    /// The names that [`Dialect::named`] knows.
    pub const NAMES: [&'static str; 2] = [Self::V2_3.name, Self::V2_6.name];

    /// The dialect with this name.
    pub fn named(name: &str) -> Option<Self> {
        Self::ALL.into_iter().find(|dialect| dialect.name == name)
    }

    /// The states with these codes of mode, robot, program and safety.
    pub fn states(&self, [mode, robot, program, safety]: [u8; 4]) -> States {
        States {
            mode: OperationMode::from_code(mode),
            robot: self.robot_state(robot),
            program: ProgramState::from_code(program),
            safety: self.safety_state(safety),
        }
    }

    /// The robot state for `code` in this version.
    pub fn robot_state(&self, code: u8) -> RobotState {
        if self.robot_update == Some(code) { RobotState::Update } else { RobotState::from_code(code) }
    }

    /// This version's code for `state`. For an update it is 7, as in later versions, if the version has no code for it.
    pub fn robot_code(&self, state: RobotState) -> u8 {
        match state {
            RobotState::Update => self.robot_update.unwrap_or(RobotState::Update.code()),
            other => other.code(),
        }
    }

    /// The safety state for `code` in this version.
    pub fn safety_state(&self, code: u8) -> SafetyState {
        if code == self.safety_update {
            return SafetyState::Update;
        }
        match SafetyState::from_code(code) {
            // A code of another version: unknown in this one.
            SafetyState::Update => SafetyState::Unknown(code),
            other => other,
        }
    }

    /// This version's code for `state`.
    pub fn safety_code(&self, state: SafetyState) -> u8 {
        match state {
            SafetyState::Update => self.safety_update,
            other => other.code(),
        }
    }

    /// Holding register 0 for an operation mode.
    pub fn mode_to_register(&self, mode: OperationMode, motion: Motion) -> u16 {
        let code = u16::from(mode.code());
        match (self.mode_register, motion) {
            (ModeRegister::UnitsDigit, Motion::Simulated) => code.saturating_add(100),
            _ => code,
        }
    }

    /// Operation mode and motion from a value of holding register 0.
    pub fn mode_from_register(&self, register: u16) -> (OperationMode, Motion) {
        match self.mode_register {
            ModeRegister::Code => {
                (OperationMode::from_code(u8::try_from(register).unwrap_or(u8::MAX)), Motion::Real)
            }
            ModeRegister::UnitsDigit => {
                let motion = if (register / 100) % 10 == 1 { Motion::Simulated } else { Motion::Real };
                (OperationMode::from_code((register % 10) as u8), motion)
            }
        }
    }
}

impl Default for Dialect {
    fn default() -> Self {
        Self::V2_3
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_find_their_dialects() {
        for name in Dialect::NAMES {
            assert_eq!(Dialect::named(name).unwrap().name, name);
        }
        assert_eq!(Dialect::named("V2.3"), None);
        assert_eq!(Dialect::default(), Dialect::V2_3);
    }

    #[test]
    fn every_state_code_survives_both_ways_in_every_dialect() {
        for dialect in Dialect::ALL {
            for code in 0..=u8::MAX {
                assert_eq!(dialect.robot_code(dialect.robot_state(code)), code, "{}", dialect.name);
                assert_eq!(dialect.safety_code(dialect.safety_state(code)), code, "{}", dialect.name);
            }
        }
        assert_eq!(Dialect::V2_3.safety_state(15), SafetyState::Update);
        assert_eq!(Dialect::V2_3.safety_state(99), SafetyState::Unknown(99));
        assert_eq!(Dialect::V2_6.safety_state(99), SafetyState::Update);
        assert_eq!(Dialect::V2_6.safety_state(15), SafetyState::Unknown(15));
        assert_eq!(Dialect::V2_3.robot_state(7), RobotState::Unknown(7));
        assert_eq!(Dialect::V2_6.robot_state(7), RobotState::Update);
    }

    #[test]
    fn the_mode_register_carries_the_simulation_digit_only_where_the_dialect_has_one() {
        let (old, new) = (Dialect::V2_3, Dialect::V2_6);
        assert_eq!(old.mode_to_register(OperationMode::Remote, Motion::Simulated), 2);
        assert_eq!(new.mode_to_register(OperationMode::Remote, Motion::Simulated), 102);
        assert_eq!(new.mode_to_register(OperationMode::Auto, Motion::Real), 1);
        assert_eq!(new.mode_from_register(102), (OperationMode::Remote, Motion::Simulated));
        assert_eq!(new.mode_from_register(1102), (OperationMode::Remote, Motion::Simulated));
        assert_eq!(new.mode_from_register(1), (OperationMode::Auto, Motion::Real));
        assert_eq!(new.mode_from_register(65535).0, OperationMode::Unknown(5));
        assert_eq!(old.mode_from_register(2), (OperationMode::Remote, Motion::Real));
        assert_eq!(old.mode_from_register(102), (OperationMode::Unknown(102), Motion::Real));
        assert_eq!(old.mode_from_register(300), (OperationMode::Unknown(255), Motion::Real));
    }
}
