//! Configurations: stored, live and on trial.

use core::fmt;

use crate::{Flash, Put, PutError, RecordKey, Store};

/// Maximum number of stored configurations.
pub const MAX_REVISIONS: usize = 8;

/// A stored configuration.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Revision {
    /// Number of the revision; increases with each one.
    pub number: u32,
    /// Distinguishes different contents of the same number. The caller computes it, not the store.
    pub digest: u32,
    /// Length of its image in bytes.
    pub len: usize,
    slot: u8,
}

impl Revision {
    /// The key of its image.
    pub fn key(&self) -> RecordKey {
        RecordKey::Image(self.slot)
    }
}

/// Marks of the configurations, written atomically.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Marks {
    /// Number of the configuration that runs after a restart.
    pub live: Option<u32>,
    /// Number of the previously live configuration.
    pub previous: Option<u32>,
    /// The configuration on trial.
    pub trial: Option<Trial>,
    /// Number of the configuration whose trial ended last, and how.
    pub last: Option<(u32, TrialEnd)>,
}

impl Marks {
    /// Marked configurations, whose places must not be reused.
    pub fn numbers(&self) -> [Option<u32>; 4] {
        let last = self.last.map(|(number, _)| number);
        [self.live, self.previous, self.trial.map(|trial| trial.number), last]
    }
}

/// How a trial ended.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum TrialEnd {
    /// It was confirmed.
    Confirmed,
    /// Nobody confirmed it in time.
    NotConfirmed,
    /// It was rolled back.
    TakenBack,
    /// The configuration or firmware on trial did not run, or used up its starts.
    Failed,
}

impl TrialEnd {
    const ALL: [Self; 4] = [Self::Confirmed, Self::NotConfirmed, Self::TakenBack, Self::Failed];

    /// Never 0.
    pub(crate) fn code(self) -> u8 {
        Self::ALL.iter().position(|ended| *ended == self).map_or(0, |nth| nth as u8).saturating_add(1)
    }

    pub(crate) fn of_code(code: u8) -> Option<Self> {
        Self::ALL.get(usize::from(code.checked_sub(1)?)).copied()
    }
}

/// A trial of a configuration.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Trial {
    /// Number of the configuration.
    pub number: u32,
    /// Remaining starts.
    pub attempts: u8,
    /// Time until it must be confirmed, in seconds.
    pub confirm_s: u16,
}

/// Why a configuration was not stored or marked.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[non_exhaustive]
pub enum KeepError {
    /// The record cannot be written.
    Put(PutError),
    /// The configuration to be forgotten or replaced is marked.
    Needed {
        /// Number of the configuration.
        number: u32,
    },
    /// There is no such configuration.
    Unknown {
        /// Number of the configuration.
        number: u32,
    },
}

impl fmt::Display for KeepError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Put(error) => error.fmt(f),
            Self::Needed { number } => write!(f, "configuration {number} is in use"),
            Self::Unknown { number } => write!(f, "configuration {number} is not kept"),
        }
    }
}

impl core::error::Error for KeepError {}

impl From<PutError> for KeepError {
    fn from(error: PutError) -> Self {
        Self::Put(error)
    }
}

/// Role of a configuration at a start.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Role {
    /// It is on trial.
    Trial {
        /// Time until it must be confirmed, in seconds.
        confirm_s: u16,
    },
    /// It is the live one.
    Live,
    /// It was live before.
    Previous,
}

/// Candidates at a start.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Start {
    /// Marks to write before anything runs: they count a start of the trial, or end it.
    pub marks: Option<Marks>,
    /// Candidates in order; the first one that can run is to be run.
    pub candidates: heapless::Vec<(Revision, Role), 3>,
}

/// Next step of adopting an image.
#[derive(Debug)]
pub enum Adoption<'s, 'd> {
    /// A record to write.
    Write(Put<'s, 'd>),
    /// The image has been adopted.
    Done,
}

