//! The stack: it has the DTCM for itself, and a guard at its end.

use cortex_m::peripheral::MPU;

unsafe extern "C" {
    /// From memory.x: the lowest address of the guard, which ends where the stack may begin.
    static _stack_guard: u32;
    /// The stack's lowest address.
    static _stack_end: u32;
    /// Its upper end.
    static _stack_start: u32;
}

const PAINT: u32 = 0xC5C5_C5C5;
/// log2 of the guard's size.
const GUARD_BITS: u32 = 14;

fn bottom() -> usize {
    &raw const _stack_end as usize
}

/// Keeps everybody from the 16 KiB below the stack, so that an overflow faults. The handler of the fault
/// is not kept from them: it has to have a stack.
pub(super) fn guard() {
    // SAFETY: nobody else uses the MPU, and nothing is kept where the guard is (memory.x).
    unsafe {
        let mpu = &*MPU::PTR;
        mpu.rnr.write(0);
        mpu.rbar.write(&raw const _stack_guard as u32);
        // Execute never, no access, its size, on.
        mpu.rasr.write(1 << 28 | (GUARD_BITS - 1) << 1 | 1);
        // On, with the ordinary map for everything else.
        mpu.ctrl.write(1 << 2 | 1);
    }
    cortex_m::asm::dsb();
    cortex_m::asm::isb();
}

/// Marks the stack's unused part.
pub(super) fn paint() {
    let used = cortex_m::register::msp::read() as usize - 256;
    for address in (bottom()..used).step_by(4) {
        // SAFETY: below everything that is on the stack now; nobody owns it.
        unsafe { core::ptr::with_exposed_provenance_mut::<u32>(address).write_volatile(PAINT) }
    }
}

/// The most that was ever on the stack, in bytes.
pub(crate) fn used() -> usize {
    let top = &raw const _stack_start as usize;
    // SAFETY: the stack is readable as a whole.
    let is_painted = |&address: &usize| unsafe {
        core::ptr::with_exposed_provenance::<u32>(address).read_volatile() == PAINT
    };
    let painted = (bottom()..top).step_by(4).take_while(is_painted).count();
    top - bottom() - 4 * painted
}
