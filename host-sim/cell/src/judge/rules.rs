//! What is promised of one cell, in words of its robot and its device.

use proto_core::sysvar::SysVar;
use proto_core::time::Duration;

/// Where a value of an order comes from.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Source {
    Word(SysVar),
    /// A value of the device itself, by its number, as it sent it before.
    Own(usize),
    Constant(u32),
}

/// The promises.
#[derive(Debug, Clone)]
pub(crate) struct Rules {
    /// The values of the event, and how long after the rise it may be sent.
    pub moves: (Vec<Source>, Duration),
    /// The same of the step that follows it.
    pub step: Option<(Vec<Source>, Duration)>,
    /// What the device keeps.
    pub keeps: Option<SysVar>,
    /// Where its values go, by number.
    pub values: Vec<SysVar>,
    /// What these are when it is silent.
    pub safe: u16,
    /// How old a value may be when it arrives at the robot.
    pub value_age: Duration,
    /// A bit is not an old one for so long.
    pub stale_after: Duration,
    /// What was away for so long has started.
    pub absent: Duration,
    /// How long what was sent may wait in the transport of a gateway that is not called.
    pub transport: Duration,
    /// The most that each variable may be, for the program; beyond it nothing is sent.
    pub limits: Vec<(SysVar, u16)>,
}

impl Rules {
    /// Those of a device that is asked with this timeout.
    pub(super) fn new(moves: Vec<Source>, values: &[&str], timeout: Duration) -> Self {
        Self {
            moves: (moves, PORT_TIMEOUT),
            step: None,
            keeps: Some(var("WordOutputReg[3]")),
            values: values.iter().map(|name| var(name)).collect(),
            safe: 7,
            // Until it is overdue, in all repetitions, on its way to the controller, in a stall of the gateway and of
            // its transport.
            value_age: PORT_TIMEOUT + timeout.saturating_mul(9) + Duration::from_millis(3_500),
            stale_after: Duration::from_millis(300),
            absent: Duration::from_secs(3),
            transport: Duration::ZERO,
            limits: Vec::new(),
        }
    }

    pub(super) fn limit(mut self, name: &str, most: u16) -> Self {
        self.limits.push((var(name), most));
        self
    }

    /// The variables that the program sets.
    pub(super) fn sources(&self) -> impl Iterator<Item = SysVar> {
        let words = self.moves.0.iter().chain(self.step.iter().flat_map(|(sources, _)| sources));
        let words = words.filter_map(|source| match source {
            Source::Word(var) => Some(*var),
            Source::Own(_) | Source::Constant(_) => None,
        });
        words.chain(self.keeps)
    }
}

/// A word of the robot.
pub(super) fn word(name: &str) -> Source {
    Source::Word(var(name))
}

/// A variable of the table, by name.
pub(super) fn var(name: &str) -> SysVar {
    match SysVar::parse(name) {
        Ok(var) => var,
        Err(error) => panic!("{name}: {error}"),
    }
}

/// The coils that ask for a motion and for a stop.
pub(super) const MOVE_BIT: u8 = 0;
pub(super) const STOP_BIT: u8 = 1;
const PORT_TIMEOUT: Duration = Duration::from_secs(1);
