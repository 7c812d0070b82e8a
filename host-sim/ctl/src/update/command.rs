//! `ctl update` for one board, with its messages.

use std::time::{Duration, Instant};

use super::steps::{AGAIN, ended_words};
use super::{
    Downgrade, Firmware, Health, Incoming, UpdateProgress, UpdateTrial, begin_trial, confirm, fitting,
    health, push, take_back,
};
use crate::answer::Answer;
use crate::client::Client;
use crate::failure::Failure;
use crate::firmware::Update;

/// What to do with an update file.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Plan {
    /// Put it on trial for this many seconds.
    pub trial_s: Option<u32>,
    /// Confirm it once the board is as healthy as before.
    pub confirm: bool,
    /// Whether it may be older than the running firmware.
    pub downgrade: Downgrade,
}

/// `update FILE`: the whole plan for one board.
///
/// # Errors
/// A step is refused, or does not end in time.
pub fn update(
    client: &Client,
    file: &Update,
    plan: Plan,
    notify: &mut dyn FnMut(&str),
) -> Result<Answer, Failure> {
    let board = Firmware::of(client)?;
    if board.is_of(file) && board.is_build_of(file) == Some(true) && board.trial.is_none() {
        let text = format!("{} runs already, this very build; nothing was sent\n", board.version);
        return Ok(answer(board, text));
    }
    let link = fitting(client, &board, file)?;
    let (now, new, slot) = (&board.version, link.header.version(), link.header.slot());
    notify(&format!("{now} runs on this {}; {new} goes into slot {slot:?}", board.board));
    let mut shown = String::new();
    let mut progress = |step: UpdateProgress| {
        let line = step.words();
        // Print only lines that change.
        if line != shown {
            notify(&line);
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

/// The board on trial and its health: at once, or once it is as healthy as before.
fn settled(
    client: &Client,
    before: &Health,
    is_to_last: bool,
    trial_s: u32,
    progress: &mut dyn FnMut(UpdateProgress),
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
        progress(UpdateProgress::OnTrial(trial));
        if client.stop().wait(AGAIN) {
            return Err(client.refused("ended during the trial; `update --confirm` or `--back` ends it"));
        }
    }
}

/// `update` without a file: the state of the board.
pub fn shown(client: &Client) -> Result<Answer, Failure> {
    let firmware = Firmware::of(client)?;
    let text = firmware.text();
    Ok(answer(firmware, text))
}

/// `update --confirm` without a file.
pub fn confirmed(client: &Client) -> Result<Answer, Failure> {
    let firmware = confirm(client)?;
    let text = firmware.text();
    Ok(answer(firmware, text))
}

/// `update --back`.
///
/// # Errors
/// The request is refused, or the board does not come back in time.
pub fn taken_back(client: &Client, notify: &mut dyn FnMut(&str)) -> Result<Answer, Failure> {
    let firmware = take_back(client, &mut |step| notify(&step.words()))?;
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
        if let Some(digits) = &self.sha512 {
            text += &format!(", build {digits}");
        }
        text.push('\n');
        if let Some(why) = &self.cannot {
            text += &format!("it takes no update: {why}\n");
        }
        if let Some(UpdateTrial { left_s, waits_for }) = &self.trial {
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
