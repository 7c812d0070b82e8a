//! The fields of a part or of one CAN frame: checked one by one, then moved between payload and process image in merged
//! runs (docs/wire/recipes.md sections 2 and 7).

use heapless::Vec;

use super::error::{EncodeError, FieldPlace, PartError, ValueError};
use super::model::{Field, MAX_FIELDS, Mode, Rules};
use crate::sysvar::{Direction, IMAGE_BYTES, SysVar};
use crate::wire::runs;
use crate::wire::scalar::{Scalar, ScalarType};

/// One field and its place in the payload.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct PlacedField {
    /// Offset of its first byte in the payload.
    pub offset: usize,
    /// The field.
    pub field: Field,
}

/// The result of applying a payload (D22).
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct Applied {
    /// Number of fields with reserved bits set; the bits were cleared in the image.
    pub masked: u16,
}

/// The values of a payload, in field order.
#[derive(Debug, Clone)]
pub struct Values<'a> {
    fields: core::slice::Iter<'a, Field>,
    payload: &'a [u8],
}

impl Iterator for Values<'_> {
    type Item = Scalar;

    fn next(&mut self) -> Option<Scalar> {
        let ty = self.fields.next()?.ty();
        let (value, rest) = self.payload.split_at_checked(ty.size())?;
        self.payload = rest;
        Scalar::decode(ty, value)
    }

    fn size_hint(&self) -> (usize, Option<usize>) {
        (0, Some(self.fields.len()))
    }
}

/// All fields of a part, and the runs that copy them.
#[derive(Debug, Clone)]
pub(super) struct Pool {
    fields: Vec<Field, MAX_FIELDS>,
    steps: Vec<FieldRun, MAX_FIELDS>,
}

/// At most [`runs::MAX_RUN`] bytes that are adjacent in the payload and in the image. The runs of a frame cover its
/// payload in order, without gaps.
#[derive(Debug, Clone, Copy)]
pub(super) struct FieldRun {
    image: u16,
    len: u8,
    kind: RunContent,
}

/// The content of a run: for one byte with reserved bits the mask of its other bits, else [`RunContent::FLOATS`] or
/// [`RunContent::PLAIN`]. It takes one byte, because parts have up to 128 runs.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
struct RunContent(u8);

impl RunContent {
    /// Floats, which must be finite.
    const FLOATS: Self = Self(0);
    /// Every bit pattern is valid.
    const PLAIN: Self = Self(0xFF);
}

#[derive(Debug, Clone, Copy)]
pub(super) struct FrameFields<'a> {
    fields: &'a [Field],
    /// Length of the payload in bytes.
    len: usize,
}

/// The runs of one frame: several, or none if its fields are user-defined.
#[derive(Debug, Clone, Copy)]
pub(super) struct Runs<'a> {
    steps: &'a [FieldRun],
    /// Length of the payload in bytes.
    len: usize,
}

/// Where the fields and runs of a frame begin in a [`Pool`]; they end where those of the next frame begin.
#[derive(Debug, Clone, Copy)]
pub(super) struct Share {
    pub(super) first_field: u8,
    pub(super) first_step: u8,
    pub(super) whole: FieldRun,
}

impl Pool {
    pub(super) const fn new() -> Self {
        Self { fields: Vec::new(), steps: Vec::new() }
    }

    pub(super) fn field_count(&self) -> usize {
        self.fields.len()
    }

    pub(super) fn step_count(&self) -> usize {
        self.steps.len()
    }

