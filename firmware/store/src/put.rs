//! Writes a record.
//!
//! Records are written one behind the other into the current sector. The sectors form a ring. When the current sector
//! is full, the next one is erased. The sector behind the next one is the oldest in use: its records that are still
//! needed are copied into the next one, whose head is written last. Until the head is written, a power cut leaves
//! everything as it was; afterwards the oldest sector is free, to be erased when the new current sector is full. So a
//! sector that is being erased never contains a record that is needed.

use core::fmt;

use crate::mount::is_whole;
use crate::record::{KEYS, MAX_DATA, RecordHead, SectorHead, part, sum};
use crate::{BLANK, Flash, FlashWord, FoundRecord, RecordKey, Store, Word};

/// A record being written. If it is dropped before its end, either the old or the new record is valid. Each flash
/// operation must be complete before the next one begins.
#[must_use = "nothing is written until `next` or `execute` is called"]
#[derive(Debug)]
pub struct Put<'s, 'd> {
    store: &'s mut Store,
    data: &'d [u8],
    work: Work,
}

#[derive(Debug)]
pub(crate) struct Work {
    head: RecordHead,
    phase: PutPhase,
    writing: WordWriter,
    /// Next free word of the sector that records are copied into.
    fill: u16,
    /// Words of the copies, by key.
    copies: [u16; KEYS],
    /// Remaining attempts to begin a sector.
    turns: u8,
    tries: u8,
    /// All sectors have been erased: a blank sector is not erased again before it is begun.
    is_erased: bool,
}

/// The next step.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum PutStep {
    /// Erase this sector.
    Erase(u8),
    /// Write a word.
    Write(FlashWord, Word),
    /// The end. The old record is valid until the put ends without an error; from then on the new one is.
    End(Result<(), PutError>),
}

/// Why a record was not written.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[non_exhaustive]
pub enum PutError {
    /// The data are longer than [`MAX_DATA`].
    TooLong {
        /// Number of bytes.
        len: usize,
    },
    /// Not enough space beside the stored records.
    Full {
        /// Number of words in use.
        used: u32,
        /// Limit of words in use when this record is added.
        available: u32,
    },
    /// No such key.
    Key,
    /// The sector is not blank after an erase, or its head cannot be written.
    Sector(u8),
    /// At several places, words read differently from what was written.
    Worn,
}

impl fmt::Display for PutError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::TooLong { len } => write!(f, "{len} bytes; at most {MAX_DATA} are kept"),
            Self::Full { used, available } => {
                write!(
                    f,
                    "the store is full: it holds {used} words, and may hold {available} beside the new record"
                )
            }
            Self::Key => f.write_str("no such key"),
            Self::Sector(sector) => write!(f, "sector {sector} of the store cannot be erased"),
            Self::Worn => f.write_str("the flash does not keep what is written"),
        }
    }
}

impl core::error::Error for PutError {}

#[derive(Debug, Clone, Copy)]
enum PutPhase {
    Place,
    Append,
    Erase {
        tries: u8,
    },
    Erased {
        tries: u8,
    },
    /// Copy the record of this key if it is in the oldest sector; then do the same for all later keys.
    Copy {
        key: u8,
    },
    Copying {
        key: u8,
        head: RecordHead,
        from: FoundRecord,
    },
    Begin,
    Begun,
    End(Result<(), PutError>),
}

#[derive(Debug, Clone, Copy)]
enum WordWriter {
    Head,
    CheckHead { at: u16 },
    Data { at: u16, nth: u16 },
    Check { at: u16 },
}

/// Result of one step of writing a record.
enum WriteProgress {
    Step(PutStep),
    /// The record begins here.
    At(u16),
    Full,
    Worn,
}

pub(crate) enum RecordSource<'d, F> {
    Bytes(&'d [u8]),
    Flash(&'d F, FoundRecord),
}

impl<F: Flash> RecordSource<'_, F> {
    fn part(&self, nth: u16) -> Word {
        match self {
            Self::Bytes(data) => part(data, nth),
            Self::Flash(flash, FoundRecord { data: FlashWord { sector, word }, .. }) => {
                flash.read(FlashWord { sector: *sector, word: word.saturating_add(nth) })
            }
        }
    }
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum PutTarget {
    Filled,
    /// The target of copying.
    Next,
}

impl Store {
    /// Begins to write a record, which replaces the one of this key.
    ///
    /// # Errors
    /// It cannot be written; the previous value remains.
    pub fn put<'d>(&mut self, key: RecordKey, tag: u64, data: &'d [u8]) -> Result<Put<'_, 'd>, PutError> {
        let code = key.code().ok_or(PutError::Key)?;
        let too_long = PutError::TooLong { len: data.len() };
        let len = u32::try_from(data.len()).map_err(|_| too_long)?;
        if data.len() > MAX_DATA {
            return Err(too_long);
        }
        let head = RecordHead { key: code, sequence: self.sequence, len, tag, sum: sum(data) };
        let work = self.begin(head)?;
        // The number is used up even if the write fails, because the written words may later be read as a record.
        self.sequence = self.sequence.saturating_add(1);
        Ok(Put { store: self, data, work })
    }

    /// Plans writing the record with this head, if there is space.
    pub(crate) fn begin(&self, head: RecordHead) -> Result<Work, PutError> {
        let (used, available) = self.used(head.extent());
        if used > available {
            return Err(PutError::Full { used, available });
        }
        Ok(Work {
            head,
            phase: PutPhase::Place,
            writing: WordWriter::Head,
            fill: 0,
            copies: [0; KEYS],
            turns: self.geometry.sectors,
            tries: TRIES,
            is_erased: false,
        })
    }
}

