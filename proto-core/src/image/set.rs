//! A set of input variables, as bits: what a frame carries, what is still to be written.

use crate::sysvar::{INPUT_COUNT, SysVar};

const WORDS: usize = INPUT_COUNT.div_ceil(32);

/// Some of the input variables. Output variables are never in it.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct InputSet([u32; WORDS]);

impl InputSet {
    /// The empty set.
    pub const EMPTY: Self = Self([0; WORDS]);

    /// The byte variables: they come first in the table of inputs.
    pub const BYTES: Self = Self([0x1FFF, 0, 0]);

    /// Adds an input variable; an output variable is ignored.
    pub fn insert(&mut self, var: SysVar) {
        if let Some((word, bit)) = self.slot(var) {
            *word |= bit;
        }
    }

    /// Removes a variable.
    pub fn remove(&mut self, var: SysVar) {
        if let Some((word, bit)) = self.slot(var) {
            *word &= !bit;
        }
    }

    /// Whether the variable is in the set.
    pub fn contains(&self, var: SysVar) -> bool {
        let ordinal = var.ordinal();
        ordinal < INPUT_COUNT && self.0.get(ordinal / 32).is_some_and(|word| word >> (ordinal % 32) & 1 == 1)
    }

    /// Whether nothing is in the set.
    pub fn is_empty(&self) -> bool {
        self.0.iter().all(|&word| word == 0)
    }

    /// How many variables are in the set.
    pub fn len(&self) -> usize {
        self.0.iter().fold(0, |sum, word| sum.saturating_add(word.count_ones() as usize))
    }

    /// What is in both.
    #[must_use]
    pub fn and(&self, other: &Self) -> Self {
        self.merge(other, |a, b| a & b)
    }

    /// What is in either.
    #[must_use]
    pub fn or(&self, other: &Self) -> Self {
        self.merge(other, |a, b| a | b)
    }

    /// What is in this set but not in the other.
    #[must_use]
    pub fn minus(&self, other: &Self) -> Self {
        self.merge(other, |a, b| a & !b)
    }

    /// The variables, in table order.
    pub fn iter(&self) -> impl Iterator<Item = SysVar> + use<> {
        let mut words = self.0;
        core::iter::from_fn(move || {
            for (nth, word) in words.iter_mut().enumerate() {
                if *word != 0 {
                    let bit = word.trailing_zeros() as usize;
                    *word &= word.wrapping_sub(1);
                    return SysVar::from_ordinal(nth.saturating_mul(32).saturating_add(bit));
                }
            }
            None
        })
    }

    fn merge(&self, other: &Self, op: impl Fn(u32, u32) -> u32) -> Self {
        let mut merged = *self;
        for (a, &b) in merged.0.iter_mut().zip(&other.0) {
            *a = op(*a, b);
        }
        merged
    }

    fn slot(&mut self, var: SysVar) -> Option<(&mut u32, u32)> {
        let ordinal = var.ordinal();
        if ordinal >= INPUT_COUNT {
            return None;
        }
        let bit = 1_u32.checked_shl((ordinal % 32) as u32)?;
        self.0.get_mut(ordinal / 32).map(|word| (word, bit))
    }
}

impl FromIterator<SysVar> for InputSet {
    fn from_iter<I: IntoIterator<Item = SysVar>>(vars: I) -> Self {
        let mut set = Self::EMPTY;
        vars.into_iter().for_each(|var| set.insert(var));
        set
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_set_holds_every_input_and_no_output() {
        let all: InputSet = SysVar::all().collect();
        assert_eq!(all.len(), INPUT_COUNT);
        assert!(all.iter().eq(SysVar::all().take(INPUT_COUNT)));
        let mut some = all;
        let force = SysVar::parse("ForceEnd[1]").unwrap();
        some.remove(force);
        assert!(!some.contains(force) && all.contains(force));
        assert!(all.minus(&some).iter().eq([force]));
        assert!(!all.contains(SysVar::parse("RobotState[1]").unwrap()));
        assert_eq!(InputSet::BYTES, all.iter().filter(|v| v.is_bits()).collect());
        assert!(InputSet::EMPTY.is_empty() && InputSet::EMPTY.or(&some).and(&all) == some);
    }
}
