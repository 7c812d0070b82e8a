//! Writes an update into the free slot.
//!
//! The header is checked before anything is erased. The image is written word by word, and each word is read back.
//! Then the hash of the image is compared with the signed one. The header is written last, and of it the word with the
//! magic number. So a slot with a header is complete, and an interrupted update leaves a slot without one.

use core::fmt;

use recipe_store::{FlashWord, SlotMarks, WORD, Word};

use crate::check::{BadImage, Check};
use crate::header::{HEADER, Header, IMAGE_OFFSET};
use crate::rules::{Downgrade, RunningFirmware, UpdateRefused};
use crate::{FIRST_WORD, SlotFlash, place};

/// An update being received.
#[derive(Debug)]
pub struct Receive {
    header: Header,
    phase: ReceivePhase,
    /// Bytes of the image received so far.
    taken: u32,
    word: Word,
    /// Number of bytes in `word`.
    collected: usize,
}

/// The next step.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum ReceiveStep {
    /// Erase this sector of the slot.
    Erase(u8),
    /// Write this word of the slot.
    Write(FlashWord, Word),
    /// Supply bytes of the image from this offset on ([`Receive::take`]).
    Take {
        /// Number of bytes received so far.
        offset: u32,
    },
    /// Nothing to do: call again. Other tasks can run in between.
    Again,
    /// The end: the slot contains the update, or after an error nothing that can run.
    End(Result<(), ReceiveError>),
}

/// Why receiving an update failed.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[non_exhaustive]
pub enum ReceiveError {
    /// A word reads differently from what was written.
    Worn(FlashWord),
    /// The received image is not the signed one.
    Bad(BadImage),
}

impl fmt::Display for ReceiveError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Worn(FlashWord { sector, word }) => {
                write!(f, "word {word} of sector {sector} does not keep what is written")
            }
            Self::Bad(bad) => bad.fmt(f),
        }
    }
}

impl core::error::Error for ReceiveError {}

/// The bytes that were passed do not continue those received so far.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Gap {
    /// Offset of the next bytes.
    pub expected: u32,
}

impl fmt::Display for Gap {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "the next bytes are those from {} on", self.expected)
    }
}

impl core::error::Error for Gap {}

#[derive(Debug)]
#[allow(clippy::large_enum_variant, reason = "there is no heap")]
enum ReceivePhase {
    /// Erase from this sector on. The first sector, with the header, comes first.
    Erase {
        sector: u8,
        end: u8,
    },
    Fill,
    /// The collected word was written here.
    Written(FlashWord),
    Hash(Check),
    /// The word of the header of this index in [`ORDER`] is next.
    Header {
        nth: usize,
    },
    HeaderWritten {
        nth: usize,
    },
    End(Result<(), ReceiveError>),
}

impl Receive {
    /// Begins to receive an update if it may be installed. `flash` is the free slot.
    ///
    /// The signature is checked elsewhere: by [`Header::verify`], when no cell depends on the board, and by the loader.
    ///
    /// # Errors
    /// The update may not be installed; nothing has changed.
    pub fn begin(
        header: Header,
        running: &RunningFirmware,
        marks: SlotMarks,
        downgrade: Downgrade,
        flash: &impl SlotFlash,
    ) -> Result<Self, UpdateRefused> {
        running.accepts(&header, flash, marks, downgrade)?;
        let bytes = u32::from(flash.geometry().words).saturating_mul(WORD as u32);
        let sectors = header.length().saturating_add(IMAGE_OFFSET).div_ceil(bytes.max(1));
        let end = u8::try_from(sectors).unwrap_or(u8::MAX);
        Ok(Self { header, phase: ReceivePhase::Erase { sector: 0, end }, taken: 0, word: FILL, collected: 0 })
    }

    /// Header of the update.
    pub fn header(&self) -> &Header {
        &self.header
    }

    /// Number of bytes of the image received so far: where to resume.
    pub fn taken(&self) -> u32 {
        self.taken
    }

