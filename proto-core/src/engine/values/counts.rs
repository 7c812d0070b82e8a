//! Alive counters in received frames: the number that goes up by one with every frame.
//!
//! In: the counters of otherwise valid frames. Out: whether a frame is a repeat, as a frozen device sends, and whether
//! frames are missing before it. One list for all ports, so that ports without counters take no memory.

use heapless::Vec;

use crate::engine::rejection::Rejection;
use crate::wire::scalar::Scalar;

/// Maximum number of counters in the input frames of all ports.
pub(crate) const MAX_COUNTS: usize = 32;

/// The counters of all ports; bindings refer to them by index.
#[derive(Debug, Clone)]
pub(crate) struct Counts(Vec<Count, MAX_COUNTS>);

#[derive(Debug, Clone, Copy)]
struct Count {
    /// The highest number; 0 follows it.
    max: u32,
    /// The number of the newest accepted frame.
    last: Option<u32>,
}

impl Counts {
    pub(crate) const fn new() -> Self {
        Self(Vec::new())
    }

    /// Adds a counter and returns its index; `None` if there are too many.
    pub(crate) fn add(&mut self, max: u32) -> Option<u8> {
        let nth = self.0.len() as u8;
        self.0.push(Count { max, last: None }).ok()?;
        Some(nth)
    }

    /// Whether a frame with this number is new.
    pub(crate) fn check(&self, nth: u8, number: Scalar) -> Result<(), Rejection> {
        let Some(count) = self.0.get(usize::from(nth)) else { return Ok(()) };
        match number.as_f64() {
            number if number > f64::from(count.max) => Err(Rejection::OutOfRange),
            number if count.last.map(f64::from) == Some(number) => Err(Rejection::Repeated),
            _ => Ok(()),
        }
    }

    /// Takes the number of an accepted frame; returns whether it is out of sequence.
    pub(crate) fn take(&mut self, nth: u8, number: Scalar) -> bool {
        let Some(count) = self.0.get_mut(usize::from(nth)) else { return false };
        let number = number.as_f64() as u32;
        let before = count.last.replace(number);
        let next = |last: u32| if last >= count.max { 0 } else { last.saturating_add(1) };
        before.is_some_and(|last| next(last) != number)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_counter_goes_from_its_highest_number_to_zero() {
        let mut counts = Counts::new();
        let nth = counts.add(14).unwrap();
        for number in [13, 14, 0, 1] {
            assert_eq!(counts.check(nth, Scalar::Byte(number)), Ok(()));
            assert!(!counts.take(nth, Scalar::Byte(number)), "{number}");
        }
        assert_eq!(counts.check(nth, Scalar::Byte(1)), Err(Rejection::Repeated));
        assert_eq!(counts.check(nth, Scalar::Byte(15)), Err(Rejection::OutOfRange));
        assert!(counts.take(nth, Scalar::Byte(3)));
        assert!(counts.take(nth, Scalar::Byte(2)), "backwards");
    }
}
