//! Flash as the emulator's memory: pages are read-only, and not readable if they contain a torn word, so
//! that the model decides about each such access. The model owns the contents.

use super::{Chip, PRECISE_BUS};
use crate::board::{FLASH, FLASH_SIZE};
use crate::exception::masks;
use crate::models::flash::WORD;
use crate::unicorn::Reg;

impl Chip {
    /// Whether the page of this address contains torn words.
    pub(super) fn has_torn(&self, address: u32) -> bool {
        let offset = page(address).wrapping_sub(FLASH);
        self.board.devices.flash.torn().any(|word| page(word) == offset)
    }

    /// Makes a page read-only, or inaccessible if it contains a torn word.
    pub(super) fn close_page(&self, address: u32) -> Result<(), String> {
        if self.has_torn(address) {
            self.core.protect(page(address), PAGE, true)
        } else {
            self.core.make_read_only(page(address), PAGE)
        }
    }

    /// Executes one instruction with full access to a page of flash.
    pub(super) fn step_in_page(&mut self, address: u32) {
        self.core.protect(page(address), PAGE, false).expect("there is flash");
        // The block was translated without a stop after one instruction.
        self.core.invalidate(self.pc, 4);
        self.board.is_single_step = true;
        self.core.run_one(self.pc, &mut self.board);
        self.board.is_single_step = false;
        self.pc = self.engine().reg(Reg::Pc);
        // The cells change only when programming ends.
        let place = (page(address) - FLASH) as usize;
        let cells = &self.board.devices.flash.cells()[place..place + PAGE as usize];
        self.engine().write(page(address), cells);
        self.close_page(address).expect("there is flash");
    }

    /// A read of a page with a torn word: a bus fault if it hits that word, unless bus faults are ignored.
    pub(super) fn read_torn(&mut self, address: u32) {
        let word = (address - FLASH) & !(WORD - 1);
        if self.board.devices.flash.torn().any(|torn| torn == word) {
            if !self.board.scs.ignores_bus_faults(masks(self.engine())) {
                self.fault(PRECISE_BUS, address);
                return;
            }
            self.board.scs.record_fault(PRECISE_BUS, address, false);
        }
        self.step_in_page(address);
    }

    /// A write to flash: the instruction is executed, and the model decides what the cells hold.
    pub(super) fn program_flash(&mut self, address: u32, (value, size): (u32, u32)) {
        let bytes = &value.to_le_bytes()[..size as usize];
        self.board.program_flash(self.pc, address - FLASH, bytes);
        self.step_in_page(address);
    }

    /// Copies what was erased or programmed into the emulator's memory.
    pub(super) fn update_flash(&mut self) {
        for (offset, len) in self.board.devices.flash.take_changed() {
            let cells = &self.board.devices.flash.cells()[offset as usize..][..len as usize];
            self.core.engine().write(FLASH + offset, cells);
            self.core.invalidate(FLASH + offset, len);
            for address in (FLASH + offset..FLASH + offset + len).step_by(PAGE as usize) {
                self.close_page(address).expect("there is flash");
            }
        }
    }
}

/// The emulator's unit of access rights.
const PAGE: u32 = 0x1000;

fn page(address: u32) -> u32 {
    address & !(PAGE - 1)
}

pub(super) fn is_flash(address: u32) -> bool {
    (FLASH..FLASH + FLASH_SIZE).contains(&address)
}