    /// Appends a field. `frame_starts` is the number of runs at the beginning of its frame, so that runs are not merged
    /// across frames; `place_of` returns the place of the n-th field of the pool.
    pub(super) fn push(
        &mut self,
        rules: Rules,
        field: Field,
        at: FieldPlace,
        frame_starts: usize,
        place_of: impl Fn(usize) -> FieldPlace,
    ) -> Result<(), PartError> {
        let step = match (field, rules.mode) {
            (Field::System(var), Mode::Realtime) => {
                if var.direction() != rules.direction {
                    return Err(PartError::WrongDirection { at, var, part: rules.direction });
                }
                let twice = self.fields.iter().position(|&other| other == field);
                if let (Direction::Input, Some(nth)) = (rules.direction, twice) {
                    return Err(PartError::DuplicateVariable { at, first: place_of(nth), var });
                }
                Some(FieldRun::of(var))
            }
            (Field::User(_), Mode::User) => None,
            (_, mode) => return Err(PartError::WrongMode { at, mode }),
        };
        self.fields.push(field).map_err(|_| PartError::TooManyFields { at })?;
        let Some(step) = step else { return Ok(()) };
        match self.steps.get_mut(frame_starts..).and_then(|steps| steps.last_mut()) {
            Some(last) if last.joins(step) => last.len = last.len.saturating_add(step.len),
            // Cannot fail: there are never more runs than fields.
            _ => self.steps.push(step).map_err(|_| PartError::TooManyFields { at })?,
        }
        Ok(())
    }

    /// The single run of a frame of `len` bytes, which is all that was added since `first_step`. Most parts consist of
    /// one run; for others, the result has no place in the image.
    pub(super) fn whole(&self, first_step: usize, len: usize) -> FieldRun {
        match self.steps.get(first_step..) {
            Some([step]) => *step,
            _ => FieldRun {
                image: NOWHERE,
                len: u8::try_from(len).unwrap_or_default(),
                kind: RunContent::PLAIN,
            },
        }
    }

    /// The fields `first..end`, of a frame of `len` bytes.
    pub(super) fn fields(&self, first: usize, end: usize, len: usize) -> FrameFields<'_> {
        FrameFields { fields: self.fields.get(first..end).unwrap_or(&[]), len }
    }

    /// The runs `first..end`, of a frame of `len` bytes.
    pub(super) fn runs(&self, first: usize, end: usize, len: usize) -> Runs<'_> {
        Runs { steps: self.steps.get(first..end).unwrap_or(&[]), len }
    }
}

impl FieldRun {
    fn of(var: SysVar) -> Self {
        let kind = match var.ty() {
            ScalarType::Float => RunContent::FLOATS,
            ScalarType::Byte => RunContent(var.valid_bits()),
            _ => RunContent::PLAIN,
        };
        Self { image: var.image_offset() as u16, len: var.size() as u8, kind }
    }

    fn joins(self, next: Self) -> bool {
        self.kind == next.kind
            && matches!(self.kind, RunContent::FLOATS | RunContent::PLAIN)
            && self.image.saturating_add(u16::from(self.len)) == next.image
            && usize::from(self.len.saturating_add(next.len)) <= runs::MAX_RUN
    }
}

impl Runs<'_> {
    /// Writes a payload into the image. Returns `None`, with nothing written, if [`FrameFields::check`] has to handle
    /// it.
    // docs/performance.md section 1 has the cost of this attribute and the others here.
    #[inline(never)]
    pub(super) fn apply(self, payload: &[u8], image: &mut [u8; IMAGE_BYTES]) -> Option<Applied> {
        if payload.len() != self.len {
            return None;
        }
        let mut rest = payload;
        let mut accepted = !self.steps.is_empty();
        for step in self.steps {
            let (run, after) = rest.split_at_checked(usize::from(step.len))?;
            accepted &= step.accepts(run);
            rest = after;
        }
        if !accepted {
            return None;
        }
        let mut applied = Applied::default();
        let mut rest = payload;
        for step in self.steps {
            let (run, after) = rest.split_at_checked(usize::from(step.len))?;
            applied.masked = applied.masked.saturating_add(step.write(run, image));
            rest = after;
        }
        Some(applied)
    }

    /// Fills a payload from the image; user-defined fields are not in the image and become zero.
    pub(super) fn encode(self, image: &[u8; IMAGE_BYTES], payload: &mut [u8]) {
        let mut rest = payload;
        for step in self.steps {
            let Some((run, after)) = rest.split_at_mut_checked(usize::from(step.len)) else { return };
            step.read(image, run);
            rest = after;
        }
        if self.steps.is_empty() {
            rest.fill(0);
        }
    }
}

