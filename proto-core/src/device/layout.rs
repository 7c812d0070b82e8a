//! One frame of a device: head, elements, checksum, tail.
//!
//! In: bytes that may begin with such a frame, or the numbers to send. Out: whether and how far they
//! are one and the values in it, or the frame. The elements stay with the caller, so that the frames
//! of many devices share one pool; every call takes the ones that [`FrameLayout::new`] checked.

use core::borrow::Borrow;
use core::fmt;

use heapless::Vec;

use super::checksum::Algorithm;
use super::encoding::{Bits, Digits, Encoding, Kind, MAX_DIGITS, Overflow, Unreadable, Width};
use super::order::ByteOrder;
use super::text::{Counts, Length, MAX_TEXT, Text, TextWidth};
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
    /// Characters.
    Text(Text),
    /// The frame's length.
    Length(Length),
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
    /// The byte behind the last one; 0 is that of the checksum.
    pub end: u16,
}

impl Checksum {
    /// This algorithm as its standard has it: over everything before it, in the standard's byte
    /// order.
    pub const fn standard(algorithm: Algorithm) -> Self {
        Self { algorithm, order: algorithm.order(), text: false, first: 0, end: 0 }
    }

    /// Over these bytes of the frame, the last one included; `None` is the one before the checksum.
    pub const fn over(self, first: u16, last: Option<u16>) -> Self {
        let end = match last {
            Some(last) => last.saturating_add(1),
            None => 0,
        };
        Self { first, end, ..self }
    }

