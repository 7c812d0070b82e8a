//! The controller's side of a port-2000 connection: where one command ends and the next begins (docs/wire/command.md
//! section 5).
//!
//! In: received bytes and the time. Out: requests, and texts to be answered with `unknown command`. Does not execute
//! anything.

use super::MAX_COMMAND;
use super::request::{Keyword, Request, may_become_command};
use super::text::{is_blank, is_terminator, trim};
use crate::time::{Duration, Instant};

/// Splits one connection's bytes into commands.
///
/// Call [`receive`](Self::receive) with each piece until it returns `None`; when [`deadline`](Self::deadline) is
/// reached, call [`poll`](Self::poll) until it returns `None`. Polling early is harmless.
#[derive(Debug, Clone)]
pub struct CommandServer {
    /// A keyword without arguments is complete after this much silence: 20 ms (D2).
    pub keyword_gap: Duration,
    /// After this much silence the dropping of an overlong command ends, and a text that can no longer become a command
    /// is given up: 100 ms (D5).
    pub drop_gap: Duration,
    /// An incomplete command is given up after this much silence: 10 s.
    pub beginning_gap: Duration,
    buffer: [u8; MAX_COMMAND],
    len: usize,
    /// The buffer holds a command that was returned; the next call removes it.
    handed_out: bool,
    /// Dropping the rest of an overlong command.
    dropping: bool,
    /// Silence ended the previous command: its empty parentheses may still follow.
    ended_by_gap: bool,
    /// When the newest byte arrived.
    newest: Instant,
}

/// What a client sent.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum ServerEvent<'a> {
    /// A command.
    Request(Request<'a>),
    /// Something else; the answer is [`Reply::UnknownCommand`](super::Reply::UnknownCommand).
    Unknown(UnknownCommand<'a>),
}

/// A text to be answered with `unknown command`.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum UnknownCommand<'a> {
    /// A text that is not a command.
    Text(&'a [u8]),
    /// More than [`MAX_COMMAND`] bytes without an end; the rest is dropped.
    TooLong,
}

impl CommandServer {
    /// A server for a new connection.
    pub const fn new() -> Self {
        Self {
            keyword_gap: Duration::from_millis(20),
            drop_gap: Duration::from_millis(100),
            beginning_gap: Duration::from_secs(10),
            buffer: [0; MAX_COMMAND],
            len: 0,
            handed_out: false,
            dropping: false,
            ended_by_gap: false,
            newest: Instant::ZERO,
        }
    }

    /// Takes bytes from the front of `bytes` until a command is complete. `None` if all are taken and no command is
    /// complete.
    pub fn receive(&mut self, now: Instant, bytes: &mut &[u8]) -> Option<ServerEvent<'_>> {
        if self.handed_out {
            self.handed_out = false;
            self.len = 0;
        }
        match self.step(now, bytes)? {
            StepEnd::TooLong => Some(ServerEvent::Unknown(UnknownCommand::TooLong)),
            StepEnd::Command => {
                self.handed_out = true;
                let text = trim(self.buffer.get(..self.len).unwrap_or(&[]));
                Some(match Request::parse(text) {
                    Ok(request) => ServerEvent::Request(request),
                    Err(_) => ServerEvent::Unknown(UnknownCommand::Text(text)),
                })
            }
        }
    }

    /// Returns a command that silence has completed by `now`.
    pub fn poll(&mut self, now: Instant) -> Option<ServerEvent<'_>> {
        self.receive(now, &mut &[][..])
    }

    /// When silence completes the received bytes, if it does.
    pub fn deadline(&self) -> Option<Instant> {
        Some(self.newest + self.gap()?)
    }

    /// Drops all received bytes, for a new connection.
    pub fn reset(&mut self) {
        let Self { keyword_gap, drop_gap, beginning_gap, .. } = *self;
        *self = Self { keyword_gap, drop_gap, beginning_gap, ..Self::new() };
    }

    fn step(&mut self, now: Instant, bytes: &mut &[u8]) -> Option<StepEnd> {
        if self.deadline().is_some_and(|deadline| now >= deadline) {
            if !self.dropping {
                self.ended_by_gap = is_bare_keyword(trim(self.text()));
                return Some(StepEnd::Command);
            }
            self.dropping = false;
        }
        while let Some((&byte, rest)) = bytes.split_first() {
            *bytes = rest;
            self.newest = now;
            if self.dropping {
                self.dropping = !is_terminator(byte);
                continue;
            }
            if self.len == 0 && is_blank(byte) {
                continue;
            }
            if is_terminator(byte) {
                return Some(self.end());
            }
            let Some(place) = self.buffer.get_mut(self.len) else {
                self.len = 0;
                self.dropping = true;
                self.ended_by_gap = false;
                return Some(StepEnd::TooLong);
            };
            *place = byte;
            self.len = self.len.saturating_add(1);
            if byte == b')' && self.text().contains(&b'(') {
                if self.ended_by_gap && is_empty_pair(self.text()) {
                    self.ended_by_gap = false;
                    self.len = 0;
                    continue;
                }
                return Some(self.end());
            }
        }
        None
    }

    fn end(&mut self) -> StepEnd {
        self.ended_by_gap = false;
        StepEnd::Command
    }

    /// The silence that ends the text in the buffer.
    fn gap(&self) -> Option<Duration> {
        if self.dropping {
            return Some(self.drop_gap);
        }
        let text = if self.handed_out { &[][..] } else { trim(self.text()) };
        if text.is_empty() {
            return None;
        }
        if is_bare_keyword(text) {
            return Some(self.keyword_gap);
        }
        let may_go_on = may_become_command(self.text()) || (self.ended_by_gap && text == b"(");
        Some(if may_go_on { self.beginning_gap } else { self.drop_gap })
    }

    fn text(&self) -> &[u8] {
        self.buffer.get(..self.len).unwrap_or(&[])
    }
}

impl Default for CommandServer {
    fn default() -> Self {
        Self::new()
    }
}

/// Why [`CommandServer::step`] stopped.
enum StepEnd {
    /// The buffer is a command.
    Command,
    /// The buffer overflowed.
    TooLong,
}

fn is_bare_keyword(text: &[u8]) -> bool {
    Keyword::ALL.into_iter().any(|keyword| keyword.is_bare() && keyword.word().as_bytes() == text)
}

/// `()`, perhaps with blanks between.
fn is_empty_pair(text: &[u8]) -> bool {
    matches!(text, [b'(', inner @ .., b')'] if trim(inner).is_empty())
}
