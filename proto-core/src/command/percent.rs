//! A speed in percent, and its text.
//!
//! In: a number, or its decimal text. Out: the other. `core`'s parsing and printing of floats is not used: it takes
//! about 20 KiB, with panics that no compiler can remove.

use core::fmt;

use super::text::{CountingWriter, trim_str};
use crate::wire::ascii::split_once;

/// A speed in percent, above 0 and at most 100.
#[derive(Debug, Clone, Copy, PartialEq, PartialOrd)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct Percent(f32);

impl Percent {
    /// `percent` if it is above 0 and at most 100.
    pub fn new(percent: f32) -> Option<Self> {
        (percent > 0.0 && percent <= 100.0).then_some(Self(percent))
    }

    /// The value, such as 50.0.
    pub const fn value(self) -> f32 {
        self.0
    }

    /// Parses a decimal text, ignoring surrounding blanks, to the nearest binary32; only its first 19 digits decide.
    /// Values below 1e-30 are refused.
    pub fn parse(text: &str) -> Option<Self> {
        Self::new(Decimal::parse(trim_str(text))?.nearest()?)
    }

    /// The shortest decimal number that parses to this speed, with at most 30 decimals.
    fn decimal(self) -> Decimal {
        let is_same = |decimal: &Decimal| decimal.nearest() == Some(self.0);
        let mut all = (0..MAX_DECIMALS).map(|decimals| Decimal::round(self.0, decimals));
        all.find(is_same).unwrap_or_else(|| Decimal::round(self.0, MAX_DECIMALS))
    }

    pub(super) fn write(self, writer: &mut CountingWriter<'_>) {
        self.decimal().bytes().for_each(|byte| writer.push(&[byte]));
    }
}

impl fmt::Display for Percent {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        use fmt::Write;
        self.decimal().bytes().try_for_each(|byte| f.write_char(char::from(byte)))
    }
}

/// `digits` with a decimal point before the last `decimals` digits.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
struct Decimal {
    digits: u64,
    decimals: u32,
    /// The number has more digits, and not all of them are 0.
    more: bool,
}

impl Decimal {
    /// Parses a number. `None` if it is not a number above 0, or far above the range of a speed.
    fn parse(text: &str) -> Option<Self> {
        let (number, exponent) = match text.split_once(['e', 'E']) {
            Some((number, exponent)) => (number, exponent.parse().ok()?),
            None => (text, 0_i32),
        };
        let number = number.strip_prefix('+').unwrap_or(number);
        let (whole, fraction) = split_once(number, b'.').unwrap_or((number, ""));
        if whole.is_empty() && fraction.is_empty() {
            return None;
        }
        let (mut digits, mut more) = (0_u64, false);
        let mut decimals = exponent.saturating_neg();
        let whole = whole.bytes().map(|byte| (byte, 0));
        for (byte, behind_the_point) in whole.chain(fraction.bytes().map(|byte| (byte, 1))) {
            let digit = char::from(byte).to_digit(10)?;
            if digits < ENOUGH {
                digits = digits.saturating_mul(10).saturating_add(u64::from(digit));
                decimals = decimals.saturating_add(behind_the_point);
            } else {
                more |= digit != 0;
                decimals = decimals.saturating_sub(1).saturating_add(behind_the_point);
            }
        }
        // Bounded by the range of u64, because `digits` is not 0.
        while digits != 0 && decimals < 0 {
            digits = digits.checked_mul(10)?;
            decimals = decimals.saturating_add(1);
        }
        while digits != 0 && decimals > MAX_DECIMALS as i32 {
            more |= !digits.is_multiple_of(10);
            digits /= 10;
            decimals = decimals.saturating_sub(1);
        }
        (digits != 0).then_some(Self { digits, decimals: decimals.unsigned_abs(), more })
    }

    /// Rounds `value`, above 0 and at most 100, to this many decimals.
    fn round(value: f32, decimals: u32) -> Self {
        let bits = value.to_bits();
        let (exponent, fraction) = (bits >> FRACTION_BITS, bits & FRACTION);
        // The value is mantissa / 2^shift.
        let (mantissa, exponent) =
            if exponent == 0 { (fraction, 1) } else { (fraction | HIDDEN_BIT, exponent) };
        let shift = 150_u32.saturating_sub(exponent);
        let scaled = u128::from(mantissa).saturating_mul(10_u128.saturating_pow(decimals));
        let half = 1_u128.unbounded_shl(shift.saturating_sub(1));
        let digits = scaled.saturating_add(half).unbounded_shr(shift);
        Self { digits: u64::try_from(digits).unwrap_or(u64::MAX), decimals, more: false }
    }

