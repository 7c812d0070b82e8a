//! The Sparkplug edge node: publishes the state of the gateway to a broker (docs/fleet.md section 6).
//!
//! In: the status of the gateway, sampled in parts between which other tasks run; bytes from the broker; UTC. Out:
//! bytes for the broker, the bdSeq of each session for the store task, a view for the console. `recipe_sparkplug`
//! decides what is published and when. The node has its own socket and memory and never waits for the engine, so an
//! absent, slow or hostile broker does not affect the cell.

use core::cell::Cell;
use core::pin::pin;

use embassy_futures::select::{Either, Either3, select, select3};
use embassy_futures::yield_now;
use embassy_net::tcp::TcpSocket;
use embassy_net::{IpEndpoint, Stack};
use embassy_time::{Duration, Instant, Timer, with_timeout};
use proto_core::config::ConfigView;
use proto_core::time::{Duration as Span, Instant as Time};
use recipe_sparkplug::document::DocumentError;
pub use recipe_sparkplug::document::NodeDocument;
use recipe_sparkplug::gateway::{GatewayCatalog, Rates};
use recipe_sparkplug::node::{
    EdgeNode, Input, MIN_BUFFER, NodeCounters, NodeError, NodeOutput, SessionFailure,
};

use super::gateway::Gateway;
use super::link::resolve;
use super::store::StoreHandle;
use super::time::WallClock;
use super::watchdog::Pulse;
use crate::clock::now;
use crate::fmt::DisplayText;
use crate::{info, warn};

/// Maximum number of metrics.
pub const METRICS: usize = 256;
/// Capacity of the buffer for samples taken while offline.
pub const HISTORY: usize = 192;

type BoardCatalog = GatewayCatalog<'static, METRICS>;

/// Memory of the node. All zeros, so it is placed in .bss.
pub struct NodeMemory {
    /// The decoded settings.
    pub document: NodeDocument,
    /// The state of the node.
    pub node: NodeState,
}

/// The node with room for [`METRICS`] and [`HISTORY`].
type NodeState = EdgeNode<METRICS, HISTORY>;

impl NodeMemory {
    /// Empty: the settings have not been read.
    pub const ZEROED: Self = Self { document: NodeDocument::empty(), node: EdgeNode::idle() };
}

/// Buffers of the node's socket.
#[derive(Debug)]
pub struct NodeBuffers<'a> {
    rx: &'a mut [u8],
    tx: &'a mut [u8],
    /// Buffer for one piece of output or input.
    piece: &'a mut [u8],
}

impl<'a> NodeBuffers<'a> {
    /// Size in bytes.
    pub const SIZE: usize = RX + TX + MIN_BUFFER;

    /// Takes [`NodeBuffers::SIZE`] bytes from the front of `memory`; `None` if there are fewer.
    pub fn take(memory: &mut &'a mut [u8]) -> Option<Self> {
        Some(Self {
            rx: memory.split_off_mut(..RX)?,
            tx: memory.split_off_mut(..TX)?,
            piece: memory.split_off_mut(..MIN_BUFFER)?,
        })
    }
}

/// Why the edge node does not run although there are settings.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum EdgeError {
    /// No configuration runs.
    NothingRuns,
    /// The settings cannot be read.
    Settings(DocumentError),
    /// More than [`METRICS`] metrics.
    Metrics,
    /// The configuration contains names that are invalid in a topic.
    Node(NodeError),
}

impl core::fmt::Display for EdgeError {
    fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        match self {
            Self::NothingRuns => f.write_str("no configuration runs"),
            Self::Settings(error) => error.fmt(f),
            Self::Metrics => write!(f, "more than {METRICS} metrics; ask for fewer values"),
            Self::Node(NodeError::SameDevice { nth }) => {
                write!(f, "port {nth}: another port has the same name there")
            }
            Self::Node(NodeError::Device { nth, error }) => write!(f, "port {nth}: {error}"),
            Self::Node(_) => f.write_str("the configuration is too large"),
        }
    }
}

/// State of the edge node for clients of the API.
#[derive(Debug, Clone, Copy)]
pub enum View {
    /// No settings are stored.
    Off,
    /// There are settings, but the node cannot run.
    Cannot(EdgeError),
    /// The node runs.
    Runs(EdgeStatus),
}

/// Status of a running edge node.
#[derive(Debug, Clone, Copy)]
pub struct EdgeStatus {
    /// Whether a session with the broker is established.
    pub is_online: bool,
    /// The last failure, if there is no session.
    pub failure: Option<SessionFailure>,
    /// bdSeq of the session.
    pub bd_seq: Option<u8>,
    /// Number of metrics.
    pub metrics: usize,
    /// Counters since the start.
    pub counters: NodeCounters,
}

/// Shared by the edge node and the console.
pub struct Edge {
    view: Cell<View>,
    /// Set when settings were stored that take effect at the next start: whether they enable publishing.
    next: Cell<Option<bool>>,
}

impl Edge {
    /// The state of a board without an edge node.
    pub const fn off() -> Self {
        Self { view: Cell::new(View::Off), next: Cell::new(None) }
    }

