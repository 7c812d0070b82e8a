//! The gateway's configurations: runs one, tries another, returns to the previous one.
//!
//! In: commands of the console. Out: gateways that are started and ended, files, and a view for readers. Does not know
//! when to do what: `recipe_api::revisions` decides. A thread of its own executes it, because starting and ending a
//! gateway takes time.

use std::collections::BTreeMap;
use std::net::IpAddr;
use std::path::{Path, PathBuf};
use std::sync::mpsc::RecvTimeoutError;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError, mpsc as blocking};
use std::thread::JoinHandle;
use std::time::Duration as StdDuration;

use proto_core::config::GatewayConfig;
use proto_core::time::{Duration, Instant};
use recipe_api::revisions::{Ended, Refused, Result as Done, Revision, RevisionOutput, Revisions};
use recipe_io::bind::Bind;
use recipe_io::handover::Handover;
use recipe_io::realtime::Scheduling;
use recipe_io::timer::now;
use serde_json::{Value, json};
use tokio::sync::oneshot;
use tracing::{error, info, warn};

use super::check::{self, Prepared};
use super::store::{RevisionEntry, RevisionStore, digest};
use super::{Bound, Console, ConsoleOptions, ConsoleSource};
use crate::client::RuntimeClient;
use crate::gateway::{self, Observers};
use crate::host::{ForegroundRun, Handle};
use crate::publisher::SnapshotWatch;
use crate::snapshot::SnapshotSlot;
use crate::worker::RuntimePlace;
use crate::{RunError, RunOptions};

/// The configuration that a gateway was started with.
#[derive(Debug, Clone)]
pub struct ConfigFile {
    /// Name of the file.
    pub name: String,
    /// Text of the file.
    pub toml: String,
    /// Overrides, which apply to every revision.
    pub overrides: Vec<String>,
}

impl ConfigFile {
    /// Reads a file.
    pub fn read(path: &Path, overrides: Vec<String>) -> Result<Self, RunError> {
        let name = path.display().to_string();
        match std::fs::read_to_string(path) {
            Ok(toml) => Ok(Self { name, toml, overrides }),
            Err(error) => Err(RunError::new(format!("{name}: cannot be read: {error}"))),
        }
    }
}

#[derive(Debug)]
pub(crate) struct SupervisorCommand {
    pub(super) peer: IpAddr,
    pub(super) what: SupervisorAction,
    /// Gets the number of the revision.
    pub(super) answer: oneshot::Sender<Result<u32, ActionError>>,
}

#[derive(Debug)]
pub(super) enum SupervisorAction {
    /// Store a text that was derived from revision `base`.
    Put {
        base: Revision,
        toml: String,
    },
    /// Run one on trial.
    Apply {
        number: Option<u32>,
        trial: Duration,
    },
    Confirm,
    /// Return to the previous revision.
    RollBack,
    Shutdown,
}

#[derive(Debug)]
pub(super) enum ActionError {
    Refused(Refused),
    /// An attempt failed, for this reason.
    Tried(String),
}

#[derive(Debug, Default)]
pub(crate) struct SupervisorView {
    pub(super) revisions: Option<Revisions>,
    /// Metadata of the revisions, the oldest first.
    pub(super) entries: Vec<RevisionEntry>,
    pub(super) texts: BTreeMap<u32, Arc<str>>,
    /// The addresses of what runs, as in the line `ready`.
    pub(super) ready: Value,
    /// Why the newest revision that failed to start failed.
    pub(super) failure: Option<String>,
    /// Overrides, which apply to every revision.
    pub(super) overrides: Vec<String>,
    pub(super) config: Option<Arc<GatewayConfig>>,
    client: Option<RuntimeClient>,
    slot: Option<Arc<SnapshotSlot>>,
}

impl SupervisorView {
    pub(super) fn running_text(&self) -> Option<Arc<str>> {
        self.config.as_ref()?;
        self.texts.get(&self.revisions.as_ref()?.running()?).cloned()
    }
}

#[derive(Debug, Default)]
pub(crate) struct SharedView(Mutex<SupervisorView>);

