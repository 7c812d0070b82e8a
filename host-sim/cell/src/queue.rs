//! A queue of events, ordered by time and, at the same instant, by arrival.
//!
//! Only small keys are sorted, and the events stay in place: otherwise most of a cell's time would go into moving them.

use std::cmp::Reverse;
use std::collections::BinaryHeap;

use proto_core::time::Instant;

#[derive(Debug)]
pub(super) struct Queue<T> {
    /// The earliest key is on top.
    order: BinaryHeap<Reverse<Entry>>,
    things: Vec<Option<T>>,
    /// Free places in `things`.
    free: Vec<usize>,
    pushed: u64,
}

/// A key: an instant, a number that grows with each entry, and a place in `things`. They are packed in one integer, so
/// one comparison orders two keys.
type Entry = u128;

impl<T> Queue<T> {
    pub(super) const fn new() -> Self {
        Self { order: BinaryHeap::new(), things: Vec::new(), free: Vec::new(), pushed: 0 }
    }

    pub(super) fn push(&mut self, at: Instant, thing: T) {
        let place = match self.free.pop() {
            Some(place) => {
                self.things[place] = Some(thing);
                place
            }
            None => {
                self.things.push(Some(thing));
                self.things.len() - 1
            }
        };
        assert!(place < MOST, "{place} events wait");
        let behind = self.pushed << PLACE_BITS | place as u64;
        self.order.push(Reverse(u128::from(at.as_micros()) << 64 | u128::from(behind)));
        self.pushed += 1;
    }

    pub(super) fn len(&self) -> usize {
        self.order.len()
    }

    pub(super) fn next(&self) -> Instant {
        self.order.peek().map_or(Instant::NEVER, |Reverse(entry)| Instant::from_micros((entry >> 64) as u64))
    }

    pub(super) fn pop_due(&mut self, now: Instant) -> Option<T> {
        if self.next() > now {
            return None;
        }
        let Reverse(entry) = self.order.pop()?;
        let place = entry as usize % MOST;
        self.free.push(place);
        self.things[place].take()
    }
}

/// Bits of a place: more places than the model ever lets wait at once. The other bits allow 2^40 pushes.
const PLACE_BITS: u32 = 24;
const MOST: usize = 1 << PLACE_BITS;

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn events_come_by_time_and_at_one_instant_in_the_order_of_their_arrival() {
        let at = Instant::from_micros;
        let mut queue = Queue::new();
        let mut come = Vec::new();
        for round in 1..=100 {
            for nth in 0..7 {
                queue.push(at(10 * round + 5 * (nth % 3)), (round, nth));
            }
            assert_eq!(queue.pop_due(at(10 * round - 1)), None);
            while let Some(event) = queue.pop_due(at(10 * round + 5)) {
                come.push(event);
            }
        }
        while let Some(event) = queue.pop_due(Instant::NEVER) {
            come.push(event);
        }
        let mut expected: Vec<_> = (1..=100).flat_map(|round| (0..7).map(move |nth| (round, nth))).collect();
        expected.sort_by_key(|&(round, nth)| (10 * round + 5 * (nth % 3), round, nth));
        assert_eq!(come, expected);
        assert_eq!((queue.len(), queue.next()), (0, Instant::NEVER));
        assert!(queue.things.len() <= 14, "places are used again");
    }
}