    fn nearest(self) -> Option<f32> {
        let digits = u128::from(self.digits);
        let divisor = 10_u128.saturating_pow(self.decimals);
        // At most 126, so that 2^-shift is a normal number.
        let shift = digits.leading_zeros().min(126);
        let scaled = digits.unbounded_shl(shift);
        let quotient = scaled.checked_div(divisor)?;
        let inexact = self.more || scaled.checked_rem(divisor) != Some(0);
        // The quotient has more than 26 bits, so ORing into the last one only distinguishes a tie between two binary32
        // from a number above it.
        let unit = f32::from_bits(127_u32.saturating_sub(shift) << FRACTION_BITS);
        Some((quotient | u128::from(inexact)) as f32 * unit)
    }

    fn bytes(self) -> impl Iterator<Item = u8> {
        let length = self.digits.checked_ilog10().unwrap_or(0);
        (0..=length.max(self.decimals)).rev().flat_map(move |place| {
            let unit = 10_u64.checked_pow(place);
            let digit = unit.and_then(|unit| self.digits.checked_div(unit)).unwrap_or(0) % 10;
            let point = (place == self.decimals && place != 0).then_some(b'.');
            core::iter::once(b'0'.saturating_add(digit as u8)).chain(point)
        })
    }
}

/// More decimals than any speed needs; 10^30 times a binary32's mantissa still fits in 128 bits.
const MAX_DECIMALS: u32 = 30;
/// Ten times this number plus a digit fits in 64 bits; this many digits distinguish all binary32 numbers.
const ENOUGH: u64 = 1_000_000_000_000_000_000;

const FRACTION_BITS: u32 = 23;
const FRACTION: u32 = HIDDEN_BIT - 1;
const HIDDEN_BIT: u32 = 1 << FRACTION_BITS;

#[cfg(test)]
mod tests {
    use std::prelude::rust_2024::*;

    use proptest::prelude::*;

    use super::*;

    fn percent(value: f32) -> Option<Percent> {
        Some(Percent::new(value).expect("a valid speed"))
    }

    #[test]
    fn speeds_are_above_0_and_at_most_100() {
        for good in [0.01, 1.0, 50.0, 99.9, 100.0] {
            assert_eq!(Percent::new(good).map(Percent::value), Some(good));
        }
        for bad in [0.0, -1.0, 100.1, f32::NAN, f32::INFINITY, f32::NEG_INFINITY] {
            assert_eq!(Percent::new(bad), None);
        }
        for text in
            ["", "x", "nan", "inf", "0", "-5", "101", "5%", "5 0", ".", "+", "1.2.3", "++5", "e1", "5e"]
        {
            assert_eq!(Percent::parse(text), None, "{text}");
        }
        assert_eq!(Percent::parse(" 50 "), percent(50.0));
        assert_eq!(Percent::parse("0.5"), percent(0.5));
        assert_eq!(Percent::parse(".5"), percent(0.5));
        assert_eq!(Percent::parse("+5."), percent(5.0));
        assert_eq!(Percent::parse("5e1"), percent(50.0));
        assert_eq!(Percent::parse("0.0005E+5"), percent(50.0));
        assert_eq!(Percent::parse("0e999999999"), None);
        assert_eq!(Percent::parse("1e-2147483648"), None);
    }

    #[test]
    fn long_texts_are_rounded_once() {
        // 64 + 1 / 2^18 is half-way between two binary32.
        assert_eq!(Percent::parse("64.00000381469726562"), percent(64.0));
        assert_eq!(Percent::parse("64.00000381469726563"), percent(64.000_01));
        assert_eq!(Percent::parse(&format!("12.5{}9", "0".repeat(60))), percent(12.5));
        assert_eq!(Percent::parse(&format!("{}10", "0".repeat(99))), percent(10.0));
    }

    #[test]
    fn what_is_written_is_short() {
        for (value, text) in [(50.0, "50"), (100.0, "100"), (0.5, "0.5"), (12.25, "12.25"), (0.1, "0.1")] {
            assert_eq!(Percent::new(value).expect("a speed").to_string(), text);
        }
        let least = Percent::new(f32::from_bits(1)).expect("a speed").to_string();
        assert_eq!(least, format!("0.{}", "0".repeat(30)), "too small to be written");
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(4096))]

        #[test]
        fn texts_mean_what_they_mean_to_core(text in "[+]?[0-9]{0,24}(\\.[0-9]{0,24})?([eE][+-]?[0-2]?[0-9])?") {
            let expected = text.parse().ok().filter(|value| *value >= 1e-11).and_then(Percent::new);
            let got = Percent::parse(&text).filter(|percent| percent.value() >= 1e-11);
            prop_assert_eq!(got, expected);
        }

        #[test]
        fn every_speed_is_written_as_core_writes_it(bits in 0.000_001_f32.to_bits()..=100.0_f32.to_bits()) {
            let value = f32::from_bits(bits);
            let speed = Percent::new(value).expect("a speed");
            let text = speed.to_string();
            prop_assert_eq!(Percent::parse(&text), Some(speed));
            prop_assert_eq!(text, value.to_string());
        }
    }
}
