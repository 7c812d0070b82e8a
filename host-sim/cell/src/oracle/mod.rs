//! Checks the gateway's promises at every step against an independent model (docs/cell.md section 4).
//!
//! In: all inputs and outputs of the engine, and what reaches the controller. Out: how often each [`Invariant`] was
//! checked, and the first [`Violation`]. Does not know the engine's recipes or its plan; of the engine it reads only
//! the counters and the states of the links.
//!
//! The model is slow and simple: it finds frames by the rules of proto-core/docs/wire/recipes.md, and keeps a queue per
//! variable. Garbage that happens to be a valid frame counts as one: the model sees what the port received, not what
//! the device sent.

mod arrivals;
mod commands;
mod counters;
mod device;
mod downward;
mod exchanges;
mod field;
mod frame;
mod gateway;
mod invariant;
mod links;
mod robot;
mod safe;
mod spec;
mod stream;
pub(crate) mod unmodelled;
mod upward;
mod varying;
mod wire;

use std::collections::{BTreeMap, VecDeque};
use std::rc::Rc;

use proto_core::config::GatewayConfig;
use proto_core::engine::{BusState, Engine, Input, LinkId, Output, PortCounters};
use proto_core::time::{Duration, Instant};

use commands::Commands;
use downward::Downward;
use exchanges::line::ExchangesWatch;
use exchanges::served::ServedWatch;
use exchanges::truth::Truth;
use field::LineWatch;
use gateway::Leaving;
use invariant::Wrong;
pub use invariant::{Invariant, Violation};
pub(super) use robot::Path;
use robot::Robot;
use spec::Spec;
use upward::Upward;
use wire::{Controller, Map, Modbus, Safe};
pub(super) use wire::{Inputs, copied_inputs, inputs_of};

/// The model's state of one field port.
#[derive(Debug, Clone, Default)]
struct PortWatch {
    line: LineWatch,
    down: Downward,
    counters: PortCounters,
    exchanges: ExchangesWatch,
    served: ServedWatch,
}

/// The model's state of one recipe link, or of the state link.
#[derive(Debug, Clone, Default)]
struct LinkWatch {
    line: LineWatch,
    stream: stream::Stream,
    busy: bool,
    /// Number of bytes sent since the link came up, in total and up to the end of each unacknowledged transmission.
    total: u64,
    unacked: VecDeque<u64>,
}

impl LinkWatch {
    fn has_room(&self) -> bool {
        !self.busy && self.unacked.len() < MAX_UNACKED
    }

    fn note_sent(&mut self, bytes: &[u8]) {
        self.total += bytes.len() as u64;
        self.unacked.push_back(self.total);
    }

    fn acked(&mut self, left: u32) {
        let acked = self.total.saturating_sub(left.into());
        while self.unacked.front().is_some_and(|end| *end <= acked) {
            self.unacked.pop_front();
        }
    }
}

/// The model and its results.
#[derive(Debug, Clone)]
pub(super) struct Oracle {
    /// Shared, so it can be read while the rest changes.
    spec: Rc<Spec>,
    map: Map,
    up: Upward,
    ports: Vec<PortWatch>,
    links: [LinkWatch; LINKS],
    modbus: Modbus,
    /// Safe values that the controller refused, and when they are written again.
    refused: Safe,
    rewrite_at: Instant,
    commands: Commands,
    controller: Controller,
    robot: Robot,
    truth: Truth,
    /// When the engine was last called.
    called_at: Option<Instant>,
    /// When the engine asked to be called, and whether another input came first at that time.
    announced: Instant,
    is_late: bool,
    /// Until this instant, input from the field is discarded, because it waited while the gateway slept.
    discards_until: Option<Instant>,
    /// The input ended a stall that was too short to count as sleep.
    after_stall: bool,
    /// Size of the model's own queues at the last check.
    remembered: usize,
    /// Number of outputs since the newest input, and its limit.
    outputs: u32,
    max_outputs: u32,
    /// Frames received and sent per port, and sends and receives per link, across restarts of the gateway.
    pub frames: Vec<(u64, u64)>,
    pub traffic: [(u64, u64); LINKS],
    pub writes: u64,
    checks: [u64; Invariant::ALL.len()],
    violation: Option<Violation>,
}

impl Oracle {
    pub(super) fn new(config: &GatewayConfig) -> Self {
        let spec = Spec::new(config);
        let of_port = |port: &spec::PortSpec| {
            port.outputs.len() + usize::from(port.exchanges.is_some() || port.served.is_some())
        };
        let parts: usize = spec.ports.iter().map(of_port).sum();
        Self {
            map: Map::new(&spec),
            up: Upward::new(&spec),
            ports: vec![PortWatch::default(); spec.ports.len()],
            links: std::array::from_fn(|_| LinkWatch::default()),
            modbus: Modbus::default(),
            refused: Safe::default(),
            rewrite_at: Instant::NEVER,
            commands: Commands::default(),
            controller: Controller::new(),
            robot: Robot::default(),
            truth: Truth::new(&spec),
            called_at: None,
            announced: Instant::NEVER,
            is_late: false,
            discards_until: None,
            after_stall: false,
            remembered: 0,
            outputs: 0,
            // Per port one frame of each id, per link one open or close and one transmission, and one more command.
            max_outputs: parts as u32 + 1 + 2 * (4 + spec.links.len() as u32),
            frames: vec![(0, 0); spec.ports.len()],
            traffic: [(0, 0); LINKS],
            writes: 0,
            checks: [0; Invariant::ALL.len()],
            violation: None,
            spec: Rc::new(spec),
        }
    }

