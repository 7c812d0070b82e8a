//! Reception: sampling, errors of characters, and idle detection.

use super::registers::*;
use super::{FIFO, Usart};
use crate::device::*;

impl Usart {
    pub(super) fn receive(&mut self, at: &Context<'_>) {
        let is_on = self.has(CR1, UE | RE) && self.pins.rx.is(at.functions, self.pins.function);
        let bit = self.bit(at.clocks);
        let bits = self.data_bits();
        // From the start bit to the middle of the first stop bit, and to its last sample.
        let middle = Picos::from(bits + 1) * bit + bit / 2;
        let sampled = middle + spread(bit);
        loop {
            let start = match self.receiving {
                Some(start) => start,
                None => match self.line.start_bit(at.now) {
                    Some(start) => start,
                    None => break,
                },
            };
            // A character that starts earlier prevents idle detection.
            self.idles = self.idles.filter(|idle| *idle <= start);
            // All of it is sampled at once, the start bit too: a glitch is not a start bit.
            if at.now < start + sampled {
                self.receiving = Some(start);
                break;
            }
            self.receiving = None;
            let sample = |index: u32| self.sample(start + Picos::from(index) * bit + bit / 2, bit);
            let level = |index: u32| sample(index).0;
            if level(0) || !is_on {
                self.line.consume(start + bit);
                continue;
            }
            let word = (0..bits).fold(0_u32, |word, index| word | u32::from(level(index + 1)) << index);
            let is_stopped = level(bits + 1);
            let is_noisy = (0..=bits + 1).any(|index| sample(index).1);
            self.line.consume(start + sampled);
            let mut flags = if is_stopped { 0 } else { FE } | if is_noisy { NE } else { 0 };
            let data = word & !(1 << (bits - 1));
            if let Some(parity) = self.parity_bit(data as u8)
                && (word >> (bits - 1) & 1 != 0) != parity
            {
                flags |= PE;
            }
            if self.received.len() == FIFO {
                self.flags |= ORE;
            } else {
                self.received.push_back((word as u16, flags));
            }
            self.idles = Some(start + middle + self.character(at.clocks));
        }
        if let Some(idle) = self.idles
            && at.now >= idle
        {
            self.idles = None;
            self.flags |= IDLE;
        }
    }

    /// The majority of a bit's three samples, and whether they disagree (RM0433, "Noise error"); `middle` is the
    /// time of the second.
    fn sample(&self, middle: Picos, bit: Picos) -> (bool, bool) {
        let levels = [middle - spread(bit), middle, middle + spread(bit)].map(|at| self.line.level(at));
        if self.has(CR3, ONEBIT) {
            return (levels[1], false);
        }
        let highs = levels.into_iter().filter(|level| *level).count();
        (highs >= 2, highs % 3 != 0)
    }
}

/// Time between two samples of a bit (oversampling by 16).
pub(super) fn spread(bit: Picos) -> Picos {
    bit / 16
}
