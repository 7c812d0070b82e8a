//! The gateway's engine on real sockets and devices.
//!
//! Everything runs on one thread. Input of a device or socket is reported to the engine at once, and the
//! outputs are carried out before anything else is read. So only one call of the engine is between the last
//! byte of a field frame and the request to the controller.

mod doctor;
mod shown;
mod tapping;

use std::cell::{Cell, RefCell};
use std::collections::{BTreeMap, BTreeSet};
use std::rc::Rc;
use std::sync::Arc;
use std::sync::mpsc::SyncSender;
use std::time::SystemTime;

use proto_core::config::{Bus, GatewayConfig, Parts, Port as PortConfig, image};
use proto_core::engine::{Input, LinkId, LinkKind, OUTPUT_BUFFER, Output, PortId, Transport};
use proto_core::sysvar::Direction;
use proto_core::time::Instant;
use serde_json::{Value, json};
use tokio::net::{TcpListener, UdpSocket};
use tokio::sync::Notify;
use tokio::task::JoinSet;
use tracing::{info, trace, warn};

pub use doctor::listen;

use super::console::window::{MAX_SAFE, Window};
use super::console::{self, ConfigFile, Supervised};
use super::host::{self, Handle, Shell};
use super::link::{self, Endpoint, LinkControl, LinkEvent};
use super::{RunOptions, StartError};
use recipe_capture::{Cell as Watched, Epoch, Watch};
use recipe_device::bind::Bind;
use recipe_device::exchange::{PortEvent, PortTx};
use recipe_device::port::{Port, PortBus};
use recipe_doctor::PortRecord;
use recipe_net::fairness;
use recipe_net::realtime::{self, Scheduling};
use recipe_net::tcp_options;
use recipe_net::timer::{Timer, now};
use shown::Shown;
use tapping::{TAP, Tapping};

/// The engine with room for a tap.
pub(crate) type Engine = proto_core::engine::Engine<8, 4, 512, TAP>;

/// Who looks at a gateway.
#[derive(Debug, Clone, Default)]
pub(crate) struct Observers {
    /// Captures and recordings.
    pub watch: Watch,
    /// A console.
    pub window: Option<Arc<Window>>,
    /// Whoever reads the log or the statistics, where findings are told.
    pub readers: bool,
}

impl Observers {
    pub(crate) fn of(options: &RunOptions) -> Self {
        let readers = options.stats.is_some() || tracing::enabled!(tracing::Level::INFO);
        Self { watch: options.watch.clone(), window: None, readers }
    }
}

/// A gateway with its ports and links, before it runs.
struct Gateway {
    core: Rc<Core>,
    ports: Vec<(PortId, Port)>,
    links: Vec<(LinkId, LinkKind, Endpoint)>,
    ready: Value,
    window: Option<Arc<Window>>,
    /// Who looks at it once a second, if somebody does.
    doctor: Option<SyncSender<doctor::Snapshot>>,
}

/// What the gateway may send.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Voice {
    /// Everything.
    Full,
    /// Nothing, neither to the controller nor to the field.
    Silent,
    /// Nothing to the controller; to the field, what ports with exchanges send.
    Asking,
}

/// Shared by all tasks of the gateway.
struct Core {
    engine: RefCell<Box<Engine>>,
    tapping: RefCell<Tapping>,
    ports: BTreeMap<PortId, (String, Rc<PortTx>)>,
    links: BTreeMap<LinkId, Rc<LinkControl>>,
    deadline: Cell<Instant>,
    /// The engine's count of sleeps at the last call.
    sleeps: Cell<u32>,
    /// Links that were told of as missing.
    unreachable: RefCell<BTreeSet<LinkId>>,
    deadline_moved: Notify,
    /// Another gateway takes its place: its devices are not listened to any more.
    is_ending: Cell<bool>,
    voice: Voice,
    /// Ports with exchanges.
    asks: BTreeSet<PortId>,
    started: Instant,
    /// What came in at each port lately.
    records: RefCell<Vec<PortRecord>>,
    /// The newest findings, if somebody looks.
    told: RefCell<Option<doctor::Told>>,
}

