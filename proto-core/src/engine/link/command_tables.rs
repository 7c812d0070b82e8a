//! Tables of commands: which command a field's value picks, and its text.
//!
//! In: the tables of the configuration, and values. Out: entries. Does not know when a command is
//! sent.

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
    /// The value in the previous frame; none after silence.
    pub last: Option<i64>,
    /// Index of its input frame, and its index in the frame.
    pub place: (u8, u8),
    /// The gateway has slept since the value in the previous frame: what changed it may have been discarded.
    pub woke: bool,
    /// The table names the values that pick nothing; otherwise it is 0.
    pub names_idle: bool,
}

impl CommandField {
    /// Its frame is overdue: the next value only sets the base, unless the field keeps it, because its device sends
    /// only changes. Whether there was one and is none.
    pub(crate) fn silent(&mut self) -> bool {
        self.when != CommandWhen::Kept && self.last.take().is_some()
    }

    /// Its device is gone: the next value only sets the base. Whether there was one.
    pub(crate) fn forget(&mut self) -> bool {
        self.woke = false;
        self.last.take().is_some()
    }

    /// The gateway slept: the next value only sets the base, unless it stops the robot.
    pub(crate) fn slept(&mut self) {
        self.woke |= self.last.take().is_some();
    }
}

/// What a field's value leads to.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Picked {
    Nothing,
    /// The table does not have the value.
    Unknown,
    /// It would pick a command, but there is no value before it.
    Based,
    /// One more command of the port, with the reply code until its result is known.
    Command {
        reply: ReplyCode,
        /// It will not be sent, and there is no further result.
        is_dropped: bool,
    },
}

/// All command tables.
#[derive(Debug, Clone)]
pub(crate) struct Tables {
    entries: Vec<Entry, MAX_COMMANDS>,
    /// The texts of all entries, one after the other.
    texts: String<MAX_COMMAND_BYTES>,
}

/// One entry of a command table.
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
            // Validation has refused everything that is not a command.
            let keyword = Request::parse(entry.text.as_bytes()).map_or(Keyword::State, |r| r.keyword());
            let &CommandEntry { first, last, .. } = entry;
            let (len, has_value) = (entry.text.len() as u16, placeholders(&entry.text) > 0);
            tables.entries.push(Entry { first, last, start, len, keyword, has_value }).ok()?;
        }
        Some(tables)
    }

    /// An entry and its text.
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

    /// Whether the table names values that pick nothing.
    pub(crate) fn names_idle(&self, table: Span) -> bool {
        table.of(&self.entries).iter().any(|entry| entry.len == 0)
    }

    /// Whether one of the commands is urgent.
    pub(crate) fn has_urgent(&self) -> bool {
        self.entries.iter().any(|entry| entry.keyword.is_urgent())
    }
}

/// Whether the field of a command still has the value that picked it.
pub(crate) fn is_asked(fields: &[CommandField], waiting: &Waiting) -> bool {
    fields.get(usize::from(waiting.field)).and_then(|field| field.last) == Some(waiting.value)
}
