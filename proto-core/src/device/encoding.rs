//! Encoding of one field of a device's frame: numbers in any byte order, bits, BCD, digits.
//!
//! In: the field's bytes, or a number. Out: the other. Does not know the field's position in the frame or the meaning
//! of its value.

use core::fmt;
use core::ops::RangeInclusive;

use super::order::ByteOrder;
use crate::image::round;
use crate::wire::scalar::{Scalar, ScalarType};

/// Maximum number of characters of a decimal number, sign and point included.
pub const MAX_DIGITS: usize = 16;

/// How a field is encoded.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
pub struct Encoding {
    /// How the bytes are interpreted.
    pub kind: Kind,
    /// Byte order. Ignored for digits, which are read from left to right.
    pub order: ByteOrder,
    /// The field begins where the previous one began: for other bits of the same number, or a second use of the same
    /// bytes.
    pub shared: bool,
}

/// How the bytes of a field are interpreted.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
#[non_exhaustive]
pub enum Kind {
    /// A scalar type, as in recipes.
    Scalar(ScalarType),
    /// Unsigned, three bytes.
    Uint24,
    /// Signed, three bytes, two's complement.
    Int24,
    /// Packed decimal digits, two a byte.
    Bcd {
        /// Number of bytes, 1..=4.
        bytes: u8,
    },
    /// Decimal digits in ASCII, with a sign if negative.
    Decimal(Digits),
    /// Hexadecimal digits in ASCII, at most eight; written in upper case.
    Hex(Width),
    /// Some bits of an unsigned number.
    Bits(Bits),
}

/// A decimal number in ASCII.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
pub struct Digits {
    /// Number of characters.
    pub width: Width,
    /// Number of digits written after the point; 0 writes no point. Received numbers may have a point or not.
    pub decimals: u8,
}

/// Number of characters of a field.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
pub enum Width {
    /// Exactly this many, 1..=16; written with leading zeros.
    Fixed(u8),
    /// All before this byte, which follows the field; at most 16.
    Until(u8),
}

/// Up to 32 bits of a number of 1 to 8 bytes; the lowest is bit 0.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
pub struct Bits {
    /// Length of the number in bytes, 1..=8.
    pub bytes: u8,
    /// The lowest bit.
    pub first: u8,
    /// Number of bits, 1..=32.
    pub count: u8,
    /// The highest bit is a sign.
    pub signed: bool,
}

/// Why the bytes of a field cannot be read.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
#[non_exhaustive]
pub enum Unreadable {
    /// Too few or too many bytes.
    Length,
    /// A character or half byte that is not a digit.
    NotADigit,
    /// The number is too large for its kind.
    TooLarge,
}

impl fmt::Display for Unreadable {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Length => "the field has too few or too many bytes",
            Self::NotADigit => "the field has a character that is not a digit",
            Self::TooLarge => "the field has too many digits",
        })
    }
}

impl core::error::Error for Unreadable {}

/// What happens to a number that is out of a field's or variable's range.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
pub enum Overflow {
    /// A received frame with such a number is rejected; a sent frame gets the nearest number in range.
    #[default]
    Usual,
    /// It wraps around, like a counter. Integers only.
    Wrap,
}

impl Encoding {
    const fn of(kind: Kind) -> Self {
        Self { kind, order: ByteOrder::Little, shared: false }
    }

    /// A value of this type, lowest byte first, as in recipes.
    pub const fn scalar(ty: ScalarType) -> Self {
        Self::of(Kind::Scalar(ty))
    }

    /// Unsigned, three bytes.
    pub const fn uint24() -> Self {
        Self::of(Kind::Uint24)
    }

    /// Signed, three bytes.
    pub const fn int24() -> Self {
        Self::of(Kind::Int24)
    }

    /// Packed decimal digits, two a byte; 1..=4 bytes.
    pub const fn bcd(bytes: u8) -> Self {
        Self::of(Kind::Bcd { bytes })
    }

