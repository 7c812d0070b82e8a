//! Writes a record.
//!
//! Records are written one behind the other in one sector. When it is full, the next one of the ring is erased.
//! The records that are still needed in the sector behind that are copied into it, and only then it gets its
//! head: so a power cut before leaves everything as it was, and the sector behind is free for the next turn.
//! Nothing that is needed is ever in a sector that is being erased.

use core::fmt;

use crate::mount::is_whole;
use crate::record::{Head, KEYS, MAX_DATA, SectorHead, extent, part, sum};
use crate::{BLANK, Flash, Found, Key, Place, Store, Word};

/// A record that is being written. Dropped before it has ended, it leaves the old record or the new one; the
/// operation of flash that was begun has to end before the next.
#[must_use = "nothing is written until `next` or `carry_out` is called"]
#[derive(Debug)]
pub struct Put<'s, 'd> {
    store: &'s mut Store,
    head: Head,
    data: &'d [u8],
    phase: Phase,
    writing: Writing,
    /// The next free word of the sector that is copied into.
    fill: u16,
    /// Where the copies are, by key.
    copies: [u16; KEYS],
    /// How often a sector may be begun.
    turns: u8,
    /// How often something may be written again.
    tries: u8,
}

/// What to do next.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Step {
    /// Erase this sector.
    Erase(u8),
    /// Write a word.
    Write(Place, Word),
    /// Nothing more. Until a put has ended well, what was there before counts; after that, what was put.
    End(Result<(), PutError>),
}

/// Why a record is not there.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[non_exhaustive]
pub enum PutError {
    /// The data are longer than [`MAX_DATA`].
    TooLong {
        /// Number of bytes.
        len: usize,
    },
    /// There is no room beside what is kept.
    Full {
        /// Number of words that are taken.
        used: u32,
        /// Number of words that may be taken when this record is added.
        available: u32,
    },
    /// No such key.
    Key,
    /// The sector does not become blank, or its head cannot be written.
    Sector(u8),
    /// The words that were written read differently, at several places.
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
enum Phase {
    /// Look for room.
    Place,
    Append,
    Erase {
        tries: u8,
    },
    Erased {
        tries: u8,
    },
    /// Copy the record of this key if the sector behind has it, and those of all later keys.
    Copy {
        key: u8,
    },
    Copying {
        key: u8,
        head: Head,
        from: Found,
    },
    Begin,
    Begun,
    End(Result<(), PutError>),
}

/// How far a record is written.
#[derive(Debug, Clone, Copy)]
enum Writing {
    Head,
    CheckHead { at: u16 },
    Data { at: u16, nth: u16 },
    Check { at: u16 },
}

/// What writing a record asks for.
enum Written {
    Step(Step),
    /// It begins here.
    At(u16),
    NoRoom,
    Worn,
}

/// Where the data of a record come from.
#[derive(Clone, Copy)]
enum Source<'d> {
    Bytes(&'d [u8]),
    Flash(Found),
}

impl Source<'_> {
    fn part(&self, flash: &impl Flash, nth: u16) -> Word {
        match self {
            Self::Bytes(data) => part(data, nth),
            Self::Flash(Found { data: Place { sector, word }, .. }) => {
                flash.read(Place { sector: *sector, word: word.saturating_add(nth) })
            }
        }
    }
}

impl Store {
    /// Begins to write a record, which replaces the one of this key.
    ///
    /// # Errors
    /// It cannot be kept.
    pub fn put<'d>(&mut self, key: Key, tag: u64, data: &'d [u8]) -> Result<Put<'_, 'd>, PutError> {
        let code = key.code().ok_or(PutError::Key)?;
        let too_long = PutError::TooLong { len: data.len() };
        let len = u32::try_from(data.len()).map_err(|_| too_long)?;
        if data.len() > MAX_DATA {
            return Err(too_long);
        }
        let (used, available) = self.used(extent(data.len()));
        if used > available {
            return Err(PutError::Full { used, available });
        }
        let head = Head { key: code, sequence: self.sequence, len, tag, sum: sum(data) };
        // Also if it fails: its words may be read as a record later.
        self.sequence = self.sequence.saturating_add(1);
        let turns = self.geometry.sectors;
        Ok(Put {
            store: self,
            head,
            data,
            phase: Phase::Place,
            writing: Writing::Head,
            fill: 0,
            copies: [0; KEYS],
            turns,
            tries: TRIES,
        })
    }
}

