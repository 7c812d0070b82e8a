//! Findings of a running gateway, and of one that only listens.
//!
//! A running gateway is examined once a second, if its findings are read. The gateway's thread copies the engine and
//! the port records into a buffer; another thread examines the copy, logs changes, and returns the buffer. Until then
//! nothing is copied.
//!
//! A gateway that only listens sends nothing to the controller, and nothing to the field except exchanges if these are
//! enabled: every output passes [`super::TxPolicy`]. Its engine sees no link but the state stream, on which it never
//! sends.

use std::rc::Rc;
use std::sync::mpsc::{Receiver, Sender, SyncSender, TryRecvError, channel, sync_channel};
use std::time::Duration as StdDuration;

use proto_core::config::GatewayConfig;
use proto_core::engine::{LinkId, PortId};
use proto_core::time::Instant;
use proto_core::wire::state::States;
use recipe_doctor::{Change, Finding, LinkFacts, PortRecord, Watch, has_commands};
use serde_json::Value;
use tracing::{Span, info};

use super::open::Devices;
use super::{Core, Observers, PreparedGateway, TxPolicy};
use crate::findings::{FindingTexts, look_at_states, unexplained};
use crate::host::{self, Runtime};
use crate::snapshot::GatewaySnapshot;
use crate::worker::RuntimePlace;
use crate::{RunError, Signals};
use recipe_io::bind::Bind;
use recipe_io::timer::now;

/// The gateway's end of the channels to the examining thread.
pub(super) struct Doctor {
    buffers: Receiver<Box<GatewaySnapshot>>,
    filled: SyncSender<Box<GatewaySnapshot>>,
}

impl Core {
    /// Starts to record the input of each port.
    pub(super) fn keep_records(&self, config: &GatewayConfig, binds: &[Bind]) {
        self.records.replace(records(config, binds));
    }

    /// Records the counters of this instant.
    fn note(&self, at: Instant) {
        let engine = self.engine.borrow();
        let mut records = self.records.borrow_mut();
        for port in engine.status(at).ports() {
            if let Some(record) = records.iter_mut().find(|record| record.port == port.id) {
                record.note(at, port.counters);
                record.fd_frames = self.ports.get(&port.id).map_or(0, |(_, tx)| tx.counters().fd_frames);
            }
        }
    }

    /// Facts about a link that the engine's status does not have.
    pub(super) fn facts_of(&self, link: LinkId) -> LinkFacts {
        let control = self.links.get(&link);
        LinkFacts {
            link,
            reach: control.and_then(|control| control.reach()),
            strangers: control.map_or(0, |control| control.refusals().strangers),
        }
    }

    /// Records the counters once a second. Never returns.
    pub(super) async fn keep_notes(&self) -> Result<(), RunError> {
        let mut ticks = tokio::time::interval(LOOK);
        ticks.set_missed_tick_behavior(tokio::time::MissedTickBehavior::Delay);
        loop {
            ticks.tick().await;
            self.note(now());
        }
    }

    /// Passes a snapshot to the examining thread once a second.
    pub(super) async fn be_watched(&self, doctor: Doctor) -> Result<(), RunError> {
        let mut ticks = tokio::time::interval(LOOK);
        ticks.set_missed_tick_behavior(tokio::time::MissedTickBehavior::Delay);
        loop {
            ticks.tick().await;
            let at = now();
            self.note(at);
            let mut buffer = match doctor.buffers.try_recv() {
                Ok(buffer) => buffer,
                // The previous snapshot is still being examined.
                Err(TryRecvError::Empty) => continue,
                Err(TryRecvError::Disconnected) => return std::future::pending().await,
            };
            self.copy_to(&mut buffer, at);
            // There is only one buffer, so the channel has space.
            let _ = doctor.filled.try_send(buffer);
        }
    }
}

/// Starts the thread that examines snapshots and logs findings that appear or disappear.
pub(super) fn start(config: GatewayConfig, span: Span) -> Result<(Doctor, FindingTexts), RunError> {
    let (filled, inbox) = sync_channel(1);
    let (empty, buffers) = sync_channel(1);
    let buffer = GatewaySnapshot::empty();
    let texts = FindingTexts::default();
    let own = texts.clone();
    let thread = std::thread::Builder::new().name("doctor".to_owned());
    thread
        .spawn(move || {
            // Cannot fail: the gateway holds the receiver until this thread has started.
            let _ = empty.send(buffer);
            let _of = span.entered();
            log_changes(&config, &inbox, &empty, &own);
        })
        .map_err(|error| RunError::new(format!("cannot start a thread: {error}")))?;
    Ok((Doctor { buffers, filled }, texts))
}

