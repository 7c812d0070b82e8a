//! Every text that a test looks for in a log is a text of the programs. Without this, a text that was
//! changed in the program leaves `assert!(!log.contains(..))` behind, which can no longer fail.
//!
//! A text is found if its constant words are in one string literal of the sources, in their order; a
//! number, and what a test formats itself, stands for a placeholder. A part before `: `, `; ` or `, ` may be in
//! another literal than the rest.

use std::collections::BTreeMap;
use std::path::Path;

use recipe_test_kit::source::{Source, read, root};

/// Folders of tests, and the folders of the programs that they run.
const TESTS: [(&str, &[&str]); 7] = [
    ("firmware/chip-model/tests", &["firmware/src", "proto-core/src"]),
    ("firmware/tests", &["firmware/src", "proto-core/src"]),
    ("host-sim/tests/scenarios", &["firmware/src", "host-sim", "proto-core/src"]),
    ("host-sim/tests/usb_can", &["host-sim", "proto-core/src"]),
    ("host-sim/tests/socketcan", &["host-sim", "proto-core/src"]),
    ("host-sim/tests/hostile", &["host-sim", "proto-core/src"]),
    ("host-sim/tests/api", &["host-sim"]),
];

/// The beginning of a panic message, which is Rust's.
const PANIC: &str = r#"fn panic() { "panicked at" }"#;

/// Calls whose arguments are looked for in a log, up to their parenthesis.
const LOOKUPS: [&str; 13] = [
    "until_log(",
    "has_logged(",
    "times_logged(",
    "assert_said(",
    "machine.until(",
    ".log(",
    "log.contains(",
    "log.matches(",
    "log.split_once(",
    "log.rsplit_once(",
    "log().contains(",
    "errors().contains(",
    "warning.contains(",
];

#[test]
fn every_text_that_is_looked_for_is_logged() {
    let (mut seen, mut missing) = (0, Vec::new());
    let mut folders: BTreeMap<&str, Vec<LogSource>> = BTreeMap::new();
    for folder in TESTS.into_iter().flat_map(|(_, programs)| programs) {
        folders.entry(folder).or_insert_with(|| programs(folder));
    }
    let panic = LogSource::new(Source::new(PANIC));
    for (tests, programs) in TESTS {
        let programs = programs.iter().flat_map(|folder| &folders[folder]);
        let sources = Sources(programs.chain([&panic]).collect());
        let files = read(&root().join(tests), |_| true);
        let files: Vec<_> = files.into_iter().map(|(path, source)| (path, LogSource::new(source))).collect();
        let constants: BTreeMap<String, String> =
            files.iter().flat_map(|(_, source)| source.constants()).collect();
        for (path, source) in &files {
            for text in source.lookups(&constants) {
                seen += 1;
                if !sources.have(&text) {
                    missing.push(format!("{}: {text:?}", path.strip_prefix(root()).unwrap().display()));
                }
            }
        }
    }
    assert!(seen > 70, "only {seen} lookups found: the search is broken");
    assert!(missing.is_empty(), "no program logs what these look for:\n{}\n", missing.join("\n"));
}

#[test]
fn a_changed_text_is_noticed() {
    let source = LogSource::new(Source::new(
        r#"fn f() {
            warn!("port {}: {} bytes discarded; parity {}", name, count, parity); // "of a comment"
            let quote = ('"', b'\'', "the image is \
                damaged");
            info!(interface, bitrate = 1, %error, "interface lost");
        }
        #[cfg(test)]
        mod tests { const ONLY: &str = "in a test"; }"#,
    ));
    let sources = Sources(vec![&source]);
    for text in [
        "bytes discarded",
        "12 bytes discarded; parity 2",
        "warn: 7 bytes",
        "bytes discarded: the image is damaged",
        "interface=",
        "bitrate=250000 error=gone",
    ] {
        assert!(sources.have(text), "{text}");
    }
    for text in [
        "bytes dropped",
        "12 bytes discarded; framing 2",
        "discarded bytes",
        "nothing runs: the image is damaged",
        "of a comment",
        "in a test",
        "name=",
        "bitrate=250000 configured=500000",
    ] {
        assert!(!sources.have(text), "{text}");
    }
}

#[test]
fn lookups_are_read_however_they_are_written() {
    let source = LogSource::new(Source::new(
        r#"const ADDRESS: &str = "address 10.0.2.15";
        fn f() {
            board.until_log(board::ADDRESS);
            bench.until_log(&format!("panic at {place:08X}, from 08"), span(1));
            assert!(!log.contains("(") && !bench.has_logged("a)b"), "not looked for");
            assert_said(&log, &["one", "two"]);
        }"#,
    ));
    let constants = source.constants().collect();
    let texts = source.lookups(&constants);
    assert_eq!(texts, ["address 10.0.2.15", "panic at {place:08X}, from 08", "a)b", "one", "two", "("]);
}

/// The programs that a test runs.
struct Sources<'a>(Vec<&'a LogSource>);

