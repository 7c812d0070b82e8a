//! Where boards have their slots and stores: one table for loaders, firmware and the tool that signs.

use recipe_store::{Side, Slot};

/// The flash of a board, by addresses.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Layout {
    /// The board's name.
    pub board: &'static str,
    /// Size of a sector in bytes.
    pub sector: u32,
    /// Where each slot begins.
    pub slots: [u32; 2],
    /// Number of sectors of a slot, which lie one behind the other.
    pub slot_sectors: u8,
    /// Where the sectors of each place for the store begin.
    pub stores: [[u32; 2]; 2],
    /// Where RAM begins and ends: a vector table begins with the address of a stack.
    pub ram: &'static [(u32, u32)],
}

/// ST's NUCLEO-H743ZI2. Sectors 0 to 7 are the first bank, 8 to 15 the second. The loader is in sector 0, the image of
/// a probe in sector 14. A firmware keeps its store in the bank that it does not run from.
pub const NUCLEO_H743ZI: Layout = Layout {
    board: "nucleo-h743zi",
    sector: 0x2_0000,
    slots: [0x0802_0000, 0x0810_0000],
    slot_sectors: 5,
    stores: [[0x081A_0000, 0x081E_0000], [0x080C_0000, 0x080E_0000]],
    ram: &[(0x2000_0000, 0x2002_0000), (0x2400_0000, 0x2408_0000)],
};

/// All boards with a loader.
pub const BOARDS: [&Layout; 1] = [&NUCLEO_H743ZI];

impl Layout {
    /// The board of this name.
    pub fn of(board: &str) -> Option<&'static Self> {
        BOARDS.into_iter().find(|layout| layout.board == board)
    }

    /// The address at which a slot begins.
    pub const fn slot(&self, slot: Slot) -> u32 {
        let [a, b] = self.slots;
        match slot {
            Slot::A => a,
            Slot::B => b,
        }
    }

    /// Size of a slot in bytes.
    pub const fn slot_size(&self) -> u32 {
        (self.slot_sectors as u32).saturating_mul(self.sector)
    }

    /// The addresses of the sectors of a place for the store.
    pub const fn store(&self, side: Side) -> [u32; 2] {
        let [first, second] = self.stores;
        match side {
            Side::First => first,
            Side::Second => second,
        }
    }

    /// The place for the store of a firmware that runs in this slot.
    pub const fn store_of(slot: Slot) -> Side {
        match slot {
            Slot::A => Side::First,
            Slot::B => Side::Second,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::vec::Vec;

    #[test]
    fn nothing_overlaps_and_a_store_is_not_in_the_bank_of_its_firmware() {
        for layout in BOARDS {
            let sectors =
                |start: u32| (0..u32::from(layout.slot_sectors)).map(move |nth| start + nth * layout.sector);
            let mut all: Vec<u32> = layout.slots.into_iter().flat_map(sectors).collect();
            all.extend(layout.stores.as_flattened());
            let count = all.len();
            all.sort();
            all.dedup();
            assert_eq!(all.len(), count);
            assert!(
                all.iter()
                    .all(|start| start % layout.sector == 0 && *start > 0x0800_0000 && *start != 0x081C_0000)
            );
            let bank = |address: u32| address >> 20;
            for slot in Slot::ALL {
                let store = layout.store(Layout::store_of(slot));
                assert!(store.iter().all(|address| bank(*address) != bank(layout.slot(slot))));
            }
            assert_eq!(Layout::of(layout.board), Some(layout));
        }
    }
}
