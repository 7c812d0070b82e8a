//! Frames with random values, as simulated devices send them.
//!
//! In: the fields of a frame. Out: values that change a little from frame to frame, and the frame's bytes.

use proto_core::config::{CommandEntry, DeviceFrame, FieldSpec, GatewayConfig, InputBinding, StreamPart};
use proto_core::device::{Boundary, Carrier, Probe, TextWidth};
use proto_core::sysvar::{Direction, SysVar};
use proto_core::wire::can::CanId;
use proto_core::wire::scalar::{Scalar, ScalarType};

use crate::Rng;

/// A frame that the device can send.
#[derive(Debug, Clone)]
pub(super) struct Template {
    pub head: Vec<u8>,
    pub tail: Vec<u8>,
    pub id: Option<CanId>,
    pub fields: Vec<Content>,
    /// The frame of a device, if it has one; its elements are the fields without the checksum.
    device: Option<Box<DeviceFrame>>,
}

/// The kind of a field, which determines its random values.
#[derive(Debug, Clone)]
pub(super) enum Content {
    /// Bits; mostly one changes at a time.
    Bits,
    /// Numbers of this type, mostly up to `most`. Most bound variables accept these.
    Number { ty: ScalarType, most: f64 },
    /// A constant, or padding.
    Constant,
    /// The layout computes the checksum; it is no element of the frame.
    Checksum,
    /// A number that increases with each frame, mostly by one, and wraps from `max` to 0.
    Counter { max: u32 },
    /// Numbers that sometimes select commands.
    Commands { ty: ScalarType, values: Vec<i64> },
    /// A text made from a random number. The layout of the frame says how it ends.
    Text { width: TextWidth, ignored: Vec<Vec<u8>>, capacity: usize },
}

impl Template {
    /// A template. Only frames on a bus have an id.
    pub(super) fn new(
        config: &GatewayConfig,
        id: Option<CanId>,
        delimiters: (&[u8], &[u8]),
        fields: &[FieldSpec],
    ) -> Self {
        let carrier = if id.is_some() { Carrier::Can } else { Carrier::Stream };
        Self::carried(config, (carrier, id), delimiters, fields)
    }

    /// A template of a stream part, with the head and tail of that part.
    pub(super) fn of_part(config: &GatewayConfig, part: &StreamPart) -> Self {
        let is_cut = part.framing != Boundary::Fields || part.escape.is_some();
        let carrier = if is_cut { Carrier::Whole } else { Carrier::Stream };
        Self::carried(config, (carrier, None), (&part.head, &part.tail), part.fields.of(&config.fields))
    }

    fn carried(
        config: &GatewayConfig,
        (carrier, id): (Carrier, Option<CanId>),
        delimiters: (&[u8], &[u8]),
        fields: &[FieldSpec],
    ) -> Self {
        let (head, tail) = (delimiters.0.to_vec(), delimiters.1.to_vec());
        let is_device = fields.iter().any(FieldSpec::is_device);
        // Cannot fail: validation refuses fields that have no layout.
        let device = is_device.then(|| DeviceFrame::new(carrier, Direction::Input, delimiters, fields).ok());
        let fields = fields.iter().map(|field| content(config, field)).collect();
        Self { head, tail, id, fields, device: device.flatten().map(Box::new) }
    }

    /// The initial values.
    pub(super) fn zeros(&self) -> Vec<Scalar> {
        self.fields.iter().map(zero).collect()
    }

    /// The bytes between head and tail; in a device's own frame, including its checksum.
    pub(super) fn payload(&self, values: &[Scalar]) -> Vec<u8> {
        if let Some(device) = &self.device {
            let elements = self.fields.iter().zip(values);
            let elements = elements.filter(|(content, _)| !matches!(content, Content::Checksum));
            let numbers: Vec<f64> = elements.map(|(_, value)| value.as_f64()).collect();
            let elements = self.fields.iter().filter(|content| !matches!(content, Content::Checksum));
            let elements: Vec<&Content> = elements.collect();
            let text = |nth: usize, out: &mut [u8]| {
                let text = elements[nth].text(numbers[nth] as u32);
                out.get_mut(..text.len())?.copy_from_slice(&text);
                Some(text.len())
            };
            let mut bytes = [0; 512];
            let number = |nth: usize| numbers[nth];
            let len = device.layout.encode_with(&device.elements, number, text, &mut bytes);
            let len = len.unwrap_or(0);
            let tail = len.saturating_sub(self.tail.len());
            return bytes.get(self.head.len()..tail).unwrap_or(&[]).to_vec();
        }
        let mut bytes = Vec::with_capacity(64);
        for value in values {
            put(*value, &mut bytes);
        }
        bytes
    }

