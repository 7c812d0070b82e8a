//! The flash of the store: a file of the host, named by the fourth semihosting argument. It stands for two sectors of
//! 128 KiB as the NUCLEO has them; without the argument there is no store. No word of it is ever torn.

use core::cell::RefCell;
use core::ffi::CStr;

use firmware::kept::StoreFlash;
use recipe_store::{BLANK, Found, Geometry, MAX_DATA, Place, WORD, Word};
use recipe_update::SlotFlash;
use semihosting::fs::File;
use semihosting::io::{Read, Seek, SeekFrom, Write};
use static_cell::ConstStaticCell;

use super::storage::{self, MAX_ARGUMENTS};

const WORDS: u16 = 4096;
/// Words that are read at once: each access to the file is a trap.
const PAGE: usize = 32;

/// The file.
pub(crate) struct Flash {
    file: RefCell<File>,
    /// The last page that was read: its offset in the file, and its bytes.
    page: RefCell<Option<(u64, [u8; PAGE * WORD])>>,
    record: &'static mut [u8; MAX_DATA],
}

/// Opens the file, or makes it; called once.
pub(super) fn open() -> Option<Flash> {
    static RECORD: ConstStaticCell<[u8; MAX_DATA]> = ConstStaticCell::new([0; MAX_DATA]);
    let opened = storage::argument(3, |path| {
        let mut name = [0; MAX_ARGUMENTS];
        name.get_mut(..path.len())?.copy_from_slice(path.as_bytes());
        let name = CStr::from_bytes_until_nul(&name).ok()?;
        let opened = File::options().read(true).write(true).open(name);
        opened.or_else(|_| File::options().read(true).write(true).create(true).truncate(true).open(name)).ok()
    });
    let Some(file) = opened? else {
        firmware::error!("the file of the store cannot be opened");
        return None;
    };
    Some(Flash { file: RefCell::new(file), page: RefCell::new(None), record: RECORD.take() })
}

fn offset(Place { sector, word }: Place) -> u64 {
    (u64::from(sector) * u64::from(WORDS) + u64::from(word)) * WORD as u64
}

impl Flash {
    /// Whether all bytes are in the file.
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
}

impl recipe_store::Flash for Flash {
    fn geometry(&self) -> Geometry {
        Geometry { sectors: 2, words: WORDS }
    }

    fn read(&self, place: Place) -> Word {
        let offset = offset(place);
        let inside = offset % (PAGE * WORD) as u64;
        let mut page = self.page.borrow_mut();
        let (_, bytes) = match &mut *page {
            Some(page) if page.0 == offset - inside => page,
            page => page.insert((offset - inside, self.read_page(offset - inside))),
        };
        bytes.as_chunks().0.get(inside as usize / WORD).copied().unwrap_or(BLANK)
    }

    async fn write(&mut self, place: Place, word: &Word) {
        // What is missing shows when it is read back.
        let _ = self.write_at(offset(place), word);
    }

    async fn erase(&mut self, sector: u8) {
        for word in (0..WORDS).step_by(PAGE) {
            let _ = self.write_at(offset(Place { sector, word }), &[0xFF; PAGE * WORD]);
        }
    }
}

impl Flash {
    /// What is behind the end of the file is blank.
    fn read_page(&self, offset: u64) -> [u8; PAGE * WORD] {
        let mut bytes = [0xFF; PAGE * WORD];
        let mut file = self.file.borrow_mut();
        let mut len = 0;
        if file.seek(SeekFrom::Start(offset)).is_ok() {
            while let Some(room @ [_, ..]) = bytes.get_mut(len..) {
                match file.read(room) {
                    Ok(count @ 1..) => len += count,
                    _ => break,
                }
            }
        }
        bytes
    }
}

impl SlotFlash for Flash {
    fn whole(&self, place: Place) -> Option<Word> {
        Some(recipe_store::Flash::read(self, place))
    }
}

impl StoreFlash for Flash {
    fn bytes(&mut self, found: Found) -> Option<&[u8]> {
        let mut place = found.data;
        let words = found.len.div_ceil(WORD);
        for nth in 0..words {
            let word = recipe_store::Flash::read(self, place);
            let part = self.record.get_mut(nth * WORD..)?;
            part.iter_mut().zip(word).for_each(|(byte, read)| *byte = read);
            place.word += 1;
        }
        self.record.get(..found.len)
    }
}
