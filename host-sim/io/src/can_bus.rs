//! A CAN bus in user space (proto-core/docs/wire/slcan.md section 4), with one port and any number of slcan clients.

mod clients;

use std::cell::{Cell, RefCell};
use std::collections::VecDeque;
use std::future::pending;
use std::io;
use std::rc::Rc;

use proto_core::time::Instant;
use proto_core::wire::can::CanFrame;
use tokio::net::{TcpListener, TcpStream};
use tokio::sync::Notify;

use super::bind::{Device, Pace};
use super::exchange::{Backlog, PortEvent, PortTx};
use super::pty::{HandoverPty, Pty};
use super::stream;
use super::wire::{Full, NodeId, Pacing, Transmitted, Wire};
use crate::clock::Clock;
use crate::timer::now;
pub(crate) use clients::{Clients, SlcanClient, SlcanSession};
use clients::{serve, serve_all};

/// A bus. Clones share it.
#[derive(Debug, Clone)]
pub(crate) struct CanBus {
    shared: Rc<BusState>,
}

#[derive(Debug)]
struct BusState {
    wire: RefCell<Wire>,
    nodes: RefCell<Vec<Rc<NodeState>>>,
    deadline_moved: Notify,
    clock: Clock,
    /// Counts dropped frames.
    tx: Rc<PortTx>,
}

#[derive(Debug)]
struct NodeState {
    id: NodeId,
    /// Received frames, each with the time of its end.
    queue: RefCell<VecDeque<(Instant, CanFrame)>>,
    wake: Notify,
    is_receiving: Cell<bool>,
    dropped: Cell<u64>,
    sent: Cell<SentFrames>,
    sent_wake: Notify,
}

/// Transmissions of a node since the last report.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub(crate) struct SentFrames {
    pub(crate) frames: u64,
    /// Data bytes of the frames.
    pub(crate) bytes: u64,
}

impl CanBus {
    /// A bus without nodes. Frames that nodes drop are counted at `tx`; transmissions take their time on `clock`.
    pub(crate) fn new(pacing: Pacing, tx: Rc<PortTx>, clock: Clock) -> Self {
        let wire = RefCell::new(Wire::new(pacing));
        let (nodes, deadline_moved) = (RefCell::default(), Notify::new());
        Self { shared: Rc::new(BusState { wire, nodes, deadline_moved, clock, tx }) }
    }

    fn now(&self) -> Instant {
        self.shared.clock.now()
    }

    /// Adds a node that receives all frames.
    pub(crate) fn join(&self) -> BusNode {
        let state = Rc::new(NodeState {
            id: self.shared.wire.borrow_mut().join(),
            queue: RefCell::default(),
            wake: Notify::new(),
            is_receiving: Cell::new(true),
            dropped: Cell::new(0),
            sent: Cell::default(),
            sent_wake: Notify::new(),
        });
        self.shared.nodes.borrow_mut().push(Rc::clone(&state));
        BusNode { bus: self.clone(), state }
    }

    /// Advances the bus with the clock until dropped.
    pub(crate) async fn run(&self) -> io::Result<()> {
        let timer = self.shared.clock.alarm()?;
        loop {
            let deadline = self.shared.wire.borrow().deadline();
            timer.arm(deadline)?;
            tokio::select! {
                expired = timer.expired() => {
                    expired?;
                    self.advance(self.now());
                }
                () = self.shared.deadline_moved.notified() => {}
            }
        }
    }

    /// Delivers the frames that were transmitted by now to every receiving node except the sender. A node
    /// with [`MAX_WAITING`] frames waiting drops and counts a frame.
    pub(crate) fn advance(&self, now: Instant) {
        loop {
            let transmitted = self.shared.wire.borrow_mut().poll(now);
            let Some(Transmitted { from, frame, at }) = transmitted else { return };
            for node in self.shared.nodes.borrow().iter() {
                if node.id == from {
                    let SentFrames { frames, bytes } = node.sent.get();
                    node.sent
                        .set(SentFrames { frames: frames + 1, bytes: bytes + frame.data().len() as u64 });
                    node.sent_wake.notify_one();
                    continue;
                }
                if !node.is_receiving.get() {
                    continue;
                }
                let mut queue = node.queue.borrow_mut();
                if queue.len() == MAX_WAITING {
                    node.dropped.set(node.dropped.get() + 1);
                    self.shared.tx.count(|counters| counters.dropped += 1);
                } else {
                    queue.push_back((at, frame));
                    node.wake.notify_one();
                }
            }
        }
    }
}