impl Gateway {
    /// Opens devices and listening sockets.
    async fn open(
        config: &GatewayConfig,
        binds: &[Bind],
        voice: Voice,
        watch: &Watch,
    ) -> Result<Self, StartError> {
        let engine: Box<Engine> =
            Box::new(Engine::new(config).map_err(|error| StartError::new(error.to_string()))?);
        let field = || config.view().field_ports().map(|(_, port, _)| port);
        if let Some(bind) = binds.iter().find(|bind| field().all(|port| port.name != bind.port.as_str())) {
            let names: Vec<_> = field().map(|port| port.name.as_str()).collect();
            let message = format!("--bind {bind}: there is no such port; there are {}", names.join(", "));
            return Err(StartError::new(message));
        }
        let (mut ports, mut records) = (Vec::new(), Vec::new());
        let mut asks = BTreeSet::new();
        for (index, port, recipe) in config.view().field_ports() {
            let mut device = open_port(port, binds).await?;
            if matches!(recipe.parts, Parts::Can { .. }) {
                let ids = |part| config.view().can_ids(recipe, part);
                device.listen_to(ids(Direction::Input).chain(ids(Direction::Output)).collect());
            }
            let mut record = PortRecord::new(PortId(index));
            let bind = binds.iter().find(|bind| port.name == bind.port.as_str());
            record.device = bind.map(|bind| bind.device.to_string()).unwrap_or_default();
            records.push(record);
            if recipe.exchanges.len > 0 {
                asks.insert(PortId(index));
            }
            ports.push((PortId(index), device));
        }
        let mut links = Vec::new();
        for info in engine.links() {
            links.push((info.id, info.kind, open_endpoint(info.endpoint).await?));
        }
        let name = |id: PortId| config.ports.get(usize::from(id.0)).map_or("", |port| port.name.as_str());
        let mut places = serde_json::Map::new();
        for (id, port) in &ports {
            places.insert(name(*id).to_owned(), json!(port.place()));
        }
        for (_, kind, endpoint) in &links {
            if let LinkKind::RecipeTcpListen { port } | LinkKind::RecipeUdpListen { port } = kind {
                places.insert(name(*port).to_owned(), json!(endpoint.place()));
            }
        }
        let tapping = begin_tapping(config, &engine, watch)?;
        let core = Rc::new(Core {
            tapping: RefCell::new(tapping),
            ports: ports.iter().map(|(id, port)| (*id, (name(*id).to_owned(), port.tx()))).collect(),
            links: links.iter().map(|(id, ..)| (*id, Rc::default())).collect(),
            engine: RefCell::new(engine),
            deadline: Cell::new(Instant::NEVER),
            sleeps: Cell::new(0),
            unreachable: RefCell::default(),
            deadline_moved: Notify::new(),
            is_ending: Cell::new(false),
            voice,
            asks,
            started: now(),
            records: RefCell::new(records),
            told: RefCell::default(),
        });
        Ok(Self { core, ports, links, ready: json!({ "ports": places }), window: None, doctor: None })
    }

    async fn drive(self) -> Result<(), StartError> {
        let Self { core: shared, ports, links, window, doctor, .. } = self;
        let mut tasks = JoinSet::new();
        if let Some(window) = window {
            let core = Rc::clone(&shared);
            tasks.spawn_local(async move { core.show(&window).await });
        }
        for (id, port) in ports {
            let core = Rc::clone(&shared);
            tasks.spawn_local(async move {
                let name = core.ports.get(&id).map_or("", |(name, _)| name).to_owned();
                let result = port.run(|event| core.port_event(id, event)).await;
                result.map_err(|error| StartError::new(format!("port {name}: {error}")))
            });
        }
        for (id, kind, endpoint) in links {
            let core = Rc::clone(&shared);
            let Some(control) = core.links.get(&id).cloned() else { continue };
            tasks.spawn_local(async move {
                let is_frame = |datagram: &[u8]| core.engine.borrow().is_frame(id, datagram);
                let events = |event: LinkEvent<'_>| core.link_event(id, event);
                if !core.may_open(id) {
                    link::probe(kind.name(), &endpoint, &control, is_frame).await;
                    return std::future::pending().await;
                }
                link::run(kind.name(), &endpoint, &control, is_frame, events).await;
                Ok(())
            });
        }
        if let Some(doctor) = doctor {
            let core = Rc::clone(&shared);
            tasks.spawn_local(async move { core.be_watched(doctor).await });
        }
        tasks.spawn_local(async move { shared.keep_time().await });
        while let Some(ended) = tasks.join_next().await {
            match ended {
                Ok(done) => done?,
                Err(error) => return Err(StartError::new(format!("a task ended: {error}"))),
            }
        }
        Ok(())
    }
}

