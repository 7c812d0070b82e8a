//! Times of a line (docs/wire/modbus-rtu.md section 2).

use crate::time::Duration;

/// How long things take on a line, and the silences that the standard asks for.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct Timing {
    baud: u32,
    bits: u8,
    silence: Duration,
    turnaround: Duration,
}

impl Timing {
    /// Above this rate, in bit/s, the silences are [`Self::FAST_T1_5`] and [`Self::FAST_T3_5`]
    /// whatever a character takes.
    pub const FAST: u32 = 19_200;
    /// The 1.5 characters of a fast line.
    pub const FAST_T1_5: Duration = Duration::from_micros(750);
    /// The 3.5 characters of a fast line.
    pub const FAST_T3_5: Duration = Duration::from_micros(1_750);
    /// The time after a broadcast that [`Self::new`] gives the slaves; the standard's is 100 to
    /// 200 ms.
    pub const TURNAROUND: Duration = Duration::from_millis(100);

    /// Times of a line with `baud` bit/s and characters of `bits` bits: start, data, parity and
    /// stop bits, 11 in the standard. A rate or a character of 0 counts as 1.
    pub const fn new(baud: u32, bits: u8) -> Self {
        let baud = if baud == 0 { 1 } else { baud };
        let bits = if bits == 0 { 1 } else { bits };
        let silence = if baud > Self::FAST { Self::FAST_T3_5 } else { half_characters(baud, bits, 7) };
        Self { baud, bits, silence, turnaround: Self::TURNAROUND }
    }

    /// The same with another silence between frames, where the caller cannot see 3.5 characters:
    /// bytes that come through an operating system or a USB adapter come with gaps.
    #[must_use]
    pub const fn with_silence(self, silence: Duration) -> Self {
        Self { silence, ..self }
    }

    /// The same with another delay after a broadcast.
    #[must_use]
    pub const fn with_turnaround(self, turnaround: Duration) -> Self {
        Self { turnaround, ..self }
    }

    /// The longest silence within a frame by the standard: 1.5 characters, or 750 µs above 19200
    /// bit/s. Nothing is refused because of it; see docs/wire/modbus-rtu.md section 2.
    pub const fn t1_5(&self) -> Duration {
        if self.baud > Self::FAST { Self::FAST_T1_5 } else { half_characters(self.baud, self.bits, 3) }
    }

    /// The silence between frames: 3.5 characters, or 1750 µs above 19200 bit/s, unless
    /// [`Self::with_silence`] says otherwise.
    pub const fn silence(&self) -> Duration {
        self.silence
    }

    /// How long nothing is sent after a broadcast.
    pub const fn turnaround(&self) -> Duration {
        self.turnaround
    }

    /// The time that `len` bytes take on the line, rounded up.
    pub const fn of(&self, len: usize) -> Duration {
        half_characters(self.baud, self.bits, (len as u64).saturating_mul(2))
    }
}

/// The time of so many halves of a character, rounded up to the microsecond.
const fn half_characters(baud: u32, bits: u8, halves: u64) -> Duration {
    let half_bits = halves.saturating_mul(bits as u64).saturating_mul(1_000_000);
    let rate = (baud as u64).saturating_mul(2);
    let rounded_up = half_bits.saturating_add(rate.saturating_sub(1));
    Duration::from_micros(match rounded_up.checked_div(rate) {
        Some(micros) => micros,
        None => u64::MAX,
    })
}
