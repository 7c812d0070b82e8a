//! The firmware of one board: sent, tried, confirmed or taken back (docs/api.md section 9, docs/update.md).
//!
//! In: a board's client, an update file. Out: what the board says, as [`Firmware`]. Each step is a function, so that
//! they can be put together for many boards; [`update`] does them for one.

use std::fmt;
use std::time::{Duration, Instant};

use recipe_remote::key::from_hex;
use recipe_update::{Link, PublicKey, Slot};
use serde_json::{Value, json};

use crate::answer::Answer;
use crate::client::{Body, Call, Client};
use crate::failure::Failure;
use crate::firmware::Update;
use crate::http::Reply;
use crate::shown;

/// What a board says of its firmware: the document `update`.
#[derive(Debug, Clone, PartialEq)]
pub struct Firmware {
    /// Its board, such as `nucleo-h743zi`.
    pub board: String,
    /// The version that runs.
    pub version: String,
    /// The slot it runs in; `None` if it takes no updates.
    pub slot: Option<Slot>,
    /// Why it takes no update.
    pub cannot: Option<String>,
    /// The key that its loader takes firmware of.
    pub key: Option<PublicKey>,
    /// What runs is on trial.
    pub trial: Option<Trial>,
    /// What is being received, or was.
    pub incoming: Option<Incoming>,
    /// The newest trial that has ended: its slot, and how.
    pub last: Option<(Slot, String)>,
    /// The document itself.
    pub document: Value,
}

/// A firmware that runs on trial.
#[derive(Debug, Clone, PartialEq)]
pub struct Trial {
    /// Seconds until it is taken back.
    pub left_s: f64,
    /// What is missing until it confirms itself.
    pub waits_for: String,
}

/// A firmware on its way into the free slot.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Incoming {
    /// `erasing`, `receiving`, `checking`, `ready` or `failed`.
    pub state: String,
    /// The first digits of its SHA-512.
    pub sha512: String,
    /// Length of header and image in bytes.
    pub length: u64,
    /// Where the next piece begins.
    pub received: u64,
    /// Why it has failed.
    pub why: String,
}

/// How a board does.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Health {
    /// In one word, as in `status`: `running` if nothing is wrong.
    pub word: String,
    /// Links to the controller that are up.
    pub links_up: u64,
    /// Field ports that work.
    pub ports_working: u64,
}

impl Health {
    /// Whether it is at least as good as it was.
    pub fn is_as_good_as(&self, before: &Self) -> bool {
        self.links_up >= before.links_up && self.ports_working >= before.ports_working
    }
}

/// Whether an older firmware than the one that runs is taken.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Downgrade {
    /// The board refuses it.
    Refused,
    /// Somebody has asked for it.
    Allowed,
}

/// What is told while a firmware is sent and tried.
#[derive(Debug, Clone, PartialEq)]
pub enum Progress {
    /// The slot is being erased.
    Erasing,
    /// So many bytes of so many were taken.
    Sent {
        /// Bytes that the board has.
        received: u64,
        /// All of them.
        length: u64,
    },
    /// The board computes the hash.
    Checking,
    /// The board restarts.
    Restarting,
    /// It runs the firmware on trial, which waits for this until it confirms itself.
    OnTrial(Trial),
}

impl Firmware {
    /// What the board says.
    ///
    /// # Errors
    /// It is refused, such as by a gateway on a host, or not reached.
    pub fn of(client: &Client) -> Result<Self, Failure> {
        Self::read(client, client.json("update")?)
    }

    fn read(client: &Client, document: Value) -> Result<Self, Failure> {
        let text = |value: &Value| value.as_str().map(|text| shown::line(text).into_owned());
        let slot = |value: &Value| match value.as_str() {
            Some("A") => Some(Slot::A),
            Some("B") => Some(Slot::B),
            _ => None,
        };
        let (Some(board), Some(version)) = (text(&document["board"]), text(&document["version"])) else {
            return Err(client.refused("its `update` names no board and version; is this a board?"));
        };
        let incoming = &document["incoming"];
        let trial = &document["trial"];
        Ok(Self {
            board,
            version,
            slot: slot(&document["slot"]),
            cannot: text(&document["cannot"]),
            key: document["key"].as_str().and_then(from_hex).and_then(|bytes| PublicKey::parse(&bytes)),
            trial: trial.is_object().then(|| Trial {
                left_s: trial["left_s"].as_f64().unwrap_or_default(),
                waits_for: text(&trial["waits_for"]).unwrap_or_default(),
            }),
            incoming: incoming.is_object().then(|| Incoming {
                state: text(&incoming["state"]).unwrap_or_default(),
                sha512: text(&incoming["sha512"]).unwrap_or_default(),
                length: incoming["length"].as_u64().unwrap_or_default(),
                received: incoming["received"].as_u64().unwrap_or_default(),
                why: text(&incoming["why"]).unwrap_or_default(),
            }),
            last: slot(&document["last"]["slot"]).zip(text(&document["last"]["ended"])),
            document,
        })
    }
}

