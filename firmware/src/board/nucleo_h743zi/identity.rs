//! The board's address, and a seed for each start.

use embassy_stm32::pac::{RCC, RNG};
use embassy_stm32::uid;
use embassy_time::Instant;

pub(super) fn ethernet_address() -> [u8; 6] {
    firmware::identity::ethernet_address(&uid::uid())
}

/// A seed for local port numbers, from the chip's number, the time and the random number generator, which may
/// fail.
pub(crate) fn seed() -> u64 {
    let own = firmware::identity::hash(&uid::uid()) ^ Instant::now().as_ticks();
    start_generator();
    (0..2).fold(own, |seed, _| seed.rotate_left(32) ^ u64::from(random_word().unwrap_or(0)))
}

/// Random bytes; `None` if the generator fails or reports an earlier failure.
pub(super) fn random() -> Option<[u8; 32]> {
    start_generator();
    let mut bytes = [0; 32];
    let (words, _) = bytes.as_chunks_mut::<4>();
    let mut before = 0;
    for word in words {
        let random = random_word()?;
        // RM0433, "True random number generator": the first word after an error repeats the previous one, or is 0.
        if random == before {
            return None;
        }
        before = random;
        *word = random.to_le_bytes();
    }
    let state = RNG.sr().read();
    (!state.ceis() && !state.seis()).then_some(bytes)
}

fn start_generator() {
    RCC.ahb2enr().modify(|w| w.set_rngen(true));
    // Enabling the clock takes two cycles; writes to the generator before that are lost.
    RCC.ahb2enr().read();
    RNG.cr().modify(|w| w.set_rngen(true));
}

fn random_word() -> Option<u32> {
    // A word takes 40 cycles of 48 MHz.
    (0..10_000).find(|_| RNG.sr().read().drdy()).map(|_| RNG.dr().read())
}
