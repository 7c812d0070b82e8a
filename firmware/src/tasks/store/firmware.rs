//! Firmware updates in the store task: pieces, trials and their end.

use embassy_time::Instant;
use proto_core::engine::PortState;
use proto_core::link::LinkState;
use recipe_store::{SlotMarks, TrialEnd};
use recipe_update::{SlotFlash, begin_trial, confirm, end_trial};

use super::super::gateway::Gateway;
use super::{Failed, FirmwareView, MAX_SAFE, StoreRequest, StoreTask};
use crate::fmt::DisplayText;
use crate::stored::{StoreFlash, image_version};
use crate::update::{TrialVerdict, UpdateError, WaitsFor, Works};
use crate::{error, info, warn};

pub(super) enum TrialState {
    /// Nothing is on trial.
    Settled,
    /// The trial goes on.
    OnTrial(WaitsFor),
    /// The board must restart with the previous firmware.
    Restart,
}

fn works(gateway: &Gateway) -> Works {
    gateway.report(|status| {
        let is_up = |state| matches!(state, LinkState::Up { .. } | LinkState::Shared);
        let links = status.links().filter(|link| is_up(link.state)).count();
        let ports = status.ports().filter(|port| port.state == PortState::Working).count();
        let byte = |count| u8::try_from(count).unwrap_or(u8::MAX);
        Works { links: byte(links), ports: byte(ports) }
    })
}

impl<F: StoreFlash, S: SlotFlash> StoreTask<'_, F, S> {
    /// Checks the trial of the running firmware; confirms or ends it.
    pub(super) async fn judge(&mut self, gateway: &Gateway) -> TrialState {
        let Some(trial) = &mut self.trial else { return TrialState::Settled };
        match trial.look(Instant::now(), works(gateway), self.handle.was_reached.get()) {
            TrialVerdict::Waits(waits_for) => TrialState::OnTrial(waits_for),
            TrialVerdict::Confirmed => match self.confirm_firmware().await {
                Ok(_) => TrialState::Settled,
                // Retried at the next check until the trial expires.
                Err(_) if self.trial.is_some_and(|trial| Instant::now() < trial.until()) => {
                    TrialState::OnTrial(WaitsFor::Time)
                }
                Err(_) => self.over(TrialEnd::NotConfirmed).await,
            },
            TrialVerdict::Over => {
                warn!("the firmware was not confirmed in time: back to the one before");
                self.over(TrialEnd::NotConfirmed).await
            }
        }
    }

    async fn over(&mut self, ended: TrialEnd) -> TrialState {
        // Starts of a trial are counted, so it ends even if this write fails.
        if let Some(marks) = end_trial(self.stored.slots(), ended)
            && let Err(error) = self.stored.mark_slots(marks).await
        {
            error!("the store: {}", DisplayText(&error));
        }
        TrialState::Restart
    }

    async fn confirm_firmware(&mut self) -> Result<u32, Failed> {
        let running = self.updates.running();
        let marks = running.and_then(|running| confirm(self.stored.slots(), running));
        let marks = marks.ok_or(Failed::Firmware(UpdateError::NotOnTrial))?;
        self.stored.mark_slots(marks).await.map_err(|error| {
            error!("the store: {}", DisplayText(&error));
            Failed::Store(error)
        })?;
        self.trial = None;
        info!("the firmware is confirmed");
        Ok(0)
    }

    pub(super) fn show(&self, waits_for: Option<WaitsFor>) {
        let updates = &self.updates;
        let trial = self.trial.map(|trial| (trial.until(), waits_for.unwrap_or(WaitsFor::Time)));
        self.handle.firmware.set(Some(FirmwareView {
            board: *updates.board(),
            slot: updates.running(),
            build: updates.build(),
            cannot: updates.cannot(),
            key: updates.key(),
            marks: self.stored.slots(),
            trial,
            other: updates.other().copied(),
            incoming: updates.incoming(),
        }));
    }

    /// Executes a request about the firmware; `None` if it is about something else. Returns what `execute` returns.
    pub(super) async fn of_firmware(
        &mut self,
        gateway: &Gateway,
        request: &StoreRequest,
    ) -> Option<(Result<u32, Failed>, bool)> {
        let refused = |why| Some((Err(Failed::Firmware(why)), false));
        let marks = self.stored.slots();
        match request {
            StoreRequest::Put { len, .. } => {
                let version = image_version(self.handle.image.borrow().get(..*len).unwrap_or(&[]));
                match self.updates.may_keep(version.unwrap_or(0), marks) {
                    Ok(()) => None,
                    Err(why) => refused(why),
                }
            }
            StoreRequest::Piece { offset, len, downgrade } => {
                Some((self.take_piece(*offset, *len, marks, *downgrade).await, false))
            }
            StoreRequest::TryFirmware { confirm_s, downgrade } => {
                if self.handle.look(|revisions| revisions.trial().is_some()) != Some(false) {
                    return refused(UpdateError::Unsettled);
                }
                let header = match self.updates.ready(self.stored.versions(), marks, *downgrade) {
                    Ok(header) => header,
                    Err(why) => return refused(why),
                };
                let before = works(gateway).code();
                // From here on the board restarts whatever the result: checking a signature blocks all tasks, and a
                // gateway that has sent its safe values cannot continue.
                if !gateway.make_safe(MAX_SAFE).await {
                    warn!("the controller does not show all safe values");
                }
                if let Err(why) = self.updates.verify(&header) {
                    warn!("the firmware that was received was signed with another key");
                    return Some((Err(Failed::Firmware(why)), true));
                }
                let marks = begin_trial(marks, header.slot(), *confirm_s, before);
                let marked = self.stored.mark_slots(marks).await;
                Some((marked.map(|()| 0).map_err(Failed::Store), true))
            }
            StoreRequest::ConfirmFirmware => Some((self.confirm_firmware().await, false)),
            StoreRequest::EndFirmware if self.trial.is_none() => refused(UpdateError::NotOnTrial),
            StoreRequest::EndFirmware => {
                self.over(TrialEnd::TakenBack).await;
                Some((Ok(0), true))
            }
            StoreRequest::Apply { .. }
            | StoreRequest::Confirm
            | StoreRequest::RollBack
            | StoreRequest::Claim(_)
            | StoreRequest::Edge { .. } => None,
        }
    }

    #[allow(clippy::await_holding_refcell_ref, reason = "the holder of the lock waits for the store task")]
    async fn take_piece(
        &mut self,
        offset: u32,
        len: usize,
        marks: SlotMarks,
        downgrade: recipe_update::Downgrade,
    ) -> Result<u32, Failed> {
        let versions = self.stored.versions();
        let image = self.handle.image.borrow();
        let bytes = image.get(..len).unwrap_or(&[]);
        self.updates.take(offset, bytes, versions, marks, downgrade).await.map_err(Failed::Firmware)?;
        Ok(0)
    }
}
