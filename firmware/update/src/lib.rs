#![no_std]
#![forbid(unsafe_code)]
#![cfg_attr(
    not(test),
    deny(
        clippy::indexing_slicing,
        clippy::unwrap_used,
        clippy::expect_used,
        clippy::panic,
        clippy::arithmetic_side_effects
    )
)]
//! A board's firmware in two slots (docs/update.md).
//!
//! In: the flash of the slots, marks of the store, bytes of an update. Out: what is to be written and erased, which
//! slot a loader runs, and why an update is refused. Does not know a chip or a network.
//!
//! A slot begins with a [`Header`], which is signed and contains the hash of the image behind it. [`Receive`] writes an
//! update into the slot that does not run. The loader calls [`choose`], which returns the slot on trial while it has
//! starts left, otherwise the good one. [`UpdateFile`] is what a host sends: the same firmware linked for each slot.
//!
//! ```
//! use recipe_update::{BoardName, Formats, Header, ImageFacts, PublicKey, Slot, Version};
//!
//! let image = [0x5A; 5_000];
//! let formats = Formats::new(1, 3, 3).unwrap();
//! let board = BoardName::parse("nucleo-h743zi").unwrap();
//! let facts = ImageFacts { board, slot: Slot::B, version: Version::new(0, 3, 0), formats, store: 1 };
//! let seed = [7; 32];
//! let header = Header::sign(facts, &image, &seed).unwrap();
//! let read = Header::parse(&header.encode()).unwrap();
//! assert_eq!((read, read.version().minor), (header, 3));
//! assert!(read.verify(&PublicKey::of_seed(&seed)).is_ok());
//! assert!(read.verify(&PublicKey::of_seed(&[8; 32])).is_err());
//! ```

#[cfg(test)]
extern crate std;

mod boot;
mod check;
mod file;
mod header;
mod layout;
mod receive;
mod rules;

pub use boot::{Chosen, Machine, STARTS, begin_trial, choose, confirm, end_trial};
pub use check::{BadImage, Check, header as header_of};
pub use file::{FILE_HEAD, FileError, SlotImage, UpdateFile, file_head, link_padding};
pub use header::{
    BoardName, Foreign, Formats, HEADER, Header, HeaderError, IMAGE_OFFSET, ImageFacts, PublicKey, SIGNED,
    Version,
};
pub use layout::{BOARDS, Layout, MPS2_AN500, NUCLEO_H743ZI, NUCLEO_H743ZI_STORES, Stores};
pub use receive::{Gap, Receive, ReceiveError, ReceiveStep};
pub use recipe_store::{Side, Slot, SlotMarks, SlotTrial, TrialEnd};
pub use rules::{Downgrade, RunningFirmware, UpdateRefused, may_keep};

use recipe_store::{Flash, FlashWord, Word};

/// The flash of a slot.
pub trait SlotFlash: Flash {
    /// The bytes of a word; `None` if it cannot be read. [`Flash::read`] returns zeros instead, which cannot be told
    /// from zeros in an image; but executing an unreadable word causes a fault.
    fn whole(&self, place: FlashWord) -> Option<Word>;
}

/// The word of a slot at which its image begins.
const FIRST_WORD: u32 = 32;
const _: () = assert!(FIRST_WORD as usize * recipe_store::WORD == IMAGE_OFFSET as usize);

/// Number of bytes of a slot.
fn size(flash: &impl Flash) -> u32 {
    let geometry = flash.geometry();
    let words = u32::from(geometry.sectors).saturating_mul(geometry.words.into());
    words.saturating_mul(recipe_store::WORD as u32)
}

/// Sector and word of the word with this index in the slot; `None` beyond the end of the slot.
fn place(flash: &impl Flash, word: u32) -> Option<FlashWord> {
    let words = u32::from(flash.geometry().words);
    let sector = u8::try_from(word.checked_div(words)?).ok()?;
    let word = u16::try_from(word.checked_rem(words)?).ok()?;
    (sector < flash.geometry().sectors).then_some(FlashWord { sector, word })
}