impl Shell for Gateway {
    fn ready(&self) -> Value {
        self.ready.clone()
    }

    fn stats(&self) -> impl Fn() -> Value + 'static {
        let core = Rc::clone(&self.core);
        move || core.stats()
    }

    async fn run(self) -> Result<(), StartError> {
        self.drive().await
    }
}

impl Core {
    /// Calls the engine at its deadlines.
    async fn keep_time(&self) -> Result<(), StartError> {
        let clock = |error| StartError::new(format!("timerfd: {error}"));
        let timer = Timer::new().map_err(clock)?;
        self.input(Input::Tick);
        loop {
            timer.arm(self.deadline.get()).map_err(clock)?;
            fairness::set_deadline(self.deadline.get());
            tokio::select! {
                expired = timer.expired() => {
                    expired.map_err(clock)?;
                    // Input that had arrived by the deadline is not overdue.
                    fairness::let_others_run().await;
                    self.input(Input::Tick);
                }
                () = self.deadline_moved.notified() => {}
            }
        }
    }

    /// Fills a console's window when it asks, and brings the safe values out when it wants to end this gateway.
    async fn show(&self, window: &Window) -> Result<(), StartError> {
        loop {
            tokio::select! {
                () = window.wanted.notified() => window.fill(|shot| {
                    shot.engine.clone_from(&self.engine.borrow());
                    shot.at = now();
                    shot.devices = Default::default();
                    for (port, (_, tx)) in &self.ports {
                        if let Some(counters) = shot.devices.get_mut(usize::from(port.0)) {
                            *counters = Some(tx.counters());
                        }
                    }
                }),
                () = window.ending.notified() => {
                    self.is_ending.set(true);
                    self.engine.borrow_mut().make_safe();
                    self.input(Input::Tick);
                    let is_safe = async {
                        while !self.engine.borrow().is_safe() {
                            tokio::time::sleep(SAFE_CHECK).await;
                        }
                    };
                    if tokio::time::timeout(MAX_SAFE, is_safe).await.is_err() {
                        warn!("the controller does not show all safe values; ending all the same");
                    }
                    window.is_safe();
                }
            }
        }
    }

    fn port_event(&self, port: PortId, event: PortEvent<'_>) {
        if self.is_ending.get() && event != PortEvent::Sent {
            return;
        }
        if let Some(record) = self.records.borrow_mut().iter_mut().find(|record| record.port == port) {
            match &event {
                PortEvent::Bytes(bytes) => record.heard(bytes),
                PortEvent::Frame { frame } => record.frame(frame),
                _ => {}
            }
        }
        match event {
            PortEvent::Up => self.input(Input::PortUp { port }),
            PortEvent::Down => self.input(Input::PortDown { port }),
            PortEvent::Bytes(bytes) => self.input(Input::PortBytes { port, bytes }),
            PortEvent::Frame { frame } => self.input(Input::PortCan { port, frame }),
            PortEvent::Bus(state) => self.input(Input::PortBus { port, state }),
            PortEvent::Sent => self.input(Input::PortSent { port }),
        }
    }

