//! The edge node of a board: its state, and new settings for it (docs/api.md section 10).

use std::time::{Duration, Instant};

use serde_json::Value;

use crate::answer::Answer;
use crate::client::{Call, Client, RequestBody};
use crate::failure::Failure;
use crate::table::{TableCell, facts};

/// When stored settings take effect.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum From {
    /// At the next restart, whenever that is.
    NextStart,
    /// At an immediate restart.
    Now,
}

/// The state of a board's edge node.
///
/// # Errors
/// If it is refused, such as by a gateway on a host, or the board is not reached.
pub fn shown(client: &Client) -> Result<Answer, Failure> {
    client.json("edge").map(answer)
}

/// Stores settings for the edge node of a board, in the board's format.
///
/// # Errors
/// If it is refused, the board is not reached, or it does not come back.
pub fn set(client: &Client, settings: &[u8], from: From) -> Result<Answer, Failure> {
    let (path, more_time) = match from {
        From::NextStart => ("edge", Duration::ZERO),
        From::Now => ("edge?restart=yes", RESTARTING),
    };
    let call = Call { method: "PUT", path, body: RequestBody::Image(settings), if_match: None, more_time };
    let document = client.ask(&call)?;
    match from {
        From::NextStart => Ok(answer(document)),
        From::Now => restarted(client).map(answer),
    }
}

fn restarted(client: &Client) -> Result<Value, Failure> {
    let deadline = Instant::now() + RESTARTING;
    loop {
        let last = client.json("edge");
        match &last {
            // Before the restart, the board still reports the stored settings; after it, connecting takes a moment.
            Ok(document) if document.get("next").is_none() && !is_trying(document) => return last,
            Ok(document) if document.get("next").is_none() && Instant::now() > deadline => return last,
            _ if Instant::now() > deadline => {
                return last.and_then(|_| {
                    Err(client.refused("the settings are kept; it has not restarted in time"))
                });
            }
            _ => {}
        }
        if client.stop().wait(AGAIN) {
            return Err(client.refused("ended before the board had restarted; the settings are kept"));
        }
    }
}

/// Whether the node has neither a session nor a reason for having none.
fn is_trying(document: &Value) -> bool {
    document["state"] == "offline" && document.get("why").is_none()
}

fn answer(document: Value) -> Answer {
    let word = |key: &str| document[key].as_str().map(TableCell::of);
    let count = |key: &str| document["counters"][key].as_u64();
    let mut rows: Vec<(&'static str, TableCell)> = Vec::new();
    for (name, key) in
        [("edge node", "state"), ("why", "why"), ("broker", "broker"), ("group", "group"), ("name", "node")]
    {
        rows.extend(word(key).map(|word| (name, word)));
    }
    rows.extend(document["utc"].as_bool().map(|utc| ("UTC", if utc { "known" } else { "unknown" }.into())));
    rows.extend(word("time_server").map(|server| ("time server", server)));
    rows.extend(document["bd_seq"].as_u64().map(|number| ("session", TableCell::number(number))));
    rows.extend(document["metrics"].as_u64().map(|count| ("metrics", TableCell::number(count))));
    for (name, key) in [("messages", "data"), ("births", "births"), ("values lost", "lost")] {
        rows.extend(count(key).map(|count| (name, TableCell::number(count))));
    }
    match document["next"].as_str() {
        Some("off") => rows.push(("next start", "it tells nothing".into())),
        Some(_) => rows.push(("next start", "with other settings".into())),
        None => {}
    }
    let row = ["state", "broker", "why"].map(|key| (key, word(key).unwrap_or_default()));
    let text = facts(rows);
    let is_well =
        matches!(document["state"].as_str(), Some("off" | "online")) || document.get("next").is_some();
    Answer::new(document, text).with_row(row.into()).with_verdict(is_well)
}

/// Time that a board may take to restart.
const RESTARTING: Duration = Duration::from_secs(30);
const AGAIN: Duration = Duration::from_millis(200);
