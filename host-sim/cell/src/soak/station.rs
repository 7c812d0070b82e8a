//! A field device made up from a port's own recipe: what it sends is right most of the time, and
//! everything else sometimes.
//!
//! In: the gateway's configuration and a seed. Out: frames, at times that no cycle of the gateway
//! shares. A device has moods that last for seconds: steady, hasty, silent, stuck, careless.

use proto_core::config::{Bus, FieldSpec, GatewayConfig, InputBinding, Port};
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
}

/// What a field's values are like.
#[derive(Debug, Clone)]
enum Content {
    /// Bits that come and go one by one.
    Bits,
    /// Numbers of this type; `most` keeps them where a bound variable takes most of them.
    Number { ty: ScalarType, most: f64 },
    /// Numbers that pick commands, now and then.
    Orders { ty: ScalarType, values: Vec<i64> },
}

/// How the device behaves at present.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Mood {
    Steady,
    Hasty,
    Silent,
    Stuck,
    Careless,
}

/// One device for all frames of a port.
#[derive(Debug)]
pub(super) struct Station {
    rng: Rng,
    templates: Vec<Template>,
    /// The values of the frame before, a template.
    values: Vec<Vec<Scalar>>,
    /// How long the device may take before it is overdue.
    timeout: Duration,
    /// What a frame takes on the line.
    frame_time: Duration,
    mood: Mood,
    mood_ends: Instant,
    /// Until then orders stay as they are, as long as somebody's finger is on the button.
    pressed_until: Instant,
    next: Instant,
    nth: usize,
}

impl Station {
    /// A device for the port; `None` for a port without an input part, and for a listening one.
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
                });
            }
            (Bus::Can { .. }, proto_core::config::Parts::Can { input, .. }) => {
                templates.extend(input.iter().map(|frame| Template {
                    head: Vec::new(),
                    tail: Vec::new(),
                    id: Some(frame.id),
                    fields: frame.fields.of(&config.fields).iter().map(|f| content(config, f)).collect(),
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
            mood: Mood::Steady,
            mood_ends: start,
            pressed_until: start,
            next,
            nth: 0,
        })
    }

    fn deadline(&self) -> Instant {
        self.next
    }

    fn change_mood(&mut self, now: Instant) {
        let rng = &mut self.rng;
        (self.mood, self.mood_ends) = match rng.below(20) {
            0..12 => (Mood::Steady, now + rng.up_to(Duration::from_secs(20))),
            12..15 => (Mood::Hasty, now + rng.up_to(Duration::from_secs(2))),
            15 => (Mood::Silent, now + rng.up_to(self.timeout.saturating_mul(4))),
            16 => (Mood::Silent, now + self.timeout + rng.up_to(Duration::from_secs(10))),
            17 => (Mood::Stuck, now + rng.up_to(Duration::from_secs(5))),
            _ => (Mood::Careless, now + rng.up_to(Duration::from_secs(3))),
        };
    }

    /// Which template is next, with new values, and when the one after it leaves.
    fn step(&mut self, now: Instant) -> Option<usize> {
        if now >= self.mood_ends {
            self.change_mood(now);
        }
        let timeout = self.timeout.as_micros();
        let pause = match self.mood {
            Mood::Steady => self.rng.between(timeout / 8, timeout * 6 / 10),
            // As fast as the line can, and now and then faster.
            Mood::Hasty => self.rng.between(0, self.frame_time.as_micros() * 2),
            Mood::Silent => {
                self.next = self.mood_ends.max(now + Duration::from_micros(1));
                return None;
            }
            Mood::Stuck => timeout / 3,
            Mood::Careless => self.rng.between(timeout / 20, timeout * 2),
        };
        // What the line cannot carry in time would only pile up at its beginning.
        let floor = self.frame_time.as_micros().max(100);
        self.next = now + Duration::from_micros(pause.max(floor));
        self.nth = (self.nth + 1) % self.templates.len();
        if self.mood != Mood::Stuck {
            let template = &self.templates[self.nth];
            let is_pressed = now < self.pressed_until;
            for (value, content) in self.values[self.nth].iter_mut().zip(&template.fields) {
                let is_order = matches!(content, Content::Orders { .. });
                if is_order && is_pressed {
                    continue;
                }
                let before = std::mem::replace(value, changed(&mut self.rng, content, *value));
                // A button is pressed for a moment, or for seconds.
                if is_order && before != *value && self.rng.below(2) == 0 {
                    self.pressed_until = now + self.rng.up_to(Duration::from_secs(6));
                }
            }
        }
        Some(self.nth)
    }

    fn payload(&self, nth: usize) -> Vec<u8> {
        let mut bytes = Vec::with_capacity(64);
        for value in &self.values[nth] {
            put(*value, &mut bytes);
        }
        bytes
    }
}

impl Device<Vec<u8>> for Station {
    fn deadline(&self) -> Instant {
        self.deadline()
    }

    fn poll(&mut self, now: Instant) -> Vec<Vec<u8>> {
        let Some(nth) = self.step(now) else { return Vec::new() };
        let template = &self.templates[nth];
        let mut frame = template.head.clone();
        frame.extend(self.payload(nth));
        frame.extend(&template.tail);
        if self.mood == Mood::Careless {
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
                // A head, and then the frame.
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

impl Device<CanFrame> for Station {
    fn deadline(&self) -> Instant {
        self.deadline()
    }

    fn poll(&mut self, now: Instant) -> Vec<CanFrame> {
        let Some(nth) = self.step(now) else { return Vec::new() };
        let mut data = self.payload(nth);
        let mut id = self.templates[nth].id.unwrap_or(CanId::Standard(0));
        let mut is_remote = false;
        if self.mood == Mood::Careless {
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

fn content(config: &GatewayConfig, field: &FieldSpec) -> Content {
    let of_var = |var: SysVar| match var.ty() {
        ScalarType::Byte => Content::Bits,
        ty => Content::Number { ty, most: 1e4 },
    };
    match *field {
        FieldSpec::System(var) => of_var(var),
        FieldSpec::UserInput { ty, to: InputBinding::Commands { table, .. } } => {
            Content::Orders { ty, values: table.of(&config.commands).iter().map(|e| e.value).collect() }
        }
        FieldSpec::UserInput { ty: ScalarType::Byte, .. } => Content::Bits,
        FieldSpec::UserInput { ty, .. } | FieldSpec::UserOutput { ty, .. } => {
            Content::Number { ty, most: 1e3 }
        }
    }
}

fn zero(content: &Content) -> Scalar {
    match content {
        Content::Bits => Scalar::Byte(0),
        Content::Number { ty, .. } | Content::Orders { ty, .. } => number(*ty, 0.0),
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
                // Sixteenths, so that decimal and binary agree for whoever reads a trace.
                let steps = (most * 32.0) as u64;
                number(*ty, rng.below(steps) as f64 / 16.0 - most)
            }
        },
        Content::Orders { ty, values } => {
            let picks = rng.below(25) == 0 && !values.is_empty();
            let value = if picks { values[rng.below(values.len() as u64) as usize] } else { 0 };
            match rng.below(30) {
                0 => number(*ty, rng.below(256) as f64),
                _ => number(*ty, value as f64),
            }
        }
    }
}

/// Little-endian, by hand.
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
