//! Copies and checks of a few bytes whose number is known only at run time.
//!
//! They use one word from each end; the words overlap in the middle. For the short runs of recipes this takes several
//! times fewer instructions than a call of `memcpy` or a loop over bytes, on a host and on a Cortex-M.

/// The longest run.
pub(crate) const MAX_RUN: usize = 32;

/// Copies `from`, at most [`MAX_RUN`] bytes, into `to`, which has the same length.
pub(crate) fn copy(to: &mut [u8], from: &[u8]) {
    debug_assert!(to.len() == from.len() && from.len() <= MAX_RUN);
    match from.len() {
        // As one number, because copying an array of 16 bytes calls `memcpy` on a Cortex-M.
        16.. => both_ends(to, from, |bytes| u128::from_ne_bytes(bytes).to_ne_bytes()),
        8.. => both_ends(to, from, as_is::<8>),
        4.. => both_ends(to, from, as_is::<4>),
        2.. => both_ends(to, from, as_is::<2>),
        _ => both_ends(to, from, as_is::<1>),
    }
}

/// Copies a slice of any length to one of the same length, in runs. On a Cortex-M it takes half the time of `memcpy`,
/// which moves one word at a time.
// docs/performance.md section 1 has the cost of this attribute and the others here.
#[inline(never)]
pub(crate) fn copy_long(to: &mut [u8], from: &[u8]) {
    let (to_runs, to_rest) = to.as_chunks_mut::<16>();
    let (from_runs, from_rest) = from.as_chunks::<16>();
    let (to_pairs, to_last) = to_runs.as_chunks_mut::<2>();
    let (from_pairs, from_last) = from_runs.as_chunks::<2>();
    let number = |bytes: [u8; 16]| u128::from_ne_bytes(bytes).to_ne_bytes();
    for ([to, to_next], [from, from_next]) in to_pairs.iter_mut().zip(from_pairs) {
        *to = number(*from);
        *to_next = number(*from_next);
    }
    for (to, from) in to_last.iter_mut().zip(from_last) {
        *to = number(*from);
    }
    if to_rest.len() == from_rest.len() {
        copy(to_rest, from_rest);
    }
}

fn as_is<const N: usize>(bytes: [u8; N]) -> [u8; N] {
    bytes
}

#[inline(always)]
fn both_ends<const N: usize>(to: &mut [u8], from: &[u8], by: impl Fn([u8; N]) -> [u8; N]) {
    if let (Some(&front), Some(&back)) = (from.first_chunk::<N>(), from.last_chunk::<N>()) {
        if let Some(target) = to.first_chunk_mut() {
            *target = by(front);
        }
        if let Some(target) = to.last_chunk_mut() {
            *target = by(back);
        }
    }
}

/// Whether all binary32 numbers in `run`, at most [`MAX_RUN`] bytes, are finite.
pub(crate) fn all_finite(run: &[u8]) -> bool {
    debug_assert!(run.len() <= MAX_RUN && run.len().is_multiple_of(4));
    match run.len() {
        16.. => finite_ends::<16>(run).is_some(),
        8.. => finite_ends::<8>(run).is_some(),
        4.. => finite_ends::<4>(run).is_some(),
        _ => true,
    }
}

/// Checks and copies in one: like [`copy`], but copies nothing unless all numbers are finite.
#[inline(always)]
pub(crate) fn copy_finite(to: &mut [u8], run: &[u8]) -> bool {
    debug_assert!(to.len() == run.len() && run.len() <= MAX_RUN && run.len().is_multiple_of(4));
    match run.len() {
        16.. => finite_ends::<16>(run).is_some_and(|(&front, &back)| {
            // Loads both before it stores one, so they stay in the registers in which they were checked.
            let (front, back) = (u128::from_ne_bytes(front), u128::from_ne_bytes(back));
            if let Some(target) = to.first_chunk_mut() {
                *target = front.to_ne_bytes();
            }
            if let Some(target) = to.last_chunk_mut() {
                *target = back.to_ne_bytes();
            }
            true
        }),
        9.. => finite_ends::<8>(run).is_some_and(|_| {
            both_ends(to, run, as_is::<8>);
            true
        }),
        // Both ends are the same bytes.
        8 => one_end::<8>(to, run),
        4.. => one_end::<4>(to, run),
        _ => true,
    }
}

