//! The controller's recipe ports (docs/simulated-controller.md section 5, proto-core/docs/wire/recipes.md).
//!
//! In: received bytes, datagrams and CAN frames, the time, and what a program sends. Out: input
//! variables written, output frames on a fixed grid, frames for the program. Knows neither devices
//! nor sockets.
//!
//! A realtime output part is sent on an absolute grid that all ports share: a deadline that comes
//! while the frame before is still leaving, or while the line is not quiet, is skipped and counted,
//! never made up for. Every received input frame is applied at once.

mod clients;
mod counters;
mod recipe;

use std::collections::VecDeque;
use std::net::SocketAddr;

use proto_core::recipe::model::{MAX_STREAM_FRAME, Mode};
use proto_core::recipe::{CanReject, Deframer, EncodeError, datagram};
use proto_core::schedule::Grid;
use proto_core::sysvar::IMAGE_BYTES;
use proto_core::time::{Duration, Instant};
use proto_core::wire::can::{CanFrame, CanId};
use proto_core::wire::scalar::{Scalar, ScalarType};

use super::registers::Registers;
use clients::Clients;
pub use clients::MAX_UDP_CLIENTS;
pub use counters::PortCounters;
use recipe::Parts;
pub use recipe::RecipeError;
use recipe_config::{SimBus, SimConfig, SimPort};

/// What a port wants to send.
#[derive(Debug, Clone, PartialEq)]
pub(super) enum Outgoing {
    Bytes(Vec<u8>),
    Can(CanFrame),
    Datagram { peer: SocketAddr, bytes: Vec<u8> },
}

/// A frame of a user recipe, for a program.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Received {
    pub(super) id: Option<CanId>,
    pub(super) values: Vec<Scalar>,
}

/// One port.
#[derive(Debug)]
pub(super) struct Port {
    name: String,
    medium: Medium,
    recipe: Option<(Mode, Parts)>,
    up: bool,
    cycle: Duration,
    /// For a realtime output part, while the port is up.
    grid: Option<Grid>,
    transmitter: Transmitter,
    deframer: Deframer,
    newest_byte: Instant,
    inbox: VecDeque<Received>,
    counters: PortCounters,
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
    /// The cycle's frame waits for the line to be quiet; it is made when it leaves.
    CycleDue,
    /// A program's frame waits for that.
    Waiting(Outgoing),
    /// Until everything has left.
    Sending,
}

impl Port {
    pub(super) fn new(config: &SimConfig, port: &SimPort) -> Result<Self, RecipeError> {
        let recipe = compile(config, port)?;
        let medium = match &port.bus {
            SimBus::Rs485(line) => {
                // 3.5 characters of at most 12 bits, when that is the longer of the two (D19).
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
            cycle: port.cycle.max(SHORTEST_CYCLE),
            grid: None,
            transmitter: Transmitter::Idle,
            deframer: Deframer::new(),
            newest_byte: Instant::ZERO,
            inbox: VecDeque::new(),
            counters: PortCounters::default(),
        })
    }

    /// Gives the port the recipe that `port` has now. Partial frames, frames that wait for a
    /// program and UDP clients belong to the old one (D24).
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