/// A node of a bus. Dropping it removes it from the bus and drops its waiting frames.
#[derive(Debug)]
pub(crate) struct BusNode {
    bus: CanBus,
    state: Rc<NodeState>,
}

impl BusNode {
    /// Queues a frame for transmission.
    pub(crate) fn send(&self, now: Instant, frame: CanFrame) -> Result<(), Full> {
        let wire = &self.bus.shared.wire;
        self.bus.advance(now);
        let before = wire.borrow().deadline();
        wire.borrow_mut().send(now, self.state.id, frame)?;
        self.bus.advance(now);
        if wire.borrow().deadline() != before {
            self.bus.shared.deadline_moved.notify_one();
        }
        Ok(())
    }

    /// Whether the next frame would be refused.
    pub(crate) fn is_full(&self) -> bool {
        self.bus.shared.wire.borrow().is_full(self.state.id)
    }

    /// Number of frames of this node that have not been transmitted.
    pub(crate) fn waiting(&self) -> usize {
        self.bus.shared.wire.borrow().waiting(self.state.id)
    }

    /// Waits until frames of this node have been transmitted, and returns their number. Cancel safe.
    pub(crate) async fn sent(&self) -> SentFrames {
        loop {
            let sent = self.state.sent.take();
            if sent.frames > 0 {
                return sent;
            }
            self.state.sent_wake.notified().await;
        }
    }

    /// The next received frame, with the time of its end.
    pub(crate) fn try_recv(&self) -> Option<(Instant, CanFrame)> {
        self.state.queue.borrow_mut().pop_front()
    }

    /// Waits for the next frame. Cancel safe.
    pub(crate) async fn recv(&self) -> (Instant, CanFrame) {
        loop {
            if let Some(frame) = self.try_recv() {
                return frame;
            }
            self.state.wake.notified().await;
        }
    }

    /// Starts or stops receiving frames of other nodes. Stopping drops the waiting frames.
    pub(crate) fn set_receiving(&self, is_receiving: bool) {
        self.state.is_receiving.set(is_receiving);
        if !is_receiving {
            self.state.queue.borrow_mut().clear();
        }
    }

    /// Number of received frames dropped because too many waited.
    pub(crate) fn dropped(&self) -> u64 {
        self.state.dropped.get()
    }
}

impl Drop for BusNode {
    fn drop(&mut self) {
        self.bus.shared.wire.borrow_mut().leave(self.state.id);
        self.bus.shared.nodes.borrow_mut().retain(|node| !Rc::ptr_eq(node, &self.state));
    }
}

/// A CAN port of the configuration, on a bus of its own that slcan clients connect to.
#[derive(Debug)]
pub(super) struct CanPort {
    pty: Option<(Rc<Pty>, Rc<RefCell<SlcanSession>>)>,
    listener: Option<Rc<TcpListener>>,
    clients: Rc<Clients>,
    /// The device was taken over, and old input may wait in it.
    is_handed_over: bool,
    bitrate: u32,
    pacing: Pacing,
    tx: Rc<PortTx>,
    pub(super) clock: Clock,
}

/// The clients' side of a CAN bus in user space, without queued frames.
#[derive(Debug)]
pub(crate) struct HandoverBus {
    /// Bit/s of the bus, which the clients' channels must match.
    pub(crate) bitrate: u32,
    pub(crate) pty: Option<(HandoverPty, SlcanSession)>,
    pub(crate) listener: Option<std::net::TcpListener>,
    pub(crate) clients: Vec<(std::net::TcpStream, SlcanSession)>,
}

/// The clients' side of a bus whose tasks still run.
#[derive(Debug)]
pub(crate) struct HeldBus {
    pub(crate) bitrate: u32,
    pub(crate) pty: Option<(Rc<Pty>, Rc<RefCell<SlcanSession>>)>,
    pub(crate) listener: Option<Rc<TcpListener>>,
    pub(crate) clients: Rc<Clients>,
}

