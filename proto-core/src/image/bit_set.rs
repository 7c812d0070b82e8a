//! Sets of single bits of byte inputs, such as those that a device writes or those still to be sent.

use super::InputSet;
use crate::sysvar::{BIT_INPUT_COUNT, SysVar};

const _: () = assert!(BIT_INPUT_COUNT * 8 <= 128);

/// A set of bits of byte inputs, or the values of all of them. Other variables are ignored.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub(crate) struct BitSet(u128);

impl BitSet {
    pub(crate) const EMPTY: Self = Self(0);

    /// The bits of one variable.
    pub(crate) fn of(var: SysVar, mask: u8) -> Self {
        match place(var) {
            Some(place) => Self(u128::from(mask).wrapping_shl(place)),
            None => Self::EMPTY,
        }
    }

    /// All bits of these variables.
    pub(crate) fn all_of(vars: &InputSet) -> Self {
        vars.iter().fold(Self::EMPTY, |all, var| all.or(Self::of(var, u8::MAX)))
    }

    /// The variable's bits that are in the set, or its value.
    pub(crate) fn byte(self, var: SysVar) -> u8 {
        place(var).map_or(0, |place| self.0.wrapping_shr(place) as u8)
    }

    /// The set with the bits in `mask` of a variable replaced by those of `value`.
    #[must_use]
    pub(crate) fn with(self, var: SysVar, mask: u8, value: u8) -> Self {
        self.minus(Self::of(var, mask)).or(Self::of(var, mask & value))
    }

    #[must_use]
    pub(crate) const fn and(self, other: Self) -> Self {
        Self(self.0 & other.0)
    }

    #[must_use]
    pub(crate) const fn or(self, other: Self) -> Self {
        Self(self.0 | other.0)
    }

    /// The bits in this set but not in the other.
    #[must_use]
    pub(crate) const fn minus(self, other: Self) -> Self {
        Self(self.0 & !other.0)
    }

    pub(crate) const fn is_empty(self) -> bool {
        self.0 == 0
    }
}

/// Position of the variable's lowest bit. Byte inputs come first in the table.
fn place(var: SysVar) -> Option<u32> {
    (var.ordinal() < BIT_INPUT_COUNT).then(|| var.ordinal().wrapping_mul(8) as u32)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn each_bit_has_a_place_of_its_own() {
        let mut all = BitSet::EMPTY;
        for var in SysVar::all().take(BIT_INPUT_COUNT) {
            for bit in 0..8 {
                let one = BitSet::of(var, 1 << bit);
                assert!(!one.is_empty() && all.and(one).is_empty());
                assert_eq!(one.byte(var), 1 << bit);
                all = all.or(one);
            }
        }
        assert_eq!(all, BitSet::all_of(&InputSet::BYTES));
        let (first, word) = (SysVar::from_ordinal(0).unwrap(), SysVar::parse("WordInputReg[1]").unwrap());
        assert!(BitSet::of(word, 0xFF).is_empty() && all.byte(word) == 0);
        assert_eq!(all.with(first, 0x0F, 0xF5).byte(first), 0xF5);
        assert_eq!(all.minus(BitSet::of(first, 0xF0)).byte(first), 0x0F);
    }
}