impl Store {
    /// Stored configurations in the order of their numbers.
    pub fn revisions(&self) -> heapless::Vec<Revision, MAX_REVISIONS> {
        let mut all: heapless::Vec<Revision, MAX_REVISIONS> = heapless::Vec::new();
        let next = |after: Option<u32>| {
            let kept = (0..MAX_REVISIONS as u8).filter_map(|slot| self.in_slot(slot));
            kept.filter(|kept| after.is_none_or(|after| kept.number > after)).min_by_key(|kept| kept.number)
        };
        while let Some(revision) = next(all.last().map(|last| last.number)) {
            if all.push(revision).is_err() {
                break;
            }
        }
        all
    }

    fn in_slot(&self, slot: u8) -> Option<Revision> {
        // An empty record without a number marks a forgotten image.
        let found = self.find(RecordKey::Image(slot)).filter(|found| found.len > 0 || found.tag != 0)?;
        let [a, b, c, d, e, f, g, h] = found.tag.to_le_bytes();
        let number = u32::from_le_bytes([a, b, c, d]);
        let digest = u32::from_le_bytes([e, f, g, h]);
        Some(Revision { number, digest, len: found.len, slot })
    }

    /// The configuration of this number.
    pub fn revision(&self, number: u32) -> Option<Revision> {
        (0..MAX_REVISIONS as u8)
            .filter_map(|slot| self.in_slot(slot))
            .find(|revision| revision.number == number)
    }

