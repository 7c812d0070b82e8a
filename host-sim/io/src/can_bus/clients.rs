//! slcan clients of a bus, over TCP and on a terminal: their commands, and the frames that they receive.

use std::cell::RefCell;
use std::io;
use std::ops::Range;
use std::rc::Rc;
use std::time::Duration as StdDuration;

use proto_core::wire::slcan::{Channel, ChannelState};
use tokio::net::{TcpListener, TcpStream};
use tokio::task::{JoinSet, yield_now};
use tracing::{info, warn};

use super::super::exchange::{Backlog, PortTx};
use super::super::stream::{self, ByteStream, accept};
use super::{BusNode, CanBus};
use crate::fairness::{arrival_time, yield_fairly};
use crate::tcp_options;
use crate::timer::now;

#[derive(Debug)]
pub(crate) struct SlcanClient {
    pub(crate) stream: TcpStream,
    pub(crate) session: RefCell<SlcanSession>,
}

pub(crate) type Clients = RefCell<Vec<Rc<SlcanClient>>>;

/// The slcan state of a client.
#[derive(Debug)]
pub(crate) struct SlcanSession {
    channel: Channel,
    /// Bytes that the client has not read yet.
    out: Vec<u8>,
    /// Received frames that wait for space on the bus.
    rest: Vec<u8>,
}

impl SlcanSession {
    pub(super) fn new(bitrate: u32) -> Self {
        Self { channel: Channel::new(bitrate), out: Vec::new(), rest: Vec::new() }
    }
}

/// Serves clients over TCP: those that were taken over, and new ones.
pub(super) async fn serve_all(
    listener: &TcpListener,
    clients: &Rc<Clients>,
    bus: &CanBus,
    bitrate: u32,
    tx: &Rc<PortTx>,
) {
    let mut tasks = JoinSet::new();
    for client in clients.borrow().iter() {
        let backlog = Backlog::new(tx);
        tasks.spawn_local(serve_client(
            Rc::clone(client),
            Rc::clone(clients),
            bus.join(),
            Rc::clone(tx),
            backlog,
        ));
    }
    let mut known = tx.sleeps();
    loop {
        tokio::select! {
            (stream, peer) = accept(listener, tx) => {
                let backlog = Backlog::accepted(tx, known);
                known = tx.sleeps();
                if tasks.len() == MAX_CLIENTS {
                    drop(stream);
                    tx.count(|counters| counters.refused += 1);
                    if let Some(more) = tx.log_limit.allow(now()) {
                        warn!(%peer, more, "refused: the bus already has {MAX_CLIENTS} slcan clients");
                    }
                    yield_fairly().await;
                    continue;
                }
                info!(%peer, "slcan client connected");
                tcp_options::enable_keepalive(&stream);
                let client = Rc::new(SlcanClient { stream, session: RefCell::new(SlcanSession::new(bitrate)) });
                clients.borrow_mut().push(Rc::clone(&client));
                tasks.spawn_local(serve_client(client, Rc::clone(clients), bus.join(), Rc::clone(tx), backlog));
            }
            Some(_) = tasks.join_next() => {}
        }
    }
}

/// Serves a client on TCP until it has gone.
async fn serve_client(
    client: Rc<SlcanClient>,
    clients: Rc<Clients>,
    node: BusNode,
    tx: Rc<PortTx>,
    backlog: Backlog,
) {
    let peer = stream::peer_of(&client.stream);
    let error = serve(&client.stream, &client.session, &node, &tx, backlog).await;
    info!(%peer, %error, "slcan client disconnected");
    clients.borrow_mut().retain(|other| !Rc::ptr_eq(other, &client));
    drop(client);
    // Frames that were acknowledged to the client are still sent.
    node.set_receiving(false);
    while node.waiting() > 0 {
        node.sent().await;
    }
}

