//! The outboxes between the engine and the tasks of ports and links.

use core::cell::{Cell, RefCell};

use heapless::{Deque, Vec};
use proto_core::engine::OUTPUT_BUFFER;
use proto_core::recipe::model::MAX_CAN_IDS;
use proto_core::wire::can::CanFrame;
use proto_core::wire::can::CanId;

use super::notify::Notify;

/// One transmission: the longest frame or request.
pub(crate) type Transmission = Vec<u8, OUTPUT_BUFFER>;

/// Data that waits to be sent on a port: bytes on RS-485, frames on CAN.
enum PortOutbox {
    Empty,
    Bytes(Transmission),
    Frames(Deque<CanFrame, MAX_CAN_IDS>),
}

/// The engine's side of a field port.
pub(crate) struct PortControl {
    ids: Vec<CanId, MAX_CAN_IDS>,
    outbox: RefCell<PortOutbox>,
    has_slept: Cell<bool>,
    changed: Notify,
}

impl PortControl {
    pub(crate) const fn new() -> Self {
        Self {
            ids: Vec::new(),
            outbox: RefCell::new(PortOutbox::Empty),
            has_slept: Cell::new(false),
            changed: Notify::new(),
        }
    }

    /// Sets the CAN ids of the port before its task starts. A configuration cannot have more than fit.
    pub(crate) fn set_ids(&mut self, ids: impl Iterator<Item = CanId>) {
        for id in ids {
            let _ = self.ids.push(id);
        }
    }

    /// The ids that the recipe of a CAN port receives.
    pub(crate) fn ids(&self) -> &[CanId] {
        &self.ids
    }

    /// Takes one transmission from the engine, which waits until it has left.
    pub(crate) fn put(&self, bytes: &[u8]) {
        let bytes = Transmission::from_slice(bytes);
        *self.outbox.borrow_mut() = bytes.map_or(PortOutbox::Empty, PortOutbox::Bytes);
        self.changed.notify();
    }

    /// Queues a frame. The engine never has more frames waiting than fit.
    pub(crate) fn put_frame(&self, frame: CanFrame) {
        let mut outbox = self.outbox.borrow_mut();
        if !matches!(*outbox, PortOutbox::Frames(_)) {
            *outbox = PortOutbox::Frames(Deque::new());
        }
        if let PortOutbox::Frames(frames) = &mut *outbox {
            let _ = frames.push_back(frame);
        }
        self.changed.notify();
    }

    /// Wakes the task: its device may hold data whose interrupt is pending.
    pub(crate) fn wake(&self) {
        self.changed.notify();
    }

    pub(crate) fn slept(&self) {
        self.has_slept.set(true);
        self.wake();
    }

    /// Waits until the gateway has slept: data in the device then must be reported at once, while the engine
    /// discards it. Consumes notifications, so nothing else may wait for them.
    pub(crate) async fn wait_for_sleep(&self) {
        while !self.has_slept.take() {
            self.changed.notified().await;
        }
    }

    pub(crate) fn clear_sleep(&self) {
        self.has_slept.set(false);
    }

    /// Waits until there is a transmission.
    pub(crate) async fn bytes_wait(&self) {
        while !matches!(*self.outbox.borrow(), PortOutbox::Bytes(_)) {
            self.changed.notified().await;
        }
    }

    fn take_bytes(&self) -> Option<Transmission> {
        let mut outbox = self.outbox.borrow_mut();
        match core::mem::replace(&mut *outbox, PortOutbox::Empty) {
            PortOutbox::Bytes(bytes) => Some(bytes),
            other => {
                *outbox = other;
                None
            }
        }
    }

    /// The next transmission, if there is one and it may be sent now.
    pub(crate) fn take_bytes_if(&self, may_send: bool) -> Option<Transmission> {
        if may_send { self.take_bytes() } else { None }
    }

    pub(crate) async fn frame_waits(&self) {
        while !matches!(&*self.outbox.borrow(), PortOutbox::Frames(frames) if !frames.is_empty()) {
            self.changed.notified().await;
        }
    }

    pub(crate) fn next_frame(&self) -> Option<CanFrame> {
        match &mut *self.outbox.borrow_mut() {
            PortOutbox::Frames(frames) => frames.pop_front(),
            PortOutbox::Empty | PortOutbox::Bytes(_) => None,
        }
    }

    /// Drops all data to send: the device is gone.
    pub(crate) fn clear(&self) {
        *self.outbox.borrow_mut() = PortOutbox::Empty;
    }
}

/// The engine's side of a link. The time from an opening of the link to its closing is a *turn*. Events of an earlier
/// turn are not reported, and its data is not sent.
pub(crate) struct LinkControl {
    /// Number of the turn. Each opening and each closing increments it, so it is odd while the link is to be open.
    turn: Cell<u32>,
    outbox: RefCell<Option<Transmission>>,
    /// Bytes of the transmission in the outbox that the socket has accepted.
    sent: Cell<usize>,
    /// Unacknowledged bytes of this turn, as last reported to the engine.
    unacknowledged: Cell<u32>,
    changed: Notify,
    refused_peers: Cell<u32>,
}

