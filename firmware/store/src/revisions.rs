//! Configurations: which are kept, which one is live, and which one is on trial.

use core::fmt;

use crate::{Flash, Key, Put, PutError, Store};

/// Number of configurations that are kept.
pub const MAX_REVISIONS: usize = 8;

/// A configuration that is kept.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Revision {
    /// Its number: higher than that of all before it.
    pub number: u32,
    /// Tells it from other contents of the same number; the store does not compute it.
    pub digest: u32,
    /// Length of its image in bytes.
    pub len: usize,
    slot: u8,
}

impl Revision {
    /// The key of its image.
    pub fn key(&self) -> Key {
        Key::Image(self.slot)
    }
}

/// What the configurations are, changed in one step.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Marks {
    /// Number of the one that runs after a restart.
    pub live: Option<u32>,
    /// Number of the one that was live before.
    pub previous: Option<u32>,
    /// The one on trial.
    pub trial: Option<Trial>,
    /// Number of the one whose trial ended last, and how.
    pub last: Option<(u32, Ended)>,
}

impl Marks {
    /// The configurations that it names, whose places are theirs.
    pub fn numbers(&self) -> [Option<u32>; 4] {
        let last = self.last.map(|(number, _)| number);
        [self.live, self.previous, self.trial.map(|trial| trial.number), last]
    }
}

/// How a trial ended.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Ended {
    /// It was confirmed.
    Confirmed,
    /// Nobody confirmed it in time.
    NotConfirmed,
    /// Somebody took it back.
    TakenBack,
    /// It did not run, or used up its starts.
    Failed,
}

impl Ended {
    const ALL: [Self; 4] = [Self::Confirmed, Self::NotConfirmed, Self::TakenBack, Self::Failed];

    /// Never 0.
    pub(crate) fn code(self) -> u8 {
        Self::ALL.iter().position(|ended| *ended == self).map_or(0, |nth| nth as u8).saturating_add(1)
    }

    pub(crate) fn of_code(code: u8) -> Option<Self> {
        Self::ALL.get(usize::from(code.checked_sub(1)?)).copied()
    }
}

/// A configuration that runs, and is not live.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Trial {
    /// Its number.
    pub number: u32,
    /// How many more starts it has.
    pub attempts: u8,
    /// How long it runs until it has to be confirmed, in seconds.
    pub confirm_s: u16,
}

/// Why a configuration is not kept or marked.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[non_exhaustive]
pub enum KeepError {
    /// It cannot be written.
    Put(PutError),
    /// A mark names the one to be forgotten, or the one of this number.
    Needed {
        /// Its number.
        number: u32,
    },
    /// There is no such configuration.
    Unknown {
        /// Its number.
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

/// Why a configuration is to be run.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Role {
    /// It is on trial.
    Trial {
        /// How long it runs until it has to be confirmed, in seconds.
        confirm_s: u16,
    },
    /// It is the live one.
    Live,
    /// It was live before.
    Previous,
}

/// What to do at a start.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Start {
    /// To be marked before anything runs: the trial has one start less, or is over.
    pub marks: Option<Marks>,
    /// The first of them that can run is to be run.
    pub candidates: heapless::Vec<(Revision, Role), 3>,
}

/// The next thing to be written of an image that is taken over.
#[derive(Debug)]
pub enum Adoption<'s, 'd> {
    /// This.
    Write(Put<'s, 'd>),
    /// Nothing: it was taken over.
    Done,
}

impl Store {
    /// The configurations that are kept, by their numbers.
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
        // An empty one without a number is a place whose image was forgotten.
        let found = self.find(Key::Image(slot)).filter(|found| found.len > 0 || found.tag != 0)?;
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

    /// The image of a configuration, in the beginning of `out`; `None` if it is not kept, or if `out` is too
    /// short.
    pub fn image<'o>(&self, flash: &impl Flash, number: u32, out: &'o mut [u8]) -> Option<&'o [u8]> {
        self.get(flash, self.revision(number)?.key(), out)
    }

    /// Which configurations are live, before it, and on trial.
    pub fn marks(&self) -> Marks {
        let Some(found) = self.find(Key::Marks) else { return Marks::default() };
        let [live, previous, trial, attempts, low, high, last, ended] = found.tag.to_le_bytes();
        let number = |slot: u8| self.in_slot(slot).map(|revision| revision.number);
        let confirm_s = u16::from_le_bytes([low, high]);
        Marks {
            live: number(live),
            previous: number(previous),
            trial: number(trial).map(|number| Trial { number, attempts, confirm_s }),
            last: number(last).zip(Ended::of_code(ended)),
        }
    }

    /// Marks configurations.
    ///
    /// # Errors
    /// One of them is not kept, or the marks cannot be written.
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
        Ok(self.put(Key::Marks, tag, &[])?)
    }

    /// Keeps a configuration, in the place of `forget`. Without that it is a free place, or that of the oldest one
    /// that no mark names.
    ///
    /// # Errors
    /// It is not kept, and `forget` is.
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
        // One of the same number is replaced.
        let same = revisions.iter().find(|revision| revision.number == number).map(|same| same.number);
        let free = (0..MAX_REVISIONS as u8).find(|slot| self.in_slot(*slot).is_none());
        let oldest = || revisions.iter().find(|kept| !is_needed(kept.number)).map(|kept| kept.slot);
        let slot = match same.or(forget) {
            Some(number) if is_needed(number) => return Err(KeepError::Needed { number }),
            Some(number) => self.revision(number).ok_or(KeepError::Unknown { number })?.slot,
            None => free.or_else(oldest).ok_or(KeepError::Needed { number })?,
        };
        let tag = u64::from(digest) << 32 | u64::from(number);
        Ok(self.put(Key::Image(slot), tag, image)?)
    }

    /// Forgets a configuration, for its room: `number`, or the oldest one that no mark names. `None` if there is none.
    ///
    /// # Errors
    /// A mark names it, or that cannot be written.
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
        Ok(Some(self.put(Key::Image(slot), 0, &[])?))
    }

    /// What is to be run at a start: the configuration on trial while it has starts left, the live one, the one
    /// before.
    pub fn at_start(&self) -> Start {
        let marks = self.marks();
        let mut start = Start { marks: None, candidates: heapless::Vec::new() };
        if let Some(trial) = marks.trial {
            let left = trial.attempts.checked_sub(1);
            let last = if left.is_some() { marks.last } else { Some((trial.number, Ended::Failed)) };
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

    /// Takes over an image from outside the store: it is kept, becomes the live one, and that it was taken over
    /// is noted, so that it happens once. Called again after each [`Adoption::Write`] that was executed; after
    /// a power cut it goes on where it was.
    ///
    /// # Errors
    /// It cannot be written.
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
        Ok(Adoption::Write(self.put(Key::Adopted, adopted(digest, image.len()), &[])?))
    }

    /// Whether this is the image that was taken over last.
    pub fn is_adopted(&self, digest: u32, len: usize) -> bool {
        self.find(Key::Adopted).is_some_and(|found| found.tag == adopted(digest, len))
    }
}

/// Tells an image that was taken over from others.
fn adopted(digest: u32, len: usize) -> u64 {
    u64::from(digest) << 32 | u64::from(u32::try_from(len).unwrap_or(u32::MAX))
}

const NO_SLOT: u8 = u8::MAX;
