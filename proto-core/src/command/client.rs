//! The gateway's side of a port-2000 connection: one request in flight, one urgent request besides it, and how the ends
//! of their replies are found (docs/wire/command.md section 6).
//!
//! In: a command to send, received bytes and the time. Out: the bytes to send, replies, unsolicited texts, and a
//! timeout. Does not decide what to send or to repeat.

use core::cell::Cell;
use core::fmt;

use super::reply::{Match, Reply, ReplyKind, SCRIPT_FINISH, failure, match_fixed, match_value, named_at};
use super::request::{EncodeError, Keyword, ParseError, Request};
use super::text::{is_blank, is_terminator, trim_start};
use crate::time::{Duration, Instant};
use crate::wire::dialect::{Dialect, Parentheses, Terminator};

/// Maximum length of a reply; the rest of a longer one is dropped and counted.
pub const MAX_REPLY: usize = 320;

/// One connection to port 2000.
///
/// Call [`receive`](Self::receive) with each piece until it returns `None`; when [`deadline`](Self::deadline) is
/// reached, call [`poll`](Self::poll) until it returns `None`. Polling early is harmless.
#[derive(Debug, Clone)]
pub struct CommandClient {
    /// A reply that further bytes could extend is complete after this much silence: 20 ms.
    pub quiet_gap: Duration,
    /// Like `quiet_gap`, for the reply to `getlasterror`, whose free text may come in pieces: 100 ms.
    pub message_gap: Duration,
    /// A request without a reply is given up after this time: 10 s. Powering on takes seconds, and its reply comes at
    /// the end.
    pub timeout: Duration,
    /// The older request in flight.
    waiting: Option<PendingRequest>,
    /// The urgent request, sent without waiting for the reply to the older one.
    beside: Option<PendingRequest>,
    buffer: [u8; MAX_REPLY],
    len: usize,
    /// Number of bytes at the front that were returned; the next call removes them.
    handed_out: usize,
    /// Dropping the rest of a text that was too long.
    dropping: bool,
    newest: Instant,
    dropped: u32,
}

#[derive(Debug, Clone, Copy)]
struct PendingRequest {
    keyword: Keyword,
    /// When it was written.
    since: Instant,
    until: Instant,
    /// An unknown text was received that may be its reply.
    has_text: bool,
}

/// The result of a request, or an unsolicited text.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum ClientEvent<'a> {
    /// The reply to a request in flight, which has then ended.
    Reply {
        /// Whether it replies to the newer of two requests. After the reply to the older one, the newer one is the only
        /// one in flight.
        beside: bool,
        /// The kind of answer.
        kind: ReplyKind,
        /// The answer.
        reply: Reply<'a>,
        /// The answer's text, without a terminator.
        text: &'a [u8],
    },
    /// A program that was started from port 2000 has ended.
    ScriptFinish,
    /// A text that answers no request in flight: a late reply, or an unknown text. All requests stay in flight.
    Unsolicited {
        /// The text, without a terminator.
        text: &'a [u8],
        /// The request in flight that the unknown text may be a reply to: `true` for the urgent one besides the older
        /// one. `None` for a late reply, or if it can be no request.
        beside: Option<bool>,
    },
    /// The request in flight is given up. Its reply may still come, as an unsolicited text; a value would be taken for
    /// the next reply of its kind, so reconnect before the next request.
    Timeout,
}

/// Why a command cannot be sent.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
#[non_exhaustive]
pub enum StartError {
    /// A request is already in flight.
    Busy,
    /// The text is not a command.
    Command(ParseError),
    /// The command cannot be encoded.
    Encode(EncodeError),
}

impl fmt::Display for StartError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Busy => f.write_str("the previous command has not been answered yet"),
            Self::Command(error) => error.fmt(f),
            Self::Encode(error) => error.fmt(f),
        }
    }
}

impl core::error::Error for StartError {}

impl CommandClient {
    /// A client for a new connection.
    pub const fn new() -> Self {
        Self {
            quiet_gap: Duration::from_millis(20),
            message_gap: Duration::from_millis(100),
            timeout: Duration::from_secs(10),
            waiting: None,
            beside: None,
            buffer: [0; MAX_REPLY],
            len: 0,
            handed_out: 0,
            dropping: false,
            newest: Instant::ZERO,
            dropped: 0,
        }
    }

