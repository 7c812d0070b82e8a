//! The fields of a part or of one CAN frame: checked one by one, then moved between payload and
//! process image in merged runs (docs/wire/recipes.md sections 2 and 7).

use heapless::Vec;

use super::error::{EncodeError, FieldPlace, PartError, ValueError};
use super::model::{Field, MAX_FIELDS, Mode, Rules};
use crate::sysvar::{Direction, IMAGE_BYTES, SysVar};
use crate::wire::scalar::{Scalar, ScalarType};

/// One field and where it stands in the payload.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct PlacedField {
    /// Offset of its first byte, counted from the payload's.
    pub offset: usize,
    /// The field.
    pub field: Field,
}

/// What applying a payload found (D22).
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct Applied {
    /// Fields whose reserved bits were set; they were cleared on the way into the image.
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

/// All fields of a part with the runs that move them.
#[derive(Debug, Clone)]
pub(super) struct Pool {
    fields: Vec<Field, MAX_FIELDS>,
    steps: Vec<Step, MAX_FIELDS>,
}

/// Consecutive payload bytes that are consecutive in the image too. The runs of a frame cover its
/// payload in order, without gaps.
#[derive(Debug, Clone, Copy)]
struct Step {
    image: u16,
    len: u16,
    kind: Kind,
}

/// What a run holds.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Kind {
    /// Anything that is right whatever its bits are.
    Plain,
    /// Floats, which must be finite.
    Floats,
    /// One byte of which only these bits mean something.
    Bits(u8),
}

/// One frame's share of a [`Pool`].
#[derive(Debug, Clone, Copy)]
pub(super) struct FrameFields<'a> {
    fields: &'a [Field],
    steps: &'a [Step],
    len: usize,
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

    /// Adds a field after those there are. `frame_starts` is the step count where its frame
    /// begins, so that runs never reach across frames; `place_of` says where the n-th field of the
    /// pool stands.
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
                Some(Step::of(var))
            }
            (Field::User(_), Mode::User) => None,
            (_, mode) => return Err(PartError::WrongMode { at, mode }),
        };
        self.fields.push(field).map_err(|_| PartError::TooManyFields { at })?;
        let Some(step) = step else { return Ok(()) };
        match self.steps.get_mut(frame_starts..).and_then(|steps| steps.last_mut()) {
            Some(last) if last.joins(step) => last.len = last.len.saturating_add(step.len),
            // There are never more runs than fields, so the push cannot fail.
            _ => self.steps.push(step).map_err(|_| PartError::TooManyFields { at })?,
        }
        Ok(())
    }

    /// The share of a frame whose fields and runs are these ranges; `len` is its payload's length.
    #[inline]
    pub(super) fn frame(
        &self,
        fields: core::ops::Range<usize>,
        steps: core::ops::Range<usize>,
        len: usize,
    ) -> FrameFields<'_> {
        FrameFields {
            fields: self.fields.get(fields).unwrap_or(&[]),
            steps: self.steps.get(steps).unwrap_or(&[]),
            len,
        }
    }

    /// The share of a part that is one frame.
    #[inline]
    pub(super) fn whole(&self, len: usize) -> FrameFields<'_> {
        FrameFields { fields: &self.fields, steps: &self.steps, len }
    }
}

impl Step {
    fn of(var: SysVar) -> Self {
        let kind = match var.ty() {
            ScalarType::Float => Kind::Floats,
            _ if var.valid_bits() != 0xFF => Kind::Bits(var.valid_bits()),
            _ => Kind::Plain,
        };
        Self { image: var.image_offset() as u16, len: var.size() as u16, kind }
    }

