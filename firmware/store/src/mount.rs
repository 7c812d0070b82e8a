//! The index of a store, read from flash.

use core::fmt;

use crate::record::{KEYS, RecordHead, RecordKey, SectorHead, digest};
use crate::{BLANK, Flash, FlashWord, Geometry, WORD, Word};

/// The newest record of each key, and where the next record goes.
#[derive(Debug, Clone)]
pub struct Store {
    pub(crate) geometry: Geometry,
    /// The current sector and its sequence number.
    pub(crate) head: Option<(u8, u32)>,
    /// Next free word of the current sector.
    pub(crate) end: u16,
    /// Sequence number of the next record.
    pub(crate) sequence: u32,
    index: [Option<FoundRecord>; KEYS],
}

/// A record.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct FoundRecord {
    /// First word of the data, `len` bytes long. Valid until the next change of the store.
    pub data: FlashWord,
    /// Length of the data in bytes.
    pub len: usize,
    /// Value stored in the head of the record; its meaning depends on the key.
    pub tag: u64,
    pub(crate) sequence: u32,
}

/// Why there is no store.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[non_exhaustive]
pub enum MountError {
    /// The store was written by a newer program. It is left unchanged.
    Version {
        /// The version found.
        found: u32,
    },
    /// The flash has fewer than two sectors of eight words, or more than eight sectors.
    Geometry(Geometry),
}

impl fmt::Display for MountError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Version { found } => {
                write!(f, "the store has version {found}; this program reads {}", crate::record::VERSION)
            }
            Self::Geometry(Geometry { sectors, words }) => {
                write!(f, "{sectors} sectors of {words} words are no store")
            }
        }
    }
}

impl core::error::Error for MountError {}

impl Store {
    /// Reads the whole flash. Flash without a store counts as an empty store. Nothing is written: the next write skips
    /// the words that a power cut left incomplete.
    ///
    /// # Errors
    /// The flash is unsuitable, or a newer program wrote it.
    pub fn mount(flash: &impl Flash) -> Result<Self, MountError> {
        let geometry = flash.geometry();
        if !(2..=8).contains(&geometry.sectors) || geometry.words < 8 {
            return Err(MountError::Geometry(geometry));
        }
        let mut store = Self::empty(geometry, 1);
        // Sectors are read in the order in which they were begun. Of two copies of a record the later one is valid,
        // because the sector of the earlier one is erased next.
        while let Some((sector, sequence)) = store.begun_next(flash)? {
            let end = store.walk(flash, sector);
            store.head = Some((sector, sequence));
            // Skip one word: it may look blank and yet not take a write.
            store.end = end.saturating_add(1);
        }
        Ok(store)
    }

    /// An empty store on blank flash, whose next record has this sequence number.
    pub(crate) fn empty(geometry: Geometry, sequence: u32) -> Self {
        Self { geometry, head: None, end: 0, sequence, index: [None; KEYS] }
    }

    /// The sector that was begun next after `head`. (Sorting the sectors would take 6 KiB of code.)
    fn begun_next(&self, flash: &impl Flash) -> Result<Option<(u8, u32)>, MountError> {
        let mut next: Option<(u8, u32)> = None;
        for sector in 0..self.geometry.sectors {
            match SectorHead::parse(&flash.read(FlashWord { sector, word: 0 })) {
                Some(SectorHead::Known { sequence }) => {
                    let is_later = self.head.is_none_or(|(_, head)| sequence > head);
                    if is_later && next.is_none_or(|(_, next)| sequence < next) {
                        next = Some((sector, sequence));
                    }
                }
                Some(SectorHead::Other { version }) => return Err(MountError::Version { found: version }),
                None => {}
            }
        }
        Ok(next)
    }

