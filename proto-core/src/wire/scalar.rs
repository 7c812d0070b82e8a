//! The eight scalar types of recipe fields (docs/wire/recipes.md section 1).
//!
//! In: little-endian bytes or numbers. Out: the other. Does not know fields, frames or units.

use core::fmt;

use crate::decimal::Decimal;

/// A field's data type; the variants have the specification's names.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
pub enum ScalarType {
    /// Unsigned 8 bit: `u8`.
    #[doc(alias = "u8")]
    Byte,
    /// Signed 8 bit: `i8`.
    #[doc(alias = "i8")]
    Char,
    /// Unsigned 16 bit: `u16`.
    #[doc(alias = "u16")]
    Word,
    /// Signed 16 bit: `i16`.
    #[doc(alias = "i16")]
    Short,
    /// Unsigned 32 bit: `u32`.
    #[doc(alias = "u32")]
    Dword,
    /// Signed 32 bit: `i32`.
    #[doc(alias = "i32")]
    Int,
    /// IEEE-754 binary32: `f32`.
    #[doc(alias = "f32")]
    Float,
    /// IEEE-754 binary64: `f64`.
    #[doc(alias = "f64")]
    Double,
}

impl ScalarType {
    /// Every type, in the specification's order.
    pub const ALL: [Self; 8] =
        [Self::Byte, Self::Char, Self::Word, Self::Short, Self::Dword, Self::Int, Self::Float, Self::Double];

    /// Encoded size in bytes: 1, 2, 4 or 8.
    pub const fn size(self) -> usize {
        match self {
            Self::Byte | Self::Char => 1,
            Self::Word | Self::Short => 2,
            Self::Dword | Self::Int | Self::Float => 4,
            Self::Double => 8,
        }
    }

    /// The name used in configuration files and on the teach pendant.
    pub const fn name(self) -> &'static str {
        match self {
            Self::Byte => "byte",
            Self::Char => "char",
            Self::Word => "word",
            Self::Short => "short",
            Self::Dword => "dword",
            Self::Int => "int",
            Self::Float => "float",
            Self::Double => "double",
        }
    }

    /// The type with this name.
    pub fn from_name(name: &str) -> Option<Self> {
        Self::ALL.into_iter().find(|ty| ty.name() == name)
    }

    /// The smallest and the largest value of a field of this type.
    pub const fn range(self) -> (f64, f64) {
        match self {
            Self::Byte => (0.0, u8::MAX as f64),
            Self::Char => (i8::MIN as f64, i8::MAX as f64),
            Self::Word => (0.0, u16::MAX as f64),
            Self::Short => (i16::MIN as f64, i16::MAX as f64),
            Self::Dword => (0.0, u32::MAX as f64),
            Self::Int => (i32::MIN as f64, i32::MAX as f64),
            Self::Float => (f32::MIN as f64, f32::MAX as f64),
            Self::Double => (f64::MIN, f64::MAX),
        }
    }
}

impl fmt::Display for ScalarType {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.name())
    }
}

/// One typed value.
#[derive(Debug, Clone, Copy, PartialEq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
pub enum Scalar {
    /// Unsigned 8 bit.
    Byte(u8),
    /// Signed 8 bit.
    Char(i8),
    /// Unsigned 16 bit.
    Word(u16),
    /// Signed 16 bit.
    Short(i16),
    /// Unsigned 32 bit.
    Dword(u32),
    /// Signed 32 bit.
    Int(i32),
    /// IEEE-754 binary32.
    Float(f32),
    /// IEEE-754 binary64.
    Double(f64),
}

/// Why a number does not fit a [`ScalarType`].
#[derive(Debug, Clone, Copy, PartialEq)]
#[non_exhaustive]
pub enum ScalarError {
    /// The number is outside the type's range, or not finite.
    OutOfRange {
        /// The type.
        ty: ScalarType,
        /// The number.
        value: f64,
    },
    /// A number with a fraction for an integer type.
    NotWhole {
        /// The type.
        ty: ScalarType,
        /// The number.
        value: f64,
    },
}

impl fmt::Display for ScalarError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match *self {
            Self::OutOfRange { ty, value } => {
                let (low, high) = ty.range();
                let [value, low, high] = [value, low, high].map(Decimal::Double);
                write!(f, "{value} does not fit in a {ty} ({low}..={high})")
            }
            Self::NotWhole { ty, value } => {
                write!(f, "{} is not an integer, but a {ty} must be", Decimal::Double(value))
            }
        }
    }
}

impl core::error::Error for ScalarError {}

impl Scalar {
    /// Reads a value of type `ty` from the front of `bytes`; `None` if there are too few bytes.
    pub fn decode(ty: ScalarType, bytes: &[u8]) -> Option<Self> {
        Some(match ty {
            ScalarType::Byte => Self::Byte(*bytes.first()?),
            ScalarType::Char => Self::Char(i8::from_le_bytes([*bytes.first()?])),
            ScalarType::Word => Self::Word(u16::from_le_bytes(*bytes.first_chunk()?)),
            ScalarType::Short => Self::Short(i16::from_le_bytes(*bytes.first_chunk()?)),
            ScalarType::Dword => Self::Dword(u32::from_le_bytes(*bytes.first_chunk()?)),
            ScalarType::Int => Self::Int(i32::from_le_bytes(*bytes.first_chunk()?)),
            ScalarType::Float => Self::Float(f32::from_le_bytes(*bytes.first_chunk()?)),
            ScalarType::Double => Self::Double(f64::from_le_bytes(*bytes.first_chunk()?)),
        })
    }

