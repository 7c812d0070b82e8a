//! Finds frames and their values in the bytes that a field port received: a plain implementation of
//! proto-core/docs/wire/recipes.md sections 4, 6 and 7.

mod cut;

use std::collections::BTreeMap;
use std::ops::Range;

use proto_core::config::{CommandWhen, FieldSpec, InputBinding, InputRule, Span};
use proto_core::device::{Boundary, Encoding, Overflow};
use proto_core::recipe::model::Mode;
use proto_core::sysvar::SysVar;
use proto_core::time::Instant;
use proto_core::wire::can::CanFrame;
use proto_core::wire::scalar::{Scalar, ScalarType};

use super::device::{self, DeviceSpec, Look, Read, Seen};
use super::frame::{Frame, Raw, written};
use super::spec::PortSpec;
use super::varying;
use cut::CutWatch;

/// Whether a frame is accepted or rejected, and why.
#[derive(Debug, Clone, PartialEq)]
pub(super) enum Verdict {
    Accepted(Accepted),
    NotFinite,
    OutOfRange,
    /// A field of a device's frame is not a number.
    Unreadable,
    /// The checksum of a device's frame is wrong.
    WrongChecksum,
    /// A frame of another device.
    OtherDevice,
    /// The alive counter is equal to that of the previous frame.
    Repeated,
    /// No frame has the length of the bytes between two ends.
    WrongLength,
    /// A text in the port's frame with this index reports that the device has no news.
    Ignored(usize),
}

/// An accepted frame.
#[derive(Debug, Clone, PartialEq, Default)]
pub(super) struct Accepted {
    /// Index of the port's input frame.
    pub frame: usize,
    pub values: Vec<(SysVar, Raw)>,
    /// Single bits of byte variables.
    pub bits: Vec<Coils>,
    /// Reserved bits were set.
    pub masked: bool,
    /// Values of command fields: the index of the field in the frame, its table, when it selects a command, and the
    /// value.
    pub commands: Vec<(usize, Span, CommandWhen, i64)>,
    /// The alive counters, each with the place of its field.
    pub counts: Vec<((usize, usize), u32)>,
    /// How many alive counters are not the next number.
    pub jumps: u32,
    /// Variables that become the number of accepted frames.
    pub counted: Vec<SysVar>,
    /// The fields for which the frame has no value.
    pub without: Box<Without>,
    /// When its values were first requested, if an earlier request had no reply in time: they may be that old.
    pub asked: Option<Instant>,
}

impl Accepted {
    /// Sets the variables that tell whether a field's newest value was accepted. Returns whether there are any.
    fn note_validity(&mut self, rules: &[FieldSpec], is_valid: bool) -> bool {
        let number = f64::from(u8::from(is_valid));
        for rule in rules {
            match *rule {
                FieldSpec::InputRule(InputRule::ValidTo { var, bit: Some(bit) }) => {
                    self.bits.push(coil(var, bit, number));
                }
                FieldSpec::InputRule(InputRule::ValidTo { var, bit: None }) => {
                    self.values.extend(bound(var, number).map(|raw| (var, raw)));
                }
                _ => continue,
            }
            return true;
        }
        false
    }

    /// Records an alive counter.
    fn count(
        &mut self,
        place: (usize, usize),
        before: Option<u32>,
        max: u32,
        number: f64,
    ) -> Result<(), Unfit> {
        if number > f64::from(max) {
            return Err(Unfit::OutOfRange);
        }
        let number = number as u32;
        if before == Some(number) {
            return Err(Unfit::Repeated);
        }
        let next = |before: u32| if before >= max { 0 } else { before + 1 };
        self.jumps += u32::from(before.is_some_and(|before| next(before) != number));
        self.counts.push((place, number));
        Ok(())
    }
}

/// Bits of one byte.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Coils {
    pub var: SysVar,
    pub mask: u8,
    pub on: u8,
}

/// Why a field of a device's frame is rejected, or for a counter the whole frame.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Unfit {
    NotFinite,
    OutOfRange,
    Unreadable,
    Repeated,
}

impl From<Unfit> for Verdict {
    fn from(why: Unfit) -> Self {
        match why {
            Unfit::NotFinite => Self::NotFinite,
            Unfit::OutOfRange => Self::OutOfRange,
            Unfit::Unreadable => Self::Unreadable,
            Unfit::Repeated => Self::Repeated,
        }
    }
}

