//! One frame of a device: head, elements, checksum, tail.
//!
//! In: bytes that may begin with such a frame, or values to send. Out: whether they are a frame, and its values; or the
//! encoded frame. The caller keeps the elements, so that many devices share one pool, and passes those that
//! [`FrameLayout::new`] checked to every call.

mod check;
mod element;
mod frame_checksum;
mod places;

use core::borrow::Borrow;

use heapless::Vec;

use super::encoding::Unreadable;
use super::text::MAX_TEXT;
use crate::recipe::model::{MAX_DELIMITER, MAX_FIELDS, MAX_STREAM_FRAME};
use crate::sysvar::Direction;
use crate::wire::can::MAX_CAN_DATA;
use crate::wire::scalar::Scalar;
use check::check_elements;
use places::{ElementPlaces, Unplaced};

pub use check::LayoutError;
pub use element::Element;
pub use frame_checksum::{Checksum, DataId, MAX_CHECKSUM, MAX_DATA_ID};

/// How frames are transported.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum Carrier {
    /// A byte stream in which frames must be searched; at most 512 bytes per frame.
    Stream,
    /// CAN frames, identified by their id; at most 8 bytes.
    Can,
    /// A byte stream in which something else than the fields shows where frames end, such as escape bytes; at most 512
    /// bytes per frame.
    Whole,
}

/// What the bytes are if a frame begins at the first one.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Probe {
    /// Not the beginning of a frame; the number of steps it took to find out.
    No(usize),
    /// Possibly the beginning of a frame; at least this many more bytes are needed.
    Partial(usize),
    /// A frame; its length in bytes.
    Frame(usize),
    /// A frame with a right checksum, but with another device's constants; its length in bytes.
    Other(usize),
    /// A frame with a wrong checksum; its length in bytes.
    Wrong(usize),
}

/// A part of a frame.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum Part {
    /// The bytes before the elements.
    Head,
    /// The element with this index.
    Element(usize),
    /// The checksum.
    Checksum,
    /// The bytes behind the elements.
    Tail,
}

/// The position of a part, the same in all frames.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct Place {
    /// Offset of its first byte in the frame; `None` after a field of varying length.
    pub at: Option<usize>,
    /// Number of bytes; `None` if it varies.
    pub len: Option<usize>,
}

/// A frame, checked and ready to find, decode and encode.
#[derive(Debug, Clone)]
pub struct FrameLayout {
    // Lengths take one byte, because every port has space for many layouts.
    head: Vec<u8, MAX_DELIMITER, u8>,
    tail: Vec<u8, MAX_DELIMITER, u8>,
    checksum: Option<Checksum>,
    /// Number of elements before the checksum.
    behind: u8,
    shortest: u16,
    longest: u16,
    /// Number of bytes after a `TextWidth::Rest` text: elements, checksum and tail.
    behind_rest: u16,
}

impl FrameLayout {
    /// Checks a frame. `checksum` comes with the number of elements before it.
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
        // An output frame on CAN may be empty: its id is enough, as for CANopen's SYNC.
        let is_sent_on_can = carrier == Carrier::Can && direction == Direction::Output;
        if elements.is_empty() && head.is_empty() && !is_sent_on_can {
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

    /// Length of the frame if its fields of varying length have the lengths that `varying` returns.
    fn length_with(&self, elements: &[Element], varying: impl Fn(&Element) -> usize) -> usize {
        let mut places = ElementPlaces::new(self, None);
        for element in elements {
            let further = usize::from(element.until().is_some() && !element.is_shared());
            let len = element.len().unwrap_or_else(|| varying(element));
            places.next(element, len, further);
        }
        places.at.saturating_add(self.tail.len())
    }

    /// Minimum and maximum number of bytes of a frame.
    pub fn lengths(&self) -> (usize, usize) {
        (usize::from(self.shortest), usize::from(self.longest))
    }

    /// The bytes after the fields.
    pub fn tail(&self) -> &[u8] {
        &self.tail
    }

    /// Classifies `bytes` as a frame that begins at the first of them.
    pub fn probe(&self, elements: impl IntoIterator<Item: Borrow<Element>>, bytes: &[u8]) -> Probe {
        self.probe_to(elements, bytes, None)
    }

    /// Classifies `bytes` as one whole frame; [`Probe::Partial`] if there are too few.
    pub fn probe_whole(&self, elements: impl IntoIterator<Item: Borrow<Element>>, bytes: &[u8]) -> Probe {
        self.probe_to(elements, bytes, Some(bytes.len()))
    }

    /// `end` is the end of the frame, if it is known from outside.
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
        let mut places = ElementPlaces::new(self, end);
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

    /// Whether all constants that are complete in `bytes` match this frame, so that it may be the beginning of one.
    pub(crate) fn agrees(&self, elements: impl IntoIterator<Item: Borrow<Element>>, bytes: &[u8]) -> bool {
        let mut places = ElementPlaces::new(self, None);
        for element in elements {
            let element = element.borrow();
            let Ok(place) = places.find(element, bytes) else { break };
            if let Element::Fixed { encoding, value } = element {
                let field = bytes.get(place).unwrap_or(&[]);
                if !encoding.read(field).is_ok_and(|read| read.as_f64() == *value as f64) {
                    return false;
                }
            }
        }
        true
    }

    /// Whether the checksum at `at` is right; `None` without one.
    fn checksum_is_right(&self, frame: &[u8], at: usize) -> Option<bool> {
        let sum = self.checksum?;
        let (found, right) = checksums_at(&sum, frame, at);
        let right = right.get(..sum.len())?;
        Some(if sum.text { found.eq_ignore_ascii_case(right) } else { found == right })
    }

    /// The checksum in a frame that [`Self::probe`] found, and the right one; `None` if the frame has no checksum.
    pub fn checksums<'f>(
        &self,
        elements: impl IntoIterator<Item: Borrow<Element>>,
        frame: &'f [u8],
    ) -> Option<(&'f [u8], Vec<u8, MAX_CHECKSUM>)> {
        let sum = self.checksum?;
        let mut places = ElementPlaces::new(self, Some(frame.len()));
        for element in elements {
            places.find(element.borrow(), frame).ok()?;
        }
        let (found, right) = checksums_at(&sum, frame, places.checksum_at);
        Some((found, Vec::from_slice(right.get(..sum.len())?).ok()?))
    }