    /// A decimal number of this many ASCII characters, 1..=16.
    pub const fn decimal(width: u8) -> Self {
        Self::of(Kind::Decimal(Digits { width: Width::Fixed(width), decimals: 0 }))
    }

    /// A decimal number in ASCII that ends before the byte `end`.
    pub const fn decimal_until(end: u8) -> Self {
        Self::of(Kind::Decimal(Digits { width: Width::Until(end), decimals: 0 }))
    }

    /// A hexadecimal number of this many ASCII digits, 1..=8.
    pub const fn hex(width: u8) -> Self {
        Self::of(Kind::Hex(Width::Fixed(width)))
    }

    /// A hexadecimal number in ASCII that ends before the byte `end`.
    pub const fn hex_until(end: u8) -> Self {
        Self::of(Kind::Hex(Width::Until(end)))
    }

    /// These bits of a number of this type: a byte, word or dword.
    pub const fn bits(ty: ScalarType, bits: RangeInclusive<u8>) -> Self {
        let (first, last) = (*bits.start(), *bits.end());
        let count = last.saturating_add(1).saturating_sub(first);
        Self::of(Kind::Bits(Bits { bytes: ty.size() as u8, first, count, signed: false }))
    }

    /// One bit of a number of this type.
    pub const fn bit(ty: ScalarType, bit: u8) -> Self {
        Self::bits(ty, bit..=bit)
    }

    /// Sets the byte order: highest byte first.
    pub const fn big_endian(self) -> Self {
        self.ordered(ByteOrder::Big)
    }

    /// Sets the byte order.
    pub const fn ordered(self, order: ByteOrder) -> Self {
        Self { order, ..self }
    }

    /// These bits of a number of `bytes` bytes; signals of CAN databases are bits of all eight.
    pub const fn bits_of(bytes: u8, bits: RangeInclusive<u8>) -> Self {
        let (first, last) = (*bits.start(), *bits.end());
        let count = last.saturating_sub(first).saturating_add(1);
        Self::of(Kind::Bits(Bits { bytes, first, count, signed: false }))
    }

    /// Makes the field begin where the previous one began: for other bits of the same number, or a second use of the
    /// same bytes.
    pub const fn shared(self) -> Self {
        Self { shared: true, ..self }
    }

    /// Makes the highest bit a sign. No effect on other kinds.
    pub const fn signed(mut self) -> Self {
        if let Kind::Bits(bits) = &mut self.kind {
            bits.signed = true;
        }
        self
    }

    /// Sets the number of digits written after the point. No effect on other kinds.
    pub const fn decimals(mut self, decimals: u8) -> Self {
        if let Kind::Decimal(digits) = &mut self.kind {
            digits.decimals = decimals;
        }
        self
    }

    /// Number of bytes in the frame, without a terminating byte; `None` if it varies.
    pub const fn size(&self) -> Option<usize> {
        Some(match self.kind {
            Kind::Scalar(ty) => ty.size(),
            Kind::Uint24 | Kind::Int24 => 3,
            Kind::Bcd { bytes } | Kind::Bits(Bits { bytes, .. }) => bytes as usize,
            Kind::Decimal(Digits { width: Width::Fixed(width), .. }) | Kind::Hex(Width::Fixed(width)) => {
                width as usize
            }
            Kind::Decimal(_) | Kind::Hex(_) => return None,
        })
    }

    /// The byte that terminates the field, if its length varies.
    pub const fn until(&self) -> Option<u8> {
        match self.kind {
            Kind::Decimal(Digits { width: Width::Until(end), .. }) | Kind::Hex(Width::Until(end)) => {
                Some(end)
            }
            _ => None,
        }
    }

    /// Whether the field consists of ASCII digits.
    pub const fn is_digits(&self) -> bool {
        matches!(self.kind, Kind::Decimal(_) | Kind::Hex(_))
    }

    /// Whether all received values are integers. Not so for decimal digits, which may always have a point.
    pub const fn reads_integers(&self) -> bool {
        self.is_integer() && !matches!(self.kind, Kind::Decimal(_))
    }