impl LinkControl {
    pub(crate) const fn new() -> Self {
        Self {
            turn: Cell::new(0),
            outbox: RefCell::new(None),
            sent: Cell::new(0),
            unacknowledged: Cell::new(0),
            changed: Notify::new(),
            refused_peers: Cell::new(0),
        }
    }

    /// Counts a connection or datagram of another host than the controller.
    pub(crate) fn count_refused_peer(&self) {
        self.refused_peers.set(self.refused_peers.get().saturating_add(1));
    }

    /// Refused connections and datagrams since the start.
    pub(crate) fn refused_peers(&self) -> u32 {
        self.refused_peers.get()
    }

    pub(crate) fn is_turn(&self, turn: u32) -> bool {
        self.turn.get() == turn
    }

    pub(crate) fn open(&self) {
        if self.turn.get().is_multiple_of(2) {
            self.turn_over();
        }
    }

    pub(crate) fn close(&self) {
        if !self.turn.get().is_multiple_of(2) {
            self.turn_over();
        }
    }

    /// Takes one transmission from the engine, which waits until the socket has accepted it.
    pub(crate) fn put(&self, bytes: &[u8]) {
        self.unacknowledged.set(self.unacknowledged.get().saturating_add(bytes.len() as u32));
        *self.outbox.borrow_mut() = Transmission::from_slice(bytes).ok();
        self.sent.set(0);
        self.changed.notify();
    }

    fn turn_over(&self) {
        self.turn.set(self.turn.get().wrapping_add(1));
        self.unacknowledged.set(0);
        *self.outbox.borrow_mut() = None;
        self.changed.notify();
    }

    /// Number of bytes of this turn that the engine considers unacknowledged.
    pub(crate) fn unacknowledged(&self) -> u32 {
        self.unacknowledged.get()
    }

    /// Updates the number of unacknowledged bytes, and returns it for the engine if it has changed. `left` is the
    /// number of bytes that the socket has accepted and the peer has not acknowledged.
    pub(crate) fn acknowledged(&self, left: usize) -> Option<u32> {
        let waiting = self.rest(<[u8]>::len).unwrap_or(0);
        let left = left.saturating_add(waiting) as u32;
        (self.unacknowledged.replace(left) != left).then_some(left)
    }

    /// Waits until the link is to be open; returns the turn.
    pub(crate) async fn opened(&self) -> u32 {
        loop {
            let turn = self.turn.get();
            if !turn.is_multiple_of(2) {
                return turn;
            }
            self.changed.notified().await;
        }
    }

    /// Waits until this turn is over. Consumes notifications, so nothing else may wait for them.
    pub(crate) async fn over(&self, turn: u32) {
        while self.is_turn(turn) {
            self.changed.notified().await;
        }
    }

    /// Waits for the next transmission, which stays in the outbox while it is sent; false when this turn is over.
    pub(crate) async fn next(&self, turn: u32) -> bool {
        loop {
            if !self.is_turn(turn) {
                return false;
            }
            if self.outbox.borrow().is_some() {
                return true;
            }
            self.changed.notified().await;
        }
    }

    /// Passes what is left of the transmission to `look`; `None` if there is none.
    pub(crate) fn rest<R>(&self, look: impl FnOnce(&[u8]) -> R) -> Option<R> {
        let outbox = self.outbox.borrow();
        Some(look(outbox.as_ref()?.get(self.sent.get()..).unwrap_or(&[])))
    }

    /// Notes that the socket has accepted `count` more bytes of the transmission; returns whether these were the last.
    pub(crate) fn accepted(&self, count: usize) -> bool {
        self.sent.set(self.sent.get().saturating_add(count));
        let is_all = self.rest(<[u8]>::is_empty).unwrap_or(true);
        if is_all {
            self.taken();
        }
        is_all
    }

    /// Frees the outbox after the transmission was accepted by the socket or dropped.
    pub(crate) fn taken(&self) {
        *self.outbox.borrow_mut() = None;
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
        // The socket accepts a part of the transmission, of which the peer acknowledges some, then the rest.
        assert!(!link.accepted(34));
        assert_eq!((link.acknowledged(34), link.acknowledged(0)), (None, Some(35)));
        assert!(link.accepted(35));
        assert_eq!(link.acknowledged(35), None);
        link.put(&[0; 100]);
        assert_eq!((link.unacknowledged(), link.acknowledged(0)), (135, Some(100)));
        assert!(link.accepted(100));
        assert_eq!((link.acknowledged(0), link.acknowledged(0)), (Some(0), None));
    }

    #[test]
    fn what_an_earlier_turn_has_left_is_nobodys() {
        let link = LinkControl::new();
        link.open();
        link.put(&[0; 69]);
        assert!(!link.accepted(34));
        link.close();
        link.open();
        assert_eq!((link.unacknowledged(), link.acknowledged(0), link.rest(<[u8]>::len)), (0, None, None));
        link.put(&[0; 3]);
        assert_eq!(link.rest(<[u8]>::len), Some(3));
    }
}
