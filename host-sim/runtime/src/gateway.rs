//! The gateway's engine on real sockets and devices.
//!
//! The engine, devices and sockets share one thread. Input is reported to the engine at once, and its outputs are
//! executed before anything else is read, so a single call of the engine lies between the last byte of a field frame
//! and the request to the controller.

mod doctor;
mod open;
mod shown;
mod tapping;

use std::cell::{Cell, RefCell};
use std::collections::{BTreeMap, BTreeSet};
use std::rc::Rc;
use std::sync::Arc;

use proto_core::config::GatewayConfig;
use proto_core::engine::{Input, LinkId, LinkKind, OUTPUT_BUFFER, Output, PortId};
use proto_core::time::Instant;
use serde_json::{Value, json};
use tokio::sync::Notify;
use tokio::task::JoinSet;
use tracing::{info, trace, warn};

use doctor::Doctor;
pub use doctor::listen;
use open::Devices;

use super::host::{self, Handle, Runtime};
use super::link::{self, LinkControl, LinkEndpoint, LinkEvent};
use super::publisher::{Publisher, SnapshotWatch};
use super::snapshot::{GatewayEngine, GatewaySnapshot, MAX_SAFE, SnapshotSlot};
use super::worker::RuntimePlace;
use super::{RunError, RunOptions};
use recipe_capture::{Decoder, Watch};
use recipe_doctor::PortRecord;
use recipe_io::bind::Bind;
use recipe_io::exchange::{PortEvent, PortTx};
use recipe_io::fairness;
use recipe_io::handover::Handover;
use recipe_io::port::OpenPort;
use recipe_io::realtime::{self, Scheduling};
use recipe_io::timer::{Timer, now};
use shown::TraceText;
use tapping::Tapping;

/// Observers of a gateway.
#[derive(Debug, Clone, Default)]
pub(crate) struct Observers {
    pub watch: Watch,
    /// Decodes frames for subscribers of `watch`.
    pub decoder: Arc<Decoder>,
    pub slot: Option<Arc<SnapshotSlot>>,
    pub snapshot_watch: Option<SnapshotWatch>,
    /// Whether the log or the statistics, which report findings, are read.
    pub readers: bool,
}

impl Observers {
    pub(crate) fn of(options: &RunOptions) -> Self {
        let readers = options.stats.is_some() || tracing::enabled!(tracing::Level::INFO);
        Self {
            watch: options.watch.clone(),
            decoder: Arc::clone(&options.decoder),
            slot: None,
            snapshot_watch: None,
            readers,
        }
    }
}

/// A gateway with its ports and links, before it runs.
struct PreparedGateway {
    core: Rc<Core>,
    ports: Vec<(PortId, OpenPort)>,
    links: Vec<(LinkId, LinkKind, LinkEndpoint)>,
    ready: Value,
    slot: Option<Arc<SnapshotSlot>>,
    publisher_slot: Option<Arc<SnapshotSlot>>,
    /// Examines the gateway once a second.
    doctor: Option<Doctor>,
}

/// Which outputs of the engine are executed.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum TxPolicy {
    All,
    /// No output that sends, neither to the controller nor to the field.
    None,
    /// Outputs of ports with exchanges; nothing to the controller.
    Exchanges,
}

/// Shared by all tasks of the gateway.
struct Core {
    engine: RefCell<Box<GatewayEngine>>,
    tapping: RefCell<Tapping>,
    ports: BTreeMap<PortId, (String, Rc<PortTx>)>,
    links: BTreeMap<LinkId, Rc<LinkControl>>,
    deadline: Cell<Instant>,
    /// The engine's sleep count after the last call.
    sleeps: Cell<u32>,
    /// Links that were logged as down.
    unreachable: RefCell<BTreeSet<LinkId>>,
    deadline_moved: Notify,
    /// The gateway is being replaced: input of its devices is ignored.
    is_ending: Cell<bool>,
    tx_policy: TxPolicy,
    exchange_ports: BTreeSet<PortId>,
    started: Instant,
    /// Recent input of each port.
    records: RefCell<Vec<PortRecord>>,
}

impl PreparedGateway {
    async fn drive(self) -> Result<(), RunError> {
        let Self { core: shared, ports, links, slot, publisher_slot, doctor, .. } = self;
        let mut tasks = JoinSet::new();
        if let Some(slot) = slot {
            let core = Rc::clone(&shared);
            tasks.spawn_local(async move { core.show(&slot).await });
            if doctor.is_none() {
                let core = Rc::clone(&shared);
                tasks.spawn_local(async move { core.keep_notes().await });
            }
        }
        if let Some(publisher_slot) = publisher_slot {
            let core = Rc::clone(&shared);
            tasks.spawn_local(async move { core.show(&publisher_slot).await });
        }
        for (id, port) in ports {
            let core = Rc::clone(&shared);
            tasks.spawn_local(async move {
                let name = core.ports.get(&id).map_or("", |(name, _)| name).to_owned();
                let result = port.run(|event| core.port_event(id, event)).await;
                result.map_err(|error| RunError::new(format!("port {name}: {error}")))
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
                Err(error) => return Err(RunError::new(format!("a task ended: {error}"))),
            }
        }
        Ok(())
    }
}

impl Runtime for PreparedGateway {
    fn ready(&self) -> Value {
        self.ready.clone()
    }