    /// Copies the image of a configuration to the beginning of `out`; `None` if it is not stored or `out` is too short.
    pub fn image<'o>(&self, flash: &impl Flash, number: u32, out: &'o mut [u8]) -> Option<&'o [u8]> {
        self.get(flash, self.revision(number)?.key(), out)
    }

    /// Marks of the configurations.
    pub fn marks(&self) -> Marks {
        let Some(found) = self.find(RecordKey::Marks) else { return Marks::default() };
        let [live, previous, trial, attempts, low, high, last, ended] = found.tag.to_le_bytes();
        let number = |slot: u8| self.in_slot(slot).map(|revision| revision.number);
        let confirm_s = u16::from_le_bytes([low, high]);
        Marks {
            live: number(live),
            previous: number(previous),
            trial: number(trial).map(|number| Trial { number, attempts, confirm_s }),
            last: number(last).zip(TrialEnd::of_code(ended)),
        }
    }

    /// Marks configurations.
    ///
    /// # Errors
    /// A marked configuration is not stored, or the marks cannot be written.
    pub fn mark(&mut self, marks: Marks) -> Result<Put<'_, 'static>, KeepError> {
        let slot = |number: Option<u32>| match number {
            Some(number) => {
                self.revision(number).map(|revision| revision.slot).ok_or(KeepError::Unknown { number })
            }
            None => Ok(NO_SLOT),
        };
        let (live, previous) = (slot(marks.live)?, slot(marks.previous)?);
        let trial = slot(marks.trial.map(|trial| trial.number))?;
        let (attempts, confirm_s) = marks.trial.map_or((0, 0), |trial| (trial.attempts, trial.confirm_s));
        let ended_slot = slot(marks.last.map(|(number, _)| number))?;
        let ended = marks.last.map_or(0, |(_, ended)| ended.code());
        let [low, high] = confirm_s.to_le_bytes();
        let tag = u64::from_le_bytes([live, previous, trial, attempts, low, high, ended_slot, ended]);
        Ok(self.put(RecordKey::Marks, tag, &[])?)
    }

    /// Stores a configuration in the place of `forget`; if that is `None`, in a free place or that of the oldest
    /// unmarked one.
    ///
    /// # Errors
    /// It cannot be written; `forget` remains.
    pub fn keep<'d>(
        &mut self,
        number: u32,
        digest: u32,
        image: &'d [u8],
        forget: Option<u32>,
    ) -> Result<Put<'_, 'd>, KeepError> {
        let marks = self.marks();
        let needed = marks.numbers();
        let is_needed = |number: u32| needed.contains(&Some(number));
        let revisions = self.revisions();
        // A configuration of the same number is replaced.
        let same = revisions.iter().find(|revision| revision.number == number).map(|same| same.number);
        let free = (0..MAX_REVISIONS as u8).find(|slot| self.in_slot(*slot).is_none());
        let oldest = || revisions.iter().find(|kept| !is_needed(kept.number)).map(|kept| kept.slot);
        let slot = match same.or(forget) {
            Some(number) if is_needed(number) => return Err(KeepError::Needed { number }),
            Some(number) => self.revision(number).ok_or(KeepError::Unknown { number })?.slot,
            None => free.or_else(oldest).ok_or(KeepError::Needed { number })?,
        };
        let tag = u64::from(digest) << 32 | u64::from(number);
        Ok(self.put(RecordKey::Image(slot), tag, image)?)
    }

    /// Forgets a configuration to free its space: `number`, or the oldest unmarked one. `None` if there is none.
    ///
    /// # Errors
    /// It is marked, or the flash cannot be written.
    pub fn forget(&mut self, number: Option<u32>) -> Result<Option<Put<'_, 'static>>, KeepError> {
        let needed = self.marks().numbers();
        let is_needed = |number: u32| needed.contains(&Some(number));
        let revisions = self.revisions();
        let slot = match number {
            Some(number) if is_needed(number) => return Err(KeepError::Needed { number }),
            Some(number) => self.revision(number),
            None => revisions.into_iter().find(|kept| !is_needed(kept.number)),
        };
        let Some(Revision { slot, .. }) = slot else { return Ok(None) };
        Ok(Some(self.put(RecordKey::Image(slot), 0, &[])?))
    }

    /// Candidates at a start: the configuration on trial while it has starts left, the live one, the previous one.
    pub fn at_start(&self) -> Start {
        let marks = self.marks();
        let mut start = Start { marks: None, candidates: heapless::Vec::new() };
        if let Some(trial) = marks.trial {
            let left = trial.attempts.checked_sub(1);
            let last = if left.is_some() { marks.last } else { Some((trial.number, TrialEnd::Failed)) };
            let trial_left = left.map(|attempts| Trial { attempts, ..trial });
            start.marks = Some(Marks { trial: trial_left, last, ..marks });
            if let Some(revision) = self.revision(trial.number).filter(|_| left.is_some()) {
                let _ = start.candidates.push((revision, Role::Trial { confirm_s: trial.confirm_s }));
            }
        }
        for (number, role) in [(marks.live, Role::Live), (marks.previous, Role::Previous)] {
            if let Some(revision) = number.and_then(|number| self.revision(number)) {
                let _ = start.candidates.push((revision, role));
            }
        }
        start
    }

    /// Adopts an image from outside the store: stores it, makes it the live one, and records the adoption, so that it
    /// happens once. Call again after executing each [`Adoption::Write`]; it resumes after a power cut.
    pub fn adopt<'d>(&mut self, digest: u32, image: &'d [u8]) -> Result<Adoption<'_, 'd>, KeepError> {
        if self.is_adopted(digest, image.len()) {
            return Ok(Adoption::Done);
        }
        let revisions = self.revisions();
        let same = revisions.iter().rev().find(|kept| kept.digest == digest && kept.len == image.len());
        let Some(same) = same.map(|kept| kept.number) else {
            let newest = revisions.last().map_or(0, |kept| kept.number);
            return Ok(Adoption::Write(self.keep(newest.saturating_add(1), digest, image, None)?));
        };
        let marks = self.marks();
        if marks.live != Some(same) {
            let marks = Marks { live: Some(same), previous: marks.live, trial: None, last: marks.last };
            return Ok(Adoption::Write(self.mark(marks)?));
        }
        Ok(Adoption::Write(self.put(RecordKey::Adopted, adopted(digest, image.len()), &[])?))
    }

    /// Whether this is the image that was adopted last.
    pub fn is_adopted(&self, digest: u32, len: usize) -> bool {
        self.find(RecordKey::Adopted).is_some_and(|found| found.tag == adopted(digest, len))
    }
}

/// Digest and length of an adopted image, as stored in its record.
fn adopted(digest: u32, len: usize) -> u64 {
    u64::from(digest) << 32 | u64::from(u32::try_from(len).unwrap_or(u32::MAX))
}

const NO_SLOT: u8 = u8::MAX;