    /// Whether a request is in flight.
    pub const fn busy(&self) -> bool {
        self.waiting.is_some()
    }

    /// Whether two requests are in flight, so that no other one can be sent.
    pub const fn busy_beside(&self) -> bool {
        self.beside.is_some()
    }

    /// Number of dropped bytes of texts longer than [`MAX_REPLY`], wrapping.
    pub const fn dropped_bytes(&self) -> u32 {
        self.dropped
    }

    /// Writes the command `text` in the dialect's form to the front of `out` and returns its length. The request is
    /// then in flight.
    ///
    /// # Errors
    /// [`StartError`]; nothing was started then.
    pub fn start(
        &mut self,
        now: Instant,
        text: &[u8],
        dialect: &Dialect,
        out: &mut [u8],
    ) -> Result<usize, StartError> {
        let request = Request::parse_strict(text).map_err(StartError::Command)?;
        self.start_request(now, &request, dialect, out)
    }

    /// Like [`start`](Self::start), for a parsed request.
    ///
    /// # Errors
    /// [`StartError`]; nothing was started then.
    pub fn start_request(
        &mut self,
        now: Instant,
        request: &Request<'_>,
        dialect: &Dialect,
        out: &mut [u8],
    ) -> Result<usize, StartError> {
        if self.busy() {
            return Err(StartError::Busy);
        }
        let len = request.encode(dialect, out).map_err(StartError::Encode)?;
        self.drop_handed_out();
        // Bytes received before the request cannot be part of its reply.
        if !SCRIPT_FINISH.as_bytes().starts_with(self.received()) {
            self.len = 0;
        }
        self.waiting = Some(self.written(request.keyword(), now));
        Ok(len)
    }

    /// Writes an urgent command without waiting for the reply to the request in flight. Replies are matched by their
    /// keywords (D26); a reply that fits both belongs to the older request. If the older one is a keyword with nothing
    /// after it, a line feed ends it first, because `resumestop` is not a command (D2). Without a request in flight
    /// this is the same as [`start`](Self::start).
    ///
    /// # Errors
    /// [`StartError`]; nothing was started then. [`StartError::Busy`] if two requests are already in flight.
    pub fn start_beside(
        &mut self,
        now: Instant,
        text: &[u8],
        dialect: &Dialect,
        out: &mut [u8],
    ) -> Result<usize, StartError> {
        if self.beside.is_some() {
            return Err(StartError::Busy);
        }
        let Some(older) = self.waiting else { return self.start(now, text, dialect, out) };
        let request = Request::parse_strict(text).map_err(StartError::Command)?;
        let is_open = older.keyword.is_bare()
            && (dialect.terminator, dialect.parentheses) == (Terminator::None, Parentheses::Omitted);
        let len = match out.split_first_mut() {
            Some((end, rest)) if is_open => {
                let len = request.encode(dialect, rest).map_err(StartError::Encode)?;
                *end = b'\n';
                len.saturating_add(1)
            }
            _ => request.encode(dialect, out).map_err(StartError::Encode)?,
        };
        self.beside = Some(self.written(request.keyword(), now));
        Ok(len)
    }

    fn written(&self, keyword: Keyword, now: Instant) -> PendingRequest {
        PendingRequest { keyword, since: now, until: now + self.timeout, has_text: false }
    }

