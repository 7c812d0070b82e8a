//! The console's server: the API of docs/api.md over HTTP, for the gateway and the simulated controller.
//!
//! It runs on an ordinary thread. It takes snapshots of the gateway at most ten times a second for all clients
//! together, and never blocks the gateway's thread.

mod api;
mod check;
mod frames;
mod http;
mod key_file;
mod pendant;
mod reading;
mod reply;
mod snapshots;
mod store;
mod stream;
mod supervisor;

use std::cell::{Cell, RefCell};
use std::net::{SocketAddr, TcpListener};
use std::path::PathBuf;
use std::rc::Rc;
use std::sync::{Arc, mpsc as blocking};
use std::thread::JoinHandle;

use recipe_api::guard::Guard;
use recipe_api::key::Key;
use recipe_api::route::Served;
use recipe_capture::Watch;
use recipe_io::log_limit::LogLimit;
use recipe_io::random::random;
use recipe_io::timer::now;
use serde_json::{Value, json};
use tokio::sync::Notify;
use tracing::{Span, info};

use crate::client::RuntimeClient;
use crate::host::{self, ForegroundRun, Handle};
use crate::log::Log;
use crate::publisher::Publisher;
use crate::worker::RuntimePlace;
use crate::{RunError, RunOptions};
pub use key_file::read_key;
use snapshots::Snapshots;
pub use supervisor::ConfigFile;
pub(crate) use supervisor::Supervised;

/// Stack size of the console's thread, which builds engines by value.
const STACK: usize = 16 << 20;

/// Nice value of the console's thread.
const NICENESS: i32 = 10;

/// Options of a console.
#[derive(Debug, Clone)]
pub struct ConsoleOptions {
    /// The address to listen on; port 0: any.
    pub address: SocketAddr,
    /// The key. Without a key nothing can be changed, and only this machine is served.
    pub key: Option<Key>,
    /// The folder for the last revisions of the configuration; without a folder they end with the process.
    pub state: Option<PathBuf>,
    /// The port of the other program's console on this machine: the controller's for a gateway, and the reverse.
    pub peer: Option<u16>,
}

/// A socket that listens and is not served yet.
#[derive(Debug)]
pub(crate) struct Bound {
    listener: TcpListener,
    address: SocketAddr,
    key: Option<Key>,
    peer: Option<u16>,
}

impl ConsoleOptions {
    pub(crate) fn bind(&self) -> Result<Bound, RunError> {
        let refused =
            |why: &dyn std::fmt::Display| RunError::new(format!("--console {}: {why}", self.address));
        if !self.address.ip().to_canonical().is_loopback() && self.key.is_none() {
            return Err(refused(&"other machines are served only with a key; add --console-key FILE"));
        }
        let bound = TcpListener::bind(self.address).and_then(|listener| {
            listener.set_nonblocking(true)?;
            let address = listener.local_addr()?;
            Ok(Bound { listener, address, key: self.key.clone(), peer: self.peer })
        });
        bound.map_err(|error| refused(&error))
    }
}

/// What a console serves.
#[derive(Debug)]
pub(crate) enum ConsoleSource {
    /// A gateway that can be given another configuration.
    Gateway {
        shared: Arc<supervisor::SharedView>,
        commands: blocking::Sender<supervisor::SupervisorCommand>,
        watch: Watch,
    },
    /// A simulated controller, and the address of its control socket.
    Controller { client: RuntimeClient, control: SocketAddr },
}

impl ConsoleSource {
    fn served(&self) -> Served {
        match self {
            Self::Gateway { .. } => Served::Gateway,
            Self::Controller { .. } => Served::Controller,
        }
    }
}

/// A console that is being served until it is dropped.
#[derive(Debug)]
pub(crate) struct Console {
    address: SocketAddr,
    end: Arc<Notify>,
    thread: Option<JoinHandle<()>>,
}

