//! Firmware slots: which of the two is good, and which is on trial (docs/update.md).

use crate::revisions::TrialEnd;
use crate::{Put, PutError, RecordKey, Store};

/// One of the two places for firmware. Each image is linked for one slot.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Slot {
    /// The first one.
    A,
    /// The second one.
    B,
}

impl Slot {
    /// Both slots, A first.
    pub const ALL: [Self; 2] = [Self::A, Self::B];

    /// The other slot.
    pub fn other(self) -> Self {
        match self {
            Self::A => Self::B,
            Self::B => Self::A,
        }
    }

    /// Number of the slot: 0 for A, 1 for B.
    pub fn number(self) -> u8 {
        match self {
            Self::A => 0,
            Self::B => 1,
        }
    }

    /// The slot of this number; `None` from 2 on.
    pub fn of_number(number: u8) -> Option<Self> {
        Self::ALL.get(usize::from(number)).copied()
    }
}

/// Marks of the slots, written atomically.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct SlotMarks {
    /// The slot that was confirmed last; if there was none, the first slot that was run.
    pub good: Option<Slot>,
    /// The trial, if a slot is on trial.
    pub trial: Option<SlotTrial>,
    /// The slot whose trial ended last, and how.
    pub last: Option<(Slot, TrialEnd)>,
}

/// A trial of a firmware.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct SlotTrial {
    /// Slot on trial.
    pub slot: Slot,
    /// Remaining starts.
    pub attempts: u8,
    /// Time until it must be confirmed, in seconds.
    pub confirm_s: u16,
    /// State of the cell before the trial, encoded by the firmware.
    pub before: u8,
}

impl Store {
    /// Marks of the slots; empty if never written.
    pub fn slots(&self) -> SlotMarks {
        let Some(found) = self.find(RecordKey::Slots) else { return SlotMarks::default() };
        let [good, trial, attempts, low, high, last, ended, before] = found.tag.to_le_bytes();
        let confirm_s = u16::from_le_bytes([low, high]);
        SlotMarks {
            good: Slot::of_number(good),
            trial: Slot::of_number(trial).map(|slot| SlotTrial { slot, attempts, confirm_s, before }),
            last: Slot::of_number(last).zip(TrialEnd::of_code(ended)),
        }
    }

    /// Marks slots.
    ///
    /// # Errors
    /// The marks cannot be written; the previous marks remain valid.
    pub fn mark_slots(&mut self, marks: SlotMarks) -> Result<Put<'_, 'static>, PutError> {
        let number = |slot: Option<Slot>| slot.map_or(NO_SLOT, Slot::number);
        let (attempts, confirm_s, before) =
            marks.trial.map_or((0, 0, 0), |trial| (trial.attempts, trial.confirm_s, trial.before));
        let [low, high] = confirm_s.to_le_bytes();
        let trial = number(marks.trial.map(|trial| trial.slot));
        let last = number(marks.last.map(|(slot, _)| slot));
        let ended = marks.last.map_or(0, |(_, ended)| ended.code());
        let tag = [number(marks.good), trial, attempts, low, high, last, ended, before];
        self.put(RecordKey::Slots, u64::from_le_bytes(tag), &[])
    }
}

const NO_SLOT: u8 = u8::MAX;
