//! Frames of devices in a configuration: converts the fields of a frame to the elements of a layout.
//!
//! In: the fields of a user recipe's frame. Out: elements and layout, or the error in them.

use heapless::Vec;

use super::{FieldSpec, InputBinding, Parts, Recipe, StreamPart};
use crate::config::ConfigView;
use crate::device::{Carrier, Checksum, Element, Encoding, FrameLayout, LayoutError};
use crate::recipe::model::MAX_FIELDS;
use crate::sysvar::Direction;

/// The elements of one frame, and its layout.
#[derive(Debug, Clone)]
pub struct DeviceFrame {
    /// The frame's elements, without the checksum.
    pub elements: Vec<Element, MAX_FIELDS>,
    /// Their layout.
    pub layout: FrameLayout,
}

impl DeviceFrame {
    /// Lays out a frame. Head and tail are those of a stream part, or empty.
    ///
    /// # Errors
    /// [`LayoutError`]; its element indices do not count the checksum.
    pub fn new(
        carrier: Carrier,
        direction: Direction,
        (head, tail): (&[u8], &[u8]),
        fields: &[FieldSpec],
    ) -> Result<Self, LayoutError> {
        let mut elements = Vec::new();
        let mut checksum: Option<(Checksum, usize)> = None;
        for field in fields {
            match (field.element(), field) {
                (Some(element), _) => {
                    elements.push(element).map_err(|_| LayoutError::TooManyElements)?;
                }
                (None, FieldSpec::Checksum(sum)) if checksum.is_none() => {
                    checksum = Some((*sum, elements.len()));
                }
                (None, field) if field.is_of_field_before() => {}
                (None, _) => return Err(LayoutError::ChecksumPlace),
            }
        }
        let layout = FrameLayout::new(carrier, direction, head, tail, &elements, checksum)?;
        Ok(Self { elements, layout })
    }
}

/// The index of the field that causes a layout error, if a field does.
pub(super) fn field_of(fields: &[FieldSpec], error: LayoutError) -> Option<u8> {
    // A checksum is a field, but not an element.
    let field = match error.element().map(usize::from) {
        Some(element) => {
            let is_element = |field: &(usize, &FieldSpec)| field.1.element().is_some();
            fields.iter().enumerate().filter(is_element).nth(element).map(|(nth, _)| nth)
        }
        None if error.is_of_checksum() => {
            fields.iter().rposition(|field| matches!(field, FieldSpec::Checksum(_)))
        }
        None => None,
    };
    field.map(|field| field as u8)
}

/// The bits of a register, highest byte first, that belong to fields: the bits that
/// [`Operation::MaskWriteRegister`](crate::modbus::rtu::Operation::MaskWriteRegister) writes. Padding has no bits;
/// fields of more than two bytes, texts and lengths have all.
pub fn register_bits(fields: &[FieldSpec]) -> u16 {
    let (mut bits, mut at, mut shared_at) = (0, 0_usize, 0);
    for element in fields.iter().filter_map(FieldSpec::element) {
        let len = element.len().unwrap_or(2);
        if !element.is_shared() {
            shared_at = at;
            at = at.saturating_add(len);
        }
        let mut register = [0; 2];
        let Some(own) = register.get_mut(shared_at..).and_then(|rest| rest.get_mut(..len)) else {
            return u16::MAX;
        };
        match element.encoding() {
            // -1 sets all bits.
            Some(encoding) if element.bits().is_some() => drop(encoding.write(-1.0, own)),
            None if matches!(element, Element::Padding { .. }) => {}
            _ => own.fill(u8::MAX),
        }
        bits |= u16::from_be_bytes(register);
    }
    bits
}

impl FieldSpec {
    /// Whether only received frames can have this field.
    pub(super) const fn is_input(&self) -> bool {
        matches!(self, Self::UserInput { .. } | Self::DeviceInput { .. } | Self::TextInput { .. })
    }