    fn link_event(&self, link: LinkId, event: LinkEvent<'_>) {
        match event {
            LinkEvent::Up => {
                self.tell_link(link, true);
                self.input(Input::LinkUp { link });
            }
            LinkEvent::Down => {
                self.tell_link(link, false);
                self.input(Input::LinkDown { link });
            }
            LinkEvent::Bytes(bytes) => self.input(Input::LinkBytes { link, bytes }),
            LinkEvent::Sent => self.input(Input::LinkSent { link }),
            LinkEvent::Acked(left) => self.input(Input::LinkAcked { link, left }),
        }
    }

    /// Tells once when a connection to the controller is missing, and when it is back. What the
    /// controller opens by itself may take days, and some controllers take no second connection for
    /// urgent commands.
    fn tell_link(&self, id: LinkId, is_up: bool) {
        if id == LinkId::URGENT {
            return;
        }
        let engine = self.engine.borrow();
        let Some(info) = engine.links().find(|link| link.id == id) else { return };
        if matches!(info.kind, LinkKind::RecipeTcpListen { .. } | LinkKind::RecipeUdpListen { .. }) {
            return;
        }
        let mut unreachable = self.unreachable.borrow_mut();
        if is_up && unreachable.remove(&id) {
            warn!(link = info.name, "connected to the controller again");
        } else if is_up {
            info!(link = info.name, "connected to the controller");
        } else if unreachable.insert(id) {
            warn!(link = info.name, "no connection to the controller; trying again");
        }
    }

    /// Reports one input and carries out all outputs.
    fn input(&self, input: Input<'_>) {
        let at = now();
        trace!(input = %Shown(&input), "in");
        let mut engine = self.engine.borrow_mut();
        let mut tapping = self.tapping.borrow_mut();
        tapping.before(engine.tap(), at, input);
        engine.handle(at, input);
        let sleeps = engine.sleeps();
        if self.sleeps.replace(sleeps) != sleeps {
            warn!(sleeps, "the gateway slept: waiting input is discarded");
            for (_, tx) in self.ports.values() {
                tx.note_sleep(at);
            }
        }
        let mut buf = [0; OUTPUT_BUFFER];
        loop {
            let output = engine.poll_output(at, &mut buf);
            tapping.output(output);
            match output {
                Output::Sleep { until } => {
                    tapping.behind(engine.tap());
                    if self.deadline.replace(until) != until {
                        self.deadline_moved.notify_one();
                    }
                    return;
                }
                _ => trace!(output = %Shown(&output), "out"),
            }
            if !self.may(&output) {
                continue;
            }
            match output {
                Output::PortSend { port, bytes } => self.with_port(port, |tx| tx.send(bytes)),
                Output::PortSendCan { port, frame } => self.with_port(port, |tx| tx.send_frame(frame)),
                Output::LinkOpen { link, .. } => self.with_link(link, LinkControl::open),
                Output::LinkClose { link } => self.with_link(link, LinkControl::close),
                Output::LinkSend { link, bytes } => self.with_link(link, |control| control.send(bytes)),
                _ => {}
            }
        }
    }

    /// Whether an output may be carried out: the one gate for a gateway that only listens.
    fn may(&self, output: &Output<'_>) -> bool {
        match (self.voice, output) {
            (Voice::Full, _) => true,
            (Voice::Asking, Output::PortSend { port, .. } | Output::PortSendCan { port, .. }) => {
                self.asks.contains(port)
            }
            (_, &Output::LinkOpen { link, .. }) => self.may_open(link),
            (_, Output::LinkClose { .. }) => true,
            _ => false,
        }
    }

    /// Whether a link may be opened. A gateway that only listens reads the state stream, on which nothing
    /// is ever sent.
    fn may_open(&self, link: LinkId) -> bool {
        self.voice == Voice::Full || link == LinkId::STATE
    }

    fn with_port(&self, id: PortId, act: impl FnOnce(&PortTx)) {
        match self.ports.get(&id) {
            Some((_, tx)) => act(tx),
            None => warn!(?id, "the engine sends on an unknown port"),
        }
    }

