//! Errors in the elements, texts or checksum of a frame.

use core::fmt;

use super::FrameLayout;
use super::element::Element;
use super::places::ElementPlaces;
use crate::device::checksum::Algorithm;
use crate::device::encoding::{Bits, Digits, Encoding, Kind, MAX_DIGITS, Width};
use crate::device::text::{Length, MAX_TEXT};
use crate::recipe::model::{MAX_DELIMITER, MAX_FIELDS};
use crate::sysvar::Direction;
use crate::wire::scalar::ScalarType;

/// Why a frame's layout is invalid.
#[derive(Debug, Clone, Copy, PartialEq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
#[non_exhaustive]
pub enum LayoutError {
    /// The head or the tail has more than 8 bytes.
    DelimiterTooLong {
        /// Number of bytes.
        len: usize,
    },
    /// There is no element, and no head.
    Empty,
    /// There are more than 128 elements.
    TooManyElements,
    /// The frame is longer than its carrier allows.
    TooLong {
        /// Maximum number of bytes of the frame.
        len: usize,
        /// Number of bytes that the carrier allows.
        room: usize,
    },
    /// Nothing marks the beginning of a frame: it has no head, tail, checksum or constant.
    NothingToFind,
    /// A parameter of an element's encoding is out of range, such as bits beyond its number.
    Encoding {
        /// Index of the element.
        element: u8,
    },
    /// The byte order swaps words, but the element does not consist of whole words.
    NotWords {
        /// Index of the element.
        element: u8,
    },
    /// An element shares the place of a shorter one. Or, in an output part, bits share a number with an element that is
    /// not bits or is part of another number, or overlap its bits.
    NotShared {
        /// Index of the element.
        element: u8,
    },
    /// The constant does not fit in its encoding.
    Constant {
        /// Index of the element.
        element: u8,
    },
    /// The parameters are not those of a CRC.
    Algorithm,
    /// The checksum is after more elements than there are, or between bits of one number.
    ChecksumPlace,
    /// The checksum covers nothing, itself, the tail, or bytes after a field of varying length.
    ChecksumRange,
    /// The frame begins with a text or with arbitrary bytes, so the end of another frame could be mistaken for it.
    NoBeginning {
        /// Index of the text.
        element: u8,
    },
    /// Nothing shows where the frame and its last text end.
    NoEnd {
        /// Index of the text.
        element: u8,
    },
    /// A field of varying length follows a `TextWidth::Rest` text.
    BehindRest {
        /// Index of the field.
        element: u8,
    },
    /// A length field that is not an integer, has a varying length itself, or is the second one.
    Length {
        /// Index of the element.
        element: u8,
    },
}

impl fmt::Display for LayoutError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match *self {
            Self::DelimiterTooLong { len } => {
                write!(f, "{len} bytes of head or tail; at most {MAX_DELIMITER} are allowed")
            }
            Self::Empty => f.write_str("the frame has no fields"),
            Self::TooManyElements => write!(f, "more than {MAX_FIELDS} fields"),
            Self::TooLong { len, room } => write!(f, "a frame of {len} bytes; at most {room} are allowed"),
            Self::NothingToFind => {
                f.write_str("nothing tells where a frame begins: a head, a tail, a checksum or a constant is needed")
            }
            Self::Encoding { .. } => f.write_str("the field cannot be written like this"),
            Self::NotWords { .. } => {
                f.write_str("an order that swaps words needs a field of whole words: 2, 4 or 8 bytes")
            }
            Self::NotShared { .. } => f.write_str(
                "the field cannot share the bytes of the one before: there is none, or it is shorter, or (in an \
                 output part) it is not other bits of the same number",
            ),
            Self::Constant { .. } => f.write_str("the field cannot have this value"),
            Self::Algorithm => f.write_str("these are not the parameters of a CRC: 1 to 32 bits, no number with more"),
            Self::ChecksumPlace => {
                f.write_str("the checksum must stand between two fields, or behind the last one")
            }
            Self::ChecksumRange => f.write_str(
                "the checksum must cover bytes of head and fields, and not itself",
            ),
            Self::NoBeginning { .. } => f.write_str(
                "a text at the beginning of a frame could be the end of a longer one; a head, a checksum, \
                 framing = \"tail\" or \"silence\", or escape is needed",
            ),
            Self::NoEnd { .. } => f.write_str(
                "nothing tells where the text ends; width, until, a length before it, framing or escape is needed",
            ),
            Self::BehindRest { .. } => {
                f.write_str("the text before takes the rest of the frame; no field of varying length may follow")
            }
            Self::Length { .. } => {
                f.write_str("a frame has one length, an integer in a fixed number of bytes")
            }
        }
    }
}

