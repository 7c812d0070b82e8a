//! What each field port must send, and when (proto-core/docs/engine.md section 8).

use std::borrow::Cow;

use proto_core::config::{FieldSpec, OutputBinding, SendOn};
use proto_core::device::{Encoding, Overflow};
use proto_core::sysvar::SysVar;
use proto_core::time::{Duration, Instant};
use proto_core::wire::scalar::ScalarType;

use super::Invariant;
use super::device;
use super::field::as_number;
use super::frame::{Frame, Raw};
use super::invariant::Wrong;
use super::spec::{Origin, PortSpec, Spec};
use super::upward::Upward;
use super::varying;

/// The model of one port's transmissions.
#[derive(Debug, Clone, Default)]
pub(super) struct Downward {
    pub is_up: bool,
    pub is_bus_off: bool,
    /// A frame is due as soon as the line is free.
    pub due: bool,
    in_flight: bool,
    /// The next CAN frame of a cycle that has begun.
    next_can: usize,
    /// Number of the newest cycle on the grid.
    slot: Option<u64>,
    next_slot_at: Instant,
    /// The bytes of the newest cycle, for a port that sends on changes.
    newest: Option<Vec<u8>>,
    /// The bytes sent so far in the current cycle.
    begun: Vec<u8>,
    last_bit: Option<bool>,
    pub heard: Instant,
    /// Number of cycles sent, as a counter field sends it.
    cycles: u32,
    pub frames_out: u32,
    pub bytes_out: u32,
    pub skipped: u32,
    pub stale: u32,
}

/// Why a value must not be sent. Most of these cases are no violation, so the text is made only for a violation.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Hidden {
    Unreadable(SysVar),
    Unknown(SysVar),
    Stale(SysVar, Duration),
}

impl Hidden {
    /// The violation if the value was sent nevertheless.
    pub(super) fn wrong(self, spec: &Spec) -> Wrong {
        match self {
            Self::Unreadable(var) => (Invariant::Unreadable, format!("{var} is unreadable")),
            Self::Unknown(var) => (Invariant::Known, format!("{var} was never received")),
            Self::Stale(var, age) => {
                let is_own = spec.origin[var.ordinal()] == Some(Origin::Field);
                let invariant = if is_own { Invariant::OwnAge } else { Invariant::Age };
                (invariant, format!("{var} is {age} old"))
            }
        }
    }
}

impl Downward {
    pub(super) fn is_usable(&self) -> bool {
        self.is_up && !self.is_bus_off
    }

    /// Whether a transmission is not complete, or the line is used by an exchange.
    pub(super) fn is_busy(&self) -> bool {
        self.in_flight
    }

    /// The line is used by an exchange until [`Self::sent`].
    pub(super) fn hold(&mut self) {
        self.in_flight = true;
    }

    fn may_send(&self, port: &PortSpec, now: Instant) -> bool {
        self.due && !self.in_flight && self.is_usable() && now >= self.heard + port.turnaround
    }

    /// A frame becomes due. If one is due already, it is skipped.
    pub(super) fn raise(&mut self) {
        if self.due {
            self.skipped = self.skipped.wrapping_add(1);
        }
        self.due = true;
    }

    /// Handles the cycles that have begun since the last call.
    pub(super) fn tick(&mut self, port: &PortSpec, now: Instant) {
        if port.outputs.is_empty() || !matches!(port.send, SendOn::Period | SendOn::Change) {
            return;
        }
        if now < self.next_slot_at {
            return;
        }
        let slot = now.as_micros() / port.cycle.as_micros();
        self.next_slot_at = Instant::from_micros((slot + 1) * port.cycle.as_micros());
        // On the first call, the current cycle has just begun.
        let before = self.slot.replace(slot).unwrap_or(slot.saturating_sub(1));
        if slot == before || !self.is_usable() {
            return;
        }
        if self.cycles > 0 {
            self.skipped = self.skipped.wrapping_add((slot - before - 1) as u32);
        }
        self.raise();
    }