    pub(super) fn counters(&self) -> PortCounters {
        let stats = self.deframer.stats();
        PortCounters {
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

    /// The port can be used; `epoch` is where all grids begin.
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

    /// Everything that was handed over has left.
    pub(super) fn sent(&mut self) {
        if self.transmitter == Transmitter::Sending {
            self.transmitter = Transmitter::Idle;
        }
    }

    /// Whether a program's frame is still on its way.
    pub(super) fn is_busy(&self) -> bool {
        self.transmitter != Transmitter::Idle
    }

    /// Bytes of the stream, or one datagram.
    pub(super) fn receive(
        &mut self,
        now: Instant,
        bytes: &[u8],
        registers: &mut Registers,
        listening: Listening,
    ) {
        self.counters.bytes_in += bytes.len() as u64;
        if self.transmitter == Transmitter::Sending && matches!(self.medium, Medium::Rs485 { .. }) {
            self.counters.bytes_while_sending += bytes.len() as u64;
        }
        let Some((mode, Parts::Stream { input: Some(layout), .. })) = &self.recipe else {
            self.counters.unexpected_bytes += bytes.len() as u64;
            return;
        };
        let gap = match self.medium {
            Medium::Rs485 { idle_gap, .. } => idle_gap,
            _ => IDLE_GAP,
        };
        let silence = now.saturating_since(self.newest_byte);
        self.newest_byte = now;
        let mut sink =
            Sink { mode: *mode, listening, registers, inbox: &mut self.inbox, counters: &mut self.counters };
        match self.medium {
            Medium::UdpServer(_) | Medium::UdpClient => match datagram(layout, bytes) {
                Ok(payload) => sink.take(
                    None,
                    |image| layout.apply(payload, image).map(|applied| applied.masked),
                    || layout.check(payload).map(|()| layout.values(payload).collect()),
                ),
                Err(_) => self.counters.wrong_datagrams += 1,
            },
            _ => {
                if silence >= gap {
                    self.deframer.discard();
                }
                let mut rest = bytes;
                while let Some(payload) = self.deframer.next_frame(layout, &mut rest) {
                    sink.take(
                        None,
                        |image| layout.apply(payload, image).map(|applied| applied.masked),
                        || layout.check(payload).map(|()| layout.values(payload).collect()),
                    );
                }
            }
        }
    }

    /// A datagram at the UDP server.
    pub(super) fn heard(&mut self, now: Instant, peer: SocketAddr) {
        self.forget_silent(now);
        if let Medium::UdpServer(clients) = &mut self.medium
            && clients.heard(now, peer)
        {
            self.counters.clients_displaced += 1;
        }
    }

    /// Who has something to send and does not is not streamed to for ever (D30).
    fn forget_silent(&mut self, now: Instant) {
        if let Medium::UdpServer(clients) = &mut self.medium
            && self.recipe.as_ref().is_some_and(|(_, parts)| parts.has_input())
        {
            self.counters.clients_silent += clients.forget_silent(now) as u64;
        }
    }

    /// Nobody listens at `peer` any more.
    pub(super) fn unreachable(&mut self, peer: SocketAddr) {
        if let Medium::UdpServer(clients) = &mut self.medium
            && clients.unreachable(peer)
        {
            self.counters.clients_gone += 1;
        }
    }

    /// A frame from the CAN bus.
    pub(super) fn receive_can(&mut self, frame: &CanFrame, registers: &mut Registers, listening: Listening) {
        self.counters.bytes_in += frame.data().len() as u64;
        let Some((mode, Parts::Can { input: Some(layout), .. })) = &self.recipe else {
            self.counters.unknown_ids += 1;
            return;
        };
        let accepted = match layout.accept(frame) {
            Ok(index) => layout.frame(index),
            Err(CanReject::Remote { .. }) => {
                self.counters.remote_frames += 1;
                return;
            }
            Err(CanReject::WrongLength { .. }) => {
                self.counters.wrong_lengths += 1;
                return;
            }
            Err(_) => {
                self.counters.unknown_ids += 1;
                return;
            }
        };
        let Some(part) = accepted else { return };
        let mut sink =
            Sink { mode: *mode, listening, registers, inbox: &mut self.inbox, counters: &mut self.counters };
        sink.take(
            Some(part.id()),
            |image| part.apply(frame.data(), image).map(|applied| applied.masked),
            || part.check(frame.data()).map(|()| part.values(frame.data()).collect()),
        );
    }

    /// The oldest frame that waits for a program.
    pub(super) fn next_received(&mut self) -> Option<Received> {
        self.inbox.pop_front()
    }

    /// Forgets frames that waited for a program that is gone.
    pub(super) fn forget_received(&mut self) {
        self.inbox.clear();
    }

    /// Whether a program can receive here.
    pub(super) fn check_receive(&self) -> Result<(), String> {
        match &self.recipe {
            Some((Mode::User, Parts::Stream { input: Some(_), .. } | Parts::Can { input: Some(_), .. })) => {
                Ok(())
            }
            _ => Err(format!("{} has no user-defined recipe with an input part", self.name)),
        }
    }

    /// Takes a program's frame. It has left when [`Self::is_busy`] is false again.
    pub(super) fn send(&mut self, id: Option<i64>, values: &[f64]) -> Result<(), String> {
        let name = &self.name;
        let Some((Mode::User, parts)) = &self.recipe else {
            return Err(format!("{name} has no user-defined recipe"));
        };
        if !self.up {
            return Err(format!("{name} is not connected"));
        }
        let outgoing = match (parts, id) {
            (Parts::Stream { output: Some(layout), .. }, None) => {
                let values = typed(name, values, layout.fields().map(|placed| placed.field.ty()))?;
                let mut out = vec![0; layout.frame_len()];
                layout.encode_values(&values, &mut out).map_err(|error| refused(name, error))?;
                Outgoing::Bytes(out)
            }
            (Parts::Can { output: Some(layout), .. }, id) => {
                let index = match id {
                    Some(id) => recipe::frame_of(layout, id)
                        .ok_or_else(|| format!("{name}: id {id} is not in the recipe's output part"))?,
                    None if layout.frame_count() == 1 => 0,
                    None => return Err(format!("{name}: the output part has several ids; give one")),
                };
                let part = layout.frame(index).ok_or_else(|| format!("{name}: no such frame"))?;
                let values = typed(name, values, part.fields().map(|placed| placed.field.ty()))?;
                Outgoing::Can(part.encode_values(&values).map_err(|error| refused(name, error))?)
            }
            (Parts::Stream { output: Some(_), .. }, Some(_)) => {
                return Err(format!("{name} carries a stream recipe: comm_send takes no frame id"));
            }
            _ => return Err(format!("{name}: the recipe has no output part")),
        };
        self.transmitter = Transmitter::Waiting(outgoing);
        Ok(())
    }

    /// When something is to be sent.
    pub(super) fn deadline(&self) -> Option<Instant> {
        let grid = self.grid.as_ref().map(Grid::next);
        let waiting = match self.transmitter {
            Transmitter::CycleDue | Transmitter::Waiting(_) => Some(self.quiet_at()),
            Transmitter::Idle | Transmitter::Sending => None,
        };
        [grid, waiting].into_iter().flatten().min()
    }

    /// What has become due.
    pub(super) fn poll(&mut self, now: Instant, image: &[u8; IMAGE_BYTES]) -> Vec<Outgoing> {
        if let Some(missed) = self.grid.as_mut().and_then(|grid| grid.due(now)) {
            self.counters.skipped_cycles += missed;
            match self.transmitter {
                Transmitter::Idle => self.transmitter = Transmitter::CycleDue,
                _ => self.counters.skipped_cycles += 1,
            }
        }
        if now < self.quiet_at() {
            return Vec::new();
        }
        match std::mem::replace(&mut self.transmitter, Transmitter::Idle) {
            Transmitter::CycleDue => {
                self.forget_silent(now);
                let frames = self.cycle_frames(image);
                // Datagrams leave at once; everything else says when it has.
                if !frames.is_empty() && !matches!(self.medium, Medium::UdpServer(_) | Medium::UdpClient) {
                    self.transmitter = Transmitter::Sending;
                }
                self.count_out(&frames);
                frames
            }
            Transmitter::Waiting(frame) => {
                self.transmitter = Transmitter::Sending;
                let frames = vec![frame];
                self.count_out(&frames);
                frames
            }
            other => {
                self.transmitter = other;
                Vec::new()
            }
        }
    }

    /// The output part with the present values.
    fn cycle_frames(&self, image: &[u8; IMAGE_BYTES]) -> Vec<Outgoing> {
        match &self.recipe {
            Some((_, Parts::Stream { output: Some(layout), .. })) => {
                let mut out = [0; MAX_STREAM_FRAME];
                let len = layout.encode(image, &mut out).unwrap_or(0);
                let bytes = out.get(..len).unwrap_or(&[]);
                match &self.medium {
                    Medium::UdpServer(clients) => clients
                        .iter()
                        .map(|peer| Outgoing::Datagram { peer, bytes: bytes.to_vec() })
                        .collect(),
                    _ => vec![Outgoing::Bytes(bytes.to_vec())],
                }
            }
            Some((_, Parts::Can { output: Some(layout), .. })) => {
                layout.frames().map(|frame| Outgoing::Can(frame.encode(image))).collect()
            }
            _ => Vec::new(),
        }
    }

    fn count_out(&mut self, frames: &[Outgoing]) {
        self.counters.frames_out += frames.len() as u64;
        for frame in frames {
            self.counters.bytes_out += match frame {
                Outgoing::Bytes(bytes) | Outgoing::Datagram { bytes, .. } => bytes.len(),
                Outgoing::Can(frame) => frame.data().len(),
            } as u64;
        }
    }

    /// When the line may be driven: half duplex waits for silence.
    fn quiet_at(&self) -> Instant {
        match self.medium {
            Medium::Rs485 { turnaround, .. } if self.counters.bytes_in > 0 => self.newest_byte + turnaround,
            _ => Instant::ZERO,
        }
    }
}

fn compile(config: &SimConfig, port: &SimPort) -> Result<Option<(Mode, Parts)>, RecipeError> {
    let Some(index) = port.recipe else { return Ok(None) };
    let recipe = config.recipes.get(index).ok_or(RecipeError::NoSuchRecipe)?;
    Ok(Some((recipe.mode, Parts::new(recipe, &port.bus)?)))
}

/// Whether a program is there that may want received frames.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Listening {
    Yes,
    No,
}

/// Where an accepted frame goes.
struct Sink<'a> {
    mode: Mode,
    listening: Listening,
    registers: &'a mut Registers,
    inbox: &'a mut VecDeque<Received>,
    counters: &'a mut PortCounters,
}