impl SharedView {
    pub(super) fn view(&self) -> MutexGuard<'_, SupervisorView> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Snapshot slot and configuration of the running gateway.
    pub(super) fn running(&self) -> Option<(Arc<SnapshotSlot>, Arc<GatewayConfig>)> {
        let view = self.view();
        view.slot.clone().zip(view.config.clone())
    }
}

/// A gateway with a console. Dropping it ends both.
#[derive(Debug)]
pub(crate) struct Supervised {
    ready: Value,
    shared: Arc<SharedView>,
    commands: blocking::Sender<SupervisorCommand>,
    thread: Option<JoinHandle<Result<(), RunError>>>,
    /// Dropped first, so no requests are answered during the shutdown.
    console: Option<Console>,
}

impl Supervised {
    pub(crate) fn start(
        file: ConfigFile,
        options: &RunOptions,
        console: &ConsoleOptions,
        snapshot_watch: Option<SnapshotWatch>,
        place: RuntimePlace,
    ) -> Result<Self, RunError> {
        let bound = console.bind()?;
        let store = RevisionStore::open(console.state.as_deref(), (&file.name, &file.toml))?;
        let Some(revisions) = store.revisions() else {
            return Err(RunError::new("--console-state: the revisions make no sense"));
        };
        let shared = Arc::<SharedView>::default();
        let (commands, inbox) = blocking::channel();
        let supervisor = Supervisor {
            store,
            revisions,
            running: None,
            shared: Arc::clone(&shared),
            overrides: file.overrides,
            state: console.state.clone(),
            binds: options.binds.clone(),
            scheduling: options.scheduling,
            handover: Handover::default(),
            place,
            observers: Observers { snapshot_watch, ..Observers::of(options) },
            put: None,
            failure: None,
        };
        let (opened, outcome) = blocking::channel();
        let thread = std::thread::Builder::new().name("supervisor".to_owned()).stack_size(super::STACK);
        let thread = thread.spawn(move || {
            let _of = supervisor.place.span.clone().entered();
            supervisor.run(&opened, &inbox)
        });
        let thread = thread.map_err(|error| RunError::new(format!("cannot start a thread: {error}")))?;
        match outcome.recv() {
            Ok(Ok(())) => {}
            Ok(Err(error)) => return Err(error),
            Err(_) => return Err(RunError::new("the supervisor ended")),
        }
        let mut running = Self { ready: Value::Null, shared, commands, thread: Some(thread), console: None };
        running.serve(bound, options)?;
        Ok(running)
    }

    fn serve(&mut self, bound: Bound, options: &RunOptions) -> Result<(), RunError> {
        let (shared, commands) = (Arc::clone(&self.shared), self.commands.clone());
        let source = ConsoleSource::Gateway { shared, commands, watch: options.watch.clone() };
        let console = Console::start(bound, source, options.log.clone())?;
        self.ready = self.shared.view().ready.clone();
        self.ready["console"] = json!(console.address());
        self.console = Some(console);
        Ok(())
    }

    fn end(&mut self) -> Result<(), RunError> {
        self.console = None;
        let (answer, _) = oneshot::channel();
        let peer = IpAddr::V4(std::net::Ipv4Addr::LOCALHOST);
        let _ = self.commands.send(SupervisorCommand { peer, what: SupervisorAction::Shutdown, answer });
        let Some(thread) = self.thread.take() else { return Ok(()) };
        thread.join().unwrap_or_else(|_| Err(RunError::new("a thread panicked").after_start()))
    }
}

impl Drop for Supervised {
    fn drop(&mut self) {
        let _ = self.end();
    }
}

impl ForegroundRun for Supervised {
    fn ready(&self) -> &Value {
        &self.ready
    }

    fn stats(&self) -> Option<Value> {
        let client = self.shared.view().client.clone();
        client?.stats()
    }

    fn clients(&self) -> Vec<RuntimeClient> {
        self.shared.view().client.clone().into_iter().collect()
    }

    fn has_ended(&self) -> bool {
        self.thread.as_ref().is_none_or(JoinHandle::is_finished)
    }

    fn shutdown(mut self: Box<Self>) -> Result<(), RunError> {
        self.end()
    }
}

/// A running gateway that can be replaced.
struct Replaceable {
    number: u32,
    handle: Handle,
    slot: Arc<SnapshotSlot>,
    config: Arc<GatewayConfig>,
}