impl Put<'_, '_> {
    /// Returns the next step. Call it again when that step is done, until it returns [`PutStep::End`].
    pub fn next<F: Flash>(&mut self, flash: &F) -> PutStep {
        self.work.next(self.store, &RecordSource::<F>::Bytes(self.data), flash)
    }

    /// Executes all steps.
    ///
    /// # Errors
    /// The record was not written; the previous one remains.
    pub async fn execute(mut self, flash: &mut impl Flash) -> Result<(), PutError> {
        loop {
            match self.next(flash) {
                PutStep::Erase(sector) => flash.erase(sector).await,
                PutStep::Write(place, word) => flash.write(place, &word).await,
                PutStep::End(result) => return result,
            }
        }
    }
}

impl Work {
    /// For flash whose sectors have all been erased.
    pub(crate) fn in_erased(self) -> Self {
        Self { is_erased: true, ..self }
    }

    /// Returns the next step for the flash of `store`.
    pub(crate) fn next<F: Flash>(
        &mut self,
        store: &mut Store,
        source: &RecordSource<'_, impl Flash>,
        flash: &F,
    ) -> PutStep {
        loop {
            match self.phase {
                PutPhase::Place => self.find_place(store),
                PutPhase::Append => {
                    let head = self.head;
                    match self.write(store, flash, &head, source, PutTarget::Filled) {
                        WriteProgress::Step(step) => return step,
                        WriteProgress::At(word) => {
                            if let Some((sector, _)) = store.head {
                                store.enter(FlashWord { sector, word }, &head);
                            }
                            self.phase = PutPhase::End(Ok(()));
                        }
                        WriteProgress::Full => self.phase = PutPhase::Place,
                        WriteProgress::Worn => self.phase = PutPhase::End(Err(PutError::Worn)),
                    }
                }
                PutPhase::Erase { tries } => {
                    self.phase = PutPhase::Erased { tries: tries.saturating_sub(1) };
                    return PutStep::Erase(next_sector(store));
                }
                PutPhase::Erased { tries } => {
                    let sector = next_sector(store);
                    self.fill = 1;
                    self.phase = match (is_blank(flash, sector), tries) {
                        (true, _) => PutPhase::Copy { key: 0 },
                        (false, 0) => PutPhase::End(Err(PutError::Sector(sector))),
                        (false, tries) => PutPhase::Erase { tries },
                    };
                }
                PutPhase::Copy { key } => self.copy(store, flash, key),
                PutPhase::Copying { key, head, from } => {
                    match self.write(store, flash, &head, &RecordSource::Flash(flash, from), PutTarget::Next)
                    {
                        WriteProgress::Step(step) => return step,
                        WriteProgress::At(word) => {
                            if let Some(copy) = self.copies.get_mut(usize::from(key)) {
                                *copy = word;
                            }
                            self.phase = PutPhase::Copy { key: key.saturating_add(1) };
                        }
                        WriteProgress::Full | WriteProgress::Worn => {
                            self.phase = PutPhase::End(Err(PutError::Worn))
                        }
                    }
                }
                PutPhase::Begin => {
                    let place = FlashWord { sector: next_sector(store), word: 0 };
                    self.phase = PutPhase::Begun;
                    return PutStep::Write(place, SectorHead::word(next_sequence(store)));
                }
                PutPhase::Begun => self.begun(store, flash),
                PutPhase::End(result) => return PutStep::End(result),
            }
        }
    }

    fn find_place(&mut self, store: &Store) {
        self.writing = WordWriter::Head;
        self.phase = if store.head.is_some() && store.has_room(store.end, self.head.extent()) {
            PutPhase::Append
        } else if let Some(left) = self.turns.checked_sub(1) {
            self.turns = left;
            self.copies = [0; KEYS];
            if self.is_erased { PutPhase::Erased { tries: 2 } } else { PutPhase::Erase { tries: 2 } }
        } else {
            // Rewrites have used up the space.
            PutPhase::End(Err(PutError::Worn))
        };
    }

