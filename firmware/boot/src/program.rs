//! The loader's program: chooses a slot and jumps to its firmware.

use core::fmt;
use core::panic::PanicInfo;

use embassy_futures::block_on;
use recipe_store::{Newest, Side, SlotMarks, Store, newest};
use recipe_update::{BoardName, Machine, PublicKey, Slot, choose};

use crate::board::{self, Area, BOARD};

/// The public key that firmware must be signed with, preceded by a mark. It is at a fixed address (loader.x), where the
/// firmware reads it too.
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
    match vectors() {
        Some(vectors) => run(vectors),
        None => board::nothing_runs(),
    }
}

/// Vector table of the firmware to run. Not inlined, to free the stack of the signature check.
#[inline(never)]
fn vectors() -> Option<u32> {
    // SAFETY: `vectors` is called once.
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

/// Mounts the store. A board with one flash bank has only one place for it.
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
        // The future never pends: it waits only for the flash, whose operations block.
        store.mark_slots(marks).is_ok_and(|put| block_on(put.execute(flash)).is_ok())
    }

    fn passed_over(&mut self, slot: Slot, why: &dyn fmt::Display) {
        board::say(format_args!("slot {slot:?} is not run: {why}"));
    }
}

/// Jumps to the firmware.
fn run(vectors: u32) -> ! {
    board::leave();
    // SAFETY: `choose` has checked the image that begins at this address, and nothing of the loader is used after the
    // jump. The image begins with its vector table, whose alignment suffices for the 166 vectors of the STM32H743 and
    // the fewer vectors of QEMU's board.
    unsafe {
        (*cortex_m::peripheral::SCB::PTR).vtor.write(vectors);
        cortex_m::asm::dsb();
        cortex_m::asm::isb();
        cortex_m::asm::bootload(core::ptr::with_exposed_provenance(vectors as usize))
    }
}

/// Waits until the watchdog resets the board, as after a fault.
#[panic_handler]
fn panic(_: &PanicInfo<'_>) -> ! {
    loop {
        cortex_m::asm::nop();
    }
}
