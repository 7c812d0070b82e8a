//! An executor that sleeps with WFI. QEMU ignores WFE, so Embassy's own executor would keep a core of the host busy.

use core::sync::atomic::{AtomicBool, Ordering};

use embassy_executor::{Spawner, raw};
use static_cell::StaticCell;

/// A task was woken.
static PENDING: AtomicBool = AtomicBool::new(true);

#[unsafe(export_name = "__pender")]
fn pender(_: *mut ()) {
    PENDING.store(true, Ordering::Release);
}

pub(super) fn run(init: impl FnOnce(Spawner)) -> ! {
    static EXECUTOR: StaticCell<raw::Executor> = StaticCell::new();
    let executor: &'static raw::Executor = EXECUTOR.init(raw::Executor::new(core::ptr::null_mut()));
    init(executor.spawner());
    loop {
        while PENDING.swap(false, Ordering::AcqRel) {
            // SAFETY: this loop is the only caller of `poll`, and it is not run by a task, so `poll` is not reentered.
            unsafe { executor.poll() };
        }
        // Interrupts are disabled for the check: an interrupt after it stays pending and ends WFI at once.
        cortex_m::interrupt::disable();
        if !PENDING.load(Ordering::Acquire) {
            cortex_m::asm::wfi();
        }
        // SAFETY: this function does not run within a critical section, so enabling interrupts breaks none.
        unsafe { cortex_m::interrupt::enable() };
    }
}