/// How the board does.
///
/// # Errors
/// It is refused, or not reached.
pub fn health(client: &Client) -> Result<Health, Failure> {
    let status = client.json("status")?;
    let count = |list: &str, is_well: &dyn Fn(&str) -> bool| {
        let all = status[list].as_object().into_iter().flatten();
        all.filter(|(_, one)| one["state"].as_str().is_some_and(is_well)).count() as u64
    };
    Ok(Health {
        word: shown::line(status["health"].as_str().unwrap_or("unknown")).into_owned(),
        links_up: count("links", &|state| matches!(state, "up" | "shared")),
        ports_working: count("ports", &|state| state == "working"),
    })
}

/// The part of an update file that this board takes.
///
/// # Errors
/// It takes none, or none of this file: another board, no link for its free slot, damaged, or signed with another key
/// than its loader's.
pub fn fitting<'u>(client: &Client, board: &Firmware, update: &'u Update) -> Result<Link<'u>, Failure> {
    if let Some(why) = &board.cannot {
        return Err(client.refused(why));
    }
    let Some(slot) = board.slot else {
        return Err(client.refused("its firmware does not say in which slot it runs"));
    };
    let links = update.links();
    let free = slot.other();
    let link = links.into_iter().find(|link| link.header.slot() == free);
    let link = link.ok_or_else(|| {
        client.refused(format!("slot {free:?} is free, and the file has no firmware linked for it"))
    })?;
    let named = link.header.parts().board;
    if named.as_str() != board.board {
        return Err(
            client.refused(format!("this is a {}; the firmware is for the board {named}", board.board))
        );
    }
    link.check().map_err(|why| client.refused(why))?;
    if let Some(key) = &board.key {
        link.header.verify(key).map_err(|why| client.refused(why))?;
    }
    Ok(link)
}

/// Sends a firmware into the free slot, or what is missing of it, until the board has computed its hash. Changes
/// nothing of what runs.
///
/// # Errors
/// It is refused, damaged on the way, or the board was not reached for a minute.
pub fn push(
    client: &Client,
    link: &Link<'_>,
    downgrade: Downgrade,
    told: &mut dyn FnMut(Progress),
) -> Result<Firmware, Failure> {
    let length = (link.header_bytes.len() + link.image.len()) as u64;
    let mut lost: Option<Instant> = None;
    // Where the next piece begins; `None` while the board has something else to do.
    let mut next = Some(0);
    loop {
        let asked = match next {
            Some(offset) => put(client, link, offset, downgrade),
            None => client.call(&Call::get("update")),
        };
        let firmware = match asked {
            Ok(reply) => answered(client, reply)?,
            Err(failure) => {
                let since = *lost.get_or_insert_with(Instant::now);
                if since.elapsed() > AWAY || client.stop().wait(AGAIN) {
                    return Err(failure);
                }
                // Whether it was restarted meanwhile is seen by what it says to the header.
                next = Some(0);
                continue;
            }
        };
        lost = None;
        let Some(incoming) = &firmware.incoming else {
            return Err(client.refused("it does not say what it has received"));
        };
        next = None;
        match incoming.state.as_str() {
            "ready" => return Ok(firmware),
            "failed" => {
                return Err(client.refused(format!("it has not taken the firmware: {}", incoming.why)));
            }
            "receiving" => {
                next = Some(incoming.received);
                told(Progress::Sent { received: incoming.received, length });
                if client.stop().is_asked() {
                    return Err(client.refused("ended; the same command goes on where this one has"));
                }
                continue;
            }
            "erasing" => told(Progress::Erasing),
            _ => told(Progress::Checking),
        }
        if client.stop().wait(AGAIN) {
            return Err(client.refused("ended; the same command goes on where this one has"));
        }
    }
}