impl<'a> FrameFields<'a> {
    pub(super) fn placed(self) -> impl Iterator<Item = PlacedField> + Clone + 'a {
        self.fields.iter().scan(0_usize, |next, &field| {
            let offset = *next;
            *next = offset.saturating_add(field.ty().size());
            Some(PlacedField { offset, field })
        })
    }

    pub(super) fn values<'p>(self, payload: &'p [u8]) -> Values<'p>
    where
        'a: 'p,
    {
        Values { fields: self.fields.iter(), payload }
    }

    /// Rejects a payload of another length, or with a float or double that is not finite.
    pub(super) fn check(self, payload: &[u8]) -> Result<(), ValueError> {
        if payload.len() != self.len {
            return Err(ValueError::Length { expected: self.len, got: payload.len() });
        }
        match self.values(payload).position(|value| !value.is_finite()) {
            Some(field) => Err(ValueError::NotFinite { field: field as u8 }),
            None => Ok(()),
        }
    }

    /// Checks that there is one value per field, each of its field's type.
    pub(super) fn accepts(self, values: &[Scalar]) -> Result<(), EncodeError> {
        if values.len() != self.fields.len() {
            return Err(EncodeError::Count { expected: self.fields.len(), got: values.len() });
        }
        let pairs = self.fields.iter().map(|field| field.ty()).zip(values.iter().map(|value| value.ty()));
        match pairs.enumerate().find(|(_, (expected, got))| expected != got) {
            Some((field, (expected, got))) => Err(EncodeError::Type { field: field as u8, expected, got }),
            None => Ok(()),
        }
    }

    /// Fills a payload with values that passed [`Self::accepts`].
    pub(super) fn encode_values(self, values: &[Scalar], payload: &mut [u8]) {
        let mut rest = payload;
        for value in values {
            let Some((target, after)) = rest.split_at_mut_checked(value.ty().size()) else { return };
            let _ = value.encode(target);
            rest = after;
        }
    }
}

impl FieldRun {
    pub(super) const fn len(&self) -> usize {
        self.len as usize
    }

    /// Writes a payload that is this one run, and has its length, into the image. Returns `None`, with nothing written,
    /// if [`Runs::apply`] or [`FrameFields::check`] has to handle it.
    #[inline(always)]
    pub(super) fn apply(&self, payload: &[u8], image: &mut [u8; IMAGE_BYTES]) -> Option<Applied> {
        let start = usize::from(self.image);
        let target = image.get_mut(start..start.wrapping_add(payload.len()))?;
        if self.kind == RunContent::FLOATS {
            return runs::copy_finite(target, payload).then_some(Applied { masked: 0 });
        }
        Some(Applied { masked: self.put(payload, target) })
    }

    /// Fills a payload that is this one run from the image; `false`, with nothing written, if the frame has several
    /// runs.
    pub(super) fn encode(&self, image: &[u8; IMAGE_BYTES], payload: &mut [u8]) -> bool {
        match image.get(self.range()) {
            Some(source) if payload.len() == source.len() => {
                runs::copy(payload, source);
                true
            }
            _ => false,
        }
    }

    fn accepts(&self, run: &[u8]) -> bool {
        self.kind != RunContent::FLOATS || runs::all_finite(run)
    }

    /// Writes a run into the image, and returns the number of fields that had reserved bits set.
    fn write(&self, run: &[u8], image: &mut [u8; IMAGE_BYTES]) -> u16 {
        image.get_mut(self.range()).map_or(0, |target| self.put(run, target))
    }

    fn put(&self, run: &[u8], target: &mut [u8]) -> u16 {
        match self.kind {
            RunContent::PLAIN | RunContent::FLOATS => {
                runs::copy(target, run);
                0
            }
            RunContent(valid) => {
                let (Some(bits), Some(&received)) = (target.first_mut(), run.first()) else { return 0 };
                *bits = received & valid;
                u16::from(received & !valid != 0)
            }
        }
    }

    fn read(&self, image: &[u8; IMAGE_BYTES], run: &mut [u8]) {
        if let Some(source) = image.get(self.range()) {
            runs::copy(run, source);
        }
    }

    fn range(&self) -> core::ops::Range<usize> {
        let start = usize::from(self.image);
        start..start.saturating_add(usize::from(self.len))
    }
}

/// Beyond the end of the image.
const NOWHERE: u16 = u16::MAX;
const _: () = assert!(IMAGE_BYTES < NOWHERE as usize);
