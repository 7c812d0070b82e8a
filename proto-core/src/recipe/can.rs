//! The compiled part of a CAN recipe: frame ids, each with its fields (docs/wire/recipes.md section 6).
//!
//! In: a [`CanFrame`] or any other [`embedded_can::Frame`], or the process image. Out: the other. A frame that does not
//! match the recipe is rejected with a reason to count, and never applied in part.

use embedded_can::Frame;
use heapless::Vec;

use super::error::{EncodeError, FieldPlace, PartError, ValueError};
use super::fields::{Applied, FrameFields, PlacedField, Pool, Runs, Share, Values};
use super::model::{Field, MAX_CAN_IDS, Rules};
use crate::sysvar::IMAGE_BYTES;
use crate::wire::can::{CanFrame, CanId, CanKey, MAX_CAN_DATA};
use crate::wire::scalar::Scalar;

/// Why a received frame does not match the recipe (D17).
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
#[non_exhaustive]
pub enum CanReject {
    /// No frame of the part has this id.
    UnknownId {
        /// The received id.
        id: CanId,
    },
    /// A remote frame.
    Remote {
        /// The received id.
        id: CanId,
    },
    /// The length of the data is not that of the fields.
    WrongLength {
        /// The frame's index in the part.
        frame: u8,
        /// Length of the fields in bytes.
        expected: u8,
        /// Length of the data in bytes.
        got: u8,
    },
}

/// One part of a CAN recipe, checked and ready to decode and encode; about 1.2 KiB.
#[derive(Debug, Clone)]
pub struct CanLayout {
    rules: Rules,
    /// The ids of the frames, as many as `shares`, then [`CanKey::NONE`].
    keys: [CanKey; MAX_CAN_IDS],
    shares: Vec<Share, MAX_CAN_IDS>,
    /// Hash table of the ids: indices of frames, or [`EMPTY`]. See [`CanLayout::search_order`].
    places: [u8; PLACES],
    pool: Pool,
}

/// One frame of a [`CanLayout`].
#[derive(Debug, Clone, Copy)]
pub struct CanFrameLayout<'a> {
    id: CanId,
    index: usize,
    share: &'a Share,
    layout: &'a CanLayout,
}

impl CanLayout {
    /// Checks and compiles a part; each frame is its id and its fields.
    ///
    /// # Errors
    /// [`PartError`] says which limit or rule is broken, and by which frame or field.
    pub fn new<F>(rules: Rules, frames: impl IntoIterator<Item = (CanId, F)>) -> Result<Self, PartError>
    where
        F: IntoIterator<Item = Field>,
    {
        let (keys, places) = ([CanKey::NONE; MAX_CAN_IDS], [EMPTY; PLACES]);
        let mut layout = Self { rules, keys, shares: Vec::new(), places, pool: Pool::new() };
        for (id, fields) in frames {
            layout.push(id, fields)?;
        }
        if layout.shares.is_empty() { Err(PartError::NoFrames) } else { Ok(layout) }
    }

    /// The mode and the direction of the part.
    pub const fn rules(&self) -> Rules {
        self.rules
    }