    /// Whether a received value goes to a variable, selects a command or is an alive counter.
    pub fn has_value(&self) -> bool {
        match self {
            Self::UserInput { to, .. } | Self::DeviceInput { to, .. } => *to != InputBinding::Unused,
            Self::TextInput { .. } => self.variables().next().is_some(),
            _ => false,
        }
    }

    /// Whether only frames of devices can have this field, not the controller's recipes.
    pub const fn is_device(&self) -> bool {
        match self {
            Self::UserInput { to: InputBinding::Counter { .. }, .. } => true,
            Self::System(_) | Self::UserInput { .. } | Self::UserOutput { .. } => false,
            Self::DeviceInput { .. }
            | Self::DeviceOutput { .. }
            | Self::Fixed { .. }
            | Self::Padding { .. }
            | Self::Checksum(_)
            | Self::TextInput { .. }
            | Self::TextOutput { .. }
            | Self::Length(_)
            | Self::Limits(_)
            | Self::Mapped(_)
            | Self::InputRule(_) => true,
        }
    }

    /// The field as an element of a device's frame. `None` for a checksum, for an entry that applies to the field
    /// before it, and for fields of realtime recipes.
    pub const fn element(&self) -> Option<Element> {
        Some(match *self {
            Self::UserInput { ty, .. } | Self::UserOutput { ty, .. } => Element::value(Encoding::scalar(ty)),
            Self::DeviceInput { encoding, overflow, .. } | Self::DeviceOutput { encoding, overflow, .. } => {
                Element::Value { encoding, overflow }
            }
            Self::Fixed { encoding, value } => Element::Fixed { encoding, value },
            Self::Padding { len, fill } => Element::Padding { len, fill },
            Self::TextInput { text, .. } | Self::TextOutput { text, .. } => Element::Text(text),
            Self::Length(length) => Element::Length(length),
            Self::System(_) | Self::Checksum(_) | Self::Limits(_) | Self::Mapped(_) | Self::InputRule(_) => {
                return None;
            }
        })
    }

    /// Maximum number of bytes that the field adds to a frame.
    pub(super) fn longest(&self) -> usize {
        match (self.element(), self) {
            (_, Self::System(var)) => var.size(),
            (_, Self::Checksum(sum)) => sum.len(),
            (Some(element), _) => element.longest(),
            (None, _) => 0,
        }
    }
}

/// One frame of a part in the configuration.
#[derive(Debug, Clone, Copy)]
pub(crate) struct FrameView<'c> {
    /// 0 in a stream recipe, otherwise the index of the CAN frame.
    pub(crate) nth: u8,
    pub(crate) carrier: Carrier,
    pub(crate) delimiters: (&'c [u8], &'c [u8]),
    pub(crate) fields: &'c [FieldSpec],
}

impl<'c> ConfigView<'c> {
    /// The frames of one part of a device's recipe.
    pub(crate) fn device_frames(
        self,
        recipe: &'c Recipe,
        part: Direction,
    ) -> impl Iterator<Item = FrameView<'c>> {
        let is_can = matches!(recipe.parts, Parts::Can { .. });
        let stream = recipe.stream_part(part);
        let carrier = match stream {
            _ if is_can => Carrier::Can,
            Some(part) if part.is_cut() => Carrier::Whole,
            _ => Carrier::Stream,
        };
        let delimiters = stream.map_or((&[][..], &[][..]), |part| (&*part.head, &*part.tail));
        (0..).zip(recipe.part_frames(part)).map(move |(nth, span)| FrameView {
            nth,
            carrier,
            delimiters,
            fields: span.of(self.fields),
        })
    }

    /// Whether a port with this recipe uses frames beyond what the controller's recipes can describe.
    pub fn is_device(self, recipe: &Recipe) -> bool {
        recipe.exchanges.len > 0
            || recipe.repeats_ids()
            || recipe.sends_empty()
            || [Direction::Input, Direction::Output].into_iter().any(|part| {
                recipe.stream_part(part).is_some_and(StreamPart::is_cut)
                    || recipe
                        .part_frames(part)
                        .any(|span| span.of(self.fields).iter().any(FieldSpec::is_device))
            })
    }
}