    /// The device or the bus is gone: nothing is due or in flight.
    pub(super) fn reset(&mut self) {
        self.due = false;
        self.in_flight = false;
        self.next_can = 0;
        self.newest = None;
    }

    pub(super) fn sent(&mut self) {
        self.in_flight = false;
    }

    /// The gateway slept: due frames are dropped, frames that were sent stay in flight.
    pub(super) fn slept(&mut self) {
        let in_flight = self.in_flight;
        self.reset();
        self.in_flight = in_flight;
    }

    /// This many input frames were accepted together.
    pub(super) fn answered(&mut self, port: &PortSpec, frames: u32) {
        if port.send == SendOn::Frame && self.is_usable() && !port.outputs.is_empty() {
            (0..frames).for_each(|_| self.raise());
        }
    }

    /// A value changed: checks for a rising edge of the trigger.
    pub(super) fn watch(&mut self, port: &PortSpec, up: &Upward) {
        let SendOn::Rising { var, bit } = port.send else { return };
        let Some((raw, _)) = up.known(var).value else { return };
        let on = raw[0] >> bit & 1 == 1;
        if on && self.last_bit == Some(false) && self.is_usable() {
            self.raise();
        }
        self.last_bit = Some(on);
    }

    /// Whether all values of the port are known and, if the recipe requires it, not stale.
    fn may_show(port: &PortSpec, up: &Upward, now: Instant) -> Result<(), Hidden> {
        Self::may_show_all(port, up, port.needed.iter().copied(), now)
    }

    /// Whether these values are known and, if the recipe requires it, not stale.
    pub(super) fn may_show_all(
        port: &PortSpec,
        up: &Upward,
        mut vars: impl Iterator<Item = SysVar>,
        now: Instant,
    ) -> Result<(), Hidden> {
        vars.try_for_each(|var| {
            let known = up.known(var);
            if known.unreadable {
                return Err(Hidden::Unreadable(var));
            }
            let Some((_, at)) = known.value.filter(|_| !known.unknown) else {
                return Err(Hidden::Unknown(var));
            };
            let age = now.saturating_since(at);
            if port.stops_when_stale && age > port.stale_after {
                return Err(Hidden::Stale(var, age));
            }
            Ok(())
        })
    }

    /// A request of this many bytes was sent.
    pub(super) fn asked(&mut self, len: usize) {
        self.frames_out = self.frames_out.wrapping_add(1);
        self.bytes_out = self.bytes_out.wrapping_add(len as u32);
        self.cycles = self.cycles.wrapping_add(1);
        self.in_flight = true;
    }

    /// Checks a frame that the engine sends; `id` is the id of a CAN frame.
    pub(super) fn check(
        &mut self,
        spec: &Spec,
        nth: usize,
        up: &Upward,
        id: Option<proto_core::wire::can::CanId>,
        bytes: &[u8],
        now: Instant,
    ) -> Result<(), Wrong> {
        let port = &spec.ports[nth];
        if !self.is_usable() {
            return Err((Invariant::Line, "sent while the device was gone".to_owned()));
        }
        if self.in_flight {
            return Err((Invariant::Line, "sent before the previous frame had left".to_owned()));
        }
        if now < self.heard + port.turnaround {
            return Err((Invariant::Line, "sent before the line was silent for long enough".to_owned()));
        }
        if !self.due {
            return Err((Invariant::Cycle, "sent without a cycle, a request or a trigger for it".to_owned()));
        }
        let Some(frame) = port.outputs.get(self.next_can) else {
            return Err((Invariant::Shown, "sent without an output part".to_owned()));
        };
        if frame.id != id {
            return Err((
                Invariant::Shown,
                format!("frame {} of the cycle has another id", self.next_can + 1),
            ));
        }
        if self.next_can == 0 {
            Self::may_show(port, up, now).map_err(|hidden| hidden.wrong(spec))?;
            self.begun.clear();
        }
        let shown = frame.payload_of(bytes);
        let Some(shown) = shown.filter(|shown| self.agrees(frame, up, shown)) else {
            return Err((Invariant::Shown, "the frame does not have the newest values".to_owned()));
        };
        self.begun.extend_from_slice(shown);
        self.frames_out = self.frames_out.wrapping_add(1);
        self.bytes_out = self.bytes_out.wrapping_add(bytes.len() as u32);
        self.next_can += 1;
        if self.next_can == port.outputs.len() {
            self.next_can = 0;
            self.due = false;
            self.in_flight = true;
            self.cycles = self.cycles.wrapping_add(1);
            if port.send == SendOn::Change {
                if self.newest.as_ref() == Some(&self.begun) {
                    return Err((Invariant::Cycle, "sent without a change".to_owned()));
                }
                self.newest = Some(self.begun.clone());
            }
        }
        Ok(())
    }