    /// Begins with a cell that was just switched on: its ports are up, and the engine expects a tick at `announced`.
    pub(super) fn begin(&mut self, engine: &Engine, announced: Instant, now: Instant) {
        self.called_at = Some(now);
        self.announced = announced;
        for port in engine.field_ports() {
            let watch = &mut self.ports[usize::from(port.0)];
            watch.down.is_up = true;
            watch.exchanges.begin(self.spec.ports[usize::from(port.0)].exchanges.as_ref(), now);
        }
    }

    /// The gateway has restarted without any state.
    pub(super) fn restarted(&mut self, now: Instant) {
        self.up = Upward::new(&self.spec);
        self.ports = vec![PortWatch::default(); self.spec.ports.len()];
        self.links = std::array::from_fn(|_| LinkWatch::default());
        self.modbus.lost();
        self.refused = Safe::default();
        self.rewrite_at = Instant::NEVER;
        self.commands = Commands::default();
        self.robot.restarted(now);
        self.called_at = None;
        self.announced = Instant::ZERO;
        self.is_late = false;
        self.discards_until = None;
    }

    pub(super) fn violation(&self) -> Option<&Violation> {
        self.violation.as_ref()
    }

    pub(super) fn checks(&self) -> BTreeMap<Invariant, u64> {
        Invariant::ALL.into_iter().zip(self.checks).collect()
    }

    #[inline]
    fn judge(&mut self, now: Instant, invariants: &[Invariant], result: Result<(), Wrong>) {
        for &invariant in invariants {
            self.checks[invariant as usize] += 1;
        }
        if let Err(wrong) = result {
            self.violate(now, wrong);
        }
    }

    #[cold]
    fn violate(&mut self, now: Instant, (invariant, what): Wrong) {
        if self.violation.is_none() {
            self.violation = Some(Violation { invariant, at: now, what });
        }
    }

    /// The engine has handled an input; its outputs follow.
    pub(super) fn input(&mut self, now: Instant, input: &Input<'_>, engine: &Engine) {
        if self.violation.is_some() {
            return;
        }
        self.outputs = 0;
        let idle = self.called_at.replace(now).map_or(Duration::ZERO, |at| now.saturating_since(at));
        let has_slept = idle > ASLEEP;
        let is_tick = matches!(input, Input::Tick);
        self.after_stall = is_tick && !has_slept && self.robot.has_stalled(now);
        self.is_late = !is_tick && now >= self.announced;
        if is_tick {
            self.announced = Instant::NEVER;
        }
        if has_slept {
            self.commands.slept(now);
            self.robot.forget_all(now);
            // A master's request that waited is not executed, because its age is unknown.
            for watch in &mut self.ports {
                watch.line.discarded += watch.served.discard();
            }
            self.find_lost_links(engine, None, now);
        }
        if is_tick || has_slept {
            let has_slept = has_slept || self.discards_until.is_some_and(|until| now < until);
            self.pass(has_slept, now);
        }
        if has_slept {
            self.slept(now);
        }
        let reported = match input {
            // After a sleep, links are given up before any input is handled.
            _ if has_slept => None,
            Input::LinkDown { link } | Input::LinkBytes { link, .. } => Some(*link),
            _ => None,
        };
        self.find_lost_links(engine, reported, now);
        if is_tick || has_slept {
            self.up.repeat(&self.spec, now);
        }
        self.discards_until = self.discards_until.filter(|until| !is_tick || now < *until);
        match *input {
            Input::PortBytes { port, bytes } => self.port_bytes(usize::from(port.0), bytes, now),
            Input::PortCan { port, frame } => self.port_can(usize::from(port.0), &frame, now),
            Input::PortSent { port } => self.port_sent(usize::from(port.0), now),
            Input::PortUp { port } => self.port_up(usize::from(port.0), now),
            Input::PortDown { port } => {
                let nth = usize::from(port.0);
                let watch = &mut self.ports[nth];
                watch.counters.downs += u32::from(watch.down.is_up);
                watch.down.is_up = false;
                watch.down.reset();
                watch.line.discard_of(&self.spec.ports[nth]);
                watch.line.discarded += watch.served.discard();
                watch.exchanges.gone(self.spec.ports[nth].exchanges.as_ref(), now);
                self.forget_commands(nth, None, now);
            }
            Input::PortBus { port, state } => {
                let nth = usize::from(port.0);
                let watch = &mut self.ports[nth];
                let is_off = state == BusState::BusOff;
                let is_news = is_off && !watch.down.is_bus_off;
                let was_off = std::mem::replace(&mut watch.down.is_bus_off, is_off);
                if is_news {
                    watch.counters.bus_offs += 1;
                    watch.down.reset();
                    watch.exchanges.gone(self.spec.ports[nth].exchanges.as_ref(), now);
                    self.forget_commands(nth, None, now);
                } else if was_off && !is_off {
                    self.begin_exchanges(nth, now);
                }
            }
            Input::LinkUp { link } => {
                self.forget_sender(link);
                self.up.controller_was_away(&self.spec, now);
                if !self.up.is_up(link) && engine.is_up(link) {
                    self.up.link_up(link, now);
                    self.links[place(link)] = LinkWatch::default();
                }
            }
            Input::LinkDown { link } => self.link_lost(link, now),
            Input::LinkBytes { link, bytes } if self.up.is_up(link) => self.link_bytes(link, bytes, now),
            Input::LinkSent { link } => self.links[place(link)].busy = false,
            Input::LinkAcked { link, left } => self.links[place(link)].acked(left),
            _ => {}
        }
        let result = self.commands.match_replies(engine);
        self.judge(now, &[], result);
        if reported.is_some() {
            self.find_lost_links(engine, None, now);
        }
    }