impl Console {
    /// Serves a socket on a thread of its own.
    pub(crate) fn start(bound: Bound, source: ConsoleSource, log: Option<Log>) -> Result<Self, RunError> {
        let refused = |error: std::io::Error| RunError::new(format!("console: {error}"));
        let Bound { listener, address, key, peer } = bound;
        let end = Arc::new(Notify::new());
        let ended = Arc::clone(&end);
        let guard = Guard::new(key, random().map_err(refused)?);
        let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build().map_err(refused)?;
        let listener = {
            let _inside = runtime.enter();
            tokio::net::TcpListener::from_std(listener).map_err(refused)?
        };
        let span = Span::current();
        let serve = move || {
            let _of = span.entered();
            // The gateway's thread goes first even without real-time priority.
            let _ = rustix::process::setpriority_process(Some(rustix::thread::gettid()), NICENESS);
            let server = Rc::new(ConsoleServer {
                address,
                peer,
                source,
                guard: RefCell::new(guard),
                snapshots: Snapshots::default(),
                connections: Cell::new(0),
                streams: Cell::new(0),
                counters: Cell::default(),
                log,
                log_limit: LogLimit::default(),
                started: now(),
            });
            let local = tokio::task::LocalSet::new();
            local.block_on(&runtime, async {
                tokio::select! {
                    () = server.accept(listener) => {}
                    () = ended.notified() => {}
                }
            });
        };
        let thread = std::thread::Builder::new().name("console".to_owned()).stack_size(STACK).spawn(serve);
        let thread = Some(thread.map_err(refused)?);
        info!(%address, "the console is served");
        Ok(Self { address, end, thread })
    }

    pub(crate) fn address(&self) -> SocketAddr {
        self.address
    }
}

impl Drop for Console {
    fn drop(&mut self) {
        self.end.notify_one();
        if let Some(thread) = self.thread.take() {
            let _ = thread.join();
        }
    }
}

/// Runs a gateway with a console, which can replace its configuration, until Ctrl-C, SIGTERM or SIGHUP.
pub fn run_gateway(file: ConfigFile, console: &ConsoleOptions, options: &RunOptions) -> Result<(), RunError> {
    let publisher = options.sparkplug.clone().map(Publisher::start).transpose()?;
    let snapshot_watch = publisher.as_ref().map(Publisher::snapshot_watch);
    let supervised = Supervised::start(file, options, console, snapshot_watch, RuntimePlace::alone())?;
    host::foreground(Box::new(supervised), options)
}

#[derive(Debug)]
pub(crate) struct Consoled {
    ready: Value,
    /// Dropped first, so no requests are answered during the shutdown.
    console: Option<Console>,
    handle: Handle,
}

impl Consoled {
    pub(crate) fn start(bound: Bound, handle: Handle, log: Option<Log>) -> Result<Self, RunError> {
        let control = handle.place("control").parse();
        let control = control.map_err(|error| RunError::new(format!("control socket: {error}")))?;
        let console =
            Console::start(bound, ConsoleSource::Controller { client: handle.client(), control }, log)?;
        let mut ready = handle.ready().clone();
        ready["console"] = json!(console.address());
        Ok(Self { ready, console: Some(console), handle })
    }
}

impl ForegroundRun for Consoled {
    fn ready(&self) -> &Value {
        &self.ready
    }

    fn stats(&self) -> Option<Value> {
        self.handle.stats()
    }

    fn clients(&self) -> Vec<RuntimeClient> {
        vec![self.handle.client()]
    }

    fn has_ended(&self) -> bool {
        self.handle.has_ended()
    }

    fn shutdown(mut self: Box<Self>) -> Result<(), RunError> {
        self.console = None;
        self.handle.shutdown()
    }
}

struct ConsoleServer {
    address: SocketAddr,
    peer: Option<u16>,
    source: ConsoleSource,
    guard: RefCell<Guard>,
    snapshots: Snapshots,
    connections: Cell<usize>,
    streams: Cell<usize>,
    counters: Cell<ServerCounters>,
    log: Option<Log>,
    log_limit: LogLimit,
    started: proto_core::time::Instant,
}

#[derive(Debug, Clone, Copy, Default, serde::Serialize)]
struct ServerCounters {
    connections: u64,
    /// Connections turned away because there were too many.
    turned_away: u64,
    /// Requests that did not arrive in time, or were cut off.
    incomplete: u64,
    /// Responses and streams ended because the client did not read.
    slow_readers: u64,
    /// Events that streams left out because their client reads slowly.
    lost_events: u64,
    /// Frames that streams left out.
    lost_frames: u64,
}

impl ConsoleServer {
    fn count(&self, change: impl FnOnce(&mut ServerCounters)) {
        let mut counters = self.counters.get();
        change(&mut counters);
        self.counters.set(counters);
    }
}
