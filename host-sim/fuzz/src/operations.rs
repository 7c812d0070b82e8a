//! Operations as the control socket has them, and timelines: what is refused has changed nothing, what is accepted
//! is the same after it was written out (docs/control.md).

use proto_core::time::Duration;
use recipe_config::SimConfig;
use recipe_config::file::{Text, parse_controller};
use recipe_controller::operations::Operation;
use recipe_controller::timeline::Timeline;
use recipe_controller::{ControllerOutput, TestController};
use recipe_fuzz::source::Source;
use serde_json::{Map, Value, json};

/// A controller with a program, a recipe and a port.
const CELL: &str = r#"
[robot]
power = "enabled"
[[program]]
name = "pick"
script = "wait_ms(20); set(\"DO[1]\", true); wait_ms(20);"
[[recipe]]
name = "outputs"
kind = "stream"
mode = "realtime"
[recipe.input]
head = [255, 255]
tail = [238, 238]
fields = ["DigitalOutputCommand[1]"]
[[port]]
name = "line"
bus = "rs485"
recipe = "outputs"
"#;

/// Operations that are there, one a line.
const LINES: [&str; 41] = [
    r#"{"do":"state"}"#,
    r#"{"do":"get","items":["DI[1]","DO[1]"]}"#,
    r#"{"do":"counters"}"#,
    r#"{"do":"programs"}"#,
    r#"{"do":"events","since":1,"max":5}"#,
    r#"{"do":"events","kinds":["mode"]}"#,
    r#"{"do":"follow"}"#,
    r#"{"do":"set","items":{"DI[1]":1,"DI[2]":true}}"#,
    r#"{"do":"set","items":{"AI_V[1]":2.5,"DI[17]":1}}"#,
    r#"{"do":"set","items":{"DI[1]":0}}"#,
    r#"{"do":"mode","mode":"auto"}"#,
    r#"{"do":"mode","mode":"remote"}"#,
    r#"{"do":"emergency_stop"}"#,
    r#"{"do":"protective_stop"}"#,
    r#"{"do":"collide","axis":3}"#,
    r#"{"do":"clear"}"#,
    r#"{"do":"hold","safety":null}"#,
    r#"{"do":"reduced","on":true}"#,
    r#"{"do":"raise_error","code":7,"text":"x"}"#,
    r#"{"do":"clear_error"}"#,
    r#"{"do":"power_on"}"#,
    r#"{"do":"power_off"}"#,
    r#"{"do":"enable"}"#,
    r#"{"do":"disable"}"#,
    r#"{"do":"run","program":"pick","speed_percent":50}"#,
    r#"{"do":"run","program":"cell/pick"}"#,
    r#"{"do":"stop"}"#,
    r#"{"do":"pause"}"#,
    r#"{"do":"resume"}"#,
    r#"{"do":"upload","program":"new","script":"wait_ms(5); set(\"DO[2]\", 1);"}"#,
    r#"{"do":"remove","program":"new"}"#,
    r#"{"do":"recipe","port":"line","recipe":null}"#,
    r#"{"do":"cycle","port":"line","ms":8}"#,
    r#"{"do":"restart","registers":"cleared"}"#,
    r#"{"do":"fault","server":"command","kind":"delay","seconds":0.5}"#,
    r#"{"do":"fault","port":"line","kind":"cut","bytes":2}"#,
    r#"{"do":"fault","item":"DI[1]","kind":"spoil","value":3}"#,
    r#"{"do":"fault","transitions":0.1}"#,
    r#"{"do":"heal"}"#,
    r#"{"do":"advance","seconds":1}"#,
    r#"{"do":"wait","until":{"items":{"DO[1]":1},"program":"pick"},"timeout_s":1}"#,
];

/// What is put into lines and files.
const PIECES: [&str; 32] = [
    "-1",
    "0",
    "1",
    "1e9",
    "1e999",
    "nan",
    "true",
    "null",
    "{}",
    "[]",
    "\"",
    ",",
    "}",
    "]",
    "\n",
    "\"x\"",
    "\"line\"",
    "\"pick\"",
    "\"DI[1]\"",
    "\"\\u0000\"",
    "[[step]]\n",
    "at_s = ",
    "when = { mode = \"auto\" }\n",
    "after_s = 0.01\n",
    "repeat = true\n",
    "do = \"clear\"\n",
    "items = { \"DI[1]\" = 1 }\n",
    "program = \"cell/pick\"\n",
    "kind = \"delay\"\n",
    "seconds = 0.5\n",
    "axis",
    "=",
];

