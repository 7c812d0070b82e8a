//! The words of the store: the heads of sectors and of records.
//!
//! A record is a head word, its data in whole words (the last one filled up with zeros), and a copy of the head word as
//! its end. The end is written last: it shows that the data was written completely before any power cut.

use crc::{CRC_32_ISO_HDLC, Crc, Digest, NoTable};

use crate::{WORD, Word};

/// Maximum length of a record's data in bytes: the length of the longest configuration image.
pub const MAX_DATA: usize = 16 * 1024;
/// Number of counters.
pub const COUNTERS: u8 = 3;
pub(crate) const KEYS: usize = 18;
/// Version of the store's layout. A store with another version is not read.
pub const VERSION: u32 = 1;

const SECTOR_MAGIC: [u8; 4] = *b"RGSs";
const RECORD_MAGIC: [u8; 4] = *b"RGSr";

/// Key of a record. The newest record of a key replaces earlier ones.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum RecordKey {
    /// A configuration image, in one of eight places.
    Image(u8),
    /// Marks: which images are live, previous and on trial.
    Marks,
    /// The key of the API.
    Access,
    /// Sparkplug's bdSeq.
    BirthSequence,
    /// Which image was adopted from outside the store.
    Adopted,
    /// A counter, below [`COUNTERS`].
    Counter(u8),
    /// The settings of the edge node. A program without an edge node treats the record as a counter and copies it.
    Edge,
    /// Which slots of the firmware are good and on trial.
    Slots,
    /// Number of moves of the store to another place.
    Generation,
}

impl RecordKey {
    /// Below [`KEYS`]; `None` if the number of the image or counter is too high.
    pub(crate) const fn code(self) -> Option<u8> {
        match self {
            Self::Image(slot @ 0..8) => Some(slot),
            Self::Marks => Some(8),
            Self::Access => Some(9),
            Self::BirthSequence => Some(10),
            Self::Adopted => Some(11),
            Self::Counter(number @ 0..COUNTERS) => Some(12 | number),
            Self::Edge => Some(15),
            Self::Slots => Some(16),
            Self::Generation => Some(17),
            Self::Image(_) | Self::Counter(_) => None,
        }
    }
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct RecordHead {
    pub(crate) key: u8,
    /// Sequence number: higher than those of all records written before. A copy of a record keeps its number.
    pub(crate) sequence: u32,
    /// Length of the data in bytes.
    pub(crate) len: u32,
    /// Value whose meaning depends on the key. Small records consist of it alone, without data.
    pub(crate) tag: u64,
    /// CRC-32 of the data, filled up to whole words.
    pub(crate) sum: u32,
}

impl RecordHead {
    /// Decodes a head; `None` if the word is not one.
    pub(crate) fn parse(word: &Word) -> Option<Self> {
        let (words, _) = word.as_chunks::<4>();
        let &[magic, sequence, key, len, low, high, sum, check] = words else { return None };
        let [key, 0, 0, 0] = key else { return None };
        let len = u32::from_le_bytes(len);
        let is_head = magic == RECORD_MAGIC
            && u32::from_le_bytes(check) == check_of(word)
            && usize::from(key) < KEYS
            && len as usize <= MAX_DATA;
        let tag = u64::from(u32::from_le_bytes(high)) << 32 | u64::from(u32::from_le_bytes(low));
        is_head.then_some(Self {
            key,
            sequence: u32::from_le_bytes(sequence),
            len,
            tag,
            sum: u32::from_le_bytes(sum),
        })
    }

    pub(crate) fn word(&self) -> Word {
        let [a, b, c, d, e, f, g, h] = self.tag.to_le_bytes();
        finished([
            RECORD_MAGIC,
            self.sequence.to_le_bytes(),
            [self.key, 0, 0, 0],
            self.len.to_le_bytes(),
            [a, b, c, d],
            [e, f, g, h],
            self.sum.to_le_bytes(),
        ])
    }

    pub(crate) fn extent(&self) -> u16 {
        extent(self.len as usize)
    }
}

/// Number of words of a record with `len` bytes of data, including head and end.
pub(crate) fn extent(len: usize) -> u16 {
    u16::try_from(len.div_ceil(WORD)).map_or(u16::MAX, |data| data.saturating_add(2))
}

pub(crate) enum SectorHead {
    /// A sector of this layout.
    Known {
        /// Sequence number: higher than those of all sectors that were begun before.
        sequence: u32,
    },
    /// A sector of another layout.
    Other { version: u32 },
}

impl SectorHead {
    pub(crate) fn parse(word: &Word) -> Option<Self> {
        let (words, _) = word.as_chunks::<4>();
        let &[magic, version, sequence, .., check] = words else { return None };
        if magic != SECTOR_MAGIC || u32::from_le_bytes(check) != check_of(word) {
            return None;
        }
        let sequence = u32::from_le_bytes(sequence);
        Some(match u32::from_le_bytes(version) {
            VERSION => Self::Known { sequence },
            version => Self::Other { version },
        })
    }

    pub(crate) fn word(sequence: u32) -> Word {
        let none = [0; 4];
        finished([SECTOR_MAGIC, VERSION.to_le_bytes(), sequence.to_le_bytes(), none, none, none, none])
    }
}

fn finished(parts: [[u8; 4]; 7]) -> Word {
    let mut word = [0; WORD];
    for (place, byte) in word.iter_mut().zip(parts.as_flattened()) {
        *place = *byte;
    }
    let check = check_of(&word).to_le_bytes();
    for (place, byte) in word.iter_mut().rev().zip(check.iter().rev()) {
        *place = *byte;
    }
    word
}

/// CRC of all bytes of a head but the last four.
fn check_of(word: &Word) -> u32 {
    CRC.checksum(word.split_last_chunk::<4>().map_or(&[][..], |(before, _)| before))
}

pub(crate) fn digest() -> Digest<'static, u32, NoTable> {
    CRC.digest()
}

/// Part `nth` of the data as a word, filled up with zeros.
pub(crate) fn part(data: &[u8], nth: u16) -> Word {
    let mut word = [0; WORD];
    let rest = data.get(usize::from(nth).saturating_mul(WORD)..).unwrap_or(&[]);
    for (place, byte) in word.iter_mut().zip(rest) {
        *place = *byte;
    }
    word
}

pub(crate) fn sum(data: &[u8]) -> u32 {
    let mut digest = digest();
    for nth in 0..extent(data.len()).saturating_sub(2) {
        digest.update(&part(data, nth));
    }
    digest.finalize()
}

/// Without a table, which would take 1 KiB of flash and shorten the start by only a few milliseconds.
static CRC: Crc<u32, NoTable> = Crc::<u32, NoTable>::new(&CRC_32_ISO_HDLC);
