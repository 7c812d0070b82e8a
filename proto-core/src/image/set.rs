//! Sets of variables as bits, such as the variables of a frame, those still to be written, or those that are unknown.

use crate::sysvar::{BIT_INPUT_COUNT, COUNT, INPUT_COUNT, SysVar};

const WORDS: usize = 3;
const _: () = assert!(INPUT_COUNT.div_ceil(32) == WORDS && BIT_INPUT_COUNT < 32);

/// A set of input variables. Output variables are never in it.
#[derive(Debug, Clone, Copy, Eq, Default)]
pub(crate) struct InputSet([u32; WORDS]);

/// Comparing arrays would call `memcmp` on a Cortex-M.
impl PartialEq for InputSet {
    fn eq(&self, other: &Self) -> bool {
        let ([a, b, c], [d, e, f]) = (self.0, other.0);
        (a ^ d) | (b ^ e) | (c ^ f) == 0
    }
}

impl InputSet {
    pub(crate) const EMPTY: Self = Self([0; WORDS]);

    /// The byte variables, which come first in the table of inputs.
    pub(crate) const BYTES: Self = Self([!(u32::MAX << BIT_INPUT_COUNT), 0, 0]);

    /// Adds an input variable; an output variable is ignored.
    pub(crate) fn insert(&mut self, var: SysVar) {
        if let Some((word, bit)) = self.slot(var) {
            *word |= bit;
        }
    }

    pub(crate) fn remove(&mut self, var: SysVar) {
        if let Some((word, bit)) = self.slot(var) {
            *word &= !bit;
        }
    }

    pub(crate) fn contains(&self, var: SysVar) -> bool {
        let ordinal = var.ordinal();
        ordinal < INPUT_COUNT && self.0.get(ordinal / 32).is_some_and(|word| word >> (ordinal % 32) & 1 == 1)
    }

    pub(crate) fn is_empty(&self) -> bool {
        let [a, b, c] = self.0;
        a | b | c == 0
    }

    #[cfg(test)]
    pub(crate) fn len(&self) -> usize {
        self.0.iter().fold(0, |sum, word| sum.saturating_add(word.count_ones() as usize))
    }

    #[must_use]
    pub(crate) fn and(&self, other: &Self) -> Self {
        let ([a, b, c], [d, e, f]) = (self.0, other.0);
        Self([a & d, b & e, c & f])
    }

    #[must_use]
    pub(crate) fn or(&self, other: &Self) -> Self {
        let ([a, b, c], [d, e, f]) = (self.0, other.0);
        Self([a | d, b | e, c | f])
    }

    /// The variables in this set but not in the other.
    #[must_use]
    pub(crate) fn minus(&self, other: &Self) -> Self {
        let ([a, b, c], [d, e, f]) = (self.0, other.0);
        Self([a & !d, b & !e, c & !f])
    }

    /// Number of consecutive variables of the table, from `first` on, that are in the set.
    pub(crate) fn run_len(&self, first: SysVar) -> usize {
        let ordinal = first.ordinal();
        // Most runs are within one word; 128-bit numbers are slow on a Cortex-M.
        let (within, left) = ((ordinal % 32) as u32, 32_u32.wrapping_sub((ordinal % 32) as u32));
        let run = self.0.get(ordinal / 32).map_or(0, |word| (word >> within).trailing_ones());
        if run < left { run as usize } else { self.long_run_len(ordinal) }
    }

    /// Like [`Self::run_len`], for a run that may continue in the next word.
    fn long_run_len(&self, ordinal: usize) -> usize {
        self.bits().checked_shr(ordinal as u32).map_or(0, |bits| bits.trailing_ones() as usize)
    }

    /// The `len` variables from `first` on that are inputs.
    pub(crate) fn run(first: SysVar, len: usize) -> Self {
        let (nth, within) = (first.ordinal() / 32, first.ordinal() % 32);
        // Most runs are within one word.
        if within.saturating_add(len) > 32 || first.ordinal().saturating_add(len) > INPUT_COUNT {
            return Self::long_run(first, len);
        }
        let bits = !u32::MAX.checked_shl(len as u32).unwrap_or(0) << within;
        let of = |word: usize| if word == nth { bits } else { 0 };
        Self([of(0), of(1), of(2)])
    }

    /// Like [`Self::run`], for any position.
    fn long_run(first: SysVar, len: usize) -> Self {
        let end = first.ordinal().saturating_add(len).min(INPUT_COUNT);
        Self::from(first.ordinal()).minus(&Self::from(end))
    }

    /// All bits from this position on, including those after the last input.
    fn from(start: usize) -> Self {
        let mut words = [u32::MAX; WORDS];
        for (nth, word) in words.iter_mut().enumerate() {
            let before = start.saturating_sub(nth.wrapping_mul(32));
            *word = u32::MAX.checked_shl(before as u32).unwrap_or(0);
        }
        Self(words)
    }

    /// The first variable of the set at or after this position of the table, or else the first of all.
    pub(crate) fn first_from(&self, ordinal: usize) -> Option<SysVar> {
        // Usually it is in the same word.
        let behind = self.0.get(ordinal / 32).map_or(0, |word| word >> (ordinal % 32));
        if behind != 0 {
            return SysVar::from_ordinal(ordinal.saturating_add(behind.trailing_zeros() as usize));
        }
        // Searches the later words, then all.
        let [_, b, c] = self.0;
        match ordinal / 32 {
            0 if b | c != 0 => Self([0, b, c]).first(),
            1 if c != 0 => Self([0, 0, c]).first(),
            _ => self.first(),
        }
    }