fn config() -> SimConfig {
    parse_controller(Text { name: "cell.toml", toml: CELL }, &[]).expect("it is right")
}

pub(crate) fn run_lines(input: &[u8]) {
    let mut input = Source::new(input);
    let mut robot = TestController::new(&config()).expect("it is right");
    for _ in 0..24 {
        if input.is_empty() {
            return;
        }
        let kind = input.u8();
        robot.run(Duration::from_millis(u64::from(kind >> 4) * 4));
        let line = match kind & 7 {
            0 => String::from_utf8_lossy(input.run()).into_owned(),
            damage => damaged(input.one_of(&LINES), damage.saturating_sub(4), &mut input),
        };
        let Ok(Value::Object(request)) = serde_json::from_str(&line) else { continue };
        carry_out(&mut robot, request);
    }
}

fn carry_out(robot: &mut TestController, request: Map<String, Value>) {
    let before = state(robot);
    let operation = match Operation::from_json(request) {
        Ok(operation) => operation,
        Err(error) => return one_line(&error.to_string()),
    };
    let written = serde_json::to_value(&operation).expect("it was JSON");
    let Value::Object(again) = written.clone() else { panic!("{written} is no object") };
    assert_eq!(Operation::from_json(again).as_ref(), Ok(&operation), "{written}");
    let now = robot.now();
    let done = robot.controller_mut().operate(now, &operation);
    match &done {
        Ok(Value::Null) => assert!(!operation.is_reading(), "{operation:?}"),
        Ok(_) => assert!(operation.is_reading(), "{operation:?}"),
        Err(error) => one_line(&error.to_string()),
    }
    if done.is_err() || operation.is_reading() {
        assert_eq!(state(robot), before, "{operation:?}: {done:?}");
    }
}

/// Everything that an operation may change, but the error that the machine shows: it says why it refuses.
fn state(robot: &mut TestController) -> Value {
    let now = robot.now();
    let items = ["DI[1]", "DI[2]", "DO[1]", "AI_V[1]"].map(str::to_owned).to_vec();
    let all = [Operation::State {}, Operation::Programs {}, Operation::Counters {}, Operation::Get { items }];
    let mut shown = all.map(|one| robot.controller_mut().operate(now, &one).expect("it is always there"));
    if let Some(state) = shown[0].as_object_mut() {
        state.remove("error");
    }
    json!(shown)
}

fn one_line(message: &str) {
    assert!(!message.is_empty() && !message.contains(['\n', '\r']), "{message:?}");
}

pub(crate) fn run_timeline(input: &[u8]) {
    let mut input = Source::new(input);
    let kind = input.u8();
    let text = match kind & 3 {
        0 => String::from_utf8_lossy(input.rest()).into_owned(),
        damage => {
            let steps: String = (0..1 + kind % 5).map(|_| step(&mut input)).collect();
            damaged(&steps, damage - 1, &mut input)
        }
    };
    let config = config();
    let mut timeline = match Timeline::parse("t.toml", &text, &config) {
        Ok(timeline) => timeline,
        Err(error) => {
            let message = error.to_string();
            assert!(message.starts_with("t.toml:"), "{message}");
            assert!(!message.chars().any(char::is_control), "{message:?}");
            let line = message.split(':').nth(1).and_then(|line| line.parse::<usize>().ok());
            assert!(line.is_some_and(|line| line <= text.matches('\n').count() + 1), "{message}");
            return;
        }
    };
    // A second of it: steps that cause each other take a millisecond at least.
    let mut robot = TestController::new(&config).expect("it is right");
    let end = robot.now() + Duration::from_millis(1_000);
    let most = 1_100 * timeline.len() + 10;
    let mut done = 0;
    while robot.now() <= end {
        let now = robot.now();
        let controller = robot.controller_mut();
        while !matches!(controller.poll_output(now), ControllerOutput::Sleep { .. }) {}
        timeline.observe(now, controller);
        if let Some((nth, operation)) = timeline.due(now) {
            assert!((1..=timeline.len()).contains(&nth) && !operation.is_reading(), "{operation:?}");
            // What depends on the state may be refused.
            if let Err(error) = controller.operate(now, &operation) {
                one_line(&error.to_string());
            }
            done += 1;
            assert!(done <= most, "steps keep the clock from moving");
        } else {
            assert!(timeline.deadline() > now);
            robot.run(timeline.deadline().saturating_since(now).min(Duration::from_millis(20)));
        }
    }
}

