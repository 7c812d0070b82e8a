//! Values that are still to be written to the controller.
//!
//! Analog values: the newest wins. Bits: every value that differs from the previous one is written, in order, through a
//! bounded queue per port (docs/engine.md section 5). The outbox does not know links; the caller says which variables
//! can be delivered.

use heapless::Vec;

use crate::engine::counters::{PortCounters, bump};
use crate::image::InputSet;
use crate::sysvar::{BIT_INPUT_COUNT, SysVar};
use crate::time::{Duration, Instant};

/// Number of bit values per port that can wait behind the next one to be written.
const EDGE_QUEUE: usize = 16;

#[derive(Debug, Clone, Copy)]
struct Edge {
    /// The ordinal of a byte variable, or the place of a share of bits after those.
    place: u8,
    value: u8,
    at: Instant,
}

/// The value of a byte variable to be written next, or written last.
#[derive(Debug, Clone, Copy)]
struct BitSlot {
    value: u8,
    at: Instant,
}

/// The bit values of one port that wait behind the next ones.
#[derive(Debug, Clone, Default)]
pub(crate) struct EdgeQueue {
    edges: Vec<Edge, EDGE_QUEUE>,
    /// Number of values dropped because a link was lost and not yet counted at the port.
    pub lost: u32,
}

/// How a value was queued behind one that already waits.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Offer {
    /// It equals the value to be written next and takes its place.
    Next,
    /// It is in the queue.
    Queued,
    /// The queue was full: it replaced the newest value of its place.
    Lost {
        /// The replaced value was the one to be written next.
        is_next: bool,
    },
}

impl EdgeQueue {
    /// Offers a new value for a place whose next value waits.
    pub(crate) fn offer(&mut self, place: u8, next: u8, value: u8, now: Instant) -> Offer {
        let full = self.edges.is_full();
        match self.edges.iter_mut().rev().find(|edge| edge.place == place) {
            Some(newest) if newest.value == value => {
                newest.at = now;
                Offer::Queued
            }
            Some(newest) if full => {
                *newest = Edge { place, value, at: now };
                Offer::Lost { is_next: false }
            }
            None if next == value => Offer::Next,
            None if full => Offer::Lost { is_next: true },
            _ => {
                // Cannot fail: the queue is not full.
                let _ = self.edges.push(Edge { place, value, at: now });
                Offer::Queued
            }
        }
    }

    /// Takes the oldest value of a place.
    pub(crate) fn next(&mut self, place: u8) -> Option<(u8, Instant)> {
        let at = self.edges.iter().position(|edge| edge.place == place)?;
        let edge = self.edges.remove(at);
        Some((edge.value, edge.at))
    }

    /// Drops all values of a place and returns their number.
    pub(crate) fn drop_all(&mut self, place: u8) -> usize {
        let before = self.edges.len();
        self.edges.retain(|edge| edge.place != place);
        before.saturating_sub(self.edges.len())
    }

    /// Drops the values of a place that have waited for longer than `timeout`. Returns their number, and since when the
    /// oldest remaining one has waited.
    pub(crate) fn expire(&mut self, place: u8, timeout: Duration, now: Instant) -> (usize, Instant) {
        let before = self.edges.len();
        self.edges.retain(|edge| edge.place != place || now.saturating_since(edge.at) <= timeout);
        let left = self.edges.iter().filter(|edge| edge.place == place).map(|edge| edge.at).min();
        (before.saturating_sub(self.edges.len()), left.unwrap_or(Instant::NEVER))
    }
}

#[derive(Debug, Clone)]
pub(crate) struct Outbox {
    /// Variables with a value to write.
    dirty: InputSet,
    /// By ordinal, because byte variables come first in the table.
    bits: [BitSlot; BIT_INPUT_COUNT],
}

impl Outbox {
    pub(crate) const fn new() -> Self {
        Self { dirty: InputSet::EMPTY, bits: [BitSlot { value: 0, at: Instant::ZERO }; BIT_INPUT_COUNT] }
    }

    pub(crate) fn dirty(&self) -> InputSet {
        self.dirty
    }

    /// The value of a byte variable to be written next.
    pub(crate) fn bit_value(&self, var: SysVar) -> u8 {
        self.bits.get(var.ordinal()).map_or(0, |slot| slot.value)
    }

    /// Sets a byte whose bits have owners: whether one is to be written, and the whole byte as a recipe link writes it
    /// next.
    pub(crate) fn set_shared(&mut self, var: SysVar, is_dirty: bool, value: u8) {
        if let Some(slot) = self.bits.get_mut(var.ordinal()) {
            slot.value = value;
        }
        if is_dirty {
            self.dirty.insert(var);
        } else {
            self.dirty.remove(var);
        }
    }

