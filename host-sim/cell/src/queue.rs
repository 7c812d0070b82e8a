//! A queue of events, ordered by time and, at one instant, by arrival.

use std::cmp::Ordering;
use std::collections::BinaryHeap;

use proto_core::time::Instant;

/// The queue.
#[derive(Debug)]
pub(super) struct Queue<T> {
    entries: BinaryHeap<Entry<T>>,
    pushed: u64,
}

#[derive(Debug)]
struct Entry<T> {
    at: Instant,
    nth: u64,
    thing: T,
}

impl<T> Queue<T> {
    pub(super) const fn new() -> Self {
        Self { entries: BinaryHeap::new(), pushed: 0 }
    }

    pub(super) fn push(&mut self, at: Instant, thing: T) {
        self.entries.push(Entry { at, nth: self.pushed, thing });
        self.pushed += 1;
    }

    pub(super) fn len(&self) -> usize {
        self.entries.len()
    }

    pub(super) fn next(&self) -> Instant {
        self.entries.peek().map_or(Instant::NEVER, |entry| entry.at)
    }

    pub(super) fn pop_due(&mut self, now: Instant) -> Option<T> {
        if self.next() > now {
            return None;
        }
        self.entries.pop().map(|entry| entry.thing)
    }
}

/// The earliest entry is the greatest, because a heap returns the greatest first.
impl<T> Ord for Entry<T> {
    fn cmp(&self, other: &Self) -> Ordering {
        (other.at, other.nth).cmp(&(self.at, self.nth))
    }
}

impl<T> PartialOrd for Entry<T> {
    fn partial_cmp(&self, other: &Self) -> Option<Ordering> {
        Some(self.cmp(other))
    }
}

impl<T> PartialEq for Entry<T> {
    fn eq(&self, other: &Self) -> bool {
        self.nth == other.nth
    }
}

impl<T> Eq for Entry<T> {}
