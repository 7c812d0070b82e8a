//! The engine among its tasks.
//!
//! What a driver brings goes into the engine at once, and what the engine answers is handed over
//! before anything else is read: one engine pass lies between the last byte of a field frame and the
//! request on its way to the controller. All tasks run on one executor, so nobody is in the engine
//! twice. What is handed over lies in one outbox for each port and link; a task takes it from there.

use core::cell::{Cell, RefCell};
use core::pin::pin;

use embassy_futures::select::{Either, select};
use embassy_futures::yield_now;
use embassy_time::Timer;
use heapless::{Deque, Vec};
use proto_core::config::{GatewayConfig, Parts};
use proto_core::engine::{
    BuildError, Engine as AnyEngine, Input, LinkId, LinkInfo, LinkKind, OUTPUT_BUFFER, Output, PortCounters,
    PortId, PortState,
};
use proto_core::link::LinkState;
use proto_core::recipe::model::MAX_CAN_IDS;
use proto_core::time::Instant;
use proto_core::wire::can::{CanFrame, CanId};

use crate::led::Condition;
use crate::notify::Notify;
use crate::watchdog::Pulse;

/// Field ports a board can have.
pub const MAX_FIELD_PORTS: usize = 4;
/// Recipe links a board can have.
pub const MAX_UPLINKS: usize = 2;
/// User-defined fields in one direction, over all ports.
pub const MAX_FIELDS: usize = 128;
/// Recipe links, and command, urgent commands, state and Modbus.
pub const MAX_LINKS: usize = Engine::MAX_LINKS;

/// The engine in the size of a board.
pub type Engine = AnyEngine<MAX_FIELD_PORTS, MAX_UPLINKS, MAX_FIELDS>;

/// The engine and what every task shares with it.
pub struct Gateway {
    engine: RefCell<Engine>,
    ports: Vec<(PortId, PortControl), MAX_FIELD_PORTS>,
    links: Vec<(LinkId, LinkKind, LinkControl), MAX_LINKS>,
    output: RefCell<[u8; OUTPUT_BUFFER]>,
    deadline: Cell<Instant>,
    deadline_moved: Notify,
    /// Some task gave the processor back before it had told all that waits.
    more_waits: Cell<bool>,
    /// As often the gateway slept, as the ports' tasks know.
    sleeps: Cell<u32>,
}

impl Gateway {
    /// A gateway without a configuration.
    pub const fn idle() -> Self {
        Self {
            engine: RefCell::new(Engine::idle()),
            ports: Vec::new(),
            links: Vec::new(),
            output: RefCell::new([0; OUTPUT_BUFFER]),
            deadline: Cell::new(Instant::ZERO),
            deadline_moved: Notify::new(),
            more_waits: Cell::new(false),
            sleeps: Cell::new(0),
        }
    }

    /// Takes its configuration, in place; ports and links are down.
    ///
    /// # Errors
    /// What the engine cannot run.
    pub fn configure(&mut self, config: &GatewayConfig) -> Result<(), BuildError> {
        // Not so in `idle`, which is all zeros and takes no flash.
        self.deadline.set(Instant::NEVER);
        let engine = self.engine.get_mut();
        engine.configure(config)?;
        // As many places as the engine has.
        self.ports.clear();
        self.ports.extend(engine.field_ports().map(|id| (id, PortControl::new())));
        for ((_, control), (.., recipe)) in self.ports.iter_mut().zip(config.field_ports()) {
            if let Parts::Can { input, .. } = &recipe.parts {
                control.ids.extend(input.iter().map(|frame| frame.id));
            }
        }
        self.links.clear();
        self.links.extend(engine.links().map(|link| (link.id, link.kind, LinkControl::new())));
        Ok(())
    }

