//! Formats numbers in error texts like `{}` of `core`: with the fewest digits that parse as the same number, and
//! without an exponent. `core`'s implementation has tables and panics and takes 10 KB of a board's flash; this one is
//! small and slow.
//!
//! In: a number. Out: its text. The algorithm is the free-format one of Steele and White, "How to Print Floating-Point
//! Numbers Accurately" (1990), with integers of up to 1152 bits.

use core::cmp::Ordering;
use core::fmt::{self, Write};

/// A number whose `Display` gives the same text as that of `core`.
#[derive(Debug, Clone, Copy)]
pub(crate) enum Decimal {
    Single(f32),
    Double(f64),
}

/// A finite number above zero: `mantissa * 2^exponent`.
struct BinaryFloat {
    mantissa: u64,
    exponent: i32,
    /// The next smaller number is only half as far away as the next larger one.
    is_closer_below: bool,
}

impl BinaryFloat {
    /// Decodes `bits`, which have no sign, in a format with these numbers of mantissa and exponent bits.
    fn of(bits: u64, mantissa_bits: u32, exponent_bits: u32) -> Self {
        let implied = 1_u64 << mantissa_bits;
        let fraction = bits & implied.wrapping_sub(1);
        let biased = (bits >> mantissa_bits) as i32;
        let bias =
            (1_i32 << exponent_bits.wrapping_sub(1)).wrapping_sub(2).wrapping_add(mantissa_bits as i32);
        Self {
            mantissa: if biased == 0 { fraction } else { fraction | implied },
            exponent: biased.max(1).wrapping_sub(bias).wrapping_sub(1),
            is_closer_below: fraction == 0 && biased > 1,
        }
    }
}

impl fmt::Display for Decimal {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let (value, parts) = match *self {
            Self::Single(value) => {
                (f64::from(value), BinaryFloat::of((value.to_bits() & !(1 << 31)).into(), 23, 8))
            }
            Self::Double(value) => (value, BinaryFloat::of(value.to_bits() & !(1 << 63), 52, 11)),
        };
        if value.is_nan() {
            return f.write_str("NaN");
        }
        if value.is_sign_negative() {
            f.write_char('-')?;
        }
        match () {
            () if value.is_infinite() => f.write_str("inf"),
            () if value == 0.0 => f.write_char('0'),
            () => write_shortest(&parts, f),
        }
    }
}

/// Writes the digits, with zeros or a point where needed.
fn write_shortest(parts: &BinaryFloat, out: &mut impl Write) -> fmt::Result {
    let is_even = parts.mantissa & 1 == 0;
    // All are numerators over `unit`: the number, and half the distances to its neighbours.
    let shift = parts.exponent.max(0) as u32;
    let extra = u32::from(parts.is_closer_below);
    let mut rest = Big::of(parts.mantissa, shift.wrapping_add(1).wrapping_add(extra));
    let mut below = Big::of(1, shift);
    let mut above = Big::of(1, shift.wrapping_add(extra));
    let mut unit = Big::of(1, parts.exponent.min(0).unsigned_abs().wrapping_add(1).wrapping_add(extra));
    // Number of digits before the point; if negative, the number of zeros after it.
    let mut before = 0_i32;
    while reaches(&rest, &above, &unit, is_even) {
        unit.times_ten();
        before = before.wrapping_add(1);
    }
    while before <= 0 && !reaches_in_tenths(&rest, &above, &unit, is_even) {
        [&mut rest, &mut below, &mut above].into_iter().for_each(Big::times_ten);
        before = before.wrapping_sub(1);
    }
    if before <= 0 {
        out.write_str("0.")?;
        (before..0).try_for_each(|_| out.write_char('0'))?;
    }
    loop {
        [&mut rest, &mut below, &mut above].into_iter().for_each(Big::times_ten);
        let mut digit = b'0';
        while rest.cmp(&unit) != Ordering::Less {
            rest.subtract(&unit);
            digit = digit.wrapping_add(1);
        }
        let is_low_enough = match rest.cmp(&below) {
            Ordering::Less => true,
            Ordering::Equal => is_even,
            Ordering::Greater => false,
        };
        let is_high_enough = reaches(&rest, &above, &unit, is_even);
        if !is_low_enough && !is_high_enough {
            out.write_char(digit.into())?;
            before = before.wrapping_sub(1);
            if before == 0 {
                out.write_char('.')?;
            }
            continue;
        }
        // The nearer of the last digits that are possible; the upper one in a tie.
        let is_up = is_high_enough && (!is_low_enough || rest.doubled().cmp(&unit) != Ordering::Less);
        out.write_char(digit.wrapping_add(is_up.into()).into())?;
        return (1..before).try_for_each(|_| out.write_char('0'));
    }
}

