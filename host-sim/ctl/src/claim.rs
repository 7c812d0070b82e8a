//! `claim`: a board's first key.
//!
//! A board without a key accepts one within a minute after its button is pressed. The key is made here and written to
//! its file before it is sent: a key that only the board knows would lock everybody out. It is sent once, and only
//! while the board reports that it accepts a key.

use std::path::Path;
use std::time::{Duration, Instant};

use serde_json::{Value, json};

use crate::answer::Answer;
use crate::client::{Call, Client};
use crate::failure::Failure;
use crate::key_file;
use crate::shown;

/// `claim`. `tell` gets progress messages.
///
/// # Errors
/// If it is not a board, it has another key, nobody presses the button in time, or the file cannot be written.
pub fn claim(client: &Client, file: &Path, tell: &mut dyn FnMut(&str)) -> Result<Answer, Failure> {
    let name = file.display();
    let info = client.json("info")?;
    if info["role"] != "board" {
        let role = shown::line(info["role"].as_str().unwrap_or("no board")).into_owned();
        return Err(client.refused(format!(
            "only a board is claimed, and this is a {role}; the key of a gateway on a host is its --console-key"
        )));
    }
    let is_new = !file.exists();
    if info["claimed"] == true && is_new {
        return Err(client.refused("it has a key already; only who has that can ask or change it"));
    }
    // An existing key is from an attempt whose answer was lost, or whose button nobody pressed.
    let (key, digits) = if is_new { key_file::make(file)? } else { key_file::read_with_digits(file)? };
    let owner = client.with_key(key);
    if info["claimed"] == true {
        return match owner.json("status") {
            Ok(_) => Ok(done(client, file, "it has this key already")),
            Err(_) => Err(client.refused(format!("it has another key than that of {name}"))),
        };
    }
    if is_new {
        tell(&format!("{name}: a new key, for its owner alone"));
    }
    let shown_name = info["name"].as_str().map(shown::line).unwrap_or_default().into_owned();
    wait(client, &info, &shown_name, tell)?;
    client.accepted(client.call(&Call::post("claim", &json!({ "key": digits })))?)?;
    // The board stores the key before it replies; from then on all requests need it.
    owner.json("status")?;
    Ok(done(client, file, "it is claimed"))
}

fn done(client: &Client, file: &Path, what: &str) -> Answer {
    let name = file.display();
    let text = format!("{}: {what}; keep {name} safe, and give it with --key\n", client.address());
    Answer::new(json!({ "claimed": true, "key": name.to_string() }), text)
}

/// Waits until the board accepts a key.
fn wait(client: &Client, info: &Value, name: &str, tell: &mut dyn FnMut(&str)) -> Result<(), Failure> {
    let is_open = |info: &Value| info["claim_left_s"].as_f64().is_some_and(|left| left > MIN_LEFT_S);
    if is_open(info) {
        return Ok(());
    }
    let name = if name.is_empty() { client.address().to_string() } else { name.to_owned() };
    tell(&format!("press the button of {name} within {} s", WINDOW.as_secs()));
    let deadline = Instant::now() + WINDOW;
    let mut said = WINDOW.as_secs();
    loop {
        if client.stop().wait(AGAIN) {
            return Err(client.refused("ended before the button was pressed; nothing was sent"));
        }
        // The board may be unreachable for a moment, such as during its start.
        match client.json("info") {
            Ok(info) if is_open(&info) => return Ok(()),
            Ok(info) if info["claimed"] == true => {
                return Err(client.refused("somebody else has claimed it meanwhile"));
            }
            _ => {}
        }
        let left = deadline.saturating_duration_since(Instant::now()).as_secs();
        if left == 0 {
            return Err(client.refused("nobody pressed the button in time; nothing was sent"));
        }
        if left / 10 < said / 10 {
            said = left;
            tell(&format!("{left} s left"));
        }
    }
}

/// Time to press the button.
const WINDOW: Duration = Duration::from_secs(60);
/// Minimum time left of the board's own minute: a key sent later might arrive too late.
const MIN_LEFT_S: f64 = 1.0;
const AGAIN: Duration = Duration::from_millis(500);
