//! A simulated field device that sends random frames of a port's recipe, most of them valid.
//!
//! In: the gateway's configuration and a seed. Out: frames at random times. The device changes its behaviour every few
//! seconds: steady, hasty, silent, stuck, careless.

use proto_core::config::{Bus, GatewayConfig, Port};
use proto_core::sysvar::Direction;
use proto_core::time::{Duration, Instant};
use proto_core::wire::can::{CanFrame, CanId};
use proto_core::wire::scalar::Scalar;

use super::template::{Content, Template, changed};
use crate::{Device, Rng};

/// How the device behaves for some time.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Behaviour {
    Steady,
    Hasty,
    Silent,
    Stuck,
    Careless,
}

/// A device that sends all frames of a port.
#[derive(Debug)]
pub(super) struct RandomDevice {
    rng: Rng,
    templates: Vec<Template>,
    /// The newest values, by template.
    values: Vec<Vec<Scalar>>,
    /// The port's timeout. If frames with alive counters take turns, one frame's part of it.
    timeout: Duration,
    /// Transmission time of a frame on the line.
    frame_time: Duration,
    behaviour: Behaviour,
    behaviour_ends: Instant,
    /// Values of command fields do not change before this, as if a button is held.
    pressed_until: Instant,
    next: Instant,
    nth: usize,
}

impl RandomDevice {
    /// A device for the port; `None` if the port has no input part or is a listening port.
    pub(super) fn new(config: &GatewayConfig, port: &Port, start: Instant, mut rng: Rng) -> Option<Self> {
        let recipe = config.recipes.get(usize::from(port.recipe))?;
        let mut templates = Vec::new();
        match (&port.bus, &recipe.parts) {
            (Bus::Rs485(_), proto_core::config::Parts::Stream { input: Some(part), .. }) => {
                templates.push(Template::of_part(config, part));
            }
            (Bus::Can { .. }, proto_core::config::Parts::Can { input, .. }) => {
                templates.extend(input.iter().map(|frame| {
                    Template::new(config, Some(frame.id), (&[], &[]), frame.fields.of(&config.fields))
                }));
            }
            _ => return None,
        }
        if templates.is_empty() {
            return None;
        }
        let frame_time = config.view().budget(port, Direction::Input).map_or(Duration::ZERO, |b| b.time);
        let values = templates.iter().map(Template::zeros).collect();
        let turns = if templates.iter().any(Template::counts) { templates.len() as u32 } else { 1 };
        let next = start + rng.up_to(port.timeout);
        Some(Self {
            rng,
            templates,
            values,
            timeout: Duration::from_micros(port.timeout.as_micros() / u64::from(turns)),
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

    /// Advances to the next template, with new values, and sets the next deadline. Returns the index of the template;
    /// `None` if the device is silent.
    fn step(&mut self, now: Instant) -> Option<usize> {
        if now >= self.behaviour_ends {
            self.change_behaviour(now);
        }
        let timeout = self.timeout.as_micros();
        let pause = match self.behaviour {
            Behaviour::Steady => self.rng.between(timeout / 8, timeout * 6 / 10),
            // About as fast as the line allows, sometimes faster than that.
            Behaviour::Hasty => self.rng.between(0, self.frame_time.as_micros() * 2),
            Behaviour::Silent => {
                self.next = self.behaviour_ends.max(now + Duration::from_micros(1));
                return None;
            }
            Behaviour::Stuck => timeout / 3,
            Behaviour::Careless => self.rng.between(timeout / 20, timeout * 2),
        };
        // Frames beyond the line's rate would only be queued.
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
                // A button is pressed briefly, or for several seconds.
                if is_command && before != *value && self.rng.below(2) == 0 {
                    self.pressed_until = now + self.rng.up_to(Duration::from_secs(6));
                }
            }
        }
        Some(self.nth)
    }
}

impl Device<Vec<u8>> for RandomDevice {
    fn deadline(&self) -> Instant {
        self.deadline()
    }

    fn poll(&mut self, now: Instant) -> Vec<Vec<u8>> {
        let Some(nth) = self.step(now) else { return Vec::new() };
        let template = &self.templates[nth];
        let mut frame = template.whole(&self.values[nth]);
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
                // An extra head before the frame.
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
        let mut data = self.templates[nth].payload(&self.values[nth]);
        let mut id = self.templates[nth].id.unwrap_or(CanId::Standard(0));
        let mut is_remote = false;
        if self.behaviour == Behaviour::Careless {
            match self.rng.below(4) {
                0 => data.truncate(self.rng.below(8) as usize),
                1 => id = CanId::Standard(self.rng.below(0x800) as u16),
                2 => is_remote = true,
                _ if self.templates[nth].counts() => {
                    let at = self.rng.below(data.len() as u64) as usize;
                    data[at] ^= 1 << self.rng.below(8);
                }
                _ => {}
            }
        }
        let frame = if is_remote { CanFrame::remote(id, data.len()) } else { CanFrame::new(id, &data) };
        frame.into_iter().collect()
    }
}
