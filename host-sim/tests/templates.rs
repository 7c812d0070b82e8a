//! The templates of `host-sim new`: every one is offered, is a valid gateway file, says where it comes from,
//! and its worked bytes are what `decode` and `encode` make of them.
//!
//! Worked bytes are in a template's comments, as in a shell: `#   $ host-sim decode FILE ...`, and below it
//! what this prints.

use std::fs;
use std::io::Write;
use std::path::{Path, PathBuf};
use std::process::{Output, Stdio};

use recipe_test_kit::Binary;

const BINARY: Binary = Binary(env!("CARGO_BIN_EXE_host-sim"));

/// Runs it in the folder of the templates.
fn host_sim(args: &[&str], stdin: &str) -> Output {
    let mut child = BINARY.command().current_dir(folder()).args(args).stdin(Stdio::piped()).spawn().unwrap();
    // If the arguments are refused, nobody reads this; the caller checks the exit code.
    let _ = child.stdin.take().unwrap().write_all(stdin.as_bytes());
    child.wait_with_output().unwrap()
}

/// What it prints, if it succeeds and has no complaint.
#[track_caller]
fn ok(args: &[&str], stdin: &str) -> String {
    let output = host_sim(args, stdin);
    let errors = String::from_utf8(output.stderr).unwrap();
    assert!(output.status.code() == Some(0) && errors.is_empty(), "{args:?}: {errors}");
    String::from_utf8(output.stdout).unwrap()
}

/// Checks for exit code 2 and an empty stdout; returns stderr.
#[track_caller]
fn refused(args: &[&str]) -> String {
    let output = host_sim(args, "");
    assert_eq!(output.status.code(), Some(2));
    assert!(output.stdout.is_empty(), "{}", String::from_utf8_lossy(&output.stdout));
    String::from_utf8(output.stderr).unwrap()
}

#[test]
fn the_list_is_the_folder() {
    let list = ok(&["new"], "");
    let listed: Vec<&str> = list.lines().filter_map(|line| line.split_whitespace().next()).collect();
    assert_eq!(listed, names());
    for (line, name) in list.lines().zip(names()) {
        let title = text(&name).lines().next().unwrap().trim_start_matches("# ").to_owned();
        assert!(!title.is_empty() && line.ends_with(&title), "{line}");
        assert!(line.len() <= 110, "{line}");
        assert_eq!(ok(&["new", "--device", &name], ""), text(&name), "{name}");
    }
}

#[test]
fn every_template_is_a_valid_gateway_file_without_warnings() {
    for name in names() {
        let report = ok(&["check", &file(&name)], "");
        assert!(report.contains("a valid gateway file"), "{report}");
        let warnings = report.split_once("\nwarnings").map_or("", |(_, behind)| behind);
        // This gripper has no command that stops it, which its file says.
        let is_known =
            |line: &&str| name == "dh-pge" && line.contains("exchange 4") && line.contains("stop = true");
        let others = warnings.lines().skip(1).filter(|line| !is_known(line));
        assert_eq!(others.collect::<Vec<_>>(), [""; 0], "{name}");
    }
}

/// Those that move or switch nothing, although the robot starts something in them: a measurement.
const SENSORS: [&str; 3] = ["keyence-sr750", "kunwei-kwr75", "robotiq-ft300"];

#[test]
fn a_template_that_moves_something_says_what_happens_without_the_gateway() {
    for name in names() {
        let text = text(&name);
        let is_moving =
            (text.contains("from = \"") || text.contains("rising:")) && !SENSORS.contains(&&*name);
        assert!(!is_moving || text.contains("\n# When the gateway dies"), "{name}");
    }
}

#[test]
fn every_template_says_how_to_wire_it_and_where_it_comes_from() {
    for name in names() {
        for what in ["\n# Wiring: ", "\n# Source: ", "\n#   host-sim gateway -c ", "\n# Worked bytes"] {
            assert!(text(&name).contains(what), "{name}: nothing says {what:?}");
        }
        let gateway = format!("host-sim gateway -c {name}.toml --bind ");
        assert!(text(&name).contains(&gateway), "{name}: {gateway:?}");
    }
}

#[test]
fn worked_bytes_are_what_the_program_makes_of_them() {
    let mut seen = 0;
    for name in names() {
        for Example { args, shown } in examples(&text(&name)) {
            seen += 1;
            let args: Vec<&str> = args.split_whitespace().collect();
            assert_eq!(args.get(1), Some(&&*file(&name)), "{name}: {args:?}");
            assert_eq!(ok(&args, ""), shown, "{name}: {args:?}");
            // The values make the same bytes again.
            if args[0] == "decode" {
                let options: Vec<&str> = args[2..]
                    .chunks(2)
                    .take_while(|pair| pair[0].starts_with("--"))
                    .flatten()
                    .copied()
                    .collect();
                let bytes = args[2 + options.len()..].concat();
                let again = ok(&[&["encode", args[1]], &options[..]].concat(), &shown);
                assert_eq!(digits(&again), digits(&bytes), "{name}: {args:?}");
            }
        }
    }
    assert!(seen >= 2 * names().len() - 5, "only {seen} examples found: the search is broken");
}