    /// Whether the frame has an alive counter.
    pub(super) fn counts(&self) -> bool {
        self.fields.iter().any(|content| matches!(content, Content::Counter { .. }))
    }

    /// Whether a receiver can detect damage.
    pub(super) fn has_checksum(&self) -> bool {
        self.fields.iter().any(|content| matches!(content, Content::Checksum))
    }

    /// Whether `bytes` begins with a frame of this template.
    pub(super) fn begins(&self, bytes: &[u8]) -> bool {
        let probe = |device: &DeviceFrame| device.layout.probe(&device.elements, bytes);
        self.device.as_ref().is_some_and(|device| matches!(probe(device), Probe::Frame(_)))
    }

    /// The complete frame.
    pub(super) fn whole(&self, values: &[Scalar]) -> Vec<u8> {
        [&self.head[..], &self.payload(values), &self.tail].concat()
    }
}

fn content(config: &GatewayConfig, field: &FieldSpec) -> Content {
    let of_var = |var: SysVar| match var.ty() {
        ScalarType::Byte => Content::Bits,
        ty => Content::Number { ty, most: 1e4 },
    };
    match *field {
        FieldSpec::System(var) => of_var(var),
        FieldSpec::UserInput { ty, to: InputBinding::Commands { table, .. } } => {
            Content::Commands { ty, values: table.of(&config.commands).iter().flat_map(ends).collect() }
        }
        FieldSpec::UserInput { to: InputBinding::Counter { max }, .. }
        | FieldSpec::DeviceInput { to: InputBinding::Counter { max }, .. } => Content::Counter { max },
        FieldSpec::UserInput { ty: ScalarType::Byte, .. } => Content::Bits,
        FieldSpec::UserInput { ty, .. } | FieldSpec::UserOutput { ty, .. } => {
            Content::Number { ty, most: 1e3 }
        }
        FieldSpec::DeviceInput { to: InputBinding::Commands { table, .. }, .. } => Content::Commands {
            ty: ScalarType::Double,
            values: table.of(&config.commands).iter().flat_map(ends).collect(),
        },
        FieldSpec::DeviceInput { .. } | FieldSpec::DeviceOutput { .. } => {
            Content::Number { ty: ScalarType::Double, most: 1e3 }
        }
        FieldSpec::TextInput { text, to, ignored, .. } => Content::Text {
            width: text.width,
            ignored: ignored.iter().map(<[u8]>::to_vec).collect(),
            capacity: to.map_or(8, |words| 2 * usize::from(words.count)),
        },
        FieldSpec::Fixed { .. }
        | FieldSpec::Padding { .. }
        | FieldSpec::TextOutput { .. }
        | FieldSpec::Length(_)
        | FieldSpec::Limits(_)
        | FieldSpec::Mapped(_)
        | FieldSpec::InputRule(_) => Content::Constant,
        FieldSpec::Checksum(_) => Content::Checksum,
    }
}

impl Content {
    /// The text for this number: mostly as long as there is room for, sometimes longer or empty.
    fn text(&self, number: u32) -> Vec<u8> {
        let Self::Text { width, ignored, capacity } = self else { return Vec::new() };
        let (kind, number) = (number % 16, number / 16);
        if kind < 2 && !ignored.is_empty() {
            return ignored[number as usize % ignored.len()].clone();
        }
        let most = match width {
            TextWidth::Fixed(width) => usize::from(*width),
            _ if kind == 2 => capacity + 2,
            _ => *capacity,
        };
        let len = number as usize % (most + 1);
        let letter = |nth: usize| b'A' + ((number >> (nth % 8)) as usize + nth) as u8 % 26;
        (0..len).map(letter).collect()
    }
}