    /// Takes bytes from the front of `bytes` until an event is complete. `None` if all are taken and no event is
    /// complete.
    pub fn receive(&mut self, now: Instant, bytes: &mut &[u8]) -> Option<ClientEvent<'_>> {
        self.drop_handed_out();
        let mut silent = self.gap().is_some_and(|gap| now >= self.newest + gap);
        let found = loop {
            if let Some(found) = self.scan(silent) {
                break Some(found);
            }
            let Some((&byte, rest)) = bytes.split_first() else { break None };
            *bytes = rest;
            self.newest = now;
            silent = false;
            self.push(byte);
        };
        match found {
            Some(found) => Some(self.hand_out(found)),
            None if self.timeout_at().is_some_and(|until| now >= until) => {
                self.waiting = None;
                self.beside = None;
                Some(ClientEvent::Timeout)
            }
            None => None,
        }
    }

    /// Returns an event that silence has completed by `now`, or a timeout.
    pub fn poll(&mut self, now: Instant) -> Option<ClientEvent<'_>> {
        self.receive(now, &mut &[][..])
    }

    /// When to call [`poll`](Self::poll) if no more bytes arrive.
    pub fn deadline(&self) -> Option<Instant> {
        let gap = self.gap().map(|gap| self.newest + gap);
        match (gap, self.timeout_at()) {
            (Some(gap), Some(timeout)) => Some(gap.min(timeout)),
            (gap, timeout) => gap.or(timeout),
        }
    }

    /// Drops the requests in flight and all received bytes, for a new connection.
    pub fn abort(&mut self) {
        self.waiting = None;
        self.beside = None;
        self.len = 0;
        self.handed_out = 0;
        self.dropping = false;
    }

    /// Interprets the front of the buffer. `silent` says whether enough silence has followed.
    fn scan(&mut self, silent: bool) -> Option<Scanned> {
        let blanks = self.received().iter().take_while(|&&byte| is_blank(byte)).count();
        self.drop_front(blanks);
        if self.dropping {
            self.dropping = !silent;
            return None;
        }
        let bytes = self.received();
        if bytes.is_empty() {
            return None;
        }
        let full = bytes.len() == MAX_REPLY;
        match self.front(bytes) {
            Match::Complete { len, reply } => Some(self.judge(len, &reply)),
            Match::Open { len, reply } if silent || full => {
                let found = self.judge(len, &reply);
                self.dropping = full;
                Some(found)
            }
            Match::Open { .. } | Match::Partial => None,
            Match::No => {
                let line = bytes.iter().position(|&byte| is_terminator(byte));
                if line.is_none() && !silent && !full {
                    return None;
                }
                let end = line.unwrap_or(bytes.len());
                // A reply may directly follow an unknown text.
                let glued = (1..end).find(|&at| {
                    let rest = bytes.get(at..).unwrap_or(&[]);
                    matches!(match_fixed(rest), Match::Complete { .. })
                });
                Some(self.judge_words(glued.unwrap_or(end)))
            }
        }
    }

    /// Matches the front of `bytes`, given the request in flight.
    fn front<'b>(&self, bytes: &'b [u8]) -> Match<'b> {
        let fixed = match_fixed(bytes);
        if matches!(fixed, Match::Complete { .. }) {
            return fixed;
        }
        match self.waiting.map_or(Match::No, |waiting| match_value(waiting.keyword, bytes)) {
            Match::No => fixed,
            value => value,
        }
    }

    fn judge(&self, len: usize, reply: &Reply<'_>) -> Scanned {
        let answers = |waiting: Option<PendingRequest>| waiting.is_some_and(|w| reply.answers(w.keyword));
        match reply {
            Reply::ScriptFinish => Scanned::ScriptFinish { len },
            _ if answers(self.waiting) => Scanned::Reply { len, beside: false },
            _ if answers(self.beside) => Scanned::Reply { len, beside: true },
            _ => Scanned::Unsolicited { len, beside: None },
        }
    }

    /// Interprets the unknown text at the front: it is a failure if it names a request and reports one. Otherwise it
    /// may be a reply to the request that it names, or else to the oldest request that has had no text yet.
    fn judge_words(&self, len: usize) -> Scanned {
        let text = self.received().get(..len).unwrap_or(&[]);
        let requests = [(false, self.waiting), (true, self.beside)];
        // A text that was received before a request was sent is not its reply.
        let requests = requests.into_iter().filter_map(|(beside, waiting)| Some((beside, waiting?)));
        let requests = requests.filter(|(_, waiting)| waiting.since <= self.newest);
        let named = requests.clone().filter_map(|(beside, waiting)| {
            Some((named_at(waiting.keyword, text)?, beside, waiting.keyword))
        });
        match named.min_by_key(|(at, ..)| *at) {
            Some((_, beside, keyword)) if failure(keyword, text).is_some() => Scanned::Reply { len, beside },
            Some((_, beside, _)) => Scanned::Unsolicited { len, beside: Some(beside) },
            None => {
                let beside =
                    requests.clone().find(|(_, waiting)| !waiting.has_text).map(|(beside, _)| beside);
                Scanned::Unsolicited { len, beside }
            }
        }
    }

    /// When the first request in flight is given up.
    fn timeout_at(&self) -> Option<Instant> {
        let waiting = self.waiting.iter().chain(&self.beside);
        waiting.map(|waiting| waiting.until).min()
    }

    /// The silence that ends the text in the buffer.
    fn gap(&self) -> Option<Duration> {
        if self.dropping {
            return Some(self.message_gap);
        }
        let bytes = trim_start(self.buffer.get(self.handed_out..self.len).unwrap_or(&[]));
        if bytes.is_empty() {
            return None;
        }
        match self.front(bytes) {
            Match::Open { reply: Reply::LastError { .. }, .. } => Some(self.message_gap),
            Match::Open { .. } | Match::No => Some(self.quiet_gap),
            Match::Complete { .. } | Match::Partial => None,
        }
    }

    fn push(&mut self, byte: u8) {
        if self.dropping {
            self.dropping = !is_terminator(byte);
            self.dropped = self.dropped.wrapping_add(1);
            return;
        }
        match self.buffer.get_mut(self.len) {
            Some(place) => {
                *place = byte;
                self.len = self.len.saturating_add(1);
            }
            // The beginning of a reply is never as long as the buffer: see the longest replies.
            None => self.len = 0,
        }
    }

    fn hand_out(&mut self, found: Scanned) -> ClientEvent<'_> {
        let (Scanned::Reply { len, .. } | Scanned::ScriptFinish { len } | Scanned::Unsolicited { len, .. }) =
            found;
        self.handed_out = len;
        let waiting = match found {
            Scanned::Reply { beside: false, .. } => core::mem::replace(&mut self.waiting, self.beside.take()),
            Scanned::Reply { beside: true, .. } => self.beside.take(),
            Scanned::Unsolicited { beside: Some(beside), .. } => {
                let request = if beside { &mut self.beside } else { &mut self.waiting };
                if let Some(waiting) = request {
                    waiting.has_text = true;
                }
                None
            }
            _ => None,
        };
        let bytes = self.buffer.get(..self.len).unwrap_or(&[]);
        let text = bytes.get(..len).unwrap_or(&[]);
        match found {
            Scanned::ScriptFinish { .. } => ClientEvent::ScriptFinish,
            Scanned::Unsolicited { beside, .. } => ClientEvent::Unsolicited { text, beside },
            Scanned::Reply { beside, .. } => {
                match waiting.and_then(|waiting| Reply::parse(waiting.keyword, text)) {
                    Some(reply) => ClientEvent::Reply { beside, kind: reply.kind(), reply, text },
                    None => ClientEvent::Unsolicited { text, beside: None },
                }
            }
        }
    }

    fn received(&self) -> &[u8] {
        self.buffer.get(..self.len).unwrap_or(&[])
    }

    fn drop_handed_out(&mut self) {
        let count = core::mem::take(&mut self.handed_out);
        self.drop_front(count);
    }

    fn drop_front(&mut self, count: usize) {
        if count > 0
            && let Some(held) = self.buffer.get_mut(..self.len)
            && count <= held.len()
        {
            // Like `copy_within`, without a range check.
            let held = Cell::from_mut(held).as_slice_of_cells();
            for (to, from) in held.iter().zip(held.iter().skip(count)) {
                to.set(from.get());
            }
            self.len = self.len.saturating_sub(count);
        }
    }
}

impl Default for CommandClient {
    fn default() -> Self {
        Self::new()
    }
}

/// What [`CommandClient::scan`] found at the front of the buffer.
enum Scanned {
    Reply { len: usize, beside: bool },
    ScriptFinish { len: usize },
    Unsolicited { len: usize, beside: Option<bool> },
}
