//! The compiled part of a stream recipe: head, fields, tail (docs/wire/recipes.md section 3).
//!
//! In: payloads that [`Deframer`](super::Deframer) or [`datagram`](super::datagram) found, or the
//! process image. Out: the other.

use super::delimiter::{FrameHead, FrameTail};
use super::error::{EncodeError, FieldPlace, NoSpace, PartError, ValueError};
use super::fields::{Applied, FieldRun, FrameFields, PlacedField, Pool, Runs, Values};
use super::model::{Field, Framing, MAX_DELIMITER, MAX_STREAM_FRAME, Mode, Rules};
use crate::sysvar::IMAGE_BYTES;
use crate::wire::runs;
use crate::wire::scalar::Scalar;

/// One part of a stream recipe, checked and ready to decode and encode; about 0.8 KiB.
#[derive(Debug, Clone)]
pub struct StreamLayout {
    rules: Rules,
    pub(super) head: FrameHead,
    pub(super) tail: FrameTail,
    frame_len: u16,
    payload_len: u16,
    whole: FieldRun,
    pool: Pool,
}

impl StreamLayout {
    /// Checks and compiles a part.
    ///
    /// # Errors
    /// [`PartError`] says which limit or rule is broken, and by which field.
    pub fn new(
        rules: Rules,
        head: &[u8],
        tail: &[u8],
        fields: impl IntoIterator<Item = Field>,
        framing: Framing,
    ) -> Result<Self, PartError> {
        let head = FrameHead::new(head).ok_or(PartError::HeadTooLong { len: head.len() })?;
        let tail = FrameTail::new(tail).ok_or(PartError::TailTooLong { len: tail.len() })?;
        match framing {
            Framing::Bytes if head.len() == 0 && tail.len() == 0 => return Err(PartError::NoDelimiter),
            Framing::Datagram if rules.mode == Mode::User => return Err(PartError::UserDatagram),
            Framing::Bytes | Framing::Datagram => {}
        }
        let mut pool = Pool::new();
        let mut payload_len = 0_usize;
        for (nth, field) in fields.into_iter().enumerate() {
            pool.push(rules, field, place(nth), 0, place)?;
            payload_len = payload_len.saturating_add(field.ty().size());
        }
        if pool.field_count() == 0 {
            return Err(PartError::NoFields { frame: None });
        }
        let frame_len = payload_len.saturating_add(head.len()).saturating_add(tail.len());
        if frame_len > MAX_STREAM_FRAME {
            return Err(PartError::StreamFrameTooLong { len: frame_len });
        }
        let whole = pool.whole(0, payload_len);
        let (frame_len, payload_len) = (frame_len as u16, payload_len as u16);
        Ok(Self { rules, head, tail, frame_len, payload_len, whole, pool })
    }

    /// The mode and the direction of the part.
    pub const fn rules(&self) -> Rules {
        self.rules
    }

    /// Length of a whole frame in bytes: head, fields and tail; at most 512.
    pub const fn frame_len(&self) -> usize {
        self.frame_len as usize
    }

    /// Length of the fields in bytes.
    pub const fn payload_len(&self) -> usize {
        self.payload_len as usize
    }

    /// The bytes before the fields.
    pub fn head(&self) -> &[u8] {
        self.head.bytes()
    }

    /// The bytes after the fields.
    pub fn tail(&self) -> &[u8] {
        self.tail.bytes()
    }

