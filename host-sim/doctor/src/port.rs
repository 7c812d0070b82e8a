//! Findings about field ports: what arrives, and why it is not a frame.

use proto_core::config::{Bus, Parity};
use proto_core::engine::{FieldBus, PortCounters, PortId, PortState, Rejection};
use proto_core::recipe::model::Mode;

use crate::bytes::{HexBytes, count, list};
use crate::command::{REPORTED_FOR, ago};
use crate::finding::{Cause, FILE, Finding, FindingPlace, Severity};
use crate::port_case::PortCase;
use crate::record::{PortRecord, WINDOW};
use crate::shape::Shape;
use crate::stream::{self, Fit};
use crate::{Case, can, checksum, given, peers, value};

pub(crate) fn examine(case: &Case<'_>, findings: &mut Vec<Finding>) {
    for status in &case.status.ports {
        let found = case.config.field_ports().find(|(index, ..)| PortId(*index) == status.id);
        let Some((_, port, recipe)) = found else { continue };
        let empty = PortRecord::new(status.id);
        let record = case.ports.iter().find(|record| record.port == status.id).unwrap_or(&empty);
        let seen = PortCase {
            case,
            port,
            recipe,
            place: FindingPlace::Port(status.name.clone()),
            counters: since(&status.counters, &record.counters_before(case.status.at)),
            record,
            status,
        };
        seen.examine(findings);
    }
}

/// Increments between two instants of the counters that findings use.
fn since(now: &PortCounters, before: &PortCounters) -> PortCounters {
    let mut counters = *now;
    macro_rules! subtract {
        ($($name:ident)*) => { $(counters.$name = now.$name.wrapping_sub(before.$name);)* };
    }
    subtract!(
        frames_in bytes_in rejected_not_finite rejected_out_of_range rejected_id rejected_length
        rejected_remote rejected_checksum rejected_unreadable rejected_other_device rejected_counter
        rejected_fields rejected_no_input tail_mismatches resync_bytes discarded_bytes asleep unanswered refused
    );
    counters
}