    /// Accepts bytes of the image, at most up to the end of the current word, and returns how many. The steps of
    /// [`Receive::next`] must be executed before more bytes are accepted.
    ///
    /// # Errors
    /// `offset` is not that of the next byte. No bytes were accepted.
    pub fn take(&mut self, offset: u32, bytes: &[u8]) -> Result<usize, Gap> {
        if offset != self.taken {
            return Err(Gap { expected: self.taken });
        }
        if !matches!(self.phase, ReceivePhase::Fill) || self.is_full() {
            return Ok(0);
        }
        let left = self.header.length().saturating_sub(self.taken);
        let room = WORD.saturating_sub(self.collected).min(left as usize);
        let mut count: usize = 0;
        for (place, byte) in self.word.iter_mut().skip(self.collected).zip(bytes.iter().take(room)) {
            *place = *byte;
            count = count.saturating_add(1);
        }
        self.collected = self.collected.saturating_add(count);
        self.taken = self.taken.saturating_add(count as u32);
        Ok(count)
    }

    /// Whether the collected word is to be written: it is full, or the last one.
    fn is_full(&self) -> bool {
        self.collected == WORD || self.collected > 0 && self.taken == self.header.length()
    }

    /// Returns the next step. Call it again when that step is done, until it returns [`ReceiveStep::End`].
    pub fn next(&mut self, flash: &impl SlotFlash) -> ReceiveStep {
        loop {
            match &mut self.phase {
                ReceivePhase::Erase { sector, end } => {
                    if sector < end {
                        let erased = *sector;
                        *sector = sector.saturating_add(1);
                        return ReceiveStep::Erase(erased);
                    }
                    self.phase = ReceivePhase::Fill;
                }
                ReceivePhase::Fill => {
                    if !self.is_full() {
                        return ReceiveStep::Take { offset: self.taken };
                    }
                    let word = self.taken.saturating_sub(1).checked_div(WORD as u32).unwrap_or(0);
                    // Not reached: `begin` has checked that the image fits into the slot.
                    let Some(at) = place(flash, FIRST_WORD.saturating_add(word)) else {
                        self.phase = ReceivePhase::End(Err(ReceiveError::Bad(BadImage::Crc)));
                        continue;
                    };
                    self.phase = ReceivePhase::Written(at);
                    return ReceiveStep::Write(at, self.word);
                }
                ReceivePhase::Written(at) => {
                    let at = *at;
                    self.phase = if flash.whole(at) != Some(self.word) {
                        ReceivePhase::End(Err(ReceiveError::Worn(at)))
                    } else if self.taken == self.header.length() {
                        ReceivePhase::Hash(Check::contents(self.header))
                    } else {
                        (self.word, self.collected) = (FILL, 0);
                        ReceivePhase::Fill
                    };
                }
                ReceivePhase::Hash(check) => match check.step(flash, AT_ONCE) {
                    None => return ReceiveStep::Again,
                    Some(Ok(())) => self.phase = ReceivePhase::Header { nth: 0 },
                    Some(Err(bad)) => self.phase = ReceivePhase::End(Err(ReceiveError::Bad(bad))),
                },
                ReceivePhase::Header { nth } => {
                    let nth = *nth;
                    let Some((at, word)) = self.header_word(nth) else {
                        self.phase = ReceivePhase::End(Ok(()));
                        continue;
                    };
                    self.phase = ReceivePhase::HeaderWritten { nth };
                    return ReceiveStep::Write(at, word);
                }
                ReceivePhase::HeaderWritten { nth } => {
                    let nth = *nth;
                    self.phase = match self.header_word(nth) {
                        Some((at, word)) if flash.whole(at) != Some(word) => {
                            ReceivePhase::End(Err(ReceiveError::Worn(at)))
                        }
                        _ => ReceivePhase::Header { nth: nth.saturating_add(1) },
                    };
                }
                ReceivePhase::End(result) => return ReceiveStep::End(*result),
            }
        }
    }

    /// The word of the header that is written as the `nth`, and its place; `None` after the last.
    fn header_word(&self, nth: usize) -> Option<(FlashWord, Word)> {
        let word = *ORDER.get(nth)?;
        let bytes = self.header.encode();
        let part = bytes.as_chunks::<WORD>().0.get(usize::from(word))?;
        Some((FlashWord { sector: 0, word }, *part))
    }
}

/// Padding behind the end of an image.
const FILL: Word = [0xFF; WORD];
/// Words of the header as they are written: the one with the magic number last.
const ORDER: [u16; HEADER / WORD] = [0, 1, 3, 4, 5, 2];
/// Words that are hashed at a time: 4 KiB, about 0.5 million instructions.
const AT_ONCE: u16 = 128;