fn records(config: &GatewayConfig, binds: &[Bind]) -> Vec<PortRecord> {
    let record = config.view().field_ports().map(|(index, port, _)| {
        let mut record = PortRecord::new(PortId(index));
        let bind = binds.iter().find(|bind| port.name == bind.port.as_str());
        record.device = bind.map(|bind| bind.device.to_string()).unwrap_or_default();
        record
    });
    record.collect()
}

fn log_changes(
    config: &GatewayConfig,
    inbox: &Receiver<Box<GatewaySnapshot>>,
    empty: &SyncSender<Box<GatewaySnapshot>>,
    texts: &FindingTexts,
) {
    let mut watch = Watch::new();
    let mut looked: Option<(Instant, Option<States>)> = None;
    for snapshot in inbox {
        let failed = unexplained(snapshot.engine.status(snapshot.at));
        if let Some(failed_at) = failed
            && looked.is_none_or(|(at, _)| at < failed_at)
        {
            looked = Some((failed_at, look_at_states(&config.controller)));
        }
        let states = failed.and(looked).and_then(|(_, states)| states);
        let findings = snapshot.findings(config, states);
        for change in watch.update(snapshot.at, &findings) {
            match change {
                Change::Begins(finding) => info!(severity = finding.severity.name(), "{finding}"),
                Change::Ends { place, cause } => info!("{place}: over: {}", cause.name().replace('_', " ")),
            }
        }
        texts.replace(&findings);
        // Fails only if the gateway has ended.
        let _ = empty.try_send(snapshot);
    }
}

/// Findings of a gateway with this configuration after listening for `time`.
///
/// Nothing is sent to the controller: connections are opened and closed, and only the state stream is read. Nothing is
/// sent to the field, unless `ask` is set: then ports with exchanges send theirs. SIGINT, SIGTERM and SIGHUP end the
/// listening early.
pub fn listen(
    config: GatewayConfig,
    binds: Vec<Bind>,
    time: StdDuration,
    ask: bool,
) -> Result<Vec<Finding>, RunError> {
    let (sender, findings) = channel();
    let tx_policy = if ask { TxPolicy::Exchanges } else { TxPolicy::None };
    let handle = host::start(&RuntimePlace::alone(), "doctor", async move |_| {
        let gateway =
            PreparedGateway::open(&config, Devices::own(&binds), tx_policy, &Observers::default()).await?;
        gateway.core.keep_records(&config, &binds);
        Ok(Listener { gateway, config, time, sender })
    })?;
    // The sender is dropped at the end of the run.
    let findings = findings.recv().ok();
    let ended = handle.shutdown();
    match findings {
        Some(findings) => Ok(findings),
        None => Err(ended.err().unwrap_or_else(|| RunError::new("the doctor ended early").after_start())),
    }
}

/// A gateway that listens for some time.
struct Listener {
    gateway: PreparedGateway,
    config: GatewayConfig,
    time: StdDuration,
    sender: Sender<Vec<Finding>>,
}

impl Runtime for Listener {
    fn ready(&self) -> Value {
        self.gateway.ready.clone()
    }

    fn stats(&self) -> impl Fn() -> Value + 'static {
        || Value::Null
    }

    async fn run(self) -> Result<(), RunError> {
        let core = Rc::clone(&self.gateway.core);
        let mut signals = Signals::catch().map_err(|error| RunError::new(format!("signals: {error}")))?;
        tokio::select! {
            ended = self.gateway.drive() => ended?,
            ended = core.keep_notes() => ended?,
            () = tokio::time::sleep(self.time) => {}
            _ = signals.next() => {}
        }
        let at = now();
        core.note(at);
        let mut snapshot = GatewaySnapshot::empty();
        core.copy_to(&mut snapshot, at);
        let has_states = snapshot.engine.status(snapshot.at).controller().is_some();
        let looked = match !has_states && has_commands(self.config.view()) {
            true => look_at_states(&self.config.controller),
            false => None,
        };
        // Fails only if the caller has ended.
        let _ = self.sender.send(snapshot.findings(&self.config, looked));
        Ok(())
    }
}

/// Interval at which a gateway is examined.
const LOOK: StdDuration = StdDuration::from_secs(1);
