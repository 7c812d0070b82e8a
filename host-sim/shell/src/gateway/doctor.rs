//! Findings of a running gateway, and of one that only listens.
//!
//! A running gateway is looked at once a second, if somebody reads what is found. The gateway's thread
//! copies the engine and the records; another thread looks at them and logs.
//!
//! A gateway that only listens gives nothing to the controller, and nothing to the field unless it is to
//! ask: [`super::Voice`] is the one gate that every output passes. Its engine is told of no link but the
//! state stream, on which it never sends, so it has nothing to say either.

use std::net::{TcpStream, ToSocketAddrs};
use std::rc::Rc;
use std::sync::mpsc::{Receiver, Sender, SyncSender, TrySendError, channel, sync_channel};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration as StdDuration;

use proto_core::config::{ControllerLink, FieldSpec, GatewayConfig, InputBinding};
use proto_core::engine::ReplyCode;
use proto_core::time::{Duration, Instant};
use proto_core::wire::dialect::Dialect;
use proto_core::wire::state::{StateStream, States};
use recipe_capture::Watch as Unwatched;
use recipe_doctor::{Case, Change, Finding, LinkFacts, PortRecord, Watch, examine};
use serde_json::{Value, json};
use tracing::info;

use super::{Core, Engine, Gateway, Voice};
use crate::host::{self, Shell};
use crate::{Signals, StartError};
use recipe_device::bind::Bind;
use recipe_net::timer::now;

/// The newest findings of a gateway that is looked at.
pub(super) type Told = Arc<Mutex<Vec<Finding>>>;

/// A gateway at one instant.
pub(super) struct Snapshot {
    at: Instant,
    running: Duration,
    engine: Box<Engine>,
    ports: Vec<PortRecord>,
    links: Vec<LinkFacts>,
}

impl Snapshot {
    fn findings(&self, config: &GatewayConfig, looked: Option<States>) -> Vec<Finding> {
        examine(&Case {
            config: config.view(),
            status: self.engine.status(self.at),
            ports: &self.ports,
            links: &self.links,
            running: self.running,
            looked,
        })
    }

    /// Since when a command has failed for which nobody saw the controller's states.
    fn unexplained(&self) -> Option<Instant> {
        let ports = self.engine.status(self.at).ports();
        let failed = ports.filter(|port| port.reply == ReplyCode::Fail).filter_map(|port| port.last_failed);
        failed.filter(|failed| failed.controller.is_none()).map(|failed| failed.at).max()
    }
}

impl Core {
    /// Notes the counters of this instant, and copies everything that findings are made of.
    pub(super) fn snapshot(&self) -> Snapshot {
        let at = now();
        let engine = self.engine.borrow().clone();
        let mut records = self.records.borrow_mut();
        for port in engine.status(at).ports() {
            if let Some(record) = records.iter_mut().find(|record| record.port == port.id) {
                record.note(at, port.counters);
                record.fd_frames = self.ports.get(&port.id).map_or(0, |(_, tx)| tx.counters().fd_frames);
            }
        }
        let links = engine.links().map(|info| {
            let control = self.links.get(&info.id);
            LinkFacts {
                link: info.id,
                reach: control.and_then(|control| control.reach()),
                strangers: control.map_or(0, |control| control.refusals().strangers),
            }
        });
        let links = links.collect();
        let running = at.saturating_since(self.started);
        Snapshot { at, running, engine, ports: records.clone(), links }
    }

    /// Has the gateway looked at once a second.
    pub(super) async fn be_watched(&self, doctor: SyncSender<Snapshot>) -> Result<(), StartError> {
        let mut ticks = tokio::time::interval(LOOK);
        ticks.set_missed_tick_behavior(tokio::time::MissedTickBehavior::Delay);
        loop {
            ticks.tick().await;
            // A busy machine has looked at the one before not yet.
            if let Err(TrySendError::Disconnected(_)) = doctor.try_send(self.snapshot()) {
                return std::future::pending().await;
            }
        }
    }
}

/// Starts the thread that looks at snapshots and logs what begins and ends.
pub(super) fn start(config: GatewayConfig) -> Result<(SyncSender<Snapshot>, Told), StartError> {
    let (sender, inbox) = sync_channel(1);
    let told = Told::default();
    let own = Arc::clone(&told);
    let thread = std::thread::Builder::new().name("doctor".to_owned());
    thread
        .spawn(move || log_changes(&config, &inbox, &own))
        .map_err(|error| StartError::new(format!("cannot start a thread: {error}")))?;
    Ok((sender, told))
}

