//! Bits with owners: several devices drive different bits of one byte variable.
//!
//! In: the bits of accepted frames; timeouts; what links have sent and lost. Out: which bits are to be written, with
//! which values. Bits without an owner are never written by Modbus, and frames of a recipe link only repeat them as
//! they were read back (docs/engine.md section 5). The bits that one input frame writes in one byte are a *share*: they
//! change, wait and age together.
//!
//! In the store's sets of whole variables such a byte is dirty, safe or unconfirmed if one of its bits is, and live if
//! all are. It is never reachable, so plain frames, whose variables all are, do not come here.

use heapless::Vec;

use super::outbox::{EdgeQueue, Offer};
use crate::config::SafeValue;
use crate::engine::counters::{PortCounters, add, bump};
use crate::image::{BitSet, GroupId, Image, InputSet};
use crate::sysvar::{INPUT_COUNT, SysVar, VarBit};
use crate::time::{Duration, Instant};

/// A safe value in the encoding of the image.
#[derive(Debug, Clone, Copy)]
pub(crate) struct SafeBytes {
    pub var: SysVar,
    pub bytes: [u8; 4],
    /// The bits of a byte that have this safe value.
    pub mask: u8,
}

impl SafeBytes {
    pub(crate) fn new(safe: &SafeValue) -> Self {
        let mut bytes = [0; 4];
        // Cannot fail: every variable has at most four bytes, and validation has checked the type.
        safe.value.encode(&mut bytes);
        Self { var: safe.var, bytes, mask: safe.mask }
    }
}

/// Maximum number of shares over all input frames.
pub(crate) const MAX_SHARES: usize = 32;

/// The bits of one byte that one input frame writes.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Share {
    pub var: SysVar,
    pub mask: u8,
    /// Index of the frame in the store.
    pub frame: u8,
    /// Index of the frame's port in the engine.
    pub port: u8,
    /// One more than the number of the share's group while a field of it is rejected; 0 if it belongs to its frame's
    /// group.
    group: u8,
    /// Since when the value to be written next has waited.
    at: Instant,
}

impl Share {
    fn bits(&self) -> BitSet {
        BitSet::of(self.var, self.mask)
    }

    /// The group whose age the share has.
    pub(crate) fn group(&self) -> GroupId {
        self.withheld_in().unwrap_or(GroupId(self.frame))
    }

    /// The group the share has while a field of it is rejected.
    fn withheld_in(&self) -> Option<GroupId> {
        self.group.checked_sub(1).map(GroupId)
    }
}

#[derive(Debug, Clone)]
pub(crate) struct Bits {
    shares: Vec<Share, MAX_SHARES>,
    pub is_used: bool,
    /// The bytes that have shares.
    pub bytes: InputSet,
    /// Bits with a value to write.
    pub dirty: BitSet,
    /// The value of each bit to be written next, or written last.
    values: BitSet,
    /// Bits with a value of their owner: received in time, or a configured safe value.
    pub live: BitSet,
    /// Bits at their safe value since their owner became overdue.
    pub safe: BitSet,
    /// Bits of `safe` that the controller is not known to have.
    pub unconfirmed: BitSet,
    /// Bits whose link is up.
    reachable: BitSet,
}

/// How a frame's bits were taken.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Offered {
    /// The bytes whose link is up.
    pub reachable: InputSet,
    /// A link is down.
    pub undelivered: bool,
    /// Some of the bits were at their safe value until now.
    pub was_safe: bool,
}

/// The effect of a timeout.
#[derive(Debug, Clone, Copy)]
pub(crate) struct TimedOut {
    /// Number of values that were dropped.
    pub dropped: usize,
    /// A bit took its safe value.
    pub is_safe: bool,
    /// Bytes with bits that hold: their value is unknown until it is read back.
    pub held: InputSet,
}

/// The place of a share in an edge queue, after those of variables.
fn place(index: usize) -> u8 {
    INPUT_COUNT.saturating_add(index) as u8
}

impl Bits {
    pub(crate) const fn new() -> Self {
        Self {
            shares: Vec::new(),
            is_used: false,
            bytes: InputSet::EMPTY,
            dirty: BitSet::EMPTY,
            values: BitSet::EMPTY,
            live: BitSet::EMPTY,
            safe: BitSet::EMPTY,
            unconfirmed: BitSet::EMPTY,
            reachable: BitSet::EMPTY,
        }
    }

