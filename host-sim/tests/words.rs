//! Words that are out do not come back: CONTRIBUTING.md has a table of them, each with the word of the field. Looked at
//! are names in code, but for tests, whose names may be sentences; texts and comments are for people to judge.

use std::fs;
use std::path::{Path, PathBuf};

#[test]
fn no_name_has_a_word_that_is_out() {
    let out = words_that_are_out();
    assert!(out.len() > 10, "the table of CONTRIBUTING.md was not found: {out:?}");
    let mut found = Vec::new();
    let files = product_files();
    assert!(files.len() > 300, "only {} files found", files.len());
    for path in &files {
        let text = fs::read_to_string(path).unwrap();
        // Tests beside the code are at its end.
        let code = text.split("#[cfg(test)]\nmod tests {").next().unwrap();
        for (nth, line) in without_texts(code).lines().enumerate() {
            for word in names(line).flat_map(words) {
                if out.contains(&word) {
                    found.push(format!("{}:{}: {word}", path.display(), nth + 1));
                }
            }
        }
    }
    assert!(found.is_empty(), "\n{}\n", found.join("\n"));
}

#[test]
fn names_are_cut_into_words() {
    let all = |code: &str| names(&without_texts(code)).flat_map(words).collect::<Vec<_>>();
    assert_eq!(
        all("let StoreTask { next_desk } = x; // the desk"),
        ["let", "store", "task", "next", "desk", "x"]
    );
    assert_eq!(all(r#"const DESK: &str = "a lamp, \" a talk";"#), ["const", "desk", "str"]);
    assert_eq!(all("LEDs"), ["leds"]);
    assert_eq!(all("a(\"one \\\n two\", '\"', r#\"x \"y\" \"#, b)"), ["a", "b"]);
}

fn root() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).parent().unwrap().to_owned()
}

/// The first column of the table below the heading of words that are out.
fn words_that_are_out() -> Vec<String> {
    let page = fs::read_to_string(root().join("CONTRIBUTING.md")).unwrap();
    let table = page.split("### Words that are out").nth(1).unwrap_or_default();
    let rows = table.lines().skip_while(|line| !line.starts_with("|---")).skip(1);
    let cells = rows.take_while(|line| line.starts_with('|')).filter_map(|line| line.split('|').nth(1));
    cells.flat_map(|cell| cell.split(',')).map(|word| word.trim().to_owned()).collect()
}

fn product_files() -> Vec<PathBuf> {
    let mut files = Vec::new();
    for folder in ["proto-core", "host-sim", "firmware"] {
        collect(&root().join(folder), &mut files);
    }
    files
}

fn collect(folder: &Path, files: &mut Vec<PathBuf>) {
    const LEFT_OUT: [&str; 9] =
        ["tests", "fuzz", "compare", "benches", "target", "node_modules", "test-kit", "examples", "dist"];
    for entry in fs::read_dir(folder).unwrap() {
        let path = entry.unwrap().path();
        let name = path.file_name().unwrap().to_str().unwrap();
        if path.is_dir() {
            if !LEFT_OUT.contains(&name) && !name.starts_with('.') {
                collect(&path, files);
            }
        } else if name.ends_with(".rs") && !name.ends_with("tests.rs") && !name.starts_with("test") {
            files.push(path);
        }
    }
}

/// Code without comments and texts, line by line.
fn without_texts(code: &str) -> String {
    let mut left = String::new();
    let mut rest = code;
    while let Some(next) = rest.chars().next() {
        let len = if rest.starts_with("//") {
            rest.find('\n').unwrap_or(rest.len())
        } else if rest.starts_with("r#\"") {
            rest.find("\"#").map_or(rest.len(), |end| end + 2)
        } else if rest.starts_with("'\"'") {
            3
        } else if next == '"' {
            end_of_text(rest)
        } else {
            left.push(next);
            rest = &rest[next.len_utf8()..];
            continue;
        };
        let (text, behind) = rest.split_at(len);
        left.push(' ');
        left.extend(text.chars().filter(|&char| char == '\n'));
        rest = behind;
    }
    left
}

/// Behind the closing quote of a text.
fn end_of_text(text: &str) -> usize {
    let mut is_escaped = false;
    for (at, char) in text.char_indices().skip(1) {
        match char {
            '"' if !is_escaped => return at + 1,
            _ => is_escaped = char == '\\' && !is_escaped,
        }
    }
    text.len()
}

fn names(line: &str) -> impl Iterator<Item = &str> {
    let is_part = |next: char| next.is_ascii_alphanumeric() || next == '_';
    line.split(move |next| !is_part(next)).filter(|name| !name.is_empty())
}

/// The words of a name in either case, in small letters.
fn words(name: &str) -> Vec<String> {
    let mut words = vec![String::new()];
    let mut before = '_';
    for next in name.chars() {
        if next == '_' || before.is_ascii_lowercase() && next.is_ascii_uppercase() {
            words.push(String::new());
        }
        if next != '_' {
            words.last_mut().unwrap().push(next.to_ascii_lowercase());
        }
        before = next;
    }
    words.retain(|word| !word.is_empty());
    words
}