    /// The engine has nothing to do: checks that no frame is due that could be sent.
    #[inline]
    pub(super) fn rest(&mut self, port: &PortSpec, up: &Upward, now: Instant) -> Result<(), Wrong> {
        if self.may_send(port, now) { self.rests_unsent(port, up, now) } else { Ok(()) }
    }

    fn rests_unsent(&mut self, port: &PortSpec, up: &Upward, now: Instant) -> Result<(), Wrong> {
        if port.outputs.is_empty() {
            self.due = false;
            return Ok(());
        }
        if Self::may_show(port, up, now).is_err() {
            self.due = false;
            self.stale = self.stale.wrapping_add(1);
            return Ok(());
        }
        let texts = port.outputs.iter().flat_map(|frame| &frame.fields);
        let fits = texts.filter(|field| is_text(field)).all(|field| text_of(field, up).is_some());
        if !fits || !port.outputs.iter().all(|frame| self.may_send_values(frame, up)) {
            // A text that does not fit is not sent, nor is a number that its field must not send.
            self.due = false;
            self.stale = self.stale.wrapping_add(1);
            return Ok(());
        }
        if port.send == SendOn::Change
            && self.newest.as_ref().is_some_and(|newest| self.is_same(port, up, newest))
        {
            self.due = false;
            return Ok(());
        }
        Err((Invariant::Cycle, "a frame was due and could be sent, but was not".to_owned()))
    }

    fn is_same(&self, port: &PortSpec, up: &Upward, newest: &[u8]) -> bool {
        let mut rest = newest;
        port.outputs.iter().all(|frame| {
            // A frame of varying length is the only output frame of its port.
            let len = if frame.varies { rest.len() } else { frame.payload };
            let Some((part, after)) = rest.split_at_checked(len) else { return false };
            rest = after;
            self.agrees(frame, up, part)
        })
    }

    /// Whether the payload has the current values.
    pub(super) fn agrees(&self, frame: &Frame, up: &Upward, payload: &[u8]) -> bool {
        if let Some(device) = &frame.device {
            let whole = match (&frame.head[..], &frame.tail[..]) {
                ([], []) => Cow::Borrowed(payload),
                (head, tail) => Cow::Owned([head, payload, tail].concat()),
            };
            let laid_out = if frame.varies { varying::lay_out(frame, &whole).ok() } else { None };
            if frame.varies && laid_out.is_none() {
                return false;
            }
            let device = laid_out.as_ref().unwrap_or(device);
            return device.sum_is_right(&whole) != Some(false)
                && frame.fields.iter().zip(&device.places).enumerate().all(|(nth, (field, place))| {
                    let behind = device::behind(&frame.fields, nth);
                    self.device_field_agrees(field, behind, up, &whole[place.clone()])
                });
        }
        let mut rest = payload;
        frame.fields.iter().all(|field| {
            let (ty, number) = match *field {
                FieldSpec::System(var) => {
                    let (value, after) = rest.split_at(var.size());
                    rest = after;
                    return raw_of(up, var).is_some_and(|raw| raw[..var.size()] == *value);
                }
                FieldSpec::UserOutput { ty, from } => (ty, self.number(up, ty, from)),
                FieldSpec::UserInput { ty, .. } => (ty, None),
                // A plain recipe has no other fields.
                _ => return false,
            };
            let (value, after) = rest.split_at(ty.size());
            rest = after;
            match (number, field) {
                (Some(number), _) => field_bytes(ty, number)[..ty.size()] == *value,
                // Reply codes, other values of the state packet, and the health of ports are not modelled.
                (
                    None,
                    FieldSpec::UserOutput {
                        from:
                            OutputBinding::Reply
                            | OutputBinding::State { .. }
                            | OutputBinding::Port { .. }
                            | OutputBinding::Link { .. },
                        ..
                    },
                ) => true,
                (None, _) => false,
            }
        })
    }

