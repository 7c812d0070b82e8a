//! One frame of a device: head, elements, checksum, tail.
//!
//! In: bytes that may begin with such a frame, or the numbers to send. Out: whether and how far they
//! are one and the values in it, or the frame. The elements stay with the caller, so that the frames
//! of many devices share one pool; every call takes the ones that [`FrameLayout::new`] checked.

use core::fmt;

use heapless::Vec;

use super::checksum::Algorithm;
use super::encoding::{Bits, Digits, Encoding, Kind, MAX_DIGITS, Overflow, Unreadable, Width};
use super::order::ByteOrder;
use crate::recipe::model::{MAX_DELIMITER, MAX_FIELDS, MAX_STREAM_FRAME};
use crate::sysvar::Direction;
use crate::wire::can::MAX_CAN_DATA;
use crate::wire::scalar::{Scalar, ScalarType};

/// One element of a frame, in the order of the wire.
#[derive(Debug, Clone, Copy, PartialEq)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
pub enum Element {
    /// A value.
    Value {
        /// How it is written.
        encoding: Encoding,
        /// What is sent for a number that it cannot hold.
        overflow: Overflow,
    },
    /// A value that is always the same: a frame with another one is not this frame.
    Fixed {
        /// How it is written.
        encoding: Encoding,
        /// The value, an integer.
        value: i64,
    },
    /// Bytes without a meaning: any are accepted.
    Padding {
        /// Number of bytes, 1 or more.
        len: u8,
        /// What is sent.
        fill: u8,
    },
}

/// The checksum of a frame.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
pub struct Checksum {
    /// How it is computed.
    pub algorithm: Algorithm,
    /// The order of its bytes: little or big.
    pub order: ByteOrder,
    /// Written as two hexadecimal digits in ASCII for each byte.
    pub text: bool,
    /// The first byte of the frame that it covers; 0 is the first of the head.
    pub first: u16,
    /// The last one; `None` is the one before the checksum.
    pub last: Option<u16>,
}

impl Checksum {
    /// This algorithm as its standard has it: over everything before it, in the standard's byte
    /// order.
    pub const fn standard(algorithm: Algorithm) -> Self {
        Self { algorithm, order: algorithm.order(), text: false, first: 0, last: None }
    }

    /// Number of bytes in the frame, 1..=8.
    pub const fn len(&self) -> usize {
        self.algorithm.len().saturating_mul(if self.text { 2 } else { 1 })
    }

    /// Whether it has no bytes: never, for a valid algorithm.
    pub const fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// The bytes it covers, if it stands at `at` itself.
    fn covered(&self, at: usize) -> core::ops::Range<usize> {
        let end = self.last.map_or(at, |last| usize::from(last).saturating_add(1));
        usize::from(self.first)..end
    }

    /// The bytes that stand for the checksum of `covered`.
    fn write(&self, covered: &[u8], out: &mut [u8]) {
        let sum = self.algorithm.of([covered]);
        let mut bytes = [0; 4];
        let Some(bytes) = bytes.get_mut(..self.algorithm.len()) else { return };
        self.order.write(u64::from(sum), bytes);
        if self.text {
            for (digits, &byte) in out.chunks_exact_mut(2).zip(&*bytes) {
                for (digit, half) in digits.iter_mut().zip([byte >> 4, byte & 0xF]) {
                    *digit = HEX_DIGITS.get(usize::from(half)).copied().unwrap_or(b'0');
                }
            }
        } else {
            for (slot, &byte) in out.iter_mut().zip(&*bytes) {
                *slot = byte;
            }
        }
    }
}

const HEX_DIGITS: [u8; 16] = *b"0123456789ABCDEF";

/// What carries the frames.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum Carrier {
    /// A stream of bytes, in which frames must be found; at most 512 bytes.
    Stream,
    /// CAN frames, which their id tells apart; at most 8 bytes.
    Can,
}

/// What bytes are, seen as a frame that begins at the first of them.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Probe {
    /// Not the beginning of a frame; it took so many steps to see that.
    No(usize),
    /// Perhaps the beginning of one; at least so many more bytes are needed to tell.
    Partial(usize),
    /// A frame of so many bytes.
    Frame(usize),
    /// A frame of so many bytes with a checksum that is right, and another constant: not for us.
    Other(usize),
    /// A frame of so many bytes with a checksum that is wrong.
    Wrong(usize),
}