/// The fields of an accepted frame of a device that are rejected, or that have no value at the moment.
#[derive(Debug, Clone, PartialEq, Default)]
pub(super) struct Without {
    pub vars: Vec<SysVar>,
    /// Bytes with an unreadable bit: all bits that the frame writes in them count as rejected.
    pub bytes: Vec<SysVar>,
    /// Command fields, by their index in the frame.
    pub commands: Vec<usize>,
    /// How many fields are rejected, and why the frame would be rejected.
    pub rejected: u32,
    pub why: Option<Unfit>,
    /// How many fields have no value, according to the device.
    pub no_value: u32,
}

impl Without {
    fn reject(&mut self, why: Unfit) {
        self.rejected += 1;
        self.why.get_or_insert(why);
    }
}

/// The newest alive counters by frame and field.
pub(super) type Counts = BTreeMap<(usize, usize), u32>;

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
    /// The number of bytes before the expected place of the device's next frame; `None` if that is unknown.
    pub missing: Missing,
    /// The alive counters of the accepted frames.
    pub counts: Counts,
    /// The state of frames that end with a tail or with silence.
    pub cut: CutWatch,
}

/// At the start, and after silence, a frame is expected to begin at once.
#[derive(Debug, Clone, Copy)]
pub(super) struct Missing(Option<usize>);

impl Default for Missing {
    fn default() -> Self {
        Self(Some(0))
    }
}

impl LineWatch {
    /// Discards a partial frame after the idle gap.
    pub(super) fn tick(&mut self, port: &PortSpec, now: Instant) {
        if port.framing == Boundary::Fields && !self.held.is_empty() && now >= self.heard + port.idle_gap {
            self.discard();
        }
    }

    /// A frame that has begun on the port's line is not continued.
    pub(super) fn discard_of(&mut self, port: &PortSpec) {
        match port.framing {
            Boundary::Fields => self.discard(),
            Boundary::Tail | Boundary::Silence => self.cut_off(),
        }
    }

    pub(super) fn discard(&mut self) {
        self.discarded += self.held.len() as u64;
        self.held.clear();
        self.missing = Missing::default();
    }

    /// Receives bytes; returns the frames that they complete.
    pub(super) fn bytes(&mut self, port: &PortSpec, bytes: &[u8], now: Instant) -> Vec<Verdict> {
        let is_late = now >= self.heard + port.idle_gap;
        self.heard = now;
        let Some(frame) = port.inputs.first() else { return Vec::new() };
        if port.framing != Boundary::Fields {
            let pieces = self.cut_bytes(port.framing, &frame.tail, bytes, is_late);
            return pieces.into_iter().filter_map(|piece| self.judge_piece(port, &piece)).collect();
        }
        self.held.extend_from_slice(bytes);
        if frame.device.is_some() {
            return self.cut_device(frame);
        }
        let (mut cut, mut found) = (Cut::default(), Vec::new());
        while let Some(payload) = cut.next(frame, &self.held) {
            found.push(judge(port.mode, frame, 0, payload));
        }
        self.remove(&cut);
        found
    }

    /// Drops the first held byte, as no frame begins with it.
    pub(super) fn drop_one(&mut self) {
        self.held.remove(0);
        self.dropped += 1;
        self.missing.0 = self.missing.0.and_then(|missing| missing.checked_sub(1));
    }

    /// Drops the first byte of a frame of `len` bytes with an invalid checksum. Returns whether it counts: a reply
    /// counts where one was expected, any other frame unless it is within one that has been counted.
    pub(super) fn drop_wrong(&mut self, len: usize, is_reply: bool) -> bool {
        let counts = self.missing.0.map_or(!is_reply, |missing| missing == 0);
        if counts {
            self.missing.0 = Some(len);
        }
        self.drop_one();
        counts
    }

    /// Takes a frame of `len` bytes from the front.
    pub(super) fn take_front(&mut self, len: usize) -> Vec<u8> {
        self.frame_bytes += len as u64;
        self.missing = Missing::default();
        self.held.drain(..len).collect()
    }

