//! The TOML in the documents is valid.

use std::fs;

use recipe_config::file::{self, Config, Text};
use recipe_test_kit::repository;

/// The fenced blocks of a document that are TOML, with their line numbers.
fn blocks(document: &str) -> Vec<(usize, String)> {
    let text = fs::read_to_string(repository().join(document)).unwrap();
    let mut blocks = Vec::new();
    let mut open: Option<(usize, String)> = None;
    for (number, line) in text.lines().enumerate() {
        match &mut open {
            None if line == "```toml" => open = Some((number + 1, String::new())),
            Some(_) if line == "```" => blocks.extend(open.take()),
            Some((_, block)) => *block += &format!("{line}\n"),
            None => {}
        }
    }
    blocks
}

#[test]
fn every_example_in_the_documents_is_a_valid_file() {
    let mut kinds = Vec::new();
    for document in ["README.md", "docs/architecture.md", "docs/configuration.md"] {
        for (line, toml) in blocks(document) {
            let name = format!("{document}:{line}");
            match file::parse(Text { name: &name, toml: &toml }, &[]) {
                Ok(Config::Gateway(_)) => kinds.push("gateway"),
                Ok(Config::Controller(_)) => kinds.push("controller"),
                Err(error) => panic!("{name}: {error}"),
            }
        }
    }
    assert_eq!(kinds, ["gateway", "controller"], "the README shows a first file, a page one of a controller");
}