/// A checksum, and the number of elements before it.
#[derive(Debug, Clone, Copy)]
struct Placed {
    sum: Checksum,
    behind: u8,
}

/// A frame, checked and ready to find, decode and encode.
#[derive(Debug, Clone)]
pub struct FrameLayout {
    head: Vec<u8, MAX_DELIMITER>,
    tail: Vec<u8, MAX_DELIMITER>,
    checksum: Option<Placed>,
    shortest: u16,
    longest: u16,
}

/// Why a frame cannot be laid out.
#[derive(Debug, Clone, Copy, PartialEq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
#[non_exhaustive]
pub enum LayoutError {
    /// The head or the tail has more than 8 bytes.
    DelimiterTooLong {
        /// Number of bytes.
        len: usize,
    },
    /// There is no element.
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
    /// Nothing tells where a frame begins: no head, no tail, no checksum, no constant.
    NothingToFind,
    /// A parameter of an element's encoding is out of range, such as bits that its number does not
    /// have.
    Encoding {
        /// Index of the element.
        element: u8,
    },
    /// The order swaps words, but the element does not consist of whole words.
    NotWords {
        /// Index of the element.
        element: u8,
    },
    /// An element shares its place with one that is shorter; or, in an output part, bits share a
    /// number with what is no bits, or bits of another number, or has one of these bits.
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
    /// The checksum stands behind more elements than there are, or between bits of one number.
    ChecksumPlace,
    /// The checksum covers nothing, itself, the tail, or bytes behind a field of varying length.
    ChecksumRange,
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
        }
    }
}

impl core::error::Error for LayoutError {}

impl LayoutError {
    /// Index of the element that it is about.
    pub const fn element(&self) -> Option<u8> {
        match *self {
            Self::Encoding { element }
            | Self::NotWords { element }
            | Self::NotShared { element }
            | Self::Constant { element } => Some(element),
            _ => None,
        }
    }

    /// Whether it is about the checksum.
    pub const fn is_of_checksum(&self) -> bool {
        matches!(self, Self::Algorithm | Self::ChecksumPlace | Self::ChecksumRange)
    }
}

impl Element {
    /// A value that is written like this, or the nearest that fits.
    pub const fn value(encoding: Encoding) -> Self {
        Self::Value { encoding, overflow: Overflow::Usual }
    }

    /// How it is written; `None` for padding.
    pub const fn encoding(&self) -> Option<Encoding> {
        match *self {
            Self::Value { encoding, .. } | Self::Fixed { encoding, .. } => Some(encoding),
            Self::Padding { .. } => None,
        }
    }

    fn bits(&self) -> Option<(Bits, ByteOrder)> {
        match self.encoding()? {
            Encoding { kind: Kind::Bits(bits), order, .. } => Some((bits, order)),
            _ => None,
        }
    }

    fn is_shared(&self) -> bool {
        self.encoding().is_some_and(|encoding| encoding.shared)
    }

    /// Number of bytes on the wire; `None` if it varies.
    fn len(&self) -> Option<usize> {
        match self {
            Self::Padding { len, .. } => Some(usize::from(*len)),
            Self::Value { encoding, .. } | Self::Fixed { encoding, .. } => encoding.size(),
        }
    }
}

/// The places of elements, one after the other.
struct Places {
    /// Where the next element begins.
    at: usize,
    /// Where the newest element begins that shares its place with none before, and its length.
    shared_at: usize,
    shared_len: usize,
    /// Elements that have been placed.
    nth: usize,
    /// How many of them stand before the checksum.
    checksum_behind: usize,
    checksum_len: usize,
    /// Where the checksum stands, once it is known.
    checksum_at: usize,
}

/// Why the place of an element is unknown.
enum Unplaced {
    /// The bytes end before it does; at least so many are missing.
    Partial(usize),
    /// It is too long.
    No,
}

impl Places {
    fn new(layout: &FrameLayout) -> Self {
        let (behind, len) =
            layout.checksum.map_or((usize::MAX, 0), |placed| (usize::from(placed.behind), placed.sum.len()));
        let mut places = Self {
            at: layout.head.len(),
            shared_at: 0,
            shared_len: 0,
            nth: 0,
            checksum_behind: behind,
            checksum_len: len,
            checksum_at: 0,
        };
        places.step_over_checksum();
        places
    }

