//! Bits with owners (proto-core/docs/engine.md section 5): the bits that one input frame writes in one byte wait
//! together, and are written by Modbus as coils.
//!
//! Bytes on a recipe link or in an output part are not modelled: `unmodelled.rs`.

use std::collections::VecDeque;

use proto_core::engine::LinkId;
use proto_core::sysvar::SysVar;
use proto_core::time::{Duration, Instant};

use super::{Alone, Carried, EDGES, Upward};
use crate::oracle::Invariant;
use crate::oracle::field::{Accepted, Coils};
use crate::oracle::invariant::Wrong;
use crate::oracle::spec::Spec;

/// The state of one share.
#[derive(Debug, Clone, Default)]
pub(in crate::oracle) struct Waits {
    /// Values to be written, the next one first, each with the time of its frame.
    waiting: VecDeque<(u8, Instant)>,
    /// The bits of the next value that are not written yet.
    left: u8,
    pub accepted: Option<Instant>,
    /// The share has its safe value; `safe_at` says since when.
    safe: bool,
    safe_at: Instant,
    /// A field of the share was rejected in the newest frame.
    pub alone: Option<Alone>,
}

impl Upward {
    /// Applies the bits of a frame; returns whether their link is down.
    pub(in crate::oracle) fn bits_accepted(
        &mut self,
        spec: &Spec,
        nth: usize,
        frame: &Accepted,
        now: Instant,
    ) -> bool {
        let is_up = self.is_up(LinkId::MODBUS);
        let mut undelivered = false;
        for (place, share) in spec.shares.iter().enumerate() {
            if (share.port, share.frame) != (nth, frame.frame) || frame.without.bytes.contains(&share.var) {
                continue;
            }
            let own = frame.bits.iter().filter(|coils| coils.var == share.var);
            let value = own.fold(0, |all, coils| all | coils.on);
            let queued = self.queued(spec, nth);
            let state = &mut self.shares[place];
            state.accepted = Some(now);
            if std::mem::take(&mut state.safe) {
                self.next_expiry = now;
            }
            if !is_up {
                undelivered = true;
                state.waiting.clear();
                continue;
            }
            match state.waiting.back_mut() {
                Some(newest) if newest.0 == value => newest.1 = now,
                Some(newest) if queued >= EDGES => {
                    *newest = (value, now);
                    self.counted[nth].edges_lost += 1;
                }
                _ => state.waiting.push_back((value, now)),
            }
            if state.waiting.len() == 1 {
                state.left = share.mask;
            }
        }
        undelivered
    }

    /// A frame is overdue: its bits get their safe values, or hold.
    pub(in crate::oracle) fn bits_silent(&mut self, spec: &Spec, nth: usize, frame: usize, now: Instant) {
        for (place, share) in spec.shares.iter().enumerate() {
            if (share.port, share.frame) == (nth, frame) && self.shares[place].alone.is_none() {
                self.share_silent(spec, place, now);
            }
        }
    }

    /// As [`Self::bits_silent`], for one share.
    pub(in crate::oracle) fn share_silent(&mut self, spec: &Spec, place: usize, now: Instant) {
        let (share, state) = (&spec.shares[place], &mut self.shares[place]);
        let waited = state.waiting.len() as u32;
        state.waiting.clear();
        match share.safe {
            Some(safe) => {
                // The owner may never have sent the share.
                state.accepted = state.accepted.or(Some(now));
                state.waiting.push_back((safe, now));
                (state.left, state.safe, state.safe_at) = (share.mask, true, now);
            }
            None => self.counted[share.port].values_expired += waited,
        }
    }

    /// Drops values of a port that have waited too long.
    pub(in crate::oracle) fn expire_bits(
        &mut self,
        spec: &Spec,
        nth: usize,
        timeout: Duration,
        now: Instant,
    ) {
        for (state, share) in self.shares.iter_mut().zip(&spec.shares) {
            if share.port != nth || state.safe {
                continue;
            }
            let (before, next) = (state.waiting.len(), state.waiting.front().copied());
            state.waiting.retain(|(_, at)| now.saturating_since(*at) <= timeout);
            self.counted[nth].values_expired += (before - state.waiting.len()) as u32;
            if state.waiting.front().copied() != next {
                state.left = share.mask;
            }
            for (_, at) in &state.waiting {
                self.next_expiry = self.next_expiry.min(*at + timeout + Duration::from_micros(1));
            }
        }
    }

