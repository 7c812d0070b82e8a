//! The store task: writes configurations, their marks, the access key and settings.
//!
//! In: requests from the console and the edge node, and timeouts of trials. Out: writes to the store, a view for
//! readers, and the request to restart. Does not know the rules: `recipe_api::revisions` decides what happens when.
//!
//! Another configuration runs only after a restart: only the start has the memory to load it, and it counts the
//! attempts.

mod firmware;
mod handle;

use core::pin::pin;

use embassy_futures::select::{Either4, select4};
use embassy_time::{Duration, Instant, Timer};
use heapless::Vec;
use proto_core::time::Duration as Span;
use recipe_api::revisions::{Ended, Refused, Result as Done, Revision, RevisionOutput, Revisions, Stored};
use recipe_store::{KeepError, Store};
use recipe_update::SlotFlash;

use firmware::TrialState;
pub use handle::{Failed, FirmwareView, MAX_FAILURE, PART, StoreHandle, StoreLock, StoreRequest};

use super::gateway::Gateway;
use super::watchdog::Pulse;
use crate::clock::now;
use crate::fmt::DisplayText;
use crate::stored::{StoreFlash, StoredConfig};
use crate::update::{self, Updates, Works};
use crate::{error, info, warn};

/// Work that the start leaves to the store task.
#[derive(Debug, Default)]
pub struct StartWork<'d> {
    /// Digest and bytes of an image from outside the store that becomes the live one.
    pub adopt: Option<(u32, &'d [u8])>,
    /// Duration of the trial of the running configuration.
    pub trial: Option<Duration>,
    /// Number of the configuration that runs.
    pub running: Option<u32>,
    /// The configuration on trial cannot run.
    pub trial_failed: bool,
}

/// Serves requests until the board has to be restarted; the safe values have then been sent.
pub async fn run<F: StoreFlash, S: SlotFlash>(
    gateway: &Gateway,
    pulse: &Pulse,
    handle: &StoreHandle,
    stored: &mut StoredConfig<F>,
    updates: &mut Updates<S>,
    work: StartWork<'_>,
) {
    let mut running = work.running;
    if stored.is_to_be_moved() {
        info!("the store is moved out of the bank that the program runs from");
        let moved = pulse.idle(pin!(stored.move_home())).await;
        if let Err(error) = moved {
            error!("the store stays where it is: {}", DisplayText(&error));
        }
    }
    if let Some((digest, image)) = work.adopt {
        let adopted = pulse.idle(pin!(stored.adopt(digest, image))).await;
        match adopted {
            Ok(_) => {
                info!("the store has taken over the configuration");
                running = stored.store().marks().live;
            }
            Err(error) => error!("the store: {}", DisplayText(&error)),
        }
    }
    if work.trial_failed {
        let ended = pulse.idle(pin!(stored.end_trial(recipe_store::TrialEnd::Failed))).await;
        if let Err(error) = ended {
            error!("the store: {}", DisplayText(&error));
        }
    }
    let mut revisions = revisions_of(stored.store());
    if let (Some(revisions), Some(time), Some(number)) = (&mut revisions, work.trial, running) {
        revisions.resume_trial(number, now() + Span::from_micros(time.as_micros()));
    }
    let Some(revisions) = revisions else {
        error!("the store: its marks make no sense");
        pulse.idle(pin!(core::future::pending::<()>())).await;
        return;
    };
    handle.running.set(running);
    handle.revisions.replace(Some(revisions));
    let marks = stored.slots();
    let trial = marks.trial.filter(|trial| updates.running() == Some(trial.slot));
    let trial = trial.map(|trial| {
        warn!("this firmware is on trial for {} s", trial.confirm_s);
        update::FirmwareTrial::new(Instant::now(), trial.confirm_s, Works::of_code(trial.before))
    });
    StoreTask { handle, stored, updates, trial, trial_s: None }.work(gateway, pulse).await;
}

struct StoreTask<'a, F, S> {
    handle: &'a StoreHandle,
    stored: &'a mut StoredConfig<F>,
    updates: &'a mut Updates<S>,
    /// Trial of the running firmware.
    trial: Option<update::FirmwareTrial>,
    /// Length of the requested trial, in seconds.
    trial_s: Option<u16>,
}

/// What to do after the outputs were drained.
enum DrainResult {
    Sleep { until: proto_core::time::Instant },
    Restart,
}

