//! The edge node of Sparkplug: tells a broker what the gateway knows (docs/fleet.md section 6).
//!
//! In: the status of the gateway, in parts between which the other tasks run; bytes of the broker; UTC. Out: bytes for
//! the broker, the number of each session for the store task, a view for the console. What is told when is decided in
//! `recipe_sparkplug`. It has a socket and memory of its own and never waits for the engine: a broker that is away,
//! slow or hostile costs the cell nothing.

use core::cell::Cell;
use core::pin::pin;

use embassy_futures::select::{Either, Either3, select, select3};
use embassy_futures::yield_now;
use embassy_net::tcp::TcpSocket;
use embassy_net::{IpEndpoint, Stack};
use embassy_time::{Duration, Instant, Timer, with_timeout};
use heapless::Vec;
use proto_core::config::ConfigView;
use proto_core::time::{Duration as Span, Instant as Time};
pub use recipe_sparkplug::document::Document;
use recipe_sparkplug::document::DocumentError;
use recipe_sparkplug::gateway::{GatewayCatalog, Rates};
use recipe_sparkplug::node::{Counters, EdgeNode, Failure, Input, MIN_BUFFER, NodeError, Output};
use recipe_sparkplug::value::Value;

use super::gateway::Gateway;
use super::link::resolve;
use super::store::StoreHandle;
use super::time::WallClock;
use super::watchdog::Pulse;
use crate::clock::now;
use crate::fmt::Text;
use crate::{info, warn};

/// Room for metrics.
pub const METRICS: usize = 256;
/// Room for values while nobody listens.
pub const HISTORY: usize = 192;

type Catalog = GatewayCatalog<'static, METRICS>;

/// The memory of the node; all zeros, so that it takes no flash.
pub struct NodeMemory {
    /// The settings.
    pub document: Document,
    /// What the node needs beside them.
    pub rest: NodeBuffers,
}

/// The memory of the node without its settings.
pub struct NodeBuffers {
    node: EdgeNode<METRICS, HISTORY>,
    values: Vec<Option<Value>, METRICS>,
    rx: [u8; RX],
    tx: [u8; TX],
    /// A piece of what is sent, and of what was received.
    piece: [u8; MIN_BUFFER],
    read: [u8; READ],
}

impl NodeMemory {
    /// Before the settings are known.
    pub const ZEROED: Self = Self {
        document: Document::empty(),
        rest: NodeBuffers {
            node: EdgeNode::idle(),
            values: Vec::new(),
            rx: [0; RX],
            tx: [0; TX],
            piece: [0; MIN_BUFFER],
            read: [0; READ],
        },
    };
}

/// Why a board with settings does not tell.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum EdgeError {
    /// No configuration runs.
    NothingRuns,
    /// The settings cannot be read.
    Settings(DocumentError),
    /// There are more metrics than there is room for.
    Metrics,
    /// The configuration has names that a broker does not take.
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

/// What a client sees of the node.
#[derive(Debug, Clone, Copy)]
pub enum View {
    /// There are no settings.
    Off,
    /// There are, but nothing is told.
    Cannot(EdgeError),
    /// It tells, or tries to.
    Runs(EdgeStatus),
}

/// How a node does.
#[derive(Debug, Clone, Copy)]
pub struct EdgeStatus {
    /// Whether there is a session.
    pub is_online: bool,
    /// Why not.
    pub failure: Option<Failure>,
    /// The number of the session.
    pub bd_seq: Option<u8>,
    /// How many metrics there are.
    pub metrics: usize,
    /// Counts since the start.
    pub counters: Counters,
}

/// Between the node and the console.
pub struct Edge {
    view: Cell<View>,
    /// What is kept for the next start, if it is not what runs: whether something will be told.
    next: Cell<Option<bool>>,
}

impl Edge {
    /// Of a board that tells nothing.
    pub const fn off() -> Self {
        Self { view: Cell::new(View::Off), next: Cell::new(None) }
    }

    /// What a client sees.
    pub fn view(&self) -> View {
        self.view.get()
    }

    /// Notes why there is no node.
    pub fn cannot(&self, why: EdgeError) {
        self.view.set(View::Cannot(why));
    }

    /// What is kept for the next start, if it was sent since this one: whether something will be told.
    pub fn next(&self) -> Option<bool> {
        self.next.get()
    }

    /// Notes what was kept for the next start.
    pub fn keeps(&self, tells: bool) {
        self.next.set(Some(tells));
    }
}

/// A node that was made, with everything that it needs.
pub struct Node {
    document: &'static Document,
    catalog: Catalog,
    rest: &'static mut NodeBuffers,
}

impl Node {
    /// Makes the node of what runs. `bd_seq` is the number of the last session; `seed` is another one at each start.
    ///
    /// # Errors
    /// Why there is none.
    pub fn make(
        document: &'static Document,
        rest: &'static mut NodeBuffers,
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
        let catalog = gateway.report(|status| Catalog::new(config, status, rates, env!("CARGO_PKG_VERSION")));
        let catalog = catalog.map_err(|_| EdgeError::Metrics)?;
        rest.node.configure(&document.settings, &catalog, bd_seq, seed).map_err(EdgeError::Node)?;
        let _ = rest.values.resize(catalog.len(), None);
        Ok(Self { document, catalog, rest })
    }