    /// Modbus was lost: waiting values are dropped, except safe values.
    pub(in crate::oracle) fn bits_lost(&mut self, spec: &Spec) {
        for (state, share) in self.shares.iter_mut().zip(&spec.shares).filter(|(state, _)| !state.safe) {
            self.counted[share.port].values_expired += state.waiting.len() as u32;
            state.waiting.clear();
        }
    }

    /// Queues safe bits again, unless they are no longer current. `bits` has shares with their bits.
    pub(in crate::oracle) fn bits_again(&mut self, spec: &Spec, bits: impl IntoIterator<Item = (usize, u8)>) {
        for (place, mask) in bits {
            let state = &mut self.shares[place];
            let (true, Some(safe)) = (state.safe, spec.shares[place].safe) else { continue };
            if state.waiting.is_empty() {
                state.waiting.push_back((safe, state.safe_at));
                state.left = 0;
            }
            state.left |= mask;
        }
    }

    /// Queues all safe bits again.
    pub(in crate::oracle) fn all_bits_again(&mut self, spec: &Spec) {
        let all: Vec<_> = spec.shares.iter().enumerate().map(|(place, share)| (place, share.mask)).collect();
        self.bits_again(spec, all);
    }

    /// Checks a write of coils and takes their values from the queues; returns the origin of each share's part,
    /// and the safe bits among them.
    #[allow(clippy::type_complexity, reason = "two lists that belong together")]
    pub(in crate::oracle) fn wrote_bits(
        &mut self,
        spec: &Spec,
        coils: Coils,
        now: Instant,
    ) -> Result<(Vec<Carried>, Vec<(usize, u8)>), Wrong> {
        let Coils { var, mask, on } = coils;
        let (mut carried, mut safe, mut owned) = (Vec::new(), Vec::new(), 0);
        let what = |what: &str| format!("bits {mask:#010b} of {var} were written as {on:#010b}: {what}");
        for (state, (place, share)) in self.shares.iter_mut().zip(spec.shares.iter().enumerate()) {
            let own = share.mask & mask;
            if share.var != var || own == 0 {
                continue;
            }
            owned |= own;
            if state.accepted.is_none() {
                return Err((Invariant::FirstFrame, what("no frame had them yet")));
            }
            let Some(&(next, at)) = state.waiting.front() else {
                return Err((Invariant::Sent, what("nothing of that port waited")));
            };
            if own & !state.left != 0 {
                return Err((Invariant::Sent, what("some had been written")));
            }
            if on & own != next & own {
                let later = state.waiting.iter().any(|(value, _)| value & own == on & own);
                let invariant = if later { Invariant::Edges } else { Invariant::Sent };
                return Err((invariant, what("other values were next")));
            }
            let timeout = spec.ports[share.port].timeout;
            if !state.safe && now.saturating_since(at) > timeout {
                return Err((Invariant::InTime, what("they had waited for longer than their timeout")));
            }
            if state.safe {
                safe.push((place, own));
                carried.push(Carried::Safe);
            } else {
                carried.push(Carried::Of { arrived: at, timeout });
            }
            state.left &= !own;
            if state.left == 0 {
                state.waiting.pop_front();
                state.left = share.mask;
            }
        }
        if owned != mask {
            return Err((Invariant::Ownership, what("no port drives some of them")));
        }
        Ok((carried, safe))
    }

    /// Number of the port's bit values that wait behind others.
    pub(in crate::oracle) fn queued_bits(&self, spec: &Spec, nth: usize) -> usize {
        let own = self.shares.iter().zip(&spec.shares).filter(|(_, share)| share.port == nth);
        own.map(|(state, _)| state.waiting.len().saturating_sub(1)).sum()
    }

    /// A byte with waiting bits.
    pub(in crate::oracle) fn waiting_bits(&self, spec: &Spec) -> Option<SysVar> {
        let mut shares = self.shares.iter().zip(&spec.shares);
        shares.find(|(state, _)| !state.waiting.is_empty()).map(|(_, share)| share.var)
    }
}