    /// The payload with the current values; `None` if one is not a number.
    pub(super) fn made(&self, frame: &Frame, up: &Upward) -> Option<Vec<u8>> {
        let mut bytes = vec![0; frame.payload];
        let places = frame.device.iter().flat_map(|device| &device.places);
        for (nth, (field, place)) in frame.fields.iter().zip(places).enumerate() {
            let bytes = &mut bytes[place.clone()];
            let (encoding, overflow, from) = match *field {
                FieldSpec::DeviceOutput { encoding, overflow, from } => (encoding, overflow, from),
                FieldSpec::UserOutput { ty, from } => (Encoding::scalar(ty), Overflow::Usual, from),
                FieldSpec::Padding { fill, .. } => {
                    bytes.fill(fill);
                    continue;
                }
                FieldSpec::Limits(_) | FieldSpec::Mapped(_) | FieldSpec::InputRule(_) => continue,
                _ => return None,
            };
            let number = self.device_number(&encoding, up, from)?;
            let number = device::sent_for(&encoding, number, device::behind(&frame.fields, nth))?;
            device::write(&encoding, device::shown_as(&encoding, overflow, number), bytes);
        }
        Some(bytes)
    }

    fn device_number(&self, encoding: &Encoding, up: &Upward, from: OutputBinding) -> Option<f64> {
        match from {
            OutputBinding::Counter => {
                let highest = device::range(encoding).1.min(f64::from(u32::MAX));
                Some(f64::from(self.cycles) % (highest + 1.0))
            }
            _ => self.number(up, ScalarType::Double, from),
        }
    }

    /// Whether each field may send its current value.
    fn may_send_values(&self, frame: &Frame, up: &Upward) -> bool {
        frame.fields.iter().enumerate().all(|(nth, field)| {
            let (encoding, from) = match *field {
                FieldSpec::DeviceOutput { encoding, from, .. } => (encoding, from),
                FieldSpec::UserOutput { ty, from } => (Encoding::scalar(ty), from),
                _ => return true,
            };
            let behind = device::behind(&frame.fields, nth);
            let number = if behind.is_empty() { None } else { self.device_number(&encoding, up, from) };
            number.is_none_or(|number| device::sent_for(&encoding, number, behind).is_some())
        })
    }

    fn device_field_agrees(
        &self,
        field: &FieldSpec,
        behind: &[FieldSpec],
        up: &Upward,
        bytes: &[u8],
    ) -> bool {
        let (encoding, overflow, from) = match *field {
            FieldSpec::DeviceOutput { encoding, overflow, from } => (encoding, overflow, from),
            FieldSpec::UserOutput { ty, from } => (Encoding::scalar(ty), Overflow::Usual, from),
            FieldSpec::Fixed { encoding, value } => {
                return device::read(&encoding, bytes) == Some(value as f64);
            }
            FieldSpec::Padding { fill, .. } => return bytes.iter().all(|&byte| byte == fill),
            FieldSpec::Checksum(_)
            | FieldSpec::Length(_)
            | FieldSpec::Limits(_)
            | FieldSpec::Mapped(_)
            | FieldSpec::InputRule(_) => {
                return true;
            }
            FieldSpec::TextOutput { .. } => return text_of(field, up).is_some_and(|text| text == bytes),
            // The output part of a device's recipe has none of these.
            FieldSpec::System(_)
            | FieldSpec::UserInput { .. }
            | FieldSpec::DeviceInput { .. }
            | FieldSpec::TextInput { .. } => return false,
        };
        // Reply codes are not modelled.
        if from == OutputBinding::Reply {
            return true;
        }
        let number = self.device_number(&encoding, up, from);
        let Some(number) = number.and_then(|number| device::sent_for(&encoding, number, behind)) else {
            return false;
        };
        device::read(&encoding, bytes) == Some(device::shown_as(&encoding, overflow, number))
    }

