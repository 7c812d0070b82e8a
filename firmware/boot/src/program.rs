//! The program.

use core::fmt;
use core::panic::PanicInfo;

use embassy_futures::block_on;
use recipe_store::{Newest, Side, SlotMarks, Store, newest};
use recipe_update::{BoardName, Machine, PublicKey, Slot, choose};

use crate::board::{self, Area, BOARD};

/// The public key that firmware is signed for, behind a mark: at a fixed place (loader.x), where the firmware reads it.
#[unsafe(link_section = ".update_key")]
#[used]
static KEY: MarkedKey = MarkedKey { mark: *b"RGUK", key: include!(concat!(env!("OUT_DIR"), "/key.rs")) };

#[repr(C)]
struct MarkedKey {
    mark: [u8; 4],
    key: [u8; 32],
}

#[cortex_m_rt::entry]
fn main() -> ! {
    board::start();
    match chosen() {
        Some(vectors) => run(vectors),
        None => board::nothing_runs(),
    }
}

/// The vector table of the firmware to be run. Not inlined, so that the stack of the signature is free again.
#[inline(never)]
fn chosen() -> Option<u32> {
    // SAFETY: called once.
    let (slots, stores) = unsafe { (board::slots()?, board::stores()) };
    let mut board = LoaderBoard { slots, store: stores.and_then(mount) };
    let marks = board.store.as_ref().map(|mounted| mounted.store.slots());
    let name = BoardName::parse(BOARD.board)?;
    let key = PublicKey::parse(&KEY.key)?;
    let chosen = choose(&mut board, marks, &name, &key)?;
    board::load(&chosen, &board.slots)
}

/// The valid store and its flash.
struct MountedStore {
    store: Store,
    flash: Area,
}

/// A board with one bank has one place.
fn mount((first, second): (Area, Option<Area>)) -> Option<MountedStore> {
    let Some(second) = second else {
        return Some(MountedStore { store: Store::mount(&first).ok()?, flash: first });
    };
    let Newest { store, side, .. } = newest(&first, &second).ok()?;
    let flash = match side {
        Side::First => first,
        Side::Second => second,
    };
    Some(MountedStore { store, flash })
}

struct LoaderBoard {
    slots: [Area; 2],
    store: Option<MountedStore>,
}

impl Machine for LoaderBoard {
    type Flash = Area;

    fn flash(&self, slot: Slot) -> &Area {
        let [a, b] = &self.slots;
        match slot {
            Slot::A => a,
            Slot::B => b,
        }
    }

    fn mark(&mut self, marks: SlotMarks) -> bool {
        let Some(MountedStore { store, flash }) = &mut self.store else { return false };
        // Nothing in it waits for anything but the flash, and the flash is waited for in place.
        store.mark_slots(marks).is_ok_and(|put| block_on(put.execute(flash)).is_ok())
    }

    fn passed_over(&mut self, slot: Slot, why: &dyn fmt::Display) {
        board::say(format_args!("slot {slot:?} is not run: {why}"));
    }
}

/// Leaves the board to the firmware.
fn run(vectors: u32) -> ! {
    board::leave();
    // SAFETY: the image was checked, and nothing of the loader is used any more. The image begins with a vector table,
    // which is aligned for the 166 vectors of the STM32H743, and for the fewer of QEMU's board.
    unsafe {
        (*cortex_m::peripheral::SCB::PTR).vtor.write(vectors);
        cortex_m::asm::dsb();
        cortex_m::asm::isb();
        cortex_m::asm::bootload(core::ptr::with_exposed_provenance(vectors as usize))
    }
}

/// The watchdog ends it, and a fault in the same way.
#[panic_handler]
fn panic(_: &PanicInfo<'_>) -> ! {
    loop {
        cortex_m::asm::nop();
    }
}
