//! Checks the gateway's promises at every step against an independent model (docs/cell.md section
//! 4).
//!
//! In: all inputs and outputs of the engine, and what reaches the controller. Out: how often each
//! [`Invariant`] was checked, and the first [`Violation`]. The model is slow and plain: it cuts
//! frames by the rules of proto-core/docs/wire/recipes.md, keeps a queue per variable, and uses
//! neither the engine's recipes nor its plan. Garbage that happens to be a frame is a frame: what
//! the line delivered to the port decides.
//!
//! Of the engine it reads only the counters, and which links it considers up.

mod downward;
mod far;
mod field;
mod gateway;
mod invariant;
mod orders;
mod robot;
mod safe;
mod sheet;
mod stream;
mod upward;
mod wire;

use std::collections::{BTreeMap, VecDeque};

use proto_core::config::GatewayConfig;
use proto_core::engine::{BusState, Engine, Input, LinkId, Output, PortCounters};
use proto_core::link::LinkState;
use proto_core::sysvar::SysVar;
use proto_core::time::{Duration, Instant};

use downward::Downward;
use field::LineWatch;
use invariant::ALL;
pub use invariant::{Invariant, Violation};
use orders::Orders;
pub(super) use robot::Path;
use robot::Robot;
use sheet::Sheet;
use upward::{Upward, Wrong};
pub(super) use wire::inputs_of;
use wire::{Controller, Map, Modbus};

/// The model's state of one field port.
#[derive(Debug, Clone, Default)]
struct PortWatch {
    line: LineWatch,
    down: Downward,
    counters: PortCounters,
}

/// The model's state of one recipe link, or of the state link.
#[derive(Debug, Clone, Default)]
struct LinkWatch {
    line: LineWatch,
    stream: stream::Stream,
    busy: bool,
    /// Bytes handed over since the link came up, after each unacknowledged transmission.
    total: u64,
    unacked: VecDeque<u64>,
}

impl LinkWatch {
    fn has_room(&self) -> bool {
        !self.busy && self.unacked.len() < MOST_UNACKED
    }