    /// The state for clients.
    pub fn view(&self) -> View {
        self.view.get()
    }

    /// Records why there is no node.
    pub fn cannot(&self, why: EdgeError) {
        self.view.set(View::Cannot(why));
    }

    /// Whether the node publishes after the next start; `None` if no settings were stored since this one.
    pub fn next(&self) -> Option<bool> {
        self.next.get()
    }

    /// Records that settings were stored for the next start.
    pub fn set_next(&self, publishes: bool) {
        self.next.set(Some(publishes));
    }
}

/// An edge node with its catalog and buffers.
pub struct Node {
    document: &'static NodeDocument,
    catalog: BoardCatalog,
    node: &'static mut NodeState,
}

impl Node {
    /// Creates the node for the running configuration. `bd_seq` is that of the last session; `seed` differs at each
    /// start.
    pub fn make(
        document: &'static NodeDocument,
        node: &'static mut NodeState,
        gateway: &Gateway,
        config: ConfigView<'_>,
        bd_seq: Option<u8>,
        seed: u64,
    ) -> Result<Self, EdgeError> {
        let rates = Rates {
            min_interval: document.interval,
            counter_interval: document.counter_interval,
            rules: &document.rules,
            values: &document.values,
        };
        let catalog =
            gateway.report(|status| BoardCatalog::new(config, status, rates, env!("CARGO_PKG_VERSION")));
        let catalog = catalog.map_err(|_| EdgeError::Metrics)?;
        node.configure(&document.settings, &catalog, bd_seq, seed).map_err(EdgeError::Node)?;
        Ok(Self { document, catalog, node })
    }

    /// Runs the node forever.
    #[allow(clippy::too_many_arguments, reason = "each is used once")]
    pub async fn run(
        &mut self,
        gateway: &Gateway,
        pulse: &Pulse,
        stack: Stack<'_>,
        store: &StoreHandle,
        edge: &Edge,
        clock: &WallClock,
        buffers: NodeBuffers<'_>,
    ) -> ! {
        let Self { document, catalog, node } = self;
        let NodeBuffers { rx, tx, piece } = buffers;
        let mut socket = TcpSocket::new(stack, rx, tx);
        socket.set_timeout(Some(SILENT));
        let mut driver = NodeDriver {
            gateway,
            pulse,
            store,
            edge,
            clock,
            catalog,
            node,
            period: Duration::from_micros(document.sample.as_micros()),
            sample_at: Instant::now(),
            was_online: false,
            logged: None,
        };
        // Sample first, so that even the first birth has values and timestamps.
        driver.sample().await;
        loop {
            let next = driver.drain(&mut socket, piece).await;
            driver.tell(document);
            let until = match next {
                NodeStep::Open => {
                    driver.open(stack, document, &mut socket).await;
                    continue;
                }
                NodeStep::Sleep { until } => Instant::from_micros(until.as_micros()).min(driver.sample_at),
            };
            let is_connected = driver.node.is_connected();
            let reading = async {
                match is_connected {
                    true => socket.read(piece.get_mut(..READ).unwrap_or(&mut [])).await,
                    false => core::future::pending().await,
                }
            };
            let next = pulse.idle(pin!(select(reading, Timer::at(until)))).await;
            match next {
                Either::First(Ok(count @ 1..)) => {
                    let bytes = piece.get(..count).unwrap_or(&[]);
                    driver.node.handle(now(), Input::Bytes(bytes), driver.catalog);
                }
                Either::First(_) => driver.lost(&mut socket).await,
                Either::Second(()) => {}
            }
            if Instant::now() >= driver.sample_at {
                driver.sample().await;
            }
            // Yield, so that a broker that floods the board does not starve other tasks.
            pulse.idle(pin!(yield_now())).await;
        }
    }
}

/// What to do after the outputs were drained.
enum NodeStep {
    Open,
    Sleep { until: Time },
}

struct NodeDriver<'a> {
    gateway: &'a Gateway,
    pulse: &'a Pulse,
    store: &'a StoreHandle,
    edge: &'a Edge,
    clock: &'a WallClock,
    catalog: &'a BoardCatalog,
    node: &'a mut NodeState,
    period: Duration,
    sample_at: Instant,
    was_online: bool,
    logged: Option<SessionFailure>,
}

