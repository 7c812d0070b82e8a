//! Text output into a caller's buffer, and the character classes of texts.

use core::fmt;

/// The buffer was too short; its content is undefined.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
#[non_exhaustive]
pub struct NoTextSpace {
    /// Number of bytes that the text needs.
    pub needed: usize,
    /// Number of bytes available.
    pub available: usize,
}

impl fmt::Display for NoTextSpace {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "the text needs {} bytes; the buffer has {}", self.needed, self.available)
    }
}

impl core::error::Error for NoTextSpace {}

/// Appends to a byte slice; continues to count if the slice is full.
pub(super) struct CountingWriter<'a> {
    out: &'a mut [u8],
    len: usize,
}

impl<'a> CountingWriter<'a> {
    pub(super) fn new(out: &'a mut [u8]) -> Self {
        Self { out, len: 0 }
    }

    pub(super) fn push(&mut self, bytes: &[u8]) {
        let room = self.out.get_mut(self.len..).and_then(|room| room.get_mut(..bytes.len()));
        if let Some(target) = room {
            target.copy_from_slice(bytes);
        }
        self.len = self.len.saturating_add(bytes.len());
    }

    pub(super) fn push_str(&mut self, text: &str) {
        self.push(text.as_bytes());
    }

    /// Appends a number in base 10 or 16.
    pub(super) fn push_number<const BASE: u32>(&mut self, number: u32) {
        let mut text = [0; u32::MAX.ilog10() as usize + 1];
        let (mut rest, mut first) = (number, text.len());
        for place in text.iter_mut().rev() {
            let digit = rest.checked_rem(BASE).and_then(|digit| char::from_digit(digit, BASE));
            *place = digit.map_or(b'0', |digit| digit.to_ascii_uppercase() as u8);
            first = first.saturating_sub(1);
            rest = rest.checked_div(BASE).unwrap_or(0);
            if rest == 0 {
                break;
            }
        }
        self.push(text.get(first..).unwrap_or(&[]));
    }

    pub(super) fn len(&self) -> usize {
        self.len
    }

    pub(super) fn finish(self) -> Result<usize, NoTextSpace> {
        let available = self.out.len();
        if self.len <= available { Ok(self.len) } else { Err(NoTextSpace { needed: self.len, available }) }
    }
}

/// CR, LF and NUL end a text (D2).
pub(super) const fn is_terminator(byte: u8) -> bool {
    matches!(byte, b'\r' | b'\n' | 0)
}

/// Blanks and terminators, which may surround a text.
pub(super) const fn is_blank(byte: u8) -> bool {
    matches!(byte, b' ' | b'\t') || is_terminator(byte)
}

/// `text` without blanks and terminators at both ends.
pub(super) fn trim(text: &[u8]) -> &[u8] {
    let mut text = trim_start(text);
    while let Some((&last, rest)) = text.split_last()
        && is_blank(last)
    {
        text = rest;
    }
    text
}

/// `text` without leading blanks and terminators.
pub(super) fn trim_start(mut text: &[u8]) -> &[u8] {
    while let Some((&first, rest)) = text.split_first()
        && is_blank(first)
    {
        text = rest;
    }
    text
}

/// `text` without blanks and terminators at both ends; other white space belongs to a name.
pub(super) fn trim_str(text: &str) -> &str {
    text.trim_matches(|letter: char| letter.is_ascii() && is_blank(letter as u8))
}