    /// Judges a complete frame of a device; it is the port's `nth` frame.
    pub(super) fn judge(&mut self, frame: &Frame, nth: usize, whole: &[u8]) -> Verdict {
        let verdict = judge_device(frame, nth, whole, &self.counts);
        if let Verdict::Accepted(accepted) = &verdict {
            // A rejected frame updates no counter.
            self.counts.extend(accepted.counts.iter().copied());
        }
        verdict
    }

    /// Judges the values that a master writes: all of them are accepted, or none.
    pub(super) fn judge_block(&mut self, frame: &Frame, nth: usize, data: &[u8]) -> Verdict {
        let counts = self.counts.clone();
        let verdict = self.judge_data(frame, nth, data);
        let Verdict::Accepted(accepted) = &verdict else { return verdict };
        let Some(why) = accepted.without.why else { return verdict };
        self.counts = counts;
        why.into()
    }

    /// Judges the data of a reply.
    pub(super) fn judge_data(&mut self, frame: &Frame, nth: usize, data: &[u8]) -> Verdict {
        match &frame.device {
            None => judge(Mode::User, frame, nth, data),
            Some(device) => match device.see(&frame.fields, data) {
                Seen::Ours => self.judge(frame, nth, data),
                Seen::Other | Seen::Nothing => Verdict::OtherDevice,
                Seen::WrongChecksum => Verdict::WrongChecksum,
            },
        }
    }

    /// Removes complete frames of a device from the held bytes.
    fn cut_device(&mut self, frame: &Frame) -> Vec<Verdict> {
        let mut found = Vec::new();
        while !self.held.is_empty() {
            match varying::look(frame, &self.held) {
                Look::Begins { .. } => break,
                Look::No => self.drop_one(),
                Look::Wrong(len) => {
                    if self.drop_wrong(len, false) {
                        found.push(Verdict::WrongChecksum);
                    }
                }
                Look::Other(len) => {
                    self.take_front(len);
                    found.push(Verdict::OtherDevice);
                }
                Look::Frame(len) => {
                    let whole = self.take_front(len);
                    found.push(self.judge(frame, 0, &whole));
                }
            }
        }
        found
    }

    /// Removes the bytes that were cut off from the held ones, and counts them.
    pub(super) fn remove(&mut self, cut: &Cut) {
        self.held.drain(..cut.at);
        self.mismatches += cut.mismatches;
        self.dropped += cut.dropped;
        self.frame_bytes += cut.frame_bytes;
    }
}

/// How far held bytes have been searched for complete frames.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct Cut {
    at: usize,
    mismatches: u64,
    dropped: u64,
    frame_bytes: u64,
}

impl Cut {
    /// The number of bytes that were frames or are dropped.
    pub(super) fn len(&self) -> usize {
        self.at
    }

    /// The bytes of the fields of the next frame.
    pub(super) fn next<'h>(&mut self, frame: &Frame, held: &'h [u8]) -> Option<&'h [u8]> {
        while let Some(rest) = held.get(self.at..).filter(|rest| !rest.is_empty()) {
            let seen = rest.len().min(frame.head.len());
            if rest[..seen] != frame.head[..seen] {
                self.dropped += 1;
                self.at += 1;
                continue;
            }
            let whole = rest.get(..frame.len())?;
            if let Some(payload) = frame.payload_of(whole) {
                self.frame_bytes += frame.len() as u64;
                self.at += frame.len();
                return Some(payload);
            }
            self.mismatches += 1;
            self.dropped += 1;
            self.at += 1;
        }
        None
    }
}

/// Receives a CAN frame.
pub(super) fn can(port: &PortSpec, line: &mut LineWatch, received: &CanFrame) -> Result<Verdict, Refused> {
    if received.is_remote() {
        return Err(Refused::Remote);
    }
    can_of(port.inputs.iter().enumerate(), port.mode, line, received)
}

