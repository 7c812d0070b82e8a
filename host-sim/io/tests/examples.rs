//! Each `--bind` that documentation, help or an example file shows is one that the programs take.

use std::fs;
use std::path::{Path, PathBuf};

use recipe_io::bind::Bind;

/// Files below these folders of the repository, and those beside them.
const PLACES: [&str; 7] =
    ["README.md", "CONTRIBUTING.md", "docs", "host-sim", "firmware", "proto-core", ".ci"];
const KINDS: [&str; 8] = ["md", "toml", "rs", "py", "mjs", "service", "default", "run"];

#[test]
fn every_bind_that_is_shown_can_be_typed() {
    let root = Path::new(env!("CARGO_MANIFEST_DIR")).join("../..");
    let mut files = Vec::new();
    PLACES.iter().for_each(|place| collect(&root.join(place), &mut files));
    let (mut seen, mut wrong) = (0, Vec::new());
    for file in files {
        let text = String::from_utf8_lossy(&fs::read(&file).unwrap()).into_owned();
        for (nth, line) in text.lines().enumerate() {
            for shown in line.split("--bind ").skip(1).filter_map(argument) {
                seen += 1;
                if let Err(error) = shown.parse::<Bind>() {
                    wrong.push(format!("{}:{}: {error}", file.display(), nth + 1));
                }
            }
        }
    }
    assert!(wrong.is_empty(), "{}", wrong.join("\n"));
    assert!(seen >= 40, "only {seen} were found");
}

/// What follows `--bind `, if it is an example and no placeholder or variable.
fn argument(rest: &str) -> Option<&str> {
    let end = rest.find(|c: char| c.is_whitespace() || "`\"'|)\\;".contains(c)).unwrap_or(rest.len());
    let shown = &rest[..end];
    let is_example = shown.contains('=')
        && !shown.ends_with('=')
        && !shown.contains(['$', '{', '<', '…'])
        && !shown
            .split(['=', ':'])
            .any(|part| part.len() > 1 && part.bytes().all(|byte| byte.is_ascii_uppercase()));
    is_example.then_some(shown)
}

fn collect(place: &Path, files: &mut Vec<PathBuf>) {
    if place.is_dir() {
        if place.file_name().is_some_and(|name| name == "node_modules" || name == "target") {
            return;
        }
        for entry in fs::read_dir(place).unwrap() {
            collect(&entry.unwrap().path(), files);
        }
    } else if place
        .extension()
        .map_or(place.ends_with("run"), |kind| KINDS.iter().any(|known| kind == *known))
    {
        files.push(place.to_owned());
    }
}