impl<F: StoreFlash, S: SlotFlash> StoreTask<'_, F, S> {
    async fn work(&mut self, gateway: &Gateway, pulse: &Pulse) {
        loop {
            let drained = pulse.idle(pin!(self.drain(0, &mut None))).await;
            let mut until = match drained {
                DrainResult::Restart => return self.end(gateway, pulse).await,
                DrainResult::Sleep { until } => Instant::from_micros(until.as_micros()),
            };
            let judged = pulse.idle(pin!(self.judge(gateway))).await;
            let waits_for = match judged {
                TrialState::Restart => return self.end(gateway, pulse).await,
                TrialState::OnTrial(waits_for) => {
                    until = until.min(Instant::now() + LOOK);
                    Some(waits_for)
                }
                TrialState::Settled => None,
            };
            if self.updates.is_working() {
                // One step, then the next request.
                pulse.idle(pin!(self.updates.work())).await;
                until = Instant::now();
            }
            self.show(waits_for);
            let handle = self.handle;
            let next = select4(
                handle.requests.wait(),
                handle.part_requests.wait(),
                handle.session.wait(),
                Timer::at(until),
            );
            let next = pulse.idle(pin!(next)).await;
            match next {
                Either4::First(request) => {
                    let (result, is_restart) = pulse.idle(pin!(self.execute(gateway, request))).await;
                    self.show(waits_for);
                    handle.done.signal(result);
                    if is_restart {
                        // The lock is not released before the restart.
                        return self.end(gateway, pulse).await;
                    }
                    handle.is_taken.set(false);
                }
                Either4::Second((number, offset)) => {
                    let mut part = handle.part.borrow_mut();
                    let len = self.stored.image_part(number, offset, &mut part[..]).map(<[u8]>::len);
                    handle.part_len.signal(len);
                }
                Either4::Third(bd_seq) => {
                    let written = pulse.idle(pin!(self.stored.set_session(bd_seq))).await;
                    handle.session_kept.signal(written.is_ok());
                }
                Either4::Fourth(()) => {}
            }
        }
    }

    /// Sends the safe values, after the answer to the last request.
    async fn end(&self, gateway: &Gateway, pulse: &Pulse) {
        pulse.idle(pin!(Timer::after(LOG_TIME))).await;
        if !pulse.idle(pin!(gateway.make_safe(MAX_SAFE))).await {
            warn!("the controller does not show all safe values; restarting all the same");
        }
        info!("restarting");
        pulse.idle(pin!(Timer::after(LOG_TIME))).await;
    }

    /// Returns the result, and whether the board has to be restarted.
    async fn execute(&mut self, gateway: &Gateway, request: StoreRequest) -> (Result<u32, Failed>, bool) {
        if let Some(done) = self.of_firmware(gateway, &request).await {
            return done;
        }
        if let StoreRequest::Edge { len, restart, .. } = request {
            return self.keep_edge(len, restart).await;
        }
        let mut image_len = 0;
        let decided = {
            let mut revisions = self.handle.revisions.borrow_mut();
            let Some(revisions) = revisions.as_mut() else {
                return (Err(Failed::Refused(Refused::Busy)), false);
            };
            match request {
                StoreRequest::Claim(_)
                | StoreRequest::Piece { .. }
                | StoreRequest::TryFirmware { .. }
                | StoreRequest::ConfirmFirmware
                | StoreRequest::EndFirmware
                | StoreRequest::Edge { .. } => Ok(0),
                StoreRequest::Put { base, digest, len } => {
                    image_len = len;
                    revisions.put(base, digest)
                }
                StoreRequest::Apply { number, trial } => {
                    let seconds = trial.as_millis().div_ceil(1_000);
                    self.trial_s = Some(u16::try_from(seconds).unwrap_or(u16::MAX));
                    revisions.apply(number, trial)
                }
                StoreRequest::Confirm => revisions.confirm(now()),
                StoreRequest::RollBack => revisions.roll_back(),
            }
        };
        if let StoreRequest::Claim(key) = request {
            let taken = self.stored.set_access_key(&key).await;
            return (taken.map(|()| 0).map_err(Failed::Store), false);
        }
        let number = match decided {
            Ok(number) => number,
            Err(refused) => {
                self.trial_s = None;
                return (Err(Failed::Refused(refused)), false);
            }
        };
        let mut failed = None;
        let next = self.drain(image_len, &mut failed).await;
        let result = failed.map_or(Ok(number), |why| Err(Failed::Store(why)));
        (result, matches!(next, DrainResult::Restart))
    }

    /// Stores the settings of the edge node. A restart is refused during a trial.
    #[allow(clippy::await_holding_refcell_ref, reason = "the holder of the lock waits for the store task")]
    async fn keep_edge(&mut self, len: usize, restart: bool) -> (Result<u32, Failed>, bool) {
        let is_on_trial = self.handle.look(|revisions| revisions.trial().is_some()) == Some(true);
        if restart && (is_on_trial || self.trial.is_some()) {
            return (Err(Failed::Refused(Refused::OnTrial)), false);
        }
        let image = self.handle.image.borrow();
        let written = self.stored.set_edge(image.get(..len).unwrap_or(&[])).await;
        let is_restart = restart && written.is_ok();
        (written.map(|()| 0).map_err(Failed::Store), is_restart)
    }

    fn next_output(&self) -> RevisionOutput {
        let mut revisions = self.handle.revisions.borrow_mut();
        // Not `None` here: the revisions are set while the store task runs.
        let Some(revisions) = revisions.as_mut() else {
            return RevisionOutput::Sleep { until: proto_core::time::Instant::NEVER };
        };
        let before = revisions.last();
        let output = revisions.poll_output(now());
        if revisions.last() != before
            && let Some((_, Ended::NotConfirmed)) = revisions.last()
        {
            warn!("the configuration was not confirmed in time: back to the live one");
        }
        output
    }

    /// Executes the outputs of the revisions; keeps the first failure.
    #[allow(clippy::await_holding_refcell_ref, reason = "the holder of the lock waits for the store task")]
    async fn drain(&mut self, image_len: usize, failed: &mut Option<KeepError>) -> DrainResult {
        loop {
            let output = self.next_output();
            let (written, result) = match output {
                RevisionOutput::Sleep { until } => return DrainResult::Sleep { until },
                RevisionOutput::Store { revision: Revision { number, digest }, forget } => {
                    let image = self.handle.image.borrow();
                    let image = image.get(..image_len).unwrap_or(&[]);
                    let written = self.stored.keep(number, digest, image, forget).await;
                    // Older ones may have been forgotten to make room.
                    if let Some(revisions) = self.handle.revisions.borrow_mut().as_mut() {
                        revisions.keep_only(|number| {
                            number == NOTHING.number || self.stored.store().revision(number).is_some()
                        });
                    }
                    let is_done = written.is_ok();
                    (written, Done::Stored(is_done))
                }
                RevisionOutput::Mark { live, previous } => {
                    let written =
                        self.stored.make_live(live, (previous != NOTHING.number).then_some(previous)).await;
                    let is_done = written.is_ok();
                    (written, Done::Marked(is_done))
                }
                // The trial was not started; the same configuration still runs.
                RevisionOutput::Run { number } if self.is_running(number) => (Ok(()), Done::Started(true)),
                RevisionOutput::Run { number } => {
                    let (live, ended) = self.live_and_ended();
                    let written = match self.trial_s.take() {
                        Some(confirm_s) => self.stored.begin_trial(number, confirm_s).await,
                        None if number == live => {
                            // Starts of a trial are counted, so it ends even if this write fails.
                            if let Err(error) = self.stored.end_trial(ended).await {
                                error!("the store: {}", DisplayText(&error));
                            }
                            return DrainResult::Restart;
                        }
                        None => self.stored.make_live(number, Some(live)).await,
                    };
                    if written.is_ok() {
                        return DrainResult::Restart;
                    }
                    (written, Done::Started(false))
                }
            };
            if let Err(error) = written {
                error!("the store: {}", DisplayText(&error));
                failed.get_or_insert(error);
            }
            if let Some(revisions) = self.handle.revisions.borrow_mut().as_mut() {
                revisions.handle(now(), result);
            }
        }
    }

    fn is_running(&self, number: u32) -> bool {
        self.handle.running.get().unwrap_or(NOTHING.number) == number
    }

    /// The live configuration, and how the last trial ended.
    fn live_and_ended(&self) -> (u32, recipe_store::TrialEnd) {
        let revisions = self.handle.revisions.borrow();
        let revisions = revisions.as_ref();
        let ended = match revisions.and_then(Revisions::last) {
            Some((_, Ended::NotConfirmed)) => recipe_store::TrialEnd::NotConfirmed,
            Some((_, Ended::TakenBack)) => recipe_store::TrialEnd::TakenBack,
            _ => recipe_store::TrialEnd::Failed,
        };
        (revisions.map_or(NOTHING.number, Revisions::live), ended)
    }
}

