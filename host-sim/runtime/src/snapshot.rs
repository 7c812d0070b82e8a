//! Snapshots of a running gateway for other threads.
//!
//! A reader provides a buffer and requests a snapshot; the gateway's thread copies the engine into it. That thread
//! never waits for a reader: if the buffer is locked at that moment, it is not filled.

use std::sync::Mutex;
use std::sync::atomic::{AtomicBool, Ordering::Relaxed};
use std::time::Duration as StdDuration;

use proto_core::config::{GatewayConfig, MAX_PORTS};
use proto_core::engine::PortId;
use proto_core::time::{Duration, Instant};
use proto_core::wire::state::States;
use recipe_doctor::{Case, Finding, LinkFacts, PortRecord, examine};
use recipe_io::exchange::DeviceCounters;
use tokio::sync::Notify;

/// The gateway's engine, with a tap.
pub(crate) type GatewayEngine = proto_core::engine::Engine<8, 4, 512, TAP>;

/// Bytes of the engine's tap. It is drained after each call, which fills less than this.
pub(crate) const TAP: usize = 64 << 10;

/// One snapshot at a time, between the gateway's thread and a reader's.
#[derive(Debug)]
pub(crate) struct SnapshotSlot {
    snapshot: Mutex<Option<Box<GatewaySnapshot>>>,
    is_filled: AtomicBool,
    pub(crate) wanted: Notify,
    filled: Notify,
    pub(crate) ending: Notify,
    pub(crate) safe: Mutex<Option<std::sync::mpsc::Sender<()>>>,
}

#[derive(Debug, Clone)]
pub(crate) struct GatewaySnapshot {
    /// A copy of the engine, only for reading.
    pub(crate) engine: Box<GatewayEngine>,
    pub(crate) at: Instant,
    /// Device counters by port number.
    pub(crate) devices: [Option<DeviceCounters>; MAX_PORTS],
    /// Recent input of each port; the first `ports` entries are valid.
    records: Vec<PortRecord>,
    ports: usize,
    /// Facts about the links that the engine does not know.
    pub(crate) links: Vec<LinkFacts>,
    pub(crate) running: Duration,
}

impl GatewaySnapshot {
    /// A buffer for a copy of any engine.
    pub(crate) fn empty() -> Box<Self> {
        Box::new(Self {
            engine: Box::new(GatewayEngine::idle()),
            at: Instant::ZERO,
            devices: [None; MAX_PORTS],
            records: (0..MAX_PORTS).map(|_| PortRecord::new(PortId(0))).collect(),
            ports: 0,
            links: Vec::with_capacity(2 * MAX_PORTS),
            running: Duration::ZERO,
        })
    }

    /// Copies the port records without allocating.
    pub(crate) fn keep_records(&mut self, records: &[PortRecord]) {
        for (buffer, record) in self.records.iter_mut().zip(records) {
            buffer.clone_from(record);
        }
        self.ports = records.len();
    }

    /// Findings. `looked` are the controller's states, if they were read outside the engine.
    pub(crate) fn findings(&self, config: &GatewayConfig, looked: Option<States>) -> Vec<Finding> {
        examine(&Case {
            config: config.view(),
            status: self.engine.status(self.at).into(),
            ports: self.records.get(..self.ports).unwrap_or(&self.records),
            links: &self.links,
            running: self.running,
            looked,
        })
    }
}

impl SnapshotSlot {
    pub(crate) fn new() -> Self {
        Self {
            snapshot: Mutex::new(None),
            is_filled: AtomicBool::new(false),
            wanted: Notify::new(),
            filled: Notify::new(),
            ending: Notify::new(),
            safe: Mutex::new(None),
        }
    }

    /// Gateway's thread: fills the buffer, if there is one and it is not locked.
    pub(crate) fn fill(&self, fill: impl FnOnce(&mut GatewaySnapshot)) {
        if let Ok(mut snapshot) = self.snapshot.try_lock()
            && let Some(snapshot) = snapshot.as_mut()
        {
            fill(snapshot);
            self.is_filled.store(true, Relaxed);
        }
        self.filled.notify_one();
    }

    /// Reader's thread: requests a snapshot in this buffer; returns the buffer unfilled if it takes too long.
    pub(crate) async fn look(
        &self,
        buffer: Box<GatewaySnapshot>,
    ) -> Result<Box<GatewaySnapshot>, Option<Box<GatewaySnapshot>>> {
        let put = |buffer: Option<Box<GatewaySnapshot>>| {
            let mut snapshot = self.snapshot.lock().unwrap_or_else(std::sync::PoisonError::into_inner);
            std::mem::replace(&mut *snapshot, buffer)
        };
        self.is_filled.store(false, Relaxed);
        drop(put(Some(buffer)));
        self.wanted.notify_one();
        let _ = tokio::time::timeout(MAX_WAIT, async {
            while !self.is_filled.load(Relaxed) {
                self.filled.notified().await;
            }
        })
        .await;
        let snapshot = put(None);
        match (snapshot, self.is_filled.load(Relaxed)) {
            (Some(snapshot), true) => Ok(snapshot),
            (snapshot, _) => Err(snapshot),
        }
    }

    /// Supervisor's thread: has the safe values sent, and waits until the controller shows those that it reports. The
    /// gateway must be ended after this.
    pub(crate) fn make_safe(&self) {
        let (sender, receiver) = std::sync::mpsc::channel();
        *self.safe.lock().unwrap_or_else(std::sync::PoisonError::into_inner) = Some(sender);
        self.ending.notify_one();
        // The gateway's thread limits the time itself, but may have ended.
        let _ = receiver.recv_timeout(2 * MAX_SAFE);
    }

    /// Gateway's thread: the safe values were sent, or it took too long.
    pub(crate) fn is_safe(&self) {
        if let Ok(mut safe) = self.safe.lock()
            && let Some(sender) = safe.take()
        {
            let _ = sender.send(());
        }
    }
}

const MAX_WAIT: StdDuration = StdDuration::from_millis(500);
/// Maximum time for safe values to arrive: as long as values that nothing shows are repeated (proto-core/docs/engine.md
/// section 6).
pub(crate) const MAX_SAFE: StdDuration = StdDuration::from_secs(1);
