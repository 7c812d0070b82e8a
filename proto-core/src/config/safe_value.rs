//! The values that inputs take when their port times out.
//!
//! Plain data: nothing here has been checked.

use crate::sysvar::{SysVar, VarBit};
use crate::wire::scalar::Scalar;

/// The value that an input variable takes when its port times out.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct SafeValue {
    /// An input variable that the port owns, as a whole or some of its bits.
    pub var: SysVar,
    /// Its safe value.
    pub value: Scalar,
    /// The bits that the value is for: [`u8::MAX`] for a variable as a whole.
    pub mask: u8,
}

impl SafeValue {
    /// The safe value of a whole variable.
    pub const fn new(var: SysVar, value: Scalar) -> Self {
        Self { var, value, mask: u8::MAX }
    }

    /// The safe value of one bit; of a bit that the variable does not have, the mask is 0.
    pub fn bit(bit: VarBit, on: bool) -> Self {
        let mask = bit.mask().unwrap_or(0);
        Self { var: bit.var, value: Scalar::Byte(if on { mask } else { 0 }), mask }
    }

    /// Whether it is for a variable as a whole.
    pub const fn is_whole(&self) -> bool {
        self.mask == u8::MAX
    }
}

/// As images have it: a whole variable as ordinal and value, as they always had it; bits with
/// [`BITS`] in the ordinal, and their mask behind it.
#[cfg(feature = "serde")]
mod stored {
    use core::fmt;

    use serde::de::{Error, SeqAccess, Visitor};
    use serde::ser::SerializeTuple;
    use serde::{Deserialize, Deserializer, Serialize, Serializer};

    use super::SafeValue;
    use crate::sysvar::{INPUT_COUNT, SysVar};

    const BITS: u8 = 0x80;
    const _: () = assert!(INPUT_COUNT < BITS as usize);

    impl Serialize for SafeValue {
        fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
            let &Self { var, value, mask } = self;
            let ordinal = var.ordinal() as u8;
            if self.is_whole() {
                let mut tuple = serializer.serialize_tuple(2)?;
                tuple.serialize_element(&ordinal)?;
                tuple.serialize_element(&value)?;
                return tuple.end();
            }
            let mut tuple = serializer.serialize_tuple(3)?;
            tuple.serialize_element(&(ordinal | BITS))?;
            tuple.serialize_element(&mask)?;
            tuple.serialize_element(&value)?;
            tuple.end()
        }
    }

    impl<'de> Deserialize<'de> for SafeValue {
        fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
            deserializer.deserialize_tuple(3, Stored)
        }
    }

    struct Stored;

    impl<'de> Visitor<'de> for Stored {
        type Value = SafeValue;

        fn expecting(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
            f.write_str("a safe value")
        }

        fn visit_seq<A: SeqAccess<'de>>(self, mut seq: A) -> Result<SafeValue, A::Error> {
            let short = || A::Error::custom("a safe value is cut short");
            let ordinal: u8 = seq.next_element()?.ok_or_else(short)?;
            let var = SysVar::from_ordinal(usize::from(ordinal & !BITS))
                .ok_or_else(|| A::Error::custom("no system variable has this ordinal"))?;
            let mask = match ordinal & BITS {
                0 => u8::MAX,
                _ => seq.next_element()?.ok_or_else(short)?,
            };
            Ok(SafeValue { var, value: seq.next_element()?.ok_or_else(short)?, mask })
        }
    }
}