impl Sources<'_> {
    /// Whether one of them can log a line with this text.
    fn have(&self, text: &str) -> bool {
        let text =
            ["info: ", "warn: ", "error: "].iter().find_map(|level| text.strip_prefix(level)).unwrap_or(text);
        let (fields, words): (Vec<&str>, Vec<&str>) =
            text.split_whitespace().partition(|word| word.contains('='));
        fields.iter().all(|field| self.have_field(field.split('=').next().unwrap_or("")))
            && if fields.is_empty() { self.have_words(&general(text)) } else { words.is_empty() }
    }

    fn have_words(&self, text: &str) -> bool {
        let text = text.trim_matches([' ', ':', ';', ',', '{', '}']);
        if !text.contains(char::is_alphabetic) {
            return true;
        }
        self.0.iter().any(|source| source.general.iter().any(|literal| literal.contains(text)))
            || [": ", "; ", ", "].iter().any(|separator| {
                text.split_once(separator)
                    .is_some_and(|(before, behind)| self.have_words(before) && self.have_words(behind))
            })
    }

    /// Whether a `tracing` event has a field of this name.
    fn have_field(&self, name: &str) -> bool {
        let is_name = |c: char| c.is_alphanumeric() || c == '_';
        self.0.iter().any(|source| {
            LEVELS.iter().flat_map(|level| source.arguments(level)).any(|arguments| {
                let fields = arguments.split('"').next().unwrap_or("");
                fields.split(',').any(|field| {
                    let field = field.trim().trim_start_matches(['%', '?']);
                    field.split(|c| !is_name(c)).next() == Some(name)
                })
            })
        })
    }
}

const LEVELS: [&str; 5] = ["trace!(", "debug!(", "info!(", "warn!(", "error!("];

/// A source, its literals also as [`general`] has them.
struct LogSource {
    source: Source,
    general: Vec<String>,
}

impl LogSource {
    fn new(source: Source) -> Self {
        let general = source.literals.iter().map(|literal| general(literal)).collect();
        Self { source, general }
    }

    /// What stands between the parentheses of each such call.
    fn arguments<'a>(&'a self, call: &'a str) -> impl Iterator<Item = &'a str> {
        self.source.code.match_indices(call).map(|(at, _)| {
            let rest = &self.source.code[at + call.len()..];
            let mut depth = 1;
            let end = rest.find(|c| {
                depth += i32::from(c == '(') - i32::from(c == ')');
                depth == 0
            });
            &rest[..end.unwrap_or(rest.len())]
        })
    }

    /// The texts that this file looks for in a log.
    fn lookups(&self, constants: &BTreeMap<String, String>) -> Vec<String> {
        let mut texts = Vec::new();
        for arguments in LOOKUPS.iter().flat_map(|call| self.arguments(call)) {
            let literals = arguments.split('"').skip(1).step_by(2);
            texts.extend(
                literals.map(|number| self.source.literals[number.parse::<usize>().unwrap()].clone()),
            );
            let words = arguments.split(|c: char| !c.is_alphanumeric() && c != '_');
            texts.extend(words.filter_map(|word| constants.get(word).cloned()));
        }
        texts
    }

    /// Each `const NAME: &str`.
    fn constants(&self) -> impl Iterator<Item = (String, String)> {
        self.source.code.match_indices("const ").filter_map(|(at, word)| {
            let (name, rest) = self.source.code[at + word.len()..].split_once(": &str = \"")?;
            let number: usize = rest.split('"').next()?.parse().ok()?;
            (!name.contains(char::is_whitespace))
                .then(|| (name.to_owned(), self.source.literals[number].clone()))
        })
    }
}

/// A text with `{}` in the place of each number and of each placeholder.
fn general(text: &str) -> String {
    let mut general = String::new();
    let mut rest = text;
    while let Some(c) = rest.chars().next() {
        let is_digit = |c: char| c.is_ascii_digit() || ('A'..='F').contains(&c);
        let word = rest.find(|c: char| !c.is_alphanumeric()).unwrap_or(rest.len());
        let len = if c == '{' {
            rest.find('}').map_or(rest.len(), |end| end + 1)
        } else if word > 1 && rest[..word].chars().all(is_digit) || c.is_ascii_digit() && word == 1 {
            word
        } else {
            let len = word.max(c.len_utf8());
            general += &rest[..len];
            rest = &rest[len..];
            continue;
        };
        general += "{}";
        rest = &rest[len..];
    }
    // An address is one value, whoever prints its parts.
    for parts in ["{}.{}", "{}/{}", "{}{}"] {
        while general.contains(parts) {
            general = general.replace(parts, "{}");
        }
    }
    general
}

/// The programs in a folder.
fn programs(folder: &str) -> Vec<LogSource> {
    let is_program = |path: &Path| {
        let path = path.to_string_lossy();
        !["/tests", "/test-kit", "/test_", "/fuzz"].iter().any(|part| path.contains(part))
    };
    read(&root().join(folder), is_program).into_iter().map(|(_, source)| LogSource::new(source)).collect()
}
