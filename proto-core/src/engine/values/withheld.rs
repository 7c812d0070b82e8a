//! Fields that are rejected while the rest of their frame is accepted (docs/engine.md section 11): each ages on its
//! own, from its own last accepted value.
//!
//! In: which fields of an accepted frame were taken and which were not. Out: which variables, shares of bits and
//! command fields are overdue. The variables of a rejected field leave their frame's set and return with their next
//! accepted value, so frames accepted as a whole do not come here. Fields rejected at the same time after the same
//! frame share a group.

use super::bits::Bits;
use crate::image::{GroupId, Image, InputSet, MAX_GROUPS, WITHHELD_GROUPS};
use crate::time::{Instant, Stamp};

/// Fields bound to command tables, over all ports.
pub(crate) const MAX_COMMAND_FIELDS: usize = 16;

/// Number of groups for fields that are not overdue yet.
pub(super) const OWN_GROUPS: usize = WITHHELD_GROUPS - 2;
/// The group of overdue fields whose own group was reused: as old as the oldest of them.
const OVERDUE_GROUP: GroupId = group_of(OWN_GROUPS);
/// Like `OVERDUE_GROUP`, for fields that never had a value.
const NO_VALUE_GROUP: GroupId = group_of(OWN_GROUPS + 1);

pub(super) const fn group_of(nth: usize) -> GroupId {
    GroupId(MAX_GROUPS.saturating_add(nth) as u8)
}

fn place_of(group: GroupId) -> Option<usize> {
    usize::from(group.0).checked_sub(MAX_GROUPS)
}

/// Fields of one frame.
#[derive(Debug, Clone, Copy, Default)]
pub(crate) struct FieldSet {
    /// Variables written as a whole.
    pub whole: InputSet,
    /// Bytes in which bits are written.
    pub bits: InputSet,
    /// Command fields, as a bit mask of their indices.
    pub commands: u16,
}

const _: () = assert!(MAX_COMMAND_FIELDS <= 16);

impl FieldSet {
    pub(crate) fn is_empty(&self) -> bool {
        self.whole.is_empty() && self.bits.is_empty() && self.commands == 0
    }

    pub(crate) fn insert_command(&mut self, field: u8) {
        self.commands |= 1_u16.checked_shl(field.into()).unwrap_or(0);
    }
}

/// The rejected fields of all frames.
#[derive(Debug, Clone)]
pub(crate) struct Withheld {
    /// When each group is overdue; [`Instant::NEVER`] once it is.
    pub(super) overdue_at: [Stamp; OWN_GROUPS],
    /// The frame of each group, by its index in the store.
    pub(super) frames: [u8; OWN_GROUPS],
    /// For each command field, one more than the number of its group while it is rejected, else 0.
    pub(super) commands: [u8; MAX_COMMAND_FIELDS],
    /// Whether any field is rejected.
    pub is_used: bool,
}

impl Withheld {
    pub(crate) const fn new() -> Self {
        Self {
            overdue_at: [Stamp::NEVER; OWN_GROUPS],
            frames: [0; OWN_GROUPS],
            commands: [0; MAX_COMMAND_FIELDS],
            is_used: false,
        }
    }

    /// When the first group is overdue.
    pub(crate) fn deadline(&self) -> Instant {
        self.overdue_at.iter().map(|at| at.get()).min().unwrap_or(Instant::NEVER)
    }

    /// Makes all groups overdue that are not yet.
    pub(crate) fn all_overdue(&mut self) {
        let waiting = self.overdue_at.iter_mut().filter(|at| **at != Stamp::NEVER);
        waiting.for_each(|at| *at = Stamp::at(Instant::ZERO));
    }

    pub(crate) fn groups(&self) -> impl Iterator<Item = (GroupId, u8)> + use<> {
        (0..).map(group_of).zip(self.frames)
    }

    /// Takes the first group that is overdue, with its frame.
    pub(crate) fn next_overdue(&mut self, now: Instant) -> Option<(GroupId, u8)> {
        let (nth, at) = self.overdue_at.iter_mut().enumerate().find(|(_, at)| at.get() <= now)?;
        *at = Stamp::NEVER;
        Some((group_of(nth), self.frames.get(nth).copied()?))
    }

    /// Takes a command field of an overdue group; it is no longer withheld.
    pub(crate) fn next_command(&mut self, now: Instant) -> Option<u8> {
        let overdue_at = self.overdue_at;
        let is_overdue = |group: u8| {
            let nth = place_of(GroupId(group.checked_sub(1)?))?;
            overdue_at.get(nth).filter(|at| at.get() <= now)
        };
        let (field, group) =
            (0..).zip(&mut self.commands).find(|(_, group)| is_overdue(**group).is_some())?;
        *group = 0;
        Some(field)
    }

    pub(super) fn command_groups(&self) -> impl Iterator<Item = GroupId> + '_ {
        self.commands.iter().filter_map(|group| group.checked_sub(1)).map(GroupId)
    }

    /// The group for fields of this frame whose last value arrived at `since`; `None` if all groups are in use by
    /// fields that are not overdue yet.
    pub(super) fn group(
        &mut self,
        (frame, since): (u8, Option<Instant>),
        overdue_at: Instant,
        image: &mut Image,
        bits: &mut Bits,
    ) -> Option<GroupId> {
        let mut used = [false; OWN_GROUPS];
        let in_use = image.withheld().iter().filter_map(|var| image.group(var)).chain(bits.withheld_groups());
        for group in in_use.chain(self.command_groups()) {
            if let Some(is_used) = place_of(group).and_then(|nth| used.get_mut(nth)) {
                *is_used = true;
            }
        }
        let overdue_at = Stamp::at(overdue_at);
        let all = || (0..).map(group_of).zip(self.overdue_at).zip(self.frames).zip(used);
        let same = all().find(|&(((group, at), of), is_used)| {
            is_used && (at, of, image.stamp_of(group)) == (overdue_at, frame, since)
        });
        if let Some((((group, _), _), _)) = same {
            return Some(group);
        }
        let free = all().find(|(_, is_used)| !is_used).map(|(((group, _), _), _)| group);
        let group = match free {
            Some(group) => group,
            None => {
                // Reuse a group that is overdue: it no longer needs its start.
                let over = all().filter(|(((_, at), _), _)| *at == Stamp::NEVER);
                let over = over.map(|(((group, _), _), _)| (image.stamp_of(group), group));
                let (stamp, group) = over.min_by_key(|(stamp, _)| stamp.unwrap_or(Instant::ZERO))?;
                let bin = if stamp.is_some() { OVERDUE_GROUP } else { NO_VALUE_GROUP };
                if let Some(at) = stamp {
                    let is_empty =
                        members(image, bin).is_empty() && bits.withheld_groups().all(|own| own != bin);
                    let before = image.stamp_of(bin).filter(|_| !is_empty);
                    image.stamp(bin, before.map_or(at, |before| before.min(at)));
                }
                members(image, group).iter().for_each(|var| image.assign(var, bin));
                bits.regroup(group, bin);
                group
            }
        };
        image.stamp(group, since.unwrap_or(Instant::NEVER));
        let nth = place_of(group)?;
        if let (Some(at), Some(of)) = (self.overdue_at.get_mut(nth), self.frames.get_mut(nth)) {
            (*at, *of) = (overdue_at, frame);
        }
        Some(group)
    }
}

pub(crate) fn members(image: &Image, group: GroupId) -> InputSet {
    image.withheld().iter().filter(|&var| image.group(var) == Some(group)).collect()
}
