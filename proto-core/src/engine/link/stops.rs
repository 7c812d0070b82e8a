//! Urgent commands that wait. What stops the robot goes ahead of everything and does not expire
//! while its device still asks for it (docs/engine.md section 7).

use heapless::Vec;

use crate::command::Keyword;
use crate::config::MAX_PORTS;
use crate::engine::io::PortId;
use crate::time::{Duration, Instant};

/// Number of commands, other than urgent ones, that can wait.
pub const COMMAND_QUEUE: usize = 8;
/// Four urgent commands, each once per port.
pub(crate) const MAX_STOPS: usize = 4 * MAX_PORTS;
/// How long an urgent command waits after its device has stopped asking for it, and how long it may
/// take to be acknowledged.
pub(crate) const STOP_TTL: Duration = Duration::from_secs(1);

/// A command that a value picked. Packed, because there is room for many.
#[derive(Debug, Clone, Copy)]
#[repr(C, packed(4))]
pub(crate) struct Waiting {
    /// When it was picked; for an urgent one whose device no longer asks for it, when that ended.
    pub since: Instant,
    /// Number of the port's commands up to this one: only the newest one's result is shown.
    pub nth: u32,
    pub entry: u16,
    pub port: PortId,
    /// The command field that picked it.
    pub field: u8,
    /// The value that picked it.
    pub value: i64,
}

/// The urgent commands that wait, in the order in which they were picked.
#[derive(Debug, Clone, Default)]
pub(crate) struct Stops(Vec<(Keyword, Waiting), MAX_STOPS>);

impl Stops {
    pub(crate) const fn new() -> Self {
        Self(Vec::new())
    }

    pub(crate) fn is_empty(&self) -> bool {
        self.0.is_empty()
    }

    /// A value picked an urgent command. Of each kind and port, one waits.
    pub(crate) fn push(&mut self, keyword: Keyword, command: Waiting) {
        let same = |other: &&mut (Keyword, Waiting)| other.0 == keyword && other.1.port == command.port;
        match self.0.iter_mut().find(same) {
            Some(other) => other.1 = command,
            None => {
                // As many places as there are kinds and ports.
                let _ = self.0.push((keyword, command));
            }
        }
    }

    /// A command that was in flight is to be sent again, after those that have not been sent yet.
    pub(crate) fn push_again(&mut self, keyword: Keyword, command: Waiting) {
        if !self.0.iter().any(|other| other.0 == keyword && other.1.port == command.port) {
            let _ = self.0.push((keyword, command));
        }
    }

    /// Another command of the port follows in the frame that picked the port's newest urgent one,
    /// which stays the newest.
    pub(crate) fn stays_newest(&mut self, port: PortId, nth: u32) {
        let newest = nth.wrapping_sub(1);
        for (_, command) in self.0.iter_mut().filter(|(_, c)| c.port == port && c.nth == newest) {
            command.nth = nth;
        }
    }

    /// The kinds that wait.
    pub(crate) fn kinds(&self) -> impl Iterator<Item = Keyword> + '_ {
        self.0.iter().map(|(keyword, _)| *keyword)
    }

    /// Takes the first of a kind that may be sent now.
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

    /// The field no longer asks for it.
    pub(crate) fn no_longer_asked(&mut self, field: u8, now: Instant) {
        for (_, command) in self.0.iter_mut().filter(|(_, command)| command.field == field) {
            command.since = now;
        }
    }

    /// Takes the first that no field asks for any more and that has waited too long since.
    pub(crate) fn pop_old(&mut self, now: Instant, is_asked: impl Fn(&Waiting) -> bool) -> Option<Waiting> {
        let is_old = |command: &Waiting| now >= command.since + STOP_TTL && !is_asked(command);
        let old = self.0.iter().map(|(_, command)| *command).find(is_old)?;
        self.0.retain(|(_, command)| (command.port, command.nth) != (old.port, old.nth));
        Some(old)
    }

    /// When the next one will have waited too long.
    pub(crate) fn deadline(&self, is_asked: impl Fn(&Waiting) -> bool) -> Instant {
        let waiting = self.0.iter().map(|(_, command)| command).filter(|command| !is_asked(command));
        waiting.map(|command| command.since + STOP_TTL).min().unwrap_or(Instant::NEVER)
    }
}