    fn hands_over(&mut self, bytes: &[u8]) {
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

/// The model and its findings.
#[derive(Debug, Clone)]
pub(super) struct Oracle {
    sheet: Sheet,
    map: Map,
    up: Upward,
    ports: Vec<PortWatch>,
    links: [LinkWatch; LINKS],
    modbus: Modbus,
    /// Safe values that the controller refused, and when they are written again.
    refused: Vec<SysVar>,
    again_at: Instant,
    orders: Orders,
    controller: Controller,
    robot: Robot,
    /// When the engine was called last.
    called_at: Option<Instant>,
    /// When the engine asked to be called, and whether it had another input since.
    announced: Instant,
    is_late: bool,
    /// Input from the field until then waited while the gateway slept.
    deaf_until: Option<Instant>,
    /// The gateway was not called for a while, but did not sleep.
    after_stall: bool,
    /// Size of what is remembered, at the last check.
    remembered: usize,
    /// Outputs since the newest input, and their limit.
    outputs: u32,
    most_outputs: u32,
    /// Frames in and out per port; sends and receives per link. They survive a restart.
    pub frames: Vec<(u64, u64)>,
    pub traffic: [(u64, u64); LINKS],
    pub writes: u64,
    checks: [u64; ALL.len()],
    violation: Option<Violation>,
}

impl Oracle {
    pub(super) fn new(config: &GatewayConfig) -> Self {
        let sheet = Sheet::new(config);
        let parts: usize = sheet.ports.iter().map(|port| port.outputs.len()).sum();
        Self {
            map: Map::new(),
            up: Upward::new(&sheet),
            ports: vec![PortWatch::default(); sheet.ports.len()],
            links: std::array::from_fn(|_| LinkWatch::default()),
            modbus: Modbus::default(),
            refused: Vec::new(),
            again_at: Instant::NEVER,
            orders: Orders::default(),
            controller: Controller::new(),
            robot: Robot::default(),
            called_at: None,
            announced: Instant::NEVER,
            is_late: false,
            deaf_until: None,
            after_stall: false,
            remembered: 0,
            outputs: 0,
            // A frame per port and id; opening or closing, and one transmission, per link, and one
            // more command.
            most_outputs: parts as u32 + 1 + 2 * (4 + sheet.links.len() as u32),
            frames: vec![(0, 0); sheet.ports.len()],
            traffic: [(0, 0); LINKS],
            writes: 0,
            checks: [0; ALL.len()],
            violation: None,
            sheet,
        }
    }

    /// The cell was switched on before: its ports are up, and the engine expects a tick then.
    pub(super) fn begin(&mut self, engine: &Engine, announced: Instant, now: Instant) {
        self.called_at = Some(now);
        self.announced = announced;
        for port in engine.field_ports() {
            self.ports[usize::from(port.0)].down.is_up = true;
        }
    }

    /// The gateway restarts without any state, so nothing may be expected of it.
    pub(super) fn restarted(&mut self, now: Instant) {
        self.up = Upward::new(&self.sheet);
        self.ports = vec![PortWatch::default(); self.sheet.ports.len()];
        self.links = std::array::from_fn(|_| LinkWatch::default());
        self.modbus.lost();
        self.refused.clear();
        self.again_at = Instant::NEVER;
        self.orders = Orders::default();
        self.robot.restarted(now);
        self.called_at = None;
        self.announced = Instant::ZERO;
        self.is_late = false;
        self.deaf_until = None;
    }

    pub(super) fn violation(&self) -> Option<&Violation> {
        self.violation.as_ref()
    }

    pub(super) fn checks(&self) -> BTreeMap<Invariant, u64> {
        ALL.into_iter().zip(self.checks).collect()
    }

    fn judge(&mut self, now: Instant, invariants: &[Invariant], result: Result<(), Wrong>) {
        for &invariant in invariants {
            self.checks[invariant as usize] += 1;
        }
        if let (Err((invariant, what)), None) = (result, &self.violation) {
            self.violation = Some(Violation { invariant, at: now, what });
        }
    }

    /// The engine has handled an input and was not asked for outputs yet.
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
            self.orders.slept(now);
            self.robot.forget_all(now);
            self.look_at_links(engine, None, now);
        }
        if is_tick || has_slept {
            self.pass(now);
        }
        if has_slept {
            self.slept(now);
        }
        let told = match input {
            // After sleep, links have been given up before any input is handled.
            _ if has_slept => None,
            Input::LinkDown { link } | Input::LinkBytes { link, .. } => Some(*link),
            _ => None,
        };
        self.look_at_links(engine, told, now);
        if is_tick || has_slept {
            self.up.repeat(&self.sheet, now);
        }
        self.deaf_until = self.deaf_until.filter(|until| !is_tick || now < *until);
        match *input {
            Input::PortBytes { port, bytes } => self.port_bytes(usize::from(port.0), bytes, now),
            Input::PortCan { port, frame } => self.port_can(usize::from(port.0), &frame, now),
            Input::PortSent { port } => self.ports[usize::from(port.0)].down.sent(),
            Input::PortUp { port } => self.ports[usize::from(port.0)].down.is_up = true,
            Input::PortDown { port } => {
                let nth = usize::from(port.0);
                let watch = &mut self.ports[nth];
                watch.counters.downs += u32::from(watch.down.is_up);
                watch.down.is_up = false;
                watch.down.reset();
                watch.line.discard();
                self.forget_orders(nth, None, now);
            }
            Input::PortBus { port, state } => {
                let nth = usize::from(port.0);
                let watch = &mut self.ports[nth];
                let is_off = state == BusState::BusOff;
                let is_news = is_off && !watch.down.is_bus_off;
                watch.down.is_bus_off = is_off;
                if is_news {
                    watch.counters.bus_offs += 1;
                    watch.down.reset();
                    self.forget_orders(nth, None, now);
                }
            }
            Input::LinkUp { link } => {
                self.nobody_spoke(link);
                self.up.controller_was_away(&self.sheet, now);
                if !self.up.is_up(link) && is_up(engine, link) {
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
        self.orders.look_at_replies(engine);
        if told.is_some() {
            self.look_at_links(engine, None, now);
        }
    }

    /// An output of the engine.
    pub(super) fn output(&mut self, now: Instant, output: &Output<'_>) {
        if self.violation.is_some() {
            return;
        }
        self.outputs += 1;
        let result = if self.outputs > self.most_outputs {
            Err((Invariant::Work, format!("more than {} outputs for one input", self.most_outputs)))
        } else {
            Ok(())
        };
        self.judge(now, &[Invariant::Work], result);
        match *output {
            Output::PortSend { port, bytes } => self.port_send(port, None, bytes, now),
            Output::PortSendCan { port, frame } => self.port_send(port, Some(frame.id()), frame.data(), now),
            Output::LinkClose { link } => self.link_lost(link, now),
            Output::LinkSend { link, bytes } => {
                self.traffic[place(link)].0 += 1;
                // Data handed over to a lost connection never leaves.
                self.robot.hands_over_nothing();
                if self.sheet.link(link).is_some_and(|link| !link.is_datagram) {
                    self.links[place(link)].hands_over(bytes);
                }
                let result = self.link_send(link, bytes, now);
                self.judge(now, &[], result);
            }
            _ => {}
        }
    }

    /// The engine has nothing more to do before `until`; the cell itself holds this many later
    /// events.
    pub(super) fn rest(&mut self, now: Instant, engine: &Engine, until: Instant, things: usize) {
        if self.violation.is_some() {
            return;
        }
        self.announced = self.announced.min(until);
        for nth in 0..self.ports.len() {
            if self.sheet.ports[nth].is_field {
                if !self.is_late {
                    let result = self.ports[nth].down.rest(&self.sheet, nth, &self.up, now);
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
        let result = match (remembered, things) {
            (0..MOST_BYTES, 0..MOST_THINGS) => Ok(()),
            _ => Err((Invariant::Memory, format!("{remembered} bytes and {things} things wait in the cell"))),
        };
        self.judge(now, &[Invariant::Memory], result);
    }
}

/// Index of a link in per-link state.
pub(super) fn place(link: LinkId) -> usize {
    usize::from(link.0) % LINKS
}

fn is_up(engine: &Engine, id: LinkId) -> bool {
    engine.links().any(|link| link.id == id && matches!(link.state, LinkState::Up { .. }))
}

/// Four links to fixed ports of the controller, and one per listening port.
const LINKS: usize = 16;
/// Frames of a recipe link that the controller's TCP has not acknowledged.
const MOST_UNACKED: usize = 64;
/// A gateway that is not called for longer was asleep.
const ASLEEP: Duration = Duration::from_millis(500);
/// More than any stall can gather.
const MOST_BYTES: usize = 1 << 20;
const MOST_THINGS: usize = 100_000;

#[cfg(test)]
mod robot_tests;
#[cfg(test)]
mod tests;
