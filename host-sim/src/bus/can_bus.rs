//! A CAN bus in user space (docs/wire/slcan.md section 4): a port of ours and any number of slcan clients.

use std::cell::{Cell, RefCell};
use std::collections::VecDeque;
use std::io;
use std::rc::Rc;
use std::time::Duration as StdDuration;

use embedded_can::Frame;
use proto_core::recipe::can::CanFrame;
use proto_core::time::{Duration, Instant};
use tokio::net::{TcpListener, TcpStream};
use tokio::sync::Notify;
use tokio::task::JoinSet;
use tracing::{info, warn};

use super::bind::Device;
use super::line::accept;
use super::port::{PortEvent, PortTx};
use super::pty::Pty;
use super::slcan::{Channel, ChannelState};
use super::timer::{Timer, now};

/// The bus itself; clones are the same bus.
#[derive(Debug, Clone, Default)]
pub struct CanBus {
    nodes: Rc<RefCell<Vec<Rc<NodeState>>>>,
    /// Where dropped frames are counted.
    tx: Rc<PortTx>,
}

#[derive(Debug, Default)]
struct NodeState {
    queue: RefCell<VecDeque<CanFrame>>,
    wake: Notify,
    deaf: Cell<bool>,
    dropped: Cell<u64>,
}

impl CanBus {
    /// Joins the bus with a node that hears everything.
    pub fn join(&self) -> Node {
        let state = Rc::new(NodeState::default());
        self.nodes.borrow_mut().push(Rc::clone(&state));
        Node { bus: self.clone(), state }
    }
}

/// One member of a bus; leaves it when dropped.
#[derive(Debug)]
pub struct Node {
    bus: CanBus,
    state: Rc<NodeState>,
}

impl Node {
    /// Puts a frame on the bus: every other node that hears gets it, or drops and counts it when
    /// [`MAX_WAITING`] frames wait there already.
    pub fn send(&self, frame: CanFrame) {
        for node in self.bus.nodes.borrow().iter() {
            if Rc::ptr_eq(node, &self.state) || node.deaf.get() {
                continue;
            }
            let mut queue = node.queue.borrow_mut();
            if queue.len() == MAX_WAITING {
                node.dropped.set(node.dropped.get() + 1);
                self.bus.tx.count(|counters| counters.dropped += 1);
            } else {
                queue.push_back(frame);
                node.wake.notify_one();
            }
        }
    }

    /// The next frame that others sent.
    pub fn try_recv(&self) -> Option<CanFrame> {
        self.state.queue.borrow_mut().pop_front()
    }

    /// Waits for the next frame. Cancel safe.
    pub async fn recv(&self) -> CanFrame {
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
        self.bus.nodes.borrow_mut().retain(|node| !Rc::ptr_eq(node, &self.state));
    }
}

/// A CAN port of the configuration, on a bus of its own that slcan clients join.
#[derive(Debug)]
pub(super) struct CanPort {
    source: Source,
    bitrate: u32,
    tx: Rc<PortTx>,
}

#[derive(Debug)]
enum Source {
    Pty(Pty),
    Tcp(TcpListener),
}

impl CanPort {
    pub(super) async fn open(device: &Device, bitrate: u32, tx: Rc<PortTx>) -> io::Result<Self> {
        let source = match device {
            Device::SlcanPty { link } => Source::Pty(Pty::open(link)?),
            Device::SlcanTcp { listen } => {
                let listener = TcpListener::bind((listen.host.as_str(), listen.port)).await;
                Source::Tcp(
                    listener.map_err(|error| io::Error::new(error.kind(), format!("{listen}: {error}")))?,
                )
            }
            _ => {
                let what = format!("`{device}` is a serial device; the port is a CAN bus");
                return Err(io::Error::new(io::ErrorKind::InvalidInput, what));
            }
        };
        Ok(Self { source, bitrate, tx })
    }

    pub(super) fn place(&self) -> String {
        match &self.source {
            Source::Pty(pty) => pty.link().display().to_string(),
            Source::Tcp(listener) => {
                listener.local_addr().map_or_else(|_| String::new(), |at| at.to_string())
            }
        }
    }