/// Serves one client until its connection fails.
pub(super) async fn serve<D: ByteStream>(
    io: &D,
    session: &RefCell<SlcanSession>,
    node: &BusNode,
    tx: &PortTx,
    mut backlog: Backlog,
) -> io::Error {
    node.set_receiving(false);
    {
        // Earlier input and the channel's state of a client that was taken over.
        let SlcanSession { channel, out, rest } = &mut *session.borrow_mut();
        let (rest, mut unread) = (std::mem::take(rest), 0..rest.len());
        execute_commands(channel, node, Some(tx), &rest, &mut unread, out);
    }
    let mut buf = [0; BACKLOG_CHUNK];
    let mut unread = 0..0;
    let mut reported_dropped = 0;
    let mut is_old = false;
    loop {
        if backlog.has_slept(tx) {
            backlog.note(tx, io.has_unread());
            is_old |= !unread.is_empty();
        }
        // A frame waits in the bounded queue until the client has read all output before it. A command waits until the
        // frames before it have been transmitted.
        let room = session.borrow().out.len() < MAX_PENDING;
        let most = if backlog.is_open(tx) { BACKLOG_CHUNK } else { CHUNK };
        let mut read = None;
        let done = tokio::select! {
            received = io.receive(&mut buf[..most]), if room && unread.is_empty() => {
                match received {
                    Ok(0) => Err(io::ErrorKind::UnexpectedEof.into()),
                    Ok(count) => {
                        unread = 0..count;
                        read = Some(count);
                        // Drop it here: after its time on the bus, the engine would no longer discard it.
                        is_old = backlog.has(tx, count == most) || tx.is_stale();
                        Ok(())
                    }
                    Err(error) => Err(error),
                }
            }
            _ = node.sent(), if !unread.is_empty() => Ok(()),
            (at, frame) = node.recv(), if room => {
                let SlcanSession { channel, out, .. } = &mut *session.borrow_mut();
                let mut next = Some((at, frame));
                while let Some((at, frame)) = next {
                    out.extend(channel.deliver(&frame, at.as_micros() / 1_000).iter().flatten());
                    next = if out.len() < MAX_PENDING { node.try_recv() } else { None };
                }
                Ok(())
            }
            () = tx.looked.notified(), if D::LATE && room && unread.is_empty() => match io.try_read(&mut buf[..most]) {
                Ok(0) => Err(io::ErrorKind::UnexpectedEof.into()),
                Ok(count) => {
                    unread = 0..count;
                    is_old = backlog.has(tx, count == most) || tx.is_stale();
                    Ok(())
                }
                Err(error) => Err(error),
            },
            () = tx.slept.notified() => Ok(()),
            ready = io.writable(), if !session.borrow().out.is_empty() => ready,
            () = tokio::time::sleep(CLIENT_POLL), if io.may_hold_unread() => Ok(()),
        };
        let done = {
            let SlcanSession { channel, out, rest } = &mut *session.borrow_mut();
            execute_commands(channel, node, is_old.then_some(tx), &buf, &mut unread, out);
            rest.clear();
            rest.extend_from_slice(buf.get(unread.clone()).unwrap_or_default());
            if node.dropped() != reported_dropped {
                reported_dropped = node.dropped();
                channel.note_overrun();
            }
            done.and_then(|()| flush(io, out, tx))
        };
        match done {
            Err(error) if error.kind() != io::ErrorKind::WouldBlock => return error,
            _ => {}
        }
        // One read holds fewer frames than a node's queue; other tasks empty the queue in between.
        match read {
            Some(count) if count == most && !tx.is_stale() => yield_fairly().await,
            Some(_) => yield_now().await,
            None => {}
        }
    }
}

/// Executes a client's commands as long as the node has room for their frames. Drops and counts old frames.
fn execute_commands(
    channel: &mut Channel,
    node: &BusNode,
    old: Option<&PortTx>,
    buf: &[u8],
    unread: &mut Range<usize>,
    out: &mut Vec<u8>,
) {
    // A clock that does not run by itself is never late.
    let is_real = !node.bus.shared.clock.runs_apart();
    let arrived = if is_real { arrival_time() } else { node.bus.now() };
    while !Range::is_empty(unread) && !node.is_full() {
        let mut bytes = &buf[unread.clone()];
        if let Some(reaction) = channel.receive(&mut bytes) {
            out.extend_from_slice(reaction.answer);
            match (reaction.frame, old) {
                (Some(_), Some(tx)) => tx.count(|counters| counters.dropped += 1),
                // Cannot fail: the queue has space.
                (Some(frame), None) => drop(node.send(arrived, frame)),
                (None, _) => {}
            }
        }
        unread.start = unread.end - bytes.len();
    }
    // Frames read late may already have been transmitted.
    node.bus.advance(node.bus.now());
    let is_receiving = channel.state() != ChannelState::Closed;
    if node.state.is_receiving.get() != is_receiving {
        node.set_receiving(is_receiving);
    }
}

/// Writes as much as the client accepts. Without a client everything is dropped and counted.
fn flush(io: &impl ByteStream, out: &mut Vec<u8>, tx: &PortTx) -> io::Result<()> {
    if !io.has_client() {
        tx.count(|counters| counters.unheard += out.len() as u64);
        out.clear();
    }
    while !out.is_empty() {
        let count = io.try_write(out)?;
        out.drain(..count);
    }
    Ok(())
}

pub(super) const MAX_CLIENTS: usize = 32;
const CHUNK: usize = 256;
/// Maximum number of bytes per read for bytes that waited while the process slept, whose frames are dropped. A terminal
/// with more waiting returns exactly this number.
const BACKLOG_CHUNK: usize = 4_095;
/// Maximum number of bytes that wait for a client; beyond it frames wait in the node's queue.
const MAX_PENDING: usize = 4_096;
/// Interval of checks whether a client has gone and left bytes unread.
const CLIENT_POLL: StdDuration = StdDuration::from_millis(100);
