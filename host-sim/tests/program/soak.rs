//! `host-sim soak`: its output, and the replay of a failed run.

use std::process::Output;

use super::BINARY;

fn host_sim(args: &[&str]) -> Output {
    BINARY.command().arg("soak").args(args).output().unwrap()
}

#[track_caller]
fn text(output: &Output, code: i32) -> String {
    let text = String::from_utf8(output.stdout.clone()).unwrap();
    assert_eq!(output.status.code(), Some(code), "{text}\n{}", String::from_utf8_lossy(&output.stderr));
    text
}

/// The text with numbers replaced, since other tests check them.
fn shape(text: &str) -> String {
    let lines = text.lines().map(|line| {
        let words = line.split(' ').map(|word| {
            let is_number = word.len() < 17 && word.chars().any(|c| c.is_ascii_digit());
            if is_number && word.chars().all(|c| c.is_ascii_hexdigit() || c == '.') { "#" } else { word }
        });
        let words: Vec<&str> = words.filter(|word| !word.is_empty()).collect();
        words.join(" ")
    });
    lines.collect::<Vec<_>>().join("\n")
}

#[test]
fn the_table_says_what_was_run() {
    let args =
        ["--hours", "0.003", "--seed", "3", "--faults", "mild", "--cell", "rs485-system", "--jobs", "1"];
    let table = text(&host_sim(&args), 0);
    insta::assert_snapshot!("table", shape(&table));
}

#[test]
fn a_replay_shows_what_happened() {
    let replay = text(&host_sim(&["--cell", "rs485-system", "--replay", "9@2.5", "--trace"]), 0);
    assert!(replay.contains("port receives") && replay.contains("gateway sends up"), "{replay}");
    assert!(replay.ends_with("all invariants held up to 2.501000 s\n"), "{replay}");
    assert!(replay.contains("coils from 192 = ") && replay.contains("a state packet"), "{replay}");
    let begins = |line: &str| line.contains("fault") && line.contains("begins: ");
    assert!(replay.lines().any(begins), "{replay}");
    let quiet = text(&host_sim(&["--cell", "rs485-system", "--replay", "9@2.5"]), 0);
    assert_eq!(quiet.lines().count(), 3, "{quiet}");
}

#[test]
fn help_and_refusals() {
    insta::assert_snapshot!("help", text(&host_sim(&["--help"]), 0));
    let refused = |args: &[&str]| {
        let output = host_sim(args);
        assert_eq!(text(&output, 2), "", "nothing was started");
        String::from_utf8(output.stderr).unwrap()
    };
    let messages = [
        refused(&["--hours", "0"]),
        refused(&["--faults", "awful"]),
        refused(&["--cell", "nonsense"]),
        refused(&["--cell", "no-such.toml,no-such.toml"]),
        refused(&["--replay", "5"]),
        refused(&["--trace"]),
        refused(&["--jobs", "0"]),
    ];
    insta::assert_snapshot!("refused", messages.join("\n"));
}