    /// The fields in order, each with its place in the payload.
    pub fn fields(&self) -> impl Iterator<Item = PlacedField> + Clone + '_ {
        self.all_fields().placed()
    }

    /// The payload's values, in field order; fewer if the payload is too short.
    pub fn values<'a>(&'a self, payload: &'a [u8]) -> Values<'a> {
        self.all_fields().values(payload)
    }

    /// Checks that all values of the payload are valid (D22).
    ///
    /// # Errors
    /// [`ValueError`]: a float or double that is not finite, or a payload of another length.
    pub fn check(&self, payload: &[u8]) -> Result<(), ValueError> {
        self.all_fields().check(payload)
    }

    /// Writes the payload's values into the process image: all of them, or none. User-defined fields are not in the
    /// image; for them this is [`Self::check`].
    ///
    /// # Errors
    /// [`ValueError`]: a float that is not finite, or a payload of another length.
    // docs/performance.md section 1 has the cost of this attribute and the others here.
    #[inline]
    pub fn apply(&self, payload: &[u8], image: &mut [u8; IMAGE_BYTES]) -> Result<Applied, ValueError> {
        // Compared with `payload_len`, not with the run's length: the compiler knows that a frame's payload has this
        // length.
        if payload.len() == self.payload_len()
            && let Some(applied) = self.whole.apply(payload, image)
        {
            return Ok(applied);
        }
        self.apply_runs(payload, image)
    }

    /// Writes a frame with the image's values to the front of `out` and returns its length. User-defined fields are not
    /// in the image and are sent as zero.
    ///
    /// # Errors
    /// [`NoSpace`], with nothing written, if `out` is shorter than a frame.
    pub fn encode(&self, image: &[u8; IMAGE_BYTES], out: &mut [u8]) -> Result<usize, NoSpace> {
        let payload = self.delimited(out)?;
        if !self.whole.encode(image, payload) {
            self.all_runs().encode(image, payload);
        }
        Ok(self.frame_len())
    }

    /// Writes a frame with these values, one per field, to the front of `out` and returns its length.
    ///
    /// # Errors
    /// [`EncodeError`], with nothing written: too few or too many values, a value of another type, or not enough space.
    pub fn encode_values(&self, values: &[Scalar], out: &mut [u8]) -> Result<usize, EncodeError> {
        let fields = self.all_fields();
        fields.accepts(values)?;
        fields.encode_values(values, self.delimited(out)?);
        Ok(self.frame_len())
    }

    fn all_fields(&self) -> FrameFields<'_> {
        self.pool.fields(0, self.pool.field_count(), self.payload_len())
    }

    fn all_runs(&self) -> Runs<'_> {
        self.pool.runs(0, self.pool.step_count(), self.payload_len())
    }

    #[inline(never)]
    fn apply_runs(&self, payload: &[u8], image: &mut [u8; IMAGE_BYTES]) -> Result<Applied, ValueError> {
        match self.all_runs().apply(payload, image) {
            Some(applied) => Ok(applied),
            None => self.check(payload).map(|()| Applied::default()),
        }
    }

    /// The payload of a whole frame; `None` only if `frame` is too short.
    pub(super) fn payload_of<'f>(&self, frame: &'f [u8]) -> Option<&'f [u8]> {
        frame.get(self.head.len()..)?.get(..self.payload_len())
    }

    /// Writes head and tail, and returns the space for the payload, which must be filled.
    fn delimited<'o>(&self, out: &'o mut [u8]) -> Result<&'o mut [u8], NoSpace> {
        let no_space = NoSpace { needed: self.frame_len(), available: out.len() };
        let frame = out.get_mut(..self.frame_len()).ok_or(no_space)?;
        let start = self.head.len();
        if frame.len() >= 2 * MAX_DELIMITER {
            // Writes whole words; their padding falls into the payload.
            if let Some(front) = frame.first_chunk_mut() {
                *front = self.head.padded();
            }
            if let Some(back) = frame.last_chunk_mut() {
                *back = self.tail.padded();
            }
        } else if let Some((head, rest)) = frame.split_at_mut_checked(start)
            && let Some((_, tail)) = rest.split_at_mut_checked(self.payload_len())
        {
            runs::copy(head, self.head.bytes());
            runs::copy(tail, self.tail.bytes());
        }
        frame.get_mut(start..start.saturating_add(self.payload_len())).ok_or(no_space)
    }
}

fn place(nth: usize) -> FieldPlace {
    FieldPlace { frame: None, field: nth as u8 }
}

#[cfg(test)]
mod tests;
