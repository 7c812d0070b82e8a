//! The promises that are judged in one cell, in terms of its robot and its device.

use proto_core::sysvar::SysVar;
use proto_core::time::Duration;

/// The source of a value in an order.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Source {
    Word(SysVar),
    /// A value that the device itself sent before, by its number.
    Own(usize),
    Constant(u32),
}

/// The promises of a cell.
#[derive(Debug, Clone)]
pub(crate) struct Rules {
    /// The values of the event, and how long after the rise it may be sent.
    pub moves: (Vec<Source>, Duration),
    /// The values of the step that follows the event, and how long after the event's reply it may be sent.
    pub step: Option<(Vec<Source>, Duration)>,
    /// The variable whose value the device keeps.
    pub keeps: Option<SysVar>,
    /// The variables that receive the device's values, by number.
    pub values: Vec<SysVar>,
    /// The safe value of these variables, when the device is silent.
    pub safe: u16,
    /// The maximum age of a value when it arrives at the robot.
    pub value_age: Duration,
    /// A bit does not count as stale for this long.
    pub stale_after: Duration,
    /// A device that was away for this long counts as started.
    pub absent: Duration,
    /// How long sent data may wait in the transport of a gateway that is not called.
    pub transport: Duration,
    /// The maximum of each variable in the program; larger values are not sent.
    pub limits: Vec<(SysVar, u16)>,
}

impl Rules {
    /// The rules of a device with this timeout.
    pub(super) fn new(moves: Vec<Source>, values: &[&str], timeout: Duration) -> Self {
        Self {
            moves: (moves, PORT_TIMEOUT),
            step: None,
            keeps: Some(var("WordOutputReg[3]")),
            values: values.iter().map(|name| var(name)).collect(),
            safe: 7,
            // The sum of: the time until the port is overdue, all repetitions, the way to the controller, and a stall
            // of the gateway and of its transport.
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

/// A word register of the robot.
pub(super) fn word(name: &str) -> Source {
    Source::Word(var(name))
}

/// A variable of the table by name.
pub(super) fn var(name: &str) -> SysVar {
    match SysVar::parse(name) {
        Ok(var) => var,
        Err(error) => panic!("{name}: {error}"),
    }
}

/// The coils that request a motion and a stop.
pub(super) const MOVE_BIT: u8 = 0;
pub(super) const STOP_BIT: u8 = 1;
const PORT_TIMEOUT: Duration = Duration::from_secs(1);
