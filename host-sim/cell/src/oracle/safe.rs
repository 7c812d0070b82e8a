//! Safe values: repeated until the controller is known to have them (proto-core/docs/engine.md section 6).

use proto_core::engine::LinkId;
use proto_core::sysvar::SysVar;
use proto_core::time::{Duration, Instant};

use super::field::as_number;
use super::spec::Spec;
use super::upward::{Upward, in_packet};

/// A recipe link repeats a safe value after this time.
const SOON: Duration = Duration::from_millis(4);
/// A recipe link repeats a safe value after this time if it is older than [`NEW`] and nothing can show it.
const SLOWLY: Duration = Duration::from_millis(100);
const NEW: Duration = Duration::from_secs(1);
/// A value that the controller shows earlier than this may be older than the arrival of the safe value.
const SHOWN_AFTER: Duration = Duration::from_millis(200);
/// For this long after a confirmation, another value revokes it. After that, another master must have written the
/// value.
const REVOCABLE: Duration = Duration::from_secs(3);

impl Upward {
    /// If the write of a safe value failed, queues it again, unless it is no longer current.
    pub(super) fn write_again(&mut self, spec: &Spec, vars: impl IntoIterator<Item = SysVar>) {
        for var in vars {
            let safe = spec.owned[var.ordinal()].and_then(|owned| owned.safe);
            let known = &mut self.known[var.ordinal()];
            if let (true, true, Some(safe)) = (known.safe, known.waiting.is_empty(), safe) {
                known.waiting.push_back((safe, known.safe_at));
                self.waits |= 1 << var.ordinal();
            }
        }
    }

    /// The controller may have restarted: queues all safe values again.
    pub(super) fn controller_was_away(&mut self, spec: &Spec, now: Instant) {
        self.all_bits_again(spec);
        let safe: Vec<SysVar> = spec.safe_vars.iter().copied().filter(|var| self.known(*var).safe).collect();
        if safe.is_empty() {
            return;
        }
        for var in &safe {
            self.known[var.ordinal()].unconfirmed = true;
        }
        self.unconfirmed_at = now;
        self.write_again(spec, safe);
    }

    /// A frame was sent on a recipe link: schedules the repetition of unconfirmed safe values.
    pub(super) fn sent_frame(&mut self, spec: &Spec, link: LinkId, now: Instant) {
        let rewrite_at = self.rewrite_at[usize::from(link.0)];
        let is_soon = rewrite_at == Instant::NEVER || self.is_newly_unconfirmed(now);
        if is_soon && !self.unconfirmed(spec, link).is_empty() {
            self.rewrite_at[usize::from(link.0)] = rewrite_at.min(now + SOON);
        }
    }

    fn is_newly_unconfirmed(&self, now: Instant) -> bool {
        now.saturating_since(self.unconfirmed_at) < NEW
    }

    /// Queues the safe values that are due for repetition.
    pub(super) fn repeat(&mut self, spec: &Spec, now: Instant) {
        for link in &spec.links {
            let place = usize::from(link.id.0);
            if now < self.rewrite_at[place] {
                continue;
            }
            self.rewrite_at[place] = Instant::NEVER;
            self.confirm_by_witnesses(spec, now);
            let unconfirmed = self.unconfirmed(spec, link.id);
            if unconfirmed.is_empty() || !self.is_up(link.id) {
                continue;
            }
            let soon =
                self.is_newly_unconfirmed(now) || unconfirmed.iter().any(|var| spec.can_be_shown(*var));
            self.rewrite_at[place] = now + if soon { SOON } else { SLOWLY };
            self.write_again(spec, unconfirmed);
        }
    }

    fn unconfirmed(&self, spec: &Spec, link: LinkId) -> Vec<SysVar> {
        let is_unconfirmed = |var: &SysVar| {
            let way = spec.owned[var.ordinal()].map(|owned| owned.way);
            way == Some(link) && self.known(*var).unconfirmed
        };
        spec.safe_vars.iter().copied().filter(is_unconfirmed).collect()
    }

    /// Whether what the controller shows now can confirm a safe value.
    pub(super) fn may_confirm(&self, now: Instant) -> bool {
        now >= self.unconfirmed_at + SHOWN_AFTER
    }

    /// Confirms the safe values that the packet shows. Soon after a confirmation, a different value revokes it.
    pub(super) fn compare_safe(&mut self, spec: &Spec, packet: &[u8], now: Instant) {
        let may_confirm = self.may_confirm(now);
        let may_revoke = self.confirmed_at.is_some_and(|at| now < at + REVOCABLE);
        let mut revoked = Vec::new();
        for &var in &spec.safe_vars {
            let Some(owned) = spec.owned[var.ordinal()] else { continue };
            let Some(safe) = owned.safe.filter(|_| self.known(var).safe) else { continue };
            if var.stream().is_none() {
                continue;
            }
            let by_recipe = spec.link(owned.way).is_some();
            let is_there =
                in_packet(var, packet).map(|raw| as_number(var, raw)) == Some(as_number(var, safe));
            match self.known(var).unconfirmed {
                true if is_there && may_confirm => self.confirm(var, by_recipe, now),
                false if !is_there && may_revoke && by_recipe => revoked.push(var),
                _ => {}
            }
        }
        for var in &revoked {
            self.known[var.ordinal()].unconfirmed = true;
        }
        self.write_again(spec, revoked);
    }

    /// Revokes confirmations of safe values if their witness arrived with a different value soon after.
    pub(super) fn revoke_by_witnesses(&mut self, spec: &Spec, now: Instant) {
        if self.confirmed_at.is_none_or(|at| now >= at + REVOCABLE) {
            return;
        }
        let mut revoked = Vec::new();
        for &var in &spec.safe_vars {
            let Some(owned) = spec.owned[var.ordinal()] else { continue };
            let shown = spec.witness[var.ordinal()].map(|witness| self.known(witness));
            let shown = shown.filter(|shown| !shown.unreadable).and_then(|shown| shown.value);
            let is_other =
                shown.is_some_and(|(raw, at)| at == now && owned.safe.is_some_and(|safe| safe[0] != raw[0]));
            let known = self.known(var);
            if is_other && known.safe && !known.unconfirmed && spec.link(owned.way).is_some() {
                revoked.push(var);
            }
        }
        for var in &revoked {
            self.known[var.ordinal()].unconfirmed = true;
        }
        self.write_again(spec, revoked);
    }

    fn confirm(&mut self, var: SysVar, by_recipe: bool, now: Instant) {
        self.known[var.ordinal()].unconfirmed = false;
        if by_recipe {
            self.confirmed_at = Some(now);
        }
    }

    /// Confirms the safe values that their witnesses show.
    fn confirm_by_witnesses(&mut self, spec: &Spec, now: Instant) {
        if !self.may_confirm(now) {
            return;
        }
        let since = self.unconfirmed_at + SHOWN_AFTER;
        for &var in &spec.safe_vars {
            let safe = spec.owned[var.ordinal()].and_then(|owned| owned.safe);
            let shown = spec.witness[var.ordinal()].and_then(|witness| self.known(witness).value);
            let is_there =
                shown.is_some_and(|(raw, at)| at >= since && safe.is_some_and(|safe| safe[0] == raw[0]));
            if is_there && self.known(var).unconfirmed {
                let way = spec.owned[var.ordinal()].map(|owned| owned.way);
                self.confirm(var, way.is_some_and(|way| spec.link(way).is_some()), now);
            }
        }
    }
}
