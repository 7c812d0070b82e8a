//! Frames of devices: a plain implementation of docs/configuration.md section 4 for frames of fixed length. Frames of
//! varying length are laid out by `varying.rs`.
//!
//! Written from that page, independent of the engine's layouts and encodings.

use std::ops::Range;

use proto_core::config::{FieldSpec, InputRule, Limits, OutputBinding, Outside};
use proto_core::device::{Algorithm, ByteOrder, Checksum, Crc, Encoding, Kind, Overflow, TextWidth, Width};
use proto_core::wire::scalar::ScalarType;

/// The places of a frame's fields.
#[derive(Debug, Clone, Default)]
pub(super) struct DeviceSpec {
    /// The place of each field in the whole frame.
    pub places: Vec<Range<usize>>,
    /// The checksum, its place, and the bytes that it covers.
    sum: Option<(Checksum, Range<usize>, Range<usize>)>,
    /// Number of bytes of the fields and the checksum.
    pub len: usize,
}

/// How bytes are interpreted as a frame that begins with the first of them.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Look {
    /// No frame begins here.
    No,
    /// A frame may begin here. `is_ours`: all constants so far are those of this frame.
    Begins { is_ours: bool },
    /// A frame of this many bytes.
    Frame(usize),
    /// A frame with a valid checksum, of this many bytes, in which a constant is another device's.
    Other(usize),
    /// A frame of this many bytes with an invalid checksum.
    Wrong(usize),
}

/// How a complete frame is interpreted.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Seen {
    Ours,
    /// The checksum is valid, but a constant is another device's.
    Other,
    WrongChecksum,
    /// Not a frame.
    Nothing,
}

impl DeviceSpec {
    pub(super) fn new(head: usize, fields: &[FieldSpec]) -> Self {
        let mut spec = Self::default();
        let (mut at, mut first) = (head, head);
        for field in fields {
            let (len, is_shared) = match field {
                FieldSpec::UserInput { ty, .. } | FieldSpec::UserOutput { ty, .. } => (ty.size(), false),
                FieldSpec::DeviceInput { encoding, .. }
                | FieldSpec::DeviceOutput { encoding, .. }
                | FieldSpec::Fixed { encoding, .. } => (length(encoding), encoding.shared),
                FieldSpec::Padding { len, .. } => (usize::from(*len), false),
                FieldSpec::Checksum(sum) => (sum_bytes(sum), false),
                FieldSpec::System(var) => (var.size(), false),
                // These take no bytes of the frame.
                FieldSpec::Limits(_) | FieldSpec::Mapped(_) | FieldSpec::InputRule(_) => (0, true),
                FieldSpec::TextInput { text, .. } | FieldSpec::TextOutput { text, .. } => match text.width {
                    TextWidth::Fixed(width) => (usize::from(width), false),
                    _ => panic!("{field:?} varies"),
                },
                other => panic!("{other:?} has no model"),
            };
            if !is_shared {
                first = at;
                at += len;
            }
            spec.places.push(first..first + len);
            if let FieldSpec::Checksum(sum) = field {
                let end = sum.last().map_or(first, |last| usize::from(last) + 1);
                spec.sum = Some((*sum, first..first + len, usize::from(sum.first)..end));
            }
        }
        spec.len = at - head;
        spec
    }

    /// Sets the checksum, its place, and the bytes that it covers.
    pub(super) fn set_sum(&mut self, sum: Checksum, place: Range<usize>, covered: Range<usize>) {
        self.sum = Some((sum, place, covered));
    }

    /// Interprets a complete frame with the right head, tail and length.
    pub(super) fn see(&self, fields: &[FieldSpec], frame: &[u8]) -> Seen {
        match (self.sum_is_right(frame), self.agrees(fields, frame)) {
            (None, false) => Seen::Nothing,
            (None | Some(true), true) => Seen::Ours,
            (Some(true), false) => Seen::Other,
            (Some(false), _) => Seen::WrongChecksum,
        }
    }

