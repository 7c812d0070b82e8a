//! Frames of devices, read slowly and literally: all bytes at once, every number by hand.

use proto_core::device::{Algorithm, Bits, ByteOrder, Checksum, Crc, Digits, Element, Encoding, Kind, Width};
use proto_core::wire::scalar::ScalarType;

/// A frame's description, as it was given to the layout.
pub(crate) struct PlainFrame {
    pub(crate) head: Vec<u8>,
    pub(crate) tail: Vec<u8>,
    pub(crate) elements: Vec<Element>,
    /// With the number of elements before it.
    pub(crate) checksum: Option<(Checksum, usize)>,
}

/// What bytes are, seen as a frame that begins at the first of them.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Seen {
    No,
    Partial,
    Frame(usize),
    Other(usize),
    Wrong(usize),
}

/// Why a field has no place.
enum Missing {
    Bytes,
    End,
}

impl PlainFrame {
    pub(crate) fn see(&self, bytes: &[u8]) -> Seen {
        let begins = |bytes: &[u8], with: &[u8]| bytes.iter().zip(with).all(|(one, other)| one == other);
        if !begins(bytes, &self.head) {
            return Seen::No;
        }
        if bytes.len() < self.shortest() {
            return Seen::Partial;
        }
        let (mut at, mut start, mut sum_at, mut is_ours) = (self.head.len(), 0, 0, true);
        for nth in 0..=self.elements.len() {
            if let Some((sum, behind)) = &self.checksum
                && *behind == nth
            {
                sum_at = at;
                at += sum_len(sum);
            }
            let Some(element) = self.elements.get(nth) else { break };
            if !is_shared(element) {
                start = at;
            }
            let (len, behind) = match field(element, bytes, start) {
                Ok(found) => found,
                Err(Missing::Bytes) if is_ours || self.checksum.is_some() => return Seen::Partial,
                Err(_) => return Seen::No,
            };
            if let Element::Fixed { encoding, value } = element {
                is_ours &= read(encoding, &bytes[start..start + len]) == Some(*value as f64);
            }
            if !is_shared(element) {
                at = start + len + behind;
            }
        }
        if !begins(bytes.get(at..).unwrap_or(&[]), &self.tail) {
            return Seen::No;
        }
        let len = at + self.tail.len();
        if bytes.len() < len {
            return Seen::Partial;
        }
        let is_right = self.checksum.as_ref().map(|(sum, _)| self.is_right(sum, &bytes[..len], sum_at));
        match (is_right, is_ours) {
            (None, false) => Seen::No,
            (None | Some(true), true) => Seen::Frame(len),
            (Some(true), false) => Seen::Other(len),
            (Some(false), _) => Seen::Wrong(len),
        }
    }

    /// The values of a frame: `None` inside for one that cannot be read.
    pub(crate) fn values(&self, frame: &[u8]) -> Vec<Option<f64>> {
        let (mut at, mut start, mut values) = (self.head.len(), 0, Vec::new());
        for (nth, element) in self.elements.iter().enumerate() {
            if let Some((sum, behind)) = &self.checksum
                && *behind == nth
            {
                at += sum_len(sum);
            }
            if !is_shared(element) {
                start = at;
            }
            let Ok((len, behind)) = field(element, frame, start) else { panic!("it is a frame") };
            if let Element::Value { encoding, .. } = element {
                values.push(read(encoding, &frame[start..start + len]));
            }
            if !is_shared(element) {
                at = start + len + behind;
            }
        }
        values
    }

    fn shortest(&self) -> usize {
        let mut len = self.head.len() + self.tail.len();
        len += self.checksum.as_ref().map_or(0, |(sum, _)| sum_len(sum));
        for element in self.elements.iter().filter(|element| !is_shared(element)) {
            len += match element {
                Element::Padding { len, .. } => usize::from(*len),
                // At least the byte that ends it.
                Element::Value { encoding, .. } | Element::Fixed { encoding, .. } => {
                    width(encoding).unwrap_or(1)
                }
                // Not in the frames that this reader is compared for.
                Element::Text(_) | Element::Length(_) => 0,
            };
        }
        len
    }

    fn is_right(&self, sum: &Checksum, frame: &[u8], at: usize) -> bool {
        let end = sum.last().map_or(at, |last| usize::from(last) + 1);
        let number = compute(&sum.algorithm, &frame[usize::from(sum.first)..end]);
        let len = algorithm_len(&sum.algorithm);
        let mut expected = number.to_le_bytes()[..len].to_vec();
        if sum.order == ByteOrder::Big {
            expected.reverse();
        }
        let found = &frame[at..at + sum_len(sum)];
        if sum.text {
            let digits: String = expected.iter().map(|byte| format!("{byte:02x}")).collect();
            digits.as_bytes() == found.to_ascii_lowercase()
        } else {
            expected == found
        }
    }
}

fn is_shared(element: &Element) -> bool {
    matches!(element, Element::Value { encoding, .. } | Element::Fixed { encoding, .. } if encoding.shared)
}

/// Number of bytes; `None` if a byte ends the field.
fn width(encoding: &Encoding) -> Option<usize> {
    Some(match encoding.kind {
        Kind::Scalar(ty) => ty.size(),
        Kind::Uint24 | Kind::Int24 => 3,
        Kind::Bcd { bytes } | Kind::Bits(Bits { bytes, .. }) => bytes.into(),
        Kind::Hex(Width::Fixed(width)) | Kind::Decimal(Digits { width: Width::Fixed(width), .. }) => {
            width.into()
        }
        _ => return None,
    })
}

