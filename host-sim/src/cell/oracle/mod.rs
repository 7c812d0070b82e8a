//! What the gateway has promised, checked at every step against a model of its own
//! (docs/cell.md section 4).
//!
//! In: everything that goes into the engine and comes out of it, and what reaches the controller.
//! Out: how often each [`Invariant`] was looked at, and the first [`Violation`]. The model is slow
//! and plain: it cuts frames by the rules of docs/wire/recipes.md, keeps a queue a variable, and
//! uses neither the engine's recipes nor its plan. Garbage that happens to be a frame is a frame:
//! what counts is what the wire delivered to the port.
//!
//! Of the engine it looks only at the counters, and at which links it holds for up.

mod downward;
mod field;
mod orders;
mod sheet;
mod upward;
mod wire;

use std::collections::BTreeMap;

use proto_core::config::GatewayConfig;
use proto_core::engine::{BusState, Engine, Input, LinkId, Output, PortCounters, PortId};
use proto_core::link::LinkState;
use proto_core::recipe::CanFrame;
use proto_core::sysvar::SysVar;
use proto_core::time::{Duration, Instant};

use downward::Downward;
use field::{Accepted, Line, Refused, Verdict};
use orders::Orders;
use sheet::{Origin, Raw, Sheet, shown, written};
use upward::{Upward, Wrong};
pub(super) use wire::inputs_of;
use wire::{Asked, Controller, Map, Modbus};

/// What must hold.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum Invariant {
    /// Every value written is the next one that its owner sent, or safe, or read back.
    Sent,
    /// No value is written after its time to live.
    InTime,
    /// Nothing is written before the first valid field frame.
    FirstFrame,
    /// Only variables that a port owns are written, whole, on their way up.
    Ownership,
    /// Nothing from before a reconnect is written after it.
    NoReplay,
    /// The edges of bits are written in order, or counted.
    Edges,
    /// What waits is handed over as soon as its link is free.
    Delivered,
    /// Every frame on the wire is applied or counted: all counters agree with the model's.
    Counted,
    /// Every received byte is in a frame, dropped, discarded, or held.
    Bytes,
    /// A command is sent once, in time, or not at all.
    Once,
    /// Nothing is shown before it was received.
    Known,
    /// Nothing is shown that is older than promised.
    Age,
    /// What is shown is what was received last.
    Shown,
    /// Never faster than the cycle, and each cycle, request and trigger is served or counted.
    Cycle,
    /// One transmission at a time, on a silent line, to a device that is there.
    Line,
    /// The controller receives what the gateway sent.
    Transport,
    /// The controller's inputs are what was written, and nothing else writes them.
    Registers,
    /// The work of one call is bounded.
    Work,
    /// What waits anywhere is bounded.
    Memory,
    /// Nothing panics.
    NoPanic,
}

impl Invariant {
    /// A name for people.
    pub const fn name(self) -> &'static str {
        match self {
            Self::Sent => "values-were-sent",
            Self::InTime => "values-in-time",
            Self::FirstFrame => "nothing-before-a-frame",
            Self::Ownership => "ownership",
            Self::NoReplay => "no-replay",
            Self::Edges => "edges-in-order",
            Self::Delivered => "nothing-is-left-waiting",
            Self::Counted => "applied-or-counted",
            Self::Bytes => "bytes-add-up",
            Self::Once => "commands-once",
            Self::Known => "shown-is-known",
            Self::Age => "shown-is-young",
            Self::Shown => "shown-is-newest",
            Self::Cycle => "cycle",
            Self::Line => "one-at-a-time",
            Self::Transport => "received-is-sent",
            Self::Registers => "registers",
            Self::Work => "bounded-work",
            Self::Memory => "bounded-memory",
            Self::NoPanic => "no-panic",
        }
    }
}

/// An invariant that did not hold.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Violation {
    /// Which.
    pub invariant: Invariant,
    /// When.
    pub at: Instant,
    /// In words, with the numbers.
    pub what: String,
}

impl Violation {
    /// A run ended in a panic.
    pub(crate) fn panic(at: Instant) -> Self {
        Self { invariant: Invariant::NoPanic, at, what: "a panic: see its message".to_owned() }
    }
}