impl PortCase<'_> {
    fn examine(&self, findings: &mut Vec<Finding>) {
        if self.status.state == PortState::Gone {
            findings.push(self.gone());
            return;
        }
        if let FieldBus::Can { state } = self.status.bus {
            can::examine(self, state, findings);
        } else {
            self.line(findings);
        }
        peers::examine(self, findings);
        given::examine(self, findings);
    }

    fn gone(&self) -> Finding {
        let device = match self.record.device.as_str() {
            "" => "its device".to_owned(),
            device => device.to_owned(),
        };
        self.place.fault(
            Cause::DeviceGone,
            format!("{device} is not there"),
            "",
            "The adapter is unplugged, without power, or another program has it",
            "Plug it in; `ls -l /dev/serial/by-id` shows adapters, `ip link` shows CAN interfaces",
        )
    }

    /// Whether an input frame is overdue or has never arrived.
    pub(crate) fn is_silent(&self) -> bool {
        self.status.overdue > 0
    }

    /// The number of bytes and frames within the window, in words.
    pub(crate) fn came(&self) -> String {
        let (bytes, frames) = (self.counters.bytes_in as usize, self.counters.frames_in as usize);
        format!("{}, {}", count(bytes, "byte"), count(frames, "frame"))
    }

    fn line(&self, findings: &mut Vec<Finding>) {
        let counters = &self.counters;
        if counters.rejected_no_input > 0 {
            findings.push(self.no_input());
            return;
        }
        let Some(shape) = Shape::of(self.case.config, self.recipe) else { return };
        if counters.bytes_in == 0 {
            // A polled device is judged by its replies. A device that has never sent a whole frame is judged by the
            // piece that it sent.
            let broken = self.broken_off(&shape).filter(|_| self.status.age.is_none() || !self.is_silent());
            if broken.is_some() {
                findings.extend(broken);
            } else if self.is_silent() && self.recipe.exchanges.len == 0 && self.case.running >= NOTHING_FOR {
                findings.push(self.no_bytes(&shape));
            }
            return;
        }
        let bytes = self.bytes();
        let frames = shape.frames(&bytes);
        if let Some((read, swapped)) = stream::other_order(&shape, &frames) {
            findings.push(self.byte_order(&shape, read, swapped));
            return;
        }
        let found = self.rejected(&shape, &bytes).or_else(|| self.nearest(&shape, &bytes));
        findings.extend(found);
    }

    /// The newest bytes; without a record, the bytes of the newest rejection.
    fn bytes(&self) -> Vec<u8> {
        let bytes = self.record.bytes();
        match (bytes.is_empty(), &self.status.rejection) {
            (true, Some(last)) => last.bytes.clone(),
            _ => bytes,
        }
    }

    /// Whether too many of the window's frames were rejected for an accident.
    fn are_many(&self, rejected: u32) -> bool {
        rejected >= 3 && rejected.saturating_mul(10) > self.counters.frames_in
            || rejected >= 1 && self.counters.frames_in == 0
    }

    fn no_bytes(&self, shape: &Shape<'_>) -> Finding {
        let severity = if self.status.age.is_some() { Severity::Fault } else { Severity::Warning };
        let seconds = self.status.age.unwrap_or(self.case.running).as_millis() / 1000;
        let device = match self.record.device.as_str() {
            "" => String::new(),
            device => format!(" at {device}"),
        };
        let expected = match shape.head {
            [] => "frames".to_owned(),
            head => format!("frames that begin with {}", HexBytes(head)),
        };
        self.place.found(
            severity,
            Cause::NoBytes,
            format!("0 bytes in {seconds} s{device}"),
            expected,
            "The device is off, does not send by itself, or the wires A and B are open or swapped",
            format!(
                "Check the power, the wires and the device's mode of output{}",
                if self.record.device.is_empty() { "" } else { "; make sure that this is its adapter" }
            ),
        )
    }

    fn no_input(&self) -> Finding {
        let bytes = self.bytes();
        self.place.warning(
            Cause::NoInput,
            format!("{}; first seen {}", self.came(), HexBytes(first(&bytes))),
            "nothing: the recipe has no input part",
            "The device sends, and nobody listens",
            "Add [recipe.input] to the recipe, or assign another recipe to the port",
        )
    }

    fn rejected(&self, shape: &Shape<'_>, bytes: &[u8]) -> Option<Finding> {
        let counters = &self.counters;
        if self.are_many(counters.rejected_checksum) {
            let whole = self.status.rejection.as_ref().filter(|last| last.why == Rejection::Checksum);
            let whole = whole.filter(|last| last.len == last.bytes.len()).map(|last| last.bytes.as_slice());
            let found = checksum::right_one(shape, bytes)
                .or_else(|| whole.and_then(|frame| checksum::right_one(shape, frame)));
            let seen = format!(
                "{}, {} of them with a wrong checksum",
                self.came_of(counters.rejected_checksum),
                counters.rejected_checksum
            );
            return match found {
                Some(right) => Some(self.place.fault(
                    Cause::ChecksumKind,
                    seen,
                    "the checksum of the recipe",
                    format!("The checksum is right as {right}"),
                    "Write that in `checksum` of the recipe",
                )),
                None => Some(self.place.fault(
                    Cause::ChecksumWrong,
                    seen,
                    "the checksum of the recipe",
                    "Bytes are damaged on the line, or the checksum is of another kind or range",
                    "Compare with the device's manual: algorithm, first and last byte; check the wires",
                )),
            };
        }
        if self.are_many(counters.rejected_other_device) {
            return self.other_device(shape);
        }
        if self.are_many(counters.rejected_counter) {
            return Some(self.place.fault(
                Cause::Frozen,
                format!("{} frames with the counter of the frame before", counters.rejected_counter),
                "a counter that goes on",
                "The device repeats an old frame: its program hangs",
                "Restart the device",
            ));
        }
        let unreadable = counters.rejected_unreadable.wrapping_add(counters.rejected_out_of_range);
        let values = unreadable.wrapping_add(counters.rejected_not_finite);
        if self.are_many(values) {
            return Some(self.bad_value(shape, bytes, format!("{values} frames rejected")));
        }
        if self.are_many(counters.rejected_fields) {
            let text = format!("{} fields of frames rejected", counters.rejected_fields);
            return Some(self.bad_value(shape, bytes, text));
        }
        None
    }

    /// Finding for frames or fields with a value that is rejected.
    fn bad_value(&self, shape: &Shape<'_>, bytes: &[u8], rejected: String) -> Finding {
        use Rejection::{NotFinite, OutOfRange, Unreadable};
        let is_value = |why| matches!(why, NotFinite | OutOfRange | Unreadable);
        let last = self.status.rejection.as_ref().filter(|last| is_value(last.why));
        // Only the beginning of a long frame is kept.
        let whole = last.filter(|last| last.len == last.bytes.len());
        let kept = whole.and_then(|last| value::on_line(shape, &last.bytes));
        let heard = || shape.frames(bytes).last().map(|frame| frame.to_vec());
        let heard_wrong = shape.frames(bytes).into_iter().rev().find_map(|frame| {
            let misfit = value::misfit(shape, frame)?;
            Some((frame.to_vec(), Some(misfit)))
        });
        let (frame, misfit) = heard_wrong.unwrap_or_else(|| {
            // Escape bytes do not belong to the frame.
            let misfit = match (&shape.device, whole) {
                (Some(_), Some(last)) => value::misfit(shape, &last.bytes),
                _ => kept.as_ref().and_then(|frame| value::misfit(shape, frame)),
            };
            (kept.or_else(heard).unwrap_or_default(), misfit)
        });
        let why = last.map_or("a value does not fit", |last| last.why.text());
        let (seen, expected) = match misfit {
            Some(misfit) => (misfit.seen, misfit.expected),
            None => (why.to_owned(), "values that fit the fields and variables of the recipe".to_owned()),
        };
        let name = match &*self.recipe.name {
            name if name.chars().all(|c| c.is_ascii_alphanumeric() || "-_.".contains(c)) => name.to_owned(),
            name => format!("{name:?}"),
        };
        let command = format!("host-sim decode {FILE} --recipe {name} --part input {}", HexBytes(&frame));
        self.place.fault(
            Cause::BadValue,
            format!("{rejected}: {seen}"),
            expected,
            "A field's type, place or scale is not the device's, or scale and offset leave too small a range",
            format!("Correct the field; its value in a frame: {}", command.trim_end()),
        )
    }

    /// The number of frames found, accepted or not, in words.
    fn came_of(&self, rejected: u32) -> String {
        let frames = self.counters.frames_in.wrapping_add(rejected) as usize;
        format!("{}, {}", count(self.counters.bytes_in as usize, "byte"), count(frames, "frame"))
    }

    fn other_device(&self, shape: &Shape<'_>) -> Option<Finding> {
        let last = self.status.rejection.as_ref().filter(|last| last.why == Rejection::OtherDevice);
        let bytes = last.map(|last| last.bytes.as_slice()).unwrap_or_default();
        let differs = shape.constants.iter().find_map(|constant| {
            let seen = bytes.get(constant.at..constant.at + constant.bytes.len())?;
            (seen != constant.bytes).then_some((constant, seen))
        });
        let (seen, expected) = match differs {
            Some((constant, seen)) => (
                format!("{} in byte {}", HexBytes(seen), constant.at + 1),
                format!("{} there", HexBytes(&constant.bytes)),
            ),
            None => ("another constant".into(), "that of the recipe".into()),
        };
        Some(self.place.fault(
            Cause::OtherDevice,
            format!("{} whole frames with {seen}", self.counters.rejected_other_device),
            expected,
            "The frames are right and of another device: its address or number is another one",
            "Set the device's address, or write its number in the recipe",
        ))
    }

    fn byte_order(&self, shape: &Shape<'_>, read: f64, swapped: f64) -> Finding {
        let is_little =
            shape.floats.first().is_some_and(|number| number.order == proto_core::device::ByteOrder::Little);
        let (own, other) = if is_little { ("little", "big") } else { ("big", "little") };
        let remedy = if self.recipe.mode == Mode::Realtime {
            "A realtime recipe is little-endian, as the controller's own: set the device's byte order, or \
             describe the frame as a user recipe with endian = \"big\""
                .to_owned()
        } else {
            format!("Write endian = \"{other}\" in the part or the field of the recipe")
        };
        self.place.fault(
            Cause::ByteOrder,
            format!("floats such as {read:e}; with their bytes reversed {swapped}"),
            format!("{own}-endian floats"),
            format!("The device sends {other}-endian"),
            remedy,
        )
    }

    /// Finding for bytes that are not a frame.
    fn nearest(&self, shape: &Shape<'_>, bytes: &[u8]) -> Option<Finding> {
        let counters = &self.counters;
        if counters.frames_in > 0 {
            return self.noise(shape);
        }
        let lost = counters.resync_bytes.wrapping_add(counters.discarded_bytes);
        if lost == 0 || !self.is_silent() {
            return self.broken_off(shape);
        }
        let came = self.came();
        let hex = |bytes: &[u8]| HexBytes(bytes).to_string();
        let whole = shape.len.map_or(String::new(), |len| format!("frames of {len} bytes, "));
        let Some(fit) = stream::fit(shape, bytes) else { return self.broken_off(shape) };
        match fit {
            Fit::HeadSwapped { seen } => Some(self.place.fault(
                Cause::HeadSwapped,
                format!("{came}; first seen {}", hex(&seen)),
                format!("the head {}", hex(shape.head)),
                "The bytes of the head are swapped",
                format!("Write head = {} in the recipe, or change the device", list(&seen)),
            )),
            Fit::HeadDiffers { seen } => Some(self.place.fault(
                Cause::HeadDiffers,
                format!("{came}; frames begin with {}", hex(&seen)),
                format!("the head {}", hex(shape.head)),
                "The device's head is another one",
                format!("Write head = {} in the recipe, or change the device", list(&seen)),
            )),
            Fit::SevenBits => Some(self.place.fault(
                Cause::SevenBits,
                format!("{came}; first seen {}", hex(first(bytes))),
                format!("the head {}", hex(shape.head)),
                "The head is there without bit 7: the device sends 7 data bits and parity",
                "Set the device to 8 data bits",
            )),
            Fit::TailDiffers { seen } => Some(self.place.fault(
                Cause::TailDiffers,
                format!("{came}; frames end with {}", hex(&seen)),
                format!("the tail {}", hex(shape.tail)),
                "The device's tail is another one, or the fields have another order or types",
                format!("Write tail = {} in the recipe, or correct its fields", list(&seen)),
            )),
            Fit::Length { seen } => {
                let len = shape.len.unwrap_or(0);
                let (by, word) = (seen.abs_diff(len), if seen > len { "longer" } else { "shorter" });
                Some(self.place.fault(
                    Cause::LengthDiffers,
                    format!("{came}; frames of {seen} bytes"),
                    format!("{whole}head and tail included"),
                    format!("The device's frame is {} {word}", count(by, "byte")),
                    "Correct the fields of the recipe: one is missing, too many, or of another type",
                ))
            }
            Fit::BrokenOff { seen } => Some(self.place.fault(
                Cause::BrokenOff,
                format!("{came}; after the head {} came {seen} bytes, then silence", hex(shape.head)),
                format!("{whole}without a pause"),
                "The frame is shorter than the recipe says, or the device pauses within it",
                "Correct the fields of the recipe, or raise idle_gap_ms of the port",
            )),
            Fit::NoHead => Some(self.no_head(shape, bytes, &came)),
        }
    }

    fn broken_off(&self, shape: &Shape<'_>) -> Option<Finding> {
        let last = self.status.rejection.as_ref();
        let last = last.filter(|last| last.why == Rejection::Partial && last.age < REPORTED_FOR)?;
        if self.status.age.is_some_and(|age| age < last.age) {
            // The device has sent a whole frame since.
            return None;
        }
        let whole = match shape.lengths() {
            Some((shortest, longest)) if shortest == longest => longest.to_string(),
            Some((shortest, longest)) => format!("{shortest} to {longest}"),
            None => "more".into(),
        };
        let expected = match shape.tail {
            [] => format!("frames of {whole} bytes without a pause"),
            tail => format!("frames of {whole} bytes without a pause, which end with {}", HexBytes(tail)),
        };
        let (age, bytes) = (ago(last.age), HexBytes(first(&last.bytes)));
        let seen = match last.bytes.ends_with(shape.tail) && !shape.tail.is_empty() {
            true => {
                let came = count(last.len, "byte");
                format!("{came} came behind a silence within a frame{age}: {bytes}")
            }
            false => format!("{} of {whole} bytes{age}, then silence: {bytes}", last.len),
        };
        Some(self.place.warning(
            Cause::BrokenOff,
            seen,
            expected,
            "The device's frame is shorter than the recipe says or ends otherwise, the device pauses within it, or \
             was switched off",
            "Correct the fields, the lengths or the tail of the recipe, or raise idle_gap_ms of the port",
        ))
    }

    fn no_head(&self, shape: &Shape<'_>, bytes: &[u8], came: &str) -> Finding {
        let high = bytes.iter().filter(|byte| **byte > 0x7F).count() * 100 / bytes.len().max(1);
        let edge = bytes
            .iter()
            .filter(|byte| matches!(**byte, 0x00 | 0xFF | 0x80 | 0xC0 | 0xE0 | 0xF0 | 0xF8 | 0xFC | 0xFE))
            .count();
        let edge = edge * 100 / bytes.len().max(1);
        let settings = match &self.port.bus {
            Bus::Rs485(line) => {
                let parity = match line.parity {
                    Parity::None => "no parity",
                    Parity::Even => "even parity",
                    Parity::Odd => "odd parity",
                };
                format!(
                    "{} baud, {parity}, {} stop bit{}",
                    line.baud,
                    line.stop_bits,
                    if line.stop_bits == 1 { "" } else { "s" }
                )
            }
            _ => String::new(),
        };
        let likely = if edge >= 60 {
            "Bytes arrive, no head, and most are runs of equal bits: the baud rate is wrong"
        } else {
            "Bytes arrive, no head: baud rate or parity, or another protocol"
        };
        self.place.fault(
            Cause::NoHead,
            format!("{came}; first seen {}; {high} % of the bytes above 7F", HexBytes(first(bytes))),
            match shape.head {
                [] => format!("the tail {}", HexBytes(shape.tail)),
                head => format!("the head {}", HexBytes(head)),
            },
            likely,
            format!("Compare baud rate, parity and stop bits with the device's; the port has {settings}"),
        )
    }

    /// Finding for good frames among damaged ones.
    fn noise(&self, shape: &Shape<'_>) -> Option<Finding> {
        let counters = &self.counters;
        let longest = shape.lengths().map_or(1, |(_, longest)| longest.max(1) as u32);
        // Lower bound of the number of damaged frames.
        let pieces = counters.discarded_bytes / longest;
        let bad =
            [counters.tail_mismatches, counters.rejected_checksum, counters.rejected_not_finite, pieces];
        let bad = bad.into_iter().max().unwrap_or(0);
        let is_much = bad >= 5 && bad.saturating_mul(10) > counters.frames_in;
        is_much.then(|| {
            self.place.warning(
                Cause::Noise,
                format!("{} right frames and {bad} damaged ones", counters.frames_in),
                "right frames only",
                "Bytes are lost or damaged on the line, or the head occurs within the data",
                "Check ground, shield and termination of the line; a longer head helps",
            )
        })
    }
}

fn first(bytes: &[u8]) -> &[u8] {
    &bytes[..bytes.len().min(SHOWN)]
}

/// Maximum number of bytes that are shown.
const SHOWN: usize = 12;
/// Minimum silence that is reported.
const NOTHING_FOR: proto_core::time::Duration = proto_core::time::Duration::from_secs(3);
const _: () = assert!(NOTHING_FOR.as_micros() < WINDOW.as_micros());