    /// Checks an output of the engine.
    pub(super) fn output(&mut self, now: Instant, output: &Output<'_>) {
        if self.violation.is_some() {
            return;
        }
        self.outputs += 1;
        let result = if self.outputs > self.max_outputs {
            Err((Invariant::Work, format!("more than {} outputs for one input", self.max_outputs)))
        } else {
            Ok(())
        };
        self.judge(now, &[Invariant::Work], result);
        match *output {
            Output::PortSend { port, bytes } => {
                self.port_send(port, &Leaving { id: None, is_remote: false, bytes }, now);
            }
            Output::PortSendCan { port, frame } => {
                let (id, is_remote) = (Some(frame.id()), frame.is_remote());
                self.port_send(port, &Leaving { id, is_remote, bytes: frame.data() }, now);
            }
            Output::LinkClose { link } => self.link_lost(link, now),
            Output::LinkSend { link, bytes } => {
                self.traffic[place(link)].0 += 1;
                // Values sent to a lost connection are never transmitted, so it starts with none.
                self.robot.hands_over_nothing();
                if self.spec.link(link).is_some_and(|link| !link.is_datagram) {
                    self.links[place(link)].note_sent(bytes);
                }
                let result = self.link_send(link, bytes, now);
                self.judge(now, &[], result);
            }
            _ => {}
        }
    }

    /// The engine has nothing to do before `until`. `pending` is the number of waiting events and connections in the
    /// cell.
    pub(super) fn rest(&mut self, now: Instant, engine: &Engine, until: Instant, pending: usize) {
        if self.violation.is_some() {
            return;
        }
        self.announced = self.announced.min(until);
        for nth in 0..self.ports.len() {
            if self.spec.ports[nth].is_field {
                if !self.is_late {
                    let (port, watch) = (&self.spec.ports[nth], &mut self.ports[nth]);
                    let result = watch.down.rest(port, &self.up, now);
                    let result = result.and_then(|()| self.served_rests(nth, now));
                    let result = result.and_then(|()| self.exchange_rests(nth, now));
                    self.judge(now, &[Invariant::Cycle], result);
                }
                let result = self.count(nth, engine);
                self.judge(now, &[Invariant::Counted, Invariant::Bytes], result);
                self.checks[Invariant::FalseTimeout as usize] += u64::from(self.after_stall);
            }
        }
        self.after_stall = false;
        if !self.is_late {
            let result = self.nothing_waits(now);
            self.judge(now, &[Invariant::Delivered], result);
        }
        let remembered = self.remembered;
        let result = match (remembered, pending) {
            (0..MAX_BYTES, 0..MAX_PENDING) => Ok(()),
            _ => {
                Err((Invariant::Memory, format!("{remembered} bytes and {pending} things wait in the cell")))
            }
        };
        self.judge(now, &[Invariant::Memory], result);
    }
}

/// Index of a link in arrays of per-link state.
pub(super) fn place(link: LinkId) -> usize {
    usize::from(link.0) % LINKS
}

/// Maximum number of links: those to the controller's fixed ports, and one per listening port.
const LINKS: usize = 16;
/// Maximum number of unacknowledged frames of a recipe link.
const MAX_UNACKED: usize = 64;
/// A gateway that is not called for longer than this has slept.
const ASLEEP: Duration = Duration::from_millis(500);
/// More bytes than can wait after any stall.
const MAX_BYTES: usize = 1 << 20;
const MAX_PENDING: usize = 100_000;

#[cfg(test)]
mod robot_tests;
#[cfg(test)]
mod tests;
