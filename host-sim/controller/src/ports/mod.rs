//! The controller's recipe ports (docs/simulated-controller.md section 5, proto-core/docs/wire/recipes.md).
//!
//! In: received bytes, datagrams and CAN frames, the time, and frames of a program. Out: values of input
//! variables, output frames on a fixed grid, and frames for a program. Does not know devices or sockets.
//!
//! A realtime output part is sent on an absolute grid that all ports share. A cycle that is due while the previous
//! frame is still being sent, or while the line is not quiet, is skipped and counted, never sent late. Every received
//! frame is applied at once.

mod clients;
mod receive;
mod recipe;
mod send;

use std::collections::VecDeque;

use proto_core::recipe::Deframer;
use proto_core::recipe::model::Mode;
use proto_core::schedule::Grid;
use proto_core::time::{Duration, Instant};

use crate::counters::RecipePortCounters;
use clients::Clients;
pub use clients::MAX_UDP_CLIENTS;
pub(crate) use receive::Listening;
pub use receive::MAX_INBOX;
use receive::Received;
use recipe::PartLayouts;
pub use recipe::RecipeError;
use recipe_config::{SimBus, SimConfig, SimPort};
pub(crate) use send::{Handed, PortData};

#[derive(Debug)]
pub(super) struct RecipePort {
    name: String,
    medium: Medium,
    recipe: Option<(Mode, PartLayouts)>,
    up: bool,
    cycle: Duration,
    /// The cycles of a realtime output part, while the port is up.
    grid: Option<Grid>,
    transmitter: Transmitter,
    deframer: Deframer,
    newest_byte: Instant,
    inbox: VecDeque<Received>,
    counters: RecipePortCounters,
}

#[derive(Debug)]
enum Medium {
    Rs485 { idle_gap: Duration, turnaround: Duration },
    Can,
    UdpServer(Clients),
    TcpClient,
    UdpClient,
}

#[derive(Debug, PartialEq)]
enum Transmitter {
    Idle,
    /// The cycle's frame waits for a quiet line and is encoded when it is sent.
    CycleDue,
    /// A program's frame waits for a quiet line.
    Waiting(PortData),
    /// Everything was handed to the device and has not been sent yet.
    Sending,
}

impl RecipePort {
    pub(super) fn new(config: &SimConfig, port: &SimPort) -> Result<Self, RecipeError> {
        let recipe = compile(config, port)?;
        let medium = match &port.bus {
            SimBus::Rs485(line) => {
                // At least 3.5 characters of at most 12 bits (D19).
                let characters = Duration::from_micros(42_000_000 / u64::from(line.baud.max(1)));
                Medium::Rs485 { idle_gap: line.idle_gap.max(characters), turnaround: line.turnaround }
            }
            SimBus::Can { .. } => Medium::Can,
            SimBus::UdpServer => Medium::UdpServer(Clients::default()),
            SimBus::TcpClient { .. } => Medium::TcpClient,
            SimBus::UdpClient { .. } => Medium::UdpClient,
        };
        Ok(Self {
            name: port.name.clone(),
            medium,
            recipe,
            up: false,
            cycle: port.cycle.max(MIN_CYCLE),
            grid: None,
            transmitter: Transmitter::Idle,
            deframer: Deframer::new(),
            newest_byte: Instant::ZERO,
            inbox: VecDeque::new(),
            counters: RecipePortCounters::default(),
        })
    }

    /// Takes the present recipe of `port`. Partial frames, frames that wait for a program, and UDP clients are dropped
    /// with the old recipe (D24).
    pub(super) fn assign(
        &mut self,
        now: Instant,
        epoch: Instant,
        config: &SimConfig,
        port: &SimPort,
    ) -> Result<(), RecipeError> {
        self.recipe = compile(config, port)?;
        self.inbox.clear();
        if self.up {
            self.went_down();
            self.came_up(now, epoch);
        }
        Ok(())
    }

    pub(super) fn name(&self) -> &str {
        &self.name
    }

    pub(super) fn counters(&self) -> RecipePortCounters {
        let stats = self.deframer.stats();
        RecipePortCounters {
            skipped_bytes: stats.skipped_bytes,
            tail_mismatches: stats.tail_mismatches,
            discarded_bytes: stats.discarded_bytes,
            ..self.counters
        }
    }

    pub(super) fn is_udp_server(&self) -> bool {
        matches!(self.medium, Medium::UdpServer(_))
    }

    pub(super) fn is_tcp_client(&self) -> bool {
        matches!(self.medium, Medium::TcpClient)
    }

    pub(super) fn is_up(&self) -> bool {
        self.up
    }

    /// The port is up; `epoch` is the origin of all grids.
    pub(super) fn came_up(&mut self, now: Instant, epoch: Instant) {
        if self.up {
            return;
        }
        self.up = true;
        self.counters.ups += 1;
        self.transmitter = Transmitter::Idle;
        self.deframer.discard();
        if let Some((Mode::Realtime, parts)) = &self.recipe
            && parts.has_output()
        {
            let mut grid = Grid::starting_at(epoch, self.cycle);
            grid.due(now);
            self.grid = Some(grid);
        }
    }

    pub(super) fn went_down(&mut self) {
        self.up = false;
        self.grid = None;
        self.transmitter = Transmitter::Idle;
        self.deframer.discard();
        if let Medium::UdpServer(clients) = &mut self.medium {
            clients.clear();
        }
    }

    pub(super) fn cycle(&self) -> Duration {
        self.cycle
    }

    pub(super) fn set_cycle(&mut self, now: Instant, epoch: Instant, cycle: Duration) {
        self.cycle = cycle.max(MIN_CYCLE);
        if self.grid.is_some() {
            let mut grid = Grid::starting_at(epoch, self.cycle);
            grid.due(now);
            self.grid = Some(grid);
        }
    }

    pub(super) fn sent(&mut self) {
        if self.transmitter == Transmitter::Sending {
            self.transmitter = Transmitter::Idle;
        }
    }
}

fn compile(config: &SimConfig, port: &SimPort) -> Result<Option<(Mode, PartLayouts)>, RecipeError> {
    let Some(index) = port.recipe else { return Ok(None) };
    let recipe = config.recipes.get(index).ok_or(RecipeError::NoSuchRecipe)?;
    Ok(Some((recipe.mode, PartLayouts::new(recipe, &port.bus)?)))
}

/// The controller's shortest cycle.
const MIN_CYCLE: Duration = Duration::from_millis(4);
