//! A simulated field device that sends random frames of a port's recipe, most of them valid.
//!
//! In: the gateway's configuration and a seed. Out: frames at random times. A device changes its behaviour
//! every few seconds: steady, hasty, silent, stuck, careless.

use proto_core::config::{
    Bus, CommandEntry, DeviceFrame, FieldSpec, GatewayConfig, InputBinding, Port, Span,
};
use proto_core::device::Carrier;
use proto_core::sysvar::{Direction, SysVar};
use proto_core::time::{Duration, Instant};
use proto_core::wire::can::{CanFrame, CanId};
use proto_core::wire::scalar::{Scalar, ScalarType};

use crate::{Device, Rng};

/// A frame that the device can send.
#[derive(Debug, Clone)]
struct Template {
    head: Vec<u8>,
    tail: Vec<u8>,
    id: Option<CanId>,
    fields: Vec<Content>,
    /// A device's own frame, whose elements are the fields without the checksum.
    device: Option<Box<DeviceFrame>>,
}

/// The kind of values of a field.
#[derive(Debug, Clone)]
enum Content {
    /// Bits, which mostly change one at a time.
    Bits,
    /// Numbers of this type, mostly up to `most`, which most bound variables accept.
    Number { ty: ScalarType, most: f64 },
    /// A constant, or padding.
    Constant,
    /// No element of the frame: the layout makes it.
    Checksum,
    /// Numbers that sometimes pick commands.
    Commands { ty: ScalarType, values: Vec<i64> },
}

/// How the device behaves for some time.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Behaviour {
    Steady,
    Hasty,
    Silent,
    Stuck,
    Careless,
}

/// One device for all frames of a port.
#[derive(Debug)]
pub(super) struct RandomDevice {
    rng: Rng,
    templates: Vec<Template>,
    /// The newest values, by template.
    values: Vec<Vec<Scalar>>,
    /// The port's timeout.
    timeout: Duration,
    /// Time of a frame on the line.
    frame_time: Duration,
    behaviour: Behaviour,
    behaviour_ends: Instant,
    /// Values of command fields do not change before this, like a button that is held.
    pressed_until: Instant,
    next: Instant,
    nth: usize,
}

impl RandomDevice {
    /// A device for the port; `None` if the port has no input part or is a listening one.
    pub(super) fn new(config: &GatewayConfig, port: &Port, start: Instant, mut rng: Rng) -> Option<Self> {
        let recipe = config.recipes.get(usize::from(port.recipe))?;
        let mut templates = Vec::new();
        match (&port.bus, &recipe.parts) {
            (Bus::Rs485(_), proto_core::config::Parts::Stream { input: Some(part), .. }) => {
                let fields = part.fields.of(&config.fields).iter();
                templates.push(Template {
                    head: part.head.to_vec(),
                    tail: part.tail.to_vec(),
                    id: None,
                    fields: fields.map(|field| content(config, field)).collect(),
                    device: device_frame(config, Carrier::Stream, (&part.head, &part.tail), part.fields),
                });
            }
            (Bus::Can { .. }, proto_core::config::Parts::Can { input, .. }) => {
                templates.extend(input.iter().map(|frame| Template {
                    head: Vec::new(),
                    tail: Vec::new(),
                    id: Some(frame.id),
                    fields: frame.fields.of(&config.fields).iter().map(|f| content(config, f)).collect(),
                    device: device_frame(config, Carrier::Can, (&[], &[]), frame.fields),
                }));
            }
            _ => return None,
        }
        if templates.is_empty() {
            return None;
        }
        let frame_time = config.view().budget(port, Direction::Input).map_or(Duration::ZERO, |b| b.time);
        let values = templates.iter().map(|template| template.fields.iter().map(zero).collect()).collect();
        let next = start + rng.up_to(port.timeout);
        Some(Self {
            rng,
            templates,
            values,
            timeout: port.timeout,
            frame_time,
            behaviour: Behaviour::Steady,
            behaviour_ends: start,
            pressed_until: start,
            next,
            nth: 0,
        })
    }

    fn deadline(&self) -> Instant {
        self.next
    }

    fn change_behaviour(&mut self, now: Instant) {
        let rng = &mut self.rng;
        (self.behaviour, self.behaviour_ends) = match rng.below(20) {
            0..12 => (Behaviour::Steady, now + rng.up_to(Duration::from_secs(20))),
            12..15 => (Behaviour::Hasty, now + rng.up_to(Duration::from_secs(2))),
            15 => (Behaviour::Silent, now + rng.up_to(self.timeout.saturating_mul(4))),
            16 => (Behaviour::Silent, now + self.timeout + rng.up_to(Duration::from_secs(10))),
            17 => (Behaviour::Stuck, now + rng.up_to(Duration::from_secs(5))),
            _ => (Behaviour::Careless, now + rng.up_to(Duration::from_secs(3))),
        };
    }

