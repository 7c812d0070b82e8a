//! Whether the controller has the safe values: what confirms them, what casts unconfirm on them, and when they are
//! written again.
//!
//! In: values that the controller shows, answers of links, gaps in what it sends. Out: the safe values that are
//! to be written once more.

use super::store::Store;
use crate::image::{BitSet, InputSet};
use crate::sysvar::SysVar;
use crate::time::{Duration, Instant};

impl Store {
    /// Whether the controller is known to have all safe values.
    pub(crate) fn is_safe(&self) -> bool {
        self.unconfirmed.is_empty() && self.bits.unconfirmed.is_empty()
    }

    /// A write of safe values failed: they are written again, if they are still current.
    pub(crate) fn again(&mut self, safe: &InputSet) {
        let safe = safe.and(&self.safe);
        self.outbox.again(&safe.minus(&self.bits.bytes));
        let bytes = safe.and(&self.bits.bytes);
        if !bytes.is_empty() {
            self.bits_again(BitSet::all_of(&bytes).and(self.bits.unconfirmed));
        }
    }

    /// The same for bits with owners.
    pub(crate) fn bits_again(&mut self, bits: BitSet) {
        self.bits.again(bits);
        self.bits_changed();
    }

    /// The controller has these safe values, as far as they are still current.
    pub(crate) fn confirm(&mut self, safe: &InputSet) {
        if !safe.and(&self.unconfirmed).and(&self.unanswered).is_empty() {
            self.confirmed_at = self.now;
        }
        self.unconfirmed = self.unconfirmed.minus(safe);
    }

    /// The controller has these safe values of a byte's bits, as far as they are still current.
    pub(crate) fn confirm_bits(&mut self, var: SysVar, mask: u8) {
        let bits = BitSet::of(var, mask).and(self.bits.unconfirmed);
        if !bits.is_empty() && self.unanswered.contains(var) {
            self.confirmed_at = self.now;
        }
        self.bits.unconfirmed = self.bits.unconfirmed.minus(bits);
        self.bits_changed();
    }

    /// Compares the safe values of a byte's bits with what the controller shows.
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

    /// Takes the bits of a byte that the controller shows and of which none of our own has a value.
    pub(crate) fn show_bits(&mut self, var: SysVar, shown: u8) {
        let live = self.bits.live.byte(var);
        self.image.set_bits(var, var.valid_bits() & !live, shown);
        self.bits_changed();
    }

    /// Whether the controller can have had this other value all along. Later another master has
    /// written it.
    pub(crate) fn may_unconfirm(&self) -> bool {
        self.now < self.confirmed_at + CONFIRMED_FOR
    }

    /// Outputs that have just arrived show another value than the safe one.
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

    /// The controller does not have a safe value that a recipe link has sent.
    pub(crate) fn unconfirm(&mut self, var: SysVar) {
        if self.unanswered.contains(var) {
            self.unconfirmed.insert(var);
            self.again(&InputSet::from_iter([var]));
        }
    }

    /// A state packet or a recipe frame came, which the controller sends steadily.
    pub(crate) fn heard(&mut self) {
        if !self.is_heard() {
            self.era = self.era.wrapping_add(1);
        }
        self.heard_at = Some(self.now);
    }

    /// Whether the controller has been there without a gap since the era began.
    pub(crate) fn is_heard(&self) -> bool {
        !is_gap(self.heard_at, self.now)
    }

    /// The controller may have restarted: safe values are written once more.
    pub(crate) fn controller_was_away(&mut self) {
        self.unconfirmed = self.safe;
        self.bits.unconfirmed = self.bits.safe;
        self.unconfirmed_since = self.now;
        let safe = self.safe;
        self.again(&safe);
    }

    /// Whether a value that the controller shows now can be the result of the safe values, and not
    /// older.
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
/// A packet of the state stream may be this late: a stream that is silent for 2 s is reopened.
const CONFIRMED_FOR: Duration = Duration::from_secs(3);

/// After this long without a state packet or recipe frame the controller may have restarted.
const AWAY_AFTER: Duration = Duration::from_millis(500);

/// Whether the newest packet or frame is so old, or none ever came, that the controller may have
/// restarted.
pub(crate) fn is_gap(last: Option<Instant>, now: Instant) -> bool {
    last.is_none_or(|at| now.saturating_since(at) > AWAY_AFTER)
}