    /// The frames' ids, in declared order.
    pub fn ids(&self) -> impl ExactSizeIterator<Item = CanId> + Clone + '_ {
        self.keys.get(..self.shares.len()).unwrap_or(&[]).iter().map(|&key| key.id())
    }

    /// Number of frames in the part, 1..=32.
    pub fn frame_count(&self) -> usize {
        self.shares.len()
    }

    /// The index in the part of the frame that matches a received frame.
    ///
    /// # Errors
    /// [`CanReject`]: an unknown id, a remote frame, or a wrong length.
    pub fn accept(&self, frame: &impl Frame) -> Result<usize, CanReject> {
        let key = CanKey::of(frame.id().into());
        self.accept_parts(key, frame.is_remote_frame(), frame.data().len())
    }

    /// Like [`Self::accept`], without checking the id, which a [`CanFrame`] guarantees to be valid.
    ///
    /// # Errors
    /// [`CanReject`]: an unknown id, a remote frame, or a wrong length.
    pub fn accept_frame(&self, frame: &CanFrame) -> Result<usize, CanReject> {
        self.accept_parts(frame.key(), frame.is_remote(), frame.len())
    }

    fn accept_parts(&self, key: CanKey, is_remote: bool, got: usize) -> Result<usize, CanReject> {
        if is_remote {
            return Err(CanReject::Remote { id: key.id() });
        }
        let unknown = || CanReject::UnknownId { id: key.id() };
        let index = self.index_of(key).ok_or_else(unknown)?;
        let share = self.shares.get(index).ok_or_else(unknown)?;
        let expected = share.whole.len();
        if got != expected {
            return Err(CanReject::WrongLength {
                frame: index as u8,
                expected: expected as u8,
                got: got as u8,
            });
        }
        Ok(index)
    }

    /// Whether the part has a frame with this frame's id.
    pub(crate) fn has(&self, frame: &CanFrame) -> bool {
        self.index_of(frame.key()).is_some()
    }

    /// The frame with this index in the part.
    pub fn frame(&self, index: usize) -> Option<CanFrameLayout<'_>> {
        let share = self.shares.get(index)?;
        let key = self.keys.get(index).copied().unwrap_or(CanKey::NONE);
        Some(CanFrameLayout { id: key.id(), index, share, layout: self })
    }

    /// The frames in declared order.
    pub fn frames(&self) -> impl Iterator<Item = CanFrameLayout<'_>> + Clone {
        (0..self.frame_count()).filter_map(|index| self.frame(index))
    }

    fn push(&mut self, id: CanId, fields: impl IntoIterator<Item = Field>) -> Result<(), PartError> {
        let nth = self.shares.len();
        if nth >= MAX_CAN_IDS {
            return Err(PartError::TooManyFrames);
        }
        let frame = nth as u8;
        if !id.is_valid() {
            return Err(PartError::InvalidId { frame, id });
        }
        if let Some(first) = self.ids().position(|other| other == id) {
            return Err(PartError::DuplicateId { frame, first: first as u8, id });
        }
        let (first_field, first_step) = (self.pool.field_count(), self.pool.step_count());
        let mut len = 0_usize;
        for (nth, field) in fields.into_iter().enumerate() {
            let at = FieldPlace { frame: Some(frame), field: nth.min(usize::from(u8::MAX)) as u8 };
            let shares = &self.shares;
            let place_of = |nth| place_among(shares, first_field, frame, nth);
            self.pool.push(self.rules, field, at, first_step, place_of)?;
            len = len.saturating_add(field.ty().size());
        }
        if len == 0 {
            return Err(PartError::NoFields { frame: Some(frame) });
        }
        if len > MAX_CAN_DATA {
            return Err(PartError::CanFrameTooLong { frame, len });
        }
        let key = CanKey::of(id);
        if let Some(free) = self.search_order(key).find(|&at| self.places.get(at) == Some(&EMPTY))
            && let Some(place) = self.places.get_mut(free)
        {
            *place = frame;
        }
        if let Some(place) = self.keys.get_mut(nth) {
            *place = key;
        }
        let whole = self.pool.whole(first_step, len);
        let share = Share { first_field: first_field as u8, first_step: first_step as u8, whole };
        // Cannot fail: the count was checked above.
        self.shares.push(share).map_err(|_| PartError::TooManyFrames)
    }

    /// The index of the frame with this id. At least half of the table is empty, so the search is short.
    fn index_of(&self, key: CanKey) -> Option<usize> {
        let first = self.search_order(key).next()?;
        let index = usize::from(*self.places.get(first)?);
        if *self.keys.get(index)? == key { Some(index) } else { self.index_behind(key) }
    }

    /// Continues the search if the first slot has another frame.
    fn index_behind(&self, key: CanKey) -> Option<usize> {
        for at in self.search_order(key) {
            let index = usize::from(*self.places.get(at)?);
            // [`EMPTY`] is not a valid index.
            if *self.keys.get(index)? == key {
                return Some(index);
            }
        }
        None
    }

    /// Slots of the hash table in which a key may be, in order.
    fn search_order(&self, key: CanKey) -> impl Iterator<Item = usize> + use<> {
        let first = (key.number().wrapping_mul(SPREAD) >> PLACE_SHIFT) as usize;
        (0..PLACES).map(move |further| first.wrapping_add(further) % PLACES)
    }
}

impl<'a> CanFrameLayout<'a> {
    /// The frame's id.
    pub const fn id(&self) -> CanId {
        self.id
    }

    /// Length of the data in bytes, 1..=8.
    #[allow(clippy::len_without_is_empty, reason = "no frame of a recipe is empty")]
    pub const fn len(&self) -> usize {
        self.share.whole.len()
    }