/// The revisions in a store; [`NOTHING`] is live until one is confirmed.
fn revisions_of(store: &Store) -> Option<Revisions> {
    let marks = store.marks();
    let mut stored = Stored { kept: Vec::new(), live: NOTHING.number, previous: marks.previous };
    let all = store.revisions();
    match marks.live {
        Some(live) => stored.live = live,
        None => stored.kept.push(NOTHING).ok()?,
    }
    // `NOTHING` takes one place; the oldest revision is left out.
    let left_out = all.len().saturating_sub(stored.kept.capacity().saturating_sub(stored.kept.len()));
    for kept in all.iter().skip(left_out) {
        stored.kept.push(Revision { number: kept.number, digest: kept.digest }).ok()?;
    }
    let mut revisions = Revisions::new(stored)?;
    revisions.resume_last(marks.last.map(|(number, ended)| {
        let ended = match ended {
            recipe_store::TrialEnd::Confirmed => Ended::Confirmed,
            recipe_store::TrialEnd::NotConfirmed => Ended::NotConfirmed,
            recipe_store::TrialEnd::TakenBack => Ended::TakenBack,
            recipe_store::TrialEnd::Failed => Ended::Failed,
        };
        (number, ended)
    }));
    Some(revisions)
}

/// Stands for no configuration. It is the base revision of the first configuration of an empty board.
pub const NOTHING: Revision = Revision { number: 0, digest: 0 };
/// Polling interval of a firmware trial.
const LOOK: Duration = Duration::from_secs(1);
/// Time for replies and log lines to be sent.
const LOG_TIME: Duration = Duration::from_millis(200);
/// Limit of sending safe values: how long they are repeated if nothing shows them (proto-core/docs/engine.md section
/// 6).
const MAX_SAFE: Duration = Duration::from_secs(1);
