//! Positions of a frame's elements and checksum.

use super::FrameLayout;
use super::element::Element;
use crate::device::text::{Counts, Length, MAX_TEXT};

/// Computes the positions of elements one after the other.
pub(super) struct ElementPlaces {
    /// Start of the next element.
    pub(super) at: usize,
    /// Start and length of the newest element that is not shared.
    pub(super) shared_at: usize,
    shared_len: usize,
    /// Number of elements placed so far.
    pub(super) nth: usize,
    /// Number of elements before the checksum.
    checksum_behind: usize,
    checksum_len: usize,
    /// Start of the checksum, once it is known.
    pub(super) checksum_at: usize,
    tail_len: usize,
    /// End of the frame, once it is known.
    pub(super) end: Option<usize>,
    behind_rest: usize,
}

/// Why the position of an element is unknown.
pub(super) enum Unplaced {
    /// The bytes end too early; at least this many are missing.
    Partial(usize),
    /// The element is too long.
    No,
}

impl ElementPlaces {
    pub(super) fn new(layout: &FrameLayout, end: Option<usize>) -> Self {
        let (behind, len) =
            layout.checksum.map_or((usize::MAX, 0), |sum| (usize::from(layout.behind), sum.len()));
        let mut places = Self {
            at: layout.head.len(),
            shared_at: 0,
            shared_len: 0,
            nth: 0,
            checksum_behind: behind,
            checksum_len: len,
            checksum_at: 0,
            tail_len: layout.tail.len(),
            end,
            behind_rest: usize::from(layout.behind_rest),
        };
        places.step_over_checksum();
        places
    }

    fn step_over_checksum(&mut self) {
        if self.checksum_behind == self.nth {
            self.checksum_at = self.at;
            self.at = self.at.saturating_add(self.checksum_len);
        }
    }

    /// The range of the next element, which has `len` bytes, followed by `further` bytes that belong to it.
    pub(super) fn next(&mut self, element: &Element, len: usize, further: usize) -> core::ops::Range<usize> {
        self.nth = self.nth.saturating_add(1);
        if element.is_shared() {
            let place = self.shared_at..self.shared_at.saturating_add(len);
            self.step_over_checksum();
            return place;
        }
        let start = self.at;
        let end = start.saturating_add(len);
        (self.shared_at, self.shared_len) = (start, len);
        self.at = end.saturating_add(further);
        self.step_over_checksum();
        start..end
    }

    /// Finds the range of the next element in `bytes`.
    pub(super) fn find(
        &mut self,
        element: &Element,
        bytes: &[u8],
    ) -> Result<core::ops::Range<usize>, Unplaced> {
        let (len, further) = match element.len() {
            Some(len) => (len, 0),
            None if element.is_shared() => (self.shared_len, 0),
            None if element.is_rest() => {
                let end = self.end.ok_or(Unplaced::No)?;
                let stop = end.checked_sub(self.behind_rest).ok_or(Unplaced::No)?;
                let len = stop.checked_sub(self.at).ok_or(Unplaced::No)?;
                if len > MAX_TEXT {
                    return Err(Unplaced::No);
                }
                (len, 0)
            }
            None => {
                let (end, most) = (element.until().ok_or(Unplaced::No)?, element.most());
                let rest = bytes.get(self.at..).unwrap_or(&[]);
                match rest.iter().take(most.saturating_add(1)).position(|&byte| byte == end) {
                    Some(len) => (len, 1),
                    None if rest.len() > most => return Err(Unplaced::No),
                    None => return Err(Unplaced::Partial(1)),
                }
            }
        };
        let place = self.next(element, len, further);
        match place.end.saturating_add(further).checked_sub(bytes.len()) {
            None | Some(0) => Ok(place),
            Some(missing) => Err(Unplaced::Partial(missing)),
        }
    }

    /// Length of a frame whose length field, which ends at `at`, has the value 0. Call it right after placing that
    /// field.
    pub(super) fn counted_from(&self, length: &Length, at: usize) -> i64 {
        let first = match length.counts {
            Counts::Frame => 0,
            Counts::Rest => at,
            Counts::Fields => {
                let is_behind = self.checksum_behind != usize::MAX && self.checksum_behind >= self.nth;
                let sum = if is_behind { self.checksum_len } else { 0 };
                at.saturating_add(sum).saturating_add(self.tail_len)
            }
        };
        (first as i64).saturating_add(i64::from(length.plus))
    }
}
