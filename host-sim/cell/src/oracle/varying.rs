//! Frames of varying length and the texts in them, and how bytes are interpreted as a frame: docs/configuration.md
//! section 4, "Frames of varying length".
//!
//! Written from that page, independent of the engine's layouts and cutters. In: a frame and bytes. Out: the places of
//! the fields in these bytes, in the form used for frames of fixed length.

use std::ops::Range;

use proto_core::config::{FieldSpec, Words};
use proto_core::device::{ByteOrder, Counts, Encoding, Text, TextWidth};
use proto_core::sysvar::SysVar;

use super::device::{DeviceSpec, Look, MAX_TEXT, Seen, Size, constant, read, size};
use super::frame::{Frame, Raw};

/// Why bytes are not this frame.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Unlike {
    /// No frame has this length, or the bytes end inside a field.
    Length,
    /// A constant in the bytes belongs to another frame.
    Content,
}

fn is_shared(field: &FieldSpec) -> bool {
    field.is_of_field_before()
        || field.element().and_then(|element| element.encoding()).is_some_and(|encoding| encoding.shared)
}

/// The lengths of the shortest and of the longest frame in bytes.
pub(super) fn lengths(frame: &Frame) -> (usize, usize) {
    let delimiters = frame.head.len() + frame.tail.len();
    frame.fields.iter().filter(|field| !is_shared(field)).fold(
        (delimiters, delimiters),
        |(low, high), field| match size(field) {
            Size::Fixed(len) => (low + len, high + len),
            Size::Until(_, most) => (low + 1, high + most + 1),
            Size::Rest => (low, high + MAX_TEXT),
        },
    )
}

/// The places of the fields in `whole`, which is exactly one frame.
pub(super) fn lay_out(frame: &Frame, whole: &[u8]) -> Result<DeviceSpec, Unlike> {
    let (shortest, longest) = lengths(frame);
    if !(shortest..=longest).contains(&whole.len()) {
        return Err(Unlike::Length);
    }
    if !whole.starts_with(&frame.head) {
        return Err(Unlike::Content);
    }
    let end = whole.len() - frame.tail.len();
    let mut spec = DeviceSpec::default();
    let (mut at, mut first) = (frame.head.len(), frame.head.len());
    for (nth, field) in frame.fields.iter().enumerate() {
        let (len, further) = match size(field) {
            Size::Fixed(len) => (len, 0),
            Size::Until(stop, most) => {
                let rest = whole.get(at..).unwrap_or(&[]);
                match rest.iter().position(|&byte| byte == stop) {
                    Some(len) if len <= most => (len, 1),
                    Some(_) => return Err(Unlike::Content),
                    None if rest.len() > most => return Err(Unlike::Content),
                    None => return Err(Unlike::Length),
                }
            }
            Size::Rest => {
                let behind: usize = frame.fields[nth + 1..].iter().map(fixed_size).sum();
                match end.checked_sub(at + behind) {
                    Some(len) if len <= MAX_TEXT => (len, 0),
                    _ => return Err(Unlike::Content),
                }
            }
        };
        if !is_shared(field) {
            first = at;
            at += len + further;
        }
        if first + len > whole.len() {
            return Err(Unlike::Length);
        }
        spec.places.push(first..first + len);
        if let FieldSpec::Checksum(sum) = field {
            let covered = usize::from(sum.first)..sum.last().map_or(first, |last| usize::from(last) + 1);
            spec.set_sum(*sum, first..first + len, covered);
        }
    }
    spec.len = at - frame.head.len();
    let says = |(field, place): (&FieldSpec, &Range<usize>)| match field {
        FieldSpec::Length(own) => {
            let number = read(&own.encoding, &whole[place.clone()])?;
            Some(number as i64 + i64::from(own.plus) == counted(frame, own.counts, place.end, whole.len()))
        }
        _ => Some(true),
    };
    let agree = frame.fields.iter().zip(&spec.places).all(|both| says(both) == Some(true));
    if at != end || !whole.ends_with(&frame.tail) || !agree {
        return Err(Unlike::Content);
    }
    Ok(spec)
}

fn fixed_size(field: &FieldSpec) -> usize {
    match size(field) {
        Size::Fixed(len) if !is_shared(field) => len,
        _ => 0,
    }
}

/// What a length field that ends at `at` contains in a frame of `len` bytes.
fn counted(frame: &Frame, counts: Counts, at: usize, len: usize) -> i64 {
    let sum = frame.fields.iter().rev().find(|field| matches!(field, FieldSpec::Checksum(_)));
    let others = frame.tail.len() + sum.map_or(0, fixed_size);
    let counted = match counts {
        Counts::Rest => len - at,
        Counts::Frame => len,
        // A soak run refuses such a length after a checksum.
        Counts::Fields => len.saturating_sub(at + others),
    };
    counted as i64
}

/// Interprets a complete frame.
pub(super) fn see(frame: &Frame, whole: &[u8]) -> Result<(DeviceSpec, Seen), Unlike> {
    let spec = lay_out(frame, whole)?;
    let seen = spec.see(&frame.fields, whole);
    Ok((spec, seen))
}