impl Sink<'_> {
    fn take<E>(
        &mut self,
        id: Option<CanId>,
        apply: impl FnOnce(&mut [u8; IMAGE_BYTES]) -> Result<u16, E>,
        values: impl FnOnce() -> Result<Vec<Scalar>, E>,
    ) {
        self.counters.frames_in += 1;
        match self.mode {
            Mode::Realtime => match self.registers.write_inputs(apply) {
                Ok(masked) => self.counters.masked_fields += u64::from(masked),
                Err(_) => self.counters.rejected_values += 1,
            },
            Mode::User => match values() {
                Err(_) => self.counters.rejected_values += 1,
                Ok(_) if self.listening == Listening::No => self.counters.frames_without_program += 1,
                Ok(values) => {
                    if self.inbox.len() >= MAX_INBOX {
                        self.inbox.pop_front();
                        self.counters.inbox_overflows += 1;
                    }
                    self.inbox.push_back(Received { id, values });
                }
            },
        }
    }
}

fn refused(name: &str, error: EncodeError) -> String {
    format!("{name}: {error}")
}

/// A program's numbers as the fields' types.
fn typed(
    name: &str,
    values: &[f64],
    types: impl Iterator<Item = ScalarType> + Clone,
) -> Result<Vec<Scalar>, String> {
    let count = types.clone().count();
    if values.len() != count {
        return Err(format!("{name}: the frame has {count} fields, {} values were given", values.len()));
    }
    let convert = |(ty, &value)| Scalar::from_f64(ty, value).map_err(|error| format!("{name}: {error}"));
    types.zip(values).map(convert).collect()
}

/// Frames that wait for a program; the oldest makes room.
pub const MAX_INBOX: usize = 64;
/// The fastest cycle a controller has.
const SHORTEST_CYCLE: Duration = Duration::from_millis(4);
/// On TCP, a partial frame is discarded after this much silence (D19).
const IDLE_GAP: Duration = Duration::from_millis(50);
