//! Addresses of the devices, and access to their registers.
//!
//! The loader compiles this file too (firmware/boot/src/board/mps2_an500/mod.rs).

pub(crate) const UARTS: [u32; 5] = [0x4000_4000, 0x4000_5000, 0x4000_6000, 0x4000_7000, 0x4000_9000];
/// The timer of the alarm.
pub(crate) const TIMER0: u32 = 0x4000_0000;
/// The timer that wakes the emulator.
pub(crate) const DUAL_TIMER: u32 = 0x4000_2000;
pub(crate) const WATCHDOG: u32 = 0x4000_8000;
/// LEDs, a free-running counter, and others.
pub(crate) const FPGAIO: u32 = 0x4002_8000;
pub(crate) const LAN9118: u32 = 0xA000_0000;

pub(crate) fn read(address: u32) -> u32 {
    // SAFETY: all callers pass addresses of aligned 32-bit registers of the devices above. Reading them does not
    // change memory.
    unsafe { core::ptr::with_exposed_provenance::<u32>(address as usize).read_volatile() }
}

pub(crate) fn write(address: u32, value: u32) {
    // SAFETY: all callers pass addresses of aligned 32-bit registers of the devices above, none of which writes to
    // memory.
    unsafe { core::ptr::with_exposed_provenance_mut::<u32>(address as usize).write_volatile(value) }
}
