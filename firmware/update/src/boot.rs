//! Which slot a loader runs, and the marks of a trial (docs/update.md section 4).

use core::fmt;

use recipe_store::{Slot, SlotMarks, SlotTrial, TrialEnd};

use crate::SlotFlash;
use crate::check::{BadImage, Check, header};
use crate::header::{BoardName, Header, PublicKey};

/// Number of starts that a trial has: one, and two more in case of power cuts.
pub const STARTS: u8 = 3;

/// The loader's access to its board.
pub trait Machine {
    /// The flash of a slot.
    type Flash: SlotFlash;

    /// The flash of this slot.
    fn flash(&self, slot: Slot) -> &Self::Flash;

    /// Writes marks to the store; returns whether that succeeded.
    fn mark(&mut self, marks: SlotMarks) -> bool;

    /// Reports why a slot is not run, for a log or an LED.
    fn passed_over(&mut self, slot: Slot, why: &dyn fmt::Display);
}

/// The firmware to run.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Chosen {
    /// The slot it is in.
    pub slot: Slot,
    /// The header of its slot.
    pub header: Header,
    /// Whether it is on trial.
    pub is_trial: bool,
}

/// Chooses the slot to run. The slot on trial comes first if it has a start left, which is counted before the slot is
/// checked; then the good slot; then the other one. Returns `None` if no slot can run. `marks` is `None` if there is no
/// store; then nothing is on trial.
///
/// The good slot is checked for damage only. The signature of other slots is checked too.
pub fn choose(
    machine: &mut impl Machine,
    marks: Option<SlotMarks>,
    board: &BoardName,
    key: &PublicKey,
) -> Option<Chosen> {
    let mut now = marks.unwrap_or_default();
    if let Some(trial) = now.trial
        && let Some(chosen) = on_trial(machine, &mut now, trial, board, key)
    {
        return Some(chosen);
    }
    if let Some(slot) = now.good {
        match damage(machine.flash(slot), slot, board) {
            Ok(header) => return Some(Chosen { slot, header, is_trial: false }),
            Err(bad) => machine.passed_over(slot, &bad),
        }
    }
    for slot in Slot::ALL.into_iter().filter(|slot| now.good != Some(*slot)) {
        match origin(machine.flash(slot), slot, board, key) {
            Ok(header) => {
                // From now on this slot is the one to fall back to.
                if marks.is_some() {
                    machine.mark(SlotMarks { good: Some(slot), trial: None, ..now });
                }
                return Some(Chosen { slot, header, is_trial: false });
            }
            Err(bad) => machine.passed_over(slot, &bad),
        }
    }
    None
}

/// Returns the slot on trial if it may run; otherwise ends the trial.
fn on_trial(
    machine: &mut impl Machine,
    now: &mut SlotMarks,
    trial: SlotTrial,
    board: &BoardName,
    key: &PublicKey,
) -> Option<Chosen> {
    let slot = trial.slot;
    let failed = SlotMarks { trial: None, last: Some((slot, TrialEnd::Failed)), ..*now };
    let Some(attempts) = trial.attempts.checked_sub(1) else {
        machine.passed_over(slot, &"it has used up its starts");
        machine.mark(failed);
        *now = failed;
        return None;
    };
    // The start is counted before the slot is read or run, so the trial ends whatever goes wrong.
    let counted = SlotMarks { trial: Some(SlotTrial { attempts, ..trial }), ..*now };
    if !machine.mark(counted) {
        machine.passed_over(slot, &"its start cannot be counted");
        return None;
    }
    *now = counted;
    match origin(machine.flash(slot), slot, board, key) {
        Ok(header) => Some(Chosen { slot, header, is_trial: true }),
        Err(bad) => {
            machine.passed_over(slot, &bad);
            machine.mark(failed);
            *now = failed;
            None
        }
    }
}

/// Checks the good slot for damage only.
fn damage(flash: &impl SlotFlash, slot: Slot, board: &BoardName) -> Result<Header, BadImage> {
    let header = header(flash, slot, board)?;
    Check::damage(header).whole(flash)?;
    Ok(header)
}

/// Checks damage, hash and signature of a slot that is not known to be good.
fn origin(
    flash: &impl SlotFlash,
    slot: Slot,
    board: &BoardName,
    key: &PublicKey,
) -> Result<Header, BadImage> {
    let header = header(flash, slot, board)?;
    // The signature is checked before the hash of the image, which takes longer.
    header.verify(key).map_err(|_| BadImage::Foreign)?;
    Check::contents(header).whole(flash)?;
    Ok(header)
}

/// The marks with this slot on trial: the next start runs it. `before` is kept for the firmware on trial.
#[must_use]
pub fn begin_trial(marks: SlotMarks, slot: Slot, confirm_s: u16, before: u8) -> SlotMarks {
    SlotMarks { trial: Some(SlotTrial { slot, attempts: STARTS, confirm_s, before }), ..marks }
}

/// The marks after the firmware in this slot was confirmed; `None` if it is not on trial.
pub fn confirm(marks: SlotMarks, running: Slot) -> Option<SlotMarks> {
    marks.trial.filter(|trial| trial.slot == running)?;
    Some(SlotMarks { good: Some(running), trial: None, last: Some((running, TrialEnd::Confirmed)) })
}

/// The marks after a trial has ended in another way: the next start runs the good slot. `None` if nothing is on
/// trial.
pub fn end_trial(marks: SlotMarks, ended: TrialEnd) -> Option<SlotMarks> {
    let trial = marks.trial?;
    Some(SlotMarks { trial: None, last: Some((trial.slot, ended)), ..marks })
}