impl Put<'_, '_> {
    /// What to do next; called again when that is done, until it is [`Step::End`].
    pub fn next(&mut self, flash: &impl Flash) -> Step {
        loop {
            match self.phase {
                Phase::Place => self.find_place(),
                Phase::Append => {
                    let head = self.head;
                    match self.write(flash, &head, Source::Bytes(self.data)) {
                        Written::Step(step) => return step,
                        Written::At(word) => {
                            if let Some((sector, _)) = self.store.head {
                                self.store.enter(Place { sector, word }, &head);
                            }
                            self.phase = Phase::End(Ok(()));
                        }
                        Written::NoRoom => self.phase = Phase::Place,
                        Written::Worn => self.phase = Phase::End(Err(PutError::Worn)),
                    }
                }
                Phase::Erase { tries } => {
                    self.phase = Phase::Erased { tries: tries.saturating_sub(1) };
                    return Step::Erase(self.next_sector());
                }
                Phase::Erased { tries } => {
                    let sector = self.next_sector();
                    let is_blank = (0..self.store.geometry.words)
                        .all(|word| flash.read(Place { sector, word }) == BLANK);
                    self.fill = 1;
                    self.phase = match (is_blank, tries) {
                        (true, _) => Phase::Copy { key: 0 },
                        (false, 0) => Phase::End(Err(PutError::Sector(sector))),
                        (false, tries) => Phase::Erase { tries },
                    };
                }
                Phase::Copy { key } => self.copy(flash, key),
                Phase::Copying { key, head, from } => match self.write(flash, &head, Source::Flash(from)) {
                    Written::Step(step) => return step,
                    Written::At(word) => {
                        if let Some(copy) = self.copies.get_mut(usize::from(key)) {
                            *copy = word;
                        }
                        self.phase = Phase::Copy { key: key.saturating_add(1) };
                    }
                    Written::NoRoom | Written::Worn => self.phase = Phase::End(Err(PutError::Worn)),
                },
                Phase::Begin => {
                    let place = Place { sector: self.next_sector(), word: 0 };
                    self.phase = Phase::Begun;
                    return Step::Write(place, SectorHead::word(self.next_sequence()));
                }
                Phase::Begun => self.begun(flash),
                Phase::End(result) => return Step::End(result),
            }
        }
    }

    /// Does all steps.
    ///
    /// # Errors
    /// Why the record is not there; the one before is.
    pub async fn carry_out(mut self, flash: &mut impl Flash) -> Result<(), PutError> {
        loop {
            match self.next(flash) {
                Step::Erase(sector) => flash.erase(sector).await,
                Step::Write(place, word) => flash.write(place, &word).await,
                Step::End(result) => return result,
            }
        }
    }

    fn find_place(&mut self) {
        self.writing = Writing::Head;
        self.phase = if self.store.head.is_some() && self.store.has_room(self.store.end, self.head.extent()) {
            Phase::Append
        } else if let Some(left) = self.turns.checked_sub(1) {
            self.turns = left;
            self.copies = [0; KEYS];
            Phase::Erase { tries: 2 }
        } else {
            // More was written again than there is room.
            Phase::End(Err(PutError::Worn))
        };
    }

    /// The sector to be begun next.
    fn next_sector(&self) -> u8 {
        self.store.head.map_or(0, |(head, _)| self.behind(head))
    }

    fn next_sequence(&self) -> u32 {
        self.store.head.map_or(1, |(_, sequence)| sequence.saturating_add(1))
    }