impl std::fmt::Display for Violation {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "{}: {}", self.invariant.name(), self.what)
    }
}

/// What is known of one field port.
#[derive(Debug, Clone, Default)]
struct PortWatch {
    line: Line,
    down: Downward,
    counters: PortCounters,
}

/// What is known of one recipe link, or of the state link.
#[derive(Debug, Clone, Default)]
struct LinkWatch {
    line: Line,
    busy: bool,
}

/// The model, and what it found.
#[derive(Debug, Clone)]
pub(super) struct Oracle {
    sheet: Sheet,
    map: Map,
    up: Upward,
    ports: Vec<PortWatch>,
    links: BTreeMap<LinkId, LinkWatch>,
    modbus: Modbus,
    /// Safe values that the controller refused, and when they are written again.
    refused: Vec<SysVar>,
    again_at: Instant,
    orders: Orders,
    controller: Controller,
    /// Variables with an owner, and their way up.
    owned: Vec<(SysVar, LinkId)>,
    /// Outputs since the newest input, and how many there may be.
    outputs: u32,
    most_outputs: u32,
    /// Frames in and out, a port; sent and received, a link. They outlive a restart.
    pub frames: Vec<(u64, u64)>,
    pub traffic: BTreeMap<LinkId, (u64, u64)>,
    pub writes: u64,
    checks: [u64; 20],
    violation: Option<Violation>,
}

impl Oracle {
    pub(super) fn new(config: &GatewayConfig) -> Self {
        let sheet = Sheet::new(config);
        let parts: usize = sheet.ports.iter().map(|port| port.outputs.len()).sum();
        let owned = SysVar::all().filter_map(|var| sheet.owned[var.ordinal()].map(|owned| (var, owned.way)));
        Self {
            map: Map::new(),
            up: Upward::new(&sheet),
            ports: vec![PortWatch::default(); sheet.ports.len()],
            links: BTreeMap::new(),
            modbus: Modbus::default(),
            refused: Vec::new(),
            again_at: Instant::NEVER,
            orders: Orders::default(),
            controller: Controller::new(),
            owned: owned.collect(),
            outputs: 0,
            // A frame a port and id; opening or closing, and something to send, a link.
            most_outputs: parts as u32 + 2 * (3 + sheet.links.len() as u32),
            frames: vec![(0, 0); sheet.ports.len()],
            traffic: BTreeMap::new(),
            writes: 0,
            checks: [0; 20],
            violation: None,
            sheet,
        }
    }

    /// The cell was switched on already: its ports are there.
    pub(super) fn begin(&mut self, engine: &Engine, now: Instant) {
        self.tick(now);
        for port in engine.field_ports() {
            self.ports[usize::from(port.0)].down.is_up = true;
        }
    }