struct Supervisor {
    store: RevisionStore,
    revisions: Revisions,
    running: Option<Replaceable>,
    shared: Arc<SharedView>,
    overrides: Vec<String>,
    state: Option<PathBuf>,
    binds: Vec<Bind>,
    scheduling: Scheduling,
    /// Open devices between one gateway and the next.
    handover: Handover,
    /// Where each gateway runs.
    place: RuntimePlace,
    /// Observers of each gateway except the console.
    observers: Observers,
    /// The text to be stored, and its sender.
    put: Option<(String, String)>,
    failure: Option<String>,
}

impl Supervisor {
    fn run(
        mut self,
        opened: &blocking::Sender<Result<(), RunError>>,
        inbox: &blocking::Receiver<SupervisorCommand>,
    ) -> Result<(), RunError> {
        let live = self.revisions.live();
        if let Some(folder) = &self.state {
            info!(revision = live, folder = %folder.display(), "running this revision");
        }
        let started = self.prepare(live).and_then(|prepared| self.start(live, prepared));
        let started = started.and_then(|()| self.store.has_started());
        let is_open = started.is_ok();
        self.show();
        let _ = opened.send(started);
        if !is_open {
            return Ok(());
        }
        loop {
            self.drain();
            match inbox.recv_timeout(LOOK_INTERVAL) {
                Ok(SupervisorCommand { what: SupervisorAction::Shutdown, .. })
                | Err(RecvTimeoutError::Disconnected) => {
                    return self.running.take().map_or(Ok(()), |running| running.handle.shutdown());
                }
                Ok(command) => self.execute(command),
                Err(RecvTimeoutError::Timeout) => {}
            }
            if self.running.as_ref().is_some_and(|running| running.handle.has_ended()) {
                self.has_ended()?;
            }
        }
    }

    /// Handles a gateway that has ended by itself. If it was live, the process ends, as it does without a console.
    fn has_ended(&mut self) -> Result<(), RunError> {
        let Some(running) = self.running.take() else { return Ok(()) };
        let ended = running.handle.shutdown();
        let Some((number, _)) = self.revisions.trial() else { return ended };
        let why = ended.err().map_or_else(|| "it ended".to_owned(), |error| error.to_string());
        warn!(revision = number, why, "the revision on trial ended by itself");
        self.failure = Some(why);
        self.revisions.handle(now(), Done::Ended);
        Ok(())
    }

    fn execute(&mut self, command: SupervisorCommand) {
        let SupervisorCommand { peer, what, answer } = command;
        let at = now();
        let done = match what {
            SupervisorAction::Put { base, toml } => {
                let put = self.revisions.put(base, digest(&toml));
                self.put = Some((toml, peer.to_string()));
                put
            }
            SupervisorAction::Apply { number, trial } => self.revisions.apply(number, trial),
            SupervisorAction::Confirm => self.revisions.confirm(at),
            SupervisorAction::RollBack => self.revisions.roll_back(),
            SupervisorAction::Shutdown => return,
        };
        let result = match done {
            Ok(number) => self.drain().map_or(Ok(number), |failed| Err(ActionError::Tried(failed))),
            Err(refused) => Err(ActionError::Refused(refused)),
        };
        let _ = answer.send(result);
    }

    /// Executes the outputs of the state machine. Returns the reason if one failed.
    fn drain(&mut self) -> Option<String> {
        let (mut failed, mut is_changed) = (None, false);
        loop {
            let before = self.revisions.last();
            let output = self.revisions.poll_output(now());
            if let (Some((number, Ended::NotConfirmed)), true) =
                (self.revisions.last(), self.revisions.last() != before)
            {
                warn!(
                    revision = number,
                    "nobody confirmed the revision in time; returning to the one before"
                );
            }
            let result = match output {
                RevisionOutput::Sleep { .. } => break,
                RevisionOutput::Store { revision, forget } => {
                    Done::Stored(self.keep(revision.number, forget, &mut failed))
                }
                RevisionOutput::Run { number } => {
                    let started = self.replace_by(number);
                    if let Err(error) = &started {
                        error!(revision = number, %error, "the revision does not start");
                        self.failure = Some(error.to_string());
                        failed.get_or_insert(format!("revision {number} does not start: {error}"));
                    } else {
                        info!(revision = number, "running this revision");
                    }
                    Done::Started(started.is_ok())
                }
                RevisionOutput::Mark { live, previous } => {
                    let marked = self.store.mark(live, previous);
                    if let Err(error) = &marked {
                        error!(revision = live, %error, "cannot mark the revision as live");
                        failed.get_or_insert(format!("cannot be marked as live: {error}"));
                    }
                    Done::Marked(marked.is_ok())
                }
            };
            self.revisions.handle(now(), result);
            is_changed = true;
        }
        if is_changed {
            self.show();
        }
        failed
    }