/// Interprets bytes of a line as this frame.
pub(super) fn look(frame: &Frame, bytes: &[u8]) -> Look {
    if frame.varies {
        return look_varying(frame, bytes);
    }
    let seen = bytes.len().min(frame.head.len());
    if bytes[..seen] != frame.head[..seen] {
        return Look::No;
    }
    let Some(whole) = bytes.get(..frame.len()) else {
        let is_ours = frame.device.as_ref().is_some_and(|device| device.agrees(&frame.fields, bytes));
        return Look::Begins { is_ours };
    };
    let Some(device) = frame.device.as_ref().filter(|_| whole.ends_with(&frame.tail)) else {
        return Look::No;
    };
    match device.see(&frame.fields, whole) {
        Seen::Ours => Look::Frame(whole.len()),
        Seen::Other => Look::Other(whole.len()),
        Seen::WrongChecksum => Look::Wrong(whole.len()),
        Seen::Nothing => Look::No,
    }
}

/// Whether two frames of the same direction can have the same bytes, so that they cannot be told apart.
pub(super) fn can_be_the_same(one: &Frame, other: &Frame) -> bool {
    let (Some(of_one), Some(of_other)) = (&one.device, &other.device) else { return false };
    let constants = |frame: &'_ Frame, device: &'_ DeviceSpec| -> Vec<(Range<usize>, Encoding, u64)> {
        let fields = frame.fields.iter().zip(&device.places);
        let of = |(field, place): (&FieldSpec, &Range<usize>)| {
            constant(field).map(|(encoding, value)| (place.clone(), encoding, value.to_bits()))
        };
        fields.filter_map(of).collect()
    };
    let others = constants(other, of_other);
    let differ = constants(one, of_one).into_iter().any(|(place, encoding, value)| {
        others.iter().any(|other| (&other.0, &other.1) == (&place, &encoding) && other.2 != value)
    });
    (one.id, &one.head, &one.tail, one.len()) == (other.id, &other.head, &other.tail, other.len()) && !differ
}

/// Interprets bytes of a line as a frame of varying length that has its length field before the varying part.
fn look_varying(frame: &Frame, bytes: &[u8]) -> Look {
    let seen = bytes.len().min(frame.head.len());
    let (shortest, longest) = lengths(frame);
    if bytes[..seen] != frame.head[..seen] {
        return Look::No;
    }
    let begins = Look::Begins { is_ours: false };
    if bytes.len() < shortest {
        return begins;
    }
    let mut at = frame.head.len();
    let mut said = None;
    for field in &frame.fields {
        let len = fixed_size(field);
        if let FieldSpec::Length(own) = field {
            let Some(number) = read(&own.encoding, &bytes[at..at + len]) else { return Look::No };
            let from = counted(frame, own.counts, at + len, longest);
            said = Some(number as i64 + i64::from(own.plus) + longest as i64 - from);
            break;
        }
        at += len;
    }
    let Some(said) = said.and_then(|said| usize::try_from(said).ok()) else { return Look::No };
    if !(shortest..=longest).contains(&said) {
        return Look::No;
    }
    let Some(whole) = bytes.get(..said) else { return begins };
    match see(frame, whole) {
        Ok((_, Seen::Ours)) => Look::Frame(said),
        Ok((_, Seen::Other)) => Look::Other(said),
        Ok((_, Seen::WrongChecksum)) => Look::Wrong(said),
        Ok((_, Seen::Nothing)) | Err(_) => Look::No,
    }
}

/// The text in the bytes of a field, without padding.
pub(super) fn text_in(text: Text, bytes: &[u8]) -> &[u8] {
    let (TextWidth::Fixed(_), Some(fill)) = (text.width, text.fill) else { return bytes };
    let len = bytes.iter().rposition(|&byte| byte != fill).map_or(0, |last| last + 1);
    &bytes[..len]
}

/// The registers with a text: two characters each, and zeros after its end. `None` if the text is too long.
pub(super) fn registers(words: Words, text: &[u8]) -> Option<Vec<(SysVar, Raw)>> {
    if text.len() > 2 * usize::from(words.count) {
        return None;
    }
    let character = |at: usize| text.get(at).copied().unwrap_or(0);
    let vars = words.iter().enumerate().map(|(nth, var)| {
        let (first, second) = (character(2 * nth), character(2 * nth + 1));
        let word = if words.order == ByteOrder::Little { [first, second] } else { [second, first] };
        (var, [word[0], word[1], 0, 0])
    });
    Some(vars.collect())
}

/// The text in registers: up to the first zero, or with a given number of characters. `None` if that number does not
/// fit.
pub(super) fn text_of(
    words: Words,
    raw: impl Fn(SysVar) -> Option<Raw>,
    len: Option<usize>,
) -> Option<Vec<u8>> {
    let mut text = Vec::new();
    for var in words.iter() {
        let [low, high, ..] = raw(var)?;
        text.extend(if words.order == ByteOrder::Little { [low, high] } else { [high, low] });
    }
    let len = len.unwrap_or_else(|| text.iter().position(|&byte| byte == 0).unwrap_or(text.len()));
    (len <= text.len()).then(|| text[..len].to_vec())
}

/// The bytes of a field with this text; `None` if it does not fit.
pub(super) fn field_of(text: Text, characters: &[u8]) -> Option<Vec<u8>> {
    let mut bytes = characters.to_vec();
    match text.width {
        TextWidth::Fixed(width) => match (usize::from(width).checked_sub(bytes.len())?, text.fill) {
            (0, _) => {}
            (more, Some(fill)) => bytes.extend(vec![fill; more]),
            (_, None) => return None,
        },
        TextWidth::Until(end) if bytes.contains(&end) => return None,
        TextWidth::Until(_) | TextWidth::Rest => {}
    }
    (bytes.len() <= MAX_TEXT).then_some(bytes)
}
