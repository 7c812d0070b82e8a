//! Timelines in virtual time, and the mistakes in their files.

use recipe_config::{SimConfig, SimProgram};

use super::*;
use crate::{Controller, ControllerOutput};

fn config() -> SimConfig {
    let script = "wait_ms(100); set(\"DO[1]\", true); wait_ms(100);".to_owned();
    SimConfig { programs: vec![SimProgram { name: "pick".to_owned(), script }], ..SimConfig::default() }
}

/// Runs a controller with a timeline for a second, and returns the operations with their time in
/// milliseconds.
fn run(text: &str) -> Vec<(u64, String)> {
    let mut controller = Controller::new(&config()).unwrap();
    controller.record_events();
    let mut timeline = Timeline::parse("t.toml", text, &config()).unwrap();
    let start = Instant::from_millis(1_000);
    let (mut now, mut done) = (start, Vec::new());
    while now <= start + Duration::from_millis(1_000) {
        loop {
            let until = loop {
                if let ControllerOutput::Sleep { until } = controller.poll_output(now) {
                    break until;
                }
            };
            timeline.observe(now, &controller);
            let Some((step, operation)) = timeline.due(now) else {
                now = until.min(timeline.deadline());
                break;
            };
            let result = controller.operate(now, &operation);
            let word = if result.is_ok() { "done" } else { "refused" };
            done.push((now.saturating_since(start).as_millis(), format!("{step} {word}")));
        }
    }
    done
}

#[track_caller]
fn assert_runs(text: &str, expected: &[(u64, &str)]) {
    let expected: Vec<_> = expected.iter().map(|(at, what)| (*at, (*what).to_owned())).collect();
    assert_eq!(run(text), expected);
}

#[test]
fn steps_are_done_at_their_times_and_in_the_order_of_the_file() {
    assert_runs(
        r#"
        [[step]]
        at_s = 0.25
        do = "set"
        items = { "DI[1]" = 1, "DI[2]" = true }
        [[step]]
        at_s = 0
        do = "mode"
        mode = "auto"
        [[step]]
        at_s = 0.25
        do = "stop"
        "#,
        &[(0, "2 done"), (250, "1 done"), (250, "3 refused")],
    );
}

#[test]
fn a_condition_counts_when_it_begins_to_hold() {
    assert_runs(
        r#"
        [[step]]
        at_s = 0.1
        do = "run"
        program = "pick"
        [[step]]
        when = { program = "pick" }
        after_s = 0.05
        do = "set"
        items = { "DI[1]" = 1 }
        [[step]]
        when = { items = { "DO[1]" = 1 }, program = "pick" }
        do = "emergency_stop"
        [[step]]
        when = { coil = { "1" = 0 } }
        do = "clear"
        "#,
        // The last condition holds from the start on.
        &[(0, "4 done"), (100, "1 done"), (150, "2 done"), (200, "3 done")],
    );
}

#[test]
fn a_step_that_repeats_is_done_each_time_and_others_once() {
    let toggled = |repeat: &str| {
        format!(
            "[[step]]\nwhen = {{ items = {{ \"DI[1]\" = 1 }} }}\n{repeat}\ndo = \"set\"\nitems = {{ \"DI[2]\" = 1 }}\n{}",
            [(1, 1), (2, 0), (3, 1), (4, 1), (5, 0)]
                .map(|(at, value)| format!(
                    "[[step]]\nat_s = 0.{at}\ndo = \"set\"\nitems = {{ \"DI[1]\" = {value} }}\n"
                ))
                .concat()
        )
    };
    let with = |own: &[u64]| {
        let mut all: Vec<_> = (1..=5).map(|nth| (100 * nth, format!("{} done", nth + 1))).collect();
        all.extend(own.iter().map(|at| (*at, "1 done".to_owned())));
        all.sort_by_key(|(at, what)| (*at, what.starts_with('1')));
        all
    };
    assert_eq!(run(&toggled("")), with(&[100]));
    assert_eq!(run(&toggled("repeat = true")), with(&[100, 300]));
    assert_eq!(run(&toggled("repeat = true\nafter_s = 0.25")), with(&[350, 550]));
}

#[test]
fn each_event_makes_its_condition_hold_again() {
    assert_runs(
        r#"
        [[step]]
        when = { event = { event = "mode", mode = "manual" } }
        repeat = true
        do = "mode"
        mode = "remote"
        [[step]]
        at_s = 0.1
        do = "mode"
        mode = "manual"
        [[step]]
        at_s = 0.2
        do = "mode"
        mode = "manual"
        "#,
        &[(100, "2 done"), (100, "1 done"), (200, "3 done"), (200, "1 done")],
    );
}

