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
//! Storage that survives restarts and power cuts: configurations, a key, settings, counters (docs/store.md).
//!
//! In: the words of some sectors of flash, and records to store. Out: words to write and sectors to erase, and the
//! stored records. Does not know the chip or the contents of a configuration.
//!
//! It is made for flash whose words have an error correction code and can be written once after an erase. After a power
//! cut, the word that was being written is in one of three states: it cannot be read, it reads as a mix of old and new,
//! or it looks blank but cannot be written. In each case the store has either the complete old record or the complete
//! new one.
//!
//! [`Store::mount`] reads the flash. A [`Put`] changes it, as a state machine: [`Put::next`] returns the next flash
//! operation until it ends, so the same code serves blocking and asynchronous flash. [`Put::execute`] is the loop for
//! an asynchronous [`Flash`].
//!
//! Flash cannot be read while a sector of the same bank is being erased, so a board whose program can be updated has
//! two places for a store, one in each bank. [`newest`] finds the valid store; a [`Move`] copies it to the other place.
//!
//! ```
//! # use recipe_store::{Flash, FlashWord, Geometry, Word};
//! # struct Ram(Vec<Word>);
//! # const GEOMETRY: Geometry = Geometry { sectors: 3, words: 1024 };
//! # impl Ram { fn at(place: FlashWord) -> usize { usize::from(place.sector) * 1024 + usize::from(place.word) } }
//! # impl Flash for Ram {
//! #     fn geometry(&self) -> Geometry { GEOMETRY }
//! #     fn read(&self, place: FlashWord) -> Word { self.0[Self::at(place)] }
//! #     async fn write(&mut self, place: FlashWord, word: &Word) { self.0[Self::at(place)] = *word; }
//! #     async fn erase(&mut self, sector: u8) {
//! #         self.0[usize::from(sector) * 1024..][..1024].fill([0xFF; 32]);
//! #     }
//! # }
//! # let mut flash = Ram(vec![[0; 32]; 3 * 1024]);
//! use recipe_store::{Marks, Store};
//!
//! # embassy_futures::block_on(async {
//! let mut store = Store::mount(&flash)?;
//! let image = b"a configuration";
//! store.keep(1, 0xC0FFEE, image, None)?.execute(&mut flash).await?;
//! store.mark(Marks { live: Some(1), ..Marks::default() })?.execute(&mut flash).await?;
//!
//! // After a restart.
//! let store = Store::mount(&flash)?;
//! let [(live, _)] = store.at_start().candidates[..] else { panic!("one is live") };
//! let mut buf = [0; 64];
//! assert_eq!(store.image(&flash, live.number, &mut buf), Some(&image[..]));
//! # Ok::<(), Box<dyn std::error::Error>>(())
//! # }).unwrap();
//! ```

#[cfg(test)]
extern crate std;

mod mount;
mod put;
mod record;
mod relocate;
mod revisions;
mod slots;
mod values;

use core::future::Future;

pub use mount::{FoundRecord, MountError, Store};
pub use put::{Put, PutError, PutStep};
pub use record::{COUNTERS, MAX_DATA, RecordKey, VERSION};
pub use relocate::{Move, Newest, Side, newest};
pub use revisions::{Adoption, KeepError, MAX_REVISIONS, Marks, Revision, Role, Start, Trial, TrialEnd};
pub use slots::{Slot, SlotMarks, SlotTrial};

/// Number of bytes of a [`Word`].
pub const WORD: usize = 32;
/// The unit of writing and of error correction.
pub type Word = [u8; WORD];
/// A word after an erase.
pub const BLANK: Word = [0xFF; WORD];

/// A word of the flash.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct FlashWord {
    /// Index of the sector, from 0. Sectors need not be adjacent.
    pub sector: u8,
    /// Index of the word in the sector, from 0.
    pub word: u16,
}

/// Size of the flash.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Geometry {
    /// Number of sectors: at least 2, at most 8. One of them is always free for the next sector to be begun.
    pub sectors: u8,
    /// Number of words in each: at least 8.
    pub words: u16,
}

/// Flash used only for a [`Store`] or for a slot of the firmware.
///
/// Writing and erasing may take seconds, so they are futures; a program without other tasks blocks on them. They report
/// no errors: failures are found when the words are read back.
pub trait Flash {
    /// Size of the flash; constant.
    fn geometry(&self) -> Geometry;

    /// The bytes of a word; zeros if it cannot be read because it was torn by a power cut. Reading never fails, because
    /// an error at one word would make all others unreachable.
    fn read(&self, place: FlashWord) -> Word;

    /// Writes a word that has not been written since its sector was erased.
    fn write(&mut self, place: FlashWord, word: &Word) -> impl Future<Output = ()>;

    /// Erases a sector.
    fn erase(&mut self, sector: u8) -> impl Future<Output = ()>;
}
