//! The frames in the bytes that a field port received, and their values: a plain implementation of
//! proto-core/docs/wire/recipes.md sections 4, 6 and 7.

use proto_core::config::{CommandWhen, FieldSpec, InputBinding, Span};
use proto_core::recipe::model::Mode;
use proto_core::sysvar::SysVar;
use proto_core::time::Instant;
use proto_core::wire::can::CanFrame;
use proto_core::wire::scalar::{Scalar, ScalarType};

use super::spec::{Frame, PortSpec, Raw};

/// Whether a frame is accepted.
#[derive(Debug, Clone, PartialEq)]
pub(super) enum Verdict {
    Accepted(Accepted),
    NotFinite,
    OutOfRange,
}

/// An accepted frame.
#[derive(Debug, Clone, PartialEq, Default)]
pub(super) struct Accepted {
    /// Index of the port's input frame.
    pub frame: usize,
    pub values: Vec<(SysVar, Raw)>,
    /// Reserved bits were set.
    pub masked: bool,
    /// Values of command fields: the field's index in the frame, its table, when it picks a command, and the
    /// value.
    pub commands: Vec<(usize, Span, CommandWhen, i64)>,
}

/// Why a CAN frame does not match the recipe.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Refused {
    Remote,
    Id,
    Length,
}

/// Received bytes in which no frame was found yet.
#[derive(Debug, Clone, Default)]
pub(super) struct LineWatch {
    pub held: Vec<u8>,
    pub heard: Instant,
    pub mismatches: u64,
    pub dropped: u64,
    pub discarded: u64,
    pub frame_bytes: u64,
}

impl LineWatch {
    /// Discards a partial frame after the idle gap.
    pub(super) fn tick(&mut self, port: &PortSpec, now: Instant) {
        if !self.held.is_empty() && now >= self.heard + port.idle_gap {
            self.discard();
        }
    }

    pub(super) fn discard(&mut self) {
        self.discarded += self.held.len() as u64;
        self.held.clear();
    }

    /// Receives bytes; returns the frames that they complete.
    pub(super) fn bytes(&mut self, port: &PortSpec, bytes: &[u8], now: Instant) -> Vec<Verdict> {
        self.heard = now;
        let Some(frame) = port.inputs.first() else { return Vec::new() };
        self.held.extend_from_slice(bytes);
        self.cut(frame).iter().map(|payload| judge(port.mode, frame, 0, payload)).collect()
    }

    /// Removes complete frames from the held bytes; returns the bytes of their fields.
    pub(super) fn cut(&mut self, frame: &Frame) -> Vec<Vec<u8>> {
        let mut found = Vec::new();
        let mut at = 0;
        while let Some(rest) = self.held.get(at..).filter(|rest| !rest.is_empty()) {
            let seen = rest.len().min(frame.head.len());
            if rest[..seen] != frame.head[..seen] {
                self.dropped += 1;
                at += 1;
                continue;
            }
            let Some(whole) = rest.get(..frame.len()) else { break };
            if let Some(payload) = frame.payload_of(whole) {
                found.push(payload.to_vec());
                self.frame_bytes += frame.len() as u64;
                at += frame.len();
            } else {
                self.mismatches += 1;
                self.dropped += 1;
                at += 1;
            }
        }
        self.held.drain(..at);
        found
    }
}

/// Receives a CAN frame.
pub(super) fn can(port: &PortSpec, received: &CanFrame) -> Result<Verdict, Refused> {
    if received.is_remote() {
        return Err(Refused::Remote);
    }
    let nth = port.inputs.iter().position(|frame| frame.id == Some(received.id()));
    let nth = nth.ok_or(Refused::Id)?;
    let frame = &port.inputs[nth];
    if received.data().len() != frame.payload {
        return Err(Refused::Length);
    }
    Ok(judge(port.mode, frame, nth, received.data()))
}

fn judge(mode: Mode, frame: &Frame, nth: usize, payload: &[u8]) -> Verdict {
    let mut accepted = Accepted { frame: nth, ..Accepted::default() };
    let mut rest = payload;
    let mut out_of_range = false;
    for (place, field) in frame.fields.iter().enumerate() {
        let ty = match field {
            FieldSpec::System(var) => var.ty(),
            FieldSpec::UserInput { ty, .. } | FieldSpec::UserOutput { ty, .. } => *ty,
            _ => unimplemented!("frames of devices are not modelled"),
        };
        let (bytes, after) = rest.split_at(ty.size());
        rest = after;
        let number = read(ty, bytes);
        if !number.is_finite() {
            return Verdict::NotFinite;
        }
        match (mode, field) {
            (Mode::Realtime, FieldSpec::System(var)) => {
                let mut raw = Raw::default();
                raw[..bytes.len()].copy_from_slice(bytes);
                if ty == ScalarType::Byte {
                    accepted.masked |= raw[0] & !var.valid_bits() != 0;
                    raw[0] &= var.valid_bits();
                }
                accepted.values.push((*var, raw));
            }
            (_, FieldSpec::UserInput { to: InputBinding::Variable { var, scale, offset }, .. }) => {
                match bound(*var, number * f64::from(*scale) + f64::from(*offset)) {
                    Some(raw) => accepted.values.push((*var, raw)),
                    None => out_of_range = true,
                }
            }
            (_, FieldSpec::UserInput { to: InputBinding::Commands { table, when }, .. }) => {
                accepted.commands.push((place, *table, *when, number as i64));
            }
            _ => {}
        }
    }
    if out_of_range { Verdict::OutOfRange } else { Verdict::Accepted(accepted) }
}

/// A number as a value of a variable, rounded half away from zero; `None` if it does not fit (D22).
fn bound(var: SysVar, value: f64) -> Option<Raw> {
    let mut raw = Raw::default();
    match var.ty() {
        ScalarType::Float => {
            if !value.is_finite() || value.abs() > f64::from(f32::MAX) {
                return None;
            }
            raw = (value as f32).to_le_bytes();
        }
        ScalarType::Word => {
            let whole = value.round();
            if !(0.0..=65_535.0).contains(&whole) {
                return None;
            }
            raw[..2].copy_from_slice(&(whole as u16).to_le_bytes());
        }
        _ => {
            let whole = value.round();
            if !(0.0..=255.0).contains(&whole) || whole as u8 & !var.valid_bits() != 0 {
                return None;
            }
            raw[0] = whole as u8;
        }
    }
    Some(raw)
}

/// A field's value; an `f64` can represent each type exactly.
fn read(ty: ScalarType, bytes: &[u8]) -> f64 {
    let mut wide = [0; 8];
    wide[..bytes.len()].copy_from_slice(bytes);
    let bits = u64::from_le_bytes(wide);
    match ty {
        ScalarType::Byte => f64::from(bits as u8),
        ScalarType::Char => f64::from(bits as u8 as i8),
        ScalarType::Word => f64::from(bits as u16),
        ScalarType::Short => f64::from(bits as u16 as i16),
        ScalarType::Dword => f64::from(bits as u32),
        ScalarType::Int => f64::from(bits as u32 as i32),
        ScalarType::Float => f64::from(f32::from_bits(bits as u32)),
        ScalarType::Double => f64::from_bits(bits),
    }
}

/// A variable's value as a number.
pub(super) fn as_number(var: SysVar, raw: Raw) -> f64 {
    read(var.ty(), &raw[..var.size()])
}

/// A value as text.
pub(super) fn show(var: SysVar, raw: Raw) -> String {
    let value = Scalar::decode(var.ty(), &raw);
    value.map_or_else(String::new, |value| value.to_string())
}
