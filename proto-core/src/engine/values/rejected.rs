//! Frames with rejected fields: their variables change groups.

use super::store::Store;
use super::withheld::{FieldSet, OWN_GROUPS, group_of, members};
use crate::image::GroupId;
use crate::time::{Instant, Stamp};

impl Store {
    /// Gives these rejected fields of an accepted frame an age of their own. False if there are too many groups;
    /// nothing has changed then.
    pub(crate) fn withhold(&mut self, nth: usize, rejected: &FieldSet) -> bool {
        let now = self.now;
        let Some(frame) = self.frames.get_mut(nth) else { return false };
        let id = nth as u8;
        let since = self.image.stamp_of(GroupId(id));
        let overdue_at = match since {
            Some(at) if frame.overdue_at != Instant::NEVER => at + frame.timeout,
            // The field became overdue together with its frame.
            Some(_) => Instant::NEVER,
            None if frame.overdue_at == Instant::ZERO => Instant::ZERO,
            // The field never had a value; this is the first frame that should have brought one.
            None => now + frame.timeout,
        };
        let whole = rejected.whole.and(&frame.set).minus(&self.bits.bytes);
        let has_bits = self.bits.has_unwithheld(id, &rejected.bits);
        // A command field without a value has no base to lose.
        let has_commands = since.is_some() && overdue_at != Instant::NEVER;
        let is_command = move |(field, group): &(u32, &mut u8)| {
            has_commands && **group == 0 && rejected.commands.checked_shr(*field).unwrap_or(0) & 1 == 1
        };
        let has_commands = (0..).zip(&mut self.withheld.commands).any(|command| is_command(&command));
        if !whole.is_empty() || has_bits || has_commands {
            let group = self.withheld.group((id, since), overdue_at, &mut self.image, &mut self.bits);
            let Some(group) = group else { return false };
            frame.set = frame.set.minus(&whole);
            whole.iter().for_each(|var| self.image.withhold(var, group));
            self.bits.withhold(id, &rejected.bits, group);
            let commands = (0..).zip(&mut self.withheld.commands).filter(is_command);
            commands.for_each(|(_, own)| *own = group.0.saturating_add(1));
            self.next_overdue.or_earlier(overdue_at);
        }
        self.withheld.is_used = true;
        true
    }

    /// These fields of a frame are accepted, perhaps again: they get the frame's age.
    pub(crate) fn readmit(&mut self, nth: usize, taken: &FieldSet) {
        let Some(frame) = self.frames.get_mut(nth) else { return };
        let id = nth as u8;
        for var in taken.whole.and(&self.image.withheld()).iter() {
            frame.set.insert(var);
            self.image.readmit(var, GroupId(id));
        }
        self.bits.readmit(id, &taken.bits);
        for (field, group) in (0..).zip(&mut self.withheld.commands) {
            if taken.commands.checked_shr(field).unwrap_or(0) & 1 == 1 {
                *group = 0;
            }
        }
        for nth in 0..OWN_GROUPS {
            let group = group_of(nth);
            let is_empty = members(&self.image, group).is_empty()
                && self.bits.withheld_groups().chain(self.withheld.command_groups()).all(|own| own != group);
            if let Some(at) = self.withheld.overdue_at.get_mut(nth).filter(|_| is_empty) {
                *at = Stamp::NEVER;
            }
        }
        self.withheld.is_used = !self.image.withheld().is_empty()
            || self.bits.withheld_groups().next().is_some()
            || self.withheld.command_groups().next().is_some();
    }
}