    /// The value of a bound field, before it is rounded and saturated.
    fn number(&self, up: &Upward, ty: ScalarType, from: OutputBinding) -> Option<f64> {
        match from {
            OutputBinding::Variable { var, scale, offset } => {
                let number = as_number(var, raw_of(up, var)?);
                Some(number * f64::from(scale) + f64::from(offset))
            }
            OutputBinding::Bit { var, bit } => Some(f64::from(raw_of(up, var)?[0] >> bit & 1)),
            OutputBinding::Constant(value) => Some(value),
            OutputBinding::Counter => Some(match ty {
                ScalarType::Byte => f64::from(self.cycles as u8),
                ScalarType::Char => f64::from(self.cycles % 128),
                ScalarType::Word => f64::from(self.cycles as u16),
                ScalarType::Short => f64::from(self.cycles % 32_768),
                ScalarType::Int => f64::from(self.cycles % (1 << 31)),
                ScalarType::Float => f64::from(self.cycles % (1 << 24)),
                ScalarType::Dword | ScalarType::Double => f64::from(self.cycles),
            }),
            OutputBinding::CounterTo { max } => Some((u64::from(self.cycles) % (u64::from(max) + 1)) as f64),
            OutputBinding::Reply
            | OutputBinding::State { .. }
            | OutputBinding::Port { .. }
            | OutputBinding::Link { .. } => None,
        }
    }
}

fn raw_of(up: &Upward, var: SysVar) -> Option<Raw> {
    up.known(var).value.map(|value| value.0)
}

/// The bytes of a number in a field: rounded half away from zero, and saturated.
fn field_bytes(ty: ScalarType, number: f64) -> [u8; 8] {
    let number = if number.is_nan() { 0.0 } else { number };
    let whole = number.round();
    let mut bytes = [0; 8];
    // Casts of floats to integers saturate.
    match ty {
        ScalarType::Byte => bytes[0] = whole as u8,
        ScalarType::Char => bytes[0] = whole as i8 as u8,
        ScalarType::Word => bytes[..2].copy_from_slice(&(whole as u16).to_le_bytes()),
        ScalarType::Short => bytes[..2].copy_from_slice(&(whole as i16).to_le_bytes()),
        ScalarType::Dword => bytes[..4].copy_from_slice(&(whole as u32).to_le_bytes()),
        ScalarType::Int => bytes[..4].copy_from_slice(&(whole as i32).to_le_bytes()),
        ScalarType::Float => {
            let most = f64::from(f32::MAX);
            bytes[..4].copy_from_slice(&(number.clamp(-most, most) as f32).to_le_bytes());
        }
        ScalarType::Double => bytes = number.clamp(f64::MIN, f64::MAX).to_le_bytes(),
    }
    bytes
}

fn is_text(field: &FieldSpec) -> bool {
    matches!(field, FieldSpec::TextOutput { .. })
}

/// The bytes of a text field with the current values; `None` if they do not fit.
fn text_of(field: &FieldSpec, up: &Upward) -> Option<Vec<u8>> {
    let FieldSpec::TextOutput { text, from, length_from } = field else { return None };
    let len = match length_from {
        Some(var) => Some(as_number(*var, raw_of(up, *var)?) as usize),
        None => None,
    };
    varying::field_of(*text, &varying::text_of(*from, |var| raw_of(up, var), len)?)
}
