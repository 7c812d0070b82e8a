//! Bytes as text, and their places among other bytes.

use std::fmt;

/// Bytes in hexadecimal, such as `48 AA`, as `host-sim decode` takes them.
#[derive(Debug, Clone, Copy)]
pub struct HexBytes<'a>(pub &'a [u8]);

impl fmt::Display for HexBytes<'_> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        for (nth, byte) in self.0.iter().enumerate() {
            let space = if nth == 0 { "" } else { " " };
            write!(f, "{space}{byte:02X}")?;
        }
        Ok(())
    }
}

/// The bytes of [`HexBytes`], with spaces or without; `None` if the text is anything else.
pub(crate) fn from_hex(text: &str) -> Option<Vec<u8>> {
    let digits: Option<Vec<u8>> =
        text.chars().filter(|c| *c != ' ').map(|c| c.to_digit(16).map(|digit| digit as u8)).collect();
    let (pairs, rest) = digits.as_deref()?.as_chunks::<2>();
    rest.is_empty().then(|| pairs.iter().map(|[high, low]| high << 4 | low).collect())
}

/// The places of `what` among `bytes`; they may overlap.
pub(crate) fn places(bytes: &[u8], what: &[u8]) -> Vec<usize> {
    if what.is_empty() {
        return Vec::new();
    }
    bytes.windows(what.len()).enumerate().filter(|(_, here)| *here == what).map(|(at, _)| at).collect()
}

pub(crate) fn is_at(bytes: &[u8], at: usize, what: &[u8]) -> bool {
    bytes.get(at..).is_some_and(|rest| rest.starts_with(what))
}

/// The most frequent item, the first of several, and how often it occurs.
pub(crate) fn most<T: PartialEq>(items: impl IntoIterator<Item = T>) -> Option<(T, usize)> {
    let mut counts: Vec<(T, usize)> = Vec::new();
    for item in items {
        match counts.iter_mut().find(|(known, _)| *known == item) {
            Some((_, count)) => *count += 1,
            None => counts.push((item, 1)),
        }
    }
    let most = counts.iter().map(|(_, count)| *count).max()?;
    counts.into_iter().find(|(_, count)| *count == most)
}

/// The bytes as a list of a configuration file, such as `[0xAA, 0x48]`.
pub(crate) fn list(bytes: &[u8]) -> String {
    let items: Vec<_> = bytes.iter().map(|byte| format!("0x{byte:02X}")).collect();
    format!("[{}]", items.join(", "))
}

pub(crate) fn count(number: usize, one: &str) -> String {
    format!("{number} {one}{}", if number == 1 { "" } else { "s" })
}