    /// Whether all sent values are integers.
    pub const fn is_integer(&self) -> bool {
        match self.kind {
            Kind::Scalar(ty) => !matches!(ty, ScalarType::Float | ScalarType::Double),
            Kind::Decimal(Digits { decimals, .. }) => decimals == 0,
            Kind::Uint24 | Kind::Int24 | Kind::Bcd { .. } | Kind::Hex(_) | Kind::Bits(_) => true,
        }
    }

    /// The smallest and the largest number that can be encoded.
    pub fn range(&self) -> (f64, f64) {
        match self.kind {
            Kind::Scalar(ty) => ty.range(),
            Kind::Uint24 => (0.0, f64::from(0x00FF_FFFF)),
            Kind::Int24 => (f64::from(-0x0080_0000), f64::from(0x007F_FFFF)),
            Kind::Bcd { bytes } => (0.0, power_of_ten(bytes.saturating_mul(2)) - 1.0),
            Kind::Hex(Width::Fixed(width)) => (0.0, mask(width.saturating_mul(4)) as f64),
            Kind::Hex(Width::Until(_)) => (0.0, f64::from(u32::MAX)),
            Kind::Bits(bits) if bits.signed => {
                let half = mask(bits.count.saturating_sub(1)) as f64;
                (-half - 1.0, half)
            }
            Kind::Bits(bits) => (0.0, mask(bits.count) as f64),
            Kind::Decimal(Digits { width, decimals }) => {
                let width = match width {
                    Width::Fixed(width) => width.min(MAX_DIGITS as u8),
                    Width::Until(_) => MAX_DIGITS as u8,
                };
                let point = if decimals == 0 { 0 } else { decimals.saturating_add(1) };
                let unit = power_of_ten(decimals);
                // Sixteen digits exceed the precision of a binary64.
                let digits = width.saturating_sub(point).saturating_add(decimals);
                let most = |digits: u8| (power_of_ten(digits.min(15)) - 1.0) / unit;
                (-most(digits.saturating_sub(1)), most(digits))
            }
        }
    }

    /// Rounds `value` and brings it into range. `None` for NaN, or if it should wrap and has more than 53 bits.
    pub fn fit(&self, value: f64, overflow: Overflow) -> Option<f64> {
        let (low, high) = self.range();
        if value.is_nan() {
            return None;
        }
        let value = if self.is_integer() { round(value) } else { value };
        match overflow {
            Overflow::Wrap if self.is_integer() => wrap(value, low, high),
            _ if value < low => Some(low),
            _ if value > high => Some(high),
            _ => Some(value),
        }
    }

    /// Decodes a field's bytes, without the terminating byte. A float may be infinite or NaN.
    ///
    /// # Errors
    /// [`Unreadable`]: a wrong length, a character that is not a digit, or too many digits.
    pub fn read(&self, bytes: &[u8]) -> Result<Scalar, Unreadable> {
        if self.size().is_some_and(|len| len != bytes.len()) {
            return Err(Unreadable::Length);
        }
        let raw = || self.order.read(bytes);
        Ok(match self.kind {
            Kind::Scalar(ty) => scalar(ty, raw()),
            Kind::Uint24 => Scalar::Dword(raw() as u32),
            Kind::Int24 => Scalar::Int(sign_extended(raw() as u32, 24)),
            Kind::Bits(bits) => {
                let value = (raw() & bits.mask()).unbounded_shr(u32::from(bits.first)) as u32;
                if bits.signed { Scalar::Int(sign_extended(value, bits.count)) } else { Scalar::Dword(value) }
            }
            Kind::Bcd { bytes } => {
                let raw = raw();
                let mut value = 0_u32;
                for digit in (0..u32::from(bytes).saturating_mul(2)).rev() {
                    let digit = raw.unbounded_shr(digit.saturating_mul(4)) as u32 & 0xF;
                    if digit > 9 {
                        return Err(Unreadable::NotADigit);
                    }
                    value = value.wrapping_mul(10).wrapping_add(digit);
                }
                Scalar::Dword(value)
            }
            Kind::Hex(_) => Scalar::Dword(read_hex(bytes)?),
            Kind::Decimal(_) => read_decimal(bytes)?,
        })
    }

