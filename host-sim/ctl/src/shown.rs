//! Escapes answers of a gateway for a terminal: no control characters, and nothing that changes the direction of text.

use std::borrow::Cow;
use std::fmt::Write;

use serde_json::Value;

/// Whether a terminal may interpret a character instead of showing it, or show it in a misleading way.
fn is_unfit(c: char) -> bool {
    c.is_control()
        || matches!(c,
            '\u{ad}' | '\u{61c}' | '\u{180e}' | '\u{200b}'..='\u{200f}' | '\u{2028}'..='\u{202e}'
            | '\u{2060}'..='\u{206f}' | '\u{feff}' | '\u{fff9}'..='\u{fffb}' | '\u{e0000}'..='\u{e007f}')
}

/// A text on one line, with unfit characters escaped as `\u{1b}`.
pub fn line(text: &str) -> Cow<'_, str> {
    replaced(text, |_| false, |c, out| write!(out, "{}", c.escape_unicode()))
}

/// A text of several lines, escaped except for line ends and tabs.
pub fn lines(text: &str) -> Cow<'_, str> {
    replaced(text, |c| c == '\n' || c == '\t', |c, out| write!(out, "{}", c.escape_unicode()))
}

/// A document on one line. It is still JSON: only its strings can contain unfit characters.
pub fn json(document: &Value) -> String {
    let text = document.to_string();
    let escape = |c: char, out: &mut String| {
        let mut units = [0; 2];
        c.encode_utf16(&mut units).iter().try_for_each(|unit| write!(out, "\\u{unit:04x}"))
    };
    replaced(&text, |_| false, escape).into_owned()
}

fn replaced(
    text: &str,
    stays: impl Fn(char) -> bool,
    replace: impl Fn(char, &mut String) -> std::fmt::Result,
) -> Cow<'_, str> {
    let is_replaced = |c: char| is_unfit(c) && !stays(c);
    if !text.contains(is_replaced) {
        return Cow::Borrowed(text);
    }
    let mut out = String::with_capacity(text.len() + 16);
    for c in text.chars() {
        if is_replaced(c) {
            // Writing to a `String` cannot fail.
            let _ = replace(c, &mut out);
        } else {
            out.push(c);
        }
    }
    Cow::Owned(out)
}

/// The columns that a text takes on a terminal: two for a Chinese, Japanese or Korean character.
pub(crate) fn width(text: &str) -> usize {
    let is_wide = |c: char| {
        matches!(c, '\u{1100}'..='\u{115f}' | '\u{2e80}'..='\u{303e}' | '\u{3041}'..='\u{a4cf}'
            | '\u{ac00}'..='\u{d7a3}' | '\u{f900}'..='\u{faff}' | '\u{fe30}'..='\u{fe6f}'
            | '\u{ff00}'..='\u{ff60}' | '\u{ffe0}'..='\u{ffe6}' | '\u{1f300}'..='\u{1faff}'
            | '\u{20000}'..='\u{3fffd}')
    };
    text.chars().map(|c| if is_wide(c) { 2 } else { 1 }).sum()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn nothing_that_a_terminal_acts_on_gets_through() {
        let nasty = "a\u{1b}[2J\u{7}\r\n\t\u{9b}1m\u{202e}b\u{200b}\u{e0041}";
        assert_eq!(line(nasty), "a\\u{1b}[2J\\u{7}\\u{d}\\u{a}\\u{9}\\u{9b}1m\\u{202e}b\\u{200b}\\u{e0041}");
        assert_eq!(lines("a\tb\n\u{1b}c\r\n"), "a\tb\n\\u{1b}c\\u{d}\n");
        assert!(matches!(line("机器人 rs485-1"), Cow::Borrowed(_)));
        let document = serde_json::json!({ nasty: nasty, "n": 1.5 });
        let text = json(&document);
        assert!(text.is_ascii(), "{text}");
        assert_eq!(serde_json::from_str::<Value>(&text).unwrap(), document);
    }

    #[test]
    fn a_chinese_character_takes_two_places() {
        assert_eq!(width("rs485"), 5);
        assert_eq!(width("力觉"), 4);
    }
}
