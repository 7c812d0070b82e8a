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

/// Three runs of some seconds, with more arguments.
fn three_runs(args: &[&str]) -> Output {
    let cells = ["--cell", "client", "--cell", "witness", "--cell", "orders"];
    host_sim(&[&["--hours", "0.005", "--seed", "7"], &cells[..], args].concat())
}

/// The table without its two lines about wall time.
fn without_wall_time(table: &str) -> String {
    let lines: Vec<_> = table.lines().filter(|line| !line.starts_with("wall time")).collect();
    let (kept, rates): (Vec<_>, Vec<_>) =
        lines.into_iter().partition(|line| !line.starts_with("hours a minute"));
    assert_eq!(rates.len(), 1, "{table}");
    kept.join("\n")
}

#[test]
fn shares_make_the_table_of_one_machine() {
    let folder = tempfile::tempdir().unwrap();
    let at = |name: &str| folder.path().join(name).to_str().unwrap().to_owned();
    let files = ["1/3", "2/3", "3/3"].map(|share| {
        let document = text(&three_runs(&["--shard", share, "--json"]), 0);
        let file = at(&share.replace('/', "-"));
        std::fs::write(&file, document).unwrap();
        file
    });
    let [first, second, third] = files.each_ref().map(String::as_str);
    let merged = text(&host_sim(&["merge", third, first, second]), 0);
    assert!(merged.ends_with("\nPASS  all invariants held\n"), "{merged}");
    assert_eq!(without_wall_time(&merged), without_wall_time(&text(&three_runs(&[]), 0)));
    // What was merged is a document of one machine.
    std::fs::write(at("all"), text(&host_sim(&["merge", first, second, third, "--json"]), 0)).unwrap();
    assert_eq!(text(&host_sim(&["merge", &at("all")]), 0), merged);

    let document = std::fs::read_to_string(second).unwrap();
    let failed = r#""failure":{"run":1,"seed":41,"cell":"orders","after_us":2500000,"what":"ownership: 7"}"#;
    let change = |name: &str, from: &str, to: &str| {
        assert!(document.contains(from), "{from}: {document}");
        std::fs::write(at(name), document.replace(from, to)).unwrap();
        at(name)
    };
    let failed = change("failed", r#""failure":null"#, failed);
    let table = text(&host_sim(&["merge", first, &failed, third]), 1);
    let (_, end) = table.split_once("\n\nFAIL").unwrap();
    insta::assert_snapshot!("merged_failure", end);
    let output = host_sim(&["merge", first, &failed, third, "--json"]);
    assert!(text(&output, 1).contains("ownership"));
    assert!(output.stderr.starts_with(b"FAIL  ownership: 7\n"), "{output:?}");

    let refused = |files: &[&str]| {
        let output = host_sim(&[&["merge"], files].concat());
        assert_eq!(text(&output, 2), "");
        String::from_utf8(output.stderr).unwrap().replace(&at(""), "")
    };
    std::fs::write(at("table"), &merged).unwrap();
    insta::assert_snapshot!(
        "merge_refused",
        [
            refused(&[]),
            refused(&[first, second]),
            refused(&[first, second, third, first]),
            refused(&[first, &at("none")]),
            refused(&[&at("table")]),
            refused(&[&change("format", r#""soak":2"#, r#""soak":9"#)]),
            refused(&[first, &change("key", r#""seed":7"#, r#""seeds":7"#), third]),
            refused(&[first, &change("seed", r#""seed":7"#, r#""seed":8"#), third]),
            refused(&[&change("nothing", r#""soak":2,"#, "")]),
        ]
        .join("\n")
    );
}

#[test]
fn help_and_refusals() {
    insta::assert_snapshot!("help", text(&host_sim(&["--help"]), 0));
    insta::assert_snapshot!("merge_help", text(&host_sim(&["merge", "--help"]), 0));
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
        refused(&["--shard", "0/3", "--json"]),
        refused(&["--shard", "4/3", "--json"]),
        refused(&["--shard", "1/3"]),
        refused(&["--shard", "1/3", "--json", "--replay", "9@2"]),
        refused(&["--shard", "3/23", "--json"]),
        refused(&["--seed", "1", "merge", "no-such.json"]),
    ];
    insta::assert_snapshot!("refused", messages.join("\n"));
}