/// The first and the last value that selects a command.
fn ends(entry: &CommandEntry) -> impl Iterator<Item = i64> + use<> {
    let (first, last) = (entry.first, entry.last);
    [first, last].into_iter().take(if first == last { 1 } else { 2 })
}

fn zero(content: &Content) -> Scalar {
    match content {
        Content::Bits | Content::Constant | Content::Checksum => Scalar::Byte(0),
        Content::Counter { .. } | Content::Text { .. } => Scalar::Dword(0),
        Content::Number { ty, .. } | Content::Commands { ty, .. } => number(*ty, 0.0),
    }
}

fn number(ty: ScalarType, value: f64) -> Scalar {
    let (low, high) = ty.range();
    let value = value.clamp(low, high);
    match ty {
        ScalarType::Float => Scalar::Float(value as f32),
        ScalarType::Double => Scalar::Double(value),
        _ => Scalar::from_f64(ty, value.trunc()).unwrap_or(Scalar::Byte(0)),
    }
}

pub(super) fn changed(rng: &mut Rng, content: &Content, before: Scalar) -> Scalar {
    match content {
        Content::Constant | Content::Checksum => before,
        Content::Text { .. } => match rng.below(4) {
            0 => before,
            _ => Scalar::Dword(rng.next_u64() as u32),
        },
        Content::Counter { max } => match (rng.below(80), before.as_f64() as u32) {
            (0, before) => Scalar::Dword(before),
            (1, _) => Scalar::Dword(max + 1),
            (2 | 3, _) => Scalar::Dword(rng.below(u64::from(*max) + 1) as u32),
            (_, before) if before >= *max => Scalar::Dword(0),
            (_, before) => Scalar::Dword(before + 1),
        },
        Content::Bits => match (rng.below(8), before) {
            (0, _) => Scalar::Byte(rng.next_u64() as u8),
            (1..5, Scalar::Byte(bits)) => Scalar::Byte(bits ^ 1 << rng.below(8)),
            _ => before,
        },
        Content::Number { ty, most } => match rng.below(200) {
            0 => match ty {
                ScalarType::Float => Scalar::Float(f32::from_bits(
                    [0x7FC0_0000, 0x7F80_0000, 0x8000_0000][rng.below(3) as usize],
                )),
                ScalarType::Double => {
                    Scalar::Double([f64::NEG_INFINITY, f64::INFINITY, 1e300][rng.below(3) as usize])
                }
                _ => number(*ty, [f64::MAX, f64::MIN][rng.below(2) as usize]),
            },
            1..40 => before,
            _ => {
                // Multiples of 1/16, which are exact in decimal and in binary: traces are easier to read.
                let steps = (most * 32.0) as u64;
                number(*ty, rng.below(steps) as f64 / 16.0 - most)
            }
        },
        Content::Commands { ty, values } => {
            let picks = rng.below(25) == 0 && !values.is_empty();
            let value = if picks { values[rng.below(values.len() as u64) as usize] } else { 0 };
            match rng.below(30) {
                0 => number(*ty, rng.below(256) as f64),
                _ => number(*ty, value as f64),
            }
        }
    }
}

/// Appends a value in little-endian order, independent of proto-core's encoder.
fn put(value: Scalar, bytes: &mut Vec<u8>) {
    match value {
        Scalar::Byte(value) => bytes.push(value),
        Scalar::Char(value) => bytes.extend(value.to_le_bytes()),
        Scalar::Word(value) => bytes.extend(value.to_le_bytes()),
        Scalar::Short(value) => bytes.extend(value.to_le_bytes()),
        Scalar::Dword(value) => bytes.extend(value.to_le_bytes()),
        Scalar::Int(value) => bytes.extend(value.to_le_bytes()),
        Scalar::Float(value) => bytes.extend(value.to_le_bytes()),
        Scalar::Double(value) => bytes.extend(value.to_le_bytes()),
    }
}
