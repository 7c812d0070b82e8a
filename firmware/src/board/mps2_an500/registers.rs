//! Where the devices are, and how their registers are reached.

/// UART 0 to 4.
pub(super) const UARTS: [u32; 5] = [0x4000_4000, 0x4000_5000, 0x4000_6000, 0x4000_7000, 0x4000_9000];
/// The timer of the alarm.
pub(super) const TIMER0: u32 = 0x4000_0000;
/// A timer that nobody waits for.
pub(super) const DUAL_TIMER: u32 = 0x4000_2000;
/// The watchdog.
pub(super) const WATCHDOG: u32 = 0x4000_8000;
/// LEDs, a free-running counter, and others.
pub(super) const FPGAIO: u32 = 0x4002_8000;
/// The Ethernet controller.
pub(super) const LAN9118: u32 = 0xA000_0000;

/// Reads a device's register.
pub(super) fn read(address: u32) -> u32 {
    // SAFETY: only the places above and their offsets are passed; reading them has no effect on memory.
    unsafe { core::ptr::with_exposed_provenance::<u32>(address as usize).read_volatile() }
}

/// Writes a device's register.
pub(super) fn write(address: u32, value: u32) {
    // SAFETY: as above; none of the devices writes to memory.
    unsafe { core::ptr::with_exposed_provenance_mut::<u32>(address as usize).write_volatile(value) }
}