    /// Whether the constants that are completely in the bytes are those of the frame.
    pub(super) fn agrees(&self, fields: &[FieldSpec], bytes: &[u8]) -> bool {
        fields.iter().zip(&self.places).filter(|(_, place)| place.end <= bytes.len()).all(|(field, place)| {
            constant(field)
                .is_none_or(|(encoding, value)| read(&encoding, &bytes[place.clone()]) == Some(value))
        })
    }

    /// Whether the checksum is valid; `None` without a checksum.
    pub(super) fn sum_is_right(&self, frame: &[u8]) -> Option<bool> {
        let (sum, place, covered) = self.sum.as_ref()?;
        let (id, covered) = (sum.data_id.bytes(), &frame[covered.clone()]);
        let (before, behind) = if sum.data_id.is_behind() { (&[][..], id) } else { (id, &[][..]) };
        let number = checksum(&sum.algorithm, [before, covered, behind].into_iter().flatten().copied());
        let len = if sum.text { place.len() / 2 } else { place.len() };
        let mut bytes = number.to_be_bytes();
        let bytes = &mut bytes[4 - len..];
        if sum.order == ByteOrder::Little {
            bytes.reverse();
        }
        let found = &frame[place.clone()];
        Some(if sum.text {
            let text: String = bytes.iter().map(|byte| format!("{byte:02x}")).collect();
            found.to_ascii_lowercase() == text.as_bytes()
        } else {
            found == bytes
        })
    }
}

/// The number of bytes of a field.
pub(super) enum Size {
    Fixed(usize),
    /// Up to this delimiter after the field, and at most this many bytes.
    Until(u8, usize),
    /// All bytes that the other fields leave.
    Rest,
}

pub(super) fn size(field: &FieldSpec) -> Size {
    let of_encoding = |encoding: &Encoding| match encoding.kind {
        Kind::Decimal(digits) => of_width(digits.width),
        Kind::Hex(width) => of_width(width),
        _ => Size::Fixed(length(encoding)),
    };
    match field {
        FieldSpec::TextInput { text, .. } | FieldSpec::TextOutput { text, .. } => match text.width {
            TextWidth::Fixed(width) => Size::Fixed(width.into()),
            TextWidth::Until(end) => Size::Until(end, MAX_TEXT),
            TextWidth::Rest => Size::Rest,
        },
        FieldSpec::UserInput { ty, .. } | FieldSpec::UserOutput { ty, .. } => Size::Fixed(ty.size()),
        FieldSpec::DeviceInput { encoding, .. }
        | FieldSpec::DeviceOutput { encoding, .. }
        | FieldSpec::Fixed { encoding, .. } => of_encoding(encoding),
        FieldSpec::Padding { len, .. } => Size::Fixed((*len).into()),
        FieldSpec::Checksum(sum) => Size::Fixed(sum_bytes(sum)),
        FieldSpec::Length(length) => of_encoding(&length.encoding),
        FieldSpec::System(var) => Size::Fixed(var.size()),
        FieldSpec::Limits(_) | FieldSpec::Mapped(_) | FieldSpec::InputRule(_) => Size::Fixed(0),
    }
}

fn of_width(width: Width) -> Size {
    match width {
        Width::Fixed(width) => Size::Fixed(width.into()),
        Width::Until(end) => Size::Until(end, MAX_DIGITS),
    }
}

/// Whether the length of a field varies from frame to frame, or the field contains the length of the frame.
pub(super) fn varies(field: &FieldSpec) -> bool {
    matches!(field, FieldSpec::Length(_)) || !matches!(size(field), Size::Fixed(_))
}