    fn step_over_checksum(&mut self) {
        if self.checksum_behind == self.nth {
            self.checksum_at = self.at;
            self.at = self.at.saturating_add(self.checksum_len);
        }
    }

    /// The place of the next element, whose length is `len`, with `further` bytes behind it that
    /// belong to it.
    fn next(&mut self, element: &Element, len: usize, further: usize) -> core::ops::Range<usize> {
        self.nth = self.nth.saturating_add(1);
        if element.is_shared() {
            let place = self.shared_at..self.shared_at.saturating_add(len);
            self.step_over_checksum();
            return place;
        }
        let start = self.at;
        let end = start.saturating_add(len);
        (self.shared_at, self.shared_len) = (start, len);
        self.at = end.saturating_add(further);
        self.step_over_checksum();
        start..end
    }

    /// The place of the next element in `bytes`.
    fn find(&mut self, element: &Element, bytes: &[u8]) -> Result<core::ops::Range<usize>, Unplaced> {
        let (len, further) = match element.len() {
            Some(len) => (len, 0),
            None if element.is_shared() => (self.shared_len, 0),
            None => {
                let end = element.encoding().and_then(|encoding| encoding.until()).ok_or(Unplaced::No)?;
                let rest = bytes.get(self.at..).unwrap_or(&[]);
                match rest.iter().take(MAX_DIGITS.saturating_add(1)).position(|&byte| byte == end) {
                    Some(len) => (len, 1),
                    None if rest.len() > MAX_DIGITS => return Err(Unplaced::No),
                    None => return Err(Unplaced::Partial(1)),
                }
            }
        };
        let place = self.next(element, len, further);
        match place.end.saturating_add(further).checked_sub(bytes.len()) {
            None | Some(0) => Ok(place),
            Some(missing) => Err(Unplaced::Partial(missing)),
        }
    }
}

impl FrameLayout {
    /// Checks a frame. A checksum comes with the number of elements before it.
    ///
    /// # Errors
    /// [`LayoutError`] says which rule is broken, and by which element.
    pub fn new(
        carrier: Carrier,
        direction: Direction,
        head: &[u8],
        tail: &[u8],
        elements: &[Element],
        checksum: Option<(Checksum, usize)>,
    ) -> Result<Self, LayoutError> {
        let delimiter = |bytes: &[u8]| {
            Vec::from_slice(bytes).map_err(|_| LayoutError::DelimiterTooLong { len: bytes.len() })
        };
        let (head, tail) = (delimiter(head)?, delimiter(tail)?);
        if elements.is_empty() {
            return Err(LayoutError::Empty);
        }
        if elements.len() > MAX_FIELDS {
            return Err(LayoutError::TooManyElements);
        }
        check_elements(elements, direction)?;
        let checksum = match checksum {
            Some((sum, behind)) => {
                let splits = elements.get(behind).is_some_and(Element::is_shared);
                if behind > elements.len() || splits {
                    return Err(LayoutError::ChecksumPlace);
                }
                Some(Placed { sum, behind: behind as u8 })
            }
            None => None,
        };
        let mut layout = Self { head, tail, checksum, shortest: 0, longest: 0 };
        let shortest = layout.length_with(elements, 0);
        let longest = layout.length_with(elements, MAX_DIGITS);
        let room = match carrier {
            Carrier::Stream => MAX_STREAM_FRAME,
            Carrier::Can => MAX_CAN_DATA,
        };
        if longest > room {
            return Err(LayoutError::TooLong { len: longest, room });
        }
        (layout.shortest, layout.longest) = (shortest as u16, longest as u16);
        layout.check_checksum(elements)?;
        let has_constant = elements.iter().any(|element| matches!(element, Element::Fixed { .. }));
        let can_be_found =
            has_constant || checksum.is_some() || !layout.head.is_empty() || !layout.tail.is_empty();
        if carrier == Carrier::Stream && !can_be_found {
            return Err(LayoutError::NothingToFind);
        }
        Ok(layout)
    }

    /// The bytes of the whole frame if every field of varying length has so many.
    fn length_with(&self, elements: &[Element], varying: usize) -> usize {
        let mut places = Places::new(self);
        for element in elements {
            match element.len() {
                Some(len) => places.next(element, len, 0),
                None if element.is_shared() => places.next(element, varying, 0),
                None => places.next(element, varying, 1),
            };
        }
        places.at.saturating_add(self.tail.len())
    }