    /// Drives the node, for ever.
    pub async fn run(
        &mut self,
        gateway: &Gateway,
        pulse: &Pulse,
        stack: Stack<'_>,
        store: &StoreHandle,
        edge: &Edge,
        clock: &WallClock,
    ) -> ! {
        let Self { document, catalog, rest: NodeBuffers { node, values, rx, tx, piece, read } } = self;
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
            values,
            period: Duration::from_micros(document.sample.as_micros()),
            sample_at: Instant::now(),
            was_online: false,
            told: None,
        };
        // Births have values and dates from the first one on.
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
                    true => socket.read(read).await,
                    false => core::future::pending().await,
                }
            };
            let next = pulse.idle(pin!(select(reading, Timer::at(until)))).await;
            match next {
                Either::First(Ok(count @ 1..)) => {
                    let bytes = read.get(..count).unwrap_or(&[]);
                    driver.node.handle(now(), Input::Bytes(bytes), driver.catalog);
                }
                Either::First(_) => driver.lost(&mut socket).await,
                Either::Second(()) => {}
            }
            if Instant::now() >= driver.sample_at {
                driver.sample().await;
            }
            // A broker that sends without end lets the others run.
            pulse.idle(pin!(yield_now())).await;
        }
    }
}

/// What comes of outputs.
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
    catalog: &'a Catalog,
    node: &'a mut EdgeNode<METRICS, HISTORY>,
    values: &'a mut [Option<Value>],
    period: Duration,
    sample_at: Instant,
    was_online: bool,
    told: Option<Failure>,
}

impl NodeDriver<'_> {
    /// Looks at the gateway, part by part, and gives the node what it has seen.
    async fn sample(&mut self) {
        // After a pause the next one is a period later: values are of now, not of then.
        self.sample_at = Instant::now() + self.period;
        let uptime = Span::from_micros(Instant::now().as_micros());
        let counters = self.node.counters();
        let mut start = 0_usize;
        while start < self.values.len() {
            let part = start..start.saturating_add(PLACES);
            self.gateway.report(|status| {
                self.catalog.sample_part(status, uptime, &counters, part.clone(), self.values);
            });
            start = part.end;
            self.pulse.idle(pin!(yield_now())).await;
        }
        let alive = self.gateway.report(|status| self.catalog.alive(status));
        let at = now();
        if let Some(utc_ms) = self.clock.utc_ms(at) {
            self.node.handle(at, Input::Time { utc_ms }, self.catalog);
        }
        self.node.handle(at, Input::Sample { values: self.values, alive }, self.catalog);
    }

    /// Does what the node asks for, until it waits.
    async fn drain(&mut self, socket: &mut TcpSocket<'_>, piece: &mut [u8]) -> NodeStep {
        loop {
            let is_written = match self.node.poll_output(now(), self.catalog, piece) {
                Output::Open => return NodeStep::Open,
                Output::Sleep { until } => return NodeStep::Sleep { until },
                Output::Busy => true,
                Output::Keep { bd_seq } => {
                    if !self.pulse.idle(pin!(self.store.keep_session(bd_seq))).await {
                        warn!("edge node: the number of the session cannot be kept");
                    }
                    true
                }
                Output::Send(bytes) => self.pulse.idle(pin!(write(socket, bytes))).await,
                Output::Close => {
                    socket.close();
                    let _ = self.pulse.idle(pin!(with_timeout(CLOSE_TIME, socket.flush()))).await;
                    reset(socket).await;
                    true
                }
            };
            if !is_written {
                self.lost(socket).await;
            }
            // A birth is many pieces.
            self.pulse.idle(pin!(yield_now())).await;
        }
    }

    /// Makes the connection. Samples go on meanwhile.
    async fn open(&mut self, stack: Stack<'_>, document: &Document, socket: &mut TcpSocket<'_>) {
        let connected = {
            let connecting = async {
                // Before it has an address every attempt fails at once.
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

    /// Shows how it does; a change is logged.
    fn tell(&mut self, document: &Document) {
        let is_online = self.node.is_online();
        let failure = self.node.failure();
        self.edge.view.set(View::Runs(EdgeStatus {
            is_online,
            failure,
            bd_seq: self.node.bd_seq(),
            metrics: self.values.len(),
            counters: self.node.counters(),
        }));
        match failure {
            _ if is_online && !self.was_online => {
                (self.was_online, self.told) = (true, None);
                info!("edge node: online at {}", document.host.as_str());
            }
            Some(failure) if !is_online && (self.was_online || self.told != Some(failure)) => {
                (self.was_online, self.told) = (false, Some(failure));
                warn!("edge node: {}; trying again", Text(&failure));
            }
            _ => {}
        }
    }
}

/// Gives all bytes to the network; false if it does not take them.
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

/// Metrics that are looked at between two turns of the other tasks.
const PLACES: usize = 32;
/// Receive buffer of the socket: a broker has little to say.
const RX: usize = 512;
/// Transmit buffer: some pieces of a birth.
const TX: usize = 2_048;
/// Bytes that are read at once.
const READ: usize = 256;
/// How long a connection may take, with the board's address and the look-up of a name.
const OPEN_TIME: Duration = Duration::from_secs(20);
/// How long the broker may take nothing.
const WRITE_TIME: Duration = Duration::from_secs(10);
/// How long its TCP may acknowledge nothing.
const SILENT: Duration = Duration::from_secs(15);
/// How long the end of a connection may take.
const CLOSE_TIME: Duration = Duration::from_millis(500);
/// For the reset of a connection.
const RESET_TIME: Duration = Duration::from_millis(100);
