//! A real board of a rollout: the functions of one board's update (docs/api.md section 9).

use std::time::{Duration, Instant};

use super::{BoardInfo, BoardState, RolloutBoard};
use crate::client::Client;
use crate::failure::Failure;
use crate::firmware::Update;
use crate::fleet::Member;
use crate::stop::Stop;
use crate::update::{Downgrade, Firmware, Health, begin_trial, confirm, fitting, health, push, take_back};

/// A board of an inventory and the firmware for it.
#[derive(Debug)]
pub struct Real<'a> {
    member: &'a Member,
    update: &'a Update,
    timeout: Duration,
    trial_s: u32,
    downgrade: Downgrade,
    since: Instant,
}

/// The version of the firmware in an update.
pub fn version_of(update: &Update) -> Result<String, Failure> {
    let links = update.links();
    let version = links.first().map(|link| link.header.version().to_string());
    version.ok_or_else(|| Failure::wrong("the update contains no firmware"))
}

/// The gateways of an inventory as boards for this update, with their names.
pub fn real_boards<'a>(
    members: &'a [Member],
    update: &'a Update,
    timeout: Duration,
    trial_s: u32,
    downgrade: Downgrade,
) -> Result<Vec<(String, Real<'a>)>, Failure> {
    version_of(update)?;
    let since = Instant::now();
    let board = |member: &'a Member| {
        (member.name().to_owned(), Real { member, update, timeout, trial_s, downgrade, since })
    };
    Ok(members.iter().map(board).collect())
}

impl Real<'_> {
    /// A client without a stop request: a board that has begun is brought to its end.
    fn client(&self) -> Result<Client, Failure> {
        self.member.client(self.timeout, Stop::new())
    }
}

impl RolloutBoard for Real<'_> {
    fn inspect(&self) -> Result<BoardInfo, Failure> {
        let client = self.client()?;
        let firmware = Firmware::of(&client)?;
        let state = match (firmware.is_of(self.update), &firmware.trial) {
            (true, Some(_)) => BoardState::OnTrial,
            (false, Some(_)) => BoardState::OtherOnTrial,
            (true, None) => BoardState::Confirmed,
            (false, None) => {
                fitting(&client, &firmware, self.update)?;
                BoardState::Other
            }
        };
        Ok(BoardInfo { version: firmware.version, state })
    }

    fn health(&self) -> Result<Health, Failure> {
        health(&self.client()?)
    }

    fn push(&self) -> Result<(), Failure> {
        let client = self.client()?;
        let link = fitting(&client, &Firmware::of(&client)?, self.update)?;
        push(&client, &link, self.downgrade, &mut |_| {}).map(|_| ())
    }

    fn begin(&self) -> Result<(), Failure> {
        begin_trial(&self.client()?, self.trial_s, self.downgrade, &mut |_| {}).map(|_| ())
    }

    fn confirm(&self) -> Result<(), Failure> {
        confirm(&self.client()?).map(|_| ())
    }

    fn back(&self) -> Result<(), Failure> {
        take_back(&self.client()?, &mut |_| {}).map(|_| ())
    }

    fn now(&self) -> Duration {
        self.since.elapsed()
    }

    fn wait(&self, time: Duration) {
        std::thread::sleep(time);
    }
}
