//! Texts that mean "no result", such as a scanner's `NOREAD`.
//!
//! In: a few short texts. Out: whether a text is one of them. They are stored in the space that other fields need
//! anyway.

/// Space for all ignored texts of a field; each takes one more byte for its length.
pub const MAX_IGNORED: usize = 14;

/// Length code of an empty text; a length of 0 ends the list.
const EMPTY: u8 = 0xFF;

/// The texts of a field that are ignored.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
pub struct Ignored {
    /// For each text, its length or [`EMPTY`], then its bytes; zeros after the last text.
    bytes: [u8; MAX_IGNORED],
}

impl Ignored {
    /// No text is ignored.
    pub const NONE: Self = Self { bytes: [0; MAX_IGNORED] };

    /// Ignores these texts, which may include the empty text; `None` if they do not fit.
    pub fn new(texts: &[&[u8]]) -> Option<Self> {
        let mut ignored = Self::NONE;
        let mut free = ignored.bytes.iter_mut();
        for text in texts {
            let len = match text.len() {
                0 => EMPTY,
                len => u8::try_from(len).ok()?,
            };
            for &byte in core::iter::once(&len).chain(text.iter()) {
                *free.next()? = byte;
            }
        }
        Some(ignored)
    }

    /// The texts, in order.
    pub fn iter(&self) -> impl Iterator<Item = &[u8]> {
        let mut rest = &self.bytes[..];
        core::iter::from_fn(move || {
            let (&len, behind) = rest.split_first().filter(|(len, _)| **len > 0)?;
            let len = if len == EMPTY { 0 } else { len };
            let text = behind.get(..usize::from(len))?;
            rest = behind.get(usize::from(len)..)?;
            Some(text)
        })
    }

    /// Whether this text is one of them.
    pub fn has(&self, text: &[u8]) -> bool {
        self.iter().any(|ignored| ignored == text)
    }

    /// Whether no text is ignored.
    pub fn is_empty(&self) -> bool {
        *self == Self::NONE
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn texts_are_kept_as_long_as_there_is_room() {
        let two = Ignored::new(&[b"NOREAD", b"ERROR"]).unwrap();
        assert!(two.has(b"NOREAD") && two.has(b"ERROR"));
        assert!(!two.has(b"NOREA") && !two.has(b"NOREADERROR") && !two.has(b""));
        assert!(two.iter().eq([&b"NOREAD"[..], b"ERROR"]));
        assert!(Ignored::NONE.is_empty() && !Ignored::NONE.has(b""));
        assert_eq!(Ignored::new(&[]), Some(Ignored::NONE));
        assert!(Ignored::new(&[b"0123456789ABC"]).is_some_and(|one| one.has(b"0123456789ABC")));
        assert_eq!(Ignored::new(&[b"0123456789ABCD"]), None);
        assert_eq!(Ignored::new(&[b"NOREAD", b"ERRORS!"]), None);
        let line_without_text = Ignored::new(&[b"NOREAD", b"", b"?"]).unwrap();
        assert!(line_without_text.iter().eq([&b"NOREAD"[..], b"", b"?"]));
        assert!(line_without_text.has(b"") && !line_without_text.has(b"NO"));
    }

    #[test]
    fn bytes_of_a_wrong_image_do_no_harm() {
        for first in 0..=u8::MAX {
            let mut ignored = Ignored { bytes: [first; MAX_IGNORED] };
            assert!(ignored.iter().count() <= MAX_IGNORED);
            ignored.bytes = [0; MAX_IGNORED];
            ignored.bytes[MAX_IGNORED - 1] = first;
            assert!(ignored.is_empty() || ignored.iter().count() <= 1);
        }
    }
}