    /// Writes the value to the front of `out` and returns its size; `None`, with nothing written,
    /// if `out` is too short.
    pub fn encode(self, out: &mut [u8]) -> Option<usize> {
        match self {
            Self::Byte(v) => *out.first_chunk_mut()? = v.to_le_bytes(),
            Self::Char(v) => *out.first_chunk_mut()? = v.to_le_bytes(),
            Self::Word(v) => *out.first_chunk_mut()? = v.to_le_bytes(),
            Self::Short(v) => *out.first_chunk_mut()? = v.to_le_bytes(),
            Self::Dword(v) => *out.first_chunk_mut()? = v.to_le_bytes(),
            Self::Int(v) => *out.first_chunk_mut()? = v.to_le_bytes(),
            Self::Float(v) => *out.first_chunk_mut()? = v.to_le_bytes(),
            Self::Double(v) => *out.first_chunk_mut()? = v.to_le_bytes(),
        }
        Some(self.ty().size())
    }

    /// The value's type.
    pub const fn ty(self) -> ScalarType {
        match self {
            Self::Byte(_) => ScalarType::Byte,
            Self::Char(_) => ScalarType::Char,
            Self::Word(_) => ScalarType::Word,
            Self::Short(_) => ScalarType::Short,
            Self::Dword(_) => ScalarType::Dword,
            Self::Int(_) => ScalarType::Int,
            Self::Float(_) => ScalarType::Float,
            Self::Double(_) => ScalarType::Double,
        }
    }

    /// The value as a number, which is exact for every type.
    pub const fn as_f64(self) -> f64 {
        match self {
            Self::Byte(v) => v as f64,
            Self::Char(v) => v as f64,
            Self::Word(v) => v as f64,
            Self::Short(v) => v as f64,
            Self::Dword(v) => v as f64,
            Self::Int(v) => v as f64,
            Self::Float(v) => v as f64,
            Self::Double(v) => v,
        }
    }

    /// Converts `value` to type `ty`. A `float` takes the nearest binary32; an integer type takes only integers in its
    /// range.
    ///
    /// # Errors
    /// [`ScalarError`] names the type and the number.
    pub fn from_f64(ty: ScalarType, value: f64) -> Result<Self, ScalarError> {
        let (low, high) = ty.range();
        if !(low..=high).contains(&value) {
            return Err(ScalarError::OutOfRange { ty, value });
        }
        // The casts below cannot saturate: the range was checked above.
        let (whole, scalar) = match ty {
            ScalarType::Byte => (value as u8 as f64, Self::Byte(value as u8)),
            ScalarType::Char => (value as i8 as f64, Self::Char(value as i8)),
            ScalarType::Word => (value as u16 as f64, Self::Word(value as u16)),
            ScalarType::Short => (value as i16 as f64, Self::Short(value as i16)),
            ScalarType::Dword => (value as u32 as f64, Self::Dword(value as u32)),
            ScalarType::Int => (value as i32 as f64, Self::Int(value as i32)),
            ScalarType::Float => (value, Self::Float(value as f32)),
            ScalarType::Double => (value, Self::Double(value)),
        };
        if whole == value { Ok(scalar) } else { Err(ScalarError::NotWhole { ty, value }) }
    }

    /// Whether the value is finite; always true for integers.
    pub const fn is_finite(self) -> bool {
        match self {
            Self::Float(v) => v.is_finite(),
            Self::Double(v) => v.is_finite(),
            _ => true,
        }
    }
}

impl fmt::Display for Scalar {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Byte(v) => v.fmt(f),
            Self::Char(v) => v.fmt(f),
            Self::Word(v) => v.fmt(f),
            Self::Short(v) => v.fmt(f),
            Self::Dword(v) => v.fmt(f),
            Self::Int(v) => v.fmt(f),
            Self::Float(v) => v.fmt(f),
            Self::Double(v) => v.fmt(f),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_type_survives_the_wire_at_both_ends_of_its_range() {
        for ty in ScalarType::ALL {
            let (low, high) = ty.range();
            for value in [low, 0.0, 1.0, high] {
                let scalar = Scalar::from_f64(ty, value).unwrap();
                let mut out = [0xA5; 9];
                assert_eq!(scalar.encode(&mut out), Some(ty.size()));
                assert_eq!(Scalar::decode(ty, &out), Some(scalar), "{ty} {value}");
                assert!(out[ty.size()..].iter().all(|&b| b == 0xA5), "{ty} wrote past its size");
                assert_eq!(Scalar::decode(ty, &out[..ty.size() - 1]), None);
                assert_eq!(scalar.encode(&mut out[..ty.size() - 1]), None);
            }
            assert_eq!(ScalarType::from_name(ty.name()), Some(ty));
        }
        assert_eq!(ScalarType::from_name("uint8"), None);
    }

    #[test]
    fn what_does_not_fit_is_refused_with_the_numbers() {
        let refused = Scalar::from_f64(ScalarType::Byte, 256.0);
        assert_eq!(refused, Err(ScalarError::OutOfRange { ty: ScalarType::Byte, value: 256.0 }));
        let refused = Scalar::from_f64(ScalarType::Short, 0.5);
        assert_eq!(refused, Err(ScalarError::NotWhole { ty: ScalarType::Short, value: 0.5 }));
        assert!(Scalar::from_f64(ScalarType::Double, f64::NAN).is_err());
        assert!(Scalar::from_f64(ScalarType::Float, 1e300).is_err());
    }
}
