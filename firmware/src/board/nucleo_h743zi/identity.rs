//! The board's address, and a seed for each start.

use embassy_stm32::pac::{RCC, RNG};
use embassy_stm32::uid;
use embassy_time::Instant;

/// The board's Ethernet address.
pub(super) fn ethernet_address() -> [u8; 6] {
    firmware::identity::ethernet_address(&uid::uid())
}

/// A seed for local port numbers, from the chip's number, the time and the random number generator, which may
/// fail.
pub(crate) fn seed() -> u64 {
    let own = firmware::identity::hash(&uid::uid()) ^ Instant::now().as_ticks();
    RCC.ahb2enr().modify(|w| w.set_rngen(true));
    // Enabling the clock takes two cycles; earlier writes are lost.
    RCC.ahb2enr().read();
    RNG.cr().modify(|w| w.set_rngen(true));
    (0..2).fold(own, |seed, _| seed.rotate_left(32) ^ u64::from(random_word().unwrap_or(0)))
}

fn random_word() -> Option<u32> {
    // A word takes 40 cycles of 48 MHz.
    (0..10_000).find(|_| RNG.sr().read().drdy()).map(|_| RNG.dr().read())
}