impl core::error::Error for LayoutError {}

impl LayoutError {
    /// Index of the faulty element.
    pub const fn element(&self) -> Option<u8> {
        match *self {
            Self::Encoding { element }
            | Self::NotWords { element }
            | Self::NotShared { element }
            | Self::Constant { element }
            | Self::NoBeginning { element }
            | Self::NoEnd { element }
            | Self::BehindRest { element }
            | Self::Length { element } => Some(element),
            _ => None,
        }
    }

    /// Whether the error concerns the checksum.
    pub const fn is_of_checksum(&self) -> bool {
        matches!(self, Self::Algorithm | Self::ChecksumPlace | Self::ChecksumRange)
    }
}

impl FrameLayout {
    /// Checks the beginnings and ends of texts, and the elements after a `TextWidth::Rest` text.
    pub(super) fn check_texts(&mut self, is_searched: bool, elements: &[Element]) -> Result<(), LayoutError> {
        let mut begins = !is_searched || !self.head.is_empty() || self.checksum.is_some();
        let mut ends = !is_searched;
        let mut rest_from = None;
        let mut places = ElementPlaces::new(self, None);
        for (nth, element) in elements.iter().enumerate() {
            let nth = nth as u8;
            match element {
                Element::Text(_) if !begins => return Err(LayoutError::NoBeginning { element: nth }),
                _ if rest_from.is_some() && element.len().is_none() => {
                    return Err(LayoutError::BehindRest { element: nth });
                }
                Element::Text(_) if element.is_rest() && !ends => {
                    return Err(LayoutError::NoEnd { element: nth });
                }
                Element::Fixed { .. } => begins = true,
                Element::Length(_) => ends = true,
                _ => {}
            }
            if element.is_rest() {
                // A checksum directly after the text also counts as behind it.
                rest_from = Some(places.at);
            }
            places.next(element, element.len().unwrap_or(0), 0);
        }
        let all = places.at.saturating_add(self.tail.len());
        self.behind_rest = rest_from.map_or(0, |from| all.saturating_sub(from)) as u16;
        Ok(())
    }

    pub(super) fn check_checksum(&self, elements: &[Element]) -> Result<(), LayoutError> {
        let Some(sum) = self.checksum else { return Ok(()) };
        let is_valid = match sum.algorithm {
            Algorithm::Crc(crc) => crc.is_valid(),
            _ => true,
        };
        if !is_valid || sum.order.swaps_words() {
            return Err(LayoutError::Algorithm);
        }
        // After a field of varying length, offsets are unknown.
        let mut places = ElementPlaces::new(self, None);
        let mut numbered = None;
        for element in elements {
            let len = element.len();
            if len.is_none() {
                numbered = numbered.or(Some(places.at));
            }
            places.next(element, len.unwrap_or(0), usize::from(element.until().is_some()));
        }
        let at = places.checksum_at;
        let own = at..at.saturating_add(sum.len());
        let covered = sum.covered(at);
        let overlaps = covered.start < own.end && own.start < covered.end;
        let end = if sum.last().is_some() { numbered.unwrap_or(places.at) } else { places.at };
        let comes_late = numbered.is_some_and(|numbered| usize::from(sum.first) > numbered);
        // If a text is empty, the checksum may cover nothing.
        let covers_nothing = covered.is_empty() && (numbered.is_none() || covered.start > covered.end);
        if covers_nothing || overlaps || covered.end > end || comes_late {
            return Err(LayoutError::ChecksumRange);
        }
        Ok(())
    }
}

