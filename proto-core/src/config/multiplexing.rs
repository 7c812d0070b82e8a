//! Frames with the same CAN id that a constant tells apart (multiplexed messages in CAN databases).
//!
//! In: the fields of frames. Out: which bits of a frame are constant, and whether two frames differ in one of them.

use super::{ConfigView, DeviceFrame, FieldSpec, FrameSpec, OutputBinding, Parts, Recipe};
use crate::device::{Carrier, Encoding, Kind, LayoutError, Overflow, Part};
use crate::recipe::model::Mode;
use crate::sysvar::Direction;
use crate::wire::can::{CanId, MAX_CAN_DATA};

/// Number of bytes compared: a whole CAN frame, and the first bytes of a frame on a line.
const LOOKED_AT: usize = 32;
const _: () = assert!(LOOKED_AT >= MAX_CAN_DATA);

/// The constant bits at the beginning of a frame.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Constants {
    mask: [u8; LOOKED_AT],
    value: [u8; LOOKED_AT],
}

impl Constants {
    /// The constant bits of a frame with these fields; none if its layout is invalid.
    pub fn of(fields: &[FieldSpec], part: Direction) -> Self {
        Self::of_frame(DeviceFrame::new(Carrier::Can, part, (&[], &[]), fields), &[], fields)
    }

    /// The constant bits of a frame with its head and layout.
    fn of_frame(frame: Result<DeviceFrame, LayoutError>, head: &[u8], fields: &[FieldSpec]) -> Self {
        let mut constants = Self::default();
        let Ok(frame) = frame else { return constants };
        for ((mask, value), byte) in constants.mask.iter_mut().zip(&mut constants.value).zip(head) {
            (*mask, *value) = (0xFF, *byte);
        }
        frame.layout.parts(&frame.elements, |part, place| {
            let Part::Element(nth) = part else { return };
            let field = fields.iter().filter(|field| field.element().is_some()).nth(nth);
            if let (Some((encoding, value)), Some(at)) = (field.and_then(constant), place.at) {
                constants.add(at, &encoding, value);
            }
        });
        constants
    }

    fn add(&mut self, at: usize, encoding: &Encoding, value: f64) {
        let (Some(mask), Some(bytes)) = (self.mask.get_mut(at..), self.value.get_mut(at..)) else { return };
        if encoding.size().unwrap_or(0) > mask.len() {
            return;
        }
        match encoding.kind {
            // -1 sets all bits; other bits of the number are kept.
            Kind::Bits(_) => {
                encoding.write(-1.0, mask);
            }
            _ => mask.iter_mut().take(encoding.size().unwrap_or(0)).for_each(|byte| *byte = 0xFF),
        }
        encoding.write(value, bytes);
    }

    /// Whether each of these bits is also constant, with the same value, in the other frame.
    fn are_all_of(&self, other: &Self) -> bool {
        let is_new = self.mask.iter().zip(&other.mask).any(|(own, other)| own & !other != 0);
        !is_new && !self.differ(other)
    }

    /// Whether a bit is constant in both frames, with different values.
    pub fn differ(&self, other: &Self) -> bool {
        let masks = self.mask.iter().zip(&other.mask).map(|(one, other)| one & other);
        let values = self.value.iter().zip(&other.value).map(|(one, other)| one ^ other);
        masks.zip(values).any(|(mask, value)| mask & value != 0)
    }
}

impl FrameSpec {
    /// Whether no received bytes can match both frames.
    pub(crate) fn is_distinct_from(&self, other: &Self, config: ConfigView<'_>) -> bool {
        if self.id != other.id {
            return true;
        }
        let lengths =
            |frame: &Self| frame.layout(config, Direction::Input).ok().map(|frame| frame.layout.lengths());
        if let (Some((short, long)), Some((shortest, longest))) = (lengths(self), lengths(other))
            && (long < shortest || longest < short)
        {
            return true;
        }
        let constants = |frame: &Self| frame.constants(config, Direction::Input);
        constants(self).differ(&constants(other))
    }