    /// Writes `value`, which [`Self::fit`] returned, to the front of `out` and returns the number of bytes; the caller
    /// writes a terminating byte. Bits are added to those in `out`. `None`, with nothing written, if `out` is too
    /// short.
    pub fn write(&self, value: f64, out: &mut [u8]) -> Option<usize> {
        let len = self.size().unwrap_or(0);
        let raw = match self.kind {
            Kind::Scalar(ScalarType::Float) => u64::from((value as f32).to_bits()),
            Kind::Scalar(ScalarType::Double) => value.to_bits(),
            Kind::Scalar(_) | Kind::Uint24 | Kind::Int24 => value as i64 as u64,
            Kind::Bits(bits) => {
                let field = out.get(..len)?;
                let value = (value as i64 as u64).unbounded_shl(u32::from(bits.first)) & bits.mask();
                self.order.read(field) | value
            }
            Kind::Bcd { bytes } => {
                let digits = u32::from(bytes).saturating_mul(2);
                let (_, raw) = (0..digits).fold((value as u32, 0_u64), |(left, raw), digit| {
                    let next = u64::from(left % 10).unbounded_shl(digit.saturating_mul(4));
                    (left / 10, raw | next)
                });
                raw
            }
            Kind::Hex(width) => return write_digits(value as i64, 16, width, 0, out),
            Kind::Decimal(Digits { width, decimals }) => {
                let scaled = round(value * power_of_ten(decimals));
                return write_digits(scaled as i64, 10, width, decimals, out);
            }
        };
        self.order.write(raw, out.get_mut(..len)?);
        Some(len)
    }
}

impl Bits {
    /// The mask of the bits in the number.
    pub(super) const fn mask(&self) -> u64 {
        (mask(self.count) as u64).unbounded_shl(self.first as u32)
    }

    /// The mask of the bits in the number's bytes, in this order; the first byte is the lowest.
    pub(super) fn places(&self, order: ByteOrder) -> u64 {
        let mut bytes = [0; 8];
        order.write(self.mask(), bytes.get_mut(..usize::from(self.bytes)).unwrap_or(&mut []));
        u64::from_le_bytes(bytes)
    }
}

impl From<ScalarType> for Encoding {
    fn from(ty: ScalarType) -> Self {
        Self::scalar(ty)
    }
}

/// A mask of the lowest `bits` bits.
const fn mask(bits: u8) -> u32 {
    u32::MAX.unbounded_shr(32_u32.saturating_sub(bits as u32))
}

fn sign_extended(value: u32, bits: u8) -> i32 {
    let unused = 32_u32.saturating_sub(u32::from(bits));
    value.unbounded_shl(unused).cast_signed().unbounded_shr(unused)
}

fn power_of_ten(power: u8) -> f64 {
    (0..power).fold(1.0, |product, _| product * 10.0)
}

fn scalar(ty: ScalarType, raw: u64) -> Scalar {
    match ty {
        ScalarType::Byte => Scalar::Byte(raw as u8),
        ScalarType::Char => Scalar::Char(raw as i8),
        ScalarType::Word => Scalar::Word(raw as u16),
        ScalarType::Short => Scalar::Short(raw as i16),
        ScalarType::Dword => Scalar::Dword(raw as u32),
        ScalarType::Int => Scalar::Int(raw as i32),
        ScalarType::Float => Scalar::Float(f32::from_bits(raw as u32)),
        ScalarType::Double => Scalar::Double(f64::from_bits(raw)),
    }
}

