//! The best match of received bytes with the expected frame: head, tail, length, byte order.

use crate::bytes::{is_at, most, places};
use crate::shape::{NumberField, Shape};
use proto_core::device::ByteOrder;

/// How bytes differ from the expected frames.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) enum Fit {
    /// The head's bytes in the other order.
    HeadSwapped {
        seen: Vec<u8>,
    },
    /// Frames of the right length and with the tail begin with other bytes.
    HeadDiffers {
        seen: Vec<u8>,
    },
    /// The head matches if bit 7 is ignored.
    SevenBits,
    /// Frames of the right length end with other bytes.
    TailDiffers {
        seen: Vec<u8>,
    },
    /// Frames have another length.
    Length {
        seen: usize,
    },
    /// A head with too few bytes after it.
    BrokenOff {
        seen: usize,
    },
    NoHead,
}

/// Maximum difference from the right length at which a frame is still recognised.
const NEAR: usize = 8;

/// The best match. `None` if frames seem right, or there are too few bytes to tell.
pub(crate) fn fit(shape: &Shape<'_>, bytes: &[u8]) -> Option<Fit> {
    let head = shape.head;
    if head.is_empty() {
        return shape.len.and_then(|len| fit_tails(shape, bytes, len));
    }
    let heads = places(bytes, head);
    if heads.is_empty() {
        return without_head(shape, bytes);
    }
    let len = shape.len?;
    let distance = |heads: &[usize], needs_tail: bool, way: usize| {
        let is_frame = |&&at: &&usize| {
            is_at(bytes, at + way, head)
                && (!needs_tail || is_at(bytes, at + way - shape.tail.len(), shape.tail))
        };
        heads.iter().filter(is_frame).count()
    };
    let shortest = head.len() + shape.tail.len();
    let ways: Vec<usize> = (len.saturating_sub(NEAR).max(shortest)..=len + NEAR).collect();
    let best = |needs_tail: bool| {
        // The right length wins a tie.
        let scores = ways.iter().map(|&way| (distance(&heads, needs_tail, way), way == len, way));
        scores.max().filter(|(score, ..)| *score > 0)
    };
    let enough = |score: usize, way: usize| score >= (bytes.len() / way / 3).max(1);
    if !shape.tail.is_empty()
        && let Some((score, is_right, way)) = best(true)
        && enough(score, way)
    {
        return (!is_right).then_some(Fit::Length { seen: way });
    }
    if let Some((score, is_right, way)) = best(false)
        && enough(score, way)
        && score >= 2
    {
        return match is_right {
            true => tail_of(shape, bytes, &heads, len),
            false => Some(Fit::Length { seen: way }),
        };
    }
    single(shape, bytes, heads[0], len)
}

/// The tail that frames of the right length have, if it is the same in most of them and not the right one.
fn tail_of(shape: &Shape<'_>, bytes: &[u8], heads: &[usize], len: usize) -> Option<Fit> {
    let place = |at: &usize| bytes.get(at + len - shape.tail.len()..at + len);
    let (seen, _) = most(heads.iter().filter(|&&at| is_at(bytes, at + len, shape.head)).filter_map(place))?;
    (seen != shape.tail).then(|| Fit::TailDiffers { seen: seen.to_vec() })
}

/// One frame or the beginning of one, with nothing after it.
fn single(shape: &Shape<'_>, bytes: &[u8], at: usize, len: usize) -> Option<Fit> {
    let rest = &bytes[at..];
    let tails = places(rest, shape.tail);
    let first = tails.iter().map(|tail| tail + shape.tail.len()).find(|&end| end >= shape.head.len());
    match first {
        Some(end) if end == len => None,
        Some(end) if end.abs_diff(len) <= NEAR && end == rest.len() => Some(Fit::Length { seen: end }),
        _ if rest.len() < len => Some(Fit::BrokenOff { seen: rest.len() }),
        _ => {
            let seen = rest.get(len - shape.tail.len()..len)?;
            (seen != shape.tail).then(|| Fit::TailDiffers { seen: seen.to_vec() })
        }
    }
}

