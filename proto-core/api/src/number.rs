//! Numbers as decimal text. The formatting in `core` takes 10 KB of a board's flash, and contains panics that the
//! optimiser does not remove.
//!
//! The shortest text of an `f32` is found as in Raffaello Giulietti, "The Schubfach way to render doubles" (2020), with
//! the names of that paper: `q`, `k` and `h` are exponents, `g` is a power of ten.

use core::fmt;

use heapless::String;

/// An unsigned integer.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Whole(pub(crate) u64);

impl fmt::Display for Whole {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let mut room = [0; 20];
        f.write_str(digits(self.0, &mut room).ok_or(fmt::Error)?)
    }
}

/// A signed integer.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Signed(pub(crate) i64);

impl fmt::Display for Signed {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        if self.0 < 0 {
            f.write_str("-")?;
        }
        Whole(self.0.unsigned_abs()).fmt(f)
    }
}

/// Writes the digits of a number at the end of `room`.
fn digits(number: u64, room: &mut [u8; 20]) -> Option<&str> {
    let (mut rest, mut start) = (number, room.len());
    for (place, digit) in room.iter_mut().enumerate().rev() {
        let last;
        // Most numbers are short, and a board does 64-bit divisions in software.
        (rest, last) = match u32::try_from(rest) {
            Ok(rest) => ((rest / 10).into(), (rest % 10) as u8),
            Err(_) => (rest / 10, (rest % 10) as u8),
        };
        *digit = b'0' | last;
        start = place;
        if rest == 0 {
            break;
        }
    }
    str::from_utf8(room.get(start..)?).ok()
}

/// An `f32` as the shortest text that parses to the same number, as `{:?}` writes it: with a point or an exponent.
/// Numbers that are not finite have no such text.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Shortest(pub(crate) f32);

impl fmt::Display for Shortest {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let sign = if self.0.is_sign_negative() { "-" } else { "" };
        f.write_str(sign)?;
        if self.0 == 0.0 {
            return f.write_str("0.0");
        }
        let mut text = String::new();
        place_point(shortest(self.0.to_bits() & !SIGN), &mut text).ok_or(fmt::Error)?;
        f.write_str(&text)
    }
}

/// Writes `digits * 10^power`, with an exponent outside of 0.0001 to 10^16.
fn place_point((mut number, mut power): (u32, i32), text: &mut String<32>) -> Option<()> {
    while number != 0 && number % 10 == 0 {
        number /= 10;
        power = power.saturating_add(1);
    }
    let mut room = [0; 20];
    let digits = digits(number.into(), &mut room)?;
    // The number of digits before the point, if the number has that many.
    let before = power.saturating_add(digits.len() as i32);
    let zeros = |text: &mut String<32>, count: i32| (0..count).try_for_each(|_| text.push('0').ok());
    match usize::try_from(before) {
        _ if !(-3..=16).contains(&before) => {
            let (first, rest) = digits.split_at_checked(1)?;
            text.push_str(first).ok()?;
            if !rest.is_empty() {
                text.push('.').ok()?;
                text.push_str(rest).ok()?;
            }
            text.push_str(if before < 1 { "e-" } else { "e" }).ok()?;
            let mut room = [0; 20];
            text.push_str(self::digits(before.saturating_sub(1).unsigned_abs().into(), &mut room)?).ok()?;
        }
        Err(_) | Ok(0) => {
            text.push_str("0.").ok()?;
            zeros(text, before.saturating_neg())?;
            text.push_str(digits).ok()?;
        }
        Ok(place) => match digits.split_at_checked(place).filter(|(_, behind)| !behind.is_empty()) {
            Some((whole, behind)) => {
                text.push_str(whole).ok()?;
                text.push('.').ok()?;
                text.push_str(behind).ok()?;
            }
            None => {
                text.push_str(digits).ok()?;
                zeros(text, power)?;
                text.push_str(".0").ok()?;
            }
        },
    }
    Some(())
}

/// The number with these bits, which must be positive and finite, as `digits * 10^power`.
fn shortest(bits: u32) -> (u32, i32) {
    let (exponent, fraction) = ((bits >> 23) as i32, bits & 0x7F_FFFF);
    let (c, q) = match exponent {
        0 => (fraction, -149),
        _ => (1 << 23 | fraction, exponent.saturating_sub(150)),
    };
    // Below a power of two, neighbouring numbers are only half as far apart.
    let is_closer_below = fraction == 0 && exponent > 1;
    let is_odd = c & 1;
    // floor(log10(2^q)), or floor(log10(3/4 * 2^q)).
    let k = q.wrapping_mul(1_262_611).wrapping_sub(if is_closer_below { 524_031 } else { 0 }) >> 22;
    // floor(log2(10^-k)).
    let h = q.wrapping_add(k.wrapping_mul(-1_741_647) >> 19).wrapping_add(1) as u32;
    let g = POWERS.get(FIRST_POWER.wrapping_add(k) as usize).copied().unwrap_or(0);
    let scaled = |quarters: u32| round_to_odd(g, quarters.wrapping_shl(h));
    let four = c.wrapping_mul(4);
    // Four times the number, and the bounds of the interval that rounds to it, in units of 10^k.
    let value = scaled(four);
    let lower = scaled(four.wrapping_sub(if is_closer_below { 1 } else { 2 })).wrapping_add(is_odd);
    let upper = scaled(four.wrapping_add(2)).wrapping_sub(is_odd);
    let s = value / 4;
    if s >= 10 {
        // One digit fewer, if exactly one of the two neighbours is in the interval.
        let tens = s / 10;
        let (below, above) = (tens.wrapping_mul(40), tens.wrapping_mul(40).wrapping_add(40));
        if (lower <= below) != (above <= upper) {
            return (tens.wrapping_add(u32::from(above <= upper)), k.wrapping_add(1));
        }
    }
    let (below, above) = (s.wrapping_mul(4), s.wrapping_mul(4).wrapping_add(4));
    if (lower <= below) != (above <= upper) {
        return (s.wrapping_add(u32::from(above <= upper)), k);
    }
    // The nearer one; of two equally near, the upper one, as `core` does.
    (s.wrapping_add(u32::from(value >= below.wrapping_add(2))), k)
}