    /// The gateway starts afresh: it knows nothing, so nothing may be expected of it.
    pub(super) fn restarted(&mut self) {
        self.up = Upward::new(&self.sheet);
        self.ports = vec![PortWatch::default(); self.sheet.ports.len()];
        self.links.clear();
        self.modbus.lost();
        self.refused.clear();
        self.again_at = Instant::NEVER;
        self.orders = Orders::default();
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
        self.tick(now);
        let told = match input {
            Input::LinkDown { link } | Input::LinkBytes { link, .. } => Some(*link),
            _ => None,
        };
        self.look_at_links(engine, told);
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
                self.orders.forget(nth, None);
            }
            Input::PortBus { port, state } => {
                let watch = &mut self.ports[usize::from(port.0)];
                let is_off = state == BusState::BusOff;
                if is_off && !watch.down.is_bus_off {
                    watch.counters.bus_offs += 1;
                    watch.down.reset();
                }
                watch.down.is_bus_off = is_off;
            }
            Input::LinkUp { link } => {
                if !self.up.is_up(link) && is_up(engine, link) {
                    self.up.link_up(link, now);
                    self.links.insert(link, LinkWatch::default());
                }
            }
            Input::LinkDown { link } => self.link_lost(link),
            Input::LinkBytes { link, bytes } if self.up.is_up(link) => self.link_bytes(link, bytes, now),
            Input::LinkSent { link } => self.links.entry(link).or_default().busy = false,
            Input::LinkBytes { .. } | Input::Tick => {}
        }
        self.look_at_links(engine, None);
    }

    /// What the engine wants done.
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
            Output::LinkOpen { .. } | Output::Sleep { .. } => {}
            Output::LinkClose { link } => self.link_lost(link),
            Output::LinkSend { link, bytes } => {
                self.traffic.entry(link).or_default().0 += 1;
                let result = self.link_send(link, bytes, now);
                self.judge(now, &[], result);
            }
        }
    }

    /// The engine has nothing more to do; the cell itself holds so many things for later.
    pub(super) fn rest(&mut self, now: Instant, engine: &Engine, things: usize) {
        if self.violation.is_some() {
            return;
        }
        for nth in 0..self.ports.len() {
            if self.sheet.ports[nth].is_field {
                let result = self.ports[nth].down.rest(&self.sheet, nth, &self.up, now);
                self.judge(now, &[Invariant::Cycle], result);
                let result = self.count(nth, engine);
                self.judge(now, &[Invariant::Counted, Invariant::Bytes], result);
            }
        }
        let result = self.nothing_waits(now);
        self.judge(now, &[Invariant::Delivered], result);
        let remembered = self.controller.size() + self.orders.len();
        let result = match (remembered, things) {
            (0..MOST_BYTES, 0..MOST_THINGS) => Ok(()),
            _ => Err((Invariant::Memory, format!("{remembered} bytes and {things} things wait in the cell"))),
        };
        self.judge(now, &[Invariant::Memory], result);
    }

    /// What time does before anything else.
    fn tick(&mut self, now: Instant) {
        let overdue = self.up.tick(&self.sheet, now);
        for &(nth, frame) in &overdue {
            self.orders.forget(nth, Some(frame));
        }
        if !overdue.is_empty() {
            self.values_changed();
        }
        for (watch, port) in self.ports.iter_mut().zip(&self.sheet.ports) {
            watch.line.tick(port, now);
            watch.down.tick(port, now);
        }
        if now >= self.again_at {
            self.write_refused_again();
        }
        let given_up = self.modbus.tick(now);
        self.write_again(given_up, now);
        self.orders.tick(now);
    }

    /// Links that the engine has given up by itself; those in `told` are its input's business.
    fn look_at_links(&mut self, engine: &Engine, told: Option<LinkId>) {
        for link in engine.links() {
            let is_lost = !matches!(link.state, LinkState::Up { .. });
            if is_lost && Some(link.id) != told && self.up.is_up(link.id) {
                self.link_lost(link.id);
            }
        }
    }

    fn link_lost(&mut self, link: LinkId) {
        if !self.up.is_up(link) {
            return;
        }
        match link {
            LinkId::MODBUS => {
                let given_up = self.modbus.lost();
                self.write_again(given_up, Instant::ZERO);
                self.write_refused_again();
            }
            LinkId::COMMAND => self.orders.lost(),
            _ => {}
        }
        self.links.remove(&link);
        self.up.link_lost(&self.sheet, link);
    }

    /// Safe values whose write came to nothing wait again, if they still stand.
    fn write_again(&mut self, vars: Vec<SysVar>, now: Instant) {
        for var in vars {
            let safe = self.sheet.owned[var.ordinal()].and_then(|owned| owned.safe);
            let known = &mut self.up.known[var.ordinal()];
            if let (true, true, Some(safe)) = (known.safe, known.waiting.is_empty(), safe) {
                known.waiting.push_back((safe, now));
            }
        }
    }

    fn write_refused_again(&mut self) {
        let refused = std::mem::take(&mut self.refused);
        self.write_again(refused, Instant::ZERO);
        self.again_at = Instant::NEVER;
    }

    /// A value that a port shows may have changed: bits may have risen.
    fn values_changed(&mut self) {
        for (watch, port) in self.ports.iter_mut().zip(&self.sheet.ports) {
            watch.down.watch(port, &self.up);
        }
    }

    fn port_bytes(&mut self, nth: usize, bytes: &[u8], now: Instant) {
        let port = &self.sheet.ports[nth];
        let watch = &mut self.ports[nth];
        watch.counters.bytes_in = watch.counters.bytes_in.wrapping_add(bytes.len() as u32);
        watch.down.heard = now;
        if port.inputs.is_empty() {
            watch.counters.rejected_no_input += 1;
            return;
        }
        let verdicts = watch.line.bytes(port, bytes, now);
        self.take(nth, verdicts, now);
    }

    fn port_can(&mut self, nth: usize, frame: &CanFrame, now: Instant) {
        let port = &self.sheet.ports[nth];
        let counters = &mut self.ports[nth].counters;
        counters.bytes_in = counters.bytes_in.wrapping_add(frame.data().len() as u32);
        if port.inputs.is_empty() {
            counters.rejected_no_input += 1;
            return;
        }
        match field::can(port, frame) {
            Ok(verdict) => self.take(nth, vec![verdict], now),
            Err(Refused::Remote) => counters.rejected_remote += 1,
            Err(Refused::Id) => counters.rejected_id += 1,
            Err(Refused::Length) => counters.rejected_length += 1,
        }
    }

    /// Frames that came in one piece.
    fn take(&mut self, nth: usize, verdicts: Vec<Verdict>, now: Instant) {
        let mut frames = 0;
        let mut newest: Option<Accepted> = None;
        for verdict in verdicts {
            let counters = &mut self.ports[nth].counters;
            let frame = match verdict {
                Verdict::NotFinite => {
                    counters.rejected_not_finite += 1;
                    continue;
                }
                Verdict::OutOfRange => {
                    counters.rejected_out_of_range += 1;
                    continue;
                }
                Verdict::Accepted(frame) => frame,
            };
            counters.frames_in += 1;
            counters.masked += u32::from(frame.masked);
            self.frames[nth].0 += 1;
            frames += 1;
            let commands_up = self.up.is_up(LinkId::COMMAND);
            self.orders.accepted(&self.sheet, nth, &frame, commands_up, now);
            self.up.accepted(&self.sheet, nth, &frame, now);
            self.values_changed();
            newest = Some(frame);
        }
        // Nothing is overdue right after a frame, but something may have waited too long.
        self.up.tick(&self.sheet, now);
        let Some(newest) = newest else { return };
        self.ports[nth].down.answered(&self.sheet.ports[nth], frames);
        let waits = self.sheet.links.iter().any(|link| {
            let wants = newest.values.iter().any(|(var, _)| {
                let way = self.sheet.owned[var.ordinal()].map(|owned| owned.way);
                way == Some(link.id) && !self.up.known(*var).waiting.is_empty()
            });
            wants && self.up.is_up(link.id) && !self.up.is_ready(link, now)
        });
        if waits {
            self.ports[nth].counters.withheld += frames;
        }
    }

    fn port_send(
        &mut self,
        port: PortId,
        id: Option<proto_core::recipe::model::CanId>,
        bytes: &[u8],
        now: Instant,
    ) {
        let nth = usize::from(port.0);
        self.frames[nth].1 += 1;
        let result = self.ports[nth].down.check(&self.sheet, nth, &self.up, id, bytes, now);
        self.judge(now, &[Invariant::Known, Invariant::Age, Invariant::Shown, Invariant::Line], result);
    }

    fn link_bytes(&mut self, link: LinkId, bytes: &[u8], now: Instant) {
        self.traffic.entry(link).or_default().1 += 1;
        match link {
            LinkId::MODBUS => {
                let (read, refused) = self.modbus.received(&self.map, bytes);
                for (var, raw) in read {
                    if self.sheet.origin[var.ordinal()] == Some(Origin::Modbus) {
                        self.up.known[var.ordinal()].value = Some((raw, now));
                    }
                }
                if !refused.is_empty() {
                    self.refused.extend(refused);
                    self.again_at = self.again_at.min(now + REFUSED_PAUSE);
                }
                self.values_changed();
            }
            LinkId::STATE => {
                let watch = self.links.entry(link).or_default();
                watch.line.held.extend_from_slice(bytes);
                while let Some(packet) =
                    self.links.get_mut(&link).and_then(|watch| first_packet(&mut watch.line))
                {
                    if is_packet(&packet) {
                        self.up.state_packet(&self.sheet, &packet, now);
                        self.values_changed();
                    }
                }
            }
            LinkId::COMMAND => {}
            _ => self.recipe_bytes(link, bytes, now),
        }
    }

    fn recipe_bytes(&mut self, link: LinkId, bytes: &[u8], now: Instant) {
        let Some(sheet) = self.sheet.link(link) else { return };
        let Some(frame) = sheet.output.clone() else { return };
        let found = if sheet.is_datagram {
            frame.payload_of(bytes).map(<[u8]>::to_vec).into_iter().collect()
        } else {
            let line = &mut self.links.entry(link).or_default().line;
            line.held.extend_from_slice(bytes);
            line.cut(&frame)
        };
        for payload in found {
            let mut values: Vec<(SysVar, Raw)> = Vec::new();
            let mut rest = payload.as_slice();
            for var in frame.fields.iter().filter_map(shown) {
                let (bytes, after) = rest.split_at(var.size());
                rest = after;
                let mut raw = Raw::default();
                raw[..bytes.len()].copy_from_slice(bytes);
                if var.is_bits() {
                    raw[0] &= var.valid_bits();
                }
                values.push((var, raw));
            }
            if values.iter().all(|(var, raw)| field::as_number(*var, *raw).is_finite()) {
                for (var, raw) in values {
                    self.up.known[var.ordinal()].value = Some((raw, now));
                }
                self.values_changed();
            }
        }
    }

    fn link_send(&mut self, link: LinkId, bytes: &[u8], now: Instant) -> Result<(), Wrong> {
        if !self.up.is_up(link) {
            return Err((Invariant::Line, "sent on a link that is not up".to_owned()));
        }
        match link {
            LinkId::COMMAND => {
                self.checks[Invariant::Once as usize] += 1;
                self.orders.sent(bytes, now)
            }
            LinkId::STATE => Err((Invariant::Ownership, "sent on the state link".to_owned())),
            LinkId::MODBUS => {
                let asked = self.modbus.sent(&self.map, bytes, now)?;
                let Asked::Write(values) = asked else { return Ok(()) };
                let mut safe = Vec::new();
                for (var, raw) in values {
                    if self.up.known(var).safe {
                        safe.push(var);
                    }
                    self.wrote(link, var, raw, now)?;
                }
                self.modbus.carries_safe(safe);
                Ok(())
            }
            _ => self.recipe_send(link, bytes, now),
        }
    }

    fn wrote(&mut self, link: LinkId, var: SysVar, raw: Raw, now: Instant) -> Result<(), Wrong> {
        self.writes += 1;
        let looked_at = [
            Invariant::Sent,
            Invariant::InTime,
            Invariant::FirstFrame,
            Invariant::Ownership,
            Invariant::NoReplay,
        ];
        for invariant in looked_at {
            self.checks[invariant as usize] += 1;
        }
        self.checks[Invariant::Edges as usize] += u64::from(var.is_bits());
        self.up.wrote(&self.sheet, link, var, raw, now)
    }

    fn recipe_send(&mut self, link: LinkId, bytes: &[u8], now: Instant) -> Result<(), Wrong> {
        let watch = self.links.entry(link).or_default();
        if std::mem::replace(&mut watch.busy, true) {
            return Err((Invariant::Line, "sent before the transport had taken the frame before".to_owned()));
        }
        let sheet = self.sheet.link(link).cloned();
        let frame = sheet.as_ref().and_then(|sheet| sheet.input.as_ref());
        let Some((frame, payload)) = frame.and_then(|frame| Some((frame, frame.payload_of(bytes)?))) else {
            // The greeting of the UDP server.
            let is_greeting = link == LinkId::RECIPE_UDP && bytes.len() <= 2 && bytes.iter().all(|&b| b == 0);
            let wrong = (Invariant::Sent, "sent what is neither a frame nor a greeting".to_owned());
            return if is_greeting { Ok(()) } else { Err(wrong) };
        };
        let mut rest = payload;
        let mut wanted = false;
        for var in frame.fields.iter().filter_map(written) {
            let (bytes, after) = rest.split_at(var.size());
            rest = after;
            let mut raw = Raw::default();
            raw[..bytes.len()].copy_from_slice(bytes);
            let is_ours = self.sheet.owned[var.ordinal()].is_some_and(|owned| owned.way == link);
            if is_ours && !self.up.known(var).waiting.is_empty() {
                wanted = true;
                self.wrote(link, var, raw, now)?;
            } else {
                self.writes += 1;
                self.checks[Invariant::Sent as usize] += 1;
                self.checks[Invariant::InTime as usize] += 1;
                self.up.carried(&self.sheet, var, raw, now)?;
            }
        }
        if wanted {
            Ok(())
        } else {
            Err((Invariant::Sent, "a frame that nobody's value waited for".to_owned()))
        }
    }

    /// What could go to the controller now and does not.
    fn nothing_waits(&self, now: Instant) -> Result<(), Wrong> {
        for &(var, way) in &self.owned {
            if self.up.known(var).waiting.is_empty() || !self.up.is_up(way) {
                continue;
            }
            let is_free = match self.sheet.link(way) {
                None => self.modbus.is_free(),
                Some(link) => {
                    !self.links.get(&way).is_some_and(|watch| watch.busy) && self.up.is_ready(link, now)
                }
            };
            if is_free {
                return Err((Invariant::Delivered, format!("{var} waits, and its link is free")));
            }
        }
        Ok(())
    }

    /// Whether the engine's counters are the model's.
    fn count(&mut self, nth: usize, engine: &Engine) -> Result<(), Wrong> {
        let Some(actual) = engine.port_counters(PortId(nth as u8)) else { return Ok(()) };
        let PortWatch { line, down, counters } = &self.ports[nth];
        let up = self.up.counted[nth];
        let orders = self.orders.counted.get(&nth).copied().unwrap_or_default();
        let expected = PortCounters {
            tail_mismatches: line.mismatches as u32,
            resync_bytes: line.dropped as u32,
            discarded_bytes: line.discarded as u32,
            frames_out: down.frames_out,
            bytes_out: down.bytes_out,
            skipped_cycles: down.skipped,
            stale_cycles: down.stale,
            edges_lost: up.edges_lost,
            values_expired: up.values_expired,
            undelivered: up.undelivered,
            timeouts: up.timeouts,
            commands: orders.0,
            commands_dropped: orders.1,
            ..*counters
        };
        if *actual != expected {
            return Err((Invariant::Counted, format!("port {nth} counted {actual:?}, not {expected:?}")));
        }
        let accounted = line.frame_bytes + line.dropped + line.discarded + line.held.len() as u64;
        let sheet = &self.sheet.ports[nth];
        if !sheet.is_can && !sheet.inputs.is_empty() && accounted as u32 != actual.bytes_in {
            let what =
                format!("port {nth} received {} bytes, {accounted} are accounted for", actual.bytes_in);
            return Err((Invariant::Bytes, what));
        }
        Ok(())
    }
}

