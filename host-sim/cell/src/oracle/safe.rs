//! Safe values: written again until the controller is known to have them (proto-core/docs/engine.md
//! section 6).

use proto_core::engine::LinkId;
use proto_core::sysvar::SysVar;
use proto_core::time::{Duration, Instant};

use super::field::as_number;
use super::sheet::Sheet;
use super::upward::{Upward, in_packet};

/// A recipe link sends a safe value again after this, ...
const SOON: Duration = Duration::from_millis(4);
/// ... or, where nothing can show it, after this, once it has done so for [`NEW`].
const SLOWLY: Duration = Duration::from_millis(100);
const NEW: Duration = Duration::from_secs(1);
/// A value that the controller shows sooner may be older.
const SHOWN_AFTER: Duration = Duration::from_millis(200);
/// For this long another value revokes the confirmation; later another master has written it.
const DOUBT: Duration = Duration::from_secs(3);

impl Upward {
    /// Safe values whose write failed wait again, if they are still current.
    pub(super) fn write_again(&mut self, sheet: &Sheet, vars: impl IntoIterator<Item = SysVar>) {
        for var in vars {
            let safe = sheet.owned[var.ordinal()].and_then(|owned| owned.safe);
            let known = &mut self.known[var.ordinal()];
            if let (true, true, Some(safe)) = (known.safe, known.waiting.is_empty(), safe) {
                known.waiting.push_back((safe, known.safe_at));
                self.waits |= 1 << var.ordinal();
            }
        }
    }

    /// The controller may have restarted: all safe values wait again.
    pub(super) fn controller_was_away(&mut self, sheet: &Sheet, now: Instant) {
        let safe: Vec<SysVar> = sheet.safe_vars.iter().copied().filter(|var| self.known(*var).safe).collect();
        if safe.is_empty() {
            return;
        }
        for var in &safe {
            self.known[var.ordinal()].unconfirmed = true;
        }
        self.doubted_at = now;
        self.write_again(sheet, safe);
    }

    /// A frame was sent on a recipe link: unconfirmed values are sent again later.
    pub(super) fn sent_frame(&mut self, sheet: &Sheet, link: LinkId, now: Instant) {
        let again_at = self.again_at[usize::from(link.0)];
        let is_soon = again_at == Instant::NEVER || self.is_new_doubt(now);
        if is_soon && !self.in_doubt(sheet, link).is_empty() {
            self.again_at[usize::from(link.0)] = again_at.min(now + SOON);
        }
    }

    fn is_new_doubt(&self, now: Instant) -> bool {
        now.saturating_since(self.doubted_at) < NEW
    }

    /// Safe values that are sent again now.
    pub(super) fn repeat(&mut self, sheet: &Sheet, now: Instant) {
        for link in &sheet.links {
            let place = usize::from(link.id.0);
            if now < self.again_at[place] {
                continue;
            }
            self.again_at[place] = Instant::NEVER;
            self.look_at_witnesses(sheet, now);
            let doubted = self.in_doubt(sheet, link.id);
            if doubted.is_empty() || !self.is_up(link.id) {
                continue;
            }
            let soon = self.is_new_doubt(now) || doubted.iter().any(|var| sheet.can_be_shown(*var));
            self.again_at[place] = now + if soon { SOON } else { SLOWLY };
            self.write_again(sheet, doubted);
        }
    }

    fn in_doubt(&self, sheet: &Sheet, link: LinkId) -> Vec<SysVar> {
        let is_in_doubt = |var: &SysVar| {
            let way = sheet.owned[var.ordinal()].map(|owned| owned.way);
            way == Some(link) && self.known(*var).unconfirmed
        };
        sheet.safe_vars.iter().copied().filter(is_in_doubt).collect()
    }

    /// Whether the value that the controller shows now can be the result of the safe values.
    pub(super) fn may_confirm(&self, now: Instant) -> bool {
        now >= self.doubted_at + SHOWN_AFTER
    }

    /// Safe values that the packet shows are confirmed; one that it does not show soon after its
    /// confirmation is not.
    pub(super) fn compare_safe(&mut self, sheet: &Sheet, packet: &[u8], now: Instant) {
        let may_confirm = self.may_confirm(now);
        let may_doubt = self.confirmed_at.is_some_and(|at| now < at + DOUBT);
        let mut doubted = Vec::new();
        for &var in &sheet.safe_vars {
            let Some(owned) = sheet.owned[var.ordinal()] else { continue };
            let Some(safe) = owned.safe.filter(|_| self.known(var).safe) else { continue };
            if var.stream().is_none() {
                continue;
            }
            let by_recipe = sheet.link(owned.way).is_some();
            let is_there =
                in_packet(var, packet).map(|raw| as_number(var, raw)) == Some(as_number(var, safe));
            match self.known(var).unconfirmed {
                true if is_there && may_confirm => self.confirm(var, by_recipe, now),
                false if !is_there && may_doubt && by_recipe => doubted.push(var),
                _ => {}
            }
        }
        for var in &doubted {
            self.known[var.ordinal()].unconfirmed = true;
        }
        self.write_again(sheet, doubted);
    }

    /// An output that just arrived shows another value, soon after a confirmation.
    pub(super) fn doubt_by_witnesses(&mut self, sheet: &Sheet, now: Instant) {
        if self.confirmed_at.is_none_or(|at| now >= at + DOUBT) {
            return;
        }
        let mut doubted = Vec::new();
        for &var in &sheet.safe_vars {
            let Some(owned) = sheet.owned[var.ordinal()] else { continue };
            let shown = sheet.witness[var.ordinal()].map(|witness| self.known(witness));
            let shown = shown.filter(|shown| !shown.unreadable).and_then(|shown| shown.value);
            let is_other =
                shown.is_some_and(|(raw, at)| at == now && owned.safe.is_some_and(|safe| safe[0] != raw[0]));
            let known = self.known(var);
            if is_other && known.safe && !known.unconfirmed && sheet.link(owned.way).is_some() {
                doubted.push(var);
            }
        }
        for var in &doubted {
            self.known[var.ordinal()].unconfirmed = true;
        }
        self.write_again(sheet, doubted);
    }

    fn confirm(&mut self, var: SysVar, by_recipe: bool, now: Instant) {
        self.known[var.ordinal()].unconfirmed = false;
        if by_recipe {
            self.confirmed_at = Some(now);
        }
    }

    /// Same for those that an output shows that is read anyway.
    fn look_at_witnesses(&mut self, sheet: &Sheet, now: Instant) {
        if !self.may_confirm(now) {
            return;
        }
        let since = self.doubted_at + SHOWN_AFTER;
        for &var in &sheet.safe_vars {
            let safe = sheet.owned[var.ordinal()].and_then(|owned| owned.safe);
            let shown = sheet.witness[var.ordinal()].and_then(|witness| self.known(witness).value);
            let is_there =
                shown.is_some_and(|(raw, at)| at >= since && safe.is_some_and(|safe| safe[0] == raw[0]));
            if is_there && self.known(var).unconfirmed {
                let way = sheet.owned[var.ordinal()].map(|owned| owned.way);
                self.confirm(var, way.is_some_and(|way| sheet.link(way).is_some()), now);
            }
        }
    }
}