    fn with_link(&self, id: LinkId, act: impl FnOnce(&LinkControl)) {
        match self.links.get(&id) {
            Some(control) => act(control),
            None => warn!(?id, "the engine uses an unknown link"),
        }
    }

    /// One line of statistics: the engine's status, and the counters of devices and sockets.
    fn stats(&self) -> Value {
        let engine = self.engine.borrow();
        let status = engine.status(now());
        let mut stats = json!(status);
        let values = stats["values"].take();
        let ages = values.as_object().into_iter().flatten();
        let ages = ages.map(|(var, known)| (var.clone(), known["age_ms"].clone()));
        stats["age_ms"] = Value::Object(ages.collect());
        stats["values"] = values;
        for port in status.ports() {
            let shown = &mut stats["ports"][port.name];
            lift(shown, "counters");
            if let Some((_, tx)) = self.ports.get(&port.id) {
                shown["device"] = json!(tx.counters());
            }
        }
        for link in status.links() {
            let shown = &mut stats["links"][link.name];
            lift(shown, "history");
            lift(shown, "counters");
            shown["reconnects"] = json!(link.history.connects.saturating_sub(1));
            if let LinkKind::RecipeTcpListen { .. } | LinkKind::RecipeUdpListen { .. } = link.kind
                && let Some(control) = self.links.get(&link.id)
            {
                shown["turned_away"] = json!(control.refusals());
                lift(shown, "turned_away");
            }
        }
        if let Some(told) = &*self.told.borrow() {
            stats["findings"] = doctor::words(told);
        }
        stats
    }
}

impl Drop for Core {
    fn drop(&mut self) {
        self.tapping.get_mut().end(self.engine.get_mut(), now());
    }
}

/// Begins to tell whoever watches.
fn begin_tapping(config: &GatewayConfig, engine: &Engine, watch: &Watch) -> Result<Tapping, StartError> {
    let at = now();
    let cell = Watched::new(config, engine, Epoch { at, wall: SystemTime::now() });
    let mut bytes = vec![0; image::MAX_IMAGE];
    let len = image::encode(config, &mut bytes).map_err(|error| StartError::new(error.to_string()))?;
    bytes.truncate(len);
    Tapping::begin(watch, cell, at, &bytes)
        .map_err(|error| StartError::new(format!("cannot start a thread: {error}")))
}

/// Moves the entries of the inner object `key` to the outer one.
fn lift(outer: &mut Value, key: &str) {
    if let Some(outer) = outer.as_object_mut()
        && let Some(Value::Object(inner)) = outer.remove(key)
    {
        outer.extend(inner);
    }
}

/// Runs the gateway until Ctrl-C, SIGTERM or SIGHUP. Everything that it tells [`RunOptions::watch`] has been
/// given when this returns.
///
/// # Errors
/// The reason why it could not start; nothing is left behind then.
pub fn run(config: GatewayConfig, options: RunOptions) -> Result<(), StartError> {
    let handle = spawn(config, options.binds.clone(), options.scheduling, Observers::of(&options))?;
    host::foreground(handle, &options)
}

/// Same, with a console that can give it another configuration. Without options for a console it has none.
///
/// # Errors
/// The reason why it could not start; nothing is left behind then.
pub fn run_with_console(file: ConfigFile, options: RunOptions) -> Result<(), StartError> {
    match &options.console {
        Some(console) => host::foreground(Supervised::start(file, &options, console)?, &options),
        None => run(*console::gateway(&file)?, options),
    }
}

/// Starts the gateway on a thread of its own; dropping the handle ends it.
///
/// # Errors
/// The reason why it could not start; nothing is left behind then.
pub fn start(config: GatewayConfig, binds: Vec<Bind>) -> Result<Handle, StartError> {
    start_watched(config, binds, &Watch::new())
}