#[test]
fn every_frame_has_worked_bytes() {
    for name in names() {
        let report = ok(&["check", &file(&name)], "");
        let examples = examples(&text(&name));
        let has = |words: &[&str]| examples.iter().any(|example| example.has(words));
        // Of a recipe with one part, or with one exchange, it need not be named.
        let parts: Vec<&str> =
            ["input", "output"].into_iter().filter(|part| is_in(&report, part, ' ')).collect();
        for part in &parts {
            assert!(parts.len() == 1 || has(&["--part", part]), "{name}: no {part}");
        }
        for part in ["request", "reply", "refusal"] {
            let is_there =
                is_in(&report, &format!(" {part}"), ',') || is_in(&report, &format!(" {part}"), '\n');
            assert!(!is_there || has(&["--part", part]), "{name}: no {part}");
        }
        let numbers: Vec<String> = (1..)
            .map(|nth: usize| nth.to_string())
            .take_while(|nth| {
                ["exchange", "block"].iter().any(|what| is_in(&report, &format!("{what} {nth}"), ':'))
            })
            .collect();
        for nth in &numbers {
            assert!(numbers.len() == 1 || has(&["--exchange", nth]), "{name}: no exchange {nth}");
        }
        assert!(!parts.is_empty() || !numbers.is_empty(), "{name}: {report}");
    }
}

/// Whether a port of the report has a line that begins with this.
fn is_in(report: &str, what: &str, behind: char) -> bool {
    report.contains(&format!("\n  {what}{behind}"))
}

#[test]
fn a_file_is_written_once() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("cell.toml");
    let path = path.to_str().unwrap();
    let name = names().pop().unwrap();
    let said = ok(&["new", "--device", &name, "-o", path], "");
    assert!(said.contains(path) && said.contains("host-sim check"), "{said}");
    assert_eq!(fs::read_to_string(path).unwrap(), text(&name));
    fs::write(path, "precious").unwrap();
    let message = refused(&["new", "--device", &name, "-o", path]);
    assert_eq!(message, format!("{path}: this exists; give another name\n"));
    assert_eq!(fs::read_to_string(path).unwrap(), "precious");
    let left: Vec<_> = fs::read_dir(folder.path()).unwrap().collect();
    assert_eq!(left.len(), 1, "{left:?}");
}

#[test]
fn an_unknown_device_is_answered_with_near_ones() {
    let message = refused(&["new", "--device", "robotic-ft300"]);
    assert_eq!(
        message,
        "there is no device \"robotic-ft300\"; near it: robotiq-ft300; `host-sim new` lists all\n"
    );
    let message = refused(&["new", "--device", "zzzzzzzzzz"]);
    assert_eq!(message, "there is no device \"zzzzzzzzzz\"; `host-sim new` lists all\n");
    assert!(refused(&["new", "-o", "somewhere.toml"]).contains("--device"));
}

/// A command of a template's comments, and what it prints.
#[derive(Debug)]
struct Example {
    args: String,
    shown: String,
}

impl Example {
    /// Whether these words are among the arguments, one behind the other.
    fn has(&self, words: &[&str]) -> bool {
        let args: Vec<&str> = self.args.split_whitespace().collect();
        args.windows(words.len()).any(|window| window == words)
    }
}

fn examples(text: &str) -> Vec<Example> {
    let mut examples: Vec<Example> = Vec::new();
    let mut is_output = false;
    for line in text.lines() {
        match line.strip_prefix("#   ") {
            Some(line) if line.starts_with("$ host-sim ") => {
                let args = line.trim_start_matches("$ host-sim ").to_owned();
                examples.push(Example { args, shown: String::new() });
                is_output = true;
            }
            Some(line) if is_output => {
                let shown = &mut examples.last_mut().unwrap().shown;
                *shown += line;
                shown.push('\n');
            }
            _ => is_output = false,
        }
    }
    examples
}

/// Only the hexadecimal digits of a frame.
fn digits(frame: &str) -> String {
    frame.split_whitespace().collect()
}

fn folder() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("templates")
}

fn file(name: &str) -> String {
    format!("{name}.toml")
}

fn text(name: &str) -> String {
    fs::read_to_string(folder().join(file(name))).unwrap()
}

/// The names of the files, sorted.
fn names() -> Vec<String> {
    let entries =
        fs::read_dir(folder()).unwrap().map(|entry| entry.unwrap().file_name().into_string().unwrap());
    let mut names: Vec<_> = entries.filter_map(|name| Some(name.strip_suffix(".toml")?.to_owned())).collect();
    names.sort();
    names
}