/// A line as a step of a timeline.
fn step(input: &mut Source<'_>) -> String {
    let Ok(Value::Object(operation)) = serde_json::from_str(input.one_of(&LINES)) else {
        return String::new();
    };
    let mut step = String::from("[[step]]\n");
    step += &match input.u8() {
        at @ 0..0xC0 => format!("at_s = {}\n", f64::from(at) / 100.0),
        at => format!(
            "when = {{ {} }}\nafter_s = {}\nrepeat = {}\n",
            [
                "mode = \"auto\"",
                "items = { \"DI[1]\" = 1 }",
                "program = \"pick\"",
                "event = { event = \"mode\" }"
            ][usize::from(at & 3)],
            f64::from(at >> 2 & 3) / 50.0,
            at & 0x10 != 0
        ),
    };
    for (key, value) in operation {
        if let Ok(value) = serde_json::from_value::<toml::Value>(value) {
            step += &format!("{key} = {value}\n");
        }
    }
    step
}

/// With so many pieces put into it.
fn damaged(text: &str, times: u8, input: &mut Source<'_>) -> String {
    let mut text = text.to_owned();
    for _ in 0..times {
        let place = usize::from(input.u16()) % (text.len() + 1);
        let end = (place + input.below(12)).min(text.len());
        if text.is_char_boundary(place) && text.is_char_boundary(end) {
            text.replace_range(place..end, input.one_of(&PIECES));
        }
    }
    text
}

pub(crate) fn line_seeds() -> Vec<Vec<u8>> {
    let mut seeds = Vec::new();
    for nth in 0..LINES.len() as u8 {
        seeds.push(vec![1, nth]);
        seeds.push(vec![0xF1, nth, 0x31, (nth + 7) % 40, 0x71, (nth + 19) % 40, 0x11, nth]);
        for piece in [0, 3, 6, 15, 16] {
            seeds.push(vec![5, nth, 20, 0, 1, piece, 0x21, nth]);
        }
        seeds.push([&[0, LINES[usize::from(nth)].len() as u8], LINES[usize::from(nth)].as_bytes()].concat());
    }
    seeds
}

pub(crate) fn timeline_seeds() -> Vec<Vec<u8>> {
    let mut seeds = Vec::new();
    for nth in 0..LINES.len() as u8 {
        seeds.push(vec![1, nth, 10, (nth + 1) % 40, 0xC1]);
        seeds.push(vec![0x41, nth, 0xD0, (nth + 3) % 40, 0xD6, 9, 30]);
        seeds.push(vec![2, nth, 20, 9, 5, 30, 0, 2, 26]);
    }
    // Two that cause each other.
    let toggled = |from: u8| {
        format!(
            "[[step]]\nwhen = {{ items = {{ \"DI[1]\" = {from} }} }}\nrepeat = true\ndo = \"set\"\n\
             items = {{ \"DI[1]\" = {} }}\n",
            1 - from
        )
    };
    seeds.push([&[0], [toggled(0), toggled(1)].concat().as_bytes()].concat());
    for text in [
        "",
        "[[step]]\n",
        "step = 3\n",
        "[[step]]\nat_s = 0.1\ndo = \"set\"\nitems = { \"DI[1]\" = 1 }\n",
        "[[step]]\nwhen = { coil = { \"192\" = 1 } }\nrepeat = true\ndo = \"emergency_stop\"\n",
    ] {
        seeds.push([&[0], text.as_bytes()].concat());
    }
    seeds
}
