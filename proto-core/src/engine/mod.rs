//! The gateway: one run loop over field ports and controller links, without I/O (docs/engine.md).
//!
//! One rule: change the engine once with [`Engine::handle`], then drain [`Engine::poll_output`] until it returns
//! [`Output::Sleep`]. Polling early is harmless. The engine never reads a clock, never sleeps, never does I/O and never
//! allocates; the work of a call is bounded by the size of the configuration and of its input.
//!
//! Only [`Input::Tick`] lets a deadline pass, so input that waited while the driver was busy still counts as in time.
//! After more than [`ASLEEP`] without a call the age of waiting input is unknown, and it is discarded.
//!
//! Errors of a device or of the controller are counted and skipped; the run loop never fails because of them. A frame
//! is applied as a whole or not at all, except for device frames, whose fields are judged one by one.

mod build_error;
mod clock;
mod counters;
mod dispatch;
mod field;
mod io;
mod latency;
mod link;
mod plan;
mod rejection;
mod status;
#[cfg(feature = "serde")]
mod status_serde;
mod tap;
mod values;

pub use build_error::{BuildError, PlanError};
pub use clock::ASLEEP;
pub use counters::{LinkCounters, PortCounters};
pub use field::event::Outcome;
pub use field::peer_counters::{EventCounters, PeerCounters};
pub use field::rules::{Taken, judge_field};
pub use io::{
    BusState, Endpoint, Handled, Input, LinkId, LinkKind, Output, PortId, PortState, ReplyCode, Transport,
};
pub use latency::Latency;
pub use link::dropped::{DropReason, DroppedCommand};
pub use link::failed::FailedCommand;
pub use link::links::LinkInfo;
pub use link::other_text::{MAX_OTHER_TEXT, OtherText};
pub use link::state::ControllerStatus;
pub use link::stops::COMMAND_QUEUE;
pub use plan::routes::{Plan, Route, Source};
pub use rejection::{KEPT_BYTES, LastRejection, RejectedField, Rejection};
pub use status::{FieldBus, Health, PeerStatus, PortStatus, Status, VariableStatus};
pub use tap::{MAX_TAPPED, TAP_OVERHEAD, Tap, TapDirection, TapPlace, TapRecord, TapVerdict};

use heapless::{String, Vec};

use clock::Clock;
use dispatch::time::deadlines;
use dispatch::{EngineView, hold};
use field::bindings::{Bindings, InputBind, OutputBind, Sendable};
use field::exchanges::{ExchangeItem, Exchanges, Piece};
use field::health::{PortsHealth, state_of};
use field::port::{FieldPort, find_port};
use field::turns::{PeerState, Row};
use link::command::CommandLink;
use link::device::DeviceLink;
use link::links::{Links, LinksView, MAX_HOST, Maybe};
use link::modbus::ModbusLink;
use link::recipe::RecipeLink;
use link::state::StateLink;
use values::bits::SafeBytes;
use values::outbox::EdgeQueue;
use values::store::Store;

use crate::config::{ConfigView, MAX_EXCHANGES, MAX_SAFE_VALUES, MAX_SENDABLE};
use crate::image::Image;
use crate::recipe::model::MAX_STREAM_FRAME;
use crate::time::Instant;
use crate::wire::state::LEN;

/// Size of the buffer for [`Engine::poll_output`]: the longest stream frame; every request to the
/// controller is shorter.
pub const OUTPUT_BUFFER: usize = MAX_STREAM_FRAME;

/// Size of a receive buffer that holds a state packet in one piece, and shows that a datagram is
/// longer than any frame. Bytes may be reported in pieces of any other size.
pub const INPUT_BUFFER: usize = 1536;
const _: () = assert!(INPUT_BUFFER >= LEN && INPUT_BUFFER > MAX_STREAM_FRAME);

