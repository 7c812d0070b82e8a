//! The expected frame of a serial line, to compare received bytes with.

use proto_core::config::{ConfigView, DeviceFrame, FieldSpec, Parts, Recipe, StreamPart};
use proto_core::device::{Boundary, ByteOrder, Carrier, Element, Escape, Kind, Part};
use proto_core::sysvar::Direction;
use proto_core::wire::scalar::ScalarType;

/// The frame of a stream recipe's input part.
#[derive(Debug, Clone)]
pub(crate) struct Shape<'c> {
    pub(crate) head: &'c [u8],
    pub(crate) tail: &'c [u8],
    /// Length in bytes, if it is the same for all frames and nothing but the fields ends them.
    pub(crate) len: Option<usize>,
    /// All fields of the part, in order.
    pub(crate) fields: &'c [FieldSpec],
    /// What separates frames, if not their fields.
    pub(crate) boundary: Boundary,
    pub(crate) escape: Option<Escape>,
    pub(crate) floats: Vec<NumberField>,
    pub(crate) constants: Vec<Constant>,
    /// The frame of a device, with its fields; `None` for a recipe that the controller can have.
    pub(crate) device: Option<(DeviceFrame, &'c [FieldSpec], Carrier)>,
}

/// A number at a fixed place.
#[derive(Debug, Clone, Copy)]
pub(crate) struct NumberField {
    pub(crate) at: usize,
    pub(crate) size: usize,
    pub(crate) order: ByteOrder,
}

/// Bytes that are the same in every frame.
#[derive(Debug, Clone)]
pub(crate) struct Constant {
    pub(crate) at: usize,
    pub(crate) bytes: Vec<u8>,
}

impl<'c> Shape<'c> {
    /// `None` if the recipe has no input part on a line.
    pub(crate) fn of(config: ConfigView<'c>, recipe: &'c Recipe) -> Option<Self> {
        let Parts::Stream { input: Some(part), .. } = &recipe.parts else { return None };
        let fields = part.fields.of(config.fields);
        let mut shape = Self {
            head: &part.head,
            tail: &part.tail,
            len: None,
            fields,
            boundary: part.framing,
            escape: part.escape,
            floats: Vec::new(),
            constants: Vec::new(),
            device: None,
        };
        if config.is_device(recipe) {
            shape.lay_out(part, fields);
        } else {
            let mut at = part.head.len();
            for field in fields {
                let ty = match *field {
                    FieldSpec::System(var) => var.ty(),
                    FieldSpec::UserInput { ty, .. } => ty,
                    _ => return Some(shape),
                };
                shape.add_number(at, ty, ByteOrder::Little);
                at += ty.size();
            }
            shape.len = Some(at + part.tail.len());
        }
        Some(shape)
    }

    fn add_number(&mut self, at: usize, ty: ScalarType, order: ByteOrder) {
        if matches!(ty, ScalarType::Float | ScalarType::Double) {
            self.floats.push(NumberField { at, size: ty.size(), order });
        }
    }

    /// The places of a device's fields.
    fn lay_out(&mut self, part: &'c StreamPart, fields: &'c [FieldSpec]) {
        let is_cut = part.framing != Boundary::Fields || part.escape.is_some();
        let carrier = if is_cut { Carrier::Whole } else { Carrier::Stream };
        let delimiters = (&*part.head, &*part.tail);
        let Ok(frame) = DeviceFrame::new(carrier, Direction::Input, delimiters, fields) else { return };
        let (shortest, longest) = frame.layout.lengths();
        self.len = (shortest == longest && !is_cut).then_some(longest);
        frame.layout.parts(&frame.elements, |part, place| {
            let (Part::Element(nth), Some(at)) = (part, place.at) else { return };
            match frame.elements.get(nth) {
                Some(&Element::Value { encoding, .. }) => {
                    if let Kind::Scalar(ty) = encoding.kind {
                        self.add_number(at, ty, encoding.order);
                    }
                }
                Some(&Element::Fixed { encoding, value }) if !matches!(encoding.kind, Kind::Bits(_)) => {
                    let mut bytes = vec![0; encoding.size().unwrap_or(0)];
                    if encoding.write(value as f64, &mut bytes).is_some() {
                        self.constants.push(Constant { at, bytes });
                    }
                }
                _ => {}
            }
        });
        self.device = Some((frame, fields, carrier));
    }

    /// Minimum and maximum length of a frame in bytes without escape bytes, if known.
    pub(crate) fn lengths(&self) -> Option<(usize, usize)> {
        let of_device = self.device.as_ref().map(|(frame, ..)| frame.layout.lengths());
        of_device.or_else(|| self.len.map(|len| (len, len)))
    }

    /// The beginnings of frames whose head and tail are right, if all frames have the same length.
    pub(crate) fn frames<'b>(&self, bytes: &'b [u8]) -> Vec<&'b [u8]> {
        let Some(len) = self.len else { return Vec::new() };
        let (mut at, mut frames) = (0, Vec::new());
        while let Some(frame) = bytes.get(at..at + len) {
            let is_frame = frame.starts_with(self.head) && frame.ends_with(self.tail);
            if is_frame && !(self.head.is_empty() && self.tail.is_empty()) {
                frames.push(frame);
                at += len;
            } else {
                at += 1;
            }
        }
        frames
    }
}