impl NodeDriver<'_> {
    /// Samples the gateway in parts and passes the samples to the node.
    async fn sample(&mut self) {
        // Missed periods are skipped: samples have current values.
        self.sample_at = Instant::now() + self.period;
        let uptime = Span::from_micros(Instant::now().as_micros());
        let counters = self.node.counters();
        for first in (0..self.catalog.len()).step_by(PLACES) {
            self.sample_part(first, uptime, &counters);
            self.pulse.idle(pin!(yield_now())).await;
        }
        let alive = self.gateway.report(|status| self.catalog.alive(status));
        let at = now();
        if let Some(utc_ms) = self.clock.utc_ms(at) {
            self.node.handle(at, Input::Time { utc_ms }, self.catalog);
        }
        self.node.handle(at, Input::Sampled { alive }, self.catalog);
    }

    fn sample_part(&mut self, first: usize, uptime: Span, counters: &NodeCounters) {
        let mut values = [None; PLACES];
        let end = first.saturating_add(PLACES).min(self.catalog.len());
        self.gateway.report(|status| {
            self.catalog.sample_part(status, uptime, counters, first..end, &mut values);
        });
        let values = values.get(..end.saturating_sub(first)).unwrap_or(&[]);
        self.node.handle(now(), Input::Values { first, values }, self.catalog);
    }

    async fn drain(&mut self, socket: &mut TcpSocket<'_>, piece: &mut [u8]) -> NodeStep {
        loop {
            let is_written = match self.node.poll_output(now(), self.catalog, piece) {
                NodeOutput::Open => return NodeStep::Open,
                NodeOutput::Sleep { until } => return NodeStep::Sleep { until },
                NodeOutput::Busy => true,
                NodeOutput::Keep { bd_seq } => {
                    if !self.pulse.idle(pin!(self.store.keep_session(bd_seq))).await {
                        warn!("edge node: the number of the session cannot be kept");
                    }
                    true
                }
                NodeOutput::Send(bytes) => self.pulse.idle(pin!(write(socket, bytes))).await,
                NodeOutput::Close => {
                    socket.close();
                    let _ = self.pulse.idle(pin!(with_timeout(CLOSE_TIME, socket.flush()))).await;
                    reset(socket).await;
                    true
                }
            };
            if !is_written {
                self.lost(socket).await;
            }
            // A birth consists of many pieces.
            self.pulse.idle(pin!(yield_now())).await;
        }
    }

    /// Connects to the broker; sampling continues meanwhile.
    async fn open(&mut self, stack: Stack<'_>, document: &NodeDocument, socket: &mut TcpSocket<'_>) {
        let connected = {
            let connecting = async {
                // Without an address every attempt would fail at once.
                stack.wait_config_up().await;
                let address = resolve(stack, &document.host).await?;
                socket.connect(IpEndpoint::new(address, document.port)).await.ok()
            };
            let mut connecting = pin!(connecting);
            let until = Instant::now() + OPEN_TIME;
            loop {
                let waiting = select3(connecting.as_mut(), Timer::at(self.sample_at), Timer::at(until));
                match self.pulse.idle(pin!(waiting)).await {
                    Either3::First(connected) => break connected.is_some(),
                    Either3::Second(()) => self.sample().await,
                    Either3::Third(()) => break false,
                }
            }
        };
        match connected {
            true => self.node.handle(now(), Input::Opened, self.catalog),
            false => self.lost(socket).await,
        }
    }

    async fn lost(&mut self, socket: &mut TcpSocket<'_>) {
        reset(socket).await;
        self.node.handle(now(), Input::Closed, self.catalog);
    }

    /// Publishes the status to the console and logs changes.
    fn tell(&mut self, document: &NodeDocument) {
        let is_online = self.node.is_online();
        let failure = self.node.failure();
        self.edge.view.set(View::Runs(EdgeStatus {
            is_online,
            failure,
            bd_seq: self.node.bd_seq(),
            metrics: self.catalog.len(),
            counters: self.node.counters(),
        }));
        match failure {
            _ if is_online && !self.was_online => {
                (self.was_online, self.logged) = (true, None);
                info!("edge node: online at {}", document.host.as_str());
            }
            Some(failure) if !is_online && (self.was_online || self.logged != Some(failure)) => {
                (self.was_online, self.logged) = (false, Some(failure));
                warn!("edge node: {}; trying again", DisplayText(&failure));
            }
            _ => {}
        }
    }
}

/// Writes all bytes to the socket; false on timeout or error.
async fn write(socket: &mut TcpSocket<'_>, mut bytes: &[u8]) -> bool {
    let writing = async {
        while !bytes.is_empty() {
            match socket.write(bytes).await {
                Ok(count @ 1..) => bytes = bytes.get(count..).unwrap_or(&[]),
                _ => return false,
            }
        }
        true
    };
    with_timeout(WRITE_TIME, writing).await.unwrap_or(false)
}

async fn reset(socket: &mut TcpSocket<'_>) {
    socket.abort();
    let _ = with_timeout(RESET_TIME, socket.flush()).await;
}

/// Metrics sampled per borrow of the engine.
const PLACES: usize = 32;
/// Receive buffer of the socket; a broker sends little.
const RX: usize = 512;
/// Transmit buffer: several pieces of a birth.
const TX: usize = 2_048;
/// Bytes per read.
const READ: usize = 256;
/// Limit of connecting, including DHCP and DNS.
const OPEN_TIME: Duration = Duration::from_secs(20);
/// Limit of a write that makes no progress.
const WRITE_TIME: Duration = Duration::from_secs(10);
/// TCP timeout: limit of unacknowledged data.
const SILENT: Duration = Duration::from_secs(15);
/// Limit of closing a connection.
const CLOSE_TIME: Duration = Duration::from_millis(500);
/// Time for the reset of a connection to be sent.
const RESET_TIME: Duration = Duration::from_millis(100);