/// The gateway engine for up to `PORTS` field ports, `UPLINKS` recipe links and, over all ports, `FIELDS` user-defined
/// input fields and as many output fields.
///
/// `TAP` is the size in bytes of the ring of [`Engine::tap`], and `EXCHANGES` the number of exchanges with devices over
/// all ports; 0 costs nothing. The defaults are the maximum of a configuration file.
///
/// `Engine<4, 1, 128, 0, 0>` takes less than 42 KiB.
// An engine is larger than the offset range of a load instruction, so what every call reads comes first, and what only
// some configurations have comes last.
#[derive(Debug, Clone)]
#[repr(C)]
pub struct Engine<
    const PORTS: usize = 8,
    const UPLINKS: usize = 4,
    const FIELDS: usize = 512,
    const TAP: usize = 0,
    const EXCHANGES: usize = MAX_EXCHANGES,
> {
    clock: Clock,
    host: String<MAX_HOST>,
    command: Maybe<CommandLink>,
    state: Maybe<StateLink>,
    modbus: Maybe<ModbusLink>,
    recipes: Vec<RecipeLink, UPLINKS>,
    /// Connections to devices; at most as many as recipe links.
    devices: Vec<DeviceLink, UPLINKS>,
    store: Store<Vec<EdgeQueue, PORTS>>,
    ports: Vec<FieldPort, PORTS>,
    inputs: Vec<InputBind, FIELDS>,
    outputs: Vec<OutputBind, FIELDS>,
    sendable: Vec<Sendable, MAX_SENDABLE>,
    safe_values: Vec<SafeBytes, MAX_SAFE_VALUES>,
    health: PortsHealth,
    exchanges: Vec<ExchangeItem, EXCHANGES>,
    rows: Vec<Row, EXCHANGES>,
    peers: Vec<PeerState, EXCHANGES>,
    written: [Piece; EXCHANGES],
    tap: Tap<[u8; TAP]>,
}