/// The far end: what reaches the controller, and what it does with it.
impl Oracle {
    pub(super) fn sent(&mut self, conn: u64, bytes: &[u8]) {
        self.controller.sent(conn, bytes);
    }

    pub(super) fn sent_datagram(&mut self, link: LinkId, bytes: &[u8]) {
        self.controller.sent_datagram(u64::from(link.0), bytes);
    }

    pub(super) fn conn_gone(&mut self, conn: u64) {
        self.controller.gone(conn);
    }

    /// Bytes of a connection have reached the controller, whose inputs were `before` and are `after`.
    pub(super) fn arrived(
        &mut self,
        conn: u64,
        link: LinkId,
        bytes: &[u8],
        before: &[u8],
        after: &[u8],
        now: Instant,
    ) {
        let result = self.controller.arrived(conn, bytes);
        self.judge(now, &[Invariant::Transport], result);
        let mut expected = before.to_vec();
        match link {
            LinkId::MODBUS => {
                for pdu in self.controller.requests(conn, bytes) {
                    if let Some(Asked::Write(values)) = self.map.request(&pdu) {
                        put_all(&mut expected, &values);
                    }
                }
            }
            LinkId::COMMAND | LinkId::STATE => {}
            _ => {
                let Some(frame) = self.sheet.link(link).and_then(|link| link.input.clone()) else { return };
                let mut held = std::mem::take(self.controller.held(conn));
                held.extend_from_slice(bytes);
                let mut line = Line { held, ..Line::default() };
                for payload in line.cut(&frame) {
                    put_all(&mut expected, &values_of(&frame, &payload));
                }
                *self.controller.held(conn) = line.held;
            }
        }
        self.registers(before, &expected, after, now);
    }

