//! Flash layout of the boards: one table for loaders, firmware and the signing tool.

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
    /// Begin and end of each RAM: a vector table begins with the initial stack pointer, which must point into RAM.
    pub ram: &'static [(u32, u32)],
}

/// The addresses of the sectors of two places for the store.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Stores(pub [[u32; 2]; 2]);

/// ST's NUCLEO-H743ZI2. Sectors 0 to 7 are the first bank, 8 to 15 the second. The loader is in sector 0; the
/// configuration image that a debug probe writes is in sector 14.
pub const NUCLEO_H743ZI: Layout = Layout {
    board: "nucleo-h743zi",
    sector: 0x2_0000,
    slots: [0x0802_0000, 0x0810_0000],
    slot_sectors: 5,
    ram: &[(0x2000_0000, 0x2002_0000), (0x2400_0000, 0x2408_0000)],
};

/// The stores of the NUCLEO-H743ZI2. A firmware uses the store in the bank that it does not run from.
pub const NUCLEO_H743ZI_STORES: Stores = Stores([[0x081A_0000, 0x081E_0000], [0x080C_0000, 0x080E_0000]]);

/// QEMU's `mps2-an500`. A file on the host stands for the flash; in it slot B is behind slot A. The loader copies the
/// slot that it runs to these addresses, in 4 MiB of program RAM, the first of which is the loader's. The store is a
/// file too. It has only one place, because there are no flash banks that stall during an erase.
pub const MPS2_AN500: Layout = Layout {
    board: "mps2-an500",
    sector: 0x2_0000,
    slots: [0x0010_0000, 0x0020_0000],
    slot_sectors: 5,
    ram: &[(0x2000_0000, 0x2040_0000)],
};

/// All boards with a loader.
pub const BOARDS: [&Layout; 2] = [&NUCLEO_H743ZI, &MPS2_AN500];

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

    /// Offset of a slot in memory that contains all slots one behind the other.
    pub const fn slot_offset(&self, slot: Slot) -> u32 {
        match slot {
            Slot::A => 0,
            Slot::B => self.slot_size(),
        }
    }
}

impl Stores {
    /// The addresses of the sectors of a place.
    pub const fn sectors(&self, side: Side) -> [u32; 2] {
        let Self([first, second]) = *self;
        match side {
            Side::First => first,
            Side::Second => second,
        }
    }

    /// The place for the store of a firmware that runs in this slot.
    pub const fn of(slot: Slot) -> Side {
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

    fn sectors(layout: &Layout) -> Vec<u32> {
        let of = |start: u32| (0..u32::from(layout.slot_sectors)).map(move |nth| start + nth * layout.sector);
        layout.slots.into_iter().flat_map(of).collect()
    }

    fn do_not_overlap(mut all: Vec<u32>) {
        let count = all.len();
        all.sort();
        all.dedup();
        assert_eq!(all.len(), count);
    }

    #[test]
    fn slots_do_not_overlap() {
        for layout in BOARDS {
            let all = sectors(layout);
            assert!(all.iter().all(|start| start % layout.sector == 0));
            do_not_overlap(all);
            assert_eq!(Layout::of(layout.board), Some(layout));
            assert_eq!(layout.slot_offset(Slot::B), u32::from(layout.slot_sectors) * layout.sector);
        }
    }

    #[test]
    fn a_store_of_the_nucleo_is_not_in_the_bank_of_its_firmware() {
        let mut all = sectors(&NUCLEO_H743ZI);
        all.extend(NUCLEO_H743ZI_STORES.0.as_flattened());
        assert!(all.iter().all(|start| {
            start % NUCLEO_H743ZI.sector == 0 && *start > 0x0800_0000 && *start != 0x081C_0000
        }));
        do_not_overlap(all);
        let bank = |address: u32| address >> 20;
        for slot in Slot::ALL {
            let store = NUCLEO_H743ZI_STORES.sectors(Stores::of(slot));
            assert!(store.iter().all(|address| bank(*address) != bank(NUCLEO_H743ZI.slot(slot))));
        }
    }

    #[test]
    fn a_slot_of_qemus_board_is_in_the_ram_for_programs_behind_the_loader() {
        let all = sectors(&MPS2_AN500);
        assert!(all.iter().all(|start| (0x10_0000..0x40_0000).contains(start)));
    }
}
