//! docs/interface-coverage.md names files and tests that exist.

use std::collections::BTreeSet;
use std::fs;
use std::path::{Path, PathBuf};

use recipe_test_kit::repository;

const TESTS: [&str; 6] = [
    "host-sim/controller",
    "host-sim/config",
    "host-sim/runtime",
    "proto-core/src",
    "proto-core/tests",
    "host-sim/io",
];
/// The head of the tables that are looked at.
const HEAD: &str = "| statement | where | test |";

/// A row: the statement, the files, the tests.
struct Row {
    statement: String,
    files: Vec<String>,
    tests: Vec<String>,
}

/// The rows of every table with [`HEAD`].
fn rows(page: &str) -> Vec<Row> {
    let mut rows = Vec::new();
    let mut inside = false;
    for line in page.lines() {
        if !line.starts_with('|') {
            inside = false;
        } else if line == HEAD {
            inside = true;
        } else if inside && !line.starts_with("|---") {
            let cells: Vec<_> = line.split('|').skip(1).take(3).collect();
            let [statement, files, tests] = cells[..] else { panic!("not three columns: {line}") };
            rows.push(Row {
                statement: statement.trim().to_owned(),
                files: quoted(files),
                tests: quoted(tests),
            });
        }
    }
    rows
}

/// What stands in backticks.
fn quoted(cell: &str) -> Vec<String> {
    cell.split('`').skip(1).step_by(2).map(str::to_owned).collect()
}

/// The functions of a source that are tests.
fn tests_in(source: &str) -> BTreeSet<String> {
    let mut found = BTreeSet::new();
    let mut marked = false;
    for line in source.lines().map(str::trim) {
        if line.starts_with("#[test]") || line.starts_with("#[tokio::test") {
            marked = true;
        } else if let Some(rest) = line.strip_prefix("fn ").or_else(|| line.strip_prefix("async fn ")) {
            if marked {
                found.extend(rest.split('(').next().map(str::to_owned));
            }
            marked = false;
        }
    }
    found
}

fn sources(folder: &Path, found: &mut Vec<PathBuf>) {
    for entry in fs::read_dir(folder).unwrap_or_else(|error| panic!("{}: {error}", folder.display())) {
        let path = entry.unwrap().path();
        if path.is_dir() {
            sources(&path, found);
        } else if path.extension().is_some_and(|extension| extension == "rs") {
            found.push(path);
        }
    }
}

/// What is wrong with the page's rows.
fn mistakes(rows: &[Row], tests: &BTreeSet<String>) -> Vec<String> {
    let mut wrong = Vec::new();
    for Row { statement, files, tests: named } in rows {
        if files.is_empty() || named.is_empty() {
            wrong.push(format!("{statement}: without a file or without a test"));
        }
        for file in files {
            let own = format!("host-sim/controller/src/{file}");
            if ![own.as_str(), file].iter().any(|path| repository().join(path).is_file()) {
                wrong.push(format!("{statement}: there is no file {file}"));
            }
        }
        for test in named.iter().filter(|test| !tests.contains(*test)) {
            wrong.push(format!("{statement}: there is no test {test}"));
        }
    }
    wrong
}

#[test]
fn every_file_and_test_of_the_page_exists() {
    let mut files = Vec::new();
    TESTS.iter().for_each(|folder| sources(&repository().join(folder), &mut files));
    let tests: BTreeSet<String> =
        files.iter().flat_map(|path| tests_in(&fs::read_to_string(path).unwrap())).collect();
    let page = fs::read_to_string(repository().join("docs/interface-coverage.md")).unwrap();
    let rows = rows(&page);
    assert!(rows.len() > 60, "only {} rows found: the search is broken", rows.len());
    let wrong = mistakes(&rows, &tests);
    assert!(wrong.is_empty(), "\n{}\n", wrong.join("\n"));
}

#[test]
fn a_wrong_row_is_noticed() {
    let page = format!(
        "{HEAD}\n|---|---|---|\n| good | `run.rs`, `proto-core/src/lib.rs` | `a`, `b` |\n| no file | `gone.rs` | `a` |\n\
         | no test | `run.rs` | `helper`, `c` |\n| nothing | | |\n\n| statement | why |\n|---|---|\n| x | `y` |\n"
    );
    let tests = tests_in("#[test]\nfn a() {}\nfn helper() {}\n#[tokio::test]\nasync fn b() {}\n");
    assert_eq!(
        mistakes(&rows(&page), &tests),
        [
            "no file: there is no file gone.rs",
            "no test: there is no test helper",
            "no test: there is no test c",
            "nothing: without a file or without a test",
        ]
    );
}