    /// The same of a datagram.
    pub(super) fn arrived_datagram(
        &mut self,
        link: LinkId,
        bytes: &[u8],
        before: &[u8],
        after: &[u8],
        now: Instant,
    ) {
        let result = self.controller.arrived_datagram(u64::from(link.0), bytes);
        self.judge(now, &[Invariant::Transport], result);
        let mut expected = before.to_vec();
        if let Some(frame) = self.sheet.link(link).and_then(|link| link.input.as_ref())
            && let Some(payload) = frame.payload_of(bytes)
        {
            put_all(&mut expected, &values_of(frame, payload));
        }
        self.registers(before, &expected, after, now);
    }

    /// Whole, or, when the controller refuses, not at all.
    fn registers(&mut self, before: &[u8], expected: &[u8], after: &[u8], now: Instant) {
        let result = if after == expected || after == before {
            Ok(())
        } else {
            Err((Invariant::Registers, "the controller's inputs are not what was written".to_owned()))
        };
        self.judge(now, &[Invariant::Registers], result);
    }
}

fn values_of(frame: &sheet::Frame, payload: &[u8]) -> Vec<(SysVar, Raw)> {
    let mut rest = payload;
    let vars = frame.fields.iter().filter_map(written);
    let values = vars.map(|var| {
        let (bytes, after) = rest.split_at(var.size());
        rest = after;
        let mut raw = Raw::default();
        raw[..bytes.len()].copy_from_slice(bytes);
        (var, raw)
    });
    values.collect()
}

