//! Answers in words.

use std::io::{self, Write};

use serde_json::Value;

/// The state, a line for each thing.
pub(super) fn state(state: &Value, out: &mut dyn Write) -> io::Result<()> {
    let mut line = |name: &str, text: String| writeln!(out, "{name:<9} {text}");
    let text = |key: &str| plain(&state[key]);
    line("time", format!("{} s", state["time_s"]))?;
    line("robot", text("robot"))?;
    line("safety", text("safety"))?;
    line("mode", text("mode"))?;
    let program = match state["program"].as_str() {
        Some(name) => format!("{name}, {}", text("program_state")),
        None => text("program_state"),
    };
    line("program", program)?;
    line("speed", format!("{} %", state["speed_percent"]))?;
    if let Some(code) = state["error"]["code"].as_u64() {
        line("error", format!("{code:#06x}: {}", plain(&state["error"]["text"])))?;
    }
    if state["last_run"].is_object() {
        line("last run", run(&state["last_run"]))?;
    }
    line("joints", format!("{} rad", numbers(&state["joints_rad"])))?;
    line("tcp", format!("{} (m, rad)", numbers(&state["tcp_pose"])))?;
    let clients = state["clients"].as_object().into_iter().flatten();
    let clients: Vec<String> = clients.map(|(server, count)| format!("{server} {count}")).collect();
    line("clients", clients.join(", "))?;
    let ports: Vec<_> = state["ports"].as_object().into_iter().flatten().collect();
    let width = ports.iter().map(|(name, _)| name.chars().count()).max().unwrap_or(0);
    for (name, port) in ports {
        let up = if port["up"] == true { "up" } else { "down" };
        let recipe = port["recipe"].as_str().unwrap_or("no recipe");
        let (cycle, frames_in, frames_out) = (&port["cycle_ms"], &port["frames_in"], &port["frames_out"]);
        line(
            "port",
            format!(
                "{name:<width$}  {up:<4}  {recipe}, {cycle} ms, frames: {frames_in} in, {frames_out} out"
            ),
        )?;
    }
    for fault in state["faults"].as_array().into_iter().flatten() {
        line("fault", pairs(fault, &[]))?;
    }
    let log: Vec<&str> = state["log"].as_array().into_iter().flatten().filter_map(Value::as_str).collect();
    for text in log.iter().rev().take(MAX_LOG).rev() {
        line("log", plain(&Value::from(*text)))?;
    }
    Ok(())
}

/// How a program ended.
fn run(run: &Value) -> String {
    let reason = match run["reason"].as_str() {
        Some(reason) => format!(": {reason}"),
        None => String::new(),
    };
    let place = match (&run["line"], &run["column"]) {
        (Value::Number(line), Value::Number(column)) => format!(" (line {line}, column {column})"),
        _ => String::new(),
    };
    format!("{}, run {}, {}{reason}{place}", plain(&run["program"]), run["run"], plain(&run["outcome"]))
}

/// Names and values, aligned.
pub(super) fn values(values: &Value, out: &mut dyn Write) -> io::Result<()> {
    let values: Vec<_> = values.as_object().into_iter().flatten().collect();
    let width = values.iter().map(|(name, _)| name.chars().count()).max().unwrap_or(0);
    values.iter().try_for_each(|(name, value)| writeln!(out, "{name:<width$}  {}", plain(value)))
}

/// One name on each line.
pub(super) fn names(names: &Value, out: &mut dyn Write) -> io::Result<()> {
    names.as_array().into_iter().flatten().try_for_each(|name| writeln!(out, "{}", plain(name)))
}

/// Counters that are not 0, each with its path.
pub(super) fn counters(counters: &Value, out: &mut dyn Write) -> io::Result<()> {
    let mut all = Vec::new();
    flatten("", counters, &mut all);
    let width = all.iter().map(|(path, _)| path.chars().count()).max().unwrap_or(0);
    all.iter().try_for_each(|(path, value)| writeln!(out, "{path:<width$}  {value}"))
}

fn flatten(path: &str, value: &Value, into: &mut Vec<(String, String)>) {
    match value {
        Value::Object(object) => {
            for (key, value) in object {
                flatten(&if path.is_empty() { key.clone() } else { format!("{path}.{key}") }, value, into);
            }
        }
        Value::Number(number) if number.as_f64() == Some(0.0) => {}
        other => into.push((path.to_owned(), plain(other))),
    }
}

/// The kept events.
pub(super) fn events(result: &Value, out: &mut dyn Write) -> io::Result<()> {
    if result["lost"] != 0 {
        writeln!(out, "{} events before are no longer kept", result["lost"])?;
    }
    result["events"].as_array().into_iter().flatten().try_for_each(|shown| event(shown, out))
}

/// An event: its time, its kind, and with what.
pub(super) fn event(event: &Value, out: &mut dyn Write) -> io::Result<()> {
    let time = event["time_s"].as_f64().unwrap_or(0.0);
    let rest = pairs(event, &["n", "time_s", "event"]);
    writeln!(out, "{time:>11.6}  {:<15} {rest}", plain(&event["event"]))
}

/// Keys and values of an object but for some, in one line.
fn pairs(object: &Value, without: &[&str]) -> String {
    let pairs = object.as_object().into_iter().flatten();
    let pairs = pairs.filter(|(key, _)| !without.contains(&key.as_str()));
    pairs.map(|(key, value)| format!("{key}={}", plain(value))).collect::<Vec<_>>().join(" ")
}

fn numbers(values: &Value) -> String {
    let values = values.as_array().into_iter().flatten().filter_map(Value::as_f64);
    values.map(|value| format!("{value:.4}")).collect::<Vec<_>>().join(" ")
}

/// A text without quotes and on one line; other values as in JSON.
fn plain(value: &Value) -> String {
    match value {
        Value::String(text) if text.chars().any(char::is_control) => text.escape_debug().to_string(),
        Value::String(text) => text.clone(),
        Value::Null => "none".to_owned(),
        other => other.to_string(),
    }
}

/// The newest lines of programs that are shown.
const MAX_LOG: usize = 5;
