//! Flash in a file of the host, with the NUCLEO's sectors and words. Words are never torn.
//!
//! The loader compiles this file too (firmware/boot/src/board/mps2_an500/mod.rs).

use core::cell::RefCell;
use core::fmt;

use recipe_store::{BLANK, Flash, FlashWord, Geometry, WORD, Word};
use recipe_update::SlotFlash;
use semihosting::fs::File;
use semihosting::io::{Read, Seek, SeekFrom, Write};

use super::arguments::FileName;

/// Words of a sector.
const WORDS: u16 = 4096;
/// Words per read: each access to the file is a trap.
const PAGE: usize = 32;

/// A part of a file.
pub(crate) struct HostFlash {
    file: RefCell<File>,
    /// Where the part begins in the file.
    start: u64,
    sectors: u8,
    /// The last page that was read: its offset in the file, and its bytes.
    page: RefCell<Option<(u64, [u8; PAGE * WORD])>>,
}

impl fmt::Debug for HostFlash {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("HostFlash").field("start", &self.start).finish_non_exhaustive()
    }
}

impl HostFlash {
    /// Opens `sectors` sectors of a file, which is created if it does not exist; `None` on failure.
    pub(crate) fn open(name: &FileName, start: u32, sectors: u8) -> Option<Self> {
        let name = name.as_c_str();
        let opened = File::options().read(true).write(true).open(name);
        let file = opened
            .or_else(|_| File::options().read(true).write(true).create(true).truncate(true).open(name))
            .ok()?;
        Some(Self { file: RefCell::new(file), start: start.into(), sectors, page: RefCell::new(None) })
    }

    fn offset(&self, FlashWord { sector, word }: FlashWord) -> u64 {
        self.start + (u64::from(sector) * u64::from(WORDS) + u64::from(word)) * WORD as u64
    }

    /// Writes bytes to the file; returns whether all of them were written.
    fn write_at(&mut self, offset: u64, mut bytes: &[u8]) -> bool {
        *self.page.get_mut() = None;
        let file = self.file.get_mut();
        if file.seek(SeekFrom::Start(offset)).is_err() {
            return false;
        }
        while !bytes.is_empty() {
            match file.write(bytes) {
                Ok(count @ 1..) => bytes = bytes.get(count..).unwrap_or(&[]),
                _ => return false,
            }
        }
        true
    }

    /// Reads a page. Bytes beyond the end of the file read as blank.
    fn read_page(&self, offset: u64) -> [u8; PAGE * WORD] {
        let mut bytes = [0xFF; PAGE * WORD];
        let mut file = self.file.borrow_mut();
        let mut len = 0;
        if file.seek(SeekFrom::Start(offset)).is_ok() {
            while let Some(buf @ [_, ..]) = bytes.get_mut(len..) {
                match file.read(buf) {
                    Ok(count @ 1..) => len += count,
                    _ => break,
                }
            }
        }
        bytes
    }
}

impl Flash for HostFlash {
    fn geometry(&self) -> Geometry {
        Geometry { sectors: self.sectors, words: WORDS }
    }

    fn read(&self, place: FlashWord) -> Word {
        let offset = self.offset(place);
        let inside = offset % (PAGE * WORD) as u64;
        let mut page = self.page.borrow_mut();
        let (_, bytes) = match &mut *page {
            Some(page) if page.0 == offset - inside => page,
            page => page.insert((offset - inside, self.read_page(offset - inside))),
        };
        bytes.as_chunks().0.get(inside as usize / WORD).copied().unwrap_or(BLANK)
    }

    async fn write(&mut self, place: FlashWord, word: &Word) {
        // As in flash, writing only clears bits, so a second write is detected.
        let mut kept = self.read(place);
        kept.iter_mut().zip(word).for_each(|(kept, byte)| *kept &= byte);
        // A failed write is found when it is read back.
        let _ = self.write_at(self.offset(place), &kept);
    }

    async fn erase(&mut self, sector: u8) {
        for word in (0..WORDS).step_by(PAGE) {
            let _ = self.write_at(self.offset(FlashWord { sector, word }), &[0xFF; PAGE * WORD]);
        }
    }
}

impl SlotFlash for HostFlash {
    fn whole(&self, place: FlashWord) -> Option<Word> {
        Some(self.read(place))
    }
}
