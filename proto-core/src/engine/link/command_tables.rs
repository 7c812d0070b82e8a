//! Command tables: which command a field's value picks, and its text.
//!
//! In: the tables of the configuration, and values. Out: entries. Does not know when a command is sent.

use heapless::{String, Vec};

use super::stops::Waiting;
use crate::command::{Keyword, Request};
use crate::config::{CommandEntry, CommandWhen, MAX_COMMANDS, Span, placeholders};
use crate::engine::io::ReplyCode;

/// Bytes of command texts, over all tables.
pub(crate) const MAX_COMMAND_BYTES: usize = 1024;

/// A field whose values pick commands.
#[derive(Debug, Clone, Copy)]
pub(crate) struct CommandField {
    pub table: Span,
    pub when: CommandWhen,
    /// The value in the previous frame; `None` after silence.
    pub last: Option<i64>,
    /// Index of its input frame, and its index in the frame.
    pub place: (u8, u8),
    /// The gateway has slept since the previous frame's value: the change may have been discarded.
    pub woke: bool,
    /// The table has entries that pick nothing; otherwise the value 0 picks nothing.
    pub names_idle: bool,
}

impl CommandField {
    /// The frame is overdue: the next value only sets the base, except in a field that keeps its base because the
    /// device sends only changes. Returns whether a base was lost.
    pub(crate) fn silent(&mut self) -> bool {
        self.when != CommandWhen::Kept && self.last.take().is_some()
    }

    /// The device is gone: the next value only sets the base. Returns whether there was a base.
    pub(crate) fn forget(&mut self) -> bool {
        self.woke = false;
        self.last.take().is_some()
    }

    /// The gateway slept: the next value only sets the base, unless it stops the robot.
    pub(crate) fn slept(&mut self) {
        self.woke |= self.last.take().is_some();
    }
}

/// The result of a field's value.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Picked {
    Nothing,
    /// The value is not in the table.
    Unknown,
    /// The value would pick a command, but there is no base.
    Based,
    /// The port's next command, with its reply code until the result is known.
    Command {
        reply: ReplyCode,
        /// It will not be sent, and no other result follows.
        is_dropped: bool,
    },
}

#[derive(Debug, Clone)]
pub(crate) struct Tables {
    entries: Vec<Entry, MAX_COMMANDS>,
    /// The texts of all entries, concatenated.
    texts: String<MAX_COMMAND_BYTES>,
}

#[derive(Debug, Clone, Copy)]
pub(crate) struct Entry {
    first: i64,
    last: i64,
    start: u16,
    /// 0 if the values pick nothing.
    pub len: u16,
    pub keyword: Keyword,
    /// The text contains the value.
    pub has_value: bool,
}

impl Tables {
    pub(crate) fn new(entries: &[CommandEntry]) -> Option<Self> {
        let mut tables = Self { entries: Vec::new(), texts: String::new() };
        for entry in entries {
            let start = tables.texts.len() as u16;
            tables.texts.push_str(&entry.text).ok()?;
            // Cannot fail: validation has refused texts that are not commands.
            let keyword = Request::parse(entry.text.as_bytes()).map_or(Keyword::State, |r| r.keyword());
            let &CommandEntry { first, last, .. } = entry;
            let (len, has_value) = (entry.text.len() as u16, placeholders(&entry.text) > 0);
            tables.entries.push(Entry { first, last, start, len, keyword, has_value }).ok()?;
        }
        Some(tables)
    }

    pub(crate) fn entry(&self, entry: u16) -> Option<(Entry, &str)> {
        let entry = self.entries.get(usize::from(entry))?;
        let start = usize::from(entry.start);
        let text = self.texts.get(start..start.saturating_add(usize::from(entry.len)))?;
        Some((*entry, text))
    }

    /// The entry of one table that has this value, and its index.
    pub(crate) fn find(&self, table: Span, value: i64) -> Option<(u16, &Entry)> {
        let has = |entry: &Entry| entry.first <= value && value <= entry.last;
        (table.start..).zip(table.of(&self.entries)).find(|(_, entry)| has(entry))
    }

    /// Whether the table has entries that pick nothing.
    pub(crate) fn names_idle(&self, table: Span) -> bool {
        table.of(&self.entries).iter().any(|entry| entry.len == 0)
    }

    pub(crate) fn has_urgent(&self) -> bool {
        self.entries.iter().any(|entry| entry.keyword.is_urgent())
    }
}

/// Whether the field that picked a command still has the same value.
pub(crate) fn is_asked(fields: &[CommandField], waiting: &Waiting) -> bool {
    fields.get(usize::from(waiting.field)).and_then(|field| field.last) == Some(waiting.value)
}