impl CanPort {
    pub(super) async fn open(
        device: &Device,
        bitrate: u32,
        tx: Rc<PortTx>,
        handover: Option<HandoverBus>,
    ) -> io::Result<Self> {
        let (link, listen, pace) = match device {
            Device::SlcanPty { link, pace } => (Some(link), None, *pace),
            Device::SlcanTcp { listen, link, pace } => (link.as_ref(), Some(listen), *pace),
            _ => {
                let what = format!("`{device}` is a serial device; the port is a CAN bus");
                return Err(io::Error::new(io::ErrorKind::InvalidInput, what));
            }
        };
        let is_handed_over = handover.is_some();
        let (listener, pty, clients) = match handover {
            Some(HandoverBus { pty, listener, clients, .. }) => {
                let pty = pty.map(|(pty, session)| Ok::<_, io::Error>((pty.attach()?, session)));
                let client = |(stream, session)| {
                    let stream = TcpStream::from_std(stream)?;
                    Ok::<_, io::Error>(Rc::new(SlcanClient { stream, session: RefCell::new(session) }))
                };
                let clients = clients.into_iter().map(client).collect::<io::Result<_>>()?;
                (listener.map(TcpListener::from_std).transpose()?, pty.transpose()?, clients)
            }
            None => {
                let listener = match listen {
                    Some(at) => Some(stream::listen(at).await?),
                    None => None,
                };
                let pty = link.map(|link| Pty::open(link)).transpose()?;
                (listener, pty.map(|pty| (pty, SlcanSession::new(bitrate))), Vec::new())
            }
        };
        let pty = pty.map(|(pty, session)| (Rc::new(pty), Rc::new(RefCell::new(session))));
        let (listener, clients) = (listener.map(Rc::new), Rc::new(RefCell::new(clients)));
        let pacing = match pace {
            Pace::AtOnce => Pacing::AtOnce,
            Pace::BitRate => Pacing::Bitrate(bitrate),
        };
        Ok(Self { pty, listener, clients, is_handed_over, bitrate, pacing, tx, clock: Clock::real() })
    }

    /// With both a listener and a terminal, the listener's address: the `--bind` has the terminal's link.
    pub(super) fn place(&self) -> String {
        match (&self.listener, &self.pty) {
            (Some(listener), _) => stream::address_of(listener),
            (None, Some((pty, _))) => pty.link().display().to_string(),
            (None, None) => String::new(),
        }
    }

    pub(super) fn held(&self) -> HeldBus {
        HeldBus {
            bitrate: self.bitrate,
            pty: self.pty.clone(),
            listener: self.listener.clone(),
            clients: Rc::clone(&self.clients),
        }
    }

    pub(super) async fn run(self, mut events: impl FnMut(PortEvent<'_>)) -> io::Result<()> {
        let Self { pty, listener, clients, is_handed_over, bitrate, pacing, tx, clock } = self;
        if is_handed_over {
            tx.note_gap(now());
        }
        let bus = CanBus::new(pacing, Rc::clone(&tx), clock);
        let node = bus.join();
        tx.count(|counters| counters.ups += 1);
        events(PortEvent::Up);
        let on_terminal = async {
            match &pty {
                Some((pty, session)) => serve(&**pty, session, &bus.join(), &tx, Backlog::new(&tx)).await,
                None => pending().await,
            }
        };
        let on_tcp = async {
            match listener {
                Some(listener) => serve_all(&listener, &clients, &bus, bitrate, &tx).await,
                None => pending().await,
            }
        };
        tokio::select! {
            () = port_node(&node, &tx, &mut events) => Ok(()),
            ended = bus.run() => ended,
            error = on_terminal => Err(error),
            () = on_tcp => Ok(()),
        }
    }
}

async fn port_node(node: &BusNode, tx: &PortTx, events: &mut impl FnMut(PortEvent<'_>)) {
    loop {
        tokio::select! {
            (_, frame) = node.recv() => {
                tx.count(|counters| {
                    counters.frames_in += 1;
                    counters.bytes_in += frame.data().len() as u64;
                });
                events(PortEvent::Frame { frame });
            }
            () = tx.wake.notified() => hand_over(node, tx),
            sent = node.sent() => {
                tx.count(|counters| {
                    counters.frames_out += sent.frames;
                    counters.bytes_out += sent.bytes;
                });
                hand_over(node, tx);
                if node.waiting() == 0 {
                    events(PortEvent::Sent);
                }
            }
        }
    }
}

/// Queues as many of the port's frames as its node accepts.
fn hand_over(node: &BusNode, tx: &PortTx) {
    while !node.is_full() {
        let Some(frame) = tx.frames.borrow_mut().pop_front() else { return };
        // Cannot fail: the queue has space.
        let _ = node.send(node.bus.now(), frame);
    }
}

/// Maximum number of received frames that wait at one node.
pub(crate) const MAX_WAITING: usize = 256;

#[cfg(test)]
#[path = "can_bus_tests.rs"]
mod tests;
