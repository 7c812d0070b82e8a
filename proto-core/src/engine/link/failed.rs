//! Commands that the controller answered with a failure, and the controller's states at that moment: a reply on port
//! 2000 does not say why.

use super::state::ControllerStatus;
use super::stops::Waiting;
use crate::config::{CommandText, MAX_PORTS};
use crate::engine::io::{PortId, ReplyCode};
use crate::time::{Duration, Instant};
use crate::wire::dialect::Dialect;

/// The newest failed command of each port.
#[derive(Debug, Clone)]
pub(crate) struct FailedCommands {
    newest: [Option<Failed>; MAX_PORTS],
    /// The controller's states are still to be noted for at least one of them.
    pub is_open: bool,
}

impl FailedCommands {
    pub(crate) const NONE: Self = Self { newest: [None; MAX_PORTS], is_open: false };

    pub(crate) fn of(&self, port: PortId) -> Option<Failed> {
        *self.newest.get(usize::from(port.0))?
    }

    /// Notes the controller's reply to a command.
    pub(crate) fn note(&mut self, command: Waiting, code: ReplyCode, now: Instant) {
        if code == ReplyCode::Fail
            && let Some(failed) = self.newest.get_mut(usize::from(command.port.0))
        {
            *failed = Some(Failed::new(command.entry, command.value, now));
            self.is_open = true;
        }
    }

    /// Notes the states in the newest state packet, and when it arrived.
    pub(crate) fn note_states(&mut self, newest: Option<([u8; 4], Instant)>) {
        self.is_open = false;
        self.newest.iter_mut().flatten().for_each(|failed| failed.note_states(newest));
    }
}

/// A failed command, as the command link keeps it.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Failed {
    pub at: Instant,
    pub value: i64,
    pub entry: u16,
    /// Codes of mode, robot, program and safety in the newest state packet at that moment.
    codes: [u8; 4],
    /// Age of that packet in microseconds.
    age_us: u32,
    seen: Seen,
}

/// What is known about the controller's states at a failure.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Seen {
    /// They have not been noted yet.
    Unasked,
    /// There was no packet.
    Nothing,
    /// The codes are those of a packet.
    Packet,
}

impl Failed {
    const fn new(entry: u16, value: i64, at: Instant) -> Self {
        Self { at, value, entry, codes: [0; 4], age_us: 0, seen: Seen::Unasked }
    }

    /// Notes the codes of the newest packet and when it arrived, if there is one.
    fn note_states(&mut self, newest: Option<([u8; 4], Instant)>) {
        if self.seen != Seen::Unasked {
            return;
        }
        self.seen = Seen::Nothing;
        if let Some((codes, came)) = newest {
            let age = self.at.saturating_since(came).as_micros();
            (self.codes, self.age_us, self.seen) = (codes, age.min(u32::MAX.into()) as u32, Seen::Packet);
        }
    }

    /// The controller's states at that moment; `None` if no packet had arrived.
    pub(crate) fn states(&self, dialect: &Dialect) -> Option<ControllerStatus> {
        let age = Duration::from_micros(self.age_us.into());
        (self.seen == Seen::Packet).then(|| ControllerStatus { states: dialect.states(self.codes), age })
    }
}

/// The newest command of a port that the controller answered with a failure.
#[derive(Debug, Clone, Copy)]
#[non_exhaustive]
pub struct FailedCommand<'a> {
    /// When the reply arrived.
    pub at: Instant,
    /// The command, such as `run(pick.jspf)`.
    pub command: CommandText<'a>,
    /// The controller's states in the newest packet at that moment, and the packet's age; `None` without a state link
    /// or before its first packet.
    pub controller: Option<ControllerStatus>,
}