/// Length of a field that begins at `start`, and of what ends it.
fn field(element: &Element, bytes: &[u8], start: usize) -> Result<(usize, usize), Missing> {
    let rest = bytes.get(start..).unwrap_or(&[]);
    let fixed = |len: usize| if rest.len() < len { Err(Missing::Bytes) } else { Ok((len, 0)) };
    let encoding = match element {
        Element::Padding { len, .. } => return fixed((*len).into()),
        Element::Value { encoding, .. } | Element::Fixed { encoding, .. } => encoding,
        Element::Text(_) | Element::Length(_) => return fixed(0),
    };
    let end = match encoding.kind {
        Kind::Hex(Width::Until(end)) | Kind::Decimal(Digits { width: Width::Until(end), .. }) => end,
        _ => return fixed(width(encoding).unwrap_or(0)),
    };
    match rest.iter().position(|&byte| byte == end) {
        Some(len @ 0..=16) => Ok((len, 1)),
        Some(_) => Err(Missing::End),
        None if rest.len() > 16 => Err(Missing::End),
        None => Err(Missing::Bytes),
    }
}

/// The number that bytes are in this order.
fn number(order: ByteOrder, bytes: &[u8]) -> u64 {
    let mut bytes = bytes.to_vec();
    match order {
        ByteOrder::Little => bytes.reverse(),
        ByteOrder::Big => {}
        ByteOrder::LittleSwapped => bytes.chunks_mut(2).for_each(<[u8]>::reverse),
        ByteOrder::BigSwapped => {
            bytes.reverse();
            bytes.chunks_mut(2).for_each(<[u8]>::reverse);
        }
    }
    bytes.iter().fold(0, |number, &byte| number << 8 | u64::from(byte))
}

fn signed(number: u64, bits: u32) -> f64 {
    let number = number as i64;
    (if number >> (bits - 1) & 1 == 1 { number - (1 << bits) } else { number }) as f64
}

/// The number in a field; `None` if it has none.
pub(crate) fn read(encoding: &Encoding, bytes: &[u8]) -> Option<f64> {
    let raw = || number(encoding.order, bytes);
    Some(match encoding.kind {
        Kind::Scalar(ty) => match ty {
            ScalarType::Byte | ScalarType::Word | ScalarType::Dword => raw() as f64,
            ScalarType::Char => signed(raw(), 8),
            ScalarType::Short => signed(raw(), 16),
            ScalarType::Int => signed(raw(), 32),
            ScalarType::Float => f64::from(f32::from_bits(raw() as u32)),
            ScalarType::Double => f64::from_bits(raw()),
        },
        Kind::Uint24 => raw() as f64,
        Kind::Int24 => signed(raw(), 24),
        Kind::Bits(Bits { first, count, signed: has_sign, .. }) => {
            let number = raw() >> first & ((1 << count) - 1);
            if has_sign { signed(number, count.into()) } else { number as f64 }
        }
        Kind::Bcd { .. } => format!("{:x}", raw()).parse::<u64>().ok()? as f64,
        Kind::Hex(_) => {
            let text = core::str::from_utf8(bytes).ok().filter(|text| !text.starts_with('+'))?;
            u32::from_str_radix(text, 16).ok()?.into()
        }
        Kind::Decimal(_) => decimal(bytes)?,
        _ => panic!("an encoding without a reference"),
    })
}

fn decimal(bytes: &[u8]) -> Option<f64> {
    let bytes = bytes.trim_ascii_start();
    let digits = bytes.strip_prefix(b"-").or(bytes.strip_prefix(b"+")).unwrap_or(bytes).trim_ascii();
    let text = core::str::from_utf8(digits).ok()?;
    let whole: String = text.chars().filter(|&character| character != '.').collect();
    let points = text.len() - whole.len();
    let is_number = points < 2 && whole.bytes().all(|byte| byte.is_ascii_digit());
    if !is_number || whole.parse::<u64>().ok()? >= 1 << 53 {
        return None;
    }
    let number: f64 = text.parse().ok()?;
    Some(if bytes.starts_with(b"-") { -number } else { number })
}

fn algorithm_len(algorithm: &Algorithm) -> usize {
    match algorithm {
        Algorithm::Crc(crc) => usize::from(crc.width).div_ceil(8),
        Algorithm::Sum16 => 2,
        Algorithm::Sum8 | Algorithm::Xor8 | Algorithm::Lrc => 1,
        _ => panic!("a checksum without a reference"),
    }
}

fn sum_len(sum: &Checksum) -> usize {
    algorithm_len(&sum.algorithm) * if sum.text { 2 } else { 1 }
}

fn compute(algorithm: &Algorithm, bytes: &[u8]) -> u32 {
    let sum: u32 = bytes.iter().map(|&byte| u32::from(byte)).sum();
    match algorithm {
        Algorithm::Crc(crc) => divide(crc, bytes),
        Algorithm::Sum8 => sum % 256,
        Algorithm::Sum16 => sum % 65_536,
        Algorithm::Xor8 => bytes.iter().fold(0, |all, byte| all ^ byte).into(),
        Algorithm::Lrc => (256 - sum % 256) % 256,
        _ => panic!("a checksum without a reference"),
    }
}

/// A CRC as its definition says, a bit at a time.
fn divide(crc: &Crc, bytes: &[u8]) -> u32 {
    let width = u32::from(crc.width);
    let mut register = u64::from(crc.init);
    for &byte in bytes {
        let byte = if crc.refin { byte.reverse_bits() } else { byte };
        for bit in (0..8).rev() {
            let front = register >> (width - 1) ^ u64::from(byte) >> bit;
            register = register << 1 & ((1 << width) - 1);
            if front & 1 == 1 {
                register ^= u64::from(crc.poly);
            }
        }
    }
    let register = register as u32;
    let result = if crc.refout { register.reverse_bits() >> (32 - width) } else { register };
    result ^ crc.xorout
}
