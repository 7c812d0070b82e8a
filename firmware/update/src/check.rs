//! Checks the contents of a slot, in steps.

use core::fmt;

use crc::Digest;
use recipe_store::{FlashWord, Slot, WORD};
use salty::Sha512;

use crate::header::{BoardName, CRC, Foreign, HEADER, Header, HeaderError, IMAGE_OFFSET};
use crate::{FIRST_WORD, SlotFlash, place, size};

/// Why a slot cannot run.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[non_exhaustive]
pub enum BadImage {
    /// It has no header.
    Header(HeaderError),
    /// It is linked for the other slot.
    Slot,
    /// It is for another board.
    Board(BoardName),
    /// The image is longer than the slot.
    Long {
        /// Its length in bytes.
        length: u32,
        /// Maximum length in bytes.
        room: u32,
    },
    /// A word cannot be read.
    Torn(FlashWord),
    /// The CRC does not match: the image has changed since it was written.
    Crc,
    /// The image is not the one that was signed.
    Hash,
    /// The header was signed with another key.
    Foreign,
}

impl fmt::Display for BadImage {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Header(error) => error.fmt(f),
            Self::Slot => f.write_str("the firmware is linked for the other slot"),
            Self::Board(board) => write!(f, "the firmware is for the board {board}"),
            Self::Long { length, room } => {
                write!(f, "the firmware has {length} bytes; the slot has room for {room}")
            }
            Self::Torn(FlashWord { sector, word }) => {
                write!(f, "the firmware is damaged: word {word} of sector {sector} cannot be read")
            }
            Self::Crc => f.write_str("the firmware is damaged: its CRC differs"),
            Self::Hash => f.write_str("the firmware is another one than that which was signed"),
            Self::Foreign => Foreign.fmt(f),
        }
    }
}

impl core::error::Error for BadImage {}

/// A check of an image, in steps.
pub struct Check {
    header: Header,
    /// Number of words checked so far.
    done: u32,
    crc: Digest<'static, u32>,
    hash: Option<Sha512>,
}

impl fmt::Debug for Check {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Check")
            .field("header", &self.header)
            .field("done", &self.done)
            .finish_non_exhaustive()
    }
}

/// Reads the header at the beginning of a slot and checks that it is for this slot and board.
///
/// # Errors
/// There is no header, or it is for another slot or board.
pub fn header(flash: &impl SlotFlash, slot: Slot, board: &BoardName) -> Result<Header, BadImage> {
    let mut bytes = [0; HEADER];
    for (part, word) in bytes.as_chunks_mut::<WORD>().0.iter_mut().zip(0..) {
        let at = FlashWord { sector: 0, word };
        *part = flash.whole(at).ok_or(BadImage::Torn(at))?;
    }
    let header = Header::parse(&bytes).map_err(BadImage::Header)?;
    fits(&header, flash, slot, board)?;
    Ok(header)
}

pub(crate) fn fits(
    header: &Header,
    flash: &impl SlotFlash,
    slot: Slot,
    board: &BoardName,
) -> Result<(), BadImage> {
    let room = size(flash).saturating_sub(IMAGE_OFFSET);
    if header.parts().board != *board {
        return Err(BadImage::Board(header.parts().board));
    }
    if header.slot() != slot {
        return Err(BadImage::Slot);
    }
    if header.length() > room {
        return Err(BadImage::Long { length: header.length(), room });
    }
    Ok(())
}

impl Check {
    /// A check for damage: each word must be readable, and the CRC must match.
    pub fn damage(header: Header) -> Self {
        Self { header, done: 0, crc: CRC.digest(), hash: None }
    }

    /// A check for damage that also compares the image with the signed hash.
    pub fn contents(header: Header) -> Self {
        Self { hash: Some(Sha512::new()), ..Self::damage(header) }
    }

    /// Checks up to `words` more words; returns `None` if words are left to check.
    pub fn step(&mut self, flash: &impl SlotFlash, words: u16) -> Option<Result<(), BadImage>> {
        for _ in 0..words {
            let read = self.done.saturating_mul(WORD as u32);
            let left = self.header.length().saturating_sub(read);
            if left == 0 {
                break;
            }
            // Not reached: `header` has checked that the image ends within the slot.
            let Some(at) = place(flash, FIRST_WORD.saturating_add(self.done)) else {
                return Some(Err(BadImage::Crc));
            };
            let Some(word) = flash.whole(at) else { return Some(Err(BadImage::Torn(at))) };
            let part = word.get(..(left as usize).min(WORD)).unwrap_or(&word);
            self.crc.update(part);
            if let Some(hash) = &mut self.hash {
                hash.update(part);
            }
            self.done = self.done.saturating_add(1);
        }
        if self.done.saturating_mul(WORD as u32) < self.header.length() {
            return None;
        }
        if self.crc.clone().finalize() != self.header.crc() {
            return Some(Err(BadImage::Crc));
        }
        let hash = self.hash.take().map(Sha512::finalize);
        Some(match hash {
            Some(hash) if hash != *self.header.hash() => Err(BadImage::Hash),
            _ => Ok(()),
        })
    }

    /// Checks everything that is left.
    pub(crate) fn whole(mut self, flash: &impl SlotFlash) -> Result<(), BadImage> {
        loop {
            if let Some(result) = self.step(flash, u16::MAX) {
                return result;
            }
        }
    }
}
