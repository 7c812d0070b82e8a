//! Moves a store to another place of the flash.
//!
//! A board with two slots has a place for the store in each flash bank. It uses the place in the bank that it does not
//! run from. A move erases the new place, copies all records, and writes the number of the move last. Until then the
//! old place, which is never written to, is valid, and an interrupted move is restarted.

use crate::mount::MountError;
use crate::put::{RecordSource, Work, head_of, is_blank};
use crate::record::{KEYS, RecordHead, sum};
use crate::{Flash, FoundRecord, PutError, PutStep, RecordKey, Store};

/// One of two places.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Side {
    /// The first place. A store that was never moved is here.
    First,
    /// The second place.
    Second,
}

/// The valid store of two places.
#[derive(Debug, Clone)]
pub struct Newest {
    /// The mounted store.
    pub store: Store,
    /// The valid place.
    pub side: Side,
    /// Whether it may be moved to the other place; not if that one was written by a newer program.
    pub may_move: bool,
}

/// Reads both places. The target of the last move is valid; if there was no move, the first place.
///
/// # Errors
/// Neither place is usable. The error is that of the first.
pub fn newest(first: &impl Flash, second: &impl Flash) -> Result<Newest, MountError> {
    match (Store::mount(first), Store::mount(second)) {
        (Ok(one), Ok(other)) if one.generation() >= other.generation() => {
            Ok(Newest { store: one, side: Side::First, may_move: true })
        }
        (Ok(_), Ok(store)) => Ok(Newest { store, side: Side::Second, may_move: true }),
        (Ok(store), Err(_)) => Ok(Newest { store, side: Side::First, may_move: false }),
        (Err(_), Ok(store)) => Ok(Newest { store, side: Side::Second, may_move: false }),
        (Err(error), Err(_)) => Err(error),
    }
}

/// A store being moved. If it is dropped or interrupted before its end, the store remains where it was.
#[must_use = "nothing is moved until `next` or `execute` is called"]
#[derive(Debug)]
pub struct Move<'s> {
    from: &'s Store,
    to: Store,
    phase: RelocatePhase,
}

#[derive(Debug)]
enum RelocatePhase {
    Erase {
        sector: u8,
        tries: u8,
    },
    Erased {
        sector: u8,
        tries: u8,
    },
    /// Copy the record of this key, then those of all later keys.
    Key(u8),
    Copying {
        key: u8,
        from: FoundRecord,
        work: Work,
    },
    Generation(Work),
    End(Result<(), PutError>),
}

impl Store {
    /// Number of times that the store was moved.
    pub fn generation(&self) -> u64 {
        self.find(RecordKey::Generation).map_or(0, |found| found.tag)
    }

    /// Begins a move to another place of the same size. Changes made to the store before the end of the move are lost.
    pub fn relocate(&self) -> Move<'_> {
        let to = Self::empty(self.geometry, self.sequence);
        Move { from: self, to, phase: RelocatePhase::Erase { sector: 0, tries: ERASES } }
    }
}

impl Move<'_> {
    /// Returns the next step for the new place. Call it again when that step is done, until it returns
    /// [`PutStep::End`].
    pub fn next<F: Flash>(&mut self, from: &impl Flash, to: &F) -> PutStep {
        loop {
            match &mut self.phase {
                RelocatePhase::Erase { sector, tries } => {
                    let (sector, tries) = (*sector, tries.saturating_sub(1));
                    self.phase = RelocatePhase::Erased { sector, tries };
                    return PutStep::Erase(sector);
                }
                RelocatePhase::Erased { sector, tries } => {
                    let (sector, tries) = (*sector, *tries);
                    let next = sector.saturating_add(1);
                    self.phase = if is_blank(to, sector) {
                        let is_last = next >= self.to.geometry.sectors;
                        if is_last {
                            RelocatePhase::Key(0)
                        } else {
                            RelocatePhase::Erase { sector: next, tries: ERASES }
                        }
                    } else if tries > 0 {
                        RelocatePhase::Erase { sector, tries }
                    } else {
                        RelocatePhase::End(Err(PutError::Sector(sector)))
                    };
                }
                RelocatePhase::Key(first) => {
                    let first = *first;
                    self.phase =
                        self.record(from, first).unwrap_or_else(|error| RelocatePhase::End(Err(error)));
                }
                RelocatePhase::Copying { key, from: found, work } => {
                    match work.next(&mut self.to, &RecordSource::Flash(from, *found), to) {
                        PutStep::End(Ok(())) => self.phase = RelocatePhase::Key(key.saturating_add(1)),
                        PutStep::End(Err(error)) => self.phase = RelocatePhase::End(Err(error)),
                        step => return step,
                    }
                }
                RelocatePhase::Generation(work) => {
                    match work.next(&mut self.to, &RecordSource::<F>::Bytes(&[]), to) {
                        PutStep::End(result) => self.phase = RelocatePhase::End(result),
                        step => return step,
                    }
                }
                RelocatePhase::End(result) => return PutStep::End(*result),
            }
        }
    }

    /// Begins to copy the first record from this key on. Behind the last one comes the number of the move.
    fn record(&mut self, from: &impl Flash, first: u8) -> Result<RelocatePhase, PutError> {
        let is_copied = |key: &u8| RecordKey::Generation.code() != Some(*key);
        let found = (first..KEYS as u8).filter(is_copied).find_map(|key| Some((key, self.from.entry(key)?)));
        if let Some((key, found)) = found {
            // The record was valid at mount and has not changed.
            let head = head_of(from, found).ok_or(PutError::Worn)?;
            return Ok(RelocatePhase::Copying { key, from: found, work: self.to.begin(head)?.in_erased() });
        }
        let key = RecordKey::Generation.code().ok_or(PutError::Key)?;
        let tag = self.from.generation().saturating_add(1);
        let head = RecordHead { key, sequence: self.to.sequence, len: 0, tag, sum: sum(&[]) };
        self.to.sequence = self.to.sequence.saturating_add(1);
        Ok(RelocatePhase::Generation(self.to.begin(head)?.in_erased()))
    }

    /// The store in its new place, after [`PutStep::End`] without an error; `None` otherwise.
    pub fn moved(self) -> Option<Store> {
        matches!(self.phase, RelocatePhase::End(Ok(()))).then_some(self.to)
    }

    /// Executes all steps; returns the store in its new place.
    ///
    /// # Errors
    /// The move failed; the old place remains valid.
    pub fn execute(
        self,
        from: &impl Flash,
        to: &mut impl Flash,
    ) -> impl Future<Output = Result<Store, PutError>> {
        let mut relocation = self;
        // An async block, because the future of an async function would hold `self` twice.
        async move {
            loop {
                match relocation.next(from, to) {
                    PutStep::Erase(sector) => to.erase(sector).await,
                    PutStep::Write(place, word) => to.write(place, &word).await,
                    PutStep::End(Ok(())) => return relocation.moved().ok_or(PutError::Worn),
                    PutStep::End(Err(error)) => return Err(error),
                }
            }
        }
    }
}

const ERASES: u8 = 2;
