//! The console: the API of docs/api.md over HTTP.
//!
//! In: connections, a button. Out: answers, and requests to the store task. Decides nothing about who may do what,
//! which is `recipe_api`'s, and knows no flash. There are as many tasks as connections ([`CONNECTIONS`]); each serves
//! one request and closes. The engine is looked at in pieces: for each piece of a document a task borrows it, writes
//! at most a port or 32 variables into its own memory, and lets the others run before the piece is sent. So nobody
//! waits for a socket, and a document may show its parts at slightly different instants.

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
use recipe_sparkplug::document::Document;

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
/// Of them streams: the others are always for requests.
pub const STREAMS: usize = 2;
/// The TCP port.
pub const PORT: u16 = 80;

/// What all connections share.
pub struct Console {
    gateway: &'static Gateway,
    /// `None` if the board keeps nothing.
    store: Option<&'static StoreHandle>,
    /// Those of the board.
    ports: Ports,
    node: NodeView,
    name: String<NAME>,
    guard: RefCell<Guard>,
    claim: Cell<Claim>,
    counters: Cell<Counters>,
    connections: Cell<usize>,
    streams: Cell<usize>,
    /// Somebody follows the frames.
    is_followed: Cell<bool>,
    identify_until: Cell<Instant>,
}

/// The edge node, as far as clients see it.
#[derive(Clone, Copy)]
pub struct NodeView {
    /// How it does.
    pub edge: &'static Edge,
    /// Its settings, if it has some.
    pub document: Option<&'static Document>,
    /// Whether it knows UTC.
    pub clock: &'static WallClock,
}

/// Counters of connections. They wrap.
#[derive(Debug, Clone, Copy, Default, serde::Serialize)]
struct Counters {
    /// Connections.
    connections: u32,
    /// Streams that were refused, because there were too many.
    turned_away: u32,
    /// Requests that did not arrive in time, or were cut off.
    incomplete: u32,
    /// Answers and streams that were ended because the client did not read.
    slow_readers: u32,
    /// Events that streams left out because their client reads slowly.
    lost_events: u32,
    /// Replies that did not fit into the buffer and were cut off.
    cut_off: u32,
}

impl Console {
    /// For this gateway, which may run nothing. `secret` is random.
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

    /// Whether somebody looks for this board, so that its LED has to show it.
    pub fn is_identifying(&self) -> bool {
        Instant::now() < self.identify_until.get()
    }

    /// Looks at the button, for ever. Held down since the start it is not a press, as a button that is stuck, or not
    /// there, would be one.
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

    fn count(&self, count: impl FnOnce(&mut Counters) -> &mut u32) {
        let mut counters = self.counters.get();
        let counter = count(&mut counters);
        *counter = counter.wrapping_add(1);
        self.counters.set(counters);
    }
}

/// One more, as long as it exists.
struct ConnectionPermit<'a>(&'a Cell<usize>);

impl<'a> ConnectionPermit<'a> {
    /// Unless there are `most`.
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

/// How often the button is looked at.
const BUTTON: Duration = Duration::from_millis(50);
/// How long a request may take to arrive, and how long an answer may wait for its client.
const MAX_TIME: Duration = Duration::from_secs(5);
/// How long an answer in pieces may take as a whole.
const MAX_ANSWER: Duration = Duration::from_secs(10);