    fn check_checksum(&self, elements: &[Element]) -> Result<(), LayoutError> {
        let Some(Placed { sum, .. }) = self.checksum else { return Ok(()) };
        let is_valid = match sum.algorithm {
            Algorithm::Crc(crc) => crc.is_valid(),
            _ => true,
        };
        if !is_valid || sum.order.swaps_words() {
            return Err(LayoutError::Algorithm);
        }
        // Behind a field of varying length no byte has a number.
        let mut places = Places::new(self);
        let mut numbered = None;
        for element in elements {
            let len = element.len();
            if len.is_none() {
                numbered = numbered.or(Some(places.at));
            }
            places.next(element, len.unwrap_or(0), usize::from(len.is_none()));
        }
        let at = places.checksum_at;
        let own = at..at.saturating_add(sum.len());
        let covered = sum.covered(at);
        let overlaps = covered.start < own.end && own.start < covered.end;
        let end = if sum.last.is_some() { numbered.unwrap_or(places.at) } else { places.at };
        let comes_late = numbered.is_some_and(|numbered| usize::from(sum.first) > numbered);
        if covered.is_empty() || overlaps || covered.end > end || comes_late {
            return Err(LayoutError::ChecksumRange);
        }
        Ok(())
    }

    /// Minimum and maximum number of bytes of a frame.
    pub fn lengths(&self) -> (usize, usize) {
        (usize::from(self.shortest), usize::from(self.longest))
    }

    /// What `bytes` are, seen as a frame that begins at the first of them.
    pub fn probe<'e>(&self, elements: impl IntoIterator<Item = &'e Element>, bytes: &[u8]) -> Probe {
        if let Some(differs) = self.head.iter().zip(bytes).position(|(expected, byte)| expected != byte) {
            return Probe::No(differs.saturating_add(1));
        }
        if let Some(missing @ 1..) = usize::from(self.shortest).checked_sub(bytes.len()) {
            return Probe::Partial(missing);
        }
        let mut places = Places::new(self);
        let mut is_ours = true;
        for element in elements {
            let place = match places.find(element, bytes) {
                Ok(place) => place,
                Err(Unplaced::Partial(missing)) if is_ours || self.checksum.is_some() => {
                    return Probe::Partial(missing);
                }
                Err(_) => return Probe::No(places.nth.saturating_add(self.head.len())),
            };
            if let Element::Fixed { encoding, value } = *element {
                let field = bytes.get(place).unwrap_or(&[]);
                is_ours &= encoding.read(field).is_ok_and(|read| read.as_f64() == value as f64);
            }
        }
        let tail_at = places.at;
        let len = tail_at.saturating_add(self.tail.len());
        let rest = bytes.get(tail_at..).unwrap_or(&[]);
        let steps = places.nth.saturating_add(len);
        if self.tail.iter().zip(rest).any(|(expected, byte)| expected != byte) {
            return Probe::No(steps);
        }
        if let Some(missing @ 1..) = len.checked_sub(bytes.len()) {
            return Probe::Partial(missing);
        }
        match (self.checksum_is_right(bytes, places.checksum_at), is_ours) {
            (None, false) => Probe::No(steps),
            (None | Some(true), true) => Probe::Frame(len),
            (Some(true), false) => Probe::Other(len),
            (Some(false), _) => Probe::Wrong(len),
        }
    }

    /// Whether the checksum at `at` is right; `None` without one.
    fn checksum_is_right(&self, frame: &[u8], at: usize) -> Option<bool> {
        let sum = self.checksum?.sum;
        let found = frame.get(at..at.saturating_add(sum.len())).unwrap_or(&[]);
        let mut expected = [0; 8];
        let expected = expected.get_mut(..sum.len())?;
        sum.write(frame.get(sum.covered(at)).unwrap_or(&[]), expected);
        Some(if sum.text { found.eq_ignore_ascii_case(expected) } else { found == expected })
    }

    /// The elements of a frame that [`Self::probe`] found, each with its value; `None` for what is
    /// not a value.
    pub fn values<'a>(
        &self,
        elements: impl IntoIterator<Item = &'a Element>,
        frame: &'a [u8],
    ) -> impl Iterator<Item = Result<Option<Scalar>, Unreadable>> {
        let mut places = Places::new(self);
        elements.into_iter().map(move |element| {
            let place = places.find(element, frame).map_err(|_| Unreadable::Length)?;
            match element {
                Element::Value { encoding, .. } => encoding.read(frame.get(place).unwrap_or(&[])).map(Some),
                Element::Fixed { .. } | Element::Padding { .. } => Ok(None),
            }
        })
    }

    /// Writes a frame to the front of `out` and returns its length. `value` is asked for the number
    /// of each element that is a value, by its index. `None` if one is not a number, or cannot be
    /// wrapped, or if there is no room.
    pub fn encode<'e>(
        &self,
        elements: impl IntoIterator<Item = &'e Element>,
        mut value: impl FnMut(usize) -> f64,
        out: &mut [u8],
    ) -> Option<usize> {
        let mut places = Places::new(self);
        put(out, 0, &self.head)?;
        for (nth, element) in elements.into_iter().enumerate() {
            let at = if element.is_shared() { places.shared_at } else { places.at };
            let rest = out.get_mut(at..)?;
            let (encoding, number) = match *element {
                Element::Padding { len, fill } => {
                    let len = usize::from(len);
                    rest.get_mut(..len)?.fill(fill);
                    places.next(element, len, 0);
                    continue;
                }
                Element::Fixed { encoding, value } => (encoding, value as f64),
                Element::Value { encoding, overflow } => (encoding, encoding.fit(value(nth), overflow)?),
            };
            if let Some((bits, _)) = element.bits()
                && !element.is_shared()
            {
                rest.get_mut(..usize::from(bits.bytes))?.fill(0);
            }
            let len = encoding.write(number, rest)?;
            match encoding.until() {
                Some(end) => {
                    *rest.get_mut(len)? = end;
                    places.next(element, len, 1);
                }
                None => {
                    places.next(element, len, 0);
                }
            }
        }
        if let Some(Placed { sum, .. }) = self.checksum {
            let mut bytes = [0; 8];
            let bytes = bytes.get_mut(..sum.len())?;
            sum.write(out.get(sum.covered(places.checksum_at))?, bytes);
            put(out, places.checksum_at, bytes)?;
        }
        let tail_at = places.at;
        put(out, tail_at, &self.tail)?;
        Some(tail_at.saturating_add(self.tail.len()))
    }
}