    fn keep(&mut self, number: u32, forget: Option<u32>, failed: &mut Option<String>) -> bool {
        let Some((text, from)) = self.put.take() else { return false };
        let kept = self.store.keep(number, &text, &from, forget);
        if let Err(error) = &kept {
            error!(revision = number, %error, "cannot keep the revision");
            failed.get_or_insert(format!("cannot be kept: {error}"));
        }
        kept.is_ok()
    }

    /// Replaces the running gateway by this revision. Mistakes in the revision are found before anything is stopped.
    fn replace_by(&mut self, number: u32) -> Result<(), RunError> {
        if self.running.as_ref().is_some_and(|running| running.number == number) {
            // Its replacement could not be prepared.
            return Ok(());
        }
        let prepared = self.prepare(number)?;
        self.stop();
        self.start(number, prepared)
    }

    fn prepare(&self, number: u32) -> Result<Prepared, RunError> {
        let text = self.store.text(number).map_or("", |text| text);
        let name = format!("revision {number}");
        check::prepare(&name, text, &self.overrides)
            .map_err(|mistake| RunError::new(format!("{name}: {mistake}")))
    }

    /// Sends the safe values and ends the running gateway.
    fn stop(&mut self) {
        let Some(Replaceable { handle, slot, .. }) = self.running.take() else { return };
        // From here on no gateway runs.
        self.show();
        slot.make_safe();
        if let Err(error) = handle.shutdown() {
            warn!(%error, "the gateway had ended by itself");
        }
    }

    fn start(&mut self, number: u32, prepared: Prepared) -> Result<(), RunError> {
        let slot = Arc::new(SnapshotSlot::new());
        let Prepared { config, decoder } = prepared;
        let observers = Observers { slot: Some(Arc::clone(&slot)), decoder, ..self.observers.clone() };
        let copy = (*config).clone();
        let binds = self.binds_of(number, &config);
        let handle =
            gateway::spawn(copy, binds, self.scheduling, observers, self.handover.clone(), &self.place)?;
        self.running = Some(Replaceable { number, handle, slot, config });
        Ok(())
    }

    /// The binds of the ports that a revision has. The others are kept for later revisions.
    fn binds_of(&self, number: u32, config: &GatewayConfig) -> Vec<Bind> {
        let has =
            |bind: &&Bind| config.view().field_ports().any(|(_, port, _)| port.name == bind.port.as_str());
        let (used, spare): (Vec<_>, Vec<_>) = self.binds.iter().partition(has);
        for bind in spare {
            warn!(revision = number, %bind, "--bind is not used: the revision has no such port");
        }
        used.into_iter().cloned().collect()
    }

    /// Updates the readers' view.
    fn show(&self) {
        let mut view = self.shared.view();
        view.revisions = Some(self.revisions.clone());
        view.entries = self.store.entries().to_vec();
        view.texts = self.store.texts().clone();
        view.failure = self.failure.clone();
        view.overrides = self.overrides.clone();
        let running = self.running.as_ref();
        view.client = running.map(|running| running.handle.client());
        view.slot = running.map(|running| Arc::clone(&running.slot));
        view.config = running.map(|running| Arc::clone(&running.config));
        view.ready = running.map_or(Value::Null, |running| running.handle.ready().clone());
    }
}

/// Poll interval for the end of a trial or gateway.
const LOOK_INTERVAL: StdDuration = StdDuration::from_millis(100);

/// The revision on trial, and the remaining seconds.
pub(super) fn left_of(trial: Option<(u32, Instant)>) -> Option<(u32, f64)> {
    let (number, until) = trial?;
    Some((number, until.saturating_since(now()).as_millis() as f64 / 1_000.0))
}
