//! Whether the controller has the safe values: what confirms them, what makes them unconfirmed again, and when they are
//! rewritten.
//!
//! In: values that the controller shows, replies of links, gaps in what it sends. Out: the safe values to write once
//! more.

use super::store::Store;
use crate::image::{BitSet, InputSet};
use crate::sysvar::SysVar;
use crate::time::{Duration, Instant};

impl Store {
    /// Whether the controller is known to have all safe values.
    pub(crate) fn is_safe(&self) -> bool {
        self.unconfirmed.is_empty() && self.bits.unconfirmed.is_empty()
    }

    /// A write of safe values failed: writes them again if they are still current.
    pub(crate) fn again(&mut self, safe: &InputSet) {
        let safe = safe.and(&self.safe);
        self.outbox.again(&safe.minus(&self.bits.bytes));
        let bytes = safe.and(&self.bits.bytes);
        if !bytes.is_empty() {
            self.bits_again(BitSet::all_of(&bytes).and(self.bits.unconfirmed));
        }
    }

    /// Like [`Self::again`], for bits with owners.
    pub(crate) fn bits_again(&mut self, bits: BitSet) {
        self.bits.again(bits);
        self.bits_changed();
    }

    /// The controller has these safe values; those no longer current are ignored.
    pub(crate) fn confirm(&mut self, safe: &InputSet) {
        if !safe.and(&self.unconfirmed).and(&self.unanswered).is_empty() {
            self.confirmed_at = self.now;
        }
        self.unconfirmed = self.unconfirmed.minus(safe);
    }

    /// The controller has the safe values of these bits; those no longer current are ignored.
    pub(crate) fn confirm_bits(&mut self, var: SysVar, mask: u8) {
        let bits = BitSet::of(var, mask).and(self.bits.unconfirmed);
        if !bits.is_empty() && self.unanswered.contains(var) {
            self.confirmed_at = self.now;
        }
        self.bits.unconfirmed = self.bits.unconfirmed.minus(bits);
        self.bits_changed();
    }

    /// Compares the safe bits of a byte with what the controller shows.
    pub(crate) fn compare_bits(&mut self, var: SysVar, shown: u8, may_confirm: bool, may_unconfirm: bool) {
        let (safe, unconfirmed) = (self.bits.safe.byte(var), self.bits.unconfirmed.byte(var));
        let is_there = !(shown ^ self.image.byte(var));
        if may_confirm {
            self.confirm_bits(var, unconfirmed & is_there);
        }
        let refuted = BitSet::of(var, safe & !unconfirmed & !is_there);
        if may_unconfirm && !refuted.is_empty() && self.unanswered.contains(var) {
            self.bits.unconfirmed = self.bits.unconfirmed.or(refuted);
            self.bits_again(refuted);
        }
    }

    /// Takes from what the controller shows the bits of a byte that have no value of their owner.
    pub(crate) fn show_bits(&mut self, var: SysVar, shown: u8) {
        let live = self.bits.live.byte(var);
        self.image.set_bits(var, var.valid_bits() & !live, shown);
        self.bits_changed();
    }

    /// Whether another value that the controller shows may have been there all along. Shown later, it was written by
    /// another master.
    pub(crate) fn may_unconfirm(&self) -> bool {
        self.now < self.confirmed_at + CONFIRMED_FOR
    }

    /// Outputs that have just arrived may show a value other than the safe one.
    pub(crate) fn unconfirm_by_witnesses(&mut self) {
        if !self.may_unconfirm() {
            return;
        }
        for var in self.safe.and(&self.bits.bytes).iter() {
            if let Some(witness) = var.shown_by()
                && self.image.known_since(witness) == Some(self.now)
            {
                self.compare_bits(var, self.image.byte(witness), false, true);
            }
        }
        let whole = InputSet::BYTES.minus(&self.bits.bytes);
        for var in self.safe.minus(&self.unconfirmed).and(&whole).iter() {
            if let Some(witness) = var.shown_by()
                && self.image.known_since(witness) == Some(self.now)
                && self.image.value(witness) != self.image.value(var)
            {
                self.unconfirm(var);
            }
        }
    }

    /// The controller does not have a safe value that a recipe link sent.
    pub(crate) fn unconfirm(&mut self, var: SysVar) {
        if self.unanswered.contains(var) {
            self.unconfirmed.insert(var);
            self.again(&InputSet::from_iter([var]));
        }
    }

    /// A state packet or a recipe frame arrived; the controller sends these steadily.
    pub(crate) fn heard(&mut self) {
        if !self.is_heard() {
            self.era = self.era.wrapping_add(1);
        }
        self.heard_at = Some(self.now);
    }

    /// Whether the controller has been heard without a gap since the era began.
    pub(crate) fn is_heard(&self) -> bool {
        !is_gap(self.heard_at, self.now)
    }

    /// The controller may have restarted: writes the safe values once more.
    pub(crate) fn controller_was_away(&mut self) {
        self.unconfirmed = self.safe;
        self.bits.unconfirmed = self.bits.safe;
        self.unconfirmed_since = self.now;
        let safe = self.safe;
        self.again(&safe);
    }

    /// Whether a value that the controller shows now is new enough to confirm safe values.
    pub(crate) fn may_confirm(&self) -> bool {
        !self.unconfirmed.is_empty() && self.now >= self.unconfirmed_since + SHOWN_AFTER
    }

    /// Outputs that show input variables have arrived: they may confirm safe values.
    pub(crate) fn confirm_by_witnesses(&mut self) {
        if !self.may_confirm() {
            return;
        }
        let since = self.unconfirmed_since + SHOWN_AFTER;
        for var in self.unconfirmed.and(&InputSet::BYTES).iter() {
            if let Some(witness) = var.shown_by()
                && self.image.known_since(witness).is_some_and(|at| at >= since)
            {
                if self.bits.bytes.contains(var) {
                    self.compare_bits(var, self.image.byte(witness), true, false);
                } else if self.image.value(witness) == self.image.value(var) {
                    self.confirm(&InputSet::from_iter([var]));
                }
            }
        }
    }
}

/// A value shown sooner than this may be older than the safe value.
const SHOWN_AFTER: Duration = Duration::from_millis(200);
/// The longest delay of a state packet: a stream that is silent for 2 s is reopened.
const CONFIRMED_FOR: Duration = Duration::from_secs(3);

/// After this long without a state packet or recipe frame the controller may have restarted.
const AWAY_AFTER: Duration = Duration::from_millis(500);

/// Whether the newest packet or frame is so old that the controller may have restarted, or none ever came.
pub(crate) fn is_gap(last: Option<Instant>, now: Instant) -> bool {
    last.is_none_or(|at| now.saturating_since(at) > AWAY_AFTER)
}
