//! The program.

use core::fmt;
use core::panic::PanicInfo;

use embassy_futures::block_on;
use recipe_store::{Newest, Side, SlotMarks, newest};
use recipe_update::{BoardName, IMAGE_OFFSET, Machine, NUCLEO_H743ZI as BOARD, PublicKey, Slot, choose};

use crate::flash::Area;
use crate::{lamp, watchdog};

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
    watchdog::start();
    if let Some(mut core) = cortex_m::Peripherals::take() {
        // Reading flash takes seven wait states after a reset.
        core.SCB.enable_icache();
    }
    match chosen() {
        Some(slot) => run(slot),
        None => lamp::blink(),
    }
}

/// The slot to be run. Not inlined, so that the stack of the signature is free again.
#[inline(never)]
fn chosen() -> Option<Slot> {
    // SAFETY: each area is made once, and they do not overlap (a test of the layout).
    let mut board = unsafe {
        Board {
            slots: Slot::ALL.map(|slot| Area::slot(slot)),
            stores: [Side::First, Side::Second].map(|side| Area::store(side)),
            newest: None,
        }
    };
    let [first, second] = &board.stores;
    board.newest = newest(first, second).ok();
    let marks = board.newest.as_ref().map(|newest| newest.store.slots());
    let name = BoardName::parse(BOARD.board)?;
    let key = PublicKey::parse(&KEY.key)?;
    choose(&mut board, marks, &name, &key).map(|chosen| chosen.slot)
}

struct Board {
    slots: [Area; 2],
    stores: [Area; 2],
    newest: Option<Newest>,
}

impl Machine for Board {
    type Flash = Area;

    fn flash(&self, slot: Slot) -> &Area {
        let [a, b] = &self.slots;
        match slot {
            Slot::A => a,
            Slot::B => b,
        }
    }

    fn mark(&mut self, marks: SlotMarks) -> bool {
        let Some(newest) = &mut self.newest else { return false };
        let [first, second] = &mut self.stores;
        let flash = match newest.side {
            Side::First => first,
            Side::Second => second,
        };
        // Nothing in it waits for anything but the flash, and the flash is waited for in place.
        newest.store.mark_slots(marks).is_ok_and(|put| block_on(put.carry_out(flash)).is_ok())
    }

    /// There is no log: what became of a trial is in the marks.
    fn passed_over(&mut self, _: Slot, _: &dyn fmt::Display) {}
}

/// Leaves everything to the firmware but the watchdog, which goes on: what hangs before it feeds it has used a start.
fn run(slot: Slot) -> ! {
    watchdog::feed();
    let vectors = BOARD.slot(slot).saturating_add(IMAGE_OFFSET);
    // SAFETY: the loader ends here, so nothing of it is used any more.
    let mut core = unsafe { cortex_m::Peripherals::steal() };
    core.SCB.disable_icache();
    // SAFETY: the image was checked. It begins with a vector table, which is aligned for the 166 vectors of the chip.
    unsafe {
        core.SCB.vtor.write(vectors);
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
