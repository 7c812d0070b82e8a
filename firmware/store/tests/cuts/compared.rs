//! `sequential-storage` on the same model, for the figures of docs/store.md: why the store is our own.
//!
//! It is given what is best for it: two images under keys of their own, written by turns, in the same three
//! sectors, through a reader that turns words that cannot be read into zeros.

use embassy_futures::block_on;
use embedded_storage_async::nor_flash::{
    ErrorType, NorFlash, NorFlashError, NorFlashErrorKind, ReadNorFlash,
};
use recipe_store::{Flash as _, FlashWord, Geometry, WORD};
use sequential_storage::cache::{Cache, Uncached};
use sequential_storage::map::{MapConfig, MapStorage};

use crate::bench::image;
use crate::model::{Nor, Torn};

#[derive(Debug, Clone)]
struct Adapter(Nor);

/// The power is off.
#[derive(Debug)]
struct PowerLoss;

impl NorFlashError for PowerLoss {
    fn kind(&self) -> NorFlashErrorKind {
        NorFlashErrorKind::Other
    }
}

impl ErrorType for Adapter {
    type Error = PowerLoss;
}

const SECTORS: Geometry = Geometry { sectors: 3, words: 4096 };
const SECTOR: usize = SECTORS.words as usize * WORD;

fn place(at: usize) -> FlashWord {
    FlashWord { sector: (at / SECTOR) as u8, word: (at % SECTOR / WORD) as u16 }
}

impl Adapter {
    fn powered(&self) -> Result<(), PowerLoss> {
        if self.0.is_off() { Err(PowerLoss) } else { Ok(()) }
    }
}

impl ReadNorFlash for Adapter {
    const READ_SIZE: usize = 1;

    async fn read(&mut self, offset: u32, bytes: &mut [u8]) -> Result<(), PowerLoss> {
        for (at, byte) in (offset as usize..).zip(bytes) {
            *byte = self.0.read(place(at))[at % WORD];
        }
        self.powered()
    }

    fn capacity(&self) -> usize {
        3 * SECTOR
    }
}

impl NorFlash for Adapter {
    const WRITE_SIZE: usize = WORD;
    const ERASE_SIZE: usize = SECTOR;

    async fn erase(&mut self, from: u32, to: u32) -> Result<(), PowerLoss> {
        (from as usize..to as usize).step_by(SECTOR).for_each(|at| self.0.erase_now(place(at).sector));
        self.powered()
    }

    async fn write(&mut self, offset: u32, bytes: &[u8]) -> Result<(), PowerLoss> {
        for (at, word) in (offset as usize..).step_by(WORD).zip(bytes.as_chunks().0) {
            self.0.write_now(place(at), word);
        }
        self.powered()
    }
}

type Map = MapStorage<u8, Adapter, Cache<Uncached, Uncached, Uncached, u8>>;

fn open(flash: Adapter) -> Map {
    MapStorage::new(flash, MapConfig::new(0..3 * SECTOR as u32), Cache::new_uncached())
}

#[derive(Debug, Default)]
struct Comparison {
    cuts: u32,
    lost: u32,
    fails: u32,
    not_there: u32,
}

fn cut_everywhere(torn: Torn, changes: u32, len: usize) -> Comparison {
    let mut flash = Adapter(Nor::new(SECTORS, torn));
    flash.0.allow_rewrites();
    let (mut buf, mut outcome) = (vec![0; 8_192], Comparison::default());
    for number in 0..changes {
        let (key, new) = ((number % 2) as u8, image(number, len));
        let old = number.checked_sub(2).map(|number| image(number, len));
        let mut whole = open(flash.clone());
        block_on(whole.store_item(&mut buf, &key, &&new[..])).expect("there is power");
        let (after, _) = whole.destroy();
        let steps = after.0.operations() - flash.0.operations();
        for cut in (0..steps).step_by(3) {
            outcome.cuts += 1;
            let mut dead = flash.clone();
            dead.0.cut_after(cut, u64::from(number) << 32 | u64::from(cut));
            let mut map = open(dead);
            let _ = block_on(map.store_item(&mut buf, &key, &&new[..]));
            let (mut dead, _) = map.destroy();
            dead.0.power();
            let mut map = open(dead);
            let found = block_on(map.fetch_item::<&[u8]>(&mut buf, &key)).ok().flatten().map(<[u8]>::to_vec);
            outcome.lost += u32::from(found != old && found.as_ref() != Some(&new));
            let again = block_on(map.store_item(&mut buf, &key, &&new[..]));
            let found = block_on(map.fetch_item::<&[u8]>(&mut buf, &key)).ok().flatten();
            match again {
                Err(_) => outcome.fails += 1,
                Ok(()) if found != Some(&new[..]) => outcome.not_there += 1,
                Ok(()) => {}
            }
        }
        flash = after;
    }
    outcome
}

#[test]
fn the_ready_made_map_says_ok_and_has_not_stored() {
    let faults = cut_everywhere(Torn::Fault, 12, 4_000);
    println!("sequential-storage, torn words read as zeros: {faults:?}");
    assert_eq!((faults.lost, faults.fails, faults.not_there), (0, 0, 0), "{faults:?}");
    let blank = cut_everywhere(Torn::Blank, 12, 4_000);
    println!("sequential-storage, torn words look blank: {blank:?}");
    // If this fails, it has become better than this page says.
    assert!(blank.fails + blank.not_there > 0, "{blank:?}");
}
