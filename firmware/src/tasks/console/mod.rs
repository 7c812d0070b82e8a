//! The console: the API of docs/api.md over HTTP.
//!
//! In: connections, a button. Out: replies, and requests to the store task. Does not know flash; access control is in
//! `recipe_api`.
//!
//! There are [`CONNECTIONS`] tasks; each serves one request per connection. Documents are written in pieces: a task
//! borrows the engine, writes at most a port or 32 variables into its buffer, and yields before it sends the piece. So
//! the engine never waits for a socket, but the parts of a document may describe slightly different instants.

mod answer;
mod arguments;
mod change;
mod connection;
mod documents;
mod edge;
mod firmware;
mod frames;
mod read;
mod stream;

use core::cell::{Cell, RefCell};
use core::pin::pin;

use embassy_time::{Duration, Instant, Timer};
use heapless::String;
use recipe_api::claim::Claim;
use recipe_api::guard::Guard;
use recipe_api::key::Key;
use recipe_sparkplug::document::NodeDocument;

use super::edge::Edge;
use super::gateway::Gateway;
use super::store::StoreHandle;
use super::time::WallClock;
use super::watchdog::Pulse;
use crate::clock::now;
use crate::identity::NAME;
use crate::info;
use crate::platform::{Button, Ports};
pub use connection::ConnectionBuffers;

/// Number of connections.
pub const CONNECTIONS: usize = 4;
/// Maximum number of streams; the other connections remain available for requests.
pub const STREAMS: usize = 2;
/// The TCP port.
pub const PORT: u16 = 80;

/// State shared by all connections.
pub struct Console {
    gateway: &'static Gateway,
    /// `None` if the board has no store.
    store: Option<&'static StoreHandle>,
    ports: Ports,
    node: NodeView,
    name: String<NAME>,
    guard: RefCell<Guard>,
    claim: Cell<Claim>,
    counters: Cell<ConnectionCounters>,
    connections: Cell<usize>,
    streams: Cell<usize>,
    /// The frame tap has a reader.
    is_followed: Cell<bool>,
    identify_until: Cell<Instant>,
}

/// The edge node as seen by clients.
#[derive(Clone, Copy)]
pub struct NodeView {
    /// State of the edge node.
    pub edge: &'static Edge,
    /// Its settings, if there are any.
    pub document: Option<&'static NodeDocument>,
    /// UTC, if known.
    pub clock: &'static WallClock,
}

#[derive(Debug, Clone, Copy, Default, serde::Serialize)]
struct ConnectionCounters {
    connections: u32,
    /// Streams refused because of [`STREAMS`].
    turned_away: u32,
    /// Requests that timed out or were cut off.
    incomplete: u32,
    /// Replies and streams aborted because the client did not read.
    slow_readers: u32,
    /// Events skipped because their client reads slowly.
    lost_events: u32,
    /// Replies that were truncated because they did not fit into the buffer.
    cut_off: u32,
}

impl Console {
    /// Creates the console. `secret` must be random.
    pub fn new(
        gateway: &'static Gateway,
        store: Option<&'static StoreHandle>,
        ports: Ports,
        node: NodeView,
        name: String<NAME>,
        key: Option<[u8; 16]>,
        secret: [u8; 32],
    ) -> Self {
        Self {
            gateway,
            store,
            ports,
            node,
            name,
            claim: Cell::new(Claim::at_start(key.is_some())),
            guard: RefCell::new(Guard::new(key.map(Key::new), secret)),
            counters: Cell::default(),
            connections: Cell::new(0),
            streams: Cell::new(0),
            is_followed: Cell::new(false),
            identify_until: Cell::new(Instant::MIN),
        }
    }

    /// Whether the LED has to identify the board.
    pub fn is_identifying(&self) -> bool {
        Instant::now() < self.identify_until.get()
    }

    /// Polls the button forever. A button that is down at the start is ignored until released: it may be stuck or
    /// missing.
    pub async fn watch(&self, pulse: &Pulse, mut button: impl Button) -> ! {
        let mut was_pressed = true;
        loop {
            let is_pressed = button.is_pressed();
            if is_pressed && !was_pressed {
                self.pressed();
            }
            was_pressed = is_pressed;
            pulse.idle(pin!(Timer::after(BUTTON))).await;
        }
    }

    fn pressed(&self) {
        let mut claim = self.claim.get();
        claim.pressed(now());
        self.claim.set(claim);
        match claim {
            Claim::Open { .. } => info!("the button was pressed: a key is taken for 60 s"),
            _ => info!("the button was pressed, but there is a key already"),
        }
    }

    fn count(&self, count: impl FnOnce(&mut ConnectionCounters) -> &mut u32) {
        let mut counters = self.counters.get();
        let counter = count(&mut counters);
        *counter = counter.wrapping_add(1);
        self.counters.set(counters);
    }
}

/// Counts a connection or stream until dropped.
struct ConnectionPermit<'a>(&'a Cell<usize>);

impl<'a> ConnectionPermit<'a> {
    /// Counts one more; `None` if there are `most` already.
    fn of(count: &'a Cell<usize>, most: usize) -> Option<Self> {
        (count.get() < most).then(|| {
            count.set(count.get().saturating_add(1));
            Self(count)
        })
    }
}

impl Drop for ConnectionPermit<'_> {
    fn drop(&mut self) {
        self.0.set(self.0.get().saturating_sub(1));
    }
}

/// Polling interval of the button.
const BUTTON: Duration = Duration::from_millis(50);
/// Limit of receiving a request, and of each write of a reply.
const MAX_TIME: Duration = Duration::from_secs(5);
/// Limit of a reply sent in pieces, in total.
const MAX_ANSWER: Duration = Duration::from_secs(10);