/// Whether `number + more` is at least one, or, if not `is_even`, more than one.
fn reaches(number: &Big, more: &Big, unit: &Big, is_even: bool) -> bool {
    match number.plus(more).cmp(unit) {
        Ordering::Less => false,
        Ordering::Equal => is_even,
        Ordering::Greater => true,
    }
}

fn reaches_in_tenths(number: &Big, more: &Big, unit: &Big, is_even: bool) -> bool {
    let mut sum = number.plus(more);
    sum.times_ten();
    match sum.cmp(unit) {
        Ordering::Less => false,
        Ordering::Equal => is_even,
        Ordering::Greater => true,
    }
}

/// Enough for twice the smallest and the largest 64-bit number, in tenths.
const WORDS: usize = 36;

/// An integer of 32 × [`WORDS`] bits, lowest word first.
#[derive(Clone, Copy)]
struct Big([u32; WORDS]);

impl Big {
    /// `number * 2^shift`.
    fn of(number: u64, shift: u32) -> Self {
        let mut words = [0; WORDS];
        let (skipped, bits) = ((shift / 32) as usize, shift % 32);
        let wide = u128::from(number) << bits;
        let parts = [wide as u32, (wide >> 32) as u32, (wide >> 64) as u32];
        for (word, part) in words.iter_mut().skip(skipped).zip(parts) {
            *word = part;
        }
        Self(words)
    }

    fn times_ten(&mut self) {
        let mut carried = 0;
        for word in &mut self.0 {
            let product = u64::from(*word).wrapping_mul(10).wrapping_add(carried);
            *word = product as u32;
            carried = product >> 32;
        }
    }

    fn plus(&self, other: &Self) -> Self {
        let (mut sum, mut carried) = (*self, 0);
        for (word, more) in sum.0.iter_mut().zip(&other.0) {
            let total = u64::from(*word).wrapping_add((*more).into()).wrapping_add(carried);
            *word = total as u32;
            carried = total >> 32;
        }
        sum
    }

    fn doubled(&self) -> Self {
        self.plus(self)
    }

    /// `other` must not be larger.
    fn subtract(&mut self, other: &Self) {
        let mut is_borrowed = false;
        for (word, less) in self.0.iter_mut().zip(&other.0) {
            let (difference, first) = word.overflowing_sub(*less);
            let (difference, second) = difference.overflowing_sub(is_borrowed.into());
            *word = difference;
            is_borrowed = first || second;
        }
    }

    fn cmp(&self, other: &Self) -> Ordering {
        self.0.iter().rev().cmp(other.0.iter().rev())
    }
}

#[cfg(test)]
mod tests {
    use std::format;

    use proptest::prelude::*;

    use super::*;

    #[track_caller]
    fn check(value: f64) {
        assert_eq!(format!("{}", Decimal::Double(value)), format!("{value}"));
        let value = value as f32;
        assert_eq!(format!("{}", Decimal::Single(value)), format!("{value}"));
    }

    proptest! {
        #[test]
        fn every_number_is_written_as_core_writes_it(bits in any::<u64>(), short in any::<f32>(), tenths in any::<i32>()) {
            check(f64::from_bits(bits));
            check(f64::from_bits(bits & !0xFFFF_FFFF));
            check(short.into());
            check(f64::from(tenths) / 10.0);
        }
    }

    #[test]
    fn ends_and_powers() {
        let ends = [f64::MIN, f64::MAX, f64::MIN_POSITIVE, 5e-324, f64::INFINITY, f64::NAN, 0.0, -0.0];
        let short = [f32::MIN, f32::MAX, f32::MIN_POSITIVE, 1e-45].map(f64::from);
        ends.into_iter().chain(short).for_each(check);
        for exponent in 0..2047_u64 {
            for bits in [exponent << 52, (exponent << 52) + 1, (exponent << 52).saturating_sub(1)] {
                check(f64::from_bits(bits));
            }
        }
        (-320..309).for_each(|power| check(format!("1e{power}").parse().unwrap()));
    }
}
