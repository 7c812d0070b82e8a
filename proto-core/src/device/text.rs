//! Texts in a device's frame, and the field with the frame's length.
//!
//! In: a field's bytes, or a number of bytes. Out: the text, or where the frame ends. Does not know the meaning of the
//! text.

use super::encoding::Encoding;

/// Maximum number of characters of a text.
pub const MAX_TEXT: usize = 128;

/// A text: bytes in any character set.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
pub struct Text {
    /// Number of characters.
    pub width: TextWidth,
    /// Pads a text that is shorter than a fixed width, often a blank. `None`: every character counts, and a shorter
    /// text is not sent.
    pub fill: Option<u8>,
}

/// How the end of a text is found.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
pub enum TextWidth {
    /// Always this many characters, 1..=128.
    Fixed(u8),
    /// It ends before this byte, which follows the field.
    Until(u8),
    /// It takes the rest of the frame, up to the elements, the checksum and the tail after it. The frame's end must be
    /// known from a length field or from outside.
    Rest,
}

impl Text {
    /// The text in a field's bytes, without padding.
    pub fn trimmed<'a>(&self, field: &'a [u8]) -> &'a [u8] {
        let (TextWidth::Fixed(_), Some(fill)) = (self.width, self.fill) else { return field };
        let end = field.iter().rposition(|&byte| byte != fill).map_or(0, |last| last.saturating_add(1));
        field.get(..end).unwrap_or(field)
    }

    /// Pads or terminates a text of `len` characters at the front of `out`. Returns its length without the terminating
    /// byte; `None` if it is too long or too short, or contains the terminating byte.
    pub(super) fn complete(&self, len: usize, out: &mut [u8]) -> Option<usize> {
        let text = out.get(..len)?;
        match self.width {
            TextWidth::Fixed(width) => {
                let width = usize::from(width);
                let behind = out.get_mut(len..width)?;
                if !behind.is_empty() {
                    behind.fill(self.fill?);
                }
                Some(width)
            }
            TextWidth::Until(end) => {
                if text.contains(&end) {
                    return None;
                }
                *out.get_mut(len)? = end;
                Some(len)
            }
            TextWidth::Rest => Some(len),
        }
    }
}

/// A field with the length of the frame.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
pub struct Length {
    /// How it is encoded: an integer of fixed length.
    pub encoding: Encoding,
    /// Which bytes it counts.
    pub counts: Counts,
    /// Added to the received number, such as 2 if the device does not count two bytes of `counts`.
    pub plus: i8,
}

/// Which bytes a length counts.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
pub enum Counts {
    /// All bytes after it, including checksum and tail.
    #[default]
    Rest,
    /// The whole frame, from its head to its tail.
    Frame,
    /// The fields after it, without checksum and tail.
    Fields,
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn blanks_that_fill_a_text_are_no_part_of_it() {
        let padded = Text { width: TextWidth::Fixed(8), fill: Some(b' ') };
        assert_eq!(padded.trimmed(b"AB C    "), b"AB C");
        assert_eq!(padded.trimmed(b"        "), b"");
        let strict = Text { fill: None, ..padded };
        assert_eq!(strict.trimmed(b"AB C    "), b"AB C    ");
        let mut out = *b"AB~~~~~~~";
        assert_eq!(padded.complete(2, &mut out), Some(8));
        assert_eq!(&out, b"AB      ~");
        assert_eq!((strict.complete(7, &mut out), strict.complete(8, &mut out)), (None, Some(8)));
        assert_eq!(padded.complete(9, &mut out), None);
    }

    #[test]
    fn a_text_with_the_byte_that_ends_it_is_not_sent() {
        let text = Text { width: TextWidth::Until(b';'), fill: None };
        let mut out = *b"AB~~";
        assert_eq!(text.complete(2, &mut out), Some(2));
        assert_eq!(&out, b"AB;~");
        assert_eq!(text.complete(3, &mut out), None);
    }
}