fn one_end<const N: usize>(to: &mut [u8], run: &[u8]) -> bool {
    match (to.first_chunk_mut(), finite_ends::<N>(run)) {
        (Some(target), Some((all, _))) => {
            *target = *all;
            true
        }
        _ => false,
    }
}

/// The first and the last bytes of a run, which may overlap, if all their numbers are finite.
#[inline(always)]
fn finite_ends<const N: usize>(run: &[u8]) -> Option<(&[u8; N], &[u8; N])> {
    let (front, back) = (run.first_chunk::<N>()?, run.last_chunk::<N>()?);
    let numbers = front.as_chunks().0.iter().zip(back.as_chunks().0);
    // Without a branch for each number, this is one vector operation.
    let special = numbers.fold(false, |any, (&front, &back)| any | is_special(front) | is_special(back));
    (!special).then_some((front, back))
}

/// Whether all exponent bits are set (infinity or NaN): adding one to the exponent then carries into the sign.
fn is_special(float: [u8; 4]) -> bool {
    ((u32::from_le_bytes(float) & EXPONENT).wrapping_add(EXPONENT_UNIT) as i32) < 0
}

const EXPONENT: u32 = 0x7F80_0000;
const EXPONENT_UNIT: u32 = 0x0080_0000;

#[cfg(test)]
mod tests {
    use std::vec;
    use std::vec::Vec;

    use super::*;

    #[test]
    fn a_copy_of_any_length_is_whole_and_stays_inside() {
        for len in 0..=MAX_RUN {
            let from: Vec<u8> = (1..=len as u8).collect();
            let mut to = vec![0xA5; len + 2];
            copy(&mut to[1..=len], &from);
            assert_eq!(to[1..=len], from);
            assert_eq!((to[0], to[len + 1]), (0xA5, 0xA5));
        }
    }

    #[test]
    fn a_long_copy_is_whole_and_stays_inside() {
        for len in 0..=5 * MAX_RUN {
            let from: Vec<u8> = (0..len).map(|at| at as u8 ^ 0x5A).collect();
            let mut to = vec![0xA5; len + 2];
            copy_long(&mut to[1..=len], &from);
            assert_eq!(to[1..=len], from);
            assert_eq!((to[0], to[len + 1]), (0xA5, 0xA5));
        }
    }

    #[test]
    fn a_special_number_is_seen_wherever_it_stands() {
        let ordinary = [0.0, -0.0, 1.5, -2.5, f32::MAX, f32::MIN, f32::MIN_POSITIVE, 1e-45];
        let specials = [f32::INFINITY, f32::NEG_INFINITY, f32::NAN, -f32::NAN, f32::from_bits(0x7F80_0001)];
        for count in 0..=MAX_RUN / 4 {
            let floats: Vec<f32> = ordinary.into_iter().cycle().take(count).collect();
            let bytes = |floats: &[f32]| -> Vec<u8> { floats.iter().flat_map(|f| f.to_le_bytes()).collect() };
            assert!(all_finite(&bytes(&floats)), "{count} ordinary numbers");
            let mut to = vec![0xA5; 4 * count + 2];
            assert!(copy_finite(&mut to[1..=4 * count], &bytes(&floats)));
            assert_eq!(to[1..=4 * count], bytes(&floats));
            assert_eq!((to[0], to[4 * count + 1]), (0xA5, 0xA5));
            for at in 0..count {
                for special in specials {
                    let mut floats = floats.clone();
                    floats[at] = special;
                    assert!(!all_finite(&bytes(&floats)), "{special} at {at} of {count}");
                    let mut to = vec![0xA5; 4 * count];
                    assert!(!copy_finite(&mut to, &bytes(&floats)), "{special} at {at} of {count}");
                    assert_eq!(to, vec![0xA5; 4 * count]);
                }
            }
        }
    }
}
