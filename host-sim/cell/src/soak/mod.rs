//! Soak runs: hours of cells in virtual time with random faults, where every step of the gateway is checked
//! (docs/cell.md sections 4 and 5).
//!
//! In: cells, a seed, a level of faults, virtual time. Out: a [`Total`], the same for the same seed on every machine
//! and for any number of threads, or the first violation and how to repeat it. Does not know how results are printed:
//! `host-sim soak` does that.

mod batch;
mod behaviour;
mod cells;
mod part;
mod peers;
mod plc;
mod random_device;
mod share;
mod show;
mod slaves;
mod template;
mod world;

use std::collections::BTreeMap;

use proto_core::config::{Bus, GatewayConfig};
use proto_core::engine::PortId;
use proto_core::time::{Duration, Instant};

pub use batch::{Batch, Failure, Progress, RUN_LENGTH, Total};
pub use cells::Scenario;
pub use part::{FORMAT, NotOneBatch, Part, PartCell, PartFailure, Sums};
pub use share::{MAX_SHARES, NoShare, Share};
pub use show::show_trace;

use crate::judge::Program;
use crate::line::Line;
use crate::{Cell, CellError, Chunking, FaultInjector, FaultKind, Invariant, Rng, Violation, Wiring};
use peers::Peers;
use plc::Plc;
use random_device::RandomDevice;
use slaves::Slaves;
use world::World;

/// How many faults are injected.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub enum Level {
    /// No faults; devices still send invalid frames.
    None,
    /// A fault every 30 s, on a quiet network.
    Mild,
    /// A fault every second, on a network that delays, splits and joins data.
    Harsh,
}

impl Level {
    /// The name that `--faults` takes.
    pub const fn name(self) -> &'static str {
        match self {
            Self::None => "none",
            Self::Mild => "mild",
            Self::Harsh => "harsh",
        }
    }

    const fn pause(self) -> Option<Duration> {
        match self {
            Self::None => None,
            Self::Mild => Some(Duration::from_secs(30)),
            Self::Harsh => Some(Duration::from_secs(1)),
        }
    }
}

/// A cell that runs with faults.
#[derive(Debug)]
pub struct Soak {
    cell: Cell,
    injector: Option<FaultInjector>,
    life: Life,
    start: Instant,
}

/// What happens at the controller.
#[derive(Debug)]
enum Life {
    /// Random events.
    World(World),
    /// A robot program that sends orders to a device.
    Program(Program),
}

impl Life {
    fn next(&self) -> Instant {
        match self {
            Self::World(world) => world.next(),
            Self::Program(program) => program.next(),
        }
    }

    fn poll(&mut self, cell: &mut Cell) {
        match self {
            Self::World(world) => world.poll(cell),
            Self::Program(program) => program.poll(cell),
        }
    }
}

/// The report of one run.
#[derive(Debug, Clone, PartialEq)]
pub struct Report {
    /// Virtual time that has passed.
    pub span: Duration,
    /// The hash of the trace.
    pub digest: u64,
    /// Number of entries in the trace.
    pub events: u64,
    /// Faults of each kind.
    pub faults: BTreeMap<FaultKind, u64>,
    /// Number of frames received and sent on each field port of the gateway, by name.
    pub ports: Vec<(String, u64, u64)>,
    /// Number of sends and receives on each link, by name.
    pub links: Vec<(&'static str, u64, u64)>,
    /// Number of values written to the controller that were checked.
    pub writes: u64,
    /// Number of checks of each invariant.
    pub checks: BTreeMap<Invariant, u64>,
    /// The outcomes of events, if a device is judged.
    pub outcomes: BTreeMap<&'static str, u64>,
    /// The first violation, and its time since the start.
    pub violation: Option<(Violation, Duration)>,
}

impl Soak {
    /// A cell of this scenario with this seed, switched on now.
    ///
    /// # Errors
    /// [`CellError`] if a configuration cannot run.
    pub fn new(scenario: &Scenario, seed: u64, level: Level) -> Result<Self, CellError> {
        let mut cell = Cell::new(&scenario.gateway, &scenario.controller, seed)?;
        let mut rng = cell.fork_rng();
        cell.keep_heard(0);
        let program = match scenario.judged {
            None => {
                cell.watch();
                attach_devices(&mut cell, &scenario.gateway, level, &mut rng);
                None
            }
            Some(kind) => {
                prepare_line(&mut cell, &scenario.gateway, level, &mut rng);
                Some(kind.begin(&mut cell, &scenario.gateway, rng.fork()))
            }
        };
        if level == Level::Harsh {
            cell.every_network(|network| {
                network.delay = rng.up_to(Duration::from_millis(2));
                network.jitter = rng.up_to(Duration::from_millis(3));
                network.merge = rng.up_to(Duration::from_millis(4));
                network.longest_segment = (rng.below(3) > 0).then(|| rng.between(20, 2_000) as usize);
                network.loss_ppm = rng.below(3_000) as u32;
                network.duplicate_ppm = rng.below(3_000) as u32;
                network.ack_delay = match rng.below(3) {
                    0 => Duration::from_millis(rng.between(40, 200)),
                    _ => Duration::ZERO,
                };
                network.ack_report = rng.up_to(Duration::from_millis(20));
                network.send_buffer = 1_024 << rng.below(7);
            });
            // Requests to devices are short.
            for link in cell.device_links() {
                cell.network(link).longest_segment = (rng.below(2) == 0).then(|| rng.between(1, 12) as usize);
            }
        }
        let life = match program {
            Some(program) => Life::Program(program),
            None => Life::World(World::new(&scenario.gateway, cell.now(), rng.fork())),
        };
        let injector = level.pause().map(|pause| FaultInjector::new(&mut cell, &FaultKind::ALL, pause));
        let start = cell.now();
        Ok(Self { cell, injector, life, start })
    }

