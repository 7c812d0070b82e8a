//! Splitting text at ASCII characters.
//!
//! Like the methods of `str`, but provably without panics: those search for an encoded `char`, whose length the
//! compiler does not know.

/// The text before and after the first `separator`, an ASCII character.
pub(crate) fn split_once(text: &str, separator: u8) -> Option<(&str, &str)> {
    split_at(text, text.bytes().position(|byte| byte == separator)?)
}

/// The text before and after the last `separator`, an ASCII character.
pub(crate) fn rsplit_once(text: &str, separator: u8) -> Option<(&str, &str)> {
    split_at(text, text.bytes().rposition(|byte| byte == separator)?)
}

fn split_at(text: &str, separator: usize) -> Option<(&str, &str)> {
    let (before, rest) = text.split_at_checked(separator)?;
    Some((before, rest.get(1..)?))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn texts_are_cut_as_the_methods_of_str_cut_them() {
        for text in ["", ".", "a.b", "a.b.c", "..", "é.ü", "abc", "a.", ".b"] {
            assert_eq!(split_once(text, b'.'), text.split_once('.'));
            assert_eq!(rsplit_once(text, b'.'), text.rsplit_once('.'));
        }
    }
}