    /// Advances to the next template, with new values, and sets the next deadline. Returns the template's
    /// index; `None` if the device is silent.
    fn step(&mut self, now: Instant) -> Option<usize> {
        if now >= self.behaviour_ends {
            self.change_behaviour(now);
        }
        let timeout = self.timeout.as_micros();
        let pause = match self.behaviour {
            Behaviour::Steady => self.rng.between(timeout / 8, timeout * 6 / 10),
            // About as fast as the line allows, sometimes faster.
            Behaviour::Hasty => self.rng.between(0, self.frame_time.as_micros() * 2),
            Behaviour::Silent => {
                self.next = self.behaviour_ends.max(now + Duration::from_micros(1));
                return None;
            }
            Behaviour::Stuck => timeout / 3,
            Behaviour::Careless => self.rng.between(timeout / 20, timeout * 2),
        };
        // Frames beyond the line's rate would only queue up.
        let floor = self.frame_time.as_micros().max(100);
        self.next = now + Duration::from_micros(pause.max(floor));
        self.nth = (self.nth + 1) % self.templates.len();
        if self.behaviour != Behaviour::Stuck {
            let template = &self.templates[self.nth];
            let is_pressed = now < self.pressed_until;
            for (value, content) in self.values[self.nth].iter_mut().zip(&template.fields) {
                let is_command = matches!(content, Content::Commands { .. });
                if is_command && is_pressed {
                    continue;
                }
                let before = std::mem::replace(value, changed(&mut self.rng, content, *value));
                // A button is pressed briefly, or for seconds.
                if is_command && before != *value && self.rng.below(2) == 0 {
                    self.pressed_until = now + self.rng.up_to(Duration::from_secs(6));
                }
            }
        }
        Some(self.nth)
    }

    /// The bytes between head and tail; in a device's own frame, with its checksum.
    fn payload(&self, nth: usize) -> Vec<u8> {
        let template = &self.templates[nth];
        if let Some(device) = &template.device {
            let elements = template.fields.iter().zip(&self.values[nth]);
            let elements = elements.filter(|(content, _)| !matches!(content, Content::Checksum));
            let numbers: Vec<f64> = elements.map(|(_, value)| value.as_f64()).collect();
            let mut bytes = [0; 512];
            let len = device.layout.encode(&device.elements, |nth| numbers[nth], &mut bytes);
            let len = len.unwrap_or(0);
            let tail = len.saturating_sub(template.tail.len());
            return bytes.get(template.head.len()..tail).unwrap_or(&[]).to_vec();
        }
        let mut bytes = Vec::with_capacity(64);
        for value in &self.values[nth] {
            put(*value, &mut bytes);
        }
        bytes
    }
}

impl Device<Vec<u8>> for RandomDevice {
    fn deadline(&self) -> Instant {
        self.deadline()
    }

    fn poll(&mut self, now: Instant) -> Vec<Vec<u8>> {
        let Some(nth) = self.step(now) else { return Vec::new() };
        let template = &self.templates[nth];
        let mut frame = template.head.clone();
        frame.extend(self.payload(nth));
        frame.extend(&template.tail);
        if self.behaviour == Behaviour::Careless {
            let rng = &mut self.rng;
            let len = frame.len() as u64;
            match rng.below(6) {
                0 => frame.truncate(rng.between(1, len) as usize),
                1 => drop(frame.drain(..rng.below(len) as usize)),
                2 => {
                    let at = rng.below(len) as usize;
                    frame[at] ^= 1 << rng.below(8);
                }
                3 => {
                    let more = rng.between(1, 20) as usize;
                    frame.extend(rng.bytes(more));
                }
                // A head before the frame.
                4 => drop(frame.splice(..0, template.head.clone())),
                _ => {
                    let twice = frame.clone();
                    frame.extend(twice);
                }
            }
        }
        vec![frame]
    }
}

impl Device<CanFrame> for RandomDevice {
    fn deadline(&self) -> Instant {
        self.deadline()
    }

    fn poll(&mut self, now: Instant) -> Vec<CanFrame> {
        let Some(nth) = self.step(now) else { return Vec::new() };
        let mut data = self.payload(nth);
        let mut id = self.templates[nth].id.unwrap_or(CanId::Standard(0));
        let mut is_remote = false;
        if self.behaviour == Behaviour::Careless {
            match self.rng.below(4) {
                0 => data.truncate(self.rng.below(8) as usize),
                1 => id = CanId::Standard(self.rng.below(0x800) as u16),
                2 => is_remote = true,
                _ => {}
            }
        }
        let frame = if is_remote { CanFrame::remote(id, data.len()) } else { CanFrame::new(id, &data) };
        frame.into_iter().collect()
    }
}

/// The frame, if it is a device's own.
fn device_frame(
    config: &GatewayConfig,
    carrier: Carrier,
    delimiters: (&[u8], &[u8]),
    fields: Span,
) -> Option<Box<DeviceFrame>> {
    let fields = fields.of(&config.fields);
    let is_device = fields.iter().any(FieldSpec::is_device);
    // Validation has refused what cannot be laid out.
    let frame = is_device.then(|| DeviceFrame::new(carrier, Direction::Input, delimiters, fields).ok());
    frame.flatten().map(Box::new)
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
        // Texts and frames of varying length are refused when the scenario is read.
        FieldSpec::Fixed { .. }
        | FieldSpec::Padding { .. }
        | FieldSpec::TextInput { .. }
        | FieldSpec::TextOutput { .. }
        | FieldSpec::Length(_) => Content::Constant,
        FieldSpec::Checksum(_) => Content::Checksum,
    }
}

/// The first and the last value of a command.
fn ends(entry: &CommandEntry) -> impl Iterator<Item = i64> + use<> {
    let (first, last) = (entry.first, entry.last);
    [first, last].into_iter().take(if first == last { 1 } else { 2 })
}

fn zero(content: &Content) -> Scalar {
    match content {
        Content::Bits | Content::Constant | Content::Checksum => Scalar::Byte(0),
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

fn changed(rng: &mut Rng, content: &Content, before: Scalar) -> Scalar {
    match content {
        Content::Constant | Content::Checksum => before,
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
