//! Commands that only read: identity, state, variables, revisions, log.

use serde_json::{Value, json};

use crate::answer::{Answer, AnswerText};
use crate::client::Client;
use crate::failure::{Failure, Verdict};
use crate::table::{Look, TableCell, TableView, TextTable, facts};

/// `info`.
pub fn info(client: &Client) -> Result<Answer, Failure> {
    let document = client.json("info")?;
    let word = |key: &str| document[key].as_str().map(TableCell::of);
    let mut rows: Vec<(&'static str, TableCell)> = Vec::new();
    rows.extend(word("name").map(|name| ("name", name)));
    rows.extend(word("role").map(|role| ("role", role)));
    rows.extend(word("version").map(|version| ("version", version)));
    rows.extend(document["uptime_s"].as_u64().map(|up| ("running for", time(up).into())));
    rows.extend(document["revision"].as_u64().map(|number| ("revision", TableCell::of(number.to_string()))));
    let has = (document["has"]["rs485"].as_u64(), document["has"]["can"].as_u64());
    if let (Some(lines), Some(buses)) = has {
        rows.push(("has", format!("{lines} RS-485 ports, {buses} CAN ports").into()));
    }
    rows.push(("changes", changes(&document)));
    let places = &document["places"];
    let mut ports: Vec<_> = places["ports"].as_object().into_iter().flatten().collect();
    ports.extend(document["ports"].as_object().into_iter().flatten());
    let mut text = facts(rows);
    let mut table = TextTable::new(&["port", "place"]);
    for (name, place) in ports {
        table.row([name.as_str().into(), place.as_str().unwrap_or_default().into()]);
    }
    if !table.is_empty() {
        text.push('\n');
        text += &table.show(ANY_WIDTH);
    }
    let cell = |key: &str| word(key).unwrap_or_default();
    let up = document["uptime_s"].as_u64().map(time).unwrap_or_default();
    let revision = document["revision"].as_u64().map(|number| number.to_string()).unwrap_or_default();
    let row = vec![
        ("name", cell("name")),
        ("role", cell("role")),
        ("version", cell("version")),
        ("running for", up.into()),
        ("revision", TableCell::number(revision)),
    ];
    Ok(Answer::new(document.clone(), text).with_row(row))
}

/// Whether the gateway accepts changes, in words.
fn changes(info: &Value) -> TableCell {
    match (info["claimed"].as_bool(), info["claim_left_s"].as_f64(), info["can_be_changed"].as_bool()) {
        (Some(false), Some(left), _) => format!("it takes a key for {left:.0} s more").into(),
        (Some(false), None, _) => TableCell::of("none: it has no key; claim it").look(Look::Warning),
        (Some(true), ..) | (None, _, Some(true)) => "with its key".into(),
        _ => "none: it has no key".into(),
    }
}

/// `status`.
pub fn status(client: &Client, view: TableView) -> Result<Answer, Failure> {
    Ok(status_of(client.json("status")?, view))
}

pub(crate) fn status_of(document: Value, view: TableView) -> Answer {
    let health = document["health"].as_str().unwrap_or_default();
    // A simulated controller has no health.
    let is_well = health.is_empty() || health == "running";
    let controller = controller(&document["controller"]);
    let look = if is_well { Look::Well } else { Look::Wrong };
    let known = [("health", TableCell::of(health).look(look)), ("controller", TableCell::of(&controller))];
    let mut text = facts(known.into_iter().filter(|(_, cell)| !cell.is_empty()));
    for table in [ports(&document), links(&document), latencies(&document)] {
        if !table.is_empty() {
            if !text.is_empty() {
                text.push('\n');
            }
            text += &table.show(view);
        }
    }
    let count = |key: &str, good: &dyn Fn(&Value) -> bool| {
        let all = document[key].as_object();
        let well = all.into_iter().flatten().filter(|(_, one)| good(one)).count();
        let look = if all.is_some_and(|all| all.len() == well) { Look::Plain } else { Look::Wrong };
        TableCell::of(format!("{well}/{}", all.map_or(0, serde_json::Map::len))).look(look)
    };
    let row = vec![
        ("health", TableCell::of(health).look(look)),
        ("ports", count("ports", &|port| port["state"] == "working")),
        ("links", count("links", &|link| is_up(link))),
        ("controller", controller.into()),
    ];
    Answer::new(document, text).with_row(row).with_verdict(is_well)
}

fn is_up(link: &Value) -> bool {
    matches!(link["state"].as_str(), Some("up" | "shared"))
}

/// Mode and states of the controller in words; empty if they are unknown.
fn controller(controller: &Value) -> String {
    let words = ["mode", "robot", "program", "safety"].map(|key| controller[key]["name"].as_str());
    let known: Vec<_> = words.into_iter().flatten().collect();
    known.join(", ")
}

fn ports(document: &Value) -> TextTable {
    let headings = ["port", "state", "age", "in", "rejected", "out", "lost cycles", "last rejection"];
    let mut table = TextTable::new(&headings);
    for (name, port) in document["ports"].as_object().into_iter().flatten() {
        let counters = &port["counters"];
        // Frames for other nodes of a CAN bus do not count, nor do rejected fields.
        let is_rejection = |key: &str| {
            (key.starts_with("rejected_")
                && !matches!(key, "rejected_id" | "rejected_remote" | "rejected_fields"))
                || key == "tail_mismatches"
        };
        let counted = counters.as_object().into_iter().flatten();
        let rejected: u64 =
            counted.filter(|(key, _)| is_rejection(key)).filter_map(|(_, count)| count.as_u64()).sum();
        // Bytes that never were a frame are counted in bytes.
        let skipped: u64 =
            ["resync_bytes", "discarded_bytes"].iter().filter_map(|key| counters[key].as_u64()).sum();
        let shown = match skipped {
            0 => rejected.to_string(),
            1 => format!("{rejected}, 1 byte"),
            bytes => format!("{rejected}, {bytes} bytes"),
        };
        let state = port["state"].as_str().unwrap_or_default();
        let look = match state {
            "working" => Look::Well,
            "" => Look::Plain,
            _ => Look::Wrong,
        };
        let lost =
            ["skipped_cycles", "stale_cycles"].iter().filter_map(|key| counters[key].as_u64()).sum::<u64>();
        let last = &port["last_rejection"];
        let last = match (last["text"].as_str(), last["bytes"].as_str(), last["age_ms"].as_u64()) {
            (Some(text), bytes, age) => {
                let age = age.map(|age| format!("{} ago: ", millis(age))).unwrap_or_default();
                let bytes = bytes.filter(|bytes| !bytes.is_empty());
                format!("{age}{text}{}", bytes.map(|bytes| format!(": {bytes}")).unwrap_or_default())
            }
            _ => String::new(),
        };
        table.row([
            name.as_str().into(),
            TableCell::of(state).look(look),
            TableCell::number(port["age_ms"].as_u64().map(millis).unwrap_or_default()),
            count(&counters["frames_in"]),
            TableCell::number(shown).look(if rejected + skipped > 0 { Look::Warning } else { Look::Plain }),
            count(&counters["frames_out"]),
            TableCell::number(lost),
            last.into(),
        ]);
    }
    table
}

fn links(document: &Value) -> TextTable {
    let mut table = TextTable::new(&["link", "state", "connects", "sent", "received", "timeouts", "refused"]);
    for (name, link) in document["links"].as_object().into_iter().flatten() {
        let state = TableCell::of(link["state"].as_str().unwrap_or_default());
        let counters = &link["counters"];
        table.row([
            name.as_str().into(),
            state.look(if is_up(link) { Look::Well } else { Look::Wrong }),
            count(&link["history"]["connects"]),
            count(&counters["sent"]),
            count(&counters["received"]),
            count(&counters["timeouts"]),
            count(&counters["refused"]),
        ]);
    }
    table
}

fn latencies(document: &Value) -> TextTable {
    let mut table = TextTable::new(&["latency", "count", "median", "99 %", "longest"]);
    let names = [
        ("handed_over", "field frame to hand-over"),
        ("arrived", "field frame to arrival"),
        ("lateness", "output frame behind its time"),
        ("modbus", "Modbus round trip"),
    ];
    for (key, name) in names {
        let histogram = &document["latency"][key];
        if histogram["count"].as_u64().is_some_and(|count| count > 0) {
            let time = |key: &str| TableCell::number(histogram[key].as_u64().map(micros).unwrap_or_default());
            table.row([
                name.into(),
                count(&histogram["count"]),
                time("p50_us"),
                time("p99_us"),
                time("max_us"),
            ]);
        }
    }
    table
}

/// `values`: the variables whose names contain one of the filters, ignoring case.
pub fn values(client: &Client, filters: &[String], view: TableView) -> Result<Answer, Failure> {
    Ok(values_of(client.json("values")?, filters, view))
}

pub(crate) fn values_of(mut document: Value, filters: &[String], view: TableView) -> Answer {
    let filters: Vec<_> = filters.iter().map(|filter| filter.to_lowercase()).collect();
    if let Some(values) = document.get_mut("values").and_then(Value::as_object_mut)
        && !filters.is_empty()
    {
        values.retain(|name, _| {
            let name = name.to_lowercase();
            filters.iter().any(|filter| name.contains(filter))
        });
    }
    let mut table = TextTable::new(&["variable", "value", "age", "owner"]);
    for (name, known) in document["values"].as_object().into_iter().flatten() {
        table.row([
            name.as_str().into(),
            TableCell::number(number(&known["value"])),
            TableCell::number(known["age_ms"].as_u64().map(millis).unwrap_or_default()),
            known["owner"].as_str().unwrap_or_default().into(),
        ]);
    }
    let known = document["values"].as_object().map_or(0, serde_json::Map::len);
    let text = match known {
        0 => "no variable is known\n".to_owned(),
        _ => table.show(view),
    };
    Answer::new(document, text).with_row(vec![("known variables", TableCell::number(known))])
}

/// `metrics`.
pub fn metrics(client: &Client) -> Result<Answer, Failure> {
    let text = client.text(client.get("metrics")?)?;
    Ok(text_answer("metrics", text))
}

/// `log`: the newest lines.
pub fn log(client: &Client, lines: u32) -> Result<Answer, Failure> {
    let text = client.text(client.get(&format!("log?lines={lines}"))?)?;
    let lines: Vec<_> = text.lines().map(str::to_owned).collect();
    let row = vec![
        ("lines", TableCell::number(lines.len())),
        ("newest", lines.last().cloned().unwrap_or_default().into()),
    ];
    let answer = text_answer("log", text);
    Ok(Answer { document: json!({ "log": lines }), ..answer }.with_row(row))
}

fn text_answer(key: &str, text: String) -> Answer {
    Answer {
        document: json!({ key: text }),
        row: vec![("bytes", TableCell::number(text.len()))],
        text: AnswerText::Document(text),
        verdict: Verdict::Well,
    }
}

/// `revisions`.
pub fn revisions(client: &Client) -> Result<Answer, Failure> {
    Ok(revisions_of(client.json("revisions")?))
}

pub(crate) fn revisions_of(document: Value) -> Answer {
    let number = |key: &str| document[key].as_u64();
    let trial = document["trial"]["revision"].as_u64();
    let mut table = TextTable::new(&["revision", "is", "from", "stored"]);
    for entry in document["kept"].as_array().into_iter().flatten() {
        let Some(revision) = entry["revision"].as_u64() else { continue };
        let marks = [
            (number("running") == Some(revision), "running"),
            (trial == Some(revision), "on trial"),
            (number("live") == Some(revision), "live"),
            (number("previous") == Some(revision), "previous"),
            (number("waiting") == Some(revision), "waiting"),
        ];
        let marks: Vec<_> = marks.into_iter().filter(|(is, _)| *is).map(|(_, word)| word).collect();
        let from = entry["from"].as_str().map(str::to_owned);
        let from = from.unwrap_or_else(|| match &entry["from"] {
            Value::Null => String::new(),
            other => other.to_string(),
        });
        table.row([
            TableCell::number(revision),
            marks.join(", ").into(),
            from.into(),
            stored(&entry["stored_at"]).into(),
        ]);
    }
    let mut text = table.show(ANY_WIDTH);
    if let (Some(revision), Some(left)) = (trial, document["trial"]["left_s"].as_f64()) {
        text += &format!(
            "\nrevision {revision} is on trial, and taken back in {left:.0} s unless it is confirmed\n"
        );
    }
    if let (Some(revision), Some(ended)) =
        (document["last"]["revision"].as_u64(), document["last"]["ended"].as_str())
    {
        text += &format!("\nthe last trial, of revision {revision}: {}\n", ended_words(ended));
    }
    if let Some(failure) = document["failure"].as_str() {
        text += &format!("{}\n", crate::shown::line(failure));
    }
    let cell =
        |value: Option<u64>| TableCell::number(value.map(|value| value.to_string()).unwrap_or_default());
    let row = vec![
        ("running", cell(number("running"))),
        ("live", cell(number("live"))),
        ("on trial", cell(trial)),
        ("waiting", cell(number("waiting"))),
        ("kept", TableCell::number(document["kept"].as_array().map_or(0, Vec::len))),
    ];
    Answer::new(document, text).with_row(row)
}

pub(crate) fn ended_words(name: &str) -> String {
    match name {
        "confirmed" => "confirmed".into(),
        "not-confirmed" => "nobody confirmed it in time".into(),
        "taken-back" => "taken back by a person".into(),
        "failed" => "it did not start".into(),
        other => crate::shown::line(other).into_owned(),
    }
}

/// When a revision was stored: seconds since 1970, or a text.
fn stored(at: &Value) -> String {
    match (at.as_u64(), at.as_str()) {
        (Some(seconds), _) => utc(seconds),
        (_, Some(text)) => text.to_owned(),
        _ => String::new(),
    }
}

/// Seconds since 1970 as `2025-01-31 12:00:00 UTC`.
fn utc(seconds: u64) -> String {
    let (days, rest) = (seconds / 86_400, seconds % 86_400);
    // Years are counted from March, so the leap day is the last day of a year.
    let shifted = days + 719_468;
    let (era, day) = (shifted / 146_097, shifted % 146_097);
    let year = (day - day / 1_460 + day / 36_524 - day / 146_096) / 365;
    let of_year = day - (365 * year + year / 4 - year / 100);
    let month = (5 * of_year + 2) / 153;
    let date = of_year - (153 * month + 2) / 5 + 1;
    let (month, carry) = if month < 10 { (month + 3, 0) } else { (month - 9, 1) };
    let (hour, minute, second) = (rest / 3_600, rest / 60 % 60, rest % 60);
    format!("{:04}-{month:02}-{date:02} {hour:02}:{minute:02}:{second:02} UTC", year + era * 400 + carry)
}

fn count(value: &Value) -> TableCell {
    TableCell::number(value.as_u64().map(|count| count.to_string()).unwrap_or_default())
}

/// A number as text.
pub(crate) fn number(value: &Value) -> String {
    match (value.as_i64(), value.as_f64()) {
        (Some(integer), _) => integer.to_string(),
        // A 32-bit float has no more digits than it needs.
        (None, Some(float)) => (float as f32).to_string(),
        _ => value.as_str().map_or_else(|| value.to_string(), str::to_owned),
    }
}

fn micros(us: u64) -> String {
    match us {
        0..1_000 => format!("{us} us"),
        1_000..1_000_000 => format!("{:.1} ms", us as f64 / 1e3),
        _ => format!("{:.1} s", us as f64 / 1e6),
    }
}

pub(crate) fn millis(ms: u64) -> String {
    match ms {
        0..1_000 => format!("{ms} ms"),
        1_000..60_000 => format!("{:.1} s", ms as f64 / 1e3),
        _ => time(ms / 1_000),
    }
}

fn time(seconds: u64) -> String {
    match seconds {
        0..60 => format!("{seconds} s"),
        60..3_600 => format!("{} min {} s", seconds / 60, seconds % 60),
        3_600..86_400 => format!("{} h {} min", seconds / 3_600, seconds / 60 % 60),
        _ => format!("{} d {} h", seconds / 86_400, seconds / 3_600 % 24),
    }
}

const ANY_WIDTH: TableView = TableView { width: None, is_terminal: false };

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn times_are_those_of_the_calendar() {
        assert_eq!(utc(0), "1970-01-01 00:00:00 UTC");
        assert_eq!(utc(951_782_399), "2000-02-28 23:59:59 UTC");
        assert_eq!(utc(951_782_400), "2000-02-29 00:00:00 UTC");
        assert_eq!(utc(951_868_800), "2000-03-01 00:00:00 UTC");
        assert_eq!(utc(1_798_761_599), "2026-12-31 23:59:59 UTC");
        assert_eq!(
            (time(59), time(3_661), time(90_000)),
            ("59 s".into(), "1 h 1 min".into(), "1 d 1 h".into())
        );
    }

    #[test]
    fn documents_of_any_shape_are_shown() {
        let view = TableView { width: Some(80), is_terminal: true };
        for document in [
            json!(null),
            json!([]),
            json!({ "ports": 3, "links": [], "health": 7 }),
            json!({ "ports": { "a": 3, "b": { "counters": "x", "last_rejection": { "text": 1 } } } }),
            json!({ "kept": [3, {}, { "revision": "x" }, { "revision": 1, "from": 3, "stored_at": u64::MAX }] }),
            json!({ "trial": { "revision": 1, "left_s": 1e300 }, "last": [], "values": { "a": [] } }),
        ] {
            status_of(document.clone(), view);
            values_of(document.clone(), &["x".into()], view);
            revisions_of(document);
        }
    }
}
