//! The link to port 2000: commands that field values pick, one after the other.
//!
//! A command is sent once or not at all. What cannot be sent soon is dropped and said so in the
//! port's reply code: a robot must not start later because of a button pressed earlier.

use heapless::{Deque, String, Vec};

use super::counters::{LinkCounters, PortCounters, add, bump};
use super::field_port::{FieldPort, ReplyCode};
use super::io::PortId;
use crate::command::{ClientEvent, CommandClient, ReplyKind};
use crate::config::{CommandEntry, CommandWhen, MAX_COMMANDS, Span};
use crate::link::{LinkTimings, Supervisor};
use crate::time::{Duration, Instant};
use crate::wire::dialect::Dialect;
use crate::wire::scalar::Scalar;

/// Fields bound to command tables, over all ports.
pub const MAX_COMMAND_FIELDS: usize = 16;
/// Bytes of command texts, over all tables.
pub const MAX_COMMAND_BYTES: usize = 1024;
/// Commands that can wait for the one before them.
pub const COMMAND_QUEUE: usize = 8;
/// A command that could not be sent within this time is dropped.
const COMMAND_TTL: Duration = Duration::from_secs(1);

/// A field whose values pick commands.
#[derive(Debug, Clone, Copy)]
pub(super) struct CommandField {
    pub table: Span,
    pub when: CommandWhen,
    /// The value of the frame before; none after silence.
    pub last: Option<i64>,
}

/// All command tables.
#[derive(Debug, Clone)]
struct Tables {
    entries: Vec<Entry, MAX_COMMANDS>,
    /// The texts of all entries, one behind the other.
    texts: String<MAX_COMMAND_BYTES>,
}

/// One line of a command table.
#[derive(Debug, Clone, Copy)]
struct Entry {
    value: i64,
    start: u16,
    len: u16,
}

#[derive(Debug, Clone, Copy)]
struct Waiting {
    port: PortId,
    entry: u16,
    since: Instant,
    /// How many commands the port had picked with it: only the newest one's outcome is shown.
    nth: u32,
}

#[derive(Debug, Clone)]
pub(super) struct CommandLink {
    pub supervisor: Supervisor,
    pub counters: LinkCounters,
    client: CommandClient,
    dialect: Dialect,
    tables: Tables,
    fields: Vec<CommandField, MAX_COMMAND_FIELDS>,
    queue: Deque<Waiting, COMMAND_QUEUE>,
    in_flight: Option<Waiting>,
    /// The transport has not taken the newest command yet.
    unsent: bool,
}

impl Tables {
    fn new(entries: &[CommandEntry]) -> Option<Self> {
        let mut tables = Self { entries: Vec::new(), texts: String::new() };
        for entry in entries {
            let start = tables.texts.len() as u16;
            tables.texts.push_str(&entry.text).ok()?;
            tables.entries.push(Entry { value: entry.value, start, len: entry.text.len() as u16 }).ok()?;
        }
        Some(tables)
    }

    fn text(&self, entry: u16) -> Option<&str> {
        let entry = self.entries.get(usize::from(entry))?;
        let start = usize::from(entry.start);
        self.texts.get(start..start.saturating_add(usize::from(entry.len)))
    }
}

impl CommandLink {
    /// A link with these command tables; `None` when their texts are too long together.
    pub(super) fn new(dialect: Dialect, entries: &[CommandEntry]) -> Option<Self> {
        Some(Self {
            supervisor: Supervisor::new(LinkTimings::TCP),
            counters: LinkCounters::default(),
            client: CommandClient::new(),
            dialect,
            tables: Tables::new(entries)?,
            fields: Vec::new(),
            queue: Deque::new(),
            in_flight: None,
            unsent: false,
        })
    }

    /// Adds a field; its index, or `None` when there are too many.
    pub(super) fn add_field(&mut self, table: Span, when: CommandWhen) -> Option<u8> {
        let index = self.fields.len() as u8;
        self.fields.push(CommandField { table, when, last: None }).ok()?;
        Some(index)
    }

    /// An accepted frame brought a value of a command field.
    pub(super) fn value(
        &mut self,
        field: u8,
        value: Scalar,
        port: PortId,
        reply: &mut ReplyCode,
        counters: &mut PortCounters,
        now: Instant,
    ) {
        let Some(field) = self.fields.get_mut(usize::from(field)) else { return };
        // Only integer fields can be bound to a table.
        let value = value.as_f64() as i64;
        let before = field.last.replace(value);
        let acts = match field.when {
            CommandWhen::Frame => true,
            CommandWhen::Change => before.is_some_and(|before| before != value),
        };
        let table = field.table;
        let entries = table.of(&self.tables.entries);
        let picked = (table.start..).zip(entries).find(|(_, entry)| entry.value == value);
        let (true, Some((entry, _))) = (acts, picked) else { return };
        bump(&mut counters.commands);
        let waiting = Waiting { port, entry, since: now, nth: counters.commands };
        if self.supervisor.is_up() && self.queue.push_back(waiting).is_ok() {
            *reply = ReplyCode::Pending;
        } else {
            bump(&mut counters.commands_dropped);
            *reply = ReplyCode::NotSent;
        }
    }