/// Wraps an integer, or an infinite number, into a range of integers.
pub(crate) fn wrap(value: f64, low: f64, high: f64) -> Option<f64> {
    // A binary64 cannot represent all larger integers.
    if !(-9.0e15..=9.0e15).contains(&value) {
        return None;
    }
    let span = (high - low) as i64;
    let above = (value - low) as i64;
    above.checked_rem_euclid(span.saturating_add(1)).map(|above| above as f64 + low)
}

fn read_hex(bytes: &[u8]) -> Result<u32, Unreadable> {
    if bytes.is_empty() {
        return Err(Unreadable::Length);
    }
    bytes.iter().try_fold(0_u32, |value, &digit| {
        let digit = (digit as char).to_digit(16).ok_or(Unreadable::NotADigit)?;
        let shifted = value.checked_mul(16).ok_or(Unreadable::TooLarge)?;
        Ok(shifted | digit)
    })
}

/// Accepts blanks before the number, a sign, digits, and an optional point with digits after it.
fn read_decimal(bytes: &[u8]) -> Result<Scalar, Unreadable> {
    let bytes = bytes.trim_ascii_start();
    let (negative, digits) = match bytes {
        [b'-', digits @ ..] => (true, digits),
        [b'+', digits @ ..] => (false, digits),
        digits => (false, digits),
    };
    // Scales send blanks between the sign and the number.
    let digits = digits.trim_ascii();
    let (mut value, mut decimals, mut count, mut has_point) = (0_u64, 0_u8, 0_u8, false);
    for &byte in digits {
        match byte {
            b'.' if !has_point => has_point = true,
            b'0'..=b'9' => {
                let digit = u64::from(byte.wrapping_sub(b'0'));
                value = value
                    .checked_mul(10)
                    .and_then(|value| value.checked_add(digit))
                    .ok_or(Unreadable::TooLarge)?;
                decimals = decimals.saturating_add(u8::from(has_point));
                count = count.saturating_add(1);
            }
            _ => return Err(Unreadable::NotADigit),
        }
    }
    if count == 0 {
        return Err(Unreadable::NotADigit);
    }
    // A binary64 represents all smaller integers exactly.
    if value >= 1 << 53 {
        return Err(Unreadable::TooLarge);
    }
    let signed = if negative { -(value as f64) } else { value as f64 };
    Ok(match i32::try_from(value) {
        Ok(_) if decimals == 0 => Scalar::Int(signed as i32),
        _ => Scalar::Double(signed / power_of_ten(decimals)),
    })
}

fn write_digits(value: i64, base: u64, width: Width, decimals: u8, out: &mut [u8]) -> Option<usize> {
    let mut digits = [b'0'; MAX_DIGITS];
    let mut left = value.unsigned_abs();
    let mut used = 0_usize;
    let sign = usize::from(value < 0);
    let least = match width {
        Width::Fixed(width) => usize::from(width),
        // A digit before the point.
        Width::Until(_) if decimals > 0 => usize::from(decimals).saturating_add(2).saturating_add(sign),
        Width::Until(_) => sign.saturating_add(1),
    };
    for at in (0..MAX_DIGITS).rev() {
        let is_point = decimals > 0 && used == usize::from(decimals);
        if left == 0 && used.saturating_add(sign) >= least && !is_point {
            break;
        }
        let slot = digits.get_mut(at)?;
        if is_point {
            *slot = b'.';
        } else {
            let digit = left.checked_rem(base)? as u32;
            *slot = char::from_digit(digit, 16)?.to_ascii_uppercase() as u8;
            left = left.checked_div(base)?;
        }
        used = used.saturating_add(1);
    }
    if value < 0 {
        *digits.get_mut(MAX_DIGITS.saturating_sub(used).checked_sub(1)?)? = b'-';
        used = used.saturating_add(1);
    }
    let text = digits.get(MAX_DIGITS.saturating_sub(used)..)?;
    for (slot, &digit) in out.get_mut(..used)?.iter_mut().zip(text) {
        *slot = digit;
    }
    Some(used)
}

#[cfg(test)]
mod tests;
