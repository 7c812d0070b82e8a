//! `doctor`: why does it not work?
//!
//! A gateway on a host reports this itself. For a board, the same rules are applied here to its configuration and to
//! some seconds of its stream.

use std::collections::BTreeMap;
use std::time::Duration as StdDuration;

use proto_core::config::GatewayConfig;
use proto_core::engine::PortId;
use proto_core::time::{Duration, Instant};
use proto_core::wire::can::CanFrame;
use recipe_doctor::{Case, Finding, PortRecord, StatusDocument, WINDOW, examine};
use serde_json::{Value, json};

use crate::answer::Answer;
use crate::changing::stored;
use crate::client::Client;
use crate::failure::Failure;
use crate::frames::FramesDocument;
use crate::shown;
use crate::table::{Look, TableCell, paint};

/// `doctor`. Listens for `time` if the gateway does not report findings itself.
pub fn doctor(client: &Client, time: StdDuration) -> Result<Answer, Failure> {
    let findings = match client.json_if_there("doctor")? {
        Some(document) => document["findings"].as_array().cloned().unwrap_or_default(),
        None => {
            let found = listen(client, time)?;
            found.iter().map(|finding| json!(finding)).collect()
        }
    };
    Ok(answer(findings))
}

fn answer(findings: Vec<Value>) -> Answer {
    let mut text = String::new();
    let mut counts = [("fault", 0_usize), ("warning", 0), ("note", 0)];
    for finding in &findings {
        let word = |key: &str| shown::line(finding[key].as_str().unwrap_or_default()).into_owned();
        let severity = word("severity");
        for (name, count) in &mut counts {
            *count += usize::from(*name == severity);
        }
        let look = match severity.as_str() {
            "fault" => Look::Wrong,
            "note" => Look::Plain,
            _ => Look::Warning,
        };
        let place = [word("place"), word("name")].join(" ");
        text += &format!("{}: {}: {}\n", paint(&severity, look), place.trim_end(), word("seen"));
        for key in ["expected", "likely", "remedy"] {
            let words = word(key);
            if !words.is_empty() {
                text += &format!("  {key:<8}  {words}\n");
            }
        }
    }
    if findings.is_empty() {
        text.push_str("nothing found\n");
    }
    let is_well = findings.iter().all(|finding| finding["severity"] == "note");
    let words: Vec<_> = counts
        .iter()
        .filter(|(_, count)| *count > 0)
        .map(|(name, count)| format!("{count} {name}{}", if *count == 1 { "" } else { "s" }))
        .collect();
    let found = if words.is_empty() { "nothing".to_owned() } else { words.join(", ") };
    let look = if is_well { Look::Well } else { Look::Wrong };
    let first = findings.first().and_then(|finding| finding["text"].as_str()).unwrap_or_default();
    let row = vec![("found", TableCell::of(found).look(look)), ("first", first.into())];
    Answer::new(json!({ "findings": findings }), text).with_row(row).with_verdict(is_well)
}

/// Listens to the stream and examines the data.
fn listen(client: &Client, time: StdDuration) -> Result<Vec<Finding>, Failure> {
    let config =
        stored(client, None)?.read().map_err(|why| client.refused(format!("its configuration: {why}")))?;
    let uptime = client.json("info")?["uptime_s"].as_u64().unwrap_or(0);
    // Counters are compared over a whole window.
    let window = StdDuration::from_micros(WINDOW.as_micros());
    let stop = client.stop().after(time.max(window + StdDuration::from_millis(500)));
    let listening = client.until(stop);
    let mut heard = Heard::new(&config);
    let mut events = listening.stream("stream?frames=1")?;
    while let Some(event) = events.next()? {
        let wrong = |_| client.refused(format!("an event `{}` has another form", event.name));
        match event.name.as_str() {
            "status" => heard.status(serde_json::from_str(&event.data).map_err(wrong)?),
            "frames" => heard.frames(&serde_json::from_str(&event.data).map_err(wrong)?),
            _ => {}
        }
    }
    if client.stop().was_interrupted() {
        return Err(client.refused("ended before enough was heard"));
    }
    let running =
        Duration::from_secs(u32::try_from(uptime).unwrap_or(u32::MAX).into()) + Duration::from_secs(5);
    heard
        .findings(running)
        .ok_or_else(|| client.refused("it sends no status"))?
        .map_err(|why| client.refused(why))
}

/// Data received from a stream.
struct Heard<'a> {
    config: &'a GatewayConfig,
    records: Vec<PortRecord>,
    noted: Option<Instant>,
    newest: Option<StatusDocument>,
    /// For each link that is up: how often it had come up, and since when it has been seen up without a break.
    up: BTreeMap<String, (u32, Instant)>,
}

impl<'a> Heard<'a> {
    fn new(config: &'a GatewayConfig) -> Self {
        let records = config.view().field_ports().map(|(index, ..)| PortRecord::new(PortId(index)));
        Self { config, records: records.collect(), noted: None, newest: None, up: BTreeMap::new() }
    }

    fn status(&mut self, document: StatusDocument) {
        let now = Instant::from_micros(document.time_us);
        if self.noted.is_none_or(|noted| now.saturating_since(noted) >= Duration::from_secs(1)) {
            self.noted = Some(now);
            for (port, counters) in document.counters(self.config) {
                if let Some(record) = self.records.iter_mut().find(|record| record.port == port) {
                    record.note(now, counters);
                }
            }
        }
        let before = std::mem::take(&mut self.up);
        for (name, connects) in document.links_up() {
            let since =
                before.get(name).filter(|(then, _)| *then == connects).map_or(now, |(_, since)| *since);
            self.up.insert(name.to_owned(), (connects, since));
        }
        self.newest = Some(document);
    }

    fn frames(&mut self, document: &FramesDocument) {
        for frame in document.frames.iter().filter(|frame| frame.is_in()) {
            let port = self.config.view().field_ports().find(|(_, port, _)| *port.name == *frame.port);
            let (Some((index, ..)), Some(bytes)) = (port, frame.bytes()) else { continue };
            let record = self.records.iter_mut().find(|record| record.port == PortId(index));
            let Some(record) = record else { continue };
            match frame.can_id() {
                Some(id) => {
                    if let Some(frame) = CanFrame::new(id, &bytes) {
                        record.frame(&frame);
                    }
                }
                None => record.heard(&bytes),
            }
        }
    }

    /// The findings; `None` if there was no status.
    fn findings(&self, running: Duration) -> Option<Result<Vec<Finding>, String>> {
        let newest = self.newest.as_ref()?;
        let now = Instant::from_micros(newest.time_us);
        let up_for =
            |name: &str| self.up.get(name).map_or(Duration::ZERO, |(_, since)| now.saturating_since(*since));
        let status = newest.state(self.config, up_for).map_err(|error| error.to_string());
        Some(status.map(|status| {
            examine(&Case {
                config: self.config.view(),
                status,
                ports: &self.records,
                links: &[],
                running,
                looked: None,
            })
        }))
    }
}