/// The encoding and the number of a constant field.
pub(super) fn constant(field: &FieldSpec) -> Option<(Encoding, f64)> {
    let (encoding, overflow, number) = match *field {
        FieldSpec::Fixed { encoding, value } => return Some((encoding, value as f64)),
        FieldSpec::UserOutput { ty, from: OutputBinding::Constant(number) } => {
            (Encoding::scalar(ty), Overflow::Usual, number)
        }
        FieldSpec::DeviceOutput { encoding, overflow, from: OutputBinding::Constant(number) } => {
            (encoding, overflow, number)
        }
        _ => return None,
    };
    Some((encoding, shown_as(&encoding, overflow, number)))
}

pub(super) fn sum_bytes(sum: &Checksum) -> usize {
    let bytes = match sum.algorithm {
        Algorithm::Crc(crc) => usize::from(crc.width).div_ceil(8),
        Algorithm::Sum16 => 2,
        Algorithm::Sum8 | Algorithm::Xor8 | Algorithm::Lrc => 1,
        other => panic!("{other:?} has no model"),
    };
    if sum.text { 2 * bytes } else { bytes }
}

fn checksum(algorithm: &Algorithm, bytes: impl Iterator<Item = u8> + Clone) -> u32 {
    let sum = || bytes.clone().map(u32::from).sum::<u32>();
    match algorithm {
        Algorithm::Sum8 => sum() % 256,
        Algorithm::Sum16 => sum() % 65_536,
        Algorithm::Lrc => (256 - sum() % 256) % 256,
        Algorithm::Xor8 => u32::from(bytes.fold(0, |xor, byte| xor ^ byte)),
        Algorithm::Crc(crc) => crc_of(crc, bytes),
        other => panic!("{other:?} has no model"),
    }
}

/// The remainder, computed bit by bit.
fn crc_of(crc: &Crc, bytes: impl Iterator<Item = u8>) -> u32 {
    let width = u32::from(crc.width);
    let top = 1_u64 << width;
    let mut register = u64::from(crc.init);
    for byte in bytes {
        let byte = if crc.refin { byte.reverse_bits() } else { byte };
        for bit in (0..8).rev() {
            let carry = register >> (width - 1) & 1 ^ u64::from(byte >> bit & 1);
            register = register << 1 & (top - 1);
            if carry == 1 {
                register ^= u64::from(crc.poly);
            }
        }
    }
    let register = register as u32;
    let result = if crc.refout { register.reverse_bits() >> (32 - width) } else { register };
    result ^ crc.xorout
}

/// The number that a field sends for a number of its source, by the rules after the field; `None` if nothing is sent.
pub(super) fn sent_for(encoding: &Encoding, number: f64, behind: &[FieldSpec]) -> Option<f64> {
    let is_whole = encoding.is_integer();
    match behind.first() {
        Some(FieldSpec::Limits(Limits { low, high, outside })) => {
            // Compared as the field sends it: a float has seven digits.
            let shown = if is_whole { number.round() } else { f64::from(number as f32) };
            let ends = [*low, *high].map(|end| if is_whole { end } else { f64::from(end as f32) });
            let is_outside = shown < ends[0] || shown > ends[1];
            (!is_outside || *outside == Outside::Clamp).then(|| number.clamp(*low, *high))
        }
        Some(FieldSpec::Mapped(_)) => behind.iter().find_map(|field| match field {
            FieldSpec::Mapped(entry) => {
                let own = entry.first as f64..=entry.last as f64;
                own.contains(&number.round()).then_some(entry.sent)
            }
            _ => None,
        }),
        _ => Some(number),
    }
}

/// The value read from an input field.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) enum Read {
    Number(f64),
    Unreadable,
    /// The device reports that it has no value.
    NoValue,
}