    /// The cell.
    pub fn cell(&self) -> &Cell {
        &self.cell
    }

    /// The cell, mutable, for example to keep its trace.
    pub fn cell_mut(&mut self) -> &mut Cell {
        &mut self.cell
    }

    /// Virtual time that has passed.
    pub fn elapsed(&self) -> Duration {
        self.cell.now().saturating_since(self.start)
    }

    /// Advances time until `elapsed` after the start, or until an invariant is violated. The result does not depend on
    /// how the time is split into calls.
    pub fn run_to(&mut self, elapsed: Duration) {
        let end = self.start + elapsed;
        while self.cell.violation().is_none() {
            let next = self.life.next().min(end);
            let span = next.saturating_since(self.cell.now());
            match &mut self.injector {
                Some(injector) => injector.run(&mut self.cell, span),
                None => self.cell.run(span),
            }
            if next >= end {
                return;
            }
            self.life.poll(&mut self.cell);
        }
    }

    /// The report so far.
    pub fn report(&self) -> Report {
        let engine = self.cell.engine();
        let ports = self.cell.gateway().ports.iter().zip(0..).filter_map(|(port, nth)| {
            let _ = engine.port_counters(PortId(nth))?;
            let (received, sent) = self.cell.watched_frames(PortId(nth));
            Some((port.name.as_str().to_owned(), received, sent))
        });
        let links = engine.links().map(|link| {
            let (sent, received) = self.cell.watched_link(link.id);
            (link.kind.name(), sent, received)
        });
        Report {
            span: self.elapsed(),
            digest: self.cell.trace().digest(),
            events: self.cell.trace().count(),
            faults: self.injector.as_ref().map(|injector| injector.counts().clone()).unwrap_or_default(),
            ports: ports.collect(),
            links: links.collect(),
            writes: self.cell.watched_writes(),
            // A panic leaves no report, so a report means that this check passed.
            checks: self.cell.checks().into_iter().chain([(Invariant::NoPanic, 1)]).collect(),
            outcomes: self.cell.outcomes(),
            violation: self
                .cell
                .violation()
                .map(|broken| (broken.clone(), broken.at.saturating_since(self.start))),
        }
    }
}

/// Varies how a line delivers bytes. Gathered bytes are reported after at most `longest_ms` milliseconds.
fn vary_delivery(line: &mut Line, longest_ms: u64, level: Level, rng: &mut Rng) {
    line.chunking = match rng.below(5) {
        2 => Chunking::Gathered(Duration::from_millis(rng.between(1, longest_ms))),
        0 => Chunking::Pieces(rng.between(1, 16) as usize),
        1 => Chunking::Random(rng.between(1, 40) as usize),
        _ => Chunking::Whole,
    };
    if level == Level::Harsh && rng.below(4) == 0 {
        line.wiring = Wiring::TwoWire;
    }
}

/// Sets how the line of a judged device delivers bytes.
fn prepare_line(cell: &mut Cell, config: &GatewayConfig, level: Level, rng: &mut Rng) {
    let Some(port) = config.ports.first().filter(|port| matches!(port.bus, Bus::Rs485(_))) else { return };
    let line = cell.line_of(&port.name);
    vary_delivery(cell.line(line), 8, level, rng);
    // An adapter that echoes sent bytes, without a setting that says so.
    cell.line(line).gives_back = level == Level::Harsh && rng.below(3) == 0;
}

/// Attaches a device to each field port and sets how its line delivers bytes.
fn attach_devices(cell: &mut Cell, config: &GatewayConfig, level: Level, rng: &mut Rng) {
    for port in &config.ports {
        let mut rng = rng.fork();
        let seed = rng.fork();
        let now = cell.now();
        match port.bus {
            Bus::Rs485(_) => {
                let line = cell.line_of(&port.name);
                vary_delivery(cell.line(line), 16, level, &mut rng);
                if let Some(peers) = Peers::new(config, port, now, seed.clone()) {
                    cell.attach(line, peers);
                } else if let Some(device) = RandomDevice::new(config, port, now, seed.clone()) {
                    cell.attach(line, device);
                } else if let Some(slaves) = Slaves::new(config, port, now, seed.clone()) {
                    cell.attach(line, slaves);
                } else if let Some(plc) = Plc::new(config, port, now, seed) {
                    cell.attach(line, plc);
                }
            }
            Bus::Can { .. } => {
                let bus = cell.bus_of(&port.name);
                if let Some(peers) = Peers::new(config, port, now, seed.clone()) {
                    cell.attach_can(bus, peers);
                } else if let Some(device) = RandomDevice::new(config, port, now, seed) {
                    cell.attach_can(bus, device);
                }
            }
            Bus::ModbusTcp { .. } | Bus::TcpListen { .. } | Bus::UdpListen { .. } => {}
        }
    }
}
