//! One connection to port 2000: what is under way on it, and what became of that
//! (docs/engine.md section 7). Which command goes where is the command link's business.

use super::counters::{LinkCounters, add, bump};
use super::flight::Flight;
use super::io::ReplyCode;
use super::stops::Waiting;
use crate::command::{ClientEvent, CommandClient, Keyword, ReplyKind, StartError};
use crate::link::{LinkTimings, Supervisor};
use crate::time::{Duration, Instant};
use crate::wire::dialect::Dialect;

/// A command that was handed over.
#[derive(Debug, Clone, Copy)]
pub(super) struct Sent {
    pub command: Waiting,
    pub keyword: Keyword,
    /// When it was handed over.
    pub at: Instant,
}

/// What happened on a connection.
pub(super) enum Event {
    /// A command came to its end.
    Answered(Sent, ReplyCode),
    /// Something else, which is counted.
    Other,
    /// The connection is to be given up.
    TimedOut,
}

#[derive(Debug, Clone)]
pub(super) struct Session {
    pub supervisor: Supervisor,
    pub counters: LinkCounters,
    client: CommandClient,
    /// The command whose reply is waited for, and a younger, urgent one that did not wait for that.
    pub in_flight: Option<Sent>,
    pub beside: Option<Sent>,
    /// The transport has not taken the newest command yet.
    unsent: bool,
    flight: Flight<2>,
}

impl Session {
    pub(super) const fn new() -> Self {
        Self {
            supervisor: Supervisor::new(LinkTimings::TCP),
            counters: LinkCounters::ZERO,
            client: CommandClient::new(),
            in_flight: None,
            beside: None,
            unsent: false,
            flight: Flight::new(),
        }
    }

    /// Whether a command can be sent, one that waits for the reply before.
    pub(super) fn is_free(&self) -> bool {
        self.supervisor.is_up() && !self.unsent && !self.client.busy()
    }

    /// Whether an urgent command can be sent, whatever is unanswered.
    pub(super) fn is_free_beside(&self) -> bool {
        self.supervisor.is_up() && !self.unsent && !self.client.busy_beside() && !self.flight.is_full()
    }

    /// Whether something that was handed over may still be on its way.
    pub(super) fn is_unacknowledged(&self) -> bool {
        !self.flight.is_empty()
    }

    /// The command's bytes are put into `out`, to be acknowledged by `until`.
    pub(super) fn send(
        &mut self,
        (keyword, command): (Keyword, Waiting),
        text: &str,
        dialect: &Dialect,
        out: &mut [u8],
        (now, until): (Instant, Instant),
    ) -> Result<usize, StartError> {
        let sent = Some(Sent { command, keyword, at: now });
        let len = if self.client.busy() {
            let len = self.client.start_beside(now, text.as_bytes(), dialect, out)?;
            self.beside = sent;
            len
        } else {
            let len = self.client.start(now, text.as_bytes(), dialect, out)?;
            self.in_flight = sent;
            len
        };
        bump(&mut self.counters.sent);
        self.unsent = true;
        self.flight.sent(len, until, Instant::NEVER);
        Ok(len)
    }

    /// The transport took everything.
    pub(super) fn taken(&mut self) {
        self.unsent = false;
    }

    /// The peer's transport has acknowledged all but `left` bytes.
    pub(super) fn acked(&mut self, left: u32) {
        self.flight.acked(left, Instant::ZERO, |_| ());
    }

    /// Bytes arrived.
    pub(super) fn heard(&mut self, len: usize, now: Instant) {
        self.supervisor.heard(now);
        add(&mut self.counters.bytes_in, len);
    }

    /// What came in time, however late it is told: only a tick lets a deadline pass.
    pub(super) fn in_time(&self, now: Instant) -> Instant {
        let before = |at: Instant| at - Duration::from_micros(1);
        self.client.deadline().map_or(now, |deadline| now.min(before(deadline)))
    }

    /// The connection is gone; what was under way is handed out.
    pub(super) fn lost(&mut self) -> [Option<Sent>; 2] {
        self.client.abort();
        self.flight.clear();
        self.unsent = false;
        [self.in_flight.take(), self.beside.take()]
    }

    /// Whether the connection has to be given up for what nobody acknowledged.
    pub(super) fn is_overdue(&mut self, now: Instant) -> bool {
        let overdue = now >= self.flight.deadline();
        if overdue {
            bump(&mut self.counters.unacknowledged);
        }
        overdue
    }

    /// Whether the client has something to say by itself.
    pub(super) fn is_due(&self, now: Instant) -> bool {
        self.client.deadline().is_some_and(|at| now >= at)
    }

    /// The next event in `rest`, or by the clock.
    pub(super) fn step(&mut self, rest: &mut &[u8], now: Instant) -> Option<Event> {
        let (beside, kind) = match self.client.receive(now, rest)? {
            ClientEvent::Reply { beside, kind, .. } => (beside, kind),
            ClientEvent::Timeout => {
                bump(&mut self.counters.timeouts);
                return Some(Event::TimedOut);
            }
            ClientEvent::ScriptFinish => return Some(Event::Other),
            _ => {
                bump(&mut self.counters.malformed);
                return Some(Event::Other);
            }
        };
        let code = match kind {
            ReplyKind::Success | ReplyKind::Value => ReplyCode::Success,
            ReplyKind::Fail => ReplyCode::Fail,
            _ => ReplyCode::Other,
        };
        let sent = match beside {
            true => self.beside.take(),
            false => core::mem::replace(&mut self.in_flight, self.beside.take()),
        };
        if self.in_flight.is_none() {
            self.flight.answered();
        }
        let Some(sent) = sent else { return Some(Event::Other) };
        self.counters.answered(now.saturating_since(sent.at).as_micros());
        if code == ReplyCode::Fail {
            bump(&mut self.counters.refused);
        }
        Some(Event::Answered(sent, code))
    }

    /// When something happens by itself, the supervisor apart.
    pub(super) fn deadline(&self) -> Instant {
        self.client.deadline().unwrap_or(Instant::NEVER).min(self.flight.deadline())
    }
}