    fn joins(self, next: Self) -> bool {
        self.kind == next.kind
            && !matches!(self.kind, Kind::Bits(_))
            && self.image.saturating_add(self.len) == next.image
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

    /// Refuses a payload of another length, or with a float or double that is not finite.
    #[inline]
    pub(super) fn check(self, payload: &[u8]) -> Result<(), ValueError> {
        if payload.len() != self.len {
            return Err(ValueError::Length { expected: self.len, got: payload.len() });
        }
        let mut rest = payload;
        let mut finite = true;
        for step in self.steps {
            let Some((run, after)) = rest.split_at_checked(usize::from(step.len)) else { break };
            if step.kind == Kind::Floats {
                finite &= all_finite(run);
            }
            rest = after;
        }
        if finite && !self.steps.is_empty() { Ok(()) } else { self.check_each(payload) }
    }

    /// For user-defined fields, and to find out which field it is.
    #[cold]
    fn check_each(self, payload: &[u8]) -> Result<(), ValueError> {
        match self.values(payload).position(|value| !value.is_finite()) {
            Some(field) => Err(ValueError::NotFinite { field: field as u8 }),
            None => Ok(()),
        }
    }

    #[inline]
    pub(super) fn apply(self, payload: &[u8], image: &mut [u8; IMAGE_BYTES]) -> Result<Applied, ValueError> {
        self.check(payload)?;
        let mut applied = Applied::default();
        let mut rest = payload;
        for step in self.steps {
            let Some((run, after)) = rest.split_at_checked(usize::from(step.len)) else { break };
            let Some(target) = image.get_mut(step.range()) else { break };
            match step.kind {
                Kind::Bits(valid) => {
                    for (bits, &received) in target.iter_mut().zip(run) {
                        *bits = received & valid;
                        applied.masked = applied.masked.saturating_add(u16::from(received & !valid != 0));
                    }
                }
                Kind::Plain | Kind::Floats => target.copy_from_slice(run),
            }
            rest = after;
        }
        Ok(applied)
    }

    /// Fills a payload from the image; user-defined fields have no place there and become zero.
    #[inline]
    pub(super) fn encode(self, image: &[u8; IMAGE_BYTES], payload: &mut [u8]) {
        let mut rest = payload;
        for step in self.steps {
            let Some((run, after)) = rest.split_at_mut_checked(usize::from(step.len)) else { return };
            let Some(source) = image.get(step.range()) else { return };
            run.copy_from_slice(source);
            rest = after;
        }
        rest.fill(0);
    }

    /// Whether `values` are one a field, each of its field's type.
    pub(super) fn accepts(self, values: &[Scalar]) -> Result<(), EncodeError> {
        if values.len() != self.fields.len() {
            return Err(EncodeError::Count { expected: self.fields.len(), got: values.len() });
        }
        match self.fields.iter().zip(values).position(|(field, value)| field.ty() != value.ty()) {
            Some(field) => {
                let expected = self.fields.get(field).map_or(ScalarType::Byte, |field| field.ty());
                let got = values.get(field).map_or(ScalarType::Byte, |value| value.ty());
                Err(EncodeError::Type { field: field as u8, expected, got })
            }
            None => Ok(()),
        }
    }

    /// Fills a payload with values that [`Self::accepts`] accepted.
    pub(super) fn encode_values(self, values: &[Scalar], payload: &mut [u8]) {
        let mut rest = payload;
        for value in values {
            let Some((target, after)) = rest.split_at_mut_checked(value.ty().size()) else { return };
            let _ = value.encode(target);
            rest = after;
        }
    }
}

impl Step {
    #[inline]
    fn range(self) -> core::ops::Range<usize> {
        let start = usize::from(self.image);
        start..start.saturating_add(usize::from(self.len))
    }
}

/// Whether none of the binary32 numbers in `run` is infinite or not a number.
#[inline]
fn all_finite(run: &[u8]) -> bool {
    const EXPONENT: u32 = 0x7F80_0000;
    let (floats, _) = run.as_chunks();
    floats.iter().all(|&float| u32::from_le_bytes(float) & EXPONENT != EXPONENT)
}