fn log_changes(config: &GatewayConfig, inbox: &Receiver<Snapshot>, told: &Told) {
    let mut watch = Watch::new();
    let mut looked: Option<(Instant, Option<States>)> = None;
    for snapshot in inbox {
        if let Some(failed_at) = snapshot.unexplained()
            && looked.is_none_or(|(at, _)| at < failed_at)
        {
            looked = Some((failed_at, look_at_states(&config.controller)));
        }
        let states = snapshot.unexplained().and(looked).and_then(|(_, states)| states);
        let findings = snapshot.findings(config, states);
        for change in watch.update(snapshot.at, &findings) {
            match change {
                Change::Begins(finding) => info!(severity = finding.severity.name(), "{finding}"),
                Change::Ends { place, cause } => info!("{place}: over: {}", cause.name().replace('_', " ")),
            }
        }
        *told.lock().unwrap_or_else(PoisonError::into_inner) = findings;
    }
}

/// The words of the newest findings.
pub(super) fn words(told: &Told) -> Value {
    let told = told.lock().unwrap_or_else(PoisonError::into_inner);
    told.iter().map(|finding| json!(finding.to_string())).collect()
}

/// The controller's states: one packet of its state stream. Nothing is sent to it.
fn look_at_states(controller: &ControllerLink) -> Option<States> {
    let dialect = Dialect::named(&controller.dialect)?;
    let place = (controller.address.as_str(), controller.state_port).to_socket_addrs().ok()?.next()?;
    let mut connection = TcpStream::connect_timeout(&place, MAX_LOOK).ok()?;
    connection.set_read_timeout(Some(MAX_LOOK)).ok()?;
    let (mut stream, mut chunk) = (StateStream::new(), [0; 2048]);
    for _ in 0..MAX_READS {
        let len = std::io::Read::read(&mut connection, &mut chunk).ok().filter(|len| *len > 0)?;
        let mut rest = &chunk[..len];
        while let Some(packet) = stream.next_packet(&mut rest) {
            if let Ok(view) = packet {
                return Some(view.states(&dialect));
            }
        }
    }
    None
}

/// What a gateway with this configuration would find, from listening for `time`.
///
/// Nothing is sent to the controller: its ports are connected to and closed, only its state stream is
/// read. Nothing is sent to the field, unless `ask`: then ports with exchanges send what their file says.
/// A signal that ends programs ends the listening early.
///
/// # Errors
/// The reason why it could not start; nothing is left behind then.
pub fn listen(
    config: GatewayConfig,
    binds: Vec<Bind>,
    time: StdDuration,
    ask: bool,
) -> Result<Vec<Finding>, StartError> {
    let (sender, findings) = channel();
    let voice = if ask { Voice::Asking } else { Voice::Silent };
    let handle = host::start("doctor", async move || {
        let gateway = Gateway::open(&config, &binds, voice, &Unwatched::new()).await?;
        Ok(Listener { gateway, config, time, sender })
    })?;
    // It is dropped at the end of the run.
    let findings = findings.recv().ok();
    let ended = handle.shutdown();
    match findings {
        Some(findings) => Ok(findings),
        None => Err(ended.err().unwrap_or_else(|| StartError::new("the doctor ended early").after_start())),
    }
}

/// A gateway that listens for some time.
struct Listener {
    gateway: Gateway,
    config: GatewayConfig,
    time: StdDuration,
    sender: Sender<Vec<Finding>>,
}

impl Shell for Listener {
    fn ready(&self) -> Value {
        self.gateway.ready.clone()
    }

    fn stats(&self) -> impl Fn() -> Value + 'static {
        || Value::Null
    }

    async fn run(self) -> Result<(), StartError> {
        let core = Rc::clone(&self.gateway.core);
        let noting = async {
            loop {
                core.snapshot();
                tokio::time::sleep(LOOK).await;
            }
        };
        let mut signals = Signals::catch().map_err(|error| StartError::new(format!("signals: {error}")))?;
        tokio::select! {
            ended = self.gateway.drive() => ended?,
            () = noting => {}
            () = tokio::time::sleep(self.time) => {}
            _ = signals.next() => {}
        }
        let snapshot = core.snapshot();
        let has_states = snapshot.engine.status(snapshot.at).controller().is_some();
        let looked = match !has_states && has_commands(&self.config) {
            true => look_at_states(&self.config.controller),
            false => None,
        };
        // Nobody listens if the caller is gone.
        let _ = self.sender.send(snapshot.findings(&self.config, looked));
        Ok(())
    }
}

fn has_commands(config: &GatewayConfig) -> bool {
    config.fields.iter().any(|field| match field {
        FieldSpec::UserInput { to, .. } | FieldSpec::DeviceInput { to, .. } => {
            matches!(to, InputBinding::Commands { .. })
        }
        _ => false,
    })
}

/// Interval at which a gateway is looked at.
const LOOK: StdDuration = StdDuration::from_secs(1);
/// How long a connection and a packet of the state stream may take.
const MAX_LOOK: StdDuration = StdDuration::from_secs(1);
/// More reads than a few packets need.
const MAX_READS: usize = 16;