/// `g * factor / 2^64`, with the lowest bit set if the result is not exact.
fn round_to_odd(g: u64, factor: u32) -> u32 {
    let part = |bits: u64| (bits & 0xFFFF_FFFF).wrapping_mul(factor.into());
    let product = part(g >> 32).wrapping_add(part(g) >> 32);
    (product >> 32) as u32 | u32::from(product as u32 > 1)
}

const SIGN: u32 = 1 << 31;
/// Powers of ten from 10^45 down to 10^-31, as their first 64 bits, rounded up.
static POWERS: [u64; 77] = powers();
/// The index of 10^0 in `POWERS`.
const FIRST_POWER: i32 = 45;

#[expect(clippy::arithmetic_side_effects, clippy::indexing_slicing, reason = "carried out by the compiler")]
const fn powers() -> [u64; 77] {
    let mut all = [0; 77];
    let mut at = 0;
    while at < all.len() {
        all[at] = power(FIRST_POWER - at as i32);
        at += 1;
    }
    all
}

/// The first 64 bits of 10^exponent, rounded up.
#[expect(clippy::arithmetic_side_effects, reason = "carried out by the compiler")]
const fn power(exponent: i32) -> u64 {
    // 10^n is 5^n times a power of two.
    let five = 5_u128.pow(exponent.unsigned_abs());
    let bits = u128::BITS - five.leading_zeros();
    if exponent >= 0 {
        return match bits.checked_sub(64) {
            Some(more) => (five >> more) as u64 + (five.trailing_zeros() < more) as u64,
            None => (five as u64) << (64 - bits),
        };
    }
    // 2^(63 + bits) divided by the power of five.
    let (mut rest, mut quotient, mut bit) = (1_u128 << (bits - 1), 0_u64, 0);
    while bit < 64 {
        rest *= 2;
        let fits = rest >= five;
        quotient = quotient << 1 | fits as u64;
        rest -= if fits { five } else { 0 };
        bit += 1;
    }
    quotient + 1
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;
    use std::format;

    #[track_caller]
    fn check(bits: u32) {
        let number = f32::from_bits(bits);
        if number.is_finite() {
            assert_eq!(format!("{}", Shortest(number)), format!("{number:?}"), "{bits:08X}");
        }
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(20_000))]

        #[test]
        fn any_number_is_written_as_core_writes_it(bits in any::<u32>(), number in any::<u64>(), short in 0..64_u32) {
            check(bits);
            let number = number >> short;
            prop_assert_eq!(format!("{}", Whole(number)), format!("{number}"));
            let number = number as i64;
            prop_assert_eq!(format!("{}", Signed(number)), format!("{number}"));
        }
    }

    #[test]
    fn powers_of_two_and_their_neighbours() {
        for exponent in 0..255_u32 {
            for fraction in (0..23).map(|bit| 1 << bit).chain([0, 0x7F_FFFF, 0x55_5555]) {
                let bits: u32 = exponent << 23 | fraction;
                [bits.wrapping_sub(1), bits, bits + 1].into_iter().for_each(check);
            }
        }
    }

    #[test]
    fn numbers_that_people_write() {
        for number in
            [0.0, -0.0, 1.0, 0.1, -2.5, 100.0, 1e-4, 9.9e-5, 1e15, 1e16, 1e17, 123456.79, 16777216.0]
        {
            check(f32::to_bits(number));
        }
        for tenths in -100_000..100_000_i32 {
            check((tenths as f32 / 10.0).to_bits());
        }
    }

    #[test]
    #[ignore = "takes an hour in a debug build: cargo test --release"]
    fn every_number_of_32_bits() {
        (0..SIGN).for_each(check);
    }

    #[test]
    fn the_ends_of_the_powers_are_those_of_the_paper() {
        assert_eq!(
            (POWERS[45], POWERS[44], POWERS[76]),
            (1 << 63, 0xA000_0000_0000_0000, 0x81CE_B32C_4B43_FCF5)
        );
    }
}