    /// Whether all received bytes that match the other frame also match this one, if this one is checked first. On a
    /// line also whether they begin with this one, in any order.
    pub(crate) fn hides(&self, other: &Self, is_first: bool, config: ConfigView<'_>) -> bool {
        let lengths =
            |frame: &Self| frame.layout(config, Direction::Input).ok().map(|frame| frame.layout.lengths());
        let (Some((short, long)), Some((shortest, longest))) = (lengths(self), lengths(other)) else {
            return false;
        };
        let is_summed = |frame: &Self| {
            frame.fields.of(config.fields).iter().any(|field| matches!(field, FieldSpec::Checksum(_)))
        };
        let [own, others] = [self, other].map(|frame| frame.constants(config, Direction::Input));
        self.id == other.id
            && own.are_all_of(&others)
            && (is_first && short <= shortest && longest <= long && (!is_summed(self) || is_summed(other))
                || self.id.is_none()
                    && self.tail.is_empty()
                    && short == long
                    && long < shortest
                    && !is_summed(self))
    }

    /// Whether this received frame may have the bytes of that request.
    pub(crate) fn may_echo(&self, request: &Self, config: ConfigView<'_>) -> bool {
        let lengths =
            |frame: &Self, part| frame.layout(config, part).ok().map(|frame| frame.layout.lengths());
        let overlap = match (lengths(self, Direction::Input), lengths(request, Direction::Output)) {
            (Some((short, long)), Some((shortest, longest))) => long >= shortest && longest >= short,
            _ => true,
        };
        self.id == request.id
            && overlap
            && !self.constants(config, Direction::Input).differ(&request.constants(config, Direction::Output))
    }

    fn constants(&self, config: ConfigView<'_>, part: Direction) -> Constants {
        let fields = self.fields.of(config.fields);
        Constants::of_frame(self.layout(config, part), &self.head, fields)
    }
}

/// The encoding and the value of a constant.
fn constant(field: &FieldSpec) -> Option<(Encoding, f64)> {
    let (encoding, overflow, value) = match *field {
        FieldSpec::Fixed { encoding, value } => (encoding, Overflow::Usual, value as f64),
        FieldSpec::UserOutput { ty, from: OutputBinding::Constant(value) } => {
            (Encoding::scalar(ty), Overflow::Usual, value)
        }
        FieldSpec::DeviceOutput { encoding, overflow, from: OutputBinding::Constant(value) } => {
            (encoding, overflow, value)
        }
        _ => return None,
    };
    Some((encoding, encoding.fit(value, overflow)?))
}

impl<'c> ConfigView<'c> {
    /// The CAN ids of the frames that a port with this recipe receives (input) or sends (output), including those of
    /// exchanges; each id once.
    pub fn can_ids(self, recipe: &'c Recipe, part: Direction) -> impl Iterator<Item = CanId> + 'c {
        let all = move || self.all_can_ids(recipe, part);
        all()
            .enumerate()
            .filter(move |&(nth, id)| all().take(nth).all(|before| before != id))
            .map(|(_, id)| id)
    }

    fn all_can_ids(self, recipe: &'c Recipe, part: Direction) -> impl Iterator<Item = CanId> + 'c {
        let frames = match (&recipe.parts, part) {
            (Parts::Can { input, .. }, Direction::Input) => &input[..],
            (Parts::Can { output, .. }, Direction::Output) => &output[..],
            (Parts::Stream { .. }, _) => &[],
        };
        let exchanges = self.exchanges_of(recipe).iter();
        let asked = exchanges.flat_map(move |exchange| exchange.frames(part));
        let ids = asked.filter_map(move |nth| self.frames.get(usize::from(nth))?.id);
        frames.iter().map(|frame| frame.id).chain(ids)
    }
}

impl Recipe {
    /// Whether frames of a part share an id, which only devices' recipes allow.
    pub(crate) fn repeats_ids(&self) -> bool {
        let Parts::Can { input, output } = &self.parts else { return false };
        self.mode == Mode::User
            && [input, output].into_iter().any(|frames| {
                (0_usize..)
                    .zip(frames)
                    .any(|(nth, frame)| frames.iter().take(nth).any(|before| before.id == frame.id))
            })
    }
    /// Whether a frame without data is sent, which only devices' recipes allow.
    pub(crate) fn sends_empty(&self) -> bool {
        let Parts::Can { output, .. } = &self.parts else { return false };
        self.mode == Mode::User && output.iter().any(|frame| frame.fields.len == 0)
    }
}