/// Sends the piece of a firmware that begins there.
fn put(client: &Client, link: &Link<'_>, offset: u64, downgrade: Downgrade) -> Result<Reply, Failure> {
    let header = link.header_bytes.len();
    let at = usize::try_from(offset).unwrap_or(usize::MAX);
    let piece = match at.checked_sub(header) {
        None => link.header_bytes.get(at..),
        Some(at) => link.image.get(at..).map(|rest| rest.get(..PIECE).unwrap_or(rest)),
    };
    let Some(piece) = piece.filter(|piece| !piece.is_empty()) else {
        return Err(client.refused("it asks for bytes that the firmware does not have"));
    };
    let path = format!("update?offset={offset}{}", more(downgrade, '&'));
    let more_time = Duration::ZERO;
    let call = Call { method: "PUT", path: &path, body: Body::Image(piece), if_match: None, more_time };
    client.call(&call)
}

/// The document of an answer.
fn answered(client: &Client, reply: Reply) -> Result<Firmware, Failure> {
    Firmware::read(client, client.document(&client.accepted(reply)?)?)
}

/// Runs what was received on trial: returns when the board has restarted with it.
///
/// # Errors
/// It is refused, or the board does not come back with it in time.
pub fn begin_trial(
    client: &Client,
    confirm_s: u32,
    downgrade: Downgrade,
    told: &mut dyn FnMut(Progress),
) -> Result<Firmware, Failure> {
    let before = Firmware::of(client)?;
    let path = format!("update/try{}", more(downgrade, '?'));
    post(client, &path, &json!({ "confirm_s": confirm_s }))?;
    told(Progress::Restarting);
    // The trial ends by itself after that, and restarts take their time.
    let there = |now: &Firmware| now.trial.is_some();
    let failed = |now: &Firmware| {
        now.last != before.last && now.trial.is_none() && now.slot == before.slot && now.last.is_some()
    };
    back(client, RESTARTING, &there, &failed)
}

/// Waits until the firmware that runs on trial was confirmed, by itself or by somebody.
///
/// # Errors
/// The trial has ended otherwise.
pub fn wait_confirmed(client: &Client, told: &mut dyn FnMut(Progress)) -> Result<Firmware, Failure> {
    let mut seen = Firmware::of(client)?;
    let slot = seen.slot;
    loop {
        let Some(trial) = seen.trial.clone() else {
            return match seen.last.clone() {
                Some((ended, how)) if Some(ended) == slot && how == "confirmed" && seen.slot == slot => {
                    Ok(seen)
                }
                Some((_, how)) => Err(client.refused(format!("the trial has ended: {}", ended_words(&how)))),
                None => Err(client.refused("no firmware is on trial")),
            };
        };
        let left = trial.left_s.max(0.0);
        told(Progress::OnTrial(trial));
        if client.stop().wait(AGAIN) {
            return Err(client.refused("ended during the trial; `ctl update --confirm` or `--back` ends it"));
        }
        seen = match Firmware::of(client) {
            Ok(seen) => seen,
            // It restarts, or is on its way back.
            Err(_) => back(client, RESTARTING + Duration::from_secs_f64(left), &|_| true, &|_| false)?,
        };
    }
}

/// Keeps the firmware that is on trial.
///
/// # Errors
/// It is refused, or the board not reached.
pub fn confirm(client: &Client) -> Result<Firmware, Failure> {
    post(client, "update/confirm", &json!({}))
}

/// Takes the firmware on trial back: returns when the board runs the one before.
///
/// # Errors
/// It is refused, or the board does not come back in time.
pub fn take_back(client: &Client, told: &mut dyn FnMut(Progress)) -> Result<Firmware, Failure> {
    let slot = post(client, "update/back", &json!({}))?.slot;
    told(Progress::Restarting);
    back(client, RESTARTING, &|now| now.slot != slot && now.trial.is_none(), &|_| false)
}

/// What is done with an update file.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Plan {
    /// Put it on trial, for so many seconds.
    pub trial_s: Option<u32>,
    /// Confirm it once the board does as well as before.
    pub confirm: bool,
    /// Whether it may be older than what runs.
    pub downgrade: Downgrade,
}

