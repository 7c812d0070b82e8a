//! A CAN bus in user space (proto-core/docs/wire/slcan.md section 4): a port of ours and any number of slcan clients.

use std::cell::{Cell, RefCell};
use std::collections::VecDeque;
use std::future::pending;
use std::io;
use std::ops::Range;
use std::rc::Rc;
use std::time::Duration as StdDuration;

use proto_core::time::Instant;
use proto_core::wire::can::CanFrame;
use proto_core::wire::slcan::{Channel, ChannelState};
use tokio::net::TcpListener;
use tokio::sync::Notify;
use tokio::task::{JoinSet, yield_now};
use tracing::{info, warn};

use super::bind::{Device, Pace};
use super::exchange::{Backlog, PortEvent, PortTx};
use super::pty::Pty;
use super::stream::{ByteStream, accept};
use super::wire::{Crossed, Full, NodeId, Pacing, Wire};
use recipe_net::peer;
use recipe_net::timer::{Timer, now};
use recipe_net::turns::{arrival, give_way};

/// The bus itself; clones are the same bus.
#[derive(Debug, Clone)]
pub struct CanBus {
    shared: Rc<Shared>,
}

#[derive(Debug)]
struct Shared {
    wire: RefCell<Wire>,
    nodes: RefCell<Vec<Rc<NodeState>>>,
    /// The wire's deadline has moved.
    moved: Notify,
    /// Where dropped frames are counted.
    tx: Rc<PortTx>,
}

#[derive(Debug)]
struct NodeState {
    id: NodeId,
    queue: RefCell<VecDeque<(Instant, CanFrame)>>,
    wake: Notify,
    deaf: Cell<bool>,
    dropped: Cell<u64>,
    left: Cell<Left>,
    left_wake: Notify,
}

/// What a node has sent and not yet been told of.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Left {
    /// Frames.
    pub frames: u64,
    /// Their data bytes.
    pub bytes: u64,
}

impl CanBus {
    /// A bus without nodes. What they drop is counted at `tx`.
    pub fn new(pacing: Pacing, tx: Rc<PortTx>) -> Self {
        let wire = RefCell::new(Wire::new(pacing));
        Self { shared: Rc::new(Shared { wire, nodes: RefCell::default(), moved: Notify::new(), tx }) }
    }

    /// Joins the bus with a node that hears everything.
    pub fn join(&self) -> Node {
        let state = Rc::new(NodeState {
            id: self.shared.wire.borrow_mut().join(),
            queue: RefCell::default(),
            wake: Notify::new(),
            deaf: Cell::new(false),
            dropped: Cell::new(0),
            left: Cell::default(),
            left_wake: Notify::new(),
        });
        self.shared.nodes.borrow_mut().push(Rc::clone(&state));
        Node { bus: self.clone(), state }
    }

    /// Lets time pass on the bus until dropped.
    ///
    /// # Errors
    /// As [`Timer::new`] and [`Timer::expired`].
    pub async fn run(&self) -> io::Result<()> {
        let timer = Timer::new()?;
        loop {
            let deadline = self.shared.wire.borrow().deadline();
            timer.arm(deadline)?;
            tokio::select! {
                expired = timer.expired() => {
                    expired?;
                    self.advance(now());
                }
                () = self.shared.moved.notified() => {}
            }
        }
    }

