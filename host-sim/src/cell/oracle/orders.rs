//! Commands that field values pick: once or not at all (docs/architecture.md section 7).

use std::collections::{BTreeMap, VecDeque};

use proto_core::config::{CommandWhen, MAX_PORTS};
use proto_core::time::{Duration, Instant};

use super::Invariant;
use super::field::Accepted;
use super::sheet::Sheet;
use super::upward::Wrong;

/// Commands that can wait.
const QUEUE: usize = 8;
/// One that could not be sent within this time is dropped.
const TTL: Duration = Duration::from_secs(1);

/// What waits, and what was counted.
#[derive(Debug, Clone, Default)]
pub(super) struct Orders {
    queue: VecDeque<(usize, String, Instant)>,
    /// The value of the frame before, by port, frame and field.
    base: BTreeMap<(usize, usize, usize), i64>,
    /// Picked and dropped, by port.
    pub counted: [(u32, u32); MAX_PORTS],
    /// Text of the newest command sent, with when it was picked.
    newest: Option<(String, Instant)>,
}

impl Orders {
    /// An accepted frame's values pick commands.
    pub(super) fn accepted(
        &mut self,
        sheet: &Sheet,
        nth: usize,
        frame: &Accepted,
        is_up: bool,
        now: Instant,
    ) {
        for &(field, table, when, value) in &frame.orders {
            let before = self.base.insert((nth, frame.frame, field), value);
            let acts = when == CommandWhen::Frame || before.is_some_and(|before| before != value);
            let Some((_, text)) = table.of(&sheet.commands).iter().find(|entry| entry.0 == value) else {
                continue;
            };
            if !acts {
                continue;
            }
            let counted = &mut self.counted[nth];
            counted.0 += 1;
            if is_up && self.queue.len() < QUEUE {
                self.queue.push_back((nth, plain(text.as_bytes()), now));
            } else {
                counted.1 += 1;
            }
        }
    }

    /// After silence the next value only sets the base.
    pub(super) fn forget(&mut self, nth: usize, frame: Option<usize>) {
        self.base.retain(|key, _| key.0 != nth || frame.is_some_and(|frame| frame != key.1));
    }

    /// Commands that waited too long.
    pub(super) fn tick(&mut self, now: Instant) {
        while self.queue.front().is_some_and(|first| now >= first.2 + TTL) {
            self.drop_first();
        }
    }

    /// The link is gone.
    pub(super) fn lost(&mut self) {
        while !self.queue.is_empty() {
            self.drop_first();
        }
    }

    fn drop_first(&mut self) {
        if let Some((port, ..)) = self.queue.pop_front() {
            self.counted[port].1 += 1;
        }
    }

    /// The engine sends a command.
    pub(super) fn sent(&mut self, bytes: &[u8], now: Instant) -> Result<(), Wrong> {
        let text = plain(bytes);
        let shown = String::from_utf8_lossy(bytes).trim().to_owned();
        let Some((_, next, at)) = self.queue.pop_front() else {
            let again = self.newest.as_ref().is_some_and(|newest| newest.0 == text);
            let what = if again { "once more than it was picked" } else { "and nobody picked it" };
            return Err((Invariant::Once, format!("{shown} was sent {what}")));
        };
        if next != text {
            return Err((Invariant::Once, format!("{shown} was sent, {next} was next")));
        }
        if now >= at + TTL {
            return Err((Invariant::Once, format!("{shown} was sent too late")));
        }
        self.newest = Some((text, at));
        Ok(())
    }

    pub(super) fn len(&self) -> usize {
        self.queue.len()
    }
}

/// A command without what dialects add.
fn plain(text: &[u8]) -> String {
    let text = String::from_utf8_lossy(text);
    text.chars()
        .filter(|c| !c.is_whitespace() && !matches!(c, '"' | '\0'))
        .collect::<String>()
        .replace("()", "")
}