/// `update FILE`: all that the plan says, for one board.
///
/// # Errors
/// A step is refused, or its end is not seen in time.
pub fn update(
    client: &Client,
    file: &Update,
    plan: Plan,
    told: &mut dyn FnMut(&str),
) -> Result<Answer, Failure> {
    let board = Firmware::of(client)?;
    let link = fitting(client, &board, file)?;
    let (now, new, slot) = (&board.version, link.header.version(), link.header.slot());
    told(&format!("{now} runs on this {}; {new} goes into slot {slot:?}", board.board));
    let mut shown = String::new();
    let mut progress = |step: Progress| {
        let line = step.words();
        // A line says something new.
        if line != shown {
            told(&line);
            shown = line;
        }
    };
    let done = push(client, &link, plan.downgrade, &mut progress)?;
    let Some(trial_s) = plan.trial_s else {
        let text =
            format!("{new} is whole in slot {slot:?}; `update --try` with the same file runs it on trial\n");
        return Ok(answer(done, text));
    };
    let before = health(client)?;
    begin_trial(client, trial_s, plan.downgrade, &mut progress)?;
    let (on_trial, after) = settled(client, &before, plan.confirm, trial_s, &mut progress)?;
    let well = after.is_as_good_as(&before);
    let compared = format!("before: {before}\nafter:  {after}\n");
    if on_trial.trial.is_none() {
        return Ok(answer(on_trial, format!("{new} runs and is confirmed\n{compared}")).with_verdict(well));
    }
    if !plan.confirm {
        let text = format!(
            "{new} runs on trial and confirms itself once all is as before; `update --confirm` keeps it now, \
             `update --back` takes it back\n{compared}"
        );
        return Ok(answer(on_trial, text).with_verdict(well));
    }
    if !well {
        return Err(client.refused(format!(
            "not confirmed, because it does worse than before; it is taken back when its time is over\n{compared}"
        )));
    }
    let kept = confirm(client)?;
    Ok(answer(kept, format!("{new} runs and is confirmed\n{compared}")))
}

/// The board on trial and how it does: at once, or once it does as well as before.
fn settled(
    client: &Client,
    before: &Health,
    is_to_last: bool,
    trial_s: u32,
    progress: &mut dyn FnMut(Progress),
) -> Result<(Firmware, Health), Failure> {
    let until = Instant::now() + Duration::from_secs(trial_s.into());
    loop {
        let now = Firmware::of(client)?;
        let after = health(client)?;
        let Some(trial) = now.trial.clone() else {
            return match &now.last {
                Some((slot, how)) if how == "confirmed" && now.slot == Some(*slot) => Ok((now, after)),
                Some((_, how)) => Err(client.refused(format!("the trial has ended: {}", ended_words(how)))),
                None => Err(client.refused("nothing is on trial any more")),
            };
        };
        let is_over = !is_to_last || after.is_as_good_as(before) || Instant::now() > until;
        if is_over {
            return Ok((now, after));
        }
        progress(Progress::OnTrial(trial));
        if client.stop().wait(AGAIN) {
            return Err(client.refused("ended during the trial; `update --confirm` or `--back` ends it"));
        }
    }
}

/// `update` without a file: what the board says, after confirming or taking back if that is asked for.
///
/// # Errors
/// It is refused, or the board not reached.
pub fn shown(client: &Client) -> Result<Answer, Failure> {
    let firmware = Firmware::of(client)?;
    let text = firmware.text();
    Ok(answer(firmware, text))
}

/// `update --confirm` without a file.
///
/// # Errors
/// It is refused, or the board not reached.
pub fn confirmed(client: &Client) -> Result<Answer, Failure> {
    let firmware = confirm(client)?;
    let text = firmware.text();
    Ok(answer(firmware, text))
}

/// `update --back`.
///
/// # Errors
/// It is refused, or the board does not come back in time.
pub fn taken_back(client: &Client, told: &mut dyn FnMut(&str)) -> Result<Answer, Failure> {
    let firmware = take_back(client, &mut |step| told(&step.words()))?;
    let text = firmware.text();
    Ok(answer(firmware, text))
}

