//! One connection to port 2000: the commands in flight on it, and their results (docs/engine.md section 7). Does not
//! decide which command goes where; the command link does.

use super::flight::Flight;
use super::other_text::LastText;
use super::stops::{STOP_TTL, Waiting};
use crate::command::{ClientEvent, CommandClient, Keyword, ReplyKind, StartError};
use crate::engine::counters::{LinkCounters, add, bump};
use crate::engine::io::ReplyCode;
use crate::engine::latency::Since;
use crate::link::{LinkTimings, Supervisor};
use crate::time::{Duration, Instant};
use crate::wire::dialect::Dialect;

/// A command that was handed over.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Sent {
    pub command: Waiting,
    pub keyword: Keyword,
    pub at: Instant,
    /// It has arrived, and the controller has sent an unknown text that may be its reply.
    pub has_text: bool,
}

pub(crate) enum Event {
    /// A command has its result.
    Answered(Sent, ReplyCode),
    /// Another event; it is counted.
    Other,
    /// The connection must be given up.
    TimedOut,
}

#[derive(Debug, Clone)]
pub(crate) struct Session {
    pub supervisor: Supervisor,
    pub counters: LinkCounters,
    client: CommandClient,
    /// The command whose reply is pending; `beside`: a newer, urgent one that did not wait for it.
    pub in_flight: Option<Sent>,
    pub beside: Option<Sent>,
    /// The newest text that was not recognized as a reply.
    pub last_text: Option<LastText>,
    /// The transport has not taken the newest command yet.
    unsent: bool,
    flight: Flight<2>,
}

impl Session {
    pub(crate) const fn new() -> Self {
        Self {
            supervisor: Supervisor::new(&LinkTimings::TCP),
            counters: LinkCounters::ZERO,
            client: CommandClient::new(),
            in_flight: None,
            beside: None,
            last_text: None,
            unsent: false,
            flight: Flight::new(),
        }
    }

    /// Whether a command that has to wait for the previous reply can be sent.
    pub(crate) fn is_free(&self) -> bool {
        self.supervisor.is_up() && !self.unsent && !self.client.busy()
    }

    /// Whether an urgent command can be sent, whatever is unanswered.
    pub(crate) fn is_free_beside(&self) -> bool {
        self.supervisor.is_up() && !self.unsent && !self.client.busy_beside() && !self.flight.is_full()
    }

    /// Whether something that was handed over may not have arrived.
    pub(crate) fn is_unacknowledged(&self) -> bool {
        !self.flight.is_empty()
    }

    /// Writes the command to `out`; it must be acknowledged by `until`.
    pub(crate) fn send(
        &mut self,
        (keyword, command): (Keyword, Waiting),
        text: &str,
        dialect: &Dialect,
        out: &mut [u8],
        (now, until): (Instant, Instant),
    ) -> Result<usize, StartError> {
        let sent = Some(Sent { command, keyword, at: now, has_text: false });
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
        self.flight.sent(len, until, Since::NONE);
        Ok(len)
    }

    /// The transport has taken everything.
    pub(crate) fn taken(&mut self) {
        self.unsent = false;
    }

    /// The peer's transport has acknowledged all but `left` bytes.
    pub(crate) fn acked(&mut self, left: u32) {
        self.flight.acked(left, |_| ());
    }

    /// Notes bytes that arrived.
    pub(crate) fn heard(&mut self, len: usize, now: Instant) {
        self.supervisor.heard(now);
        add(&mut self.counters.bytes_in, len);
    }

    /// The instant at which events count: before the deadline, however late they are handled, because only a tick lets
    /// it pass.
    pub(crate) fn in_time(&self, now: Instant) -> Instant {
        let before = |at: Instant| at - Duration::from_micros(1);
        self.client.deadline().map_or(now, |deadline| now.min(before(deadline)))
    }

    /// The connection is gone; returns the commands in flight.
    pub(crate) fn lost(&mut self) -> [Option<Sent>; 2] {
        self.client.abort();
        self.flight.clear();
        self.unsent = false;
        [self.in_flight.take(), self.beside.take()]
    }

    /// Whether the connection must be given up because something was not acknowledged in time.
    pub(crate) fn is_overdue(&mut self, now: Instant) -> bool {
        let overdue = now >= self.flight.deadline();
        if overdue {
            bump(&mut self.counters.unacknowledged);
        }
        overdue
    }

    /// Whether the client has an event without new bytes.
    pub(crate) fn is_due(&self, now: Instant) -> bool {
        self.client.deadline().is_some_and(|at| now >= at)
    }

    /// The next event, from `rest` or from the clock.
    pub(crate) fn step(&mut self, rest: &mut &[u8], now: Instant) -> Option<Event> {
        let (beside, kind) = match self.client.receive(now, rest)? {
            ClientEvent::Reply { beside, kind, .. } => (beside, kind),
            ClientEvent::Timeout => {
                bump(&mut self.counters.timeouts);
                return Some(Event::TimedOut);
            }
            ClientEvent::ScriptFinish => return Some(Event::Other),
            ClientEvent::Unsolicited { text, beside } => {
                bump(&mut self.counters.malformed);
                let sent = match beside {
                    None => None,
                    Some(false) => self.in_flight.as_mut(),
                    Some(true) => self.beside.as_mut(),
                };
                self.last_text = Some(LastText::new(now, text, sent.as_ref().map(|sent| sent.command)));
                if let Some(sent) = sent {
                    // A text that came before the command had arrived is not its reply.
                    sent.has_text |= self.flight.is_empty();
                }
                return Some(Event::Other);
            }
        };
        let code = match kind {
            ReplyKind::Success | ReplyKind::Value => ReplyCode::Success,
            ReplyKind::Fail => ReplyCode::Fail,
            ReplyKind::UnknownCommand => ReplyCode::Other,
        };
        let sent = match beside {
            true => self.beside.take(),
            false => core::mem::replace(&mut self.in_flight, self.beside.take()),
        };
        if self.in_flight.is_none() {
            self.flight.answered();
        }
        let Some(sent) = sent else { return Some(Event::Other) };
        let micros = now.saturating_since(sent.at).as_micros();
        self.counters.answered(u32::try_from(micros).unwrap_or(u32::MAX));
        if code == ReplyCode::Fail {
            bump(&mut self.counters.refused);
        }
        Some(Event::Answered(sent, code))
    }

    /// When something is due without an input, except in the supervisor.
    pub(crate) fn deadline(&self) -> Instant {
        self.client.deadline().unwrap_or(Instant::NEVER).min(self.flight.deadline())
    }
}

/// When an urgent command may be sent although one of its kind is unanswered.
pub(crate) fn may_go_at(sessions: [Option<&Session>; 2], keyword: Keyword) -> Instant {
    let sent = sessions.into_iter().flatten().flat_map(|session| [session.in_flight, session.beside]);
    let same = sent.flatten().filter(|sent| sent.keyword == keyword);
    same.map(|sent| sent.at + STOP_TTL).max().unwrap_or(Instant::ZERO)
}
