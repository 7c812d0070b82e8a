//! Checksums that fit the frames: another algorithm, byte order, or range.

use proto_core::config::{DeviceFrame, FieldSpec};
use proto_core::device::{Algorithm, ByteOrder, Carrier, Checksum, Probe};
use proto_core::sysvar::Direction;

use crate::shape::Shape;

/// A checksum that fits the frames, in words, such as `crc16-modbus, high byte first`.
///
/// `bytes` are searched at every place, or are one whole frame if something other than the fields ends frames. Several
/// frames must agree, or only one if a match by chance is unlikely.
pub(crate) fn right_one(shape: &Shape<'_>, bytes: &[u8]) -> Option<String> {
    let (_, fields, carrier) = shape.device.as_ref()?;
    let own = fields.iter().find_map(|field| match field {
        FieldSpec::Checksum(sum) => Some(*sum),
        _ => None,
    })?;
    let mut best: Option<(usize, String)> = None;
    for name in Algorithm::names() {
        let Some(algorithm) = Algorithm::named(name) else { continue };
        // Another length means another frame, which has a finding of its own.
        if algorithm.len() != own.algorithm.len() {
            continue;
        }
        for order in [ByteOrder::Little, ByteOrder::Big] {
            for (first, range) in ranges(&own, shape.head.len()) {
                let sum = Checksum { algorithm, order, first, ..own };
                if sum == own {
                    continue;
                }
                let right = count(&sum, shape, fields, *carrier, bytes);
                // One byte matches by chance once in 256.
                let needed = if own.algorithm.len() == 1 { 3 } else { 1 };
                if right >= needed && best.as_ref().is_none_or(|(most, _)| right > *most) {
                    best = Some((right, words(name, order, range, own.algorithm.len())));
                }
            }
        }
    }
    best.map(|(_, words)| words)
}

/// First bytes that a checksum may cover: as configured, the first of the head, the one after the head, the second one.
fn ranges(own: &Checksum, head: usize) -> Vec<(u16, &'static str)> {
    let mut ranges = vec![(own.first, "")];
    for (first, words) in [
        (0, ", from the first byte of the head"),
        (head as u16, ", from behind the head"),
        (1, ", from the second byte"),
    ] {
        if ranges.iter().all(|(known, _)| *known != first) {
            ranges.push((first, words));
        }
    }
    ranges
}

fn words(name: &str, order: ByteOrder, range: &str, len: usize) -> String {
    let order = match order {
        _ if len == 1 => "",
        ByteOrder::Little => ", low byte first",
        _ => ", high byte first",
    };
    format!("{name}{order}{range}")
}

/// Number of frames for which this checksum is right.
fn count(sum: &Checksum, shape: &Shape<'_>, fields: &[FieldSpec], carrier: Carrier, bytes: &[u8]) -> usize {
    let replaced: Vec<FieldSpec> = fields
        .iter()
        .map(|field| match field {
            FieldSpec::Checksum(_) => FieldSpec::Checksum(*sum),
            other => *other,
        })
        .collect();
    let delimiters = (shape.head, shape.tail);
    let Ok(frame) = DeviceFrame::new(carrier, Direction::Input, delimiters, &replaced) else { return 0 };
    if carrier == Carrier::Whole {
        let probe = frame.layout.probe_whole(&frame.elements, bytes);
        return usize::from(matches!(probe, Probe::Frame(_)));
    }
    let (mut at, mut right) = (0, 0);
    while let Some(rest) = bytes.get(at..).filter(|rest| !rest.is_empty()) {
        match frame.layout.probe(&frame.elements, rest) {
            Probe::Frame(len) => {
                right += 1;
                at += len.max(1);
            }
            _ => at += 1,
        }
    }
    right
}