    fn stats(&self) -> impl Fn() -> Value + 'static {
        let core = Rc::clone(&self.core);
        move || core.stats()
    }

    async fn run(self) -> Result<(), RunError> {
        self.drive().await
    }
}

impl Core {
    /// Calls the engine at its deadlines.
    async fn keep_time(&self) -> Result<(), RunError> {
        let clock = |error| RunError::new(format!("timerfd: {error}"));
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

    fn copy_to(&self, snapshot: &mut GatewaySnapshot, at: Instant) {
        snapshot.engine.clone_from(&self.engine.borrow());
        snapshot.at = at;
        snapshot.running = at.saturating_since(self.started);
        snapshot.keep_records(&self.records.borrow());
        snapshot.links.clear();
        snapshot.links.extend(snapshot.engine.links().map(|info| self.facts_of(info.id)));
        snapshot.devices = Default::default();
        for (port, (_, tx)) in &self.ports {
            if let Some(counters) = snapshot.devices.get_mut(usize::from(port.0)) {
                *counters = Some(tx.counters());
            }
        }
    }

    /// Fills a snapshot slot on request, and sends the safe values when the gateway is to end.
    async fn show(&self, slot: &SnapshotSlot) -> Result<(), RunError> {
        loop {
            tokio::select! {
                () = slot.wanted.notified() => slot.fill(|snapshot| self.copy_to(snapshot, now())),
                () = slot.ending.notified() => {
                    self.is_ending.set(true);
                    self.engine.borrow_mut().make_safe();
                    self.tapping.borrow_mut().make_safe(now());
                    self.input(Input::Tick);
                    let is_safe = async {
                        while !self.engine.borrow().is_safe() {
                            tokio::time::sleep(SAFE_CHECK).await;
                        }
                    };
                    if tokio::time::timeout(MAX_SAFE, is_safe).await.is_err() {
                        warn!("the controller does not show all safe values; ending all the same");
                    }
                    slot.is_safe();
                }
            }
        }
    }

    fn port_event(&self, port: PortId, event: PortEvent<'_>) {
        if self.is_ending.get() && event != PortEvent::Sent {
            return;
        }
        // The engine first: its outputs are sent before anything is recorded.
        match event {
            PortEvent::Up => self.input(Input::PortUp { port }),
            PortEvent::Down => self.input(Input::PortDown { port }),
            PortEvent::Bytes(bytes) => {
                self.input(Input::PortBytes { port, bytes });
                self.record(port, |record| record.heard(bytes));
            }
            PortEvent::Frame { frame } => {
                self.input(Input::PortCan { port, frame });
                self.record(port, |record| record.frame(&frame));
            }
            PortEvent::Bus(state) => self.input(Input::PortBus { port, state }),
            PortEvent::Sent => self.input(Input::PortSent { port }),
        }
    }

    fn record(&self, port: PortId, note: impl FnOnce(&mut PortRecord)) {
        if let Some(record) = self.records.borrow_mut().iter_mut().find(|record| record.port == port) {
            note(record);
        }
    }

    fn link_event(&self, link: LinkId, event: LinkEvent<'_>) {
        match event {
            LinkEvent::Up => {
                self.log_link(link, true);
                self.input(Input::LinkUp { link });
            }
            LinkEvent::Down => {
                self.log_link(link, false);
                self.input(Input::LinkDown { link });
            }
            LinkEvent::Bytes(bytes) => self.input(Input::LinkBytes { link, bytes }),
            LinkEvent::Sent => self.input(Input::LinkSent { link }),
            LinkEvent::Acked(left) => self.input(Input::LinkAcked { link, left }),
        }
    }

    /// Logs once when a connection goes down, and when it is back. Links that the controller opens are not logged,
    /// because that may take days, nor are urgent commands, because some controllers accept no second connection.
    fn log_link(&self, id: LinkId, is_up: bool) {
        if id == LinkId::URGENT {
            return;
        }
        let engine = self.engine.borrow();
        let Some(info) = engine.links().find(|link| link.id == id) else { return };
        if matches!(info.kind, LinkKind::RecipeTcpListen { .. } | LinkKind::RecipeUdpListen { .. }) {
            return;
        }
        let mut unreachable = self.unreachable.borrow_mut();
        if let LinkKind::ModbusDevice { .. } = info.kind {
            if is_up && unreachable.remove(&id) {
                warn!(port = info.name, "connected to the device again");
            } else if is_up {
                info!(port = info.name, "connected to the device");
            } else if unreachable.insert(id) {
                warn!(port = info.name, "no connection to the device; trying again");
            }
        } else if is_up && unreachable.remove(&id) {
            warn!(link = info.name, "connected to the controller again");
        } else if is_up {
            info!(link = info.name, "connected to the controller");
        } else if unreachable.insert(id) {
            warn!(link = info.name, "no connection to the controller; trying again");
        }
    }

    fn input(&self, input: Input<'_>) {
        let at = now();
        trace!(input = %TraceText(&input), "in");
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
                _ => trace!(output = %TraceText(&output), "out"),
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

    /// Whether an output may be executed. Everything that a listening gateway sends has passed this check.
    fn may(&self, output: &Output<'_>) -> bool {
        match (self.tx_policy, output) {
            (TxPolicy::All, _) => true,
            (TxPolicy::Exchanges, Output::PortSend { port, .. } | Output::PortSendCan { port, .. }) => {
                self.exchange_ports.contains(port)
            }
            (TxPolicy::Exchanges, Output::LinkSend { link, .. }) => self.is_exchange_link(*link),
            (_, &Output::LinkOpen { link, .. }) => self.may_open(link),
            (_, Output::LinkClose { .. }) => true,
            _ => false,
        }
    }

    /// Whether a link may be opened. A gateway that only listens opens the state stream, on which nothing is ever sent;
    /// with exchanges it also opens the connections to devices.
    fn may_open(&self, link: LinkId) -> bool {
        let may_exchange = self.tx_policy == TxPolicy::Exchanges && self.is_exchange_link(link);
        self.tx_policy == TxPolicy::All || link == LinkId::STATE || may_exchange
    }

    /// Whether a link connects to devices with exchanges.
    fn is_exchange_link(&self, link: LinkId) -> bool {
        link.port().is_some_and(|port| self.exchange_ports.contains(&port))
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
        stats
    }
}

impl Drop for Core {
    fn drop(&mut self) {
        self.tapping.get_mut().end(self.engine.get_mut(), now());
    }
}

/// Moves the entries of the inner object `key` to the outer one.
fn lift(outer: &mut Value, key: &str) {
    if let Some(outer) = outer.as_object_mut()
        && let Some(Value::Object(inner)) = outer.remove(key)
    {
        outer.extend(inner);
    }
}

/// Runs the gateway until Ctrl-C, SIGTERM or SIGHUP. All records for [`RunOptions::watch`] are delivered when this
/// returns.
pub fn run(config: GatewayConfig, options: RunOptions) -> Result<(), RunError> {
    let publisher = options.sparkplug.clone().map(Publisher::start).transpose()?;
    let snapshot_watch = publisher.as_ref().map(Publisher::snapshot_watch);
    let observers = Observers { snapshot_watch, ..Observers::of(&options) };
    let (binds, handover) = (options.binds.clone(), Handover::default());
    let handle = spawn(config, binds, options.scheduling, observers, handover, &RuntimePlace::alone())?;
    host::foreground(Box::new(handle), &options)
}

/// Starts the gateway on a thread of its own; dropping the handle ends it.
pub fn start(config: GatewayConfig, binds: Vec<Bind>) -> Result<Handle, RunError> {
    start_watched(config, binds, &Watch::new())
}

/// As [`start`], with records for the subscribers of `watch`, which can be reused for the next gateway.
pub fn start_watched(config: GatewayConfig, binds: Vec<Bind>, watch: &Watch) -> Result<Handle, RunError> {
    let observers = Observers { watch: watch.clone(), ..Observers::default() };
    spawn(config, binds, Scheduling::Ordinary, observers, Handover::default(), &RuntimePlace::alone())
}

/// Starts the gateway at a place. It takes over the devices in `handover`, and leaves its own there when it ends.
pub(crate) fn spawn(
    config: GatewayConfig,
    binds: Vec<Bind>,
    scheduling: Scheduling,
    observers: Observers,
    handover: Handover,
    place: &RuntimePlace,
) -> Result<Handle, RunError> {
    let watch = observers.watch.clone();
    let (doctor, texts) = match observers.readers {
        true => {
            let (doctor, texts) = doctor::start(config.clone(), place.span.clone())?;
            (Some(doctor), Some(texts))
        }
        false => (None, None),
    };
    let publisher_slot = observers.snapshot_watch.as_ref().map(|watch| watch.open(&config));
    let mut handle = host::start(place, "gateway", async move |at_end| {
        let devices = Devices { binds: &binds, handover: Some((handover, at_end)) };
        let mut gateway = PreparedGateway::open(&config, devices, TxPolicy::All, &observers).await?;
        gateway.slot = observers.slot;
        gateway.publisher_slot = publisher_slot;
        if doctor.is_some() || gateway.slot.is_some() {
            gateway.core.keep_records(&config, &binds);
        }
        gateway.doctor = doctor;
        // Not inside `info!`, which evaluates its arguments only if the line is printed.
        let scheduling = realtime::apply(scheduling);
        info!(%scheduling, "the gateway is running");
        Ok(gateway)
    })?;
    (handle.watch, handle.findings) = (watch, texts);
    Ok(handle)
}

/// Interval at which safe values are checked for.
const SAFE_CHECK: std::time::Duration = std::time::Duration::from_millis(5);

#[cfg(test)]
#[path = "gateway_tests.rs"]
mod tests;