/// Bytes that do not contain the head.
fn without_head(shape: &Shape<'_>, bytes: &[u8]) -> Option<Fit> {
    let head = shape.head;
    if bytes.len() < head.len() {
        return None;
    }
    let mut swapped = head.to_vec();
    swapped.reverse();
    let found = places(bytes, &swapped);
    if swapped != head && !found.is_empty() {
        let is_frame = |&at: &usize| match shape.len {
            Some(len) => {
                let has_tail = !shape.tail.is_empty();
                is_at(bytes, at + len, &swapped)
                    || has_tail && is_at(bytes, at + len - shape.tail.len(), shape.tail)
            }
            None => found.len() >= 2,
        };
        // Two bytes occur by chance once in 65536, but not with a frame around them.
        if found.iter().any(is_frame) {
            return Some(Fit::HeadSwapped { seen: swapped });
        }
    }
    let clear: Vec<u8> = bytes.iter().map(|byte| byte & 0x7F).collect();
    let clear_head: Vec<u8> = head.iter().map(|byte| byte & 0x7F).collect();
    let seven = places(&clear, &clear_head).len();
    if let Some(len) = shape.len {
        if head.len() >= 2 && seven >= (bytes.len() / len / 2).max(2) {
            return Some(Fit::SevenBits);
        }
        if let Some(seen) = head_before_tails(shape, bytes, len) {
            return Some(Fit::HeadDiffers { seen });
        }
    }
    Some(Fit::NoHead)
}

/// The bytes at the head's place in frames that end with the right tail.
fn head_before_tails(shape: &Shape<'_>, bytes: &[u8], len: usize) -> Option<Vec<u8>> {
    if shape.tail.len() < 2 {
        return None;
    }
    let ends: Vec<usize> = places(bytes, shape.tail).iter().map(|at| at + shape.tail.len()).collect();
    let begins = ends.iter().filter_map(|end| end.checked_sub(len));
    let (seen, count) = most(begins.filter_map(|at| bytes.get(at..at + shape.head.len())))?;
    (count >= 2 || ends == [bytes.len()]).then(|| seen.to_vec())
}

/// Frames without a head, which end with a tail.
fn fit_tails(shape: &Shape<'_>, bytes: &[u8], len: usize) -> Option<Fit> {
    let ends = places(bytes, shape.tail);
    if ends.is_empty() {
        return (bytes.len() >= len).then_some(Fit::NoHead);
    }
    let (way, count) = most(ends.windows(2).map(|pair| pair[1] - pair[0]))?;
    (way != len && count >= 2).then_some(Fit::Length { seen: way })
}

/// Whether the floats of right frames are only plausible in the other byte order: an example as read, and swapped.
pub(crate) fn other_order(shape: &Shape<'_>, frames: &[&[u8]]) -> Option<(f64, f64)> {
    let (mut read, mut swapped, mut all) = (0_usize, 0_usize, 0_usize);
    let mut example = None;
    for frame in frames {
        for number in &shape.floats {
            let (own, other) = values(number, frame)?;
            if own == 0.0 && other == 0.0 {
                continue;
            }
            all += 1;
            read += usize::from(is_sensible(own));
            swapped += usize::from(is_sensible(other));
            if is_sensible(other) && !is_sensible(own) {
                example = Some((own, other));
            }
        }
    }
    (all >= MIN_VALUES && swapped == all && read * 4 <= all).then_some(example).flatten()
}

/// Minimum number of values other than zero for a decision.
const MIN_VALUES: usize = 6;

/// Whether a value is plausible for a measurement.
fn is_sensible(value: f64) -> bool {
    value.is_finite() && (1e-6..=1e7).contains(&value.abs())
}

/// A float in the recipe's byte order, and with its bytes reversed.
fn values(number: &NumberField, frame: &[u8]) -> Option<(f64, f64)> {
    let bytes = frame.get(number.at..number.at + number.size)?;
    // Little or big endian, or one of the two word orders; the other one is the alternative.
    let (mut own, mut other) = (bytes.to_vec(), bytes.to_vec());
    match number.order {
        ByteOrder::Little => other.reverse(),
        ByteOrder::Big => own.reverse(),
        _ => return None,
    }
    let float = |bytes: &[u8]| match *bytes {
        [a, b, c, d] => Some(f64::from(f32::from_le_bytes([a, b, c, d]))),
        _ => Some(f64::from_le_bytes(bytes.try_into().ok()?)),
    };
    Some((float(&own)?, float(&other)?))
}
