//! The steps of an update, each with its end: sent, tried, confirmed, taken back. They can be combined for many boards.

use std::time::{Duration, Instant};

use recipe_update::SlotImage;
use serde_json::{Value, json};

use super::{Downgrade, Firmware, UpdateTrial};
use crate::client::{Call, Client, RequestBody};
use crate::failure::Failure;
use crate::firmware::Update;
use crate::http::HttpReply;

/// Progress of sending and trying a firmware.
#[derive(Debug, Clone, PartialEq)]
pub enum UpdateProgress {
    /// The slot is being erased.
    Erasing,
    /// The board has received this many bytes.
    Sent {
        /// Received bytes.
        received: u64,
        /// Total number of bytes.
        length: u64,
    },
    /// The board computes the hash.
    Checking,
    /// The board restarts.
    Restarting,
    /// The board runs the firmware on trial; `waits_for` says what is missing until it confirms itself.
    OnTrial(UpdateTrial),
}

impl UpdateProgress {
    /// One line for people.
    pub fn words(&self) -> String {
        match self {
            Self::Erasing => "the slot is being erased".to_owned(),
            Self::Sent { received, length } => {
                // In steps of ten per cent, so a line is not printed for each piece.
                let tenths = (received * 10).checked_div(*length).unwrap_or(10);
                format!("sent: {} %", tenths * 10)
            }
            Self::Checking => "the board computes the hash".to_owned(),
            Self::Restarting => "the safe values are out; the board restarts".to_owned(),
            Self::OnTrial(UpdateTrial { waits_for, .. }) => format!("on trial; it waits for: {waits_for}"),
        }
    }
}

/// The part of an update file that this board takes.
///
/// # Errors
/// The board takes no update, or not this file: another board, no image for its free slot, damaged, or not signed with
/// the key of its loader.
pub fn fitting<'u>(client: &Client, board: &Firmware, update: &'u Update) -> Result<SlotImage<'u>, Failure> {
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

/// Sends a firmware into the free slot, or its missing part, until the board has computed its hash. The running
/// firmware is not changed.
///
/// # Errors
/// The firmware is refused, damaged in transit, or the board was not reached for a minute.
pub fn push(
    client: &Client,
    link: &SlotImage<'_>,
    downgrade: Downgrade,
    progress: &mut dyn FnMut(UpdateProgress),
) -> Result<Firmware, Failure> {
    let length = (link.header_bytes.len() + link.image.len()) as u64;
    let mut lost: Option<Instant> = None;
    // The start of the next piece; `None` while the board is busy.
    let mut next = Some(0);
    loop {
        let asked = match next {
            Some(offset) => put(client, link, offset, downgrade),
            None => client.call(&Call::get("update")),
        };
        let firmware = match asked {
            Ok(reply) => Firmware::read(client, client.document(&client.accepted(reply)?)?)?,
            Err(failure) => {
                let since = *lost.get_or_insert_with(Instant::now);
                if since.elapsed() > AWAY || client.stop().wait(AGAIN) {
                    return Err(failure);
                }
                // The board's reply to the header shows whether it has restarted meanwhile.
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
                progress(UpdateProgress::Sent { received: incoming.received, length });
                if client.stop().is_asked() {
                    return Err(client.refused("ended; the same command goes on where this one has"));
                }
                continue;
            }
            "erasing" => progress(UpdateProgress::Erasing),
            _ => progress(UpdateProgress::Checking),
        }
        if client.stop().wait(AGAIN) {
            return Err(client.refused("ended; the same command goes on where this one has"));
        }
    }
}

/// Sends the piece of a firmware that begins at an offset.
fn put(
    client: &Client,
    link: &SlotImage<'_>,
    offset: u64,
    downgrade: Downgrade,
) -> Result<HttpReply, Failure> {
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
    client.call(&Call { method: "PUT", body: RequestBody::Image(piece), ..Call::get(&path) })
}

/// Runs the received firmware on trial: returns when the board has restarted with it.
///
/// # Errors
/// The trial is refused, or the board does not come back with the firmware in time.
pub fn begin_trial(
    client: &Client,
    confirm_s: u32,
    downgrade: Downgrade,
    progress: &mut dyn FnMut(UpdateProgress),
) -> Result<Firmware, Failure> {
    let before = Firmware::of(client)?;
    let path = format!("update/try{}", more(downgrade, '?'));
    post(client, &path, &json!({ "confirm_s": confirm_s }))?;
    progress(UpdateProgress::Restarting);
    // After that time the trial ends by itself; restarts take additional time.
    let there = |now: &Firmware| now.trial.is_some();
    let failed = |now: &Firmware| {
        // Two trials of one slot may end alike. The board reports the received bytes until the restart.
        let has_restarted = before.incoming.is_some() && now.incoming.is_none();
        let tried = now.last.as_ref().map(|(slot, _)| *slot);
        let is_of_this_trial = now.last != before.last || has_restarted && tried != now.slot;
        is_of_this_trial && now.trial.is_none() && now.slot == before.slot && now.last.is_some()
    };
    back(client, RESTARTING, &there, &failed)
}

/// Waits until the firmware on trial has been confirmed, by itself or by a user.
///
/// # Errors
/// The trial has ended without confirmation.
pub fn wait_confirmed(
    client: &Client,
    progress: &mut dyn FnMut(UpdateProgress),
) -> Result<Firmware, Failure> {
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
        progress(UpdateProgress::OnTrial(trial));
        if client.stop().wait(AGAIN) {
            return Err(client.refused("ended during the trial; `ctl update --confirm` or `--back` ends it"));
        }
        seen = match Firmware::of(client) {
            Ok(seen) => seen,
            // The board is restarting.
            Err(_) => back(client, RESTARTING + Duration::from_secs_f64(left), &|_| true, &|_| false)?,
        };
    }
}

/// Confirms the firmware on trial.
pub fn confirm(client: &Client) -> Result<Firmware, Failure> {
    post(client, "update/confirm", &json!({}))
}

/// Takes the firmware on trial back: returns when the board runs the previous one.
///
/// # Errors
/// The request is refused, or the board does not come back in time.
pub fn take_back(client: &Client, progress: &mut dyn FnMut(UpdateProgress)) -> Result<Firmware, Failure> {
    let slot = post(client, "update/back", &json!({}))?.slot;
    progress(UpdateProgress::Restarting);
    back(client, RESTARTING, &|now| now.slot != slot && now.trial.is_none(), &|_| false)
}

fn post(client: &Client, path: &str, arguments: &Value) -> Result<Firmware, Failure> {
    Firmware::read(client, client.ask(&Call { more_time: REPLACING, ..Call::post(path, arguments) })?)
}

/// The board, once `there` is true for it.
fn back(
    client: &Client,
    limit: Duration,
    there: &dyn Fn(&Firmware) -> bool,
    failed: &dyn Fn(&Firmware) -> bool,
) -> Result<Firmware, Failure> {
    let deadline = Instant::now() + limit;
    loop {
        // The board answers before it restarts.
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

pub(super) fn ended_words(ended: &str) -> &str {
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

/// Maximum bytes of an image in a request, the most that a board takes.
const PIECE: usize = 16 << 10;
/// How long a board may be unreachable while a firmware is sent.
const AWAY: Duration = Duration::from_secs(60);
/// Time that a board may take to send its safe values and check a signature.
const REPLACING: Duration = Duration::from_secs(10);
/// Time that a board may take to restart: three starts that the watchdog ends, and the previous firmware's start.
const RESTARTING: Duration = Duration::from_secs(60);
pub(super) const AGAIN: Duration = Duration::from_millis(300);
