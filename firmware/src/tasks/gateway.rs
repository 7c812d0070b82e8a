//! The engine, shared by the tasks.
//!
//! A driver's input is handled at once, and the engine's outputs are executed before anything else is read:
//! there is one engine pass between the last byte of a field frame and the request to the controller. All tasks
//! run on one executor, so the engine is never entered twice. Each port and link has one outbox, from which its
//! task takes data.

use core::cell::{Cell, RefCell};
use core::pin::pin;

use embassy_futures::select::{Either, select};
use embassy_futures::yield_now;
use embassy_time::{Duration, Timer, with_timeout};
use heapless::Vec;
use proto_core::config::GatewayConfig;
use proto_core::engine::{
    BuildError, Engine, Handled, Health, INPUT_BUFFER, Input, LinkId, LinkKind, OUTPUT_BUFFER, Output,
    PortId, Status, Tap,
};
use proto_core::sysvar::Direction;
use proto_core::time::Instant;

use super::control::{LinkControl, PortControl};
use super::led::Condition;
use super::notify::Notify;
use super::watchdog::Pulse;
use crate::clock::now;

/// Number of field ports that a board can have.
pub const MAX_FIELD_PORTS: usize = 4;
/// Number of recipe links that a board can have.
pub const MAX_UPLINKS: usize = 2;
/// User-defined fields in one direction, over all ports.
pub const MAX_FIELDS: usize = 128;
/// Exchanges with devices, over all ports.
pub const MAX_EXCHANGES: usize = 32;
/// Capacity of the frame tap in bytes: 25 ms of 960 sensor frames and 500 CAN frames a second.
pub const MAX_TAP: usize = 4096;
/// Recipe links, and command, urgent commands, state and Modbus.
pub const MAX_LINKS: usize = SizedEngine::MAX_LINKS;

/// The engine with the capacities of a board.
pub type SizedEngine = Engine<MAX_FIELD_PORTS, MAX_UPLINKS, MAX_FIELDS, MAX_TAP, MAX_EXCHANGES>;

/// The engine and what every task shares with it.
pub struct Gateway {
    engine: RefCell<SizedEngine>,
    ports: Vec<(PortId, PortControl), MAX_FIELD_PORTS>,
    links: Vec<(LinkId, LinkKind, LinkControl), MAX_LINKS>,
    output: RefCell<[u8; OUTPUT_BUFFER]>,
    /// Data that a link's task has just received. One buffer for all links suffices, because data is reported before
    /// another task runs.
    received: RefCell<[u8; INPUT_BUFFER]>,
    deadline: Cell<Instant>,
    deadline_moved: Notify,
    /// A task has yielded before it reported all pending input.
    more_waits: Cell<bool>,
    /// Number of sleeps of which the ports' tasks were notified.
    sleeps: Cell<u32>,
    /// The safe values are being sent; from then on input from field ports is ignored.
    is_ending: Cell<bool>,
}

impl Gateway {
    /// A gateway without a configuration.
    pub const fn idle() -> Self {
        Self {
            engine: RefCell::new(SizedEngine::idle()),
            ports: Vec::new(),
            links: Vec::new(),
            output: RefCell::new([0; OUTPUT_BUFFER]),
            received: RefCell::new([0; INPUT_BUFFER]),
            deadline: Cell::new(Instant::ZERO),
            deadline_moved: Notify::new(),
            more_waits: Cell::new(false),
            sleeps: Cell::new(0),
            is_ending: Cell::new(false),
        }
    }

    /// Applies the configuration; ports and links are down.
    pub fn configure(&mut self, config: &GatewayConfig) -> Result<(), BuildError> {
        // Set here and not in `idle`, whose value must be all zeros (.bss).
        self.deadline.set(Instant::NEVER);
        let engine = self.engine.get_mut();
        engine.configure(config)?;
        // Everything fits: the vectors have the same capacity as those of the engine.
        self.ports.clear();
        self.ports.extend(engine.field_ports().map(|id| (id, PortControl::new())));
        for ((_, control), (.., recipe)) in self.ports.iter_mut().zip(config.view().field_ports()) {
            control.set_ids(config.view().can_ids(recipe, Direction::Input));
        }
        self.links.clear();
        self.links.extend(engine.links().map(|link| (link.id, link.kind, LinkControl::new())));
        Ok(())
    }