/// As [`can`], for frames that are given. Frames with the same id are distinguished by a constant.
pub(super) fn can_of<'f>(
    frames: impl Iterator<Item = (usize, &'f Frame)>,
    mode: Mode,
    line: &mut LineWatch,
    received: &CanFrame,
) -> Result<Verdict, Refused> {
    let mut why = Err(Refused::Id);
    for (nth, frame) in frames.filter(|(_, frame)| frame.id == Some(received.id())) {
        let Some(device) = frame.device.as_ref().filter(|_| received.data().len() == frame.payload) else {
            if frame.device.is_none() && received.data().len() == frame.payload {
                return Ok(judge(mode, frame, nth, received.data()));
            }
            why = why.or(Err(Refused::Length));
            continue;
        };
        why = match (device.see(&frame.fields, received.data()), why) {
            (Seen::Ours, _) => return Ok(line.judge(frame, nth, received.data())),
            // Valid but for a constant: a frame of another device, whatever the other frames say.
            (Seen::Other | Seen::Nothing, _) | (_, Ok(Verdict::OtherDevice)) => Ok(Verdict::OtherDevice),
            (Seen::WrongChecksum, _) => Ok(Verdict::WrongChecksum),
        };
    }
    why
}

/// Each field is judged on its own. The frame is rejected if a counter is wrong, or if it has no value at all.
fn judge_device(frame: &Frame, nth: usize, whole: &[u8], counts: &Counts) -> Verdict {
    let mut accepted = Accepted { frame: nth, ..Accepted::default() };
    let laid_out = if frame.varies { varying::lay_out(frame, whole).ok() } else { None };
    let device = if frame.varies { laid_out.as_ref() } else { frame.device.as_ref() };
    let Some(DeviceSpec { places, .. }) = device else { return Verdict::Unreadable };
    accepted.values.reserve(frame.written.len());
    if texts(frame, places, whole).any(|(field, text)| {
        matches!(field, FieldSpec::TextInput { ignored, .. } if ignored.iter().any(|own| own == text))
    }) {
        return Verdict::Ignored(nth);
    }
    // The index of a command field does not count fields without bytes in the frame.
    let mut element = 0;
    let mut tells = false;
    let mut wrong_count = None;
    for (place_of, (field, place)) in frame.fields.iter().zip(places).enumerate() {
        let at = element;
        element += usize::from(!matches!(field, FieldSpec::Checksum(_)) && !field.is_of_field_before());
        let (encoding, overflow, to) = match *field {
            FieldSpec::DeviceInput { encoding, overflow, to } => (encoding, overflow, to),
            FieldSpec::UserInput { ty, to } => (Encoding::scalar(ty), Overflow::Usual, to),
            _ => continue,
        };
        let rules = device::behind(&frame.fields, place_of);
        let bytes = &whole[place.clone()];
        let number = number_in(&encoding, bytes, rules);
        match to {
            InputBinding::Variable { var, scale, offset } => {
                let raw = number.and_then(|number| {
                    let number = device::taken_for(&encoding, number, (scale, offset), rules);
                    bound_by(var, number.ok_or(Some(Unfit::OutOfRange))?, overflow, rules)
                });
                tells |= accepted.note_validity(rules, raw.is_ok());
                match raw {
                    Ok(raw) => accepted.values.push((var, raw)),
                    Err(why) => {
                        accepted.without.vars.push(var);
                        match why {
                            Some(why) => accepted.without.reject(why),
                            None => accepted.without.no_value += 1,
                        }
                    }
                }
            }
            InputBinding::Commands { table, when } => match number {
                Ok(number) => accepted.commands.push((at, table, when, number as i64)),
                Err(why) => {
                    accepted.without.commands.push(at);
                    accepted.without.reject(why.unwrap_or(Unfit::Unreadable));
                }
            },
            InputBinding::Bit { var, bit } => match number {
                Ok(number) => accepted.bits.push(coil(var, bit, number)),
                Err(why) => {
                    accepted.without.bytes.push(var);
                    accepted.without.reject(why.unwrap_or(Unfit::Unreadable));
                }
            },
            InputBinding::Counter { max } => {
                let before = counts.get(&(nth, at)).copied();
                let why = match number {
                    Ok(number) => accepted.count((nth, at), before, max, number).err(),
                    Err(why) => why,
                };
                wrong_count = wrong_count.or(why);
            }
            InputBinding::Unused => {
                if let Err(why) = number {
                    accepted.without.reject(why.unwrap_or(Unfit::Unreadable));
                }
            }
        }
    }
    if let Some(why) = wrong_count {
        return why.into();
    }
    for (field, text) in texts(frame, places, whole) {
        let FieldSpec::TextInput { to, length_to, count_to, .. } = *field else { continue };
        let registers = to.map(|words| varying::registers(words, text));
        if let Some(None) = registers {
            accepted.without.vars.extend(written(field));
            accepted.without.reject(Unfit::OutOfRange);
            continue;
        }
        accepted.values.extend(registers.flatten().into_iter().flatten());
        let length = length_to.and_then(|var| Some((var, bound(var, text.len() as f64)?)));
        accepted.values.extend(length);
        accepted.counted.extend(count_to);
    }
    accepted.bits.retain(|coils| !accepted.without.bytes.contains(&coils.var));
    let Accepted { values, bits, commands, counted, without, .. } = &accepted;
    let is_nothing = values.is_empty() && bits.is_empty() && commands.is_empty() && counted.is_empty();
    match without.why {
        Some(why) if is_nothing && without.no_value == 0 && !tells => why.into(),
        _ => Verdict::Accepted(accepted),
    }
}

