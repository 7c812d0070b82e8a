//! Copies of a running engine for the console's thread.
//!
//! The console lays out memory and asks; the engine's thread copies itself into it and goes on. It never waits
//! for the console: if the memory is in use at that moment, it is not filled.

use std::sync::Mutex;
use std::sync::atomic::{AtomicBool, Ordering::Relaxed};
use std::time::Duration as StdDuration;

use proto_core::config::MAX_PORTS;
use proto_core::engine::PortId;
use proto_core::time::{Duration, Instant};
use recipe_doctor::{LinkFacts, PortRecord};
use recipe_io::exchange::DeviceCounters;
use tokio::sync::Notify;

/// The gateway's engine, with a tap.
pub(crate) type Engine = proto_core::engine::Engine<8, 4, 512, TAP>;

/// Bytes of the engine's tap. It is drained after each call, which fills less than this.
pub(crate) const TAP: usize = 64 << 10;

/// Between the thread of an engine and the console's.
#[derive(Debug)]
pub(crate) struct SnapshotSlot {
    snapshot: Mutex<Option<Box<GatewaySnapshot>>>,
    is_filled: AtomicBool,
    pub(crate) wanted: Notify,
    filled: Notify,
    pub(crate) ending: Notify,
    pub(crate) safe: Mutex<Option<std::sync::mpsc::Sender<()>>>,
}

/// A gateway at one instant.
#[derive(Debug, Clone)]
pub(crate) struct GatewaySnapshot {
    /// The engine. Nothing is ever done with it but to look.
    pub(crate) engine: Box<Engine>,
    /// The instant.
    pub(crate) at: Instant,
    /// The counters of the devices, by the port's number.
    pub(crate) devices: [Option<DeviceCounters>; MAX_PORTS],
    /// What came in at each port lately; the first `ports` of them.
    records: Vec<PortRecord>,
    ports: usize,
    /// What is known of the links to the controller.
    pub(crate) links: Vec<LinkFacts>,
    /// How long the gateway has been running.
    pub(crate) running: Duration,
}

impl GatewaySnapshot {
    /// A buffer for a copy of any engine.
    pub(crate) fn empty() -> Box<Self> {
        Box::new(Self {
            engine: Box::new(Engine::idle()),
            at: Instant::ZERO,
            devices: [None; MAX_PORTS],
            records: (0..MAX_PORTS).map(|_| PortRecord::new(PortId(0))).collect(),
            ports: 0,
            links: Vec::with_capacity(2 * MAX_PORTS),
            running: Duration::ZERO,
        })
    }

    /// Copies what came in at each port into the memory that is there.
    pub(crate) fn keep_records(&mut self, records: &[PortRecord]) {
        for (buffer, record) in self.records.iter_mut().zip(records) {
            buffer.clone_from(record);
        }
        self.ports = records.len();
    }

    /// What came in at each port lately.
    pub(crate) fn records(&self) -> &[PortRecord] {
        self.records.get(..self.ports).unwrap_or(&self.records)
    }
}

impl SnapshotSlot {
    /// Without a copy.
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

    /// The engine's thread: fills the buffer, if there is some that nobody uses at the moment.
    pub(crate) fn fill(&self, fill: impl FnOnce(&mut GatewaySnapshot)) {
        if let Ok(mut snapshot) = self.snapshot.try_lock()
            && let Some(snapshot) = snapshot.as_mut()
        {
            fill(snapshot);
            self.is_filled.store(true, Relaxed);
        }
        self.filled.notify_one();
    }

    /// The console's thread: a copy in this buffer, or the buffer if there is none in time.
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

    /// The supervisor's thread: brings the safe values out, and waits until the controller has them, as far
    /// as it shows them. From then on the engine is to be ended.
    pub(crate) fn make_safe(&self) {
        let (sender, receiver) = std::sync::mpsc::channel();
        *self.safe.lock().unwrap_or_else(std::sync::PoisonError::into_inner) = Some(sender);
        self.ending.notify_one();
        // The engine's thread limits the time itself; it may have ended.
        let _ = receiver.recv_timeout(2 * MAX_SAFE);
    }

    /// The engine's thread: the safe values are out, or it took too long.
    pub(crate) fn is_safe(&self) {
        if let Ok(mut safe) = self.safe.lock()
            && let Some(sender) = safe.take()
        {
            let _ = sender.send(());
        }
    }
}

/// How long the console waits for a copy.
const MAX_WAIT: StdDuration = StdDuration::from_millis(500);
/// How long safe values may take: so long they are repeated where nothing shows them (proto-core/docs/engine.md section 6).
pub(crate) const MAX_SAFE: StdDuration = StdDuration::from_secs(1);