fn answer(firmware: Firmware, text: String) -> Answer {
    let is = if firmware.trial.is_some() { "on trial" } else { "" };
    let slot = firmware.slot.map_or_else(|| "-".to_owned(), |slot| format!("{slot:?}"));
    let row = vec![("firmware", firmware.version.clone().into()), ("slot", slot.into()), ("is", is.into())];
    Answer::new(firmware.document, text).with_row(row)
}

impl Firmware {
    fn text(&self) -> String {
        let mut text = format!("{} runs on this {}", self.version, self.board);
        if let Some(slot) = self.slot {
            text += &format!(", in slot {slot:?}");
        }
        text.push('\n');
        if let Some(why) = &self.cannot {
            text += &format!("it takes no update: {why}\n");
        }
        if let Some(Trial { left_s, waits_for }) = &self.trial {
            text +=
                &format!("on trial for {left_s:.0} s more; to confirm itself it waits for: {waits_for}\n");
        }
        if let Some(Incoming { state, length, received, why, .. }) = &self.incoming {
            text += &format!("another one: {state}, {received} of {length} bytes {why}\n");
        }
        if let Some((slot, how)) = &self.last {
            text += &format!("the last trial, in slot {slot:?}: {}\n", ended_words(how));
        }
        text
    }
}

impl Progress {
    /// A line for people.
    pub fn words(&self) -> String {
        match self {
            Self::Erasing => "the slot is being erased".to_owned(),
            Self::Sent { received, length } => {
                // In tens, so that a line is printed for each of them and not for each piece.
                let tenths = (received * 10).checked_div(*length).unwrap_or(10);
                format!("sent: {} %", tenths * 10)
            }
            Self::Checking => "the board computes the hash".to_owned(),
            Self::Restarting => "the safe values are out; the board restarts".to_owned(),
            Self::OnTrial(Trial { waits_for, .. }) => format!("on trial; it waits for: {waits_for}"),
        }
    }
}

impl fmt::Display for Health {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { word, links_up, ports_working } = self;
        write!(f, "{word}, {links_up} links up, {ports_working} ports working")
    }
}

fn post(client: &Client, path: &str, arguments: &Value) -> Result<Firmware, Failure> {
    let call = Call { more_time: REPLACING, ..Call::post(path, arguments) };
    answered(client, client.call(&call)?)
}

/// The board, once it is `there` again.
fn back(
    client: &Client,
    limit: Duration,
    there: &dyn Fn(&Firmware) -> bool,
    failed: &dyn Fn(&Firmware) -> bool,
) -> Result<Firmware, Failure> {
    let deadline = Instant::now() + limit;
    loop {
        // Its answer leaves before it restarts.
        if client.stop().wait(AGAIN) {
            return Err(
                client.refused("ended before the board was back; `ctl update` shows what became of it")
            );
        }
        let seen = Firmware::of(client);
        match &seen {
            Ok(firmware) if there(firmware) => return seen,
            Ok(firmware) if failed(firmware) => {
                let how = firmware.last.as_ref().map_or("failed", |(_, how)| how.as_str());
                return Err(client.refused(format!("the trial has ended: {}", ended_words(how))));
            }
            _ => {}
        }
        if Instant::now() > deadline {
            return Err(match seen {
                Err(failure) => failure,
                Ok(now) => client.refused(format!("it still runs {} without a trial", now.version)),
            });
        }
    }
}

/// How a trial ended, in words.
fn ended_words(ended: &str) -> &str {
    match ended {
        "confirmed" => "it was confirmed",
        "not_confirmed" => "it was not confirmed in time, and the firmware before runs",
        "taken_back" => "it was taken back, and the firmware before runs",
        "failed" => "the firmware did not run, and the one before does",
        other => other,
    }
}

fn more(downgrade: Downgrade, mark: char) -> String {
    match downgrade {
        Downgrade::Refused => String::new(),
        Downgrade::Allowed => format!("{mark}downgrade=yes"),
    }
}

/// Bytes of an image that are sent at once: as many as a board takes.
const PIECE: usize = 16 << 10;
/// How long a board may be away while a firmware is sent.
const AWAY: Duration = Duration::from_secs(60);
/// Time that a board may take to bring its safe values out and check a signature.
const REPLACING: Duration = Duration::from_secs(10);
/// Time that a board may take to start again: three starts that the watchdog ends, and the one before.
const RESTARTING: Duration = Duration::from_secs(60);
/// Time between two looks.
const AGAIN: Duration = Duration::from_millis(300);
