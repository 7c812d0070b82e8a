//! The flash of store and slots: two files on the host. The fourth semihosting argument names the file of the store,
//! the sixth that of the slots. Without the fourth argument there is no store.

use firmware::stored::StoreFlash;
use firmware::update::{Site, Slots};
use recipe_store::{Flash, FlashWord, FoundRecord, Geometry, MAX_DATA, WORD, Word};
use recipe_update::{MPS2_AN500 as BOARD, Slot};
use static_cell::ConstStaticCell;

use super::super::slot::running;
use super::arguments::FileName;
use super::host_flash::HostFlash;

/// The store: two sectors like those of the NUCLEO.
pub(crate) struct StoreFile {
    flash: HostFlash,
    record: &'static mut [u8; MAX_DATA],
}

/// Opens or creates the store; called once.
pub(super) fn store() -> Option<StoreFile> {
    static RECORD: ConstStaticCell<[u8; MAX_DATA]> = ConstStaticCell::new([0; MAX_DATA]);
    let Some(flash) = HostFlash::open(&FileName::argument(STORE)?, 0, STORE_SECTORS) else {
        firmware::error!("the file of the store cannot be opened");
        return None;
    };
    Some(StoreFile { flash, record: RECORD.take() })
}

pub(super) fn slots() -> Site<HostFlash> {
    Site { board: BOARD.board, slots: opened() }
}

fn opened() -> Result<Slots<HostFlash>, &'static str> {
    let running = running().ok_or("QEMU runs the program that it is given: there are no slots")?;
    let key = key().ok_or("there is no loader with a key at the beginning of the flash")?;
    let name = FileName::argument(SLOTS).ok_or("no file of the slots was named")?;
    let open = |slot: Slot| {
        HostFlash::open(&name, BOARD.slot_offset(slot), BOARD.slot_sectors)
            .ok_or("the file of the slots cannot be opened")
    };
    Ok(Slots { running, key, own: open(running)?, free: open(running.other())? })
}

/// The public key in the loader, preceded by a mark (firmware/boot/loader.x).
fn key() -> Option<[u8; 32]> {
    // SAFETY: this address is in program RAM, which can be read as a whole. It belongs to the loader, which has ended:
    // nothing writes to it, and this program has no objects there.
    let marked = unsafe { core::ptr::with_exposed_provenance::<[u8; 36]>(KEY).read_volatile() };
    marked.strip_prefix(b"RGUK")?.first_chunk().copied()
}

impl Flash for StoreFile {
    fn geometry(&self) -> Geometry {
        self.flash.geometry()
    }

    fn read(&self, place: FlashWord) -> Word {
        self.flash.read(place)
    }

    async fn write(&mut self, place: FlashWord, word: &Word) {
        self.flash.write(place, word).await;
    }

    async fn erase(&mut self, sector: u8) {
        self.flash.erase(sector).await;
    }
}

impl StoreFlash for StoreFile {
    fn bytes(&mut self, found: FoundRecord) -> Option<&[u8]> {
        let mut place = found.data;
        let words = found.len.div_ceil(WORD);
        for nth in 0..words {
            let word = self.flash.read(place);
            let part = self.record.get_mut(nth * WORD..)?;
            part.iter_mut().zip(word).for_each(|(byte, read)| *byte = read);
            place.word += 1;
        }
        self.record.get(..found.len)
    }
}

/// Indices of the semihosting arguments with the names of the files. The loader uses the same indices.
const STORE: usize = 3;
const SLOTS: usize = 5;
const STORE_SECTORS: u8 = 2;
/// Address of the mark and the key in the loader.
const KEY: usize = 0x400;