    /// After silence the next value of the field only sets the base.
    pub(super) fn forget(&mut self, field: u8) {
        if let Some(field) = self.fields.get_mut(usize::from(field)) {
            field.last = None;
        }
    }

    /// The link is gone: nothing that waited is sent later.
    pub(super) fn lost(&mut self, ports: &mut [FieldPort]) {
        self.client.abort();
        self.unsent = false;
        if let Some(sent) = self.in_flight.take() {
            settle(ports, sent, ReplyCode::NoReply);
        }
        while let Some(waiting) = self.queue.pop_front() {
            drop_one(ports, waiting);
        }
    }

    /// The transport took everything.
    pub(super) fn sent(&mut self) {
        self.unsent = false;
    }

    /// Bytes from the controller.
    pub(super) fn bytes(&mut self, bytes: &[u8], ports: &mut [FieldPort], now: Instant) {
        self.supervisor.heard(now);
        add(&mut self.counters.bytes_in, bytes.len());
        let mut rest = bytes;
        while self.step(&mut rest, ports, now) {}
    }

    /// Looks at the clock: replies that silence completes, timeouts, commands that waited too long.
    pub(super) fn advance(&mut self, ports: &mut [FieldPort], now: Instant) {
        if self.client.deadline().is_some_and(|at| now >= at) {
            let mut rest: &[u8] = &[];
            while self.step(&mut rest, ports, now) {}
        }
        while let Some(&waiting) = self.queue.front()
            && now >= waiting.since + COMMAND_TTL
        {
            self.queue.pop_front();
            drop_one(ports, waiting);
        }
    }

    /// The next command, when one may be sent.
    pub(super) fn next_command(
        &mut self,
        ports: &mut [FieldPort],
        out: &mut [u8],
        now: Instant,
    ) -> Option<usize> {
        if !self.supervisor.is_up() || self.client.busy() || self.unsent {
            return None;
        }
        let waiting = self.queue.pop_front()?;
        let text = self.tables.text(waiting.entry).unwrap_or("");
        match self.client.start(now, text.as_bytes(), &self.dialect, out) {
            Ok(len) => {
                bump(&mut self.counters.sent);
                self.in_flight = Some(Waiting { since: now, ..waiting });
                self.unsent = true;
                Some(len)
            }
            Err(_) => {
                drop_one(ports, waiting);
                None
            }
        }
    }

    /// When [`Self::advance`] has something to do.
    pub(super) fn deadline(&self) -> Instant {
        let waiting = self.queue.front().map_or(Instant::NEVER, |waiting| waiting.since + COMMAND_TTL);
        self.client.deadline().unwrap_or(Instant::NEVER).min(waiting)
    }

    /// One event of the client; false when there is none.
    fn step(&mut self, rest: &mut &[u8], ports: &mut [FieldPort], now: Instant) -> bool {
        let code = match self.client.receive(now, rest) {
            None => return false,
            Some(ClientEvent::Reply { kind, .. }) => match kind {
                ReplyKind::Success | ReplyKind::Value => ReplyCode::Success,
                ReplyKind::Fail => ReplyCode::Fail,
                _ => ReplyCode::Other,
            },
            Some(ClientEvent::Timeout) => {
                // A late reply would be taken for that of the next command.
                bump(&mut self.counters.timeouts);
                self.supervisor.give_up(now);
                self.lost(ports);
                return false;
            }
            Some(ClientEvent::ScriptFinish) => return true,
            Some(_) => {
                bump(&mut self.counters.malformed);
                return true;
            }
        };
        if let Some(sent) = self.in_flight.take() {
            self.counters.answered(now.saturating_since(sent.since).as_micros());
            if code == ReplyCode::Fail {
                bump(&mut self.counters.refused);
            }
            settle(ports, sent, code);
        }
        true
    }
}

/// A command came to its end.
fn settle(ports: &mut [FieldPort], command: Waiting, code: ReplyCode) {
    if let Some(port) = ports.iter_mut().find(|port| port.id == command.port)
        && port.counters.commands == command.nth
    {
        port.reply = code;
    }
}

fn drop_one(ports: &mut [FieldPort], command: Waiting) {
    if let Some(port) = ports.iter_mut().find(|port| port.id == command.port) {
        bump(&mut port.counters.commands_dropped);
    }
    settle(ports, command, ReplyCode::NotSent);
}