    /// Calls back for each part of the frame in wire order, with its place. Head and tail are omitted if empty.
    pub fn parts(
        &self,
        elements: impl IntoIterator<Item: Borrow<Element>>,
        mut tell: impl FnMut(Part, Place),
    ) {
        let mut places = ElementPlaces::new(self, None);
        // After a field of varying length, offsets are unknown.
        let (mut is_numbered, mut shared_is_numbered) = (true, true);
        let checksum = |places: &ElementPlaces, is_numbered: bool| {
            let sum = self.checksum.filter(|_| usize::from(self.behind) == places.nth)?;
            Some(Place { at: is_numbered.then_some(places.checksum_at), len: Some(sum.len()) })
        };
        if !self.head.is_empty() {
            tell(Part::Head, Place { at: Some(0), len: Some(self.head.len()) });
        }
        if let Some(place) = checksum(&places, true) {
            tell(Part::Checksum, place);
        }
        for (nth, element) in elements.into_iter().enumerate() {
            let element = element.borrow();
            let len = element.len();
            let at = places.next(element, len.unwrap_or(0), 0).start;
            if !element.is_shared() {
                shared_is_numbered = is_numbered;
                is_numbered &= len.is_some();
            }
            tell(Part::Element(nth), Place { at: shared_is_numbered.then_some(at), len });
            if let Some(place) = checksum(&places, is_numbered) {
                tell(Part::Checksum, place);
            }
        }
        if !self.tail.is_empty() {
            tell(Part::Tail, Place { at: is_numbered.then_some(places.at), len: Some(self.tail.len()) });
        }
    }

    /// The elements of a frame that [`Self::probe`] found, each with its value; `None` for elements that are not
    /// values.
    pub fn values(
        &self,
        elements: impl IntoIterator<Item: Borrow<Element>>,
        frame: &[u8],
    ) -> impl Iterator<Item = Result<Option<Scalar>, Unreadable>> {
        let mut places = ElementPlaces::new(self, Some(frame.len()));
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

    /// The bytes of the `nth` element of such a frame; `None` if there is no such element.
    pub fn bytes_of<'a>(
        &self,
        elements: impl IntoIterator<Item: Borrow<Element>>,
        frame: &'a [u8],
        nth: usize,
    ) -> Option<&'a [u8]> {
        let mut places = ElementPlaces::new(self, Some(frame.len()));
        for (at, element) in elements.into_iter().enumerate() {
            let place = places.find(element.borrow(), frame).ok()?;
            if at == nth {
                return frame.get(place);
            }
        }
        None
    }

    /// The text in the `nth` element of such a frame; `None` if the element is not a text.
    pub fn text<'a>(
        &self,
        elements: impl IntoIterator<Item: Borrow<Element>>,
        frame: &'a [u8],
        nth: usize,
    ) -> Option<&'a [u8]> {
        let mut places = ElementPlaces::new(self, Some(frame.len()));
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

    /// Writes a frame to the front of `out` and returns its length. `value` returns the number for the value element
    /// with this index; `text` writes a text and returns its length. `None` if a number is NaN or cannot be wrapped, if
    /// a text does not fit its width, if the length does not fit its field, or if `out` is too short.
    pub fn encode_with(
        &self,
        elements: impl IntoIterator<Item: Borrow<Element>>,
        mut value: impl FnMut(usize) -> f64,
        mut text: impl FnMut(usize, &mut [u8]) -> Option<usize>,
        out: &mut [u8],
    ) -> Option<usize> {
        let mut places = ElementPlaces::new(self, None);
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
                    // Written once the length of the frame is known.
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
            if let Some(bits) = element.bits()
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
            let mut bytes = [0; MAX_CHECKSUM];
            let bytes = bytes.get_mut(..sum.len())?;
            sum.write(out.get(sum.covered(places.checksum_at))?, bytes);
            put(out, places.checksum_at, bytes)?;
        }
        let tail_at = places.at;
        put(out, tail_at, &self.tail)?;
        Some(tail_at.saturating_add(self.tail.len()))
    }
}

/// The bytes in the checksum's place, and the right checksum, as many bytes of it.
fn checksums_at<'f>(sum: &Checksum, frame: &'f [u8], at: usize) -> (&'f [u8], [u8; MAX_CHECKSUM]) {
    let found = frame.get(at..at.saturating_add(sum.len())).unwrap_or(&[]);
    let mut right = [0; MAX_CHECKSUM];
    if let Some(right) = right.get_mut(..sum.len()) {
        sum.write(frame.get(sum.covered(at)).unwrap_or(&[]), right);
    }
    (found, right)
}

fn put(out: &mut [u8], at: usize, bytes: &[u8]) -> Option<()> {
    let place = out.get_mut(at..at.saturating_add(bytes.len()))?;
    for (slot, &byte) in place.iter_mut().zip(bytes) {
        *slot = byte;
    }
    Some(())
}

#[cfg(test)]
mod tests;
