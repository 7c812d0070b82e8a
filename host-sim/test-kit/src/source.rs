//! Rust sources, for tests that check the code.

use std::fs;
use std::path::{Path, PathBuf};

/// The root folder of the repository.
///
/// # Panics
/// Never, because this crate is inside the repository.
pub fn root() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).ancestors().nth(2).unwrap().to_path_buf()
}

/// A Rust source without comments and without the test module at its end, with its string literals separate.
#[derive(Debug, Default)]
pub struct Source {
    /// The code, with the index of each literal between its quotes.
    pub code: String,
    /// The literals, by index.
    pub literals: Vec<String>,
}

impl Source {
    /// Parses the text of a file.
    pub fn new(text: &str) -> Self {
        let text = &text[..tests_beside(text)];
        let mut source = Self::default();
        let mut rest = text;
        while let Some(c) = rest.chars().next() {
            let is_word = source.code.ends_with(|c: char| c.is_alphanumeric() || c == '_');
            if rest.starts_with("//") {
                rest = &rest[rest.find('\n').unwrap_or(rest.len())..];
            } else if let Some(behind) = rest.strip_prefix("r#\"").filter(|_| !is_word) {
                let (literal, behind) = behind.split_once("\"#").unwrap_or((behind, ""));
                source.push(literal.to_owned());
                rest = behind;
            } else if let Some(behind) = rest.strip_prefix('"') {
                rest = source.read_literal(behind);
            } else if let Some(behind) = rest.strip_prefix('\'') {
                // A character literal, or a lifetime.
                let len = match behind.as_bytes() {
                    [b'\\', ..] => behind[2..].find('\'').map_or(0, |end| end + 3),
                    _ => {
                        behind.char_indices().nth(1).filter(|(_, c)| *c == '\'').map_or(0, |(end, _)| end + 1)
                    }
                };
                rest = &behind[len..];
            } else {
                source.code.push(c);
                rest = &rest[c.len_utf8()..];
            }
        }
        source
    }

    fn push(&mut self, literal: String) {
        self.code += &format!("\"{}\"", self.literals.len());
        self.literals.push(literal);
    }

    /// Reads a literal after its opening quote; returns the text after its closing quote.
    fn read_literal<'a>(&mut self, text: &'a str) -> &'a str {
        let (mut literal, mut rest) = (String::new(), text);
        loop {
            let mut chars = rest.chars();
            match chars.next() {
                None | Some('"') => break rest = chars.as_str(),
                Some('\\') => match chars.next() {
                    Some('\n') => rest = chars.as_str().trim_start(),
                    escaped => {
                        literal.extend(escaped.filter(|c| "\"\\'".contains(*c)));
                        rest = chars.as_str();
                    }
                },
                Some(c) => {
                    literal.push(c);
                    rest = chars.as_str();
                }
            }
        }
        self.push(literal);
        rest
    }
}

/// Reads the Rust files below a folder; skips files and folders for whose path `is_wanted` is false.
///
/// # Panics
/// If a file or a folder cannot be read.
pub fn read(folder: &Path, is_wanted: impl Fn(&Path) -> bool) -> Vec<(PathBuf, Source)> {
    let (mut files, mut folders) = (Vec::new(), vec![folder.to_path_buf()]);
    while let Some(folder) = folders.pop() {
        for entry in fs::read_dir(&folder).unwrap() {
            let path = entry.unwrap().path();
            if !is_wanted(&path) {
                continue;
            }
            if path.is_dir() {
                folders.push(path);
            } else if path.extension().is_some_and(|end| end == "rs") {
                let source = Source::new(&fs::read_to_string(&path).unwrap());
                files.push((path, source));
            }
        }
    }
    files.sort_by(|(one, _), (other, _)| one.cmp(other));
    files
}

/// The offset of the test module at the end of a file; the length of the text if it has none.
fn tests_beside(text: &str) -> usize {
    let is_module = |rest: &str| {
        let line = rest.trim_start().lines().next().unwrap_or("");
        line.starts_with("mod ") && line.contains('{')
    };
    let attributes = text.match_indices("#[cfg(test)]");
    let mut modules = attributes.filter(|(at, attribute)| is_module(&text[at + attribute.len()..]));
    modules.next().map_or(text.len(), |(at, _)| at)
}
