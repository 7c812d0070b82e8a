//! Flash as memory: closed for those who write, page by page, and for those who read where a word is
//! torn. Its cells are the model's.

use super::{Chip, PRECISE_BUS};
use crate::board::{FLASH, FLASH_SIZE};
use crate::exception::masks;
use crate::models::flash::WORD;
use crate::unicorn::Reg;

impl Chip {
    /// Whether a page of flash has words that cannot be read.
    pub(super) fn has_torn(&self, address: u32) -> bool {
        let offset = page(address).wrapping_sub(FLASH);
        self.board.devices.flash.torn().any(|word| page(word) == offset)
    }

    /// Flash is not for writing, and a page with a torn word not for reading.
    pub(super) fn close_page(&self, address: u32) -> Result<(), String> {
        if self.has_torn(address) {
            self.core.guard(page(address), PAGE, true)
        } else {
            self.core.close_flash(page(address), PAGE)
        }
    }

    /// Executes one instruction with a page of flash open.
    pub(super) fn step_in_page(&mut self, address: u32) {
        self.core.guard(page(address), PAGE, false).expect("there is flash");
        // What was translated before knows nothing of stopping behind one instruction.
        self.core.forget(self.pc, 4);
        self.board.is_forced = true;
        self.core.run_one(self.pc, &mut self.board);
        self.board.is_forced = false;
        self.pc = self.engine().reg(Reg::Pc);
        // Only with the end of the work the cells change.
        let place = (page(address) - FLASH) as usize;
        let cells = &self.board.devices.flash.cells()[place..place + PAGE as usize];
        self.engine().write(page(address), cells);
        self.close_page(address).expect("there is flash");
    }

    /// A read of a page with a torn word: of that word it is a bus fault, unless those are held back.
    pub(super) fn read_torn(&mut self, address: u32) {
        let word = (address - FLASH) & !(WORD - 1);
        if self.board.devices.flash.torn().any(|torn| torn == word) {
            if !self.board.scs.ignores_bus_faults(masks(self.engine())) {
                self.fault(PRECISE_BUS, address);
                return;
            }
            self.board.scs.note_fault(PRECISE_BUS, address, false);
        }
        self.step_in_page(address);
    }

    /// A write to flash: the instruction is executed, but its cells take what the model lets them.
    pub(super) fn program_flash(&mut self, address: u32, (value, size): (u32, u32)) {
        let bytes = &value.to_le_bytes()[..size as usize];
        self.board.program_flash(self.pc, address - FLASH, bytes);
        self.step_in_page(address);
    }

    /// Memory shows what flash's cells hold since the last erase or write.
    pub(super) fn follow_flash(&mut self) {
        for (offset, len) in self.board.devices.flash.take_changed() {
            let cells = &self.board.devices.flash.cells()[offset as usize..][..len as usize];
            self.core.engine().write(FLASH + offset, cells);
            self.core.forget(FLASH + offset, len);
            for address in (FLASH + offset..FLASH + offset + len).step_by(PAGE as usize) {
                self.close_page(address).expect("there is flash");
            }
        }
    }
}

/// What memory is opened and closed by.
const PAGE: u32 = 0x1000;

fn page(address: u32) -> u32 {
    address & !(PAGE - 1)
}

pub(super) fn is_flash(address: u32) -> bool {
    (FLASH..FLASH + FLASH_SIZE).contains(&address)
}