    /// Adds a bit that an input frame writes; `None` if there are too many shares.
    pub(crate) fn add(&mut self, bit: VarBit, frame: u8, port: u8) -> Option<()> {
        let mask = bit.mask().unwrap_or(0);
        let same = |share: &&mut Share| share.frame == frame && share.var == bit.var;
        match self.shares.iter_mut().find(same) {
            Some(share) => share.mask |= mask,
            None => {
                self.shares
                    .push(Share { var: bit.var, mask, frame, port, group: 0, at: Instant::ZERO })
                    .ok()?;
            }
        }
        self.bytes.insert(bit.var);
        self.is_used = true;
        Some(())
    }

    pub(crate) fn shares(&self) -> &[Share] {
        &self.shares
    }

    /// The value of a byte as a recipe link would write it next.
    pub(crate) fn next_byte(&self, var: SysVar, image: &Image) -> u8 {
        let dirty = self.dirty.byte(var);
        image.byte(var) & !dirty | self.next_bits(var) & dirty
    }

    /// The values of a byte's bits to be written next, or written last.
    pub(crate) fn next_bits(&self, var: SysVar) -> u8 {
        self.values.byte(var)
    }

    /// Takes the bits of an accepted frame; the image already has them.
    pub(crate) fn accepted(
        &mut self,
        frame: usize,
        queue: &mut EdgeQueue,
        counters: &mut PortCounters,
        image: &Image,
        now: Instant,
    ) -> Offered {
        let mut offered = Offered { reachable: InputSet::EMPTY, undelivered: false, was_safe: false };
        for (nth, share) in self.shares.iter_mut().enumerate() {
            if usize::from(share.frame) != frame || share.group != 0 {
                continue;
            }
            let (bits, place) = (share.bits(), place(nth));
            offered.was_safe |= !self.safe.and(bits).is_empty();
            self.live = self.live.or(bits);
            self.safe = self.safe.minus(bits);
            self.unconfirmed = self.unconfirmed.minus(bits);
            if self.reachable.and(bits).is_empty() {
                offered.undelivered = true;
                queue.drop_all(place);
                self.dirty = self.dirty.minus(bits);
                continue;
            }
            offered.reachable.insert(share.var);
            let value = image.byte(share.var) & share.mask;
            let next = self.values.byte(share.var) & share.mask;
            let waits = !self.dirty.and(bits).is_empty();
            let what = if waits { queue.offer(place, next, value, now) } else { Offer::Next };
            match what {
                Offer::Queued => continue,
                Offer::Lost { is_next: false } => {
                    bump(&mut counters.edges_lost);
                    continue;
                }
                Offer::Lost { is_next: true } => bump(&mut counters.edges_lost),
                Offer::Next => {}
            }
            self.values = self.values.with(share.var, share.mask, value);
            self.dirty = self.dirty.or(bits);
            share.at = now;
        }
        offered
    }

    /// These bits have been handed over to their link: a share with no dirty bit left takes its next value from the
    /// queue.
    pub(crate) fn taken(&mut self, bits: BitSet, queues: &mut [EdgeQueue]) {
        self.dirty = self.dirty.minus(bits);
        for (nth, share) in self.shares.iter_mut().enumerate() {
            let own = share.bits();
            if own.and(bits).is_empty() || !own.and(self.dirty).is_empty() {
                continue;
            }
            let next = queues.get_mut(usize::from(share.port)).and_then(|queue| queue.next(place(nth)));
            if let Some((value, at)) = next {
                self.values = self.values.with(share.var, share.mask, value);
                self.dirty = self.dirty.or(own);
                share.at = at;
            }
        }
    }

    /// The group of a frame or of rejected fields is overdue: its bits take their safe values in place of everything
    /// that waits. Bits without a safe value hold.
    pub(crate) fn time_out(
        &mut self,
        group: GroupId,
        queue: &mut EdgeQueue,
        image: &mut Image,
        safe: &[SafeBytes],
        now: Instant,
    ) -> TimedOut {
        let mut done = TimedOut { dropped: 0, is_safe: false, held: InputSet::EMPTY };
        for (nth, share) in self.shares.iter_mut().enumerate() {
            if share.group() != group {
                continue;
            }
            let var = share.var;
            let (mut mask, mut value) = (0, 0);
            for safe in safe.iter().filter(|safe| safe.var == var) {
                let own = safe.mask & share.mask;
                (mask, value) = (mask | own, value & !own | safe.bytes[0] & own);
            }
            let waited = queue.drop_all(place(nth));
            let held = BitSet::of(var, share.mask & !mask);
            // Bits without a value have nothing to hold.
            if !self.live.and(held).is_empty() {
                let is_dirty = !self.dirty.and(held).is_empty();
                done.dropped = done.dropped.saturating_add(waited).saturating_add(usize::from(is_dirty));
                done.held.insert(var);
                self.dirty = self.dirty.minus(held);
                self.live = self.live.minus(held);
            }
            let own = BitSet::of(var, mask);
            if !own.is_empty() {
                image.set_bits(var, mask, value);
                self.values = self.values.with(var, mask, value);
                self.dirty = self.dirty.or(own);
                self.safe = self.safe.or(own);
                self.unconfirmed = self.unconfirmed.or(own);
                // The owner may never have sent them.
                self.live = self.live.or(own);
                share.at = now;
                done.is_safe = true;
            }
        }
        done
    }

