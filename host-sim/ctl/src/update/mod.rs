//! The firmware of a board (docs/api.md section 9, docs/update.md).
//!
//! In: a board's client. Out: the state that the board reports, as [`Firmware`], and whether that is the firmware of a
//! file. The steps of an update are in `steps`, a whole update of one board in `command`.

mod command;
mod health;
mod steps;

use recipe_api::key::{Hex, from_hex};
use recipe_update::{PublicKey, Slot};
use serde_json::Value;

use crate::client::Client;
use crate::failure::Failure;
use crate::firmware::Update;
use crate::shown;

pub use command::{Plan, confirmed, shown, taken_back, update};
pub use health::{Health, health};
pub use steps::{UpdateProgress, begin_trial, confirm, fitting, push, take_back, wait_confirmed};

/// The state of a board's firmware: the document `update`.
#[derive(Debug, Clone, PartialEq)]
pub struct Firmware {
    /// The board's name, such as `nucleo-h743zi`.
    pub board: String,
    /// The version that runs.
    pub version: String,
    /// The first digits of the SHA-512 of the running firmware, which distinguish builds of one version; `None` if the
    /// board does not report them.
    pub sha512: Option<String>,
    /// The running slot; `None` if the board takes no updates.
    pub slot: Option<Slot>,
    /// Why the board takes no update.
    pub cannot: Option<String>,
    /// The key that the board's loader accepts.
    pub key: Option<PublicKey>,
    /// The trial of the running firmware.
    pub trial: Option<UpdateTrial>,
    /// The newest firmware that is being received or was received.
    pub incoming: Option<Incoming>,
    /// The slot and the result of the newest ended trial.
    pub last: Option<(Slot, String)>,
    /// The document itself.
    pub document: Value,
}

/// A firmware that runs on trial.
#[derive(Debug, Clone, PartialEq)]
pub struct UpdateTrial {
    /// Seconds until the firmware is taken back.
    pub left_s: f64,
    /// The condition for the firmware to confirm itself.
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
    /// The start of the next piece.
    pub received: u64,
    /// Why the transfer has failed.
    pub why: String,
}

/// Whether a firmware older than the running one is accepted.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Downgrade {
    /// The board refuses it.
    Refused,
    /// The user has allowed it.
    Allowed,
}

impl Firmware {
    /// Reads the state of the board's firmware.
    ///
    /// # Errors
    /// It is refused, such as by a gateway on a host, or the board is not reached.
    pub fn of(client: &Client) -> Result<Self, Failure> {
        Self::read(client, client.json("update")?)
    }

    pub(super) fn read(client: &Client, document: Value) -> Result<Self, Failure> {
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
            sha512: text(&document["sha512"]),
            slot: slot(&document["slot"]),
            cannot: text(&document["cannot"]),
            key: document["key"].as_str().and_then(from_hex).and_then(|bytes| PublicKey::parse(&bytes)),
            trial: trial.is_object().then(|| UpdateTrial {
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

    /// Whether the board runs the firmware of this file: the same version, and the same build as far as the board
    /// reports it.
    pub fn is_of(&self, update: &Update) -> bool {
        let links = update.links();
        let is_version = links.first().is_some_and(|link| link.header.version().to_string() == self.version);
        is_version && self.is_build_of(update) != Some(false)
    }

    /// Whether the running firmware is the image of this file for its slot; `None` if the board does not report the
    /// build, or the file has no image for that slot.
    pub fn is_build_of(&self, update: &Update) -> Option<bool> {
        let said = self.sha512.as_deref()?;
        let link = update.links().into_iter().find(|link| Some(link.header.slot()) == self.slot)?;
        let digits = Hex(&link.header.hash()[..]).to_string();
        // The board chooses how many of the first digits it reports.
        Some(!said.is_empty() && digits.starts_with(said))
    }
}
