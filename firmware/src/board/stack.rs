//! Stack guard and measurement of stack use, for all boards. The linker script places the stack and its guard.

use cortex_m::peripheral::MPU;

unsafe extern "C" {
    /// The lowest address of the guard. The size of the guard is a power of two, and the guard is aligned to its size.
    static _stack_guard: u32;
    /// The stack's lowest address, where the guard ends.
    static _stack_end: u32;
    static _stack_start: u32;
}

const PAINT: u32 = 0xC5C5_C5C5;

fn bottom() -> usize {
    &raw const _stack_end as usize
}

/// Makes the guard below the stack inaccessible, so that a stack overflow causes a fault. The MPU does not apply to the
/// fault's handler, which needs a stack itself.
pub(super) fn guard() {
    let start = &raw const _stack_guard as u32;
    let bits = (bottom() as u32 - start).trailing_zeros();
    // SAFETY: nothing else uses the MPU. The region covers only the guard, in which the linker script places nothing.
    unsafe {
        let mpu = &*MPU::PTR;
        mpu.rnr.write(0);
        mpu.rbar.write(start);
        // Execute never, no access, size, enabled.
        mpu.rasr.write(1 << 28 | (bits - 1) << 1 | 1);
        // Enabled, with the default memory map for everything else.
        mpu.ctrl.write(1 << 2 | 1);
    }
    cortex_m::asm::dsb();
    cortex_m::asm::isb();
}

/// Fills the unused part of the stack with a pattern.
pub(super) fn paint() {
    let used = cortex_m::register::msp::read() as usize - 256;
    for address in (bottom()..used).step_by(4) {
        // SAFETY: the address is between the guard and the current stack frames, with a margin of 256 bytes. Nothing
        // uses this memory now, and the linker script places nothing else there.
        unsafe { core::ptr::with_exposed_provenance_mut::<u32>(address).write_volatile(PAINT) }
    }
}

/// Highest stack use so far, in bytes.
pub(crate) fn used() -> usize {
    let top = &raw const _stack_start as usize;
    // SAFETY: the address is aligned and between the guard and the top of the stack, all of which is readable RAM.
    let is_painted = |&address: &usize| unsafe {
        core::ptr::with_exposed_provenance::<u32>(address).read_volatile() == PAINT
    };
    let painted = (bottom()..top).step_by(4).take_while(is_painted).count();
    top - bottom() - 4 * painted
}
