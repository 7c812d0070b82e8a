//! Timing of a serial line (docs/wire/modbus-rtu.md section 2).

use crate::time::Duration;

/// Character times of a line, and the silences that the standard requires.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct Timing {
    baud: u32,
    bits: u8,
    silence: Duration,
    turnaround: Duration,
}

impl Timing {
    /// Above this rate, in bit/s, the silences are [`Self::FAST_T1_5`] and [`Self::FAST_T3_5`], whatever the character
    /// time.
    pub const FAST: u32 = 19_200;
    /// Replaces 1.5 characters above [`Self::FAST`].
    pub const FAST_T1_5: Duration = Duration::from_micros(750);
    /// Replaces 3.5 characters above [`Self::FAST`].
    pub const FAST_T3_5: Duration = Duration::from_micros(1_750);
    /// The turnaround that [`Self::new`] sets; the standard has 100 to 200 ms.
    pub const TURNAROUND: Duration = Duration::from_millis(100);

    /// Timing of a line with `baud` bit/s and `bits` bits per character: start, data, parity and stop bits, 11 in the
    /// standard. A value of 0 counts as 1.
    pub const fn new(baud: u32, bits: u8) -> Self {
        let baud = if baud == 0 { 1 } else { baud };
        let bits = if bits == 0 { 1 } else { bits };
        let silence = if baud > Self::FAST { Self::FAST_T3_5 } else { half_characters(baud, bits, 7) };
        Self { baud, bits, silence, turnaround: Self::TURNAROUND }
    }

    /// Sets another silence between frames, for callers that cannot see 3.5 characters because an operating system or a
    /// USB adapter delivers bytes with gaps.
    #[must_use]
    pub const fn with_silence(self, silence: Duration) -> Self {
        Self { silence, ..self }
    }

    /// Sets another delay after a broadcast.
    #[must_use]
    pub const fn with_turnaround(self, turnaround: Duration) -> Self {
        Self { turnaround, ..self }
    }

    /// The standard's longest silence within a frame: 1.5 characters, or 750 µs above 19200 bit/s. Nothing is rejected
    /// because of it; see docs/wire/modbus-rtu.md section 2.
    pub const fn t1_5(&self) -> Duration {
        if self.baud > Self::FAST { Self::FAST_T1_5 } else { half_characters(self.baud, self.bits, 3) }
    }

    /// The silence between frames: 3.5 characters, or 1750 µs above 19200 bit/s, unless set by [`Self::with_silence`].
    pub const fn silence(&self) -> Duration {
        self.silence
    }

    /// How long nothing is sent after a broadcast.
    pub const fn turnaround(&self) -> Duration {
        self.turnaround
    }

    /// The time that `len` characters take on the line, rounded up.
    pub const fn of(&self, len: usize) -> Duration {
        half_characters(self.baud, self.bits, (len as u64).saturating_mul(2))
    }
}

/// The time of this many half characters, rounded up to the microsecond.
const fn half_characters(baud: u32, bits: u8, halves: u64) -> Duration {
    let half_bits = halves.saturating_mul(bits as u64).saturating_mul(1_000_000);
    let rate = (baud as u64).saturating_mul(2);
    let rounded_up = half_bits.saturating_add(rate.saturating_sub(1));
    Duration::from_micros(match rounded_up.checked_div(rate) {
        Some(micros) => micros,
        None => u64::MAX,
    })
}