#[test]
fn steps_that_bring_about_each_other_let_time_pass() {
    let done = run(r#"
        [[step]]
        when = { items = { "DI[1]" = 1 } }
        repeat = true
        do = "set"
        items = { "DI[1]" = 0 }
        [[step]]
        when = { items = { "DI[1]" = 0 } }
        repeat = true
        do = "set"
        items = { "DI[1]" = 1 }
        "#);
    assert!((1_900..=2_100).contains(&done.len()), "{}", done.len());
}

#[track_caller]
fn assert_refused(text: &str, message: &str) {
    let error = Timeline::parse("t.toml", text, &config()).unwrap_err().to_string();
    assert!(error.starts_with(message), "{error}\nnot\n{message}");
}

#[test]
fn mistakes_have_file_line_column_and_key() {
    let step = |rest: &str| format!("[[step]]\nat_s = 1\n{rest}\n");
    assert_refused("[[step]\n", "t.toml:1:8: invalid TOML: ");
    assert_refused("[[steps]]\n", "t.toml:1:3: steps: unknown key; a timeline has only steps");
    assert_refused("step = 3\n", "t.toml:1:1: step: unknown key; ");
    assert_refused("step = [1]\n", "t.toml:1:9: step[1]: expected a table");
    assert_refused("[[step]]\ndo = \"clear\"\n", "t.toml:1:1: step[1]: at_s or when is missing");
    assert_refused(&step(""), "t.toml:2:1: step[1]: `do` is missing");
    assert_refused(&step("do = \"estp\""), "t.toml:3:6: step[1].do: unknown variant `estp`, expected one of");
    assert_refused(&step("do = \"clear\"\n  axis = 3"), "t.toml:4:3: step[1].axis: unknown field `axis`");
    assert_refused(
        &step("do = \"collide\"\naxis = 9"),
        "t.toml:4:1: step[1].axis: 9 is no place of a collision; there are 1 to 6, 11 to 16 and 20",
    );
    assert_refused(
        &step("do = \"mode\"\nmode = \"x\""),
        "t.toml:4:8: step[1].mode: unknown variant `x`, expected ",
    );
    assert_refused(
        &step("do = \"set\"\nitems = { \"DI[1]\" = 1, \"DI[17]\" = 1 }"),
        "t.toml:4:24: step[1].items.DI[17]: ",
    );
    assert_refused(&step("do = \"state\""), "t.toml:3:1: step[1].do: a timeline does only what changes");
    assert_refused(
        &step("do = \"recipe\"\nport = \"x\"\nrecipe = \"y\""),
        "t.toml:4:1: step[1].port: there is no port x",
    );
    assert_refused(
        &step("do = \"run\"\nprogram = \"x\""),
        "t.toml:4:1: step[1].program: there is no program x; there are pick",
    );
    assert_refused(
        "[[step]]\nat_s = \"1\"\ndo = \"clear\"",
        "t.toml:2:8: step[1].at_s: \"1\" is not a number of seconds",
    );
    // As `run` looks for it: with folders before its name, which `remove` does not take.
    Timeline::parse("t.toml", &step("do = \"run\"\nprogram = \"cell/pick\""), &config()).unwrap();
    assert_refused(
        &step("do = \"remove\"\nprogram = \"cell/pick\""),
        "t.toml:4:1: step[1].program: there is no program cell/pick; there are pick",
    );
    let run = step("do = \"run\"\nprogram = \"x\"");
    let uploaded = format!("{run}{}", step("do = \"upload\"\nprogram = \"x\"\nscript = \"1\""));
    Timeline::parse("t.toml", &uploaded, &config()).unwrap();
    assert_refused(&step("do = \"clear\"\nrepeat = true"), "t.toml:4:10: step[1].repeat: belongs to `when`");
    assert_refused(
        "[[step]]\nat_s = -1\ndo = \"clear\"",
        "t.toml:2:1: step[1].at_s: -1 is not within 0 to 86400",
    );
    assert_refused("[[step]]\nat_s = nan\ndo = \"clear\"", "t.toml:2:8: step[1].at_s: not a finite number");
    let when = |when: &str| format!("[[step]]\nwhen = {{ {when} }}\ndo = \"clear\"\n");
    assert_refused(&when("robot = \"on\""), "t.toml:2:10: step[1].when.robot: there is no state on;");
    assert_refused(&when("coil = { \"9999\" = 1 }"), "t.toml:2:10: step[1].when.coil: 9999 is no address");
    assert_refused(&when("wrong = 1"), "t.toml:2:10: step[1].when.wrong: unknown field `wrong`");
    assert_refused(&when(""), "t.toml:2:1: step[1].when: the condition is empty");
    let both = "[[step]]\nwhen = { mode = \"auto\" }\nat_s = 1\ndo = \"clear\"\n";
    assert_refused(both, "t.toml:2:8: step[1].when: a step has either `at_s` or `when`, not both");
}

#[test]
fn a_damaged_file_is_refused_or_read_and_nothing_else() {
    let text = "[[step]]\nat_s = 2.5\ndo = \"set\"\nitems = { \"DI[3]\" = 1 }\n[[step]]\n\
                when = { coil = { \"192\" = 1 } }\nrepeat = true\ndo = \"fault\"\nserver = \"command\"\n\
                kind = \"delay\"\nseconds = 0.5\n";
    let config = SimConfig::default();
    let (mut refused, mut read) = (0, 0);
    let mut parse = |text: &str| match Timeline::parse("t.toml", text, &config) {
        Ok(_) => read += 1,
        Err(error) => {
            assert!(error.to_string().starts_with("t.toml:"), "{error}");
            refused += 1;
        }
    };
    for at in 0..text.len() {
        parse(&text[..at]);
        for piece in ["", "[", "9", "\"", "{", "-", "\u{e9}", "nan", "= "] {
            parse(&format!("{}{piece}{}", &text[..at], &text[at + 1..]));
        }
    }
    assert!(refused > 1_000 && read > 50, "{refused} refused, {read} read");
}