fn put_all(image: &mut [u8], values: &[(SysVar, Raw)]) {
    for (var, raw) in values {
        let at = var.image_offset();
        let mask = if var.is_bits() { var.valid_bits() } else { 0xFF };
        for (place, byte) in image[at..at + var.size()].iter_mut().zip(raw) {
            *place = byte & mask;
        }
    }
}

fn is_up(engine: &Engine, id: LinkId) -> bool {
    engine.links().any(|link| link.id == id && matches!(link.state, LinkState::Up { .. }))
}

fn first_packet(line: &mut Line) -> Option<Vec<u8>> {
    (line.held.len() >= PACKET).then(|| line.held.drain(..PACKET).collect())
}

/// Whether the first six joints are where joints can be (D8).
fn is_packet(packet: &[u8]) -> bool {
    packet.chunks_exact(4).take(6).all(|joint| {
        let joint = f32::from_le_bytes([joint[0], joint[1], joint[2], joint[3]]);
        joint.is_finite() && joint.abs() <= 1_000.0
    })
}

const PACKET: usize = 1_468;
/// A safe value that the controller refused is written again after this.
const REFUSED_PAUSE: Duration = Duration::from_millis(500);
/// More than any stall can gather.
const MOST_BYTES: usize = 1 << 20;
const MOST_THINGS: usize = 100_000;

const ALL: [Invariant; 20] = [
    Invariant::Sent,
    Invariant::InTime,
    Invariant::FirstFrame,
    Invariant::Ownership,
    Invariant::NoReplay,
    Invariant::Edges,
    Invariant::Delivered,
    Invariant::Counted,
    Invariant::Bytes,
    Invariant::Once,
    Invariant::Known,
    Invariant::Age,
    Invariant::Shown,
    Invariant::Cycle,
    Invariant::Line,
    Invariant::Transport,
    Invariant::Registers,
    Invariant::Work,
    Invariant::Memory,
    Invariant::NoPanic,
];

#[cfg(test)]
mod tests;
