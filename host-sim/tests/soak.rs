//! `host-sim soak`: one seed is one trace, whoever runs it; what goes wrong can be repeated; what it
//! says.

use std::process::{Command, Output};
use std::sync::Arc;

use host_sim::soak::{Batch, Level, Scenario, Soak, Total};
use proto_core::time::Duration;

fn host_sim(args: &[&str]) -> Output {
    Command::new(env!("CARGO_BIN_EXE_host-sim")).arg("soak").args(args).output().unwrap()
}

#[track_caller]
fn text(output: &Output, code: i32) -> String {
    let text = String::from_utf8(output.stdout.clone()).unwrap();
    assert_eq!(output.status.code(), Some(code), "{text}\n{}", String::from_utf8_lossy(&output.stderr));
    text
}

/// The table's shape: numbers mean what they mean elsewhere.
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

fn soaked(level: Level, seed: u64, span: Duration, jobs: usize) -> Total {
    let batch = Arc::new(Batch::new(Scenario::all().unwrap(), level, seed, span));
    let workers: Vec<_> = (0..jobs)
        .map(|_| {
            let batch = Arc::clone(&batch);
            std::thread::spawn(move || batch.work())
        })
        .collect();
    workers.into_iter().for_each(|worker| worker.join().unwrap());
    assert_eq!(batch.failure(), None);
    batch.total()
}

/// What these seeds mean, on every machine. A change of what the engine, the controller or the cell
/// does, or when, changes them: then the new ones belong here. Nothing else may.
const HASHES: [(Level, u64); 2] =
    [(Level::None, 0xACBF_5417_418A_76DB), (Level::Harsh, 0xC29B_8A0D_F398_6191)];

#[test]
fn a_seed_means_the_same_trace_on_every_machine() {
    let hashes = HASHES.map(|(level, _)| (level, soaked(level, 42, Duration::from_secs(120), 2).hash));
    assert_eq!(hashes, HASHES, "{hashes:#x?}");
}

#[test]
fn the_number_of_threads_changes_nothing() {
    let span = Duration::from_secs(27);
    let one = soaked(Level::Harsh, 7, span, 1);
    assert_eq!(one, soaked(Level::Harsh, 7, span, 3));
    assert_eq!(one.span, span);
    assert!(one.cells.len() > 9 && one.writes > 500, "{one:?}");
    // Commands and safe values take their time.
    let scenario = Scenario::named("orders").unwrap().unwrap();
    let mut checks = one.checks.clone();
    for seed in 1..=3 {
        let mut orders = Soak::new(&scenario, seed, Level::Harsh).unwrap();
        orders.run_to(Duration::from_secs(180));
        let report = orders.report();
        assert_eq!(report.violation, None);
        for (what, count) in report.checks {
            *checks.entry(what).or_default() += count;
        }
    }
    let never: Vec<_> =
        checks.iter().filter(|(_, count)| **count == 0).map(|(what, _)| what.name()).collect();
    assert_eq!(never, [""; 0], "every invariant is looked at");
}

#[test]
fn how_a_run_is_cut_changes_nothing() {
    let scenario = Scenario::named("several-ports").unwrap().unwrap();
    let run = |step: u64| {
        let mut soak = Soak::new(&scenario, 5, Level::Harsh).unwrap();
        for at in (step..=12_000).step_by(step as usize) {
            soak.run_to(Duration::from_millis(at));
        }
        soak.report()
    };
    assert_eq!(run(12_000), run(75));
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