    fn behind(&self, sector: u8) -> u8 {
        let next = sector.saturating_add(1);
        if next < self.store.geometry.sectors { next } else { 0 }
    }

    /// Looks for the next record to be copied, from this key on.
    fn copy(&mut self, flash: &impl Flash, from: u8) {
        let old = self.behind(self.next_sector());
        let found = (from..KEYS as u8)
            .find_map(|key| Some((key, self.store.entry(key).filter(|found| found.data.sector == old)?)));
        self.writing = Writing::Head;
        self.phase = match found {
            Some((key, from)) => {
                let word = Place { word: from.data.word.saturating_sub(1), ..from.data };
                match Head::parse(&flash.read(word)) {
                    Some(head) => Phase::Copying { key, head, from },
                    // It was read at the start, and is not written.
                    None => Phase::End(Err(PutError::Worn)),
                }
            }
            None => Phase::Begin,
        };
    }

    /// The sector is the one that counts, if its head is there.
    fn begun(&mut self, flash: &impl Flash) {
        let (sector, sequence) = (self.next_sector(), self.next_sequence());
        if flash.read(Place { sector, word: 0 }) != SectorHead::word(sequence) {
            self.phase = Phase::End(Err(PutError::Sector(sector)));
            return;
        }
        self.store.head = Some((sector, sequence));
        self.store.end = self.fill;
        for (key, word) in (0..).zip(self.copies) {
            if word != 0 {
                self.store.moved(key, Place { sector, word });
            }
        }
        self.phase = Phase::Place;
    }

    /// The next step of a record, at the end of the sector that is being filled or copied into.
    fn write(&mut self, flash: &impl Flash, head: &Head, source: Source<'_>) -> Written {
        let is_copy = matches!(source, Source::Flash(_));
        let sector = match self.store.head {
            Some((sector, _)) if !is_copy => sector,
            _ => self.next_sector(),
        };
        let free = if is_copy { self.fill } else { self.store.end };
        loop {
            match self.writing {
                Writing::Head => {
                    if !self.store.has_room(free, head.extent()) {
                        return Written::NoRoom;
                    }
                    self.set_end(is_copy, free.saturating_add(1));
                    self.writing = Writing::CheckHead { at: free };
                    return Written::Step(Step::Write(Place { sector, word: free }, head.word()));
                }
                // Data only behind a head that can be read: without it they could be taken for records.
                Writing::CheckHead { at } => {
                    if flash.read(Place { sector, word: at }) == head.word() {
                        self.set_end(is_copy, at.saturating_add(head.extent()));
                        self.writing = Writing::Data { at, nth: 0 };
                    } else {
                        return self.again(flash, head, source);
                    }
                }
                Writing::Data { at, nth } => {
                    let place = Place { sector, word: at.saturating_add(1).saturating_add(nth) };
                    if nth < head.extent().saturating_sub(2) {
                        self.writing = Writing::Data { at, nth: nth.saturating_add(1) };
                        return Written::Step(Step::Write(place, source.part(flash, nth)));
                    }
                    self.writing = Writing::Check { at };
                    return Written::Step(Step::Write(place, head.word()));
                }
                Writing::Check { at } => {
                    let place = Place { sector, word: at };
                    if flash.read(place) == head.word() && is_whole(flash, place, head) {
                        return Written::At(at);
                    }
                    return self.again(flash, head, source);
                }
            }
        }
    }

    /// The same once more, behind what is there now.
    fn again(&mut self, flash: &impl Flash, head: &Head, source: Source<'_>) -> Written {
        let Some(left) = self.tries.checked_sub(1) else { return Written::Worn };
        self.tries = left;
        self.writing = Writing::Head;
        self.write(flash, head, source)
    }

    fn set_end(&mut self, is_copy: bool, word: u16) {
        *(if is_copy { &mut self.fill } else { &mut self.store.end }) = word;
    }
}

/// How often words may read differently than they were written. After a power cut it happens once, where a word
/// only looks blank; after several cuts in the same place, once for each.
const TRIES: u8 = 8;