pub(super) fn check_elements(elements: &[Element], direction: Direction) -> Result<(), LayoutError> {
    // The newest element that is not shared (length, terminating byte, order), and which of its bits are used.
    let mut place: Option<(Encoding, u64)> = None;
    let mut has_length = false;
    for (nth, element) in elements.iter().enumerate() {
        let nth = nth as u8;
        if let Element::Length(Length { encoding, .. }) = element {
            if has_length || encoding.size().is_none() || !encoding.is_integer() {
                return Err(LayoutError::Length { element: nth });
            }
            has_length = true;
        }
        let Some(encoding) = element.encoding() else {
            let longest = if matches!(element, Element::Text(_)) { MAX_TEXT } else { usize::MAX };
            if element.len().is_some_and(|len| !(1..=longest).contains(&len)) {
                return Err(LayoutError::Encoding { element: nth });
            }
            place = None;
            continue;
        };
        check_encoding(&encoding, nth)?;
        if let Element::Fixed { value, .. } = *element {
            let (low, high) = encoding.range();
            let is_float = matches!(encoding.kind, Kind::Scalar(ScalarType::Float | ScalarType::Double));
            if is_float || !(low..=high).contains(&(value as f64)) {
                return Err(LayoutError::Constant { element: nth });
            }
        }
        let ones = element.bits().map_or(u64::MAX, |bits| bits.places(encoding.order));
        place = match place {
            _ if !encoding.shared => Some((encoding, ones)),
            Some((first, taken)) if may_share(&first, &encoding, taken & ones, direction) => {
                Some((first, taken | ones))
            }
            _ => return Err(LayoutError::NotShared { element: nth }),
        };
    }
    Ok(())
}

/// Whether `second` may share the place of `first`; `both` are the bits used by both.
fn may_share(first: &Encoding, second: &Encoding, both: u64, direction: Direction) -> bool {
    match direction {
        Direction::Input => match (first.size(), second.size()) {
            (Some(first), Some(second)) => second <= first,
            _ => first.until() == second.until(),
        },
        Direction::Output => {
            let are_bits = matches!((first.kind, second.kind), (Kind::Bits(_), Kind::Bits(_)));
            are_bits && first.size() == second.size() && both == 0
        }
    }
}

fn check_encoding(encoding: &Encoding, element: u8) -> Result<(), LayoutError> {
    let in_range = |number: u8, most: usize| (1..=most).contains(&usize::from(number));
    let is_valid = match encoding.kind {
        Kind::Scalar(_) | Kind::Uint24 | Kind::Int24 => true,
        Kind::Bcd { bytes } => in_range(bytes, 4),
        Kind::Hex(Width::Fixed(width)) => in_range(width, 8),
        Kind::Hex(Width::Until(end)) => !end.is_ascii_hexdigit(),
        Kind::Decimal(Digits { width: Width::Fixed(width), decimals }) => {
            // The decimals need a sign, a digit and a point before them.
            let least = if decimals == 0 { 1 } else { usize::from(decimals).saturating_add(3) };
            in_range(width, MAX_DIGITS) && usize::from(width) >= least
        }
        Kind::Decimal(Digits { width: Width::Until(end), decimals }) => {
            decimals <= 9 && !matches!(end, b'0'..=b'9' | b'+' | b'-' | b'.' | b' ')
        }
        Kind::Bits(Bits { bytes, first, count, .. }) => {
            let all = u16::from(bytes).saturating_mul(8);
            matches!(bytes, 1..=8)
                && matches!(count, 1..=32)
                && u16::from(first).saturating_add(u16::from(count)) <= all
        }
    };
    if !is_valid {
        return Err(LayoutError::Encoding { element });
    }
    let is_words = match encoding.kind {
        Kind::Decimal(_) | Kind::Hex(_) => false,
        _ => encoding.size().is_some_and(|len| len.is_multiple_of(2)),
    };
    if encoding.order.swaps_words() && !is_words {
        return Err(LayoutError::NotWords { element });
    }
    Ok(())
}