    /// Takes the value that an accepted frame gave a byte variable.
    pub(crate) fn offer_bits(
        &mut self,
        queue: &mut EdgeQueue,
        counters: &mut PortCounters,
        var: SysVar,
        value: u8,
        now: Instant,
    ) {
        let Some(slot) = self.bits.get_mut(var.ordinal()) else { return };
        if !self.dirty.contains(var) {
            *slot = BitSlot { value, at: now };
            self.dirty.insert(var);
            return;
        }
        // A value of this variable already waits: only a different value is an edge.
        let full = queue.edges.is_full();
        let place = var.ordinal() as u8;
        match queue.edges.iter_mut().rev().find(|edge| edge.place == place) {
            Some(newest) if newest.value == value => newest.at = now,
            Some(newest) if full => {
                *newest = Edge { place, value, at: now };
                bump(&mut counters.edges_lost);
            }
            None if slot.value == value => slot.at = now,
            None if full => {
                *slot = BitSlot { value, at: now };
                bump(&mut counters.edges_lost);
            }
            _ => {
                // Cannot fail: the queue is not full.
                let _ = queue.edges.push(Edge { place, value, at: now });
            }
        }
    }

    /// Takes the non-bit variables that an accepted frame has set.
    pub(crate) fn offer_analog(&mut self, vars: &InputSet) {
        self.dirty = self.dirty.or(vars);
    }

    /// The owner is overdue: the variable's safe value replaces everything that waits. `bits` is the safe value of a
    /// byte variable.
    pub(crate) fn offer_safe(&mut self, queue: &mut EdgeQueue, var: SysVar, bits: u8, now: Instant) {
        queue.edges.retain(|edge| usize::from(edge.place) != var.ordinal());
        if let Some(slot) = self.bits.get_mut(var.ordinal()) {
            *slot = BitSlot { value: bits, at: now };
        }
        self.dirty.insert(var);
    }

    /// Writes again values that may not have arrived.
    pub(crate) fn again(&mut self, vars: &InputSet) {
        self.dirty = self.dirty.or(vars);
    }

    /// Drops everything to be written of these variables; returns the number of dropped values.
    pub(crate) fn forget(&mut self, queue: &mut EdgeQueue, vars: &InputSet) -> usize {
        let before = queue.edges.len();
        // The places of outputs come after those of inputs, and are in no set.
        queue
            .edges
            .retain(|edge| !SysVar::from_ordinal(edge.place.into()).is_some_and(|var| vars.contains(var)));
        let dropped = self.dirty.and(vars).iter().count();
        self.dirty = self.dirty.minus(vars);
        before.saturating_sub(queue.edges.len()).saturating_add(dropped)
    }

    /// Drops values that have waited for longer than `timeout`. Returns their number, and since when the oldest
    /// remaining one has waited.
    pub(crate) fn expire(
        &mut self,
        queue: &mut EdgeQueue,
        vars: &InputSet,
        timeout: Duration,
        now: Instant,
    ) -> (usize, Instant) {
        let before = queue.edges.len();
        queue.edges.retain(|edge| now.saturating_since(edge.at) <= timeout);
        let mut dropped = before.saturating_sub(queue.edges.len());
        let mut oldest = queue.edges.iter().map(|edge| edge.at).min().unwrap_or(Instant::NEVER);
        let mut expired = InputSet::EMPTY;
        for var in self.dirty.and(vars).iter() {
            let Some(slot) = self.bits.get(var.ordinal()) else { break };
            if now.saturating_since(slot.at) > timeout {
                dropped = dropped.saturating_add(1);
                expired.insert(var);
            } else {
                oldest = oldest.min(slot.at);
            }
        }
        self.taken(&expired);
        self.next_edges(queue, &expired);
        (dropped, oldest)
    }

    /// These values have been handed over to their link.
    pub(crate) fn taken(&mut self, vars: &InputSet) {
        self.dirty = self.dirty.minus(vars);
    }