/// The number of an input field, by the rules after the field.
pub(super) fn read_ruled(encoding: &Encoding, bytes: &[u8], behind: &[FieldSpec]) -> Read {
    let rules = || {
        behind
            .iter()
            .filter_map(|field| if let FieldSpec::InputRule(rule) = field { Some(rule) } else { None })
    };
    let trimmed = bytes.trim_ascii();
    if rules().any(|rule| matches!(rule, InputRule::NoText(text) if text.bytes() == trimmed)) {
        return Read::NoValue;
    }
    let has_comma = rules().any(|rule| *rule == InputRule::Comma);
    let turned: Vec<u8> = bytes.iter().map(|byte| if *byte == b',' { b'.' } else { *byte }).collect();
    let number = match has_comma {
        true if bytes.contains(&b'.') => None,
        true => read(encoding, &turned),
        false => read(encoding, bytes),
    };
    let Some(number) = number else { return Read::Unreadable };
    let is_single = encoding.kind == Kind::Scalar(ScalarType::Float);
    let is_same = |code: f64| {
        code == number || code.is_nan() && number.is_nan() || is_single && code as f32 == number as f32
    };
    match rules().any(|rule| matches!(rule, InputRule::NoNumber(code) if is_same(*code))) {
        true => Read::NoValue,
        false => Read::Number(number),
    }
}

/// The value of a variable for the number of its field, before rounding; `None` if the number is not allowed.
pub(super) fn taken_for(
    encoding: &Encoding,
    number: f64,
    (scale, offset): (f32, f32),
    behind: &[FieldSpec],
) -> Option<f64> {
    let entries = || {
        behind
            .iter()
            .filter_map(|field| if let FieldSpec::Mapped(entry) = field { Some(entry) } else { None })
    };
    if entries().next().is_some() {
        let own = entries().find(|entry| (entry.first as f64..=entry.last as f64).contains(&number.round()));
        let otherwise = behind.iter().find_map(|field| match field {
            FieldSpec::InputRule(InputRule::Else(number)) => Some(*number),
            _ => None,
        });
        return own.map(|entry| entry.sent).or(otherwise);
    }
    let mut number = number;
    for field in behind {
        let FieldSpec::Limits(Limits { low, high, outside }) = *field else { continue };
        let is_single = !encoding.is_integer() || matches!(encoding.kind, Kind::Decimal(_));
        // Numbers are used as a float represents them, unless they are integers.
        let of = |number: f64| if is_single { f64::from(number as f32) } else { number };
        if (of(number) < of(low) || of(number) > of(high)) && outside == Outside::Refuse {
            return None;
        }
        number = number.clamp(low, high);
    }
    Some(number * f64::from(scale) + f64::from(offset))
}

/// The rules after a field.
pub(super) fn behind(fields: &[FieldSpec], nth: usize) -> &[FieldSpec] {
    let rest = &fields[nth + 1..];
    let len = rest.iter().take_while(|field| field.is_of_field_before()).count();
    &rest[..len]
}

/// Number of bytes of a field. Fields of varying length are refused before a run.
pub(super) fn length(encoding: &Encoding) -> usize {
    match encoding.kind {
        Kind::Scalar(ty) => ty.size(),
        Kind::Uint24 | Kind::Int24 => 3,
        Kind::Bcd { bytes } => usize::from(bytes),
        Kind::Bits(bits) => usize::from(bits.bytes),
        Kind::Decimal(digits) => fixed(digits.width),
        Kind::Hex(width) => fixed(width),
        other => panic!("{other:?} has no model"),
    }
}

fn fixed(width: Width) -> usize {
    match width {
        Width::Fixed(width) => usize::from(width),
        Width::Until(_) => panic!("a field of varying length has no model"),
    }
}

/// The place of the `nth` byte, counted from the highest, in a number of `len` bytes.
fn place_of(order: ByteOrder, nth: usize, len: usize) -> usize {
    match order {
        ByteOrder::Big => nth,
        ByteOrder::Little => len - 1 - nth,
        // Pairs of bytes, the last pair first; if the number of bytes is odd, the last byte is alone.
        ByteOrder::BigSwapped => match nth.checked_sub(len % 2) {
            Some(nth) => len - len % 2 - 2 - nth / 2 * 2 + nth % 2,
            None => len - 1,
        },
        ByteOrder::LittleSwapped if nth ^ 1 < len => nth ^ 1,
        ByteOrder::LittleSwapped => nth,
    }
}

