//! Commands that change the configuration: `config`, `push`, `apply`, `confirm`, `rollback`; and `identify`.
//!
//! A file is checked here before anything is sent. A host gets its text, a board the image that is made of it here.

use std::net::IpAddr;
use std::path::Path;
use std::time::{Duration, Instant};

use proto_core::config::{GatewayConfig, MAX_PORTS, image};
use proto_core::engine::Engine;
use recipe_api::key::Hex;
use recipe_config::board::{Board, image_of};
use recipe_config::file::{self, FileError};
use serde_json::{Value, json};

use crate::answer::{Answer, AnswerText};
use crate::client::{Call, Client, RequestBody};
use crate::failure::{Failure, Verdict};
use crate::reading::{ended_words, revisions_of};
use crate::shown;
use crate::table::TableCell;

/// A configuration that can run, in the forms for a host and for a board.
#[derive(Debug, Clone)]
pub struct Configuration {
    toml: Result<String, String>,
    image: Result<Vec<u8>, String>,
}

impl Configuration {
    /// Reads a gateway file, or an image, which only a board takes. Overrides, too, only work for a board. With
    /// `board`, the configuration must fit that board.
    pub fn read(path: &Path, set: &[String], board: Option<Board>) -> Result<Self, Failure> {
        let name = path.display().to_string();
        let whole = |why: String| FileError {
            source: file::Source::WholeFile { file: name.clone() },
            key: String::new(),
            message: why,
        };
        let bytes = std::fs::read(path).map_err(|error| whole(format!("cannot be read: {error}")))?;
        if bytes.starts_with(&image::MAGIC) {
            return Self::of_image(&name, bytes, set, board);
        }
        let toml =
            String::from_utf8(bytes).map_err(|_| whole("neither a text nor an image of a board".into()))?;
        // Parse the text that is sent: the file may have changed by now.
        let config = file::parse_gateway(file::Text { name: &name, toml: &toml }, set)?;
        if let Err(error) = Engine::<MAX_PORTS>::new(&*config) {
            return Err(file::error_at(path, set, &["port"], error).into());
        }
        if let Some(Err(unfit)) = board.map(|board| board.check(&config)) {
            let key: Vec<&str> = unfit.key.iter().map(String::as_str).collect();
            return Err(file::error_at(path, set, &key, unfit.message).into());
        }
        let is_asked_for = set.iter().any(|set| set.starts_with("controller.address="));
        let image = match is_this_machine(&config.controller.address) && !is_asked_for {
            true => {
                let why = "this is the board itself, where no controller is; give the controller's address with \
                           --set controller.address=ADDRESS, or write it in the file";
                Err(file::error_at(path, set, &["controller", "address"], why).to_string())
            }
            false => image_of(&config).map_err(|why| format!("{name}: {why}")),
        };
        let toml = match set.is_empty() {
            true => Ok(toml),
            false => Err(format!(
                "{name}: a host takes the text as it is; --set is for boards, and an option of `host-sim gateway`"
            )),
        };
        Ok(Self { toml, image })
    }

    fn of_image(name: &str, bytes: Vec<u8>, set: &[String], board: Option<Board>) -> Result<Self, Failure> {
        let wrong = |why: String| Failure::wrong(format!("{name}: {why}"));
        if !set.is_empty() {
            return Err(wrong("an image has no keys for --set; make another one of its file".into()));
        }
        let config = image::decode(&bytes).map_err(|error| wrong(error.to_string()))?;
        if let Some(Err(unfit)) = board.map(|board| board.check(&config)) {
            return Err(wrong(format!("{}: {}", unfit.key.join("."), unfit.message)));
        }
        Ok(Self {
            toml: Err(format!("{name}: an image is for boards; a host takes the gateway file itself, TOML")),
            image: Ok(bytes),
        })
    }
}

fn is_this_machine(address: &str) -> bool {
    address == "localhost" || address.parse::<IpAddr>().is_ok_and(|ip| ip.to_canonical().is_loopback())
}

/// What takes a configuration.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum ServerRole {
    Host,
    Board,
}

impl ServerRole {
    /// The role that a gateway reports.
    pub(crate) fn of(client: &Client) -> Result<Self, Failure> {
        match client.json("info")?["role"].as_str() {
            Some("gateway") => Ok(Self::Host),
            Some("board") => Ok(Self::Board),
            Some("controller") => {
                Err(client.refused("this is a simulated controller; it takes no configuration"))
            }
            _ => Err(client.refused("its `info` has no role that is known here; is this a gateway?")),
        }
    }
}

/// A configuration as stored by a gateway.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Stored {
    /// The text stored by a host.
    Toml(String),
    /// The image stored by a board.
    Image(Vec<u8>),
}

