//! A board of variables: an RS-485 line with its device, a TCP connection with the controller at its other
//! end, and a clock that jumps to what happens next. A real one has interrupts and rings in these places.

use heapless::Deque;
use proto_core::engine::LinkId;
use proto_core::time::{Duration, Instant};

use crate::controller::Controller;
use crate::events::{BoardEvent, InterruptSource, SOURCES};
use crate::machine::say;

/// What the device sends, and when, in microseconds: a frame in two pieces, another one, nothing more.
const DEVICE: [(u64, &[u8]); 3] =
    [(12_000, &[0xFF, 0xFF, 0x01, 0xEE]), (12_100, &[0xEE]), (22_000, &[0xFF, 0xFF, 0x03, 0xEE, 0xEE])];

pub(crate) struct ModelBoard {
    now: Instant,
    /// What each source will have, and when.
    queues: [Deque<(Instant, BoardEvent), 8>; SOURCES.len()],
    controller: Controller,
}

impl ModelBoard {
    pub(crate) fn new() -> Self {
        let queues = SOURCES.map(|_| Deque::new());
        let mut board = Self { now: Instant::ZERO, queues, controller: Controller::new() };
        for (at, bytes) in DEVICE {
            board.later(InterruptSource::LineReceived, at, BoardEvent::LineReceived(bytes));
        }
        board
    }

    pub(crate) fn now(&self) -> Instant {
        self.now
    }

    /// What a source has by now; never waits.
    pub(crate) fn receive(&mut self, source: InterruptSource) -> Option<BoardEvent> {
        let queue = &mut self.queues[source as usize];
        queue.front().filter(|(at, _)| *at <= self.now)?;
        queue.pop_front().map(|(_, event)| event)
    }

    /// Until something happens, or the engine's deadline: WFI on a real board.
    pub(crate) fn sleep(&mut self, until: Instant) {
        let waiting = self.queues.iter().filter_map(Deque::front);
        let next = waiting.fold(until, |next, (at, _)| next.min(*at));
        self.now = self.now.max(next);
    }

    pub(crate) fn port_send(&mut self, bytes: &[u8]) {
        say!("{:>6} us  to the device   {bytes:02X?}", self.now.as_micros());
        // 10 bits a byte at 115200 baud.
        self.later(InterruptSource::LineSent, 87 * bytes.len() as u64, BoardEvent::LineSent);
    }

    pub(crate) fn link_open(&mut self, link: LinkId) {
        self.later(InterruptSource::Socket, 300, BoardEvent::LinkUp(link));
    }

    /// A reset: nothing more is heard of the connection.
    pub(crate) fn link_close(&mut self) {
        self.queues[InterruptSource::Socket as usize].clear();
    }

    pub(crate) fn link_send(&mut self, link: LinkId, request: &[u8]) {
        say!("{:>6} us  by Modbus       {request:02X?}", self.now.as_micros());
        self.later(InterruptSource::Socket, 20, BoardEvent::LinkSent(link));
        self.later(InterruptSource::Socket, 300, BoardEvent::LinkAcked(link));
        if let Some(answer) = self.controller.answer(request) {
            self.later(InterruptSource::Socket, 400, BoardEvent::LinkReceived(link, answer));
        }
    }

    fn later(&mut self, source: InterruptSource, micros: u64, event: BoardEvent) {
        let at = self.now + Duration::from_micros(micros);
        let _ = self.queues[source as usize].push_back((at, event));
    }
}