/// The bytes, the highest first.
fn ordered(order: ByteOrder, bytes: &[u8]) -> impl Iterator<Item = u8> {
    (0..bytes.len()).map(move |nth| bytes[place_of(order, nth, bytes.len())])
}

/// The unsigned number in the bytes.
fn unsigned(order: ByteOrder, bytes: &[u8]) -> u64 {
    ordered(order, bytes).fold(0, |number, byte| number << 8 | u64::from(byte))
}

/// The number in a field's bytes; `None` if it is unreadable.
pub(super) fn read(encoding: &Encoding, bytes: &[u8]) -> Option<f64> {
    let unsigned = unsigned(encoding.order, bytes);
    let signed = |number: u64, bits: u32| (number << (64 - bits)).cast_signed() >> (64 - bits);
    Some(match encoding.kind {
        Kind::Scalar(ty) => match ty {
            ScalarType::Byte | ScalarType::Word | ScalarType::Dword => unsigned as f64,
            ScalarType::Char => signed(unsigned, 8) as f64,
            ScalarType::Short => signed(unsigned, 16) as f64,
            ScalarType::Int => signed(unsigned, 32) as f64,
            ScalarType::Float => f64::from(f32::from_bits(unsigned as u32)),
            ScalarType::Double => f64::from_bits(unsigned),
        },
        Kind::Uint24 => unsigned as f64,
        Kind::Int24 => signed(unsigned, 24) as f64,
        Kind::Bits(bits) => {
            let number = unsigned >> bits.first & ((1 << bits.count) - 1);
            if bits.signed { signed(number, bits.count.into()) as f64 } else { number as f64 }
        }
        Kind::Bcd { .. } => {
            let digits: String = ordered(encoding.order, bytes).map(|byte| format!("{byte:02x}")).collect();
            digits.parse::<u32>().ok()?.into()
        }
        Kind::Hex(_) => {
            let is_hex = bytes.iter().all(u8::is_ascii_hexdigit);
            let text = std::str::from_utf8(bytes).ok().filter(|_| is_hex)?;
            u32::from_str_radix(text, 16).ok()?.into()
        }
        Kind::Decimal(_) => {
            let text = std::str::from_utf8(bytes).ok()?.trim_start_matches([' ', '\t', '\n', '\r', '\x0C']);
            let (sign, digits) = match text.strip_prefix('-') {
                Some(digits) => (-1.0, digits),
                None => (1.0, text.strip_prefix('+').unwrap_or(text)),
            };
            let digits = digits.trim_matches([' ', '\t', '\n', '\r', '\x0C']);
            let is_decimal = digits.bytes().all(|byte| byte.is_ascii_digit() || byte == b'.');
            // At most 16 characters, of which a binary64 keeps 15 digits apart.
            let significant = digits.replace('.', "").trim_start_matches('0').len();
            if !is_decimal || significant > 15 {
                return None;
            }
            sign * digits.parse::<f64>().ok()?
        }
        other => panic!("{other:?} has no model"),
    })
}

/// Whether [`write`] supports fields with this encoding.
pub(super) const fn is_written_by_model(encoding: &Encoding) -> bool {
    matches!(encoding.kind, Kind::Scalar(_) | Kind::Uint24 | Kind::Int24 | Kind::Bits(_))
}