    /// The groups of shares with a rejected field.
    pub(crate) fn withheld_groups(&self) -> impl Iterator<Item = GroupId> + '_ {
        self.shares.iter().filter_map(Share::withheld_in)
    }

    /// Whether a frame has shares in these bytes that still have the frame's age.
    pub(crate) fn has_unwithheld(&self, frame: u8, bytes: &InputSet) -> bool {
        !bytes.is_empty()
            && self
                .shares
                .iter()
                .any(|share| share.frame == frame && bytes.contains(share.var) && share.group == 0)
    }

    /// Gives the shares of a frame in these bytes a group of their own, unless they have one.
    pub(crate) fn withhold(&mut self, frame: u8, bytes: &InputSet, group: GroupId) {
        for share in self.shares.iter_mut().filter(|share| share.frame == frame && bytes.contains(share.var))
        {
            if share.group == 0 {
                share.group = group.0.saturating_add(1);
            }
        }
    }

    /// Gives the shares of a frame in these bytes the frame's age again.
    pub(crate) fn readmit(&mut self, frame: u8, bytes: &InputSet) {
        for share in self.shares.iter_mut().filter(|share| share.frame == frame && bytes.contains(share.var))
        {
            share.group = 0;
        }
    }

    /// Moves the shares of one group to another.
    pub(crate) fn regroup(&mut self, from: GroupId, to: GroupId) {
        for share in self.shares.iter_mut().filter(|share| share.withheld_in() == Some(from)) {
            share.group = to.0.saturating_add(1);
        }
    }

    /// Drops values that have waited for longer than `timeout`; returns their number, and since when the oldest
    /// remaining one has waited.
    pub(crate) fn expire(
        &mut self,
        frame: usize,
        queue: &mut EdgeQueue,
        timeout: Duration,
        now: Instant,
    ) -> (usize, Instant) {
        let (mut dropped, mut oldest) = (0_usize, Instant::NEVER);
        for (nth, share) in self.shares.iter_mut().enumerate() {
            let waiting = share.bits().and(self.dirty).minus(self.safe);
            if usize::from(share.frame) != frame || waiting.is_empty() {
                continue;
            }
            let (too_old, left) = queue.expire(place(nth), timeout, now);
            dropped = dropped.saturating_add(too_old);
            oldest = oldest.min(left);
            if now.saturating_since(share.at) <= timeout {
                oldest = oldest.min(share.at);
                continue;
            }
            dropped = dropped.saturating_add(1);
            self.dirty = self.dirty.minus(waiting);
            if share.bits().and(self.dirty).is_empty()
                && let Some((value, at)) = queue.next(place(nth))
            {
                self.values = self.values.with(share.var, share.mask, value);
                self.dirty = self.dirty.or(share.bits());
                share.at = at;
            }
        }
        (dropped, oldest)
    }

    pub(crate) fn link_up(&mut self, bytes: &InputSet) {
        self.reachable = self.reachable.or(BitSet::all_of(bytes));
    }

    /// The link of these bytes was lost: drops waiting values, except safe values, and counts them in the ports'
    /// queues. Returns whether there were any.
    pub(crate) fn link_lost(&mut self, bytes: &InputSet, queues: &mut [EdgeQueue]) -> bool {
        self.reachable = self.reachable.minus(BitSet::all_of(bytes));
        let mut has_lost = false;
        for (nth, share) in self.shares.iter().enumerate().filter(|(_, share)| bytes.contains(share.var)) {
            let waiting = share.bits().and(self.dirty).minus(self.safe);
            self.dirty = self.dirty.minus(waiting);
            let Some(queue) = queues.get_mut(usize::from(share.port)) else { continue };
            let dropped = queue.drop_all(place(nth)).saturating_add(usize::from(!waiting.is_empty()));
            add(&mut queue.lost, dropped);
            has_lost |= dropped > 0;
        }
        has_lost
    }

    /// These safe values may not have arrived: writes them again if they are still current.
    pub(crate) fn again(&mut self, bits: BitSet) {
        self.dirty = self.dirty.or(bits.and(self.safe));
    }
}