    /// The last byte that it covers; `None` is the one before the checksum.
    pub const fn last(&self) -> Option<u16> {
        self.end.checked_sub(1)
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
        let end = self.last().map_or(at, |last| usize::from(last).saturating_add(1));
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
    /// A stream in which something else than the fields tells where frames end, such as escape
    /// bytes; at most 512 bytes.
    Whole,
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

/// A frame, checked and ready to find, decode and encode.
#[derive(Debug, Clone)]
pub struct FrameLayout {
    // Their lengths in a byte: every port has room for many layouts.
    head: Vec<u8, MAX_DELIMITER, u8>,
    tail: Vec<u8, MAX_DELIMITER, u8>,
    checksum: Option<Checksum>,
    /// Number of elements before the checksum.
    behind: u8,
    shortest: u16,
    longest: u16,
    /// Number of bytes behind a text that takes the rest: elements, checksum and tail.
    behind_rest: u16,
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
    /// The frame begins with a text or with what may be anything, so that the last bytes of another
    /// frame could be taken for it.
    NoBeginning {
        /// Index of the text.
        element: u8,
    },
    /// Nothing tells where the frame and its last text end.
    NoEnd {
        /// Index of the text.
        element: u8,
    },
    /// A field of varying length behind a text that takes the rest of the frame.
    BehindRest {
        /// Index of the field.
        element: u8,
    },
    /// A length that is no integer, varies in its own length, or is the second one.
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
    /// Index of the element that it is about.
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

    /// How it is written; `None` for padding and text.
    pub const fn encoding(&self) -> Option<Encoding> {
        match *self {
            Self::Value { encoding, .. } | Self::Fixed { encoding, .. } => Some(encoding),
            Self::Length(Length { encoding, .. }) => Some(encoding),
            Self::Padding { .. } | Self::Text(_) => None,
        }
    }

    /// The byte that ends it, if its length varies.
    fn until(&self) -> Option<u8> {
        match self {
            Self::Text(Text { width: TextWidth::Until(end), .. }) => Some(*end),
            Self::Text(_) | Self::Padding { .. } => None,
            _ => self.encoding()?.until(),
        }
    }

    fn is_rest(&self) -> bool {
        matches!(self, Self::Text(Text { width: TextWidth::Rest, .. }))
    }

    /// Maximum number of bytes, with the one that ends it; 0 if it is shared.
    pub(crate) fn longest(&self) -> usize {
        match self.len() {
            _ if self.is_shared() => 0,
            Some(len) => len,
            None => self.most().saturating_add(1),
        }
    }

    /// Maximum number of bytes if its length varies.
    const fn most(&self) -> usize {
        match self {
            Self::Text(_) => MAX_TEXT,
            _ => MAX_DIGITS,
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
            Self::Text(Text { width: TextWidth::Fixed(width), .. }) => Some(usize::from(*width)),
            Self::Text(_) => None,
            Self::Length(Length { encoding, .. }) => encoding.size(),
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
    tail_len: usize,
    /// Where the frame ends, once it is known.
    end: Option<usize>,
    behind_rest: usize,
}

/// Why the place of an element is unknown.
enum Unplaced {
    /// The bytes end before it does; at least so many are missing.
    Partial(usize),
    /// It is too long.
    No,
}

impl Places {
    fn new(layout: &FrameLayout, end: Option<usize>) -> Self {
        let (behind, len) =
            layout.checksum.map_or((usize::MAX, 0), |sum| (usize::from(layout.behind), sum.len()));
        let mut places = Self {
            at: layout.head.len(),
            shared_at: 0,
            shared_len: 0,
            nth: 0,
            checksum_behind: behind,
            checksum_len: len,
            checksum_at: 0,
            tail_len: layout.tail.len(),
            end,
            behind_rest: usize::from(layout.behind_rest),
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
            None if element.is_rest() => {
                let end = self.end.ok_or(Unplaced::No)?;
                let stop = end.checked_sub(self.behind_rest).ok_or(Unplaced::No)?;
                let len = stop.checked_sub(self.at).ok_or(Unplaced::No)?;
                if len > MAX_TEXT {
                    return Err(Unplaced::No);
                }
                (len, 0)
            }
            None => {
                let (end, most) = (element.until().ok_or(Unplaced::No)?, element.most());
                let rest = bytes.get(self.at..).unwrap_or(&[]);
                match rest.iter().take(most.saturating_add(1)).position(|&byte| byte == end) {
                    Some(len) => (len, 1),
                    None if rest.len() > most => return Err(Unplaced::No),
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

    /// Number of bytes of a frame whose length field, which ends at `at`, says 0. To be called
    /// behind that field.
    fn counted_from(&self, length: &Length, at: usize) -> i64 {
        let first = match length.counts {
            Counts::Frame => 0,
            Counts::Rest => at,
            Counts::Fields => {
                let is_behind = self.checksum_behind != usize::MAX && self.checksum_behind >= self.nth;
                let sum = if is_behind { self.checksum_len } else { 0 };
                at.saturating_add(sum).saturating_add(self.tail_len)
            }
        };
        (first as i64).saturating_add(i64::from(length.plus))
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
        let (checksum, behind) = match checksum {
            Some((sum, behind)) => {
                let splits = elements.get(behind).is_some_and(Element::is_shared);
                if behind > elements.len() || splits {
                    return Err(LayoutError::ChecksumPlace);
                }
                (Some(sum), behind as u8)
            }
            None => (None, 0),
        };
        let mut layout = Self { head, tail, checksum, behind, shortest: 0, longest: 0, behind_rest: 0 };
        let shortest = layout.length_with(elements, |_| 0);
        let longest = layout.length_with(elements, Element::most);
        let is_searched = carrier == Carrier::Stream && direction == Direction::Input;
        layout.check_texts(is_searched, elements)?;
        let room = match carrier {
            Carrier::Stream | Carrier::Whole => MAX_STREAM_FRAME,
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

    /// The bytes of the whole frame if the fields of varying length have so many.
    fn length_with(&self, elements: &[Element], varying: impl Fn(&Element) -> usize) -> usize {
        let mut places = Places::new(self, None);
        for element in elements {
            let further = usize::from(element.until().is_some() && !element.is_shared());
            let len = element.len().unwrap_or_else(|| varying(element));
            places.next(element, len, further);
        }
        places.at.saturating_add(self.tail.len())
    }

    /// Where texts begin and end, and what is behind one that takes the rest.
    fn check_texts(&mut self, is_searched: bool, elements: &[Element]) -> Result<(), LayoutError> {
        let mut begins = !is_searched || !self.head.is_empty() || self.checksum.is_some();
        let mut ends = !is_searched;
        let mut rest_from = None;
        let mut places = Places::new(self, None);
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
                // A checksum right behind the text is behind it, too.
                rest_from = Some(places.at);
            }
            places.next(element, element.len().unwrap_or(0), 0);
        }
        let all = places.at.saturating_add(self.tail.len());
        self.behind_rest = rest_from.map_or(0, |from| all.saturating_sub(from)) as u16;
        Ok(())
    }

    fn check_checksum(&self, elements: &[Element]) -> Result<(), LayoutError> {
        let Some(sum) = self.checksum else { return Ok(()) };
        let is_valid = match sum.algorithm {
            Algorithm::Crc(crc) => crc.is_valid(),
            _ => true,
        };
        if !is_valid || sum.order.swaps_words() {
            return Err(LayoutError::Algorithm);
        }
        // Behind a field of varying length no byte has a number.
        let mut places = Places::new(self, None);
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
        // An empty text leaves nothing to cover.
        let covers_nothing = covered.is_empty() && (numbered.is_none() || covered.start > covered.end);
        if covers_nothing || overlaps || covered.end > end || comes_late {
            return Err(LayoutError::ChecksumRange);
        }
        Ok(())
    }

    /// Minimum and maximum number of bytes of a frame.
    pub fn lengths(&self) -> (usize, usize) {
        (usize::from(self.shortest), usize::from(self.longest))
    }

    /// The bytes behind the fields.
    pub fn tail(&self) -> &[u8] {
        &self.tail
    }

    /// What `bytes` are, seen as a frame that begins at the first of them.
    pub fn probe(&self, elements: impl IntoIterator<Item: Borrow<Element>>, bytes: &[u8]) -> Probe {
        self.probe_to(elements, bytes, None)
    }

    /// What `bytes` are, seen as one whole frame: too few of them are [`Probe::Partial`].
    pub fn probe_whole(&self, elements: impl IntoIterator<Item: Borrow<Element>>, bytes: &[u8]) -> Probe {
        self.probe_to(elements, bytes, Some(bytes.len()))
    }

    /// `end` is where the frame ends, if that is known from outside.
    fn probe_to(
        &self,
        elements: impl IntoIterator<Item: Borrow<Element>>,
        bytes: &[u8],
        end: Option<usize>,
    ) -> Probe {
        if let Some(differs) = self.head.iter().zip(bytes).position(|(expected, byte)| expected != byte) {
            return Probe::No(differs.saturating_add(1));
        }
        if let Some(missing @ 1..) = usize::from(self.shortest).checked_sub(bytes.len()) {
            return Probe::Partial(missing);
        }
        let mut places = Places::new(self, end);
        let mut is_ours = true;
        for element in elements {
            let element = element.borrow();
            let place = match places.find(element, bytes) {
                Ok(place) => place,
                Err(Unplaced::Partial(missing)) if is_ours || self.checksum.is_some() => {
                    return Probe::Partial(missing);
                }
                Err(_) => return Probe::No(places.nth.saturating_add(self.head.len())),
            };
            let ends_at = place.end;
            let field = bytes.get(place).unwrap_or(&[]);
            match element {
                Element::Fixed { encoding, value } => {
                    is_ours &= encoding.read(field).is_ok_and(|read| read.as_f64() == *value as f64);
                }
                Element::Length(length) => {
                    let steps = places.nth.saturating_add(self.head.len());
                    let Ok(number) = length.encoding.read(field) else { return Probe::No(steps) };
                    let end = places.counted_from(length, ends_at).saturating_add(number.as_f64() as i64);
                    let is_possible = (i64::from(self.shortest)..=i64::from(self.longest)).contains(&end);
                    let end = end as usize;
                    if !is_possible || places.end.is_some_and(|known| known != end) {
                        return Probe::No(steps);
                    }
                    places.end = Some(end);
                }
                _ => {}
            }
        }
        let tail_at = places.at;
        let len = tail_at.saturating_add(self.tail.len());
        let steps = places.nth.saturating_add(len);
        if places.end.is_some_and(|end| end != len) {
            return Probe::No(steps);
        }
        let rest = bytes.get(tail_at..).unwrap_or(&[]);
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
        let sum = self.checksum?;
        let found = frame.get(at..at.saturating_add(sum.len())).unwrap_or(&[]);
        let mut expected = [0; 8];
        let expected = expected.get_mut(..sum.len())?;
        sum.write(frame.get(sum.covered(at)).unwrap_or(&[]), expected);
        Some(if sum.text { found.eq_ignore_ascii_case(expected) } else { found == expected })
    }

    /// The elements of a frame that [`Self::probe`] found, each with its value; `None` for what is
    /// not a value.
    pub fn values(
        &self,
        elements: impl IntoIterator<Item: Borrow<Element>>,
        frame: &[u8],
    ) -> impl Iterator<Item = Result<Option<Scalar>, Unreadable>> {
        let mut places = Places::new(self, Some(frame.len()));
        elements.into_iter().map(move |element| {
            let element = element.borrow();
            let place = places.find(element, frame).map_err(|_| Unreadable::Length)?;
            match element {
                Element::Value { encoding, .. } => encoding.read(frame.get(place).unwrap_or(&[])).map(Some),
                Element::Fixed { .. } | Element::Padding { .. } | Element::Text(_) | Element::Length(_) => {
                    Ok(None)
                }
            }
        })
    }

    /// The text that the `nth` element of such a frame is; `None` if it is no text.
    pub fn text<'a>(
        &self,
        elements: impl IntoIterator<Item: Borrow<Element>>,
        frame: &'a [u8],
        nth: usize,
    ) -> Option<&'a [u8]> {
        let mut places = Places::new(self, Some(frame.len()));
        for (at, element) in elements.into_iter().enumerate() {
            let element = element.borrow();
            let place = places.find(element, frame).ok()?;
            match element {
                Element::Text(text) if at == nth => return Some(text.trimmed(frame.get(place)?)),
                _ if at == nth => return None,
                _ => {}
            }
        }
        None
    }

    /// Writes a frame without texts; see [`Self::encode_with`].
    pub fn encode(
        &self,
        elements: impl IntoIterator<Item: Borrow<Element>>,
        value: impl FnMut(usize) -> f64,
        out: &mut [u8],
    ) -> Option<usize> {
        self.encode_with(elements, value, |_, _| None, out)
    }

    /// Writes a frame to the front of `out` and returns its length. `value` is asked for the number
    /// of each element that is a value, by its index; `text` writes each text, and returns its
    /// length. `None` if one is not a number, or cannot be wrapped, if a text does not fit its
    /// width or the length its field, or if there is no room.
    pub fn encode_with(
        &self,
        elements: impl IntoIterator<Item: Borrow<Element>>,
        mut value: impl FnMut(usize) -> f64,
        mut text: impl FnMut(usize, &mut [u8]) -> Option<usize>,
        out: &mut [u8],
    ) -> Option<usize> {
        let mut places = Places::new(self, None);
        let mut length_at = None;
        put(out, 0, &self.head)?;
        for (nth, element) in elements.into_iter().enumerate() {
            let element = element.borrow();
            let at = if element.is_shared() { places.shared_at } else { places.at };
            let rest = out.get_mut(at..)?;
            let (encoding, number) = match *element {
                Element::Padding { len, fill } => {
                    let len = usize::from(len);
                    rest.get_mut(..len)?.fill(fill);
                    places.next(element, len, 0);
                    continue;
                }
                Element::Text(field) => {
                    let room = rest.len().min(MAX_TEXT.saturating_add(1));
                    let rest = rest.get_mut(..room)?;
                    let len = field.complete(text(nth, rest)?, rest)?;
                    if len > MAX_TEXT {
                        return None;
                    }
                    places.next(element, len, usize::from(element.until().is_some()));
                    continue;
                }
                Element::Length(length) => {
                    // It is written when the length is known.
                    let len = length.encoding.size()?;
                    if !element.is_shared() {
                        rest.get_mut(..len)?.fill(0);
                    }
                    places.next(element, len, 0);
                    length_at = Some((at, length, places.counted_from(&length, at.saturating_add(len))));
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
        if let Some((at, length, from)) = length_at {
            let all = places.at.saturating_add(self.tail.len());
            let number = (all as i64).saturating_sub(from) as f64;
            let (low, high) = length.encoding.range();
            if !(low..=high).contains(&number) {
                return None;
            }
            length.encoding.write(number, out.get_mut(at..)?)?;
        }
        if let Some(sum) = self.checksum {
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
