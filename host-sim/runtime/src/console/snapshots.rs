//! Snapshots for readers, shared by all of them and taken at most ten times a second.

use std::cell::{Cell, OnceCell, RefCell};
use std::rc::Rc;
use std::sync::Arc;
use std::time::Duration as StdDuration;

use proto_core::config::GatewayConfig;
use proto_core::time::{Duration, Instant};
use proto_core::wire::state::States;
use recipe_api::documents::{Document, Pieces};
use recipe_api::json;
use recipe_api::metrics::Families;
use recipe_doctor::Finding;
use recipe_io::timer::now;
use serde_json::Value;

use super::ConsoleSource;
use crate::findings::{look_at_states, unexplained};
use crate::snapshot::{GatewaySnapshot, SnapshotSlot};

#[derive(Default)]
pub(super) struct Snapshots {
    newest: RefCell<Option<Rc<Snapshot>>>,
    buffer: RefCell<Option<Box<GatewaySnapshot>>>,
    /// Concurrent readers get the same snapshot.
    refresh: tokio::sync::Mutex<()>,
    /// The controller's states after a command failed at that instant, if they could be read.
    looked: Cell<Option<(Instant, Option<States>)>>,
}

/// State, counters and values at one instant. Each text is built once, on first use.
pub(super) struct Snapshot {
    taken: Instant,
    what: SnapshotContent,
    status: OnceCell<Rc<str>>,
    values: OnceCell<Rc<str>>,
    metrics: OnceCell<Rc<str>>,
}

enum SnapshotContent {
    Gateway(Box<GatewaySnapshot>, Arc<GatewayConfig>),
    Controller(Value),
}

impl Snapshots {
    /// A snapshot not older than [`MAX_AGE`]; `None` while nothing runs.
    pub(super) async fn newest(&self, source: &ConsoleSource) -> Option<Rc<Snapshot>> {
        let _refresh = self.refresh.lock().await;
        if let Some(newest) = self.newest.borrow().as_ref()
            && now().saturating_since(newest.taken) < MAX_AGE
        {
            return Some(Rc::clone(newest));
        }
        let what = match source {
            ConsoleSource::Gateway { shared, .. } => {
                let (slot, config) = shared.running()?;
                SnapshotContent::Gateway(self.copy(&slot).await?, config)
            }
            ConsoleSource::Controller { client, .. } => {
                let client = client.clone();
                SnapshotContent::Controller(tokio::task::spawn_blocking(move || client.stats()).await.ok()??)
            }
        };
        let snapshot = Rc::new(Snapshot {
            taken: now(),
            what,
            status: OnceCell::new(),
            values: OnceCell::new(),
            metrics: OnceCell::new(),
        });
        let before = self.newest.replace(Some(Rc::clone(&snapshot)));
        // Reuse its buffer, unless a stream is still reading.
        if let Some(Snapshot { what: SnapshotContent::Gateway(snapshot, _), .. }) =
            before.and_then(Rc::into_inner)
        {
            self.buffer.replace(Some(snapshot));
        }
        Some(snapshot)
    }

    /// The controller's states, read once for each failed command; `None` on timeout.
    pub(super) async fn look_at_controller(&self, failed: Instant, snapshot: &Snapshot) -> Option<States> {
        let SnapshotContent::Gateway(_, config) = &snapshot.what else { return None };
        if let Some((at, states)) = self.looked.get()
            && at >= failed
        {
            return states;
        }
        let config = Arc::clone(config);
        let looking = tokio::task::spawn_blocking(move || look_at_states(&config.controller));
        let states = tokio::time::timeout(MAX_LOOK, looking).await.ok()?.ok()?;
        self.looked.set(Some((failed, states)));
        states
    }

    async fn copy(&self, slot: &Arc<SnapshotSlot>) -> Option<Box<GatewaySnapshot>> {
        let buffer = self.buffer.take().unwrap_or_else(GatewaySnapshot::empty);
        match slot.look(buffer).await {
            Ok(snapshot) => Some(snapshot),
            Err(buffer) => {
                self.buffer.replace(buffer);
                None
            }
        }
    }
}

impl Snapshot {
    pub(super) fn status(&self) -> Rc<str> {
        let make = || match &self.what {
            SnapshotContent::Controller(stats) => stats.to_string(),
            SnapshotContent::Gateway(snapshot, _) => status_of(snapshot),
        };
        Rc::clone(self.status.get_or_init(|| make().into()))
    }

    pub(super) fn values(&self) -> Option<Rc<str>> {
        let SnapshotContent::Gateway(snapshot, _) = &self.what else { return None };
        let make = || {
            written(|text| Pieces::of(Document::Values).write_all(snapshot.engine.status(snapshot.at), text))
        };
        Some(Rc::clone(self.values.get_or_init(|| make().into())))
    }

    pub(super) fn metrics(&self) -> Option<Rc<str>> {
        let SnapshotContent::Gateway(snapshot, _) = &self.what else { return None };
        let make = || written(|text| Families::new().write_all(snapshot.engine.status(snapshot.at), text));
        Some(Rc::clone(self.metrics.get_or_init(|| make().into())))
    }

    /// When the newest command failed for a reason that the state stream did not show.
    pub(super) fn unexplained(&self) -> Option<Instant> {
        let SnapshotContent::Gateway(snapshot, _) = &self.what else { return None };
        unexplained(snapshot.engine.status(snapshot.at))
    }

    /// Findings. `looked` are the controller's states, if they were read outside the engine.
    pub(super) fn findings(&self, looked: Option<States>) -> Option<Vec<Finding>> {
        let SnapshotContent::Gateway(snapshot, config) = &self.what else { return None };
        Some(snapshot.findings(config, looked))
    }
}

/// The document `status`, with the counters of the devices, which the engine does not know.
fn status_of(snapshot: &GatewaySnapshot) -> String {
    let status = snapshot.engine.status(snapshot.at);
    written(|text| {
        let _ = Pieces::of(Document::Status).write_all(status, text);
        text.pop();
        text.push_str(",\"devices\":{");
        let mut separator = "";
        for port in status.ports() {
            if let Some(counters) = snapshot.devices.get(usize::from(port.id.0)).and_then(Option::as_ref) {
                text.push_str(separator);
                let _ = json::write_text(text, port.name);
                text.push(':');
                let _ = json::write(text, counters);
                separator = ",";
            }
        }
        text.push_str("}}");
    })
}

/// The written text; writing to a `String` cannot fail.
fn written<R>(write: impl FnOnce(&mut String) -> R) -> String {
    let mut text = String::new();
    let _ = write(&mut text);
    text
}

/// Timeout for reading the controller's states.
const MAX_LOOK: StdDuration = StdDuration::from_secs(3);
/// Maximum age of a snapshot that is reused.
const MAX_AGE: Duration = Duration::from_millis(100);