/// Same as [`start`], for whoever has subscribed to `watch`, which tells of several gateways one after the
/// other if it is given again.
///
/// # Errors
/// The reason why it could not start; nothing is left behind then.
pub fn start_watched(config: GatewayConfig, binds: Vec<Bind>, watch: &Watch) -> Result<Handle, StartError> {
    let observers = Observers { watch: watch.clone(), ..Observers::default() };
    spawn(config, binds, Scheduling::Ordinary, observers)
}

/// Starts the gateway, with those who look at it.
pub(crate) fn spawn(
    config: GatewayConfig,
    binds: Vec<Bind>,
    scheduling: Scheduling,
    observers: Observers,
) -> Result<Handle, StartError> {
    let Observers { watch, window, readers } = observers;
    let watched = watch.clone();
    let handle = host::start("gateway", async move || {
        let mut gateway = Gateway::open(&config, &binds, Voice::Full, &watched).await?;
        gateway.window = window;
        if readers {
            let (doctor, told) = doctor::start(config)?;
            gateway.doctor = Some(doctor);
            gateway.core.told.replace(Some(told));
        }
        // Not as an argument of the log, which is not evaluated unless it is printed.
        let scheduling = realtime::apply(scheduling);
        info!(%scheduling, "the gateway is running");
        Ok(gateway)
    })?;
    Ok(handle.with_watch(watch))
}

/// How often is looked whether the safe values have arrived.
const SAFE_CHECK: std::time::Duration = std::time::Duration::from_millis(5);

async fn open_port(port: &PortConfig, binds: &[Bind]) -> Result<Port, StartError> {
    let name = port.name.as_str();
    let bus = match port.bus {
        Bus::Rs485(settings) => PortBus::Serial(settings),
        Bus::Can { bitrate } => PortBus::Can { bitrate },
        Bus::TcpListen { .. } | Bus::UdpListen { .. } => {
            return Err(StartError::new(format!("port {name} is not a field port")));
        }
    };
    let mut own = binds.iter().filter(|bind| bind.port == name);
    let (Some(bind), None) = (own.next(), own.next()) else {
        let examples = match bus {
            PortBus::Serial(_) => "pty:PATH or serial:/dev/ttyUSB0",
            PortBus::Can { .. } => "socketcan:can0, slcan-tcp:127.0.0.1:0 or slcan-pty:PATH",
        };
        return Err(StartError::new(format!(
            "port {name} needs exactly one device: --bind {name}=DEVICE, such as {examples}"
        )));
    };
    Port::open(&bind.device, bus)
        .await
        .map_err(|error| StartError::new(format!("--bind {name}={}: {error}", bind.device)))
}

async fn open_endpoint(to: proto_core::engine::Endpoint<'_>) -> Result<Endpoint, StartError> {
    if to.host.is_empty() {
        let message = "controller.address is needed: the controller's address or host name";
        return Err(StartError::new(message));
    }
    let host = to.host.to_owned();
    let refused = |address, error| StartError::new(format!("cannot listen on {address}: {error}"));
    Ok(match to.transport {
        Transport::Tcp { port } => Endpoint::Tcp { host, port },
        Transport::Udp { port } => Endpoint::Udp { host, port },
        Transport::TcpListen { local } => {
            let listener = TcpListener::bind(local).await.map_err(|error| refused(local, error))?;
            tcp_options::limit_buffers(&listener);
            Endpoint::TcpListen { listener, controller: host }
        }
        Transport::UdpListen { local } => {
            let socket = UdpSocket::bind(local).await.map_err(|error| refused(local, error))?;
            Endpoint::UdpListen { socket, controller: host }
        }
        other => return Err(StartError::new(format!("unknown kind of link: {other:?}"))),
    })
}

impl Endpoint {
    /// The address of a listening link.
    fn place(&self) -> String {
        let address = match self {
            Self::TcpListen { listener, .. } => listener.local_addr(),
            Self::UdpListen { socket, .. } => socket.local_addr(),
            Self::Tcp { host, port } | Self::Udp { host, port } => return format!("{host}:{port}"),
        };
        address.map_or_else(|_| String::new(), |address| address.to_string())
    }
}

#[cfg(test)]
#[path = "gateway_tests.rs"]
mod tests;
