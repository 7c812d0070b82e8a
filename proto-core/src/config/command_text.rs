//! The values of a command table's entry, and its text with a value inserted.
//!
//! In: a text such as `speed({value})`, and a value. Out: `speed(40)`. Does not use formatting, which could panic.

use core::fmt::{self, Write};

use heapless::{String, Vec};

use super::{CommandEntry, MAX_COMMAND_TEXT};

/// Placeholder for the field's value in the text of a command.
const PLACEHOLDER: &str = "{value}";

impl CommandEntry {
    /// A command for one value.
    pub const fn new(value: i64, text: String<MAX_COMMAND_TEXT>) -> Self {
        Self { first: value, last: value, text }
    }

    /// Whether the entry is for this field value.
    pub const fn has(&self, value: i64) -> bool {
        self.first <= value && value <= self.last
    }

    /// Whether the values select nothing.
    pub fn is_idle(&self) -> bool {
        self.text.is_empty()
    }

    /// The command for a value, such as `speed(40)`; `None` if it is longer than [`MAX_COMMAND_TEXT`].
    pub fn text_for(&self, value: i64) -> Option<String<MAX_COMMAND_TEXT>> {
        fill_in(&self.text, value)
    }

    /// Length of the command for a value, in bytes.
    pub(super) fn len_for(&self, value: i64) -> usize {
        let places = placeholders(&self.text);
        let shorter = places.saturating_mul(PLACEHOLDER.len());
        let longer = places.saturating_mul(decimal(value).len());
        self.text.len().saturating_sub(shorter).saturating_add(longer)
    }
}

/// The text of a selected command, such as `speed(40)`.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct CommandText<'a> {
    pub(crate) text: &'a str,
    pub(crate) value: i64,
}

impl fmt::Display for CommandText<'_> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let mut rest = self.text.chars();
        loop {
            if let Some(after) = rest.as_str().strip_prefix(PLACEHOLDER) {
                decimal(self.value).iter().rev().try_for_each(|&digit| f.write_char(digit.into()))?;
                rest = after.chars();
            } else if let Some(c) = rest.next() {
                f.write_char(c)?;
            } else {
                return Ok(());
            }
        }
    }
}

/// Number of placeholders in the text. Searching for a `str` could panic.
pub(crate) fn placeholders(text: &str) -> usize {
    let is_one = |part: &&[u8]| *part == PLACEHOLDER.as_bytes();
    text.as_bytes().windows(PLACEHOLDER.len()).filter(is_one).count()
}

/// Inserts the value in the text; `None` if the result is too long.
pub(crate) fn fill_in(text: &str, value: i64) -> Option<String<MAX_COMMAND_TEXT>> {
    let (digits, mut filled) = (decimal(value), String::new());
    let mut rest = text;
    while let Some(&byte) = rest.as_bytes().first() {
        if let Some(after) = rest.strip_prefix(PLACEHOLDER) {
            digits.iter().rev().try_for_each(|&digit| filled.push(char::from(digit))).ok()?;
            rest = after;
            continue;
        }
        let mut chars = rest.chars();
        filled.push(chars.next().unwrap_or(char::from(byte))).ok()?;
        rest = chars.as_str();
    }
    Some(filled)
}

/// An integer as decimal digits in reverse order, ending with a sign if negative.
fn decimal(value: i64) -> Vec<u8, MAX_DECIMAL> {
    let mut digits: Vec<u8, MAX_DECIMAL> = Vec::new();
    let mut rest = value.unsigned_abs();
    // Every integer fits.
    while rest >= 10 {
        let _ = digits.push(b'0'.wrapping_add((rest % 10) as u8));
        rest /= 10;
    }
    let _ = digits.push(b'0'.wrapping_add(rest as u8));
    if value < 0 {
        let _ = digits.push(b'-');
    }
    digits
}

/// Length of the longest `i64` in decimal.
const MAX_DECIMAL: usize = 20;

#[cfg(test)]
mod tests {
    use super::*;

    fn filled(text: &str, value: i64) -> Option<std::string::String> {
        fill_in(text, value).map(|text| text.as_str().into())
    }

    #[test]
    fn the_value_stands_wherever_the_text_asks_for_it() {
        for (text, value, whole) in [
            ("speed({value})", 40, "speed(40)"),
            ("run(p{value}.jspf,{value})", 7, "run(p7.jspf,7)"),
            ("run({valu,{value}}", -1, "run({valu,-1}"),
            ("stop", 3, "stop"),
            ("run(\u{e9}{value})", 0, "run(\u{e9}0)"),
            ("{value}", i64::MIN, "-9223372036854775808"),
            ("{value}", i64::MAX, "9223372036854775807"),
        ] {
            assert_eq!(filled(text, value).as_deref(), Some(whole), "{text} with {value}");
            let shown = std::format!("{}", CommandText { text, value });
            assert_eq!(shown, whole);
        }
    }

    #[test]
    fn a_text_that_becomes_too_long_is_none() {
        let text = std::format!("{}{{value}}", "x".repeat(MAX_COMMAND_TEXT - 2));
        assert!(filled(&text, 99).is_some());
        assert_eq!(filled(&text, 100), None);
    }
}