fn put(out: &mut [u8], at: usize, bytes: &[u8]) -> Option<()> {
    let place = out.get_mut(at..at.saturating_add(bytes.len()))?;
    for (slot, &byte) in place.iter_mut().zip(bytes) {
        *slot = byte;
    }
    Some(())
}

fn check_elements(elements: &[Element], direction: Direction) -> Result<(), LayoutError> {
    // The newest element that shares its place with none before: its length and the byte that ends
    // it, its order, and which of its bits are taken.
    let mut place: Option<(Encoding, u32)> = None;
    for (nth, element) in elements.iter().enumerate() {
        let nth = nth as u8;
        let Some(encoding) = element.encoding() else {
            if element.len() == Some(0) {
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
        let ones = element.bits().map_or(u32::MAX, |(bits, _)| {
            let ones = u32::MAX.unbounded_shr(32_u32.saturating_sub(u32::from(bits.count)));
            ones.unbounded_shl(u32::from(bits.first))
        });
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

/// Whether `second` may have the place of `first`; `both` are the bits that both have.
fn may_share(first: &Encoding, second: &Encoding, both: u32, direction: Direction) -> bool {
    match direction {
        Direction::Input => match (first.size(), second.size()) {
            (Some(first), Some(second)) => second <= first,
            _ => first.until() == second.until(),
        },
        Direction::Output => {
            let are_bits = matches!((first.kind, second.kind), (Kind::Bits(_), Kind::Bits(_)));
            are_bits && first.size() == second.size() && first.order == second.order && both == 0
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
            // A sign, a digit and a point stand before the decimals.
            let least = if decimals == 0 { 1 } else { usize::from(decimals).saturating_add(3) };
            in_range(width, MAX_DIGITS) && usize::from(width) >= least
        }
        Kind::Decimal(Digits { width: Width::Until(end), decimals }) => {
            decimals <= 9 && !matches!(end, b'0'..=b'9' | b'+' | b'-' | b'.' | b' ')
        }
        Kind::Bits(Bits { bytes, first, count, .. }) => {
            let all = u16::from(bytes).saturating_mul(8);
            matches!(bytes, 1 | 2 | 4)
                && count > 0
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

#[cfg(test)]
mod tests;