    /// Byte variables whose value was taken get their next value from the queue, if there is one.
    pub(crate) fn next_edges(&mut self, queue: &mut EdgeQueue, bits: &InputSet) {
        if queue.edges.is_empty() {
            return;
        }
        for var in bits.iter() {
            let place = var.ordinal() as u8;
            let next = queue.edges.iter().position(|edge| edge.place == place);
            if let (Some(at), Some(slot)) = (next, self.bits.get_mut(var.ordinal())) {
                let edge = queue.edges.remove(at);
                *slot = BitSlot { value: edge.value, at: edge.at };
                self.dirty.insert(var);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::sysvar::Direction;

    fn var(name: &str) -> SysVar {
        SysVar::parse(name).unwrap()
    }

    struct Bench {
        outbox: Outbox,
        queue: EdgeQueue,
        counters: PortCounters,
        now: Instant,
    }

    impl Bench {
        fn new() -> Self {
            let (outbox, queue) = (Outbox::new(), EdgeQueue::default());
            Self { outbox, queue, counters: PortCounters::default(), now: Instant::ZERO }
        }

        fn offer(&mut self, var: SysVar, value: u8) {
            self.now += Duration::from_millis(1);
            self.outbox.offer_bits(&mut self.queue, &mut self.counters, var, value, self.now);
        }

        fn drain(&mut self, var: SysVar) -> std::vec::Vec<u8> {
            let mut written = std::vec::Vec::new();
            while self.outbox.dirty().contains(var) {
                written.push(self.outbox.bit_value(var));
                let set = InputSet::from_iter([var]);
                self.outbox.taken(&set);
                self.outbox.next_edges(&mut self.queue, &set);
            }
            written
        }
    }

    #[test]
    fn the_byte_inputs_are_the_first_of_the_table() {
        let bytes = SysVar::all().filter(|v| v.direction() == Direction::Input && v.is_bits());
        assert!(bytes.map(|v| v.ordinal()).eq(0..BIT_INPUT_COUNT));
    }

    #[test]
    fn edges_are_written_in_order_and_repeats_once() {
        let mut bench = Bench::new();
        let (a, b) = (var("DigitalOutputCommand[1]"), var("BitInputReg[3]"));
        for value in [0, 1, 1, 0, 0, 1] {
            bench.offer(a, value);
        }
        bench.offer(b, 7);
        assert_eq!(bench.drain(a), [0, 1, 0, 1]);
        assert_eq!(bench.drain(b), [7]);
        bench.offer(a, 1);
        assert_eq!(bench.drain(a), [1], "an unchanged value is written all the same, once");
    }

    #[test]
    fn a_full_queue_keeps_the_newest_and_counts() {
        let mut bench = Bench::new();
        let a = var("DigitalOutputCommand[1]");
        for value in 0..=30 {
            bench.offer(a, value);
        }
        let written = bench.drain(a);
        assert_eq!(written.len(), 1 + EDGE_QUEUE);
        assert!(written.iter().copied().eq((0..=15).chain([30])));
        assert_eq!(bench.counters.edges_lost, 14);
    }

    #[test]
    fn a_full_queue_of_others_keeps_the_newest_too() {
        let mut bench = Bench::new();
        let (a, b) = (var("DigitalOutputCommand[1]"), var("BitInputReg[3]"));
        bench.offer(b, 1);
        for value in 0..=16 {
            bench.offer(a, value);
        }
        bench.offer(b, 2);
        assert_eq!(bench.drain(b), [2]);
        assert_eq!(bench.counters.edges_lost, 1);
    }

    #[test]
    fn a_safe_value_replaces_what_waits_and_a_new_value_follows_it() {
        let mut bench = Bench::new();
        let a = var("DigitalOutputCommand[1]");
        for value in [1, 0, 1] {
            bench.offer(a, value);
        }
        bench.outbox.offer_safe(&mut bench.queue, a, 4, bench.now);
        bench.offer(a, 1);
        assert_eq!(bench.drain(a), [4, 1]);
    }

    #[test]
    fn what_is_forgotten_is_forgotten_whole() {
        let mut bench = Bench::new();
        let (a, b) = (var("DigitalOutputCommand[1]"), var("BitInputReg[3]"));
        for value in [1, 0, 1] {
            bench.offer(a, value);
            bench.offer(b, value);
        }
        bench.outbox.forget(&mut bench.queue, &InputSet::from_iter([a]));
        assert_eq!(bench.drain(a), [0_u8; 0]);
        assert_eq!(bench.drain(b), [1, 0, 1]);
    }

    #[test]
    fn what_waited_too_long_is_dropped_and_counted() {
        let mut bench = Bench::new();
        let a = var("DigitalOutputCommand[1]");
        for value in [0, 1, 0] {
            bench.offer(a, value);
        }
        let set = InputSet::from_iter([a]);
        let now = Instant::from_millis(12);
        let (dropped, oldest) = bench.outbox.expire(&mut bench.queue, &set, Duration::from_millis(9), now);
        assert_eq!(dropped, 2, "the values of 1 and 2 ms");
        assert_eq!(oldest, Instant::from_millis(3));
        assert_eq!(bench.drain(a), [0]);
    }
}