    /// Enters the records of a sector into the index. Returns the first word behind everything that was written.
    fn walk(&mut self, flash: &impl Flash, sector: u8) -> u16 {
        let (mut word, mut end) = (1, 1);
        while word < self.geometry.words {
            let place = FlashWord { sector, word };
            let bytes = flash.read(place);
            let head = RecordHead::parse(&bytes).filter(|head| self.has_room(word, head.extent()));
            if let Some(head) = head {
                if is_whole(flash, place, &head) {
                    self.sequence = self.sequence.max(head.sequence.saturating_add(1));
                    let before = self.index.get(usize::from(head.key)).copied().flatten();
                    if before.is_none_or(|before| head.sequence >= before.sequence) {
                        self.enter(place, &head);
                    }
                }
                // Also skip the words of an incomplete record: they are data and must not be taken for heads.
                word = word.saturating_add(head.extent());
                end = word;
            } else {
                word = word.saturating_add(1);
                if bytes != BLANK {
                    end = word;
                }
            }
        }
        end
    }

    /// Whether `extent` words from `word` on fit into a sector.
    pub(crate) fn has_room(&self, word: u16, extent: u16) -> bool {
        word.checked_add(extent).is_some_and(|end| end <= self.geometry.words)
    }

    /// Makes the record at this place the newest of its key.
    pub(crate) fn enter(&mut self, FlashWord { sector, word }: FlashWord, head: &RecordHead) {
        if let Some(entry) = self.index.get_mut(usize::from(head.key)) {
            *entry = Some(FoundRecord {
                data: FlashWord { sector, word: word.saturating_add(1) },
                len: head.len as usize,
                tag: head.tag,
                sequence: head.sequence,
            });
        }
    }

    /// The newest record of the key with this code.
    pub(crate) fn entry(&self, code: u8) -> Option<FoundRecord> {
        self.index.get(usize::from(code)).copied().flatten()
    }

    /// Notes that the record of the key with this code was copied and now begins at this place.
    pub(crate) fn moved(&mut self, code: u8, FlashWord { sector, word }: FlashWord) {
        if let Some(Some(found)) = self.index.get_mut(usize::from(code)) {
            found.data = FlashWord { sector, word: word.saturating_add(1) };
        }
    }

    /// The newest record of a key.
    pub fn find(&self, key: RecordKey) -> Option<FoundRecord> {
        self.entry(key.code()?)
    }

    /// Copies the data of a key's newest record to the beginning of `out`; `None` if there is no record or `out` is too
    /// short.
    pub fn get<'o>(&self, flash: &impl Flash, key: RecordKey, out: &'o mut [u8]) -> Option<&'o [u8]> {
        let found = self.find(key)?;
        let out = out.get_mut(..found.len)?;
        let mut place = found.data;
        for part in out.chunks_mut(WORD) {
            for (byte, read) in part.iter_mut().zip(flash.read(place)) {
                *byte = read;
            }
            place.word = place.word.saturating_add(1);
        }
        Some(out)
    }

    /// Number of words of all records, and the limit of it if a record of `extent` words is to be added.
    ///
    /// Up to the limit, one sector can stay free, and at least one of the others has space for the new record behind
    /// the records that are still needed.
    pub(crate) fn used(&self, extent: u16) -> (u32, u32) {
        let used = self.index.iter().flatten().map(|found| u32::from(crate::record::extent(found.len))).sum();
        let sector = self.geometry.words.saturating_sub(1).saturating_sub(extent);
        (used, u32::from(sector).saturating_mul(u32::from(self.geometry.sectors).saturating_sub(1)))
    }
}

pub(crate) fn is_whole(flash: &impl Flash, FlashWord { sector, word }: FlashWord, head: &RecordHead) -> bool {
    let mut digest = digest();
    let end = word.saturating_add(head.extent()).saturating_sub(1);
    for word in word.saturating_add(1)..end {
        digest.update(&flash.read(FlashWord { sector, word }));
    }
    let at_end: Word = flash.read(FlashWord { sector, word: end });
    at_end == head.word() && digest.finalize() == head.sum
}
