//! `trace`: frames by name as they are sent and received.

use std::io::Write;
use std::path::Path;

use proto_core::engine::PortId;
use recipe_capture::Decoder;
use recipe_export::Model;
use serde_json::Value;

use crate::client::Client;
use crate::failure::Failure;
use crate::frames::{FrameDocument, FramesDocument};
use crate::shown;

/// The names of a file's frames, for a board, which has no names.
#[derive(Debug)]
pub struct Names(Decoder);

impl Names {
    /// Reads the names of this gateway file.
    pub fn read(path: &Path) -> Result<Self, Failure> {
        Ok(Self(Decoder::new(&Model::load(path, &[])?)))
    }
}

/// Prints frames of one port or of all ports until Ctrl-C. With `json`, prints one document per line.
pub fn trace(
    client: &Client,
    port: Option<&str>,
    names: Option<&Names>,
    json: bool,
    out: &mut dyn Write,
) -> Result<(), Failure> {
    if let Some(port) = port {
        has_port(client, port)?;
    }
    let mut events = client.stream(&path(port))?;
    let mut began = None;
    while let Some(event) = events.next()? {
        if event.name != "frames" {
            continue;
        }
        let wrong = |_| client.refused("an event `frames` has another form");
        let mut documents: Value = serde_json::from_str(&event.data).map_err(wrong)?;
        let read: FramesDocument = serde_json::from_value(documents.clone()).map_err(wrong)?;
        if read.lost > 0 {
            match json {
                true => writeln!(out, "{}", serde_json::json!({ "lost": read.lost }))?,
                false => writeln!(out, "{} frames lost", read.lost)?,
            }
        }
        let documents = documents.get_mut("frames").and_then(Value::as_array_mut);
        for (frame, document) in read.frames.iter().zip(documents.into_iter().flatten()) {
            if port.is_some_and(|port| frame.port != port) {
                continue;
            }
            let decoded = names.and_then(|names| decode(names, frame));
            if json {
                if let (Some((name, values)), None) = (&decoded, document.get("values")) {
                    document["name"] = name.clone().into();
                    document["values"] = values.clone();
                }
                writeln!(out, "{}", shown::json(document))?;
            } else {
                let since = frame.time_us.saturating_sub(*began.get_or_insert(frame.time_us));
                let decoded = decoded.as_ref().map(|(name, values)| (name.as_str(), values));
                let (seconds, micros) = (since / 1_000_000, since % 1_000_000);
                writeln!(
                    out,
                    "{seconds:4}.{micros:06}  {}  {}",
                    shown::line(&frame.port),
                    frame.line(decoded)
                )?;
            }
        }
        out.flush()?;
    }
    Ok(())
}

fn decode(names: &Names, frame: &FrameDocument) -> Option<(String, Value)> {
    // The decoder only uses the port's name.
    let tapped = frame.frame(PortId(0))?;
    let (topic, values) = names.0.decode(&frame.port, &tapped)?;
    Some((topic.name.clone(), values))
}

/// The path of the stream with frames. It only contains a port name that needs no escaping; other ports are filtered
/// here.
pub(crate) fn path(port: Option<&str>) -> String {
    match port.filter(|port| is_plain(port)) {
        Some(port) => format!("stream?frames=1&port={port}"),
        None => "stream?frames=1".to_owned(),
    }
}

/// Whether a name needs no escaping in a path.
pub(crate) fn is_plain(name: &str) -> bool {
    name.chars().all(|c| c.is_ascii_alphanumeric() || "-._~".contains(c))
}

pub(crate) fn has_port(client: &Client, port: &str) -> Result<(), Failure> {
    let status = client.json("status")?;
    let ports = status["ports"].as_object();
    if ports.is_none_or(|ports| ports.contains_key(port)) {
        return Ok(());
    }
    let names: Vec<_> = ports.into_iter().flatten().map(|(name, _)| shown::line(name).into_owned()).collect();
    Err(Failure::wrong(format!("there is no port {}; there are {}", shown::line(port), names.join(", "))))
}