/// The number in the bytes of a field, or why there is none; `Err(None)` if the device reports that it has none.
fn number_in(encoding: &Encoding, bytes: &[u8], rules: &[FieldSpec]) -> Result<f64, Option<Unfit>> {
    match device::read_ruled(encoding, bytes, rules) {
        Read::Number(number) if number.is_finite() => Ok(number),
        Read::Number(_) => Err(Some(Unfit::NotFinite)),
        Read::Unreadable => Err(Some(Unfit::Unreadable)),
        Read::NoValue => Err(None),
    }
}

/// Converts a number of a device to a value of a variable.
fn bound_by(var: SysVar, number: f64, overflow: Overflow, rules: &[FieldSpec]) -> Result<Raw, Option<Unfit>> {
    let is_int16 = rules.contains(&FieldSpec::InputRule(InputRule::Int16));
    let number = match overflow {
        Overflow::Wrap => device::shown_as(&Encoding::scalar(var.ty()), overflow, number),
        Overflow::Usual if is_int16 => match number.round() {
            number if !(-32_768.0..=32_767.0).contains(&number) => f64::NAN,
            number if number < 0.0 => number + 65_536.0,
            number => number,
        },
        Overflow::Usual => number,
    };
    bound(var, number).ok_or(Some(Unfit::OutOfRange))
}

/// The texts of an input frame, without padding.
fn texts<'f>(
    frame: &'f Frame,
    places: &'f [Range<usize>],
    whole: &'f [u8],
) -> impl Iterator<Item = (&'f FieldSpec, &'f [u8])> {
    frame.fields.iter().zip(places).filter_map(|(field, place)| match field {
        FieldSpec::TextInput { text, .. } => Some((field, varying::text_in(*text, &whole[place.clone()]))),
        _ => None,
    })
}

fn judge(mode: Mode, frame: &Frame, nth: usize, payload: &[u8]) -> Verdict {
    let mut accepted = Accepted { frame: nth, ..Accepted::default() };
    accepted.values.reserve(frame.written.len());
    let mut rest = payload;
    let mut out_of_range = false;
    for (place, field) in frame.fields.iter().enumerate() {
        let ty = match field {
            FieldSpec::System(var) => var.ty(),
            FieldSpec::UserInput { ty, .. } | FieldSpec::UserOutput { ty, .. } => *ty,
            // A plain recipe has no other fields.
            _ => continue,
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
            (_, FieldSpec::UserInput { to: InputBinding::Bit { var, bit }, .. }) => {
                accepted.bits.push(coil(*var, *bit, number));
            }
            _ => {}
        }
    }
    if out_of_range { Verdict::OutOfRange } else { Verdict::Accepted(accepted) }
}

/// A number as a bit: on unless it is 0.
fn coil(var: SysVar, bit: u8, number: f64) -> Coils {
    let mask = 1 << bit;
    Coils { var, mask, on: if number == 0.0 { 0 } else { mask } }
}

/// A number as a value of a variable, rounded half away from zero; `None` if it does not fit (D22).
pub(super) fn bound(var: SysVar, value: f64) -> Option<Raw> {
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
    let bits = bytes.iter().rev().fold(0_u64, |bits, &byte| bits << 8 | u64::from(byte));
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
