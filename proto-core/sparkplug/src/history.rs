//! A bounded ring of values that could not be published when they were new. When it is full, each new value removes the
//! oldest one, which is counted.

use crate::value::{Stamp, StoredValue};
use heapless::Deque;

/// A stored value.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Past {
    /// The place of its metric.
    pub place: u16,
    /// The value; it may be unknown.
    pub value: StoredValue,
    pub at: Stamp,
}

#[derive(Debug, Clone)]
pub(crate) struct History<const ROOM: usize> {
    kept: Deque<Past, ROOM>,
    lost: u64,
}

impl<const ROOM: usize> History<ROOM> {
    pub(crate) const fn new() -> Self {
        Self { kept: Deque::new(), lost: 0 }
    }

    /// Number of values that were removed because the ring was full.
    pub(crate) const fn lost(&self) -> u64 {
        self.lost
    }

    pub(crate) fn len(&self) -> usize {
        self.kept.len()
    }

    pub(crate) fn push(&mut self, past: Past) {
        let Err(past) = self.kept.push_back(past) else { return };
        self.lost = self.lost.saturating_add(1);
        let _ = self.kept.pop_front();
        let _ = self.kept.push_back(past);
    }

    /// Rotates the ring until a value that `is_wanted` is in front. Returns `false` if there is none.
    pub(crate) fn find(&mut self, is_wanted: impl Fn(&Past) -> bool) -> bool {
        for _ in 0..self.kept.len() {
            match self.kept.front() {
                Some(front) if is_wanted(front) => return true,
                _ => {}
            }
            if let Some(front) = self.kept.pop_front() {
                let _ = self.kept.push_back(front);
            }
        }
        false
    }

    /// The values from the front on.
    pub(crate) fn iter(&self) -> impl Iterator<Item = &Past> {
        self.kept.iter()
    }

    /// Removes this many values from the front.
    pub(crate) fn drop_front(&mut self, count: usize) {
        for _ in 0..count {
            let _ = self.kept.pop_front();
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::vec::Vec;

    fn past(place: u16) -> Past {
        Past { place, value: StoredValue::Unknown, at: Stamp::NEVER }
    }

    fn places<const ROOM: usize>(history: &History<ROOM>) -> Vec<u16> {
        history.iter().map(|past| past.place).collect()
    }

    #[test]
    fn the_oldest_goes_and_is_counted() {
        let mut history = History::<3>::new();
        (1..=5).for_each(|place| history.push(past(place)));
        assert_eq!((places(&history), history.lost()), ([3, 4, 5].into(), 2));
        assert_eq!(history.len(), 3);
    }

    #[test]
    fn what_is_not_wanted_stays_in_its_order() {
        let mut history = History::<4>::new();
        (1..=4).for_each(|place| history.push(past(place)));
        assert!(history.find(|past| past.place == 3));
        assert_eq!(places(&history), [3, 4, 1, 2]);
        history.drop_front(1);
        assert!(!history.find(|past| past.place == 9));
        assert_eq!(places(&history), [4, 1, 2]);
    }
}