    /// Hands out what has crossed the wire by now: every node but the sender gets it that hears, or
    /// drops and counts it when [`MAX_WAITING`] frames wait there already.
    pub fn advance(&self, now: Instant) {
        loop {
            let crossed = self.shared.wire.borrow_mut().poll(now);
            let Some(Crossed { from, frame, at }) = crossed else { return };
            for node in self.shared.nodes.borrow().iter() {
                if node.id == from {
                    let Left { frames, bytes } = node.left.get();
                    node.left.set(Left { frames: frames + 1, bytes: bytes + frame.data().len() as u64 });
                    node.left_wake.notify_one();
                    continue;
                }
                if node.deaf.get() {
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

/// One member of a bus; leaves it when dropped, and what it has not sent by then is given up.
#[derive(Debug)]
pub struct Node {
    bus: CanBus,
    state: Rc<NodeState>,
}

impl Node {
    /// Queues a frame for the wire.
    ///
    /// # Errors
    /// When too many wait, see [`Full`].
    pub fn send(&self, now: Instant, frame: CanFrame) -> Result<(), Full> {
        let wire = &self.bus.shared.wire;
        self.bus.advance(now);
        let before = wire.borrow().deadline();
        wire.borrow_mut().send(now, self.state.id, frame)?;
        self.bus.advance(now);
        if wire.borrow().deadline() != before {
            self.bus.shared.moved.notify_one();
        }
        Ok(())
    }

    /// Whether the next frame would be refused.
    pub fn is_full(&self) -> bool {
        self.bus.shared.wire.borrow().is_full(self.state.id)
    }

    /// Frames of this node that have not left.
    pub fn waiting(&self) -> usize {
        self.bus.shared.wire.borrow().waiting(self.state.id)
    }

    /// Waits until frames of this node have left. Cancel safe.
    pub async fn left(&self) -> Left {
        loop {
            let left = self.state.left.take();
            if left.frames > 0 {
                return left;
            }
            self.state.left_wake.notified().await;
        }
    }

    /// The next frame that others sent, with the time of its end.
    pub fn try_recv(&self) -> Option<(Instant, CanFrame)> {
        self.state.queue.borrow_mut().pop_front()
    }

    /// Waits for the next frame. Cancel safe.
    pub async fn recv(&self) -> (Instant, CanFrame) {
        loop {
            if let Some(frame) = self.try_recv() {
                return frame;
            }
            self.state.wake.notified().await;
        }
    }

    /// Whether frames of others come here from now on; those that wait are given up when they don't.
    pub fn set_hears(&self, hears: bool) {
        self.state.deaf.set(!hears);
        if !hears {
            self.state.queue.borrow_mut().clear();
        }
    }

    /// Frames dropped here because too many waited.
    pub fn dropped(&self) -> u64 {
        self.state.dropped.get()
    }
}

impl Drop for Node {
    fn drop(&mut self) {
        self.bus.shared.wire.borrow_mut().leave(self.state.id);
        self.bus.shared.nodes.borrow_mut().retain(|node| !Rc::ptr_eq(node, &self.state));
    }
}

/// A CAN port of the configuration, on a bus of its own that slcan clients join.
#[derive(Debug)]
pub(super) struct CanPort {
    pty: Option<Pty>,
    listener: Option<TcpListener>,
    bitrate: u32,
    pacing: Pacing,
    tx: Rc<PortTx>,
}

impl CanPort {
    pub(super) async fn open(device: &Device, bitrate: u32, tx: Rc<PortTx>) -> io::Result<Self> {
        let (link, listen, pace) = match device {
            Device::SlcanPty { link, pace } => (Some(link), None, *pace),
            Device::SlcanTcp { listen, link, pace } => (link.as_ref(), Some(listen), *pace),
            _ => {
                let what = format!("`{device}` is a serial device; the port is a CAN bus");
                return Err(io::Error::new(io::ErrorKind::InvalidInput, what));
            }
        };
        let listener = match listen {
            Some(listen) => {
                let listener = TcpListener::bind((listen.host.as_str(), listen.port)).await;
                let listener =
                    listener.map_err(|error| io::Error::new(error.kind(), format!("{listen}: {error}")))?;
                // Frames that wait in the kernel are old when they are read, and are not counted.
                peer::bound(&listener);
                Some(listener)
            }
            None => None,
        };
        let pty = link.map(|link| Pty::open(link)).transpose()?;
        let pacing = match pace {
            Pace::AtOnce => Pacing::AtOnce,
            Pace::Line => Pacing::Bitrate(bitrate),
        };
        Ok(Self { pty, listener, bitrate, pacing, tx })
    }

    /// Of a bus with both, where it listens: the terminal's link is in the configuration anyway.
    pub(super) fn place(&self) -> String {
        match (&self.listener, &self.pty) {
            (Some(listener), _) => listener.local_addr().map_or_else(|_| String::new(), |at| at.to_string()),
            (None, Some(pty)) => pty.link().display().to_string(),
            (None, None) => String::new(),
        }
    }

    pub(super) async fn run(self, mut events: impl FnMut(PortEvent<'_>)) -> io::Result<()> {
        let Self { pty, listener, bitrate, pacing, tx } = self;
        let bus = CanBus::new(pacing, Rc::clone(&tx));
        let node = bus.join();
        tx.count(|counters| counters.ups += 1);
        events(PortEvent::Up);
        let on_terminal = async {
            match &pty {
                Some(pty) => serve(pty, &bus.join(), bitrate, &tx).await,
                None => pending().await,
            }
        };
        let on_tcp = async {
            match listener {
                Some(listener) => serve_all(listener, &bus, bitrate, &tx).await,
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

/// The port's own node.
async fn port_node(node: &Node, tx: &PortTx, events: &mut impl FnMut(PortEvent<'_>)) {
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
            left = node.left() => {
                tx.count(|counters| {
                    counters.frames_out += left.frames;
                    counters.bytes_out += left.bytes;
                });
                hand_over(node, tx);
                if node.waiting() == 0 {
                    events(PortEvent::Sent);
                }
            }
        }
    }
}

/// Queues as many of the port's frames as its node takes.
fn hand_over(node: &Node, tx: &PortTx) {
    while !node.is_full() {
        let Some(frame) = tx.frames.borrow_mut().pop_front() else { return };
        // There is room, so it is taken.
        let _ = node.send(now(), frame);
    }
}

async fn serve_all(listener: TcpListener, bus: &CanBus, bitrate: u32, tx: &Rc<PortTx>) {
    let mut clients = JoinSet::new();
    loop {
        tokio::select! {
            (stream, peer) = accept(&listener, tx) => {
                if clients.len() == MAX_CLIENTS {
                    drop(stream);
                    tx.count(|counters| counters.refused += 1);
                    if let Some(more) = tx.complaints.take(now()) {
                        warn!(%peer, more, "refused: the bus already has {MAX_CLIENTS} slcan clients");
                    }
                    give_way().await;
                    continue;
                }
                info!(%peer, "slcan client connected");
                peer::watch(&stream);
                let (node, tx) = (bus.join(), Rc::clone(tx));
                clients.spawn_local(async move {
                    let error = serve(&stream, &node, bitrate, &tx).await;
                    info!(%peer, %error, "slcan client disconnected");
                    drop(stream);
                    // What was answered as sent is sent.
                    node.set_hears(false);
                    while node.waiting() > 0 {
                        node.left().await;
                    }
                });
            }
            Some(_) = clients.join_next() => {}
        }
    }
}

/// Ties one client to the bus until its connection fails.
async fn serve(io: &impl ByteStream, node: &Node, bitrate: u32, tx: &PortTx) -> io::Error {
    let mut channel = Channel::new(bitrate);
    node.set_hears(false);
    let mut out = Vec::new();
    let mut buf = [0; OLD_CHUNK];
    let mut unread = 0..0;
    let mut told_dropped = 0;
    let (mut backlog, mut is_old) = (Backlog::default(), false);
    loop {
        // A frame waits in the bounded queue until the client has taken what is before it, and a
        // client's line until its frames before it have left.
        let room = out.len() < MAX_PENDING;
        let most = if backlog.is_open(tx) { OLD_CHUNK } else { CHUNK };
        let mut read = None;
        let done = tokio::select! {
            received = io.receive(&mut buf[..most]), if room && unread.is_empty() => {
                match received {
                    Ok(0) => Err(io::ErrorKind::UnexpectedEof.into()),
                    Ok(count) => {
                        unread = 0..count;
                        read = Some(count);
                        // Taking its time on the bus a frame would be believed when it is over.
                        is_old = backlog.has(tx, count == most) || tx.is_stale();
                        Ok(())
                    }
                    Err(error) => Err(error),
                }
            }
            _ = node.left(), if !unread.is_empty() => Ok(()),
            (at, frame) = node.recv(), if room => {
                let mut next = Some((at, frame));
                while let Some((at, frame)) = next {
                    out.extend(channel.deliver(&frame, at.as_micros() / 1_000).iter().flatten());
                    next = if out.len() < MAX_PENDING { node.try_recv() } else { None };
                }
                Ok(())
            }
            ready = io.writable(), if !out.is_empty() => ready,
            () = tokio::time::sleep(STALE_LOOK), if io.may_be_stale() => Ok(()),
        };
        take_lines(&mut channel, node, is_old.then_some(tx), &buf, &mut unread, &mut out);
        let done = done.and_then(|()| flush(io, &mut out, tx));
        if node.dropped() != told_dropped {
            told_dropped = node.dropped();
            channel.note_overrun();
        }
        match done {
            Err(error) if error.kind() != io::ErrorKind::WouldBlock => return error,
            _ => {}
        }
        // One read holds fewer frames than a node keeps: others take them in between.
        match read {
            Some(count) if count == most && !tx.is_stale() => give_way().await,
            Some(_) => yield_now().await,
            None => {}
        }
    }
}

/// Carries out a client's lines as long as the node has room for the frames in them. Old frames are dropped
/// and counted.
fn take_lines(
    channel: &mut Channel,
    node: &Node,
    old: Option<&PortTx>,
    buf: &[u8],
    unread: &mut Range<usize>,
    out: &mut Vec<u8>,
) {
    while !Range::is_empty(unread) && !node.is_full() {
        let mut bytes = &buf[unread.clone()];
        if let Some(reaction) = channel.receive(&mut bytes) {
            out.extend_from_slice(reaction.answer);
            match (reaction.frame, old) {
                (Some(_), Some(tx)) => tx.count(|counters| counters.dropped += 1),
                // There is room, so it is taken.
                (Some(frame), None) => drop(node.send(arrival(), frame)),
                (None, _) => {}
            }
        }
        unread.start = unread.end - bytes.len();
    }
    // Frames that nobody could look at when they came have crossed the bus meanwhile.
    node.bus.advance(now());
    let hears = channel.state() != ChannelState::Closed;
    if node.state.deaf.get() == hears {
        node.set_hears(hears);
    }
}

/// Writes what the client takes; what nobody would hear is given up.
fn flush(io: &impl ByteStream, out: &mut Vec<u8>, tx: &PortTx) -> io::Result<()> {
    if !io.is_heard() {
        tx.count(|counters| counters.unheard += out.len() as u64);
        out.clear();
    }
    while !out.is_empty() {
        let count = io.try_write(out)?;
        out.drain(..count);
    }
    Ok(())
}

/// Most frames that wait for one node.
pub const MAX_WAITING: usize = 256;
/// Most slcan clients on TCP.
const MAX_CLIENTS: usize = 32;
/// Most bytes read from a client at once.
const CHUNK: usize = 256;
/// The same of what waited while the process slept: of that no frames come. A terminal that had more gives
/// exactly this.
const OLD_CHUNK: usize = 4_095;
/// Bytes made out for a client and not yet taken; beyond it frames wait in the node's queue.
const MAX_PENDING: usize = 4_096;
/// Between two looks for a client that went away and left bytes behind.
const STALE_LOOK: StdDuration = StdDuration::from_millis(100);

#[cfg(test)]
#[path = "can_bus_tests.rs"]
mod tests;