/// The running configuration, or another stored one.
pub fn stored(client: &Client, revision: Option<u32>) -> Result<Stored, Failure> {
    let path = revision.map_or_else(|| "config".to_owned(), |number| format!("config?revision={number}"));
    let reply = client.get(&path)?;
    let kind = reply.field("content-type").unwrap_or_default();
    match kind.split(';').next().unwrap_or_default().trim() {
        "application/octet-stream" => Ok(Stored::Image(reply.body)),
        _ => client.text(reply).map(Stored::Toml),
    }
}

impl Stored {
    /// The stored bytes.
    pub fn bytes(&self) -> &[u8] {
        match self {
            Self::Toml(text) => text.as_bytes(),
            Self::Image(bytes) => bytes,
        }
    }

    /// The configuration itself, without overrides of the command line.
    pub fn read(&self) -> Result<Box<GatewayConfig>, String> {
        match self {
            Self::Toml(toml) => {
                let text = file::Text { name: "config", toml };
                file::parse_gateway(text, &[]).map_err(|error| error.to_string())
            }
            Self::Image(bytes) => image::decode(bytes).map(Box::new).map_err(|error| error.to_string()),
        }
    }
}

/// `config` without an output file.
pub fn config(client: &Client, revision: Option<u32>) -> Result<Answer, Failure> {
    let stored = stored(client, revision)?;
    let len = TableCell::number(stored.bytes().len());
    let (document, text) = match stored {
        Stored::Toml(toml) => (json!({ "toml": toml }), AnswerText::Document(toml)),
        Stored::Image(bytes) => {
            let text = match Stored::Image(bytes.clone()).read() {
                Ok(config) => format!(
                    "an image of {} bytes, with {} ports and {} recipes; -o FILE writes it\n",
                    bytes.len(),
                    config.ports.len(),
                    config.recipes.len()
                ),
                Err(why) => {
                    format!("an image of {} bytes that this program does not read: {why}\n", bytes.len())
                }
            };
            (json!({ "image": Hex(&bytes).to_string() }), AnswerText::Made(text))
        }
    };
    Ok(Answer { document, text, row: vec![("bytes", len)], verdict: Verdict::Well })
}

/// How a stored revision is put on trial.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct TrialOptions {
    /// Seconds until it is taken back unless it is confirmed.
    pub confirm_s: f64,
    /// The revision to try; `None`: the stored one that waits.
    pub revision: Option<u32>,
}

/// `push`: stores a configuration, and optionally puts it on trial.
pub fn push(
    client: &Client,
    configuration: &Configuration,
    trial: Option<TrialOptions>,
) -> Result<Answer, Failure> {
    let body = match ServerRole::of(client)? {
        ServerRole::Host => RequestBody::Toml(configuration.toml.as_deref().map_err(Failure::wrong)?),
        ServerRole::Board => RequestBody::Image(configuration.image.as_deref().map_err(Failure::wrong)?),
    };
    // The base is the present revision: a person pushes a whole file.
    let base = client.json("revisions")?;
    let Some(etag) = base["base"].as_str().filter(|etag| is_etag(etag)) else {
        return Err(client.refused("it names no revision that a change could be based on"));
    };
    let call = Call { method: "PUT", path: "config", body, if_match: Some(etag), more_time: Duration::ZERO };
    let document = client.ask(&call)?;
    let Some(revision) = document["waiting"].as_u64().or(document["revision"].as_u64()) else {
        return Err(client.refused("it does not say which revision it has stored"));
    };
    if let Some(trial) = trial {
        return apply(client, trial);
    }
    let text = format!("revision {revision} is stored and waits; `apply` puts it on trial\n");
    let row = vec![("revision", TableCell::number(revision)), ("is", "waiting".into())];
    Ok(Answer::new(document, text).with_row(row))
}

fn is_etag(text: &str) -> bool {
    text.len() <= 64 && text.bytes().all(|byte| byte.is_ascii_graphic())
}

/// `apply`.
///
/// # Errors
/// If it is refused, the gateway is not reached, or the revision does not start.
pub fn apply(client: &Client, trial: TrialOptions) -> Result<Answer, Failure> {
    let mut arguments = json!({ "confirm_s": trial.confirm_s });
    if let Some(revision) = trial.revision {
        arguments["revision"] = revision.into();
    }
    let before = client.json("revisions")?["last"].clone();
    let document = replacing(client, "apply", &arguments)?;
    let revision = document["revision"].as_u64();
    let Some(revision) = revision.or(document["trial"]["revision"].as_u64()) else {
        return Err(client.refused("it does not say which revision it applies"));
    };
    // A board restarts for this, and answers before.
    let is_there = |shown: &Value| shown["running"] == revision && shown["trial"]["revision"] == revision;
    let document = match is_there(&document) {
        true => document,
        false => {
            let mut seen = document["trial"]["revision"] == revision;
            let mut ended = |shown: &Value| {
                let is_on = shown["trial"]["revision"] == revision;
                seen |= is_on;
                // An earlier trial may have ended in the same way.
                !is_on && shown["last"]["revision"] == revision && (seen || shown["last"] != before)
            };
            until(client, &is_there, &mut ended, revision)?
        }
    };
    let left = document["trial"]["left_s"].as_f64().unwrap_or(trial.confirm_s);
    let text = format!(
        "revision {revision} runs on trial; it is taken back in {left:.0} s unless it is confirmed: \
         `confirm` keeps it, `rollback` takes it back at once\n"
    );
    let row = vec![("revision", TableCell::number(revision)), ("is", "on trial".into())];
    Ok(Answer::new(document, text).with_row(row))
}

