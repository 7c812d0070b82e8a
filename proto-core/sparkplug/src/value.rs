//! Values of metrics, and their types.

use proto_core::time::Instant;

/// The type of a metric, with its code in Sparkplug B.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[repr(u8)]
pub enum DataType {
    /// Signed, 64 bits.
    Int64 = 4,
    /// Unsigned, 8 bits.
    UInt8 = 5,
    /// Unsigned, 16 bits.
    UInt16 = 6,
    /// Unsigned, 32 bits.
    UInt32 = 7,
    /// Unsigned, 64 bits.
    UInt64 = 8,
    /// IEEE 754, 32 bits.
    Float = 9,
    /// IEEE 754, 64 bits.
    Double = 10,
    /// True or false.
    Boolean = 11,
    /// UTF-8.
    String = 12,
}

/// The value of a metric.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Value {
    /// Signed, 64 bits.
    Int64(i64),
    /// Unsigned, 8 bits.
    UInt8(u8),
    /// Unsigned, 16 bits.
    UInt16(u16),
    /// Unsigned, 32 bits.
    UInt32(u32),
    /// Unsigned, 64 bits.
    UInt64(u64),
    /// IEEE 754, 32 bits; sent as unknown unless it is finite.
    Float(f32),
    /// IEEE 754, 64 bits; sent as unknown unless it is finite.
    Double(f64),
    /// True or false.
    Boolean(bool),
    /// One of several fixed words, of type [`DataType::String`].
    Word(&'static str),
}

impl Value {
    /// Its type.
    pub const fn data_type(self) -> DataType {
        match self {
            Self::Int64(_) => DataType::Int64,
            Self::UInt8(_) => DataType::UInt8,
            Self::UInt16(_) => DataType::UInt16,
            Self::UInt32(_) => DataType::UInt32,
            Self::UInt64(_) => DataType::UInt64,
            Self::Float(_) => DataType::Float,
            Self::Double(_) => DataType::Double,
            Self::Boolean(_) => DataType::Boolean,
            Self::Word(_) => DataType::String,
        }
    }

    /// The value, unless it is a float that is not finite.
    pub(crate) fn known(self) -> Option<Self> {
        match self {
            Self::Float(value) if !value.is_finite() => None,
            Self::Double(value) if !value.is_finite() => None,
            other => Some(other),
        }
    }

    /// Whether the difference to `other` is large enough to publish: more than `dead_band` for numbers.
    pub(crate) fn differs(self, other: Self, dead_band: f64) -> bool {
        match (self.number(), other.number()) {
            (Some(one), Some(two)) if dead_band > 0.0 => (one - two).abs() > dead_band,
            _ => self != other,
        }
    }

    fn number(self) -> Option<f64> {
        match self {
            Self::Int64(value) => Some(value as f64),
            Self::UInt8(value) => Some(value.into()),
            Self::UInt16(value) => Some(value.into()),
            Self::UInt32(value) => Some(value.into()),
            Self::UInt64(value) => Some(value as f64),
            Self::Float(value) => Some(value.into()),
            Self::Double(value) => Some(value),
            Self::Boolean(_) | Self::Word(_) => None,
        }
    }
}

/// A value that may be unknown; its type is stored elsewhere. Takes less memory than `Option<Value>`: a node has many.
#[derive(Debug, Clone, Copy)]
pub(crate) enum StoredValue {
    Unknown,
    /// The bits of a number, the low half first.
    Bits([u32; 2]),
    Word(&'static str),
}

impl StoredValue {
    pub(crate) fn of(value: Option<Value>) -> Self {
        let bits = match value {
            None => return Self::Unknown,
            Some(Value::Word(word)) => return Self::Word(word),
            Some(Value::Int64(value)) => value.cast_unsigned(),
            Some(Value::UInt8(value)) => value.into(),
            Some(Value::UInt16(value)) => value.into(),
            Some(Value::UInt32(value)) => value.into(),
            Some(Value::UInt64(value)) => value,
            Some(Value::Float(value)) => value.to_bits().into(),
            Some(Value::Double(value)) => value.to_bits(),
            Some(Value::Boolean(value)) => value.into(),
        };
        Self::Bits(halves(bits))
    }

    pub(crate) fn get(self, data_type: DataType) -> Option<Value> {
        let halves = match self {
            Self::Unknown => return None,
            Self::Word(word) => return Some(Value::Word(word)),
            Self::Bits(halves) => halves,
        };
        let (bits, [low, _]) = (whole(halves), halves);
        Some(match data_type {
            DataType::Int64 => Value::Int64(bits.cast_signed()),
            DataType::UInt8 => Value::UInt8(low as u8),
            DataType::UInt16 => Value::UInt16(low as u16),
            DataType::UInt32 => Value::UInt32(low),
            DataType::UInt64 => Value::UInt64(bits),
            DataType::Float => Value::Float(f32::from_bits(low)),
            DataType::Double => Value::Double(f64::from_bits(bits)),
            DataType::Boolean => Value::Boolean(low != 0),
            DataType::String => return None,
        })
    }
}

/// An instant with an alignment of only 4 bytes.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Stamp([u32; 2]);

impl Stamp {
    /// Stands for [`Instant::NEVER`].
    pub(crate) const NEVER: Self = Self(halves(Instant::NEVER.as_micros()));

    pub(crate) const fn of(at: Instant) -> Self {
        Self(halves(at.as_micros()))
    }

    pub(crate) const fn get(self) -> Instant {
        Instant::from_micros(whole(self.0))
    }
}

/// Splits 64 bits into halves, the low one first.
const fn halves(bits: u64) -> [u32; 2] {
    [bits as u32, (bits >> 32) as u32]
}

const fn whole([low, high]: [u32; 2]) -> u64 {
    (high as u64) << 32 | low as u64
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_stored_comes_back() {
        let values = [
            Value::Int64(-2),
            Value::Int64(i64::MIN),
            Value::UInt8(255),
            Value::UInt16(65_535),
            Value::UInt32(u32::MAX),
            Value::UInt64(u64::MAX - 1),
            Value::Float(-0.25),
            Value::Double(1e-300),
            Value::Boolean(true),
            Value::Boolean(false),
            Value::Word("working"),
        ];
        for value in values {
            assert_eq!(StoredValue::of(Some(value)).get(value.data_type()), Some(value));
            assert_eq!(StoredValue::of(None).get(value.data_type()), None);
        }
        for at in [Instant::ZERO, Instant::from_micros(1 << 40 | 7), Instant::NEVER] {
            assert_eq!(Stamp::of(at).get(), at);
        }
    }

    #[test]
    fn a_dead_band_is_for_numbers_and_does_not_count_itself() {
        let float = Value::Float;
        assert!(!float(1.0).differs(float(1.5), 0.5));
        assert!(float(1.0).differs(float(1.6), 0.5));
        assert!(float(1.0).differs(float(1.000_001), 0.0));
        assert!(!float(1.0).differs(float(1.0), 0.0));
        assert!(Value::Boolean(true).differs(Value::Boolean(false), 9.0));
        assert!(Value::Word("a").differs(Value::Word("b"), 9.0));
        // Above 2^53, `f64` cannot represent every integer.
        assert!(Value::UInt64(u64::MAX).differs(Value::UInt64(u64::MAX - 1), 0.0));
    }

    #[test]
    fn no_number_is_unknown() {
        assert_eq!(Value::Float(f32::NAN).known(), None);
        assert_eq!(Value::Double(f64::INFINITY).known(), None);
        assert_eq!(Value::Float(0.5).known(), Some(Value::Float(0.5)));
    }
}
