//! Registers of the chip by address: the loader needs few of them.

#[derive(Clone, Copy)]
pub(crate) struct Register(usize);

impl Register {
    /// # Safety
    /// `address` must be that of a 32-bit register that can be read without side effects that matter. Nobody but the
    /// caller may write to it.
    pub(crate) const unsafe fn at(address: usize) -> Self {
        Self(address)
    }

    pub(crate) fn read(self) -> u32 {
        // SAFETY: the caller of `at` guarantees that this is a 32-bit register that can be read without side effects.
        unsafe { core::ptr::with_exposed_provenance::<u32>(self.0).read_volatile() }
    }

    pub(crate) fn write(self, value: u32) {
        // SAFETY: the caller of `at` guarantees that this is a 32-bit register that nobody else writes to.
        unsafe { core::ptr::with_exposed_provenance_mut::<u32>(self.0).write_volatile(value) }
    }
}