    /// Looks for the next record to be copied, from this key on.
    fn copy(&mut self, store: &Store, flash: &impl Flash, from: u8) {
        let old = behind(store, next_sector(store));
        let found = (from..KEYS as u8)
            .find_map(|key| Some((key, store.entry(key).filter(|found| found.data.sector == old)?)));
        self.writing = WordWriter::Head;
        self.phase = match found {
            Some((key, from)) => match head_of(flash, from) {
                Some(head) => PutPhase::Copying { key, head, from },
                // The record was valid at mount and has not changed.
                None => PutPhase::End(Err(PutError::Worn)),
            },
            None => PutPhase::Begin,
        };
    }

    /// Makes the new sector the current one if its head can be read.
    fn begun(&mut self, store: &mut Store, flash: &impl Flash) {
        let (sector, sequence) = (next_sector(store), next_sequence(store));
        if flash.read(FlashWord { sector, word: 0 }) != SectorHead::word(sequence) {
            self.phase = PutPhase::End(Err(PutError::Sector(sector)));
            return;
        }
        store.head = Some((sector, sequence));
        store.end = self.fill;
        for (key, word) in (0..).zip(self.copies) {
            if word != 0 {
                store.moved(key, FlashWord { sector, word });
            }
        }
        self.phase = PutPhase::Place;
    }

    /// The next step of a record, at the end of a sector.
    fn write(
        &mut self,
        store: &mut Store,
        flash: &impl Flash,
        head: &RecordHead,
        source: &RecordSource<'_, impl Flash>,
        into: PutTarget,
    ) -> WriteProgress {
        let sector = match store.head {
            Some((sector, _)) if into == PutTarget::Filled => sector,
            _ => next_sector(store),
        };
        loop {
            match self.writing {
                WordWriter::Head => {
                    let free = if into == PutTarget::Next { self.fill } else { store.end };
                    if !store.has_room(free, head.extent()) {
                        return WriteProgress::Full;
                    }
                    self.set_end(store, into, free.saturating_add(1));
                    self.writing = WordWriter::CheckHead { at: free };
                    return WriteProgress::Step(PutStep::Write(
                        FlashWord { sector, word: free },
                        head.word(),
                    ));
                }
                // Data is written only behind a readable head. Otherwise it could be taken for records.
                WordWriter::CheckHead { at } => {
                    if flash.read(FlashWord { sector, word: at }) == head.word() {
                        self.set_end(store, into, at.saturating_add(head.extent()));
                        self.writing = WordWriter::Data { at, nth: 0 };
                    } else if !self.again() {
                        return WriteProgress::Worn;
                    }
                }
                WordWriter::Data { at, nth } => {
                    let place = FlashWord { sector, word: at.saturating_add(1).saturating_add(nth) };
                    if nth < head.extent().saturating_sub(2) {
                        self.writing = WordWriter::Data { at, nth: nth.saturating_add(1) };
                        return WriteProgress::Step(PutStep::Write(place, source.part(nth)));
                    }
                    self.writing = WordWriter::Check { at };
                    return WriteProgress::Step(PutStep::Write(place, head.word()));
                }
                WordWriter::Check { at } => {
                    let place = FlashWord { sector, word: at };
                    if flash.read(place) == head.word() && is_whole(flash, place, head) {
                        return WriteProgress::At(at);
                    }
                    if !self.again() {
                        return WriteProgress::Worn;
                    }
                }
            }
        }
    }

    /// Prepares a retry behind the words written so far; returns whether an attempt was left.
    fn again(&mut self) -> bool {
        let Some(left) = self.tries.checked_sub(1) else { return false };
        self.tries = left;
        self.writing = WordWriter::Head;
        true
    }

    fn set_end(&mut self, store: &mut Store, into: PutTarget, word: u16) {
        *(if into == PutTarget::Next { &mut self.fill } else { &mut store.end }) = word;
    }
}

pub(crate) fn is_blank(flash: &impl Flash, sector: u8) -> bool {
    (0..flash.geometry().words).all(|word| flash.read(FlashWord { sector, word }) == BLANK)
}

pub(crate) fn head_of(flash: &impl Flash, found: FoundRecord) -> Option<RecordHead> {
    let word = FlashWord { word: found.data.word.saturating_sub(1), ..found.data };
    RecordHead::parse(&flash.read(word))
}

/// The next sector of the ring.
fn next_sector(store: &Store) -> u8 {
    store.head.map_or(0, |(head, _)| behind(store, head))
}

fn next_sequence(store: &Store) -> u32 {
    store.head.map_or(1, |(_, sequence)| sequence.saturating_add(1))
}

fn behind(store: &Store, sector: u8) -> u8 {
    let next = sector.saturating_add(1);
    if next < store.geometry.sectors { next } else { 0 }
}

/// Maximum number of rewrites after failed verification. A power cut can cause one, by leaving a word that only looks
/// blank. Several power cuts at the same place cause one each.
const TRIES: u8 = 8;
