//! Texts on port 2000 that were not recognized as a reply: the newest of each connection, for status and statistics
//! (docs/engine.md section 7).

use heapless::String;

use super::stops::Waiting;
use crate::config::CommandText;
use crate::time::Instant;

/// Maximum length of a kept text in bytes; the rest is cut off.
pub const MAX_OTHER_TEXT: usize = 48;

/// A text that was not recognized as a reply, and the command that it may answer.
#[derive(Debug, Clone, Copy)]
#[non_exhaustive]
pub struct OtherText<'a> {
    /// When the text was complete.
    pub at: Instant,
    /// At most the first [`MAX_OTHER_TEXT`] bytes of the text. Control characters are replaced by blanks, bytes that
    /// are not UTF-8 by U+FFFD.
    pub text: &'a str,
    /// The unanswered command that it may answer, such as `disable`; `None` for a late reply to an earlier command, and
    /// if no command was unanswered.
    pub command: Option<CommandText<'a>>,
}

/// An [`OtherText`] as a connection keeps it.
#[derive(Debug, Clone)]
pub(crate) struct LastText {
    pub at: Instant,
    pub text: String<MAX_OTHER_TEXT>,
    /// The entry and value of the command.
    pub entry: Option<u16>,
    pub value: i64,
}

impl LastText {
    pub(crate) fn new(at: Instant, bytes: &[u8], command: Option<Waiting>) -> Self {
        let mut text = String::new();
        let letters = bytes.utf8_chunks().flat_map(|chunk| {
            let wrong = (!chunk.invalid().is_empty()).then_some(char::REPLACEMENT_CHARACTER);
            chunk.valid().chars().chain(wrong)
        });
        for letter in letters {
            if text.push(if letter.is_control() { ' ' } else { letter }).is_err() {
                break;
            }
        }
        let entry = command.map(|command| command.entry);
        Self { at, text, entry, value: command.map_or(0, |command| command.value) }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_text_is_cut_between_letters_and_shows_what_is_no_text() {
        let kept = |bytes: &[u8]| LastText::new(Instant::ZERO, bytes, None).text;
        assert_eq!(kept(b"already \xFFready\x07\t!"), "already \u{FFFD}ready  !");
        let long = [&[b'a'; MAX_OTHER_TEXT - 1][..], "\u{e9}b".as_bytes()].concat();
        assert_eq!(kept(&long).len(), MAX_OTHER_TEXT - 1);
        assert_eq!(kept(&[b'a'; 2 * MAX_OTHER_TEXT]).len(), MAX_OTHER_TEXT);
    }
}
