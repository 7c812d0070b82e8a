//! What is due when, in the order of time and, at one instant, of arrival.

use std::collections::BTreeMap;

use proto_core::time::Instant;

/// Things to be done later.
#[derive(Debug)]
pub(super) struct Queue<T> {
    entries: BTreeMap<(Instant, u64), T>,
    pushed: u64,
}

impl<T> Queue<T> {
    pub(super) const fn new() -> Self {
        Self { entries: BTreeMap::new(), pushed: 0 }
    }

    pub(super) fn push(&mut self, at: Instant, entry: T) {
        self.entries.insert((at, self.pushed), entry);
        self.pushed += 1;
    }

    pub(super) fn len(&self) -> usize {
        self.entries.len()
    }

    pub(super) fn next(&self) -> Instant {
        self.entries.first_key_value().map_or(Instant::NEVER, |(key, _)| key.0)
    }

    pub(super) fn pop_due(&mut self, now: Instant) -> Option<T> {
        let first = self.entries.first_entry()?;
        (first.key().0 <= now).then(|| first.remove())
    }
}