    pub(super) async fn run(self, mut events: impl FnMut(PortEvent<'_>)) -> io::Result<()> {
        let bus = CanBus { tx: Rc::clone(&self.tx), ..CanBus::default() };
        let node = bus.join();
        let tx = &self.tx;
        tx.count(|counters| counters.ups += 1);
        events(PortEvent::Up);
        let port = port_node(&node, self.bitrate, tx, &mut events);
        match self.source {
            Source::Pty(pty) => tokio::select! {
                ended = port => ended,
                ended = serve(&pty, bus.join(), self.bitrate, tx) => Err(ended),
            },
            Source::Tcp(listener) => tokio::select! {
                ended = port => ended,
                () = serve_all(listener, &bus, self.bitrate, tx) => Ok(()),
            },
        }
    }
}

/// The port's own node: its frames go out one after the other, each in its time.
async fn port_node(
    node: &Node,
    bitrate: u32,
    tx: &PortTx,
    events: &mut impl FnMut(PortEvent<'_>),
) -> io::Result<()> {
    let timer = Timer::new()?;
    let mut under_way = None;
    loop {
        tokio::select! {
            frame = node.recv() => {
                tx.count(|counters| {
                    counters.frames_in += 1;
                    counters.bytes_in += frame.data().len() as u64;
                });
                events(PortEvent::Frame { frame, at: now() });
            }
            () = tx.wake.notified(), if under_way.is_none() => {
                under_way = next_frame(tx, bitrate, now(), &timer)?;
            }
            expired = timer.expired(), if under_way.is_some() => {
                expired?;
                let Some((frame, end)) = under_way.take() else { continue };
                tx.count(|counters| {
                    counters.frames_out += 1;
                    counters.bytes_out += frame.data().len() as u64;
                });
                node.send(frame);
                under_way = next_frame(tx, bitrate, end, &timer)?;
                if under_way.is_none() {
                    events(PortEvent::Sent);
                }
            }
        }
    }
}

/// Takes the next frame of the port's queue, whose transmission begins at `start`.
fn next_frame(
    tx: &PortTx,
    bitrate: u32,
    start: Instant,
    timer: &Timer,
) -> io::Result<Option<(CanFrame, Instant)>> {
    let Some(frame) = tx.frames.borrow_mut().pop_front() else { return Ok(None) };
    let end = start + frame_time(&frame, bitrate);
    timer.arm(end)?;
    Ok(Some((frame, end)))
}

/// A frame's time on the bus with the pause after it, without stuffing.
fn frame_time(frame: &CanFrame, bitrate: u32) -> Duration {
    let overhead: u64 = if frame.is_extended() { 67 } else { 47 };
    let bits = overhead + 8 * frame.data().len() as u64;
    Duration::from_micros((bits * 1_000_000).div_ceil(u64::from(bitrate.max(1))))
}

async fn serve_all(listener: TcpListener, bus: &CanBus, bitrate: u32, tx: &Rc<PortTx>) {
    let mut clients = JoinSet::new();
    loop {
        tokio::select! {
            (stream, peer) = accept(&listener) => {
                if clients.len() == MAX_CLIENTS {
                    warn!(%peer, "refused: the bus has {MAX_CLIENTS} slcan clients already");
                    tx.count(|counters| counters.refused += 1);
                    continue;
                }
                info!(%peer, "slcan client");
                let _ = stream.set_nodelay(true);
                // Frames that wait in the kernel are old when they are read, and are not counted.
                let _ = rustix::net::sockopt::set_socket_send_buffer_size(&stream, SEND_BUFFER);
                let (node, tx) = (bus.join(), Rc::clone(tx));
                clients.spawn_local(async move {
                    let error = serve(&stream, node, bitrate, &tx).await;
                    info!(%peer, %error, "slcan client left");
                });
            }
            Some(_) = clients.join_next() => {}
        }
    }
}

/// What an slcan client is connected by.
trait ClientIo {
    async fn readable(&self) -> io::Result<()>;
    fn try_read(&self, buf: &mut [u8]) -> io::Result<usize>;
    async fn writable(&self) -> io::Result<()>;
    fn try_write(&self, bytes: &[u8]) -> io::Result<usize>;

    /// Whether anybody reads what is written.
    fn is_heard(&self) -> bool {
        true
    }

    /// Whether `is_heard` should be asked now and then.
    fn may_be_stale(&self) -> bool {
        false
    }
}

impl ClientIo for Pty {
    async fn readable(&self) -> io::Result<()> {
        Self::readable(self).await
    }
    fn try_read(&self, buf: &mut [u8]) -> io::Result<usize> {
        Self::try_read(self, buf)
    }
    async fn writable(&self) -> io::Result<()> {
        Self::writable(self).await
    }
    fn try_write(&self, bytes: &[u8]) -> io::Result<usize> {
        Self::try_write(self, bytes)
    }
    fn is_heard(&self) -> bool {
        Self::is_heard(self)
    }
    fn may_be_stale(&self) -> bool {
        Self::may_be_stale(self)
    }
}

impl ClientIo for TcpStream {
    async fn readable(&self) -> io::Result<()> {
        Self::readable(self).await
    }
    fn try_read(&self, buf: &mut [u8]) -> io::Result<usize> {
        Self::try_read(self, buf)
    }
    async fn writable(&self) -> io::Result<()> {
        Self::writable(self).await
    }
    fn try_write(&self, bytes: &[u8]) -> io::Result<usize> {
        Self::try_write(self, bytes)
    }
}

/// Ties one client to the bus until its connection fails.
async fn serve(io: &impl ClientIo, node: Node, bitrate: u32, tx: &PortTx) -> io::Error {
    let mut channel = Channel::new(bitrate);
    node.set_hears(false);
    let mut out = Vec::new();
    let mut buf = [0; 1_024];
    let mut told_dropped = 0;
    loop {
        // A frame waits in the bounded queue until the client has taken what is before it.
        let room = out.len() < MAX_PENDING;
        let done = tokio::select! {
            ready = io.readable(), if room => match ready.and_then(|()| io.try_read(&mut buf)) {
                Ok(0) => Err(io::ErrorKind::UnexpectedEof.into()),
                Ok(count) => {
                    let mut bytes = &buf[..count];
                    while let Some(frame) = channel.receive(&mut bytes, &mut out) {
                        node.send(frame);
                    }
                    let hears = channel.state() != ChannelState::Closed;
                    if node.state.deaf.get() == hears {
                        node.set_hears(hears);
                    }
                    flush(io, &mut out, tx)
                }
                Err(error) => Err(error),
            },
            frame = node.recv(), if room => {
                let millis = now().as_micros() / 1_000;
                let mut next = Some(frame);
                while let Some(frame) = next {
                    out.extend(channel.deliver(&frame, millis).iter().flatten());
                    next = if out.len() < MAX_PENDING { node.try_recv() } else { None };
                }
                flush(io, &mut out, tx)
            }
            ready = io.writable(), if !out.is_empty() => ready.and_then(|()| flush(io, &mut out, tx)),
            () = tokio::time::sleep(STALE_LOOK), if io.may_be_stale() => flush(io, &mut out, tx),
        };
        if node.dropped() != told_dropped {
            told_dropped = node.dropped();
            channel.note_overrun();
        }
        match done {
            Err(error) if error.kind() != io::ErrorKind::WouldBlock => return error,
            _ => {}
        }
    }
}

/// Writes what the client takes; what nobody would hear is given up.
fn flush(io: &impl ClientIo, out: &mut Vec<u8>, tx: &PortTx) -> io::Result<()> {
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
/// Bytes made out for a client and not yet taken; beyond it frames wait in the node's queue.
const MAX_PENDING: usize = 4_096;
/// The kernel's share of what waits for a client on TCP, in bytes.
const SEND_BUFFER: usize = 64 * 1_024;
/// Between two looks for a client that went away and left bytes behind.
const STALE_LOOK: StdDuration = StdDuration::from_millis(100);

#[cfg(test)]
#[path = "can_bus_tests.rs"]
mod tests;
