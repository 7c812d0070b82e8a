//! `bundle`: all readable documents in one, for support.
//!
//! A gateway on a host has it ready; for a board it is put together here. It contains no secret.

use std::time::Duration;

use serde_json::{Map, Value, json};

use crate::answer::Answer;
use crate::changing::config;
use crate::client::Client;
use crate::doctor::doctor;
use crate::failure::Failure;
use crate::reading::{log, metrics};

/// The document. It omits what the gateway does not provide; `missing` says why.
pub fn bundle(client: &Client) -> Result<Value, Failure> {
    if let Some(document) = client.json_if_there("bundle")? {
        return Ok(document);
    }
    // Without `info`, a bundle is useless.
    let mut bundle = Map::new();
    bundle.insert("info".into(), client.json("info")?);
    let mut missing = Map::new();
    let part = |answer: Result<Answer, Failure>, key: &str| {
        answer.map(|mut answer| answer.document.get_mut(key).map(Value::take).unwrap_or_default())
    };
    let parts: [(&str, Get<'_>); 7] = [
        ("status", &|| client.json("status")),
        ("values", &|| client.json("values")),
        ("revisions", &|| client.json("revisions")),
        ("metrics", &|| part(metrics(client), "metrics")),
        ("log", &|| part(log(client, 256), "log")),
        ("doctor", &|| Ok(doctor(client, LISTEN)?.document)),
        ("config", &|| Ok(config(client, None)?.document)),
    ];
    for (name, get) in parts {
        if client.stop().is_asked() {
            return Err(client.refused("ended before all of it was there"));
        }
        match get() {
            Ok(document) => drop(bundle.insert(name.into(), document)),
            Err(failure) => drop(missing.insert(name.into(), json!(failure.message()))),
        }
    }
    if !missing.is_empty() {
        bundle.insert("missing".into(), missing.into());
    }
    Ok(bundle.into())
}

/// The result for a written bundle.
pub fn bundled(document: &Value, file: &str, len: usize) -> Answer {
    let missing: Vec<_> = document["missing"].as_object().into_iter().flatten().collect();
    let mut text = format!("{file}: {len} bytes\n");
    for (name, why) in missing {
        text += &format!("  without {name}: {}\n", crate::shown::line(why.as_str().unwrap_or_default()));
    }
    Answer::new(json!({ "file": file, "bytes": len }), text)
}

type Get<'a> = &'a dyn Fn() -> Result<Value, Failure>;

/// How long to listen to a board.
const LISTEN: Duration = Duration::from_secs(6);
