//! Whether a word of the flash can be read: one that a power cut has torn, or that was programmed twice, has no valid
//! error correction code, and reading it is a bus fault. RM0433, "Embedded Flash memory".
//!
//! The loader compiles this file too (firmware/boot/src/board/nucleo_h743zi/mod.rs).

use core::arch::asm;

use cortex_m::peripheral::SCB;

/// Whether the flash word at this address can be read.
pub(super) fn can_read(address: usize) -> bool {
    const CCR_IGNORE_BUS_FAULTS: u32 = 1 << 8;
    const CFSR_BUS: u32 = 0xBF << 8;
    // SAFETY: all interrupts and faults are masked during one load from flash, and bus faults are ignored, so a bus
    // fault only sets its flag. Afterwards the flag is cleared and all other state is restored.
    unsafe {
        let scb = &*SCB::PTR;
        let control = scb.ccr.read();
        asm!("cpsid f");
        scb.ccr.write(control | CCR_IGNORE_BUS_FAULTS);
        cortex_m::asm::dsb();
        cortex_m::asm::isb();
        core::ptr::with_exposed_provenance::<u32>(address).read_volatile();
        cortex_m::asm::dsb();
        // The flags are those of this load: everywhere else bus faults are not ignored, so one would have ended the
        // program.
        let faults = scb.cfsr.read() & CFSR_BUS;
        if faults != 0 {
            scb.cfsr.write(faults);
        }
        scb.ccr.write(control);
        asm!("cpsie f");
        faults == 0
    }
}