    pub(crate) fn first(&self) -> Option<SysVar> {
        let (nth, word) = match self.0 {
            [0, 0, word] => (64_usize, word),
            [0, word, _] => (32, word),
            [word, ..] => (0, word),
        };
        if word == 0 { None } else { SysVar::from_ordinal(nth.wrapping_add(word.trailing_zeros() as usize)) }
    }

    /// The variables, in table order.
    pub(crate) fn iter(&self) -> impl Iterator<Item = SysVar> + use<> {
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

    fn bits(&self) -> u128 {
        let [a, b, c] = self.0.map(u128::from);
        a | b.wrapping_shl(32) | c.wrapping_shl(64)
    }

    fn slot(&mut self, var: SysVar) -> Option<(&mut u32, u32)> {
        let ordinal = var.ordinal();
        if ordinal >= INPUT_COUNT {
            return None;
        }
        self.0.get_mut(ordinal / 32).map(|word| (word, bit_of(var)))
    }
}

/// A set of any variables.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub(crate) struct VarSet([u32; COUNT.div_ceil(32)]);

impl VarSet {
    pub(crate) const EMPTY: Self = Self([0; COUNT.div_ceil(32)]);

    pub(crate) fn insert(&mut self, var: SysVar) {
        if let Some(word) = self.0.get_mut(var.ordinal() / 32) {
            *word |= bit_of(var);
        }
    }

    pub(crate) fn remove(&mut self, var: SysVar) {
        if let Some(word) = self.0.get_mut(var.ordinal() / 32) {
            *word &= !bit_of(var);
        }
    }

    pub(crate) fn contains(&self, var: SysVar) -> bool {
        self.0.get(var.ordinal() / 32).is_some_and(|word| word & bit_of(var) != 0)
    }

    pub(crate) fn is_empty(&self) -> bool {
        self.0.iter().all(|word| *word == 0)
    }

    /// The variables that are both in `vars` and in this set.
    pub(crate) fn inputs(&self, vars: &InputSet) -> impl Iterator<Item = SysVar> + use<> {
        let own = *self;
        vars.iter().filter(move |&var| own.contains(var))
    }

    /// Whether the sets have a variable in common.
    pub(crate) fn meets(&self, other: &Self) -> bool {
        self.0.iter().zip(&other.0).any(|(one, other)| one & other != 0)
    }
}

/// A set of the image's extra values.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub(crate) struct ExtraSet(u32);

const _: () = assert!(super::MAX_EXTRA <= 32);

impl ExtraSet {
    pub(crate) const EMPTY: Self = Self(0);

    /// Adds or removes a value.
    pub(crate) fn set(&mut self, nth: u8, is_in: bool) {
        let bit = 1_u32.checked_shl(nth.into()).unwrap_or(0);
        self.0 = if is_in { self.0 | bit } else { self.0 & !bit };
    }

    /// Whether the sets have a value in common.
    pub(crate) fn meets(self, other: Self) -> bool {
        self.0 & other.0 != 0
    }
}

fn bit_of(var: SysVar) -> u32 {
    1_u32.wrapping_shl((var.ordinal() % 32) as u32)
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
    fn a_set_of_all_variables_tells_each_apart() {
        for var in SysVar::all() {
            let mut set = VarSet::EMPTY;
            set.insert(var);
            assert!(SysVar::all().filter(|&other| set.contains(other)).eq([var]));
            assert!(set.meets(&set) && !set.meets(&VarSet::EMPTY));
            set.remove(var);
            assert!(set.is_empty());
        }
    }

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
        let run = InputSet::run(force, 5);
        assert_eq!((run.len(), run.run_len(force), some.run_len(force)), (5, 5, 0));
        assert!(run.iter().eq((0..5).map(|nth| SysVar::from_ordinal(force.ordinal() + nth).unwrap())));
        assert_eq!(InputSet::run(SysVar::from_ordinal(0).unwrap(), COUNT), all);
        assert_eq!(InputSet::run(SysVar::from_ordinal(INPUT_COUNT).unwrap(), 3), InputSet::EMPTY);
        for from in 0..COUNT {
            let first = SysVar::from_ordinal(from).unwrap();
            let behind = all.iter().find(|var| var.ordinal() >= from).or(all.iter().next());
            assert_eq!((all.first_from(from), InputSet::EMPTY.first_from(from)), (behind, None));
            assert_eq!(InputSet::from_iter([force]).first_from(from), Some(force));
            for len in 0..COUNT {
                let run = InputSet::run(first, len);
                assert!(run.iter().eq(all.iter().filter(|var| (from..from + len).contains(&var.ordinal()))));
                assert_eq!(run.run_len(first), len.min(INPUT_COUNT.saturating_sub(from)));
            }
        }
        // Pairs of variables in the same word and in different words.
        for pair in [[0, 20], [0, 40], [5, 77], [31, 32], [33, 70], [63, 64], [65, 88]] {
            let two: InputSet = pair.into_iter().filter_map(SysVar::from_ordinal).collect();
            for from in 0..COUNT {
                let next = pair.into_iter().find(|&ordinal| ordinal >= from).unwrap_or(pair[0]);
                assert_eq!(two.first_from(from), SysVar::from_ordinal(next), "{pair:?} from {from}");
            }
        }
        assert!(InputSet::EMPTY.is_empty() && InputSet::EMPTY.or(&some).and(&all) == some);
    }
}