    /// The links that need a task.
    pub fn links(&self) -> impl Iterator<Item = (LinkId, LinkKind)> + '_ {
        self.links.iter().map(|(id, kind, _)| (*id, *kind))
    }

    /// Shows how each link and each port does.
    pub fn report(&self, mut link: impl FnMut(LinkInfo<'_>), mut port: impl FnMut(PortId, &PortCounters)) {
        let engine = self.engine.borrow();
        engine.links().for_each(&mut link);
        for id in engine.field_ports() {
            if let Some(counters) = engine.port_counters(id) {
                port(id, counters);
            }
        }
    }

    /// What the status LED shows.
    pub fn condition(&self) -> Condition {
        let engine = self.engine.borrow();
        if self.ports.is_empty() && self.links.is_empty() {
            return Condition::Refused;
        }
        // The work of a link that is shared is done by another.
        let is_up = |link: LinkInfo<'_>| matches!(link.state, LinkState::Up { .. } | LinkState::Shared);
        let works = |id| engine.port_state(id) == Some(PortState::Working);
        if !engine.links().all(is_up) {
            Condition::NoController
        } else if !engine.field_ports().all(works) {
            Condition::PortSilent
        } else {
            Condition::Running
        }
    }

    /// How often the processor was stopped: what waited meanwhile was discarded.
    pub fn sleeps(&self) -> u32 {
        self.sleeps.get()
    }

    /// How many connections and datagrams of others than the controller each link has turned away.
    pub fn strangers(&self) -> impl Iterator<Item = (LinkKind, u32)> + '_ {
        self.links.iter().map(|(_, kind, control)| (*kind, control.strangers.get()))
    }

    /// One input, now, and everything that follows from it.
    pub fn input(&self, input: Input<'_>) {
        let now = now();
        let mut engine = self.engine.borrow_mut();
        let mut buf = self.output.borrow_mut();
        engine.handle(now, input);
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

    /// Lets deadlines pass whenever the engine asked for it. The engine's own task.
    pub async fn keep_time(&self, pulse: &Pulse) -> ! {
        self.input(Input::Tick);
        loop {
            let until = embassy_time::Instant::from_micros(self.deadline.get().as_micros());
            match pulse.idle(pin!(select(Timer::at(until), self.deadline_moved.notified()))).await {
                Either::First(()) => {
                    self.all_told().await;
                    self.input(Input::Tick);
                }
                Either::Second(()) => {}
            }
        }
    }

    /// Waits until the engine has heard of all that arrived before this moment: it was not late,
    /// whatever kept the processor meanwhile. Who always has more is not waited for without an end.
    ///
    /// In a round of the executor each task that was woken runs once, in no particular order. What the
    /// Ethernet controller has goes to the network's task in one round and to a link's in the next.
    async fn all_told(&self) {
        // A device may have what it has woken nobody for.
        self.ports.iter().for_each(|(_, control)| control.changed.notify());
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

    /// A task gives the processor back and may have left something that waits to be told.
    pub(crate) fn more_waits(&self) {
        self.more_waits.set(true);
    }

    /// Whether a datagram is a frame of the link's.
    pub(crate) fn is_frame(&self, link: LinkId, datagram: &[u8]) -> bool {
        self.engine.borrow().is_frame(link, datagram)
    }

    pub(crate) fn port(&self, id: PortId) -> Option<&PortControl> {
        self.ports.iter().find(|(port, _)| *port == id).map(|(_, control)| control)
    }

    pub(crate) fn link(&self, id: LinkId) -> Option<&LinkControl> {
        self.links.iter().find(|(link, ..)| *link == id).map(|(.., control)| control)
    }
}

/// The engine's clock.
pub(crate) fn now() -> Instant {
    Instant::from_micros(embassy_time::Instant::now().as_micros())
}

/// One for a task whose interrupt comes while the time is looked at, one for that of the network, and one
/// for a link's behind it.
const QUIET_ROUNDS: u8 = 3;
/// What a port's task tells in as many is more than any device keeps.
const MAX_ROUNDS: u8 = 20;

/// One transmission: the longest frame or request.
pub(crate) type Transmission = Vec<u8, OUTPUT_BUFFER>;

/// The engine's side of a field port.
pub(crate) struct PortControl {
    ids: Vec<CanId, MAX_CAN_IDS>,
    bytes: RefCell<Option<Transmission>>,
    frames: RefCell<Deque<CanFrame, MAX_CAN_IDS>>,
    has_slept: Cell<bool>,
    changed: Notify,
}

impl PortControl {
    const fn new() -> Self {
        Self {
            ids: Vec::new(),
            bytes: RefCell::new(None),
            frames: RefCell::new(Deque::new()),
            has_slept: Cell::new(false),
            changed: Notify::new(),
        }
    }

    /// Of a CAN port: the ids whose frames its recipe takes.
    pub(crate) fn ids(&self) -> &[CanId] {
        &self.ids
    }

    /// The engine hands over one transmission and waits until it has left.
    fn put(&self, bytes: &[u8]) {
        *self.bytes.borrow_mut() = Transmission::from_slice(bytes).ok();
        self.changed.notify();
    }

    /// The engine hands over at most as many frames as there is room for.
    fn put_frame(&self, frame: CanFrame) {
        let _ = self.frames.borrow_mut().push_back(frame);
        self.changed.notify();
    }

    fn slept(&self) {
        self.has_slept.set(true);
        self.changed.notify();
    }

    /// Waits until the gateway has slept: what waits in the device has to be told at once, as long as
    /// the engine discards it. Eats notifications, so nothing else may wait for them.
    pub(crate) async fn has_slept(&self) {
        while !self.has_slept.take() {
            self.changed.notified().await;
        }
    }

    /// From here on only a sleep to come counts.
    pub(crate) fn forget_sleep(&self) {
        self.has_slept.set(false);
    }

    /// The next transmission.
    pub(crate) async fn next_bytes(&self) -> Transmission {
        loop {
            if let Some(bytes) = self.take_bytes() {
                return bytes;
            }
            self.changed.notified().await;
        }
    }

    fn take_bytes(&self) -> Option<Transmission> {
        self.bytes.borrow_mut().take()
    }

    /// The next transmission, if there is one and it may be sent now.
    pub(crate) fn take_bytes_if(&self, may_send: bool) -> Option<Transmission> {
        if may_send { self.take_bytes() } else { None }
    }

    /// Waits until there is a frame to send.
    pub(crate) async fn frame_waits(&self) {
        while self.frames.borrow().is_empty() {
            self.changed.notified().await;
        }
    }

    /// The next frame to send, if there is one.
    pub(crate) fn next_frame(&self) -> Option<CanFrame> {
        self.frames.borrow_mut().pop_front()
    }

    /// Forgets what waits: the device is gone.
    pub(crate) fn clear(&self) {
        self.frames.borrow_mut().clear();
        *self.bytes.borrow_mut() = None;
    }
}

/// The engine's side of a link. A link is open for a *turn*: what belongs to an earlier turn is not
/// reported and not sent.
pub(crate) struct LinkControl {
    /// Odd while the link is to be open; one more for each opening and closing.
    turn: Cell<u32>,
    outbox: RefCell<Option<Transmission>>,
    /// Bytes of this turn that are not acknowledged, as the engine knows.
    unacknowledged: Cell<u32>,
    changed: Notify,
    strangers: Cell<u32>,
}

impl LinkControl {
    const fn new() -> Self {
        Self {
            turn: Cell::new(0),
            outbox: RefCell::new(None),
            unacknowledged: Cell::new(0),
            changed: Notify::new(),
            strangers: Cell::new(0),
        }
    }

    /// Somebody else than the controller came to where the controller is awaited.
    pub(crate) fn turn_away(&self) {
        self.strangers.set(self.strangers.get().saturating_add(1));
    }

    pub(crate) fn is_turn(&self, turn: u32) -> bool {
        self.turn.get() == turn
    }

    fn open(&self) {
        if self.turn.get().is_multiple_of(2) {
            self.turn_over();
        }
    }

    pub(crate) fn close(&self) {
        if !self.turn.get().is_multiple_of(2) {
            self.turn_over();
        }
    }

    /// The engine hands over one transmission and waits until it was taken.
    fn put(&self, bytes: &[u8]) {
        self.unacknowledged.set(self.unacknowledged.get().saturating_add(bytes.len() as u32));
        *self.outbox.borrow_mut() = Transmission::from_slice(bytes).ok();
        self.changed.notify();
    }

    fn turn_over(&self) {
        self.turn.set(self.turn.get().wrapping_add(1));
        self.unacknowledged.set(0);
        *self.outbox.borrow_mut() = None;
        self.changed.notify();
    }

    /// Of what was handed over in this turn, as much as the engine believes to be unacknowledged.
    pub(crate) fn unacknowledged(&self) -> u32 {
        self.unacknowledged.get()
    }

    /// The task has left `left` bytes beside what waits here. The number for the engine, if it is news.
    pub(crate) fn acknowledged(&self, left: usize) -> Option<u32> {
        let waiting = self.outbox.borrow().as_ref().map_or(0, |bytes| bytes.len());
        let left = left.saturating_add(waiting) as u32;
        (self.unacknowledged.replace(left) != left).then_some(left)
    }

    /// Waits until the link is to be open; the turn it is.
    pub(crate) async fn opened(&self) -> u32 {
        loop {
            let turn = self.turn.get();
            if !turn.is_multiple_of(2) {
                return turn;
            }
            self.changed.notified().await;
        }
    }

    /// Waits until this turn is over. Eats notifications, so nothing else may wait for them.
    pub(crate) async fn over(&self, turn: u32) {
        while self.is_turn(turn) {
            self.changed.notified().await;
        }
    }

    /// The next transmission; `None` when this turn is over.
    pub(crate) async fn next(&self, turn: u32) -> Option<Transmission> {
        loop {
            if !self.is_turn(turn) {
                return None;
            }
            if let Some(bytes) = self.outbox.borrow_mut().take() {
                return Some(bytes);
            }
            self.changed.notified().await;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_nobody_has_taken_yet_is_not_acknowledged() {
        let link = LinkControl::new();
        link.open();
        link.put(&[0; 69]);
        assert_eq!((link.unacknowledged(), link.acknowledged(0)), (69, None));
        // The task takes it, and has room for half.
        assert!(link.outbox.take().is_some());
        assert_eq!((link.acknowledged(69), link.acknowledged(35)), (None, Some(35)));
        link.put(&[0; 100]);
        assert_eq!((link.unacknowledged(), link.acknowledged(0)), (135, Some(100)));
        assert!(link.outbox.take().is_some());
        assert_eq!((link.acknowledged(0), link.acknowledged(0)), (Some(0), None));
    }

    #[test]
    fn what_an_earlier_turn_has_left_is_nobodys() {
        let link = LinkControl::new();
        link.open();
        link.put(&[0; 69]);
        link.close();
        link.open();
        assert_eq!((link.unacknowledged(), link.acknowledged(0)), (0, None));
    }
}