    /// The fields in order, each with its place in the data.
    pub fn fields(&self) -> impl Iterator<Item = PlacedField> + Clone + 'a {
        self.frame_fields().placed()
    }

    /// The data's values, in field order; fewer if the data is too short.
    pub fn values<'b>(&'b self, data: &'b [u8]) -> Values<'b> {
        self.frame_fields().values(data)
    }

    /// Checks that all values of the data are valid (D22).
    ///
    /// # Errors
    /// [`ValueError`]: a float or double that is not finite, or data of another length.
    pub fn check(&self, data: &[u8]) -> Result<(), ValueError> {
        self.frame_fields().check(data)
    }

    /// Writes the data's values into the process image: all of them, or none. User-defined fields are not in the image;
    /// for them this is [`Self::check`].
    ///
    /// # Errors
    /// [`ValueError`]: a float that is not finite, or data of another length.
    pub fn apply(&self, data: &[u8], image: &mut [u8; IMAGE_BYTES]) -> Result<Applied, ValueError> {
        if data.len() == self.len()
            && let Some(applied) = self.share.whole.apply(data, image)
        {
            return Ok(applied);
        }
        // Does not pass `self`, which would then have to be in memory on the fast path above.
        Self::apply_runs(self.layout, self.index, data, image)
    }

    /// Encodes the image's values as a frame. User-defined fields are not in the image and are sent as zero.
    pub fn encode(&self, image: &[u8; IMAGE_BYTES]) -> CanFrame {
        CanFrame::filled(self.id, self.len() as u8, |data| {
            if !self.share.whole.encode(image, data) {
                self.runs().encode(image, data);
            }
        })
    }

    /// Encodes these values, one per field, as a frame.
    ///
    /// # Errors
    /// [`EncodeError`]: too few or too many values, or a value of another type.
    pub fn encode_values(&self, values: &[Scalar]) -> Result<CanFrame, EncodeError> {
        self.frame_fields().accepts(values)?;
        Ok(CanFrame::filled(self.id, self.len() as u8, |data| {
            self.frame_fields().encode_values(values, data)
        }))
    }

    fn frame_fields(&self) -> FrameFields<'a> {
        let first = usize::from(self.share.first_field);
        let end = self.next().map_or(self.layout.pool.field_count(), |next| usize::from(next.first_field));
        self.layout.pool.fields(first, end, self.len())
    }

    fn runs(&self) -> Runs<'a> {
        let first = usize::from(self.share.first_step);
        let end = self.next().map_or(self.layout.pool.step_count(), |next| usize::from(next.first_step));
        self.layout.pool.runs(first, end, self.len())
    }

    fn next(&self) -> Option<&'a Share> {
        self.layout.shares.get(self.index.saturating_add(1))
    }

    fn apply_runs(
        layout: &CanLayout,
        index: usize,
        data: &[u8],
        image: &mut [u8; IMAGE_BYTES],
    ) -> Result<Applied, ValueError> {
        // `index` is always valid.
        let Some(frame) = layout.frame(index) else { return Ok(Applied::default()) };
        match frame.runs().apply(data, image) {
            Some(applied) => Ok(applied),
            None => frame.check(data).map(|()| Applied::default()),
        }
    }
}

/// The place of the n-th field of the part. Fields from `first_field` on belong to the new `frame`.
fn place_among(finished: &[Share], first_field: usize, frame: u8, nth: usize) -> FieldPlace {
    let begun = finished.iter().take_while(|share| usize::from(share.first_field) <= nth).enumerate().last();
    let (frame, first) = match begun {
        Some((index, share)) if nth < first_field => (index as u8, usize::from(share.first_field)),
        _ => (frame, first_field),
    };
    FieldPlace { frame: Some(frame), field: nth.saturating_sub(first) as u8 }
}

/// Twice the maximum number of ids, so that a search for an unknown id ends soon.
const PLACES: usize = 2 * MAX_CAN_IDS;
const PLACE_SHIFT: u32 = u32::BITS - PLACES.ilog2();
const _: () = assert!(PLACES.is_power_of_two());
/// 2^32 divided by the golden ratio: spreads neighbouring ids over the table.
const SPREAD: u32 = 0x9E37_79B1;
/// Not a valid index.
const EMPTY: u8 = u8::MAX;

impl core::fmt::Display for CanReject {
    fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        match *self {
            Self::UnknownId { id } => write!(f, "id {id} is not in the recipe"),
            Self::Remote { id } => write!(f, "remote frame {id}"),
            Self::WrongLength { frame, expected, got } => {
                let frame = u16::from(frame).saturating_add(1);
                write!(f, "frame {frame} carries {expected} bytes, not {got}")
            }
        }
    }
}

impl core::error::Error for CanReject {}

#[cfg(test)]
mod tests;
