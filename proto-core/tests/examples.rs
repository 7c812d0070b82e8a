//! Each example prints what stands beside it, and stays short enough to be read at once.
//!
//! After a change that is meant: `cargo run -q -p proto-core --example NAME > proto-core/examples/NAME.out`.

use std::fs;
use std::path::{Path, PathBuf};
use std::process::Command;

/// Lines of a file of an example.
const LONGEST: usize = 79;

#[test]
fn each_example_prints_what_stands_beside_it() {
    let names = examples();
    assert!(names.len() >= 6, "{names:?}");
    for name in names {
        let beside = folder().join(&name).with_extension("out");
        let expected =
            fs::read_to_string(&beside).unwrap_or_else(|error| panic!("{}: {error}", beside.display()));
        let program = program(&name);
        let ran = Command::new(&program).output();
        let ran = ran.unwrap_or_else(|error| {
            panic!("{}: {error}; `cargo build -p proto-core --examples` makes it", program.display())
        });
        assert!(ran.status.success(), "{name}: {}\n{}", ran.status, String::from_utf8_lossy(&ran.stderr));
        assert_eq!(String::from_utf8_lossy(&ran.stdout), expected, "{name}: left printed, right beside it");
    }
}

#[test]
fn each_file_of_an_example_is_short() {
    let mut files: Vec<PathBuf> = entries(&folder());
    files.extend(entries(&folder().join("superloop")));
    files.retain(|path| path.extension().is_some_and(|extension| extension == "rs"));
    assert!(files.len() >= 10, "{files:?}");
    for path in files {
        let lines = fs::read_to_string(&path).expect("a file").lines().count();
        assert!(lines <= LONGEST, "{}: {lines} lines", path.display());
    }
}

/// By name: files, and folders with a `main.rs`.
fn examples() -> Vec<String> {
    let mut names: Vec<String> = entries(&folder())
        .into_iter()
        .filter(|path| {
            path.extension().is_some_and(|extension| extension == "rs") || path.join("main.rs").exists()
        })
        .map(|path| path.file_stem().expect("a name").to_string_lossy().into_owned())
        .collect();
    names.sort();
    names
}

fn folder() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("examples")
}

fn entries(folder: &Path) -> Vec<PathBuf> {
    fs::read_dir(folder).expect("the folder").map(|entry| entry.expect("an entry").path()).collect()
}

/// `cargo test` puts it beside this test's own folder.
fn program(name: &str) -> PathBuf {
    let test = std::env::current_exe().expect("its own path");
    let profile = test.parent().and_then(Path::parent).expect("target/PROFILE/deps");
    profile.join("examples").join(format!("{name}{}", std::env::consts::EXE_SUFFIX))
}
