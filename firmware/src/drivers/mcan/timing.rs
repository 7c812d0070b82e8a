//! The bit timing of a CAN controller.

use core::fmt;

/// The nominal bit time.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct BitTiming {
    /// Clock cycles per time quantum, 1..=512.
    pub prescaler: u16,
    /// Quanta between the synchronisation segment and the sample point, 2..=256.
    pub before_sample: u16,
    /// Quanta after the sample point, 2..=128; also the synchronisation jump width.
    pub behind_sample: u16,
}

/// The bit rate cannot be derived from the clock.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct BitrateError {
    /// Requested bit rate, in bit/s.
    pub bitrate: u32,
    /// The controller's kernel clock, in Hz.
    pub clock: u32,
}

impl fmt::Display for BitrateError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{} bit/s cannot be made from {} Hz", self.bitrate, self.clock)
    }
}

impl core::error::Error for BitrateError {}

impl BitTiming {
    /// The timing with the shortest possible quanta and the sample point at 7/8 of the bit, as CiA recommends.
    ///
    /// # Errors
    /// [`BitrateError`] if the bit rate would be off by more than 0.1 %.
    pub fn of(bitrate: u32, clock: u32) -> Result<Self, BitrateError> {
        let error = BitrateError { bitrate, clock };
        let cycles = clock.saturating_add(bitrate / 2).checked_div(bitrate).ok_or(error)?;
        let made = clock.checked_div(cycles).ok_or(error)?;
        if made.abs_diff(bitrate) > bitrate / 1_000 {
            return Err(error);
        }
        (1..=512_u16)
            .filter(|&prescaler| cycles.is_multiple_of(u32::from(prescaler)))
            .find_map(|prescaler| {
                let quanta = cycles / u32::from(prescaler);
                if !(8..=MAX_QUANTA).contains(&quanta) {
                    return None;
                }
                let behind_sample = (quanta.saturating_add(4) / 8).max(2);
                let before_sample = quanta.saturating_sub(behind_sample).saturating_sub(1);
                Some(Self {
                    prescaler,
                    before_sample: before_sample as u16,
                    behind_sample: behind_sample as u16,
                })
            })
            .ok_or(error)
    }

    /// The value of register NBTP, in which each field is one less than its meaning. The jump width is the largest
    /// possible one, to tolerate inaccurate clocks.
    pub(super) fn register(self) -> u32 {
        let less_one = |value: u16| u32::from(value.saturating_sub(1));
        let jump = less_one(self.behind_sample);
        jump << 25
            | less_one(self.prescaler) << 16
            | less_one(self.before_sample) << 8
            | less_one(self.behind_sample)
    }
}

/// Maximum number of quanta per bit: at most 257 are possible up to the sample point, which is at 7/8 of the bit.
const MAX_QUANTA: u32 = 292;

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn usual_speeds_of_80_mhz_are_exact_and_sampled_at_seven_eighths() {
        for bitrate in [10_000, 20_000, 50_000, 100_000, 125_000, 250_000, 500_000, 800_000, 1_000_000] {
            let timing = BitTiming::of(bitrate, 80_000_000).unwrap();
            let quanta = 1 + u32::from(timing.before_sample) + u32::from(timing.behind_sample);
            assert_eq!(quanta * u32::from(timing.prescaler) * bitrate, 80_000_000, "{timing:?}");
            let sample = (1 + u32::from(timing.before_sample)) * 1000 / quanta;
            assert!((870..=880).contains(&sample), "{bitrate}: sampled at {sample} per mille");
            assert!(timing.before_sample <= 256 && (2..=128).contains(&timing.behind_sample), "{timing:?}");
        }
    }

    #[test]
    fn register_of_500_kbit() {
        // 160 quanta: 1 + 139 + 20, jump 20, prescaler 1.
        let timing = BitTiming { prescaler: 1, before_sample: 139, behind_sample: 20 };
        assert_eq!(BitTiming::of(500_000, 80_000_000), Ok(timing));
        assert_eq!(timing.register(), 19 << 25 | 138 << 8 | 19);
    }

    #[test]
    fn a_speed_that_is_off_is_refused() {
        assert!(BitTiming::of(83_333, 80_000_000).is_ok());
        let refused = BitTiming::of(990_000, 80_000_000);
        assert_eq!(refused, Err(BitrateError { bitrate: 990_000, clock: 80_000_000 }));
        assert!(BitTiming::of(0, 80_000_000).is_err());
        assert!(BitTiming::of(500_000, 0).is_err());
    }
}
