//! Waiting urgent commands. What stops the robot goes ahead of everything and does not expire while its device still
//! asks for it (docs/engine.md section 7).

use heapless::Vec;

use crate::command::Keyword;
use crate::config::MAX_PORTS;
use crate::engine::io::PortId;
use crate::time::{Duration, Instant};

/// Maximum number of waiting commands, not counting urgent ones.
pub const COMMAND_QUEUE: usize = 8;
/// Four kinds of urgent commands, each once per port.
pub(crate) const MAX_STOPS: usize = 4 * MAX_PORTS;
/// How long an urgent command waits after its device has stopped asking for it, and how long its acknowledgement may
/// take.
pub(crate) const STOP_TTL: Duration = Duration::from_secs(1);

/// A command that a value picked. Packed, because there are many.
#[derive(Debug, Clone, Copy)]
#[repr(C, packed(4))]
pub(crate) struct Waiting {
    /// When it was picked; for an urgent command whose device no longer asks for it, when that ended.
    pub since: Instant,
    /// The number of the command among those of its port: only the newest one's result is shown.
    pub nth: u32,
    pub entry: u16,
    pub port: PortId,
    /// Index of the command field that picked it.
    pub field: u8,
    pub value: i64,
}

/// The waiting urgent commands, in the order in which they were picked.
#[derive(Debug, Clone, Default)]
pub(crate) struct Stops(Vec<(Keyword, Waiting), MAX_STOPS>);

impl Stops {
    pub(crate) const fn new() -> Self {
        Self(Vec::new())
    }

    pub(crate) fn is_empty(&self) -> bool {
        self.0.is_empty()
    }

    /// Adds an urgent command that a value picked. One of each kind and port waits.
    pub(crate) fn push(&mut self, keyword: Keyword, command: Waiting) {
        let same = |other: &&mut (Keyword, Waiting)| other.0 == keyword && other.1.port == command.port;
        match self.0.iter_mut().find(same) {
            Some(other) => other.1 = command,
            None => {
                // Cannot fail: there is room for every kind and port.
                let _ = self.0.push((keyword, command));
            }
        }
    }

    /// Adds a command that was in flight, to be sent again after those not sent yet.
    pub(crate) fn push_again(&mut self, keyword: Keyword, command: Waiting) {
        if !self.0.iter().any(|other| other.0 == keyword && other.1.port == command.port) {
            let _ = self.0.push((keyword, command));
        }
    }

    /// Another command of the port follows in the frame that picked the port's newest urgent one, which stays the
    /// newest.
    pub(crate) fn stays_newest(&mut self, port: PortId, nth: u32) {
        let newest = nth.wrapping_sub(1);
        for (_, command) in self.0.iter_mut().filter(|(_, c)| c.port == port && c.nth == newest) {
            command.nth = nth;
        }
    }

    pub(crate) fn kinds(&self) -> impl Iterator<Item = Keyword> + '_ {
        self.0.iter().map(|(keyword, _)| *keyword)
    }

    /// Takes the first command of a kind that may be sent now.
    pub(crate) fn pop(&mut self, may_go: impl Fn(Keyword) -> bool) -> Option<(Keyword, Waiting)> {
        let mut first = None;
        self.0.retain(|stop| {
            let goes = first.is_none() && may_go(stop.0);
            if goes {
                first = Some(*stop);
            }
            !goes
        });
        first
    }

    /// The field no longer asks for its commands.
    pub(crate) fn no_longer_asked(&mut self, field: u8, now: Instant) {
        for (_, command) in self.0.iter_mut().filter(|(_, command)| command.field == field) {
            command.since = now;
        }
    }

    /// Takes the first command that no field asks for any more and that has waited too long since.
    pub(crate) fn pop_old(&mut self, now: Instant, is_asked: impl Fn(&Waiting) -> bool) -> Option<Waiting> {
        let is_old = |command: &Waiting| now >= command.since + STOP_TTL && !is_asked(command);
        let old = self.0.iter().map(|(_, command)| *command).find(is_old)?;
        self.0.retain(|(_, command)| (command.port, command.nth) != (old.port, old.nth));
        Some(old)
    }

    /// When the next command will have waited too long.
    pub(crate) fn deadline(&self, is_asked: impl Fn(&Waiting) -> bool) -> Instant {
        let waiting = self.0.iter().map(|(_, command)| command).filter(|command| !is_asked(command));
        waiting.map(|command| command.since + STOP_TTL).min().unwrap_or(Instant::NEVER)
    }
}
