//! Publishes the state of a gateway to a Sparkplug broker: the gateway's edge node (docs/fleet.md).
//!
//! An ordinary thread takes snapshots through a slot, as the console does, and never blocks the gateway's thread.
//! Another configuration is another node with a new session.

use std::io;
use std::sync::Arc;
use std::thread::JoinHandle;
use std::time::Duration;

use proto_core::config::GatewayConfig;
use proto_core::time::Instant;
use recipe_edge_node::drive::{Listener, Sampled, Sampler, drive};
use recipe_edge_node::file::{PublisherConfig, read_bd_seq, write_bd_seq};
use recipe_io::random::random;
use recipe_io::timer::now;
use recipe_sparkplug::gateway::GatewayCatalog;
use recipe_sparkplug::node::{EdgeNode, NodeCounters, SessionFailure};
use recipe_sparkplug::value::Value;
use tokio::sync::watch;
use tracing::{info, warn};

use crate::RunError;
use crate::snapshot::{GatewaySnapshot, SnapshotSlot};

/// The snapshot slot of the running gateway, for the publisher.
#[derive(Debug, Clone)]
pub(crate) struct SnapshotWatch(watch::Sender<Option<RunningGateway>>);

/// A gateway that snapshots can be taken of.
#[derive(Debug, Clone)]
struct RunningGateway {
    slot: Arc<SnapshotSlot>,
    config: Arc<GatewayConfig>,
}

impl SnapshotWatch {
    /// A slot for a gateway that starts now; replaces the previous gateway's.
    pub(crate) fn open(&self, config: &GatewayConfig) -> Arc<SnapshotSlot> {
        let slot = Arc::new(SnapshotSlot::new());
        self.0
            .send_replace(Some(RunningGateway { slot: Arc::clone(&slot), config: Arc::new(config.clone()) }));
        slot
    }
}

/// An edge node that publishes until it is dropped.
#[derive(Debug)]
pub(crate) struct Publisher {
    snapshot_watch: SnapshotWatch,
    end: watch::Sender<bool>,
    thread: Option<JoinHandle<()>>,
}

impl Publisher {
    /// Starts the thread. It waits for a gateway.
    pub(crate) fn start(publishing: PublisherConfig) -> Result<Self, RunError> {
        let refused = |error: io::Error| RunError::new(format!("--sparkplug: {error}"));
        let seed = random().map_err(refused)?;
        let (snapshot_watch, running) = watch::channel(None);
        let (end, ended) = watch::channel(false);
        let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build().map_err(refused)?;
        let thread = std::thread::Builder::new().name("sparkplug".to_owned()).stack_size(STACK);
        let thread = thread.spawn(move || {
            // The gateway's thread goes first even without real-time priority.
            let _ = rustix::process::setpriority_process(Some(rustix::thread::gettid()), NICENESS);
            runtime.block_on(async {
                let mut late = ended.clone();
                tokio::select! {
                    () = publish(&publishing, running, ended, u64::from_le_bytes(seed)) => {}
                    // A broker that does not read must not delay the shutdown.
                    () = async {
                        let _ = late.wait_for(|is_ending| *is_ending).await;
                        tokio::time::sleep(LAST_WORDS).await;
                    } => warn!("the broker did not take the node's death in time"),
                }
            });
            // Do not wait for a pending name lookup.
            runtime.shutdown_background();
        });
        Ok(Self {
            snapshot_watch: SnapshotWatch(snapshot_watch),
            end,
            thread: Some(thread.map_err(refused)?),
        })
    }

    pub(crate) fn snapshot_watch(&self) -> SnapshotWatch {
        self.snapshot_watch.clone()
    }
}

impl Drop for Publisher {
    fn drop(&mut self) {
        let _ = self.end.send(true);
        if let Some(thread) = self.thread.take() {
            let _ = thread.join();
        }
    }
}