    /// The links that need a task.
    pub fn links(&self) -> impl Iterator<Item = (LinkId, LinkKind)> + '_ {
        self.links.iter().map(|(id, kind, _)| (*id, *kind))
    }

    /// Passes the engine's status to `look`.
    pub fn report<R>(&self, look: impl FnOnce(Status<'_>) -> R) -> R {
        look(self.engine.borrow().status(now()))
    }

    /// The condition for the status LED.
    pub fn condition(&self) -> Condition {
        match self.report(|status| status.health()) {
            Health::Idle => Condition::Refused,
            Health::NoController => Condition::NoController,
            Health::PortSilent => Condition::PortSilent,
            _ => Condition::Running,
        }
    }

    /// Passes the frame tap to `look`.
    pub fn tap<R>(&self, look: impl FnOnce(&mut Tap) -> R) -> R {
        look(self.engine.borrow_mut().tap())
    }

    /// Sends the safe values as if all devices had fallen silent, and waits until the controller shows them, at most
    /// for `limit`. The gateway must be stopped afterwards. Returns whether the controller shows them.
    pub async fn make_safe(&self, limit: Duration) -> bool {
        self.is_ending.set(true);
        self.engine.borrow_mut().make_safe();
        self.input(Input::Tick);
        let is_safe = async {
            while !self.engine.borrow().is_safe() {
                Timer::after(SAFE_CHECK).await;
            }
        };
        with_timeout(limit, is_safe).await.is_ok()
    }

    /// Number of sleeps of the gateway, each of which discards pending input.
    pub fn sleeps(&self) -> u32 {
        self.sleeps.get()
    }

    /// Number of connections and datagrams of other hosts that each link has refused.
    pub fn refused_peers(&self) -> impl Iterator<Item = (LinkKind, u32)> + '_ {
        self.links.iter().map(|(_, kind, control)| (*kind, control.refused_peers()))
    }

    /// Handles one input at the present time, and all outputs that follow.
    pub fn input(&self, input: Input<'_>) {
        let is_of_field = matches!(
            input,
            Input::PortBytes { .. }
                | Input::PortCan { .. }
                | Input::PortUp { .. }
                | Input::PortDown { .. }
                | Input::PortBus { .. }
        );
        if is_of_field && self.is_ending.get() {
            return;
        }
        let now = now();
        let mut engine = self.engine.borrow_mut();
        let mut buf = self.output.borrow_mut();
        if engine.handle(now, input) == Handled::Asleep {
            return;
        }
        if self.sleeps.replace(engine.sleeps()) != engine.sleeps() {
            self.ports.iter().for_each(|(_, control)| control.slept());
        }
        loop {
            match engine.poll_output(now, &mut buf) {
                Output::PortSend { port, bytes } => {
                    if let Some(port) = self.port(port) {
                        port.put(bytes);
                    }
                }
                Output::PortSendCan { port, frame } => {
                    if let Some(port) = self.port(port) {
                        port.put_frame(frame);
                    }
                }
                Output::LinkOpen { link, .. } => {
                    if let Some(link) = self.link(link) {
                        link.open();
                    }
                }
                Output::LinkClose { link } => {
                    if let Some(link) = self.link(link) {
                        link.close();
                    }
                }
                Output::LinkSend { link, bytes } => {
                    if let Some(link) = self.link(link) {
                        link.put(bytes);
                    }
                }
                Output::Sleep { until } => {
                    if self.deadline.replace(until) != until {
                        self.deadline_moved.notify();
                    }
                    return;
                }
                _ => {}
            }
        }
    }

    /// The engine's own task: calls it at its deadlines.
    pub async fn keep_time(&self, pulse: &Pulse) -> ! {
        self.input(Input::Tick);
        loop {
            let until = embassy_time::Instant::from_micros(self.deadline.get().as_micros());
            match pulse.idle(pin!(select(Timer::at(until), self.deadline_moved.notified()))).await {
                Either::First(()) => {
                    self.drain_inputs().await;
                    self.input(Input::Tick);
                }
                Either::Second(()) => {}
            }
        }
    }

    /// Waits until all input that arrived before now has been reported. Otherwise it would count as late only because
    /// the processor was busy. The wait is bounded, because a task may always have more input.
    ///
    /// In a round of the executor each woken task runs once, in no particular order. Data in the Ethernet controller
    /// reaches the network's task in one round and a link's task in the next.
    async fn drain_inputs(&self) {
        // A device may hold data whose interrupt is pending.
        self.ports.iter().for_each(|(_, control)| control.wake());
        let mut quiet = 0_u8;
        for _ in 0..MAX_ROUNDS {
            self.more_waits.set(false);
            yield_now().await;
            quiet = if self.more_waits.get() { 0 } else { quiet.saturating_add(1) };
            if quiet >= QUIET_ROUNDS {
                return;
            }
        }
    }

    /// Notes that a task yields although it may have unreported input.
    pub(crate) fn more_waits(&self) {
        self.more_waits.set(true);
    }

    /// Whether a datagram is a frame of the link.
    pub(crate) fn is_frame(&self, link: LinkId, datagram: &[u8]) -> bool {
        self.engine.borrow().is_frame(link, datagram)
    }

    /// The buffer for what a link receives. It is free again at each await.
    pub(crate) fn received(&self) -> &RefCell<[u8; INPUT_BUFFER]> {
        &self.received
    }

    pub(crate) fn port(&self, id: PortId) -> Option<&PortControl> {
        self.ports.iter().find(|(port, _)| *port == id).map(|(_, control)| control)
    }

    pub(crate) fn link(&self, id: LinkId) -> Option<&LinkControl> {
        self.links.iter().find(|(link, ..)| *link == id).map(|(.., control)| control)
    }
}

/// Polling interval for the safe values.
const SAFE_CHECK: Duration = Duration::from_millis(5);
/// Number of rounds without input after which all input has been reported: one for a task whose interrupt occurs while
/// the time is read, one for the network's task, and one for a link's task after it.
const QUIET_ROUNDS: u8 = 3;
/// Limit of rounds. In this many rounds a port's task reports more than any device can buffer.
const MAX_ROUNDS: u8 = 20;