/// Writes a number that the field can represent into its bytes. Other bits of these bytes are unchanged.
pub(super) fn write(encoding: &Encoding, number: f64, bytes: &mut [u8]) {
    let len = bytes.len();
    let number = match encoding.kind {
        Kind::Scalar(ScalarType::Float) => u64::from((number as f32).to_bits()),
        Kind::Scalar(ScalarType::Double) => number.to_bits(),
        Kind::Bits(bits) => {
            let mask = ((1_u64 << bits.count) - 1) << bits.first;
            unsigned(encoding.order, bytes) & !mask | ((number as i64).cast_unsigned() << bits.first) & mask
        }
        _ => (number as i64).cast_unsigned(),
    };
    for (nth, byte) in number.to_be_bytes()[8 - len..].iter().enumerate() {
        bytes[place_of(encoding.order, nth, len)] = *byte;
    }
}

/// The number that a field sends for `number`: rounded, then limited to the field's range, or wrapped.
pub(super) fn shown_as(encoding: &Encoding, overflow: Overflow, number: f64) -> f64 {
    let (low, high) = range(encoding);
    let is_float = matches!(encoding.kind, Kind::Scalar(ScalarType::Float | ScalarType::Double));
    let unit = match encoding.kind {
        Kind::Decimal(digits) => 10_f64.powi(digits.decimals.into()),
        _ => 1.0,
    };
    let number = if is_float { number } else { (number * unit).round() / unit };
    let number = match overflow {
        Overflow::Wrap if unit == 1.0 && !is_float => {
            let span = high - low + 1.0;
            (number - low).rem_euclid(span) + low
        }
        _ => number.clamp(low, high),
    };
    match encoding.kind {
        Kind::Scalar(ScalarType::Float) => f64::from(number as f32),
        _ => number,
    }
}

/// The smallest and the largest number of a field.
pub(super) fn range(encoding: &Encoding) -> (f64, f64) {
    match encoding.kind {
        Kind::Scalar(ty) => ty.range(),
        Kind::Uint24 => (0.0, 16_777_215.0),
        Kind::Int24 => (-8_388_608.0, 8_388_607.0),
        Kind::Bcd { bytes } => (0.0, 100_f64.powi(bytes.into()) - 1.0),
        Kind::Hex(width) => (0.0, 16_f64.powi(fixed(width) as i32) - 1.0),
        Kind::Bits(bits) => {
            let count = 2_f64.powi(bits.count.into());
            if bits.signed { (-count / 2.0, count / 2.0 - 1.0) } else { (0.0, count - 1.0) }
        }
        Kind::Decimal(digits) => {
            let point = if digits.decimals == 0 { 0 } else { usize::from(digits.decimals) + 1 };
            let whole = fixed(digits.width) - point;
            let unit = 10_f64.powi(digits.decimals.into());
            let most = |whole: usize| {
                let all = (whole + usize::from(digits.decimals)).min(15);
                (10_f64.powi(all as i32) - 1.0) / unit
            };
            (-most(whole - 1), most(whole))
        }
        other => panic!("{other:?} has no model"),
    }
}

/// Maximum length of a text up to a delimiter.
pub(super) const MAX_TEXT: usize = 128;
/// Maximum number of digits up to a delimiter.
const MAX_DIGITS: usize = 16;

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn bytes_are_ordered_as_the_pieces_that_they_are_made_of() {
        let bytes = [1, 2, 3, 4, 5, 6, 7, 8];
        for len in 1..=bytes.len() {
            let bytes = &bytes[..len];
            let pairs = || bytes.chunks(2).map(<[u8]>::to_vec);
            let each_turned = pairs().map(|mut pair| {
                pair.reverse();
                pair
            });
            let expected = [
                (ByteOrder::Big, bytes.to_vec()),
                (ByteOrder::Little, bytes.iter().rev().copied().collect()),
                (ByteOrder::BigSwapped, pairs().rev().flatten().collect()),
                (ByteOrder::LittleSwapped, each_turned.flatten().collect()),
            ];
            for (order, expected) in expected {
                assert_eq!(ordered(order, bytes).collect::<Vec<_>>(), expected, "{order:?} of {len}");
            }
        }
    }
}