/// Runs one node for each gateway, one after the other.
async fn publish(
    publishing: &PublisherConfig,
    mut running: watch::Receiver<Option<RunningGateway>>,
    mut end: watch::Receiver<bool>,
    seed: u64,
) {
    let mut bd_seq = publishing.bd_seq.as_deref().and_then(|path| read_bd_seq(path).ok().flatten());
    loop {
        let gateway = tokio::select! {
            gateway = running.wait_for(Option::is_some) => gateway.ok().and_then(|gateway| gateway.clone()),
            _ = end.wait_for(|is_ending| *is_ending) => return,
        };
        running.mark_unchanged();
        let Some(RunningGateway { slot, config }) = gateway else { return };
        let mut reader =
            SnapshotReader { slot, running: running.clone(), buffer: Some(GatewaySnapshot::empty()) };
        let made = match reader.look().await {
            Some(snapshot) => {
                let status = snapshot.engine.status(snapshot.at);
                let catalog =
                    GatewayCatalog::new(config.view(), status, publishing.rates(), env!("CARGO_PKG_VERSION"));
                let catalog: Result<Box<NodeCatalog<'_>>, _> = catalog.map(Box::new);
                catalog.map_err(|_| format!("more than {METRICS} metrics")).and_then(|catalog| {
                    let node = EdgeNode::new(publishing.settings.clone(), &*catalog, bd_seq, seed);
                    let node: Box<GatewayNode> = Box::new(node.map_err(|error| format!("{error:?}"))?);
                    Ok((catalog, node))
                })
            }
            None if running.has_changed().is_ok_and(|has_changed| has_changed) => continue,
            None => Err("it does not answer".to_owned()),
        };
        let (catalog, mut node) = match made {
            Ok(made) => made,
            Err(why) => {
                warn!(why, "this gateway is not told of");
                tokio::select! {
                    _ = running.changed() => continue,
                    _ = end.wait_for(|is_ending| *is_ending) => return,
                }
            }
        };
        let mut sampler = GatewaySampler { reader, catalog: &catalog, started: now() };
        let mut listener = LogListener { publishing };
        drive(
            &mut node,
            &*catalog,
            &publishing.broker,
            publishing.sample,
            &mut sampler,
            &mut listener,
            end.clone(),
        )
        .await;
        bd_seq = node.bd_seq();
        if *end.borrow() {
            return;
        }
    }
}

/// Takes snapshots of one gateway.
struct SnapshotReader {
    slot: Arc<SnapshotSlot>,
    running: watch::Receiver<Option<RunningGateway>>,
    buffer: Option<Box<GatewaySnapshot>>,
}

impl SnapshotReader {
    async fn look(&mut self) -> Option<&GatewaySnapshot> {
        let buffer = self.buffer.take().unwrap_or_else(GatewaySnapshot::empty);
        match self.slot.look(buffer).await {
            Ok(snapshot) => Some(&**self.buffer.insert(snapshot)),
            Err(buffer) => {
                self.buffer = buffer;
                None
            }
        }
    }
}

struct GatewaySampler<'c> {
    reader: SnapshotReader,
    catalog: &'c NodeCatalog<'c>,
    started: Instant,
}

impl Sampler for GatewaySampler<'_> {
    async fn sample(&mut self, node: &NodeCounters, values: &mut [Option<Value>]) -> Sampled {
        if self.reader.running.has_changed().unwrap_or(true) {
            return Sampled::Changed;
        }
        let Some(snapshot) = self.reader.look().await else { return Sampled::Nothing };
        let uptime = now().saturating_since(self.started);
        Sampled::Alive(self.catalog.sample(snapshot.engine.status(snapshot.at), uptime, node, values))
    }
}

struct LogListener<'t> {
    publishing: &'t PublisherConfig,
}

impl Listener for LogListener<'_> {
    fn keep(&mut self, bd_seq: u8) {
        let Some(path) = &self.publishing.bd_seq else { return };
        if let Err(error) = write_bd_seq(path, bd_seq) {
            warn!(%error, path = %path.display(), "cannot keep the number of the session");
        }
    }

    fn online(&mut self) {
        info!(broker = self.publishing.broker.address(), "the edge node is online");
    }

    fn failed(&mut self, failure: SessionFailure, error: Option<&io::Error>) {
        let broker = self.publishing.broker.address();
        let error = error.map(ToString::to_string);
        warn!(broker, why = %failure, error, "no session with the broker; trying again");
    }
}

type NodeCatalog<'c> = GatewayCatalog<'c, METRICS>;
type GatewayNode = EdgeNode<METRICS, HISTORY>;

/// Capacity for metrics: more than a configuration can have.
const METRICS: usize = 1_024;
/// Capacity for values while the broker is unreachable.
const HISTORY: usize = 8_192;
/// Stack size: nodes and engines are built by value, with several copies on the stack in unoptimised code.
const STACK: usize = 32 << 20;
/// Nice value of the publisher's thread.
const NICENESS: i32 = 10;
/// Time for publishing the node's death at shutdown.
const LAST_WORDS: Duration = Duration::from_secs(3);
