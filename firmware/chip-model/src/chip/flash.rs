//! Flash as memory of the emulator. Pages are read-only, and inaccessible if they contain a torn word, so that the
//! model handles each write and each access to such a page. The model owns the contents.

use super::{Chip, PRECISE_BUS};
use crate::board::{FLASH, FLASH_SIZE};
use crate::exception::{IT, masks};
use crate::models::flash::WORD;
use crate::unicorn::{Emulator, Reg};

impl Chip {
    /// Whether the page of this address contains torn words.
    pub(super) fn has_torn(&self, address: u32) -> bool {
        let offset = page(address).wrapping_sub(FLASH);
        self.board.devices.flash.torn().any(|word| page(word) == offset)
    }

    /// Makes a page read-only, or inaccessible if it contains a torn word. If nothing changes, the emulator keeps its
    /// translations.
    pub(super) fn close_page(&mut self, address: u32) -> Result<(), String> {
        let page = page(address);
        match (self.has_torn(address), self.pages.get(&page)) {
            (true, Some(PageAccess::None)) | (false, None) => Ok(()),
            (true, _) => {
                self.pages.insert(page, PageAccess::None);
                self.core.protect(page, PAGE, true)
            }
            (false, _) => {
                self.pages.remove(&page);
                self.core.make_read_only(page, PAGE)
            }
        }
    }

    /// Copies the cells to the emulator's memory, which may differ because code was patched or the power was cut.
    /// Writes only pages that differ, because the emulator drops its translations of what is written.
    pub(super) fn restore_flash(&mut self) -> Result<(), String> {
        let engine = self.engine();
        let mut there = vec![0; FLASH_SIZE as usize];
        engine.read(FLASH, &mut there);
        let pages = (FLASH..).step_by(PAGE as usize);
        let cells = self.board.devices.flash.cells().chunks(PAGE as usize);
        for ((address, cells), there) in pages.zip(cells).zip(there.chunks(PAGE as usize)) {
            if cells != there {
                engine.write(address, cells);
                self.core.invalidate(address, PAGE);
            }
        }
        let torn: Vec<u32> = self.board.devices.flash.torn().map(|word| FLASH + word).collect();
        let pages: Vec<u32> = self.pages.keys().copied().chain(torn).collect();
        pages.into_iter().try_for_each(|address| self.close_page(address))
    }

    /// Executes one instruction with full access to a page of flash. The emulator then loses all of its translations.
    pub(super) fn step_in_page(&mut self, address: u32) {
        self.pages.insert(page(address), PageAccess::Full);
        self.core.protect(page(address), PAGE, false).expect("there is flash");
        // This block was translated without a stop after one instruction. So was the block that begins with the next
        // instruction, if a run ever began there.
        self.core.invalidate(self.pc, 8);
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
        match plain(self.engine(), self.pc) {
            Some(SimpleAccess { loads: Some((register, size)), len }) => {
                let mut bytes = [0; 4];
                self.engine().read(address, &mut bytes[..size]);
                self.engine().set_general(register, u32::from_le_bytes(bytes));
                self.pass(len);
            }
            _ => self.step_in_page(address),
        }
    }

    /// A write to flash: the model decides what the cells become. A simple store is then complete; any other
    /// instruction is still executed.
    pub(super) fn program_flash(&mut self, address: u32, (value, size): (u32, u32)) {
        let bytes = &value.to_le_bytes()[..size as usize];
        self.board.program_flash(self.pc, address - FLASH, bytes);
        match plain(self.engine(), self.pc) {
            Some(SimpleAccess { loads: None, len }) => self.pass(len),
            _ => self.step_in_page(address),
        }
    }

    /// Skips an instruction of this length, which was executed here instead of in the emulator.
    fn pass(&mut self, len: u32) {
        self.pc += len;
        // After it has refused one access, the emulator would allow the next ones.
        self.core.flush_rights().expect("it takes nothing");
    }

    /// Copies what was erased or programmed to the emulator's memory.
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

/// A load or store of one register that changes no other register and is in no IT block. It can be executed without the
/// emulator.
struct SimpleAccess {
    /// Length of the instruction.
    len: u32,
    /// For a load: the register, and the number of bytes, which are zero-extended.
    loads: Option<(u32, usize)>,
}

/// The current instruction, if it is a simple access: LDR, LDRH, LDRB or STR with an offset (Armv7-M ARM A5.2.4,
/// A5.3.7, A5.3.10).
fn plain(engine: Emulator, pc: u32) -> Option<SimpleAccess> {
    let word = engine.word(pc);
    let (low, high) = (word & 7, word >> 28);
    let (len, loads) = match word as u16 {
        _ if engine.reg(Reg::Xpsr) & IT != 0 => return None,
        0x5000..0x5200 | 0x6000..0x6800 | 0x9000..0x9800 => (2, None),
        0x5800..0x5A00 | 0x6800..0x7000 => (2, Some((low, 4))),
        0x5A00..0x5C00 | 0x8800..0x9000 => (2, Some((low, 2))),
        0x5C00..0x5E00 | 0x7800..0x8000 => (2, Some((low, 1))),
        0xF8C0..0xF8D0 => (4, None),
        0xF8D0..0xF8E0 => (4, Some((high, 4))),
        0xF8B0..0xF8C0 => (4, Some((high, 2))),
        0xF890..0xF8A0 => (4, Some((high, 1))),
        _ => return None,
    };
    // Loads into the stack pointer, the link register or the program counter have other effects.
    let is_special = loads.is_some_and(|(register, _)| register > 12);
    (!is_special).then_some(SimpleAccess { len, loads })
}

/// The emulator's access rights to a page that is not read-only.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum PageAccess {
    /// No access.
    None,
    /// Full access.
    Full,
}

/// The emulator's unit of access rights.
const PAGE: u32 = 0x1000;

fn page(address: u32) -> u32 {
    address & !(PAGE - 1)
}

pub(super) fn is_flash(address: u32) -> bool {
    (FLASH..FLASH + FLASH_SIZE).contains(&address)
}
