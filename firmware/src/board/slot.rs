//! The slot that the program was linked for (firmware/build.rs writes it into program.x).

use recipe_update::Slot;

unsafe extern "C" {
    /// The address of this symbol is the number of the slot: 1 for A, 2 for B.
    static _slot: u8;
}

/// The slot that the program was linked for; `None` without a loader.
pub(super) fn running() -> Option<Slot> {
    match (&raw const _slot).addr() {
        1 => Some(Slot::A),
        2 => Some(Slot::B),
        _ => None,
    }
}
