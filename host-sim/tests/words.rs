//! Words that are out do not come back: CONTRIBUTING.md has a table of them, each with the word of the field. Looked at
//! are names in code, but for tests, whose names may be sentences; texts and comments are for people to judge.

use std::fs;
use std::path::Path;

use recipe_test_kit::source::{Source, read, root};

#[test]
fn no_name_has_a_word_that_is_out() {
    let out = words_that_are_out();
    assert!(out.len() > 10, "the table of CONTRIBUTING.md was not found: {out:?}");
    let mut found = Vec::new();
    let files: Vec<_> = ["proto-core", "host-sim", "firmware"]
        .iter()
        .flat_map(|folder| read(&root().join(folder), is_product))
        .collect();
    assert!(files.len() > 300, "only {} files found", files.len());
    for (path, source) in &files {
        for name in names(&source.code) {
            let is_out = words(name).iter().any(|word| out.contains(word));
            if is_out {
                found.push(format!("{}: {name}", path.strip_prefix(root()).unwrap().display()));
            }
        }
    }
    assert!(found.is_empty(), "\n{}\n", found.join("\n"));
}

#[test]
fn names_are_cut_into_words() {
    let all = |code: &str| names(&Source::new(code).code).flat_map(words).collect::<Vec<_>>();
    assert_eq!(
        all("let StoreTask { next_desk } = x; // the desk"),
        ["let", "store", "task", "next", "desk", "x"]
    );
    assert_eq!(all(r#"const DESK: &str = "a lamp, \" a talk";"#), ["const", "desk", "str"]);
    assert_eq!(all("LEDs"), ["leds"]);
    assert_eq!(all("a(\"one \\\n two\", '\"', r#\"x \"y\" \"#, b)"), ["a", "b"]);
}

/// The first column of the table below the heading of words that are out.
fn words_that_are_out() -> Vec<String> {
    let page = fs::read_to_string(root().join("CONTRIBUTING.md")).unwrap();
    let table = page.split("### Words that are out").nth(1).unwrap_or_default();
    let rows = table.lines().skip_while(|line| !line.starts_with("|---")).skip(1);
    let cells = rows.take_while(|line| line.starts_with('|')).filter_map(|line| line.split('|').nth(1));
    cells.flat_map(|cell| cell.split(',')).map(|word| word.trim().to_owned()).collect()
}

fn is_product(path: &Path) -> bool {
    const LEFT_OUT: [&str; 8] =
        ["tests", "fuzz", "compare", "benches", "target", "node_modules", "test-kit", "examples"];
    let name = path.file_name().unwrap().to_str().unwrap();
    !LEFT_OUT.contains(&name) && !name.ends_with("tests.rs") && !name.starts_with("test")
}

/// Names in code.
fn names(code: &str) -> impl Iterator<Item = &str> {
    let is_part = |next: char| next.is_ascii_alphanumeric() || next == '_';
    code.split(move |next| !is_part(next))
        .filter(|name| name.starts_with(|first: char| !first.is_ascii_digit()))
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