impl<const PORTS: usize, const UPLINKS: usize, const FIELDS: usize, const TAP: usize, const EXCHANGES: usize>
    Engine<PORTS, UPLINKS, FIELDS, TAP, EXCHANGES>
{
    /// Maximum number of links of this engine: port 2000 twice, port 2001, Modbus, and the recipe links.
    pub const MAX_LINKS: usize = UPLINKS.saturating_add(4);

    /// An engine without a configuration: no ports, no links, nothing to do.
    ///
    /// All its bytes are zero, so a `static` engine takes no flash and is not built on the stack.
    pub const fn idle() -> Self {
        Self {
            clock: Clock::START,
            host: String::new(),
            command: Vec::new(),
            state: Vec::new(),
            modbus: Vec::new(),
            recipes: Vec::new(),
            devices: Vec::new(),
            store: Store::new(Vec::new()),
            ports: Vec::new(),
            inputs: Vec::new(),
            outputs: Vec::new(),
            sendable: Vec::new(),
            safe_values: Vec::new(),
            health: PortsHealth::new(),
            exchanges: Vec::new(),
            rows: Vec::new(),
            peers: Vec::new(),
            written: [[0; _]; EXCHANGES],
            tap: Tap::new(),
        }
    }

    /// An engine that runs this configuration. All ports and links are down until the driver reports otherwise.
    ///
    /// # Errors
    /// [`BuildError`] says what is wrong with the configuration, or what it has too many of.
    pub fn new<'c>(config: impl Into<ConfigView<'c>>) -> Result<Self, BuildError> {
        let mut engine = Self::idle();
        engine.configure(config)?;
        Ok(engine)
    }

    /// Runs this configuration from now on instead of the previous one. The engine is built in place, for boards whose
    /// stack is smaller than a few engines.
    ///
    /// # Errors
    /// Same as [`Engine::new`]; the engine is idle then.
    pub fn configure<'c>(&mut self, config: impl Into<ConfigView<'c>>) -> Result<(), BuildError> {
        self.clear();
        let done = self.view().build(config.into());
        if done.is_err() {
            self.clear();
        }
        done
    }

    /// Removes the configuration. A listening tap keeps listening.
    fn clear(&mut self) {
        self.store = Store::new(Vec::new());
        self.view().clear();
    }

    fn view(&mut self) -> EngineView<'_> {
        EngineView {
            clock: &mut self.clock,
            links: Links {
                host: &mut self.host,
                command: &mut self.command,
                state: &mut self.state,
                modbus: &mut self.modbus,
                recipes: &mut self.recipes,
                devices: &mut self.devices,
            },
            store: &mut self.store,
            ports: &mut self.ports,
            bindings: Bindings {
                inputs: &mut self.inputs,
                outputs: &mut self.outputs,
                sendable: &mut self.sendable,
            },
            safe_values: &mut self.safe_values,
            health: &mut self.health,
            exchanges: Exchanges {
                items: &mut self.exchanges,
                rows: &mut self.rows,
                peers: &mut self.peers,
                written: &mut self.written,
            },
            tap: &mut self.tap,
        }
    }

    fn links_view(&self) -> LinksView<'_> {
        LinksView {
            host: &self.host,
            command: self.command.first(),
            state: self.state.first(),
            modbus: self.modbus.first(),
            recipes: &self.recipes,
            devices: &self.devices,
        }
    }

    /// Reports an event, or that time has passed. If `now` is earlier than in the previous call, that call's instant is
    /// used.
    ///
    /// Inputs for a port or link that the configuration does not have are ignored.
    ///
    /// [`Handled::Asleep`] spares a driver the call of [`Self::poll_output`]; it may be ignored.
    // A frame byte by byte to UDP takes 4923 instructions with this out of line, 4130 with it inline.
    #[inline(always)]
    pub fn handle(&mut self, now: Instant, input: Input<'_>) -> Handled {
        let handled = match input {
            _ if !self.clock.is_idle(now) => None,
            Input::PortBytes { port, bytes } => hold(&mut self.clock, &mut self.ports, port, bytes, now),
            _ => self.handle_fast(now, &input),
        };
        handled.unwrap_or_else(|| self.handle_full(now, &input))
    }

    // Out of line to keep the view off the stack of the fast path.
    #[inline(never)]
    fn handle_full(&mut self, now: Instant, input: &Input<'_>) -> Handled {
        self.view().handle(now, input)
    }

    /// The fast path for inputs other than port bytes that have no effect while the engine sleeps and no deadline has
    /// come: frames for other nodes (most of a busy CAN bus), pieces of a state packet, and finished transmissions with
    /// nothing else to send yet. `None` if the input has to be handled; nothing has changed then.
    // Saves 230 of 1360 instructions for a frame to UDP.
    #[inline(never)]
    fn handle_fast(&mut self, now: Instant, input: &Input<'_>) -> Option<Handled> {
        let mut handled = Handled::Asleep;
        match *input {
            Input::PortCan { port, ref frame } if !self.tap.is_listening() => {
                find_port(&mut self.ports, port)?.passes_by(frame, now).then_some(())?;
            }
            Input::LinkBytes { link: LinkId::STATE, bytes } if !self.tap.is_listening() => {
                self.state.first_mut()?.hold(bytes, now).then_some(())?;
            }
            // An engine without ports may have missed a heartbeat.
            Input::PortSent { .. } | Input::LinkSent { .. } if now >= self.clock.beat_at => return None,
            Input::PortSent { port } if self.exchanges.is_empty() => {
                find_port(&mut self.ports, port)?.sender.sent_before_next().then_some(())?;
            }
            Input::LinkSent { link } => {
                if !self.command.is_empty() {
                    return None;
                }
                let deadline = match link {
                    LinkId::STATE => None,
                    LinkId::MODBUS => self.modbus.first_mut()?.sent_before_answer(),
                    link => {
                        let link = self.recipes.iter_mut().find(|other| other.id == link)?;
                        link.sent_before_next(&self.store.outbox, self.clock.idle_until)
                    }
                };
                self.clock.arm(deadline?);
            }
            Input::Tick => {
                self.clock.announce_anew(!self.ports.is_empty());
                handled = Handled::Poll;
            }
            _ => return None,
        }
        self.clock.now = now;
        Some(handled)
    }

    /// The next output for the driver. Call it again until it is [`Output::Sleep`]. Nothing is sent between a deadline
    /// and the [`Input::Tick`] that lets it pass.
    ///
    /// Order: commands that stop the robot, field values for the controller, what keeps links up, frames to the field.
    pub fn poll_output<'b>(&mut self, now: Instant, buf: &'b mut [u8; OUTPUT_BUFFER]) -> Output<'b> {
        if now < self.clock.idle_until {
            debug_assert!(self.clock.is_quiet(now) && !self.clock.is_overdue);
            debug_assert!(self.view().all_are_silent(&mut buf[..], now), "a sleeping engine has an output");
            return Output::Sleep { until: self.clock.idle_until };
        }
        if self.clock.is_quiet(now) {
            return self.clock.sleep(!self.ports.is_empty());
        }
        self.poll_full(now, buf)
    }

    // Out of line for the same reason as `handle_full`.
    #[inline(never)]
    fn poll_full<'b>(&mut self, now: Instant, buf: &'b mut [u8; OUTPUT_BUFFER]) -> Output<'b> {
        self.view().poll_work(now, buf)
    }

    /// The exact time at which the engine has something to do without an input. [`Output::Sleep`] may be earlier, never
    /// later.
    pub fn deadline(&self) -> Instant {
        let has_exchanges = !self.exchanges.is_empty();
        let (firm, partial) =
            deadlines(&self.clock, &self.ports, self.links_view(), &self.store, has_exchanges);
        firm.min(partial)
    }

    /// The process image.
    pub fn image(&self) -> &Image {
        &self.store.image
    }

    /// Counters of a field port; `None` if no such port is configured.
    pub fn port_counters(&self, port: PortId) -> Option<&PortCounters> {
        self.ports.iter().find(|other| other.id == port).map(|port| &port.counters)
    }

    /// Health of a field port; `None` if no such port is configured.
    pub fn port_state(&self, port: PortId) -> Option<PortState> {
        let (index, port) = self.ports.iter().enumerate().find(|(_, other)| other.id == port)?;
        Some(state_of(index, port, &self.store.frames, &self.peers))
    }

    /// Result of the newest command that a port's values picked; `None` if no such port is configured.
    pub fn reply_code(&self, port: PortId) -> Option<ReplyCode> {
        self.ports.iter().find(|other| other.id == port).map(|port| port.reply)
    }

    /// The field ports, in configuration order.
    pub fn field_ports(&self) -> impl Iterator<Item = PortId> + '_ {
        self.ports.iter().map(|port| port.id)
    }

    /// The links that the configuration needs.
    pub fn links(&self) -> impl Iterator<Item = LinkInfo<'_>> + '_ {
        self.links_view().infos()
    }

    /// Whether a link is up; false if the configuration does not need it. See [`Self::links`] for more.
    pub fn is_up(&self, link: LinkId) -> bool {
        self.links_view().is_up(link)
    }

    /// Whether a datagram is a frame of the link's output part. The driver of a listening UDP link checks this before
    /// it replies to a new sender.
    pub fn is_frame(&self, link: LinkId, datagram: &[u8]) -> bool {
        self.recipes.iter().any(|other| other.id == link && other.is_frame(datagram))
    }

    /// How often the gateway itself slept: it was not called for longer than [`ASLEEP`], so waiting input was
    /// discarded. Wraps.
    pub fn sleeps(&self) -> u32 {
        self.clock.sleeps
    }

    /// Prepares to end the engine: at the next [`Input::Tick`] every input frame that is not overdue yet becomes so, as if
    /// all devices were silent. Waiting values are dropped and safe values are sent; a port that is never overdue keeps
    /// its values. The driver reports no more input from its ports, and ends the engine when [`Self::is_safe`] returns
    /// true or after some time.
    pub fn make_safe(&mut self) {
        self.view().make_safe();
    }

    /// Whether the controller is known to have every safe value that was sent to it. A value that nothing shows
    /// is never known to have arrived.
    pub fn is_safe(&self) -> bool {
        let store: &Store = &self.store;
        store.is_safe()
    }

    /// A snapshot of the whole gateway at `now`.
    pub fn status(&self, now: Instant) -> Status<'_> {
        Status {
            at: self.clock.forward(now),
            ports: &self.ports,
            frames: &self.store.frames,
            health: &self.health,
            image: &self.store.image,
            inputs: &self.inputs,
            bits: &self.store.bits,
            links: self.links_view(),
            latency: &self.store.latency,
            sleeps: self.clock.sleeps,
            peers: &self.peers,
        }
    }

    /// The latencies since the start.
    pub fn latency(&self) -> &Latency {
        &self.store.latency
    }

    /// The ring of records of everything that passes over ports and links.
    pub fn tap(&mut self) -> &mut Tap {
        &mut self.tap
    }
}