/// Makes a request that replaces the running gateway.
fn replacing(client: &Client, path: &str, arguments: &Value) -> Result<Value, Failure> {
    client.ask(&Call { more_time: REPLACING, ..Call::post(path, arguments) })
}

/// The revisions once `found` is true; a failure if the trial of this revision has `ended` before.
fn until(
    client: &Client,
    found: &dyn Fn(&Value) -> bool,
    ended: &mut dyn FnMut(&Value) -> bool,
    revision: u64,
) -> Result<Value, Failure> {
    let deadline = Instant::now() + RESTARTING;
    loop {
        let last = client.json("revisions");
        if let Ok(document) = &last {
            if found(document) {
                return last;
            }
            if ended(document) {
                let ended = document["last"]["ended"].as_str().unwrap_or_default();
                let why = document["failure"].as_str().map(shown::line).unwrap_or_default();
                let why = if why.is_empty() { String::new() } else { format!(": {why}") };
                return Err(client.refused(format!("revision {revision}: {}{why}", ended_words(ended))));
            }
        }
        if Instant::now() > deadline {
            return Err(match last {
                Err(failure) => failure,
                Ok(_) => client.refused(format!("revision {revision} does not run in time")),
            });
        }
        if client.stop().wait(AGAIN) {
            return Err(client.refused("ended before the revision ran; `revisions` shows what became of it"));
        }
    }
}

/// `confirm`.
pub fn confirm(client: &Client) -> Result<Answer, Failure> {
    let document = client.ask(&Call::post("confirm", &json!({})))?;
    let live = document["live"].as_u64().unwrap_or_default();
    let row = vec![("revision", TableCell::number(live)), ("is", "live".into())];
    Ok(Answer::new(document, format!("revision {live} is live\n")).with_row(row))
}

/// What `rollback` does if there is no trial.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum WithoutTrial {
    /// Refuses.
    Refuse,
    /// Returns to the revision that was live before.
    Previous,
}

/// `rollback`. Without a trial, the API steps back to the previous revision. That is not intended by a user whose trial
/// has just ended by itself, so this checks first.
pub fn rollback(client: &Client, without: WithoutTrial) -> Result<Answer, Failure> {
    if without == WithoutTrial::Refuse {
        let document = client.json("revisions")?;
        if document["trial"].is_null() {
            return Err(client.refused(no_trial(&document)));
        }
    }
    let document = replacing(client, "rollback", &json!({}))?;
    // Without a trial it returns to the previous revision.
    let revision = document["live"].as_u64().unwrap_or_default();
    let is_there = |shown: &Value| {
        shown["running"] == revision && shown["live"] == revision && shown.get("trial").is_none()
    };
    let document = match is_there(&document) {
        true => document,
        false => until(client, &is_there, &mut |_| false, revision)?,
    };
    let row = vec![("revision", TableCell::number(revision)), ("is", "live".into())];
    let text =
        revisions_of(document.clone()).text(crate::table::TableView { width: None, is_terminal: false });
    Ok(Answer::new(document, format!("revision {revision} runs and is live\n\n{text}")).with_row(row))
}

/// Why there is no trial to take back, and what may be intended.
fn no_trial(revisions: &Value) -> String {
    let Some(live) = revisions["live"].as_u64() else {
        return "no revision is on trial, and none was confirmed".into();
    };
    let mut text = format!("no revision is on trial; revision {live} is live");
    if revisions["running"] != live {
        text += ", and does not run at the moment";
    }
    let last = &revisions["last"];
    if let (Some(revision), Some(ended)) = (last["revision"].as_u64(), last["ended"].as_str()) {
        text += &format!(". The last trial, of revision {revision}: {}", ended_words(ended));
    }
    if let Some(previous) = revisions["previous"].as_u64() {
        text += &format!(
            ". `apply --revision {previous}` tries the one before, `rollback --previous` makes it live at once"
        );
    }
    text
}

/// `identify`: a host writes a line, a board blinks its LED.
pub fn identify(client: &Client, seconds: u32) -> Result<Answer, Failure> {
    let document = client.ask(&Call::post("identify", &json!({ "s": seconds })))?;
    let text = format!("{} shows itself for {seconds} s\n", client.address());
    Ok(Answer::new(document, text))
}

/// Time that a gateway may take to send its safe values, end, and start another gateway.
const REPLACING: Duration = Duration::from_secs(10);
/// Time that a board may take to restart.
const RESTARTING: Duration = Duration::from_secs(30);
/// Poll interval for a restarting board.
const AGAIN: Duration = Duration::from_millis(300);
