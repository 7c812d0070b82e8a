//! The arguments of an operation: a flat JSON object of numbers and strings.
//!
//! In: a body. Out: its entries. Accepts a subset of JSON: no nesting, no escapes, and numbers without a sign or an
//! exponent, in thousandths. Made for a board, where a complete JSON parser would be as large as all operations
//! together.

use crate::request::{cut, trim};

/// The value of an entry.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum ArgumentValue<'a> {
    /// A number in thousandths; further digits are cut off.
    Thousandths(u64),
    /// A text.
    Text(&'a str),
}

impl ArgumentValue<'_> {
    /// A whole number.
    pub fn whole(self) -> Option<u32> {
        match self {
            Self::Thousandths(thousandths) if thousandths % 1_000 == 0 => {
                u32::try_from(thousandths / 1_000).ok()
            }
            _ => None,
        }
    }
}

/// Calls `found` with each entry; an empty body has none. Returns `false` if the body is not such an object, or if
/// `found` refuses an entry.
pub fn each<'a>(body: &'a [u8], mut found: impl FnMut(&'a str, ArgumentValue<'a>) -> bool) -> bool {
    let Ok(text) = core::str::from_utf8(body) else { return false };
    let text = blank_free(text);
    if text.is_empty() {
        return true;
    }
    let Some(inside) = text.strip_prefix('{').and_then(|text| text.strip_suffix('}')) else { return false };
    let mut rest = blank_free(inside);
    while !rest.is_empty() {
        let Some((key, behind)) = quoted(rest) else { return false };
        let Some(behind) = blank_free(behind).strip_prefix(':') else { return false };
        let Some((value, behind)) = value(blank_free(behind)) else { return false };
        if !found(key, value) {
            return false;
        }
        rest = match blank_free(behind) {
            "" => return true,
            // A comma must be followed by another entry.
            behind => match behind.strip_prefix(',').map(blank_free) {
                Some(next) if !next.is_empty() => next,
                _ => return false,
            },
        };
    }
    true
}

fn value(text: &str) -> Option<(ArgumentValue<'_>, &str)> {
    if text.starts_with('"') {
        return quoted(text).map(|(text, behind)| (ArgumentValue::Text(text), behind));
    }
    let end = text.bytes().position(|byte| !byte.is_ascii_digit() && byte != b'.').unwrap_or(text.len());
    let (number, behind) = text.split_at_checked(end)?;
    let (whole, fraction) = cut(number, b'.').unwrap_or((number, "0"));
    // JSON does not allow a leading zero.
    let is_number = (whole == "0" || !whole.starts_with('0'))
        && [whole, fraction]
            .iter()
            .all(|digits| !digits.is_empty() && digits.bytes().all(|digit| digit.is_ascii_digit()));
    if !is_number || whole.len() > MAX_DIGITS {
        return None;
    }
    let digits = whole.bytes().chain(fraction.bytes().chain(*b"000").take(3));
    let thousandths = digits.fold(0_u64, |number, digit| {
        number.saturating_mul(10).saturating_add(u64::from(digit.saturating_sub(b'0')))
    });
    Some((ArgumentValue::Thousandths(thousandths), behind))
}

/// The quoted text at the front, and what follows it.
fn quoted(text: &str) -> Option<(&str, &str)> {
    let (inside, behind) = cut(text.strip_prefix('"')?, b'"')?;
    let is_plain = !inside.bytes().any(|byte| byte == b'\\' || byte < b' ');
    is_plain.then_some((inside, behind))
}

fn blank_free(text: &str) -> &str {
    let mut text = trim(text);
    while let Some(rest) = text.strip_prefix(['\r', '\n']).or_else(|| text.strip_suffix(['\r', '\n'])) {
        text = trim(rest);
    }
    text
}

/// The number of decimal digits of `u32::MAX`.
const MAX_DIGITS: usize = 10;

#[cfg(test)]
mod tests {
    use proptest::prelude::*;
    use std::string::String;
    use std::vec::Vec;

    use super::*;

    fn read(body: &str) -> Option<Vec<(&str, ArgumentValue<'_>)>> {
        let mut entries = Vec::new();
        each(body.as_bytes(), |key, value| {
            entries.push((key, value));
            true
        })
        .then_some(entries)
    }

    #[test]
    fn objects_of_numbers_and_texts_are_read() {
        assert_eq!(read(""), Some(Vec::new()));
        assert_eq!(read(" {\r\n} "), Some(Vec::new()));
        let both = read("{\"confirm_s\": 60.5,\n\t\"revision\":3}\n").unwrap();
        assert_eq!(
            both,
            [
                ("confirm_s", ArgumentValue::Thousandths(60_500)),
                ("revision", ArgumentValue::Thousandths(3_000))
            ]
        );
        assert_eq!((both[0].1.whole(), both[1].1.whole()), (None, Some(3)));
        assert_eq!(read(r#"{"key":"a, }:b"}"#), Some(std::vec![("key", ArgumentValue::Text("a, }:b"))]));
        assert_eq!(read(r#"{"s":0.0019}"#), Some(std::vec![("s", ArgumentValue::Thousandths(1))]));
    }

    #[test]
    fn anything_else_is_refused() {
        for wrong in [
            "{",
            "}",
            "[]",
            "1",
            "null",
            "{}{}",
            r#"{"a"}"#,
            r#"{"a":}"#,
            r#"{"a":1,}"#,
            r#"{,"a":1}"#,
            r#"{"a":1 "b":2}"#,
            r#"{a:1}"#,
            r#"{"a":-1}"#,
            r#"{"a":1e3}"#,
            r#"{"a":01}"#,
            r#"{"a":.5}"#,
            r#"{"a":5.}"#,
            r#"{"a":1.2.3}"#,
            r#"{"a":99999999999}"#,
            r#"{"a":{}}"#,
            r#"{"a":true}"#,
            r#"{"a":"x\n"}"#,
            r#"{"a\"":1}"#,
            "{\"a\":\"\n\"}",
        ] {
            assert_eq!(read(wrong), None, "{wrong}");
        }
        assert!(!each(b"{\"a\":\"\xFF\"}", |_, _| true));
        assert!(!each(b"{\"a\":1}", |_, _| false));
    }

    proptest! {
        /// Whatever this parser accepts, serde_json accepts too, and reads the same.
        #[test]
        fn it_is_json(body in r#"\{(("[ab]":([0-9]{1,3}(\.[0-9]{1,4})?|"[a-z{}:, ]{0,3}"))[, ]{0,2}){0,3}\}"#) {
            if let Some(entries) = read(&body) {
                let other: serde_json::Value = serde_json::from_str(&body).map_err(|error| {
                    TestCaseError::fail(std::format!("{error}"))
                })?;
                for (key, value) in entries {
                    match value {
                        // If a name occurs twice, the other parser keeps the last.
                        ArgumentValue::Text(_) => prop_assert!(other.get(key).is_some()),
                        ArgumentValue::Thousandths(_) => prop_assert!(other.get(key).is_some()),
                    }
                }
                prop_assert!(other.is_object());
            }
            let _: String = body;
        }
    }
}
