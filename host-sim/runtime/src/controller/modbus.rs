//! The thread of the Modbus connections.
//!
//! It sleeps in the epoll of its sockets and answers a request as soon as it has read it. Whatever else a request
//! causes is left to the shell (`model`). The shell accepts connections, and hands them over when the controller has
//! accepted them too.
//!
//! A connection is read in pieces of [`CHUNK`] bytes; of those that have more, each gets one piece in turn. While a
//! client does not read its answers, it is not read.

use std::collections::{BTreeMap, VecDeque};
use std::io::{self, ErrorKind, Read, Write};
use std::net::{SocketAddr, TcpStream};
use std::os::fd::{AsFd, OwnedFd};
use std::sync::Arc;
use std::thread::JoinHandle;

use proto_core::time::{Duration, Instant};
use rustix::buffer::spare_capacity;
use rustix::event::{Timespec, epoll};
use rustix::io::Errno;
use tracing::{debug, error, info, warn};

use super::MAX_LINGERING;
use super::model::{Shared, Task};
use crate::StartError;
use crate::host::STACK;
use crate::tcp::{CHUNK, LINGER, MAX_UNSENT};
use recipe_controller::{ConnId, ControllerInput, Link};
use recipe_io::clock::Time;
use recipe_io::log_limit::LogLimit;
use recipe_io::realtime::{self, Scheduling};
use recipe_io::timer::now;

/// The thread, from the outside. Dropping it closes all connections and waits for the end.
#[derive(Debug)]
pub(super) struct Modbus {
    shared: Arc<Shared>,
    thread: Option<JoinHandle<()>>,
}

impl Modbus {
    /// Starts it.
    pub(super) fn start(
        shared: &Arc<Shared>,
        time: Time,
        scheduling: Scheduling,
    ) -> Result<Self, StartError> {
        let failed =
            |error: io::Error| StartError::new(format!("cannot start the thread for Modbus: {error}"));
        let mut connections = Connections::new(Arc::clone(shared), time).map_err(failed)?;
        let thread = std::thread::Builder::new().name("modbus".to_owned()).stack_size(STACK);
        let thread = thread.spawn(move || {
            realtime::apply(scheduling);
            let fails = Fails(&Arc::clone(&connections.shared));
            match connections.run() {
                Ok(()) => std::mem::forget(fails),
                Err(error) => error!(%error, "the Modbus connections cannot be waited for"),
            }
        });
        Ok(Self { shared: Arc::clone(shared), thread: Some(thread.map_err(failed)?) })
    }
}

impl Drop for Modbus {
    fn drop(&mut self) {
        self.shared.end_modbus();
        if let Some(thread) = self.thread.take() {
            // A panic was told already.
            let _ = thread.join();
        }
    }
}

/// Tells the shell of an end that nobody asked for.
struct Fails<'a>(&'a Shared);

impl Drop for Fails<'_> {
    fn drop(&mut self) {
        self.0.fail();
    }
}

/// What the thread has.
struct Connections {
    shared: Arc<Shared>,
    time: Time,
    poll: OwnedFd,
    peers: BTreeMap<ConnId, Peer>,
    /// Those that may have more to read.
    busy: VecDeque<ConnId>,
    /// Closed connections that still send, and until when: the oldest first.
    lingering: VecDeque<(ConnId, Instant)>,
    /// Connections that have ended without the controller's knowledge.
    gone: Vec<ConnId>,
    /// Whether the shell wants it to end.
    ends: bool,
    /// Empty, but for its memory.
    tasks: Vec<Task>,
    log_limit: LogLimit,
}

struct Peer {
    stream: TcpStream,
    address: SocketAddr,
    /// Answers that the socket has not accepted.
    out: Vec<u8>,
    /// Whether the socket may have bytes: it tells of new ones only once.
    is_readable: bool,
    /// Whether it is among those that get another turn.
    is_busy: bool,
    /// Whether it will tell of nothing more.
    is_hung_up: bool,
    is_closed: bool,
}

impl Connections {
    fn new(shared: Arc<Shared>, time: Time) -> io::Result<Self> {
        let poll = epoll::create(epoll::CreateFlags::CLOEXEC)?;
        epoll::add(&poll, shared.bell(), epoll::EventData::new_u64(BELL), epoll::EventFlags::IN)?;
        Ok(Self {
            shared,
            time,
            poll,
            peers: BTreeMap::new(),
            busy: VecDeque::new(),
            lingering: VecDeque::new(),
            gone: Vec::new(),
            ends: false,
            tasks: Vec::new(),
            log_limit: LogLimit::default(),
        })
    }

    fn run(&mut self) -> io::Result<()> {
        let mut events = Vec::with_capacity(EVENTS);
        for round in 1_u64.. {
            if round.is_multiple_of(ROUNDS) {
                // With SCHED_FIFO on a single processor, nobody else would run while clients never pause.
                std::thread::yield_now();
            }
            events.clear();
            let timeout = self.timeout();
            match epoll::wait(&self.poll, spare_capacity(&mut events), timeout.as_ref()) {
                Ok(_) | Err(Errno::INTR) => {}
                Err(error) => return Err(error.into()),
            }
            let waiting = self.busy.len();
            for event in &events {
                let (id, flags) = (event.data.u64(), event.flags);
                if id != BELL {
                    self.notice(ConnId(id), flags);
                } else {
                    self.answer_bell();
                }
            }
            for conn in self.busy.drain(..waiting).collect::<Vec<_>>() {
                if let Some(peer) = self.peers.get_mut(&conn) {
                    peer.is_busy = false;
                }
                self.serve(conn);
            }
            self.end_lingering();
            self.report_gone();
            if self.ends {
                break;
            }
        }
        Ok(())
    }

    /// How long to wait for events; `None`: until there is one.
    fn timeout(&self) -> Option<Timespec> {
        let wait = match (self.busy.is_empty(), self.lingering.front()) {
            (false, _) => Duration::ZERO,
            (true, Some(&(_, until))) => until.saturating_since(now()) + Duration::from_micros(1),
            (true, None) => return None,
        };
        let micros = wait.as_micros();
        Some(Timespec {
            tv_sec: i64::try_from(micros / 1_000_000).unwrap_or(i64::MAX),
            tv_nsec: i64::try_from(micros % 1_000_000 * 1_000).unwrap_or(0),
        })
    }

    /// Does what the shell has left to do.
    fn answer_bell(&mut self) {
        // Before the tasks are taken, so that a later ring is seen.
        let _ = rustix::io::read(self.shared.bell(), &mut [0; 8]);
        let mut tasks = std::mem::take(&mut self.tasks);
        self.shared.lock().take_tasks(&mut tasks);
        self.carry_out(tasks);
    }

    fn carry_out(&mut self, mut tasks: Vec<Task>) {
        for task in tasks.drain(..) {
            match task {
                Task::Open { conn, stream, peer } => self.open(conn, stream, peer),
                Task::Send { conn, bytes } => self.send(conn, &bytes),
                Task::Close { conn } => self.close(conn),
                Task::End => self.ends = true,
            }
        }
        self.tasks = tasks;
    }

    /// Reports an event to the controller, and does what it says.
    fn input(&mut self, input: ControllerInput<'_>) {
        let mut tasks = std::mem::take(&mut self.tasks);
        self.shared.handle_modbus(self.time, input, &mut tasks);
        self.carry_out(tasks);
    }

    /// Tells the controller which connections have ended.
    fn report_gone(&mut self) {
        while let Some(conn) = self.gone.pop() {
            if self.shared.lock().forget_modbus(conn) {
                self.input(ControllerInput::ModbusClosed { conn });
            }
        }
    }

    fn open(&mut self, conn: ConnId, stream: TcpStream, address: SocketAddr) {
        info!(link = ?Link::Modbus, peer = %address, conn = conn.0, "connected");
        let flags =
            epoll::EventFlags::IN | epoll::EventFlags::OUT | epoll::EventFlags::RDHUP | epoll::EventFlags::ET;
        let added = epoll::add(&self.poll, stream.as_fd(), epoll::EventData::new_u64(conn.0), flags);
        let peer = Peer {
            stream,
            address,
            out: Vec::new(),
            is_readable: false,
            is_busy: false,
            is_hung_up: false,
            is_closed: false,
        };
        self.peers.insert(conn, peer);
        if let Err(error) = added {
            self.end(conn, &Err(error.into()));
        }
    }

    fn notice(&mut self, conn: ConnId, flags: epoll::EventFlags) {
        let Some(peer) = self.peers.get_mut(&conn) else { return };
        let hung = epoll::EventFlags::RDHUP | epoll::EventFlags::HUP | epoll::EventFlags::ERR;
        peer.is_hung_up |= flags.intersects(hung);
        peer.is_readable |= flags.intersects(epoll::EventFlags::IN | hung);
        if !peer.out.is_empty() {
            match peer.flush() {
                Ok(()) if peer.is_closed && peer.out.is_empty() => self.end(conn, &Ok(())),
                Ok(()) => {}
                Err(error) => self.end(conn, &Err(error)),
            }
        }
        if self.peers.get(&conn).is_some_and(|peer| !peer.is_busy) {
            self.serve(conn);
        }
    }

    /// Reads once, and has what was read answered.
    fn serve(&mut self, conn: ConnId) {
        let Some(peer) = self.peers.get_mut(&conn) else { return };
        if !peer.is_readable || !peer.out.is_empty() || peer.is_closed {
            return;
        }
        let mut buf = [0; CHUNK];
        match peer.stream.read(&mut buf) {
            Ok(0) => self.end(conn, &Ok(())),
            Ok(count) => {
                // Less than there was room for was all there is.
                if count < CHUNK && !peer.is_hung_up {
                    peer.is_readable = false;
                } else {
                    peer.is_busy = true;
                    self.busy.push_back(conn);
                }
                if let Some(bytes) = buf.get(..count) {
                    self.input(ControllerInput::ModbusBytes { conn, bytes });
                }
            }
            Err(error) if error.kind() == ErrorKind::WouldBlock => peer.is_readable = false,
            Err(error) if error.kind() == ErrorKind::Interrupted => {
                peer.is_busy = true;
                self.busy.push_back(conn);
            }
            Err(error) => self.end(conn, &Err(error)),
        }
    }

    fn send(&mut self, conn: ConnId, bytes: &[u8]) {
        let Some(peer) = self.peers.get_mut(&conn).filter(|peer| !peer.is_closed) else { return };
        if let Err(error) = peer.send(bytes) {
            if let Some(more) = self.log_limit.allow(now()) {
                warn!(link = ?Link::Modbus, conn = conn.0, more, "disconnected: does not read what is sent");
            }
            self.shared.count(|counters| counters.slow_clients += 1);
            self.end(conn, &Err(error));
        }
    }

    /// Closes a connection after its waiting answers were sent. If too many are waiting for that, the oldest is
    /// cut.
    fn close(&mut self, conn: ConnId) {
        let Some(peer) = self.peers.get_mut(&conn) else { return };
        if peer.out.is_empty() {
            return self.end(conn, &Ok(()));
        }
        peer.is_closed = true;
        self.lingering.push_back((conn, now() + Duration::from_micros(LINGER.as_micros() as u64)));
        if self.lingering.len() > MAX_LINGERING
            && let Some((oldest, _)) = self.lingering.pop_front()
        {
            self.shared.count(|counters| counters.cut_answers += 1);
            self.end(oldest, &Ok(()));
        }
    }

    fn end_lingering(&mut self) {
        while let Some(&(conn, until)) = self.lingering.front()
            && until <= now()
        {
            self.end(conn, &Err(ErrorKind::TimedOut.into()));
        }
    }

    /// Closes a connection now.
    fn end(&mut self, conn: ConnId, ended: &io::Result<()>) {
        self.lingering.retain(|lingering| lingering.0 != conn);
        if let Some(peer) = self.peers.remove(&conn) {
            debug!(link = ?Link::Modbus, peer = %peer.address, conn = conn.0, ?ended, "disconnected");
            if !peer.is_closed {
                self.gone.push(conn);
            }
        }
    }
}

impl Peer {
    /// Sends bytes; at most [`MAX_UNSENT`] wait.
    fn send(&mut self, bytes: &[u8]) -> io::Result<()> {
        let sent = if self.out.is_empty() { self.write(bytes)? } else { 0 };
        let rest = bytes.get(sent..).unwrap_or(&[]);
        if self.out.len() + rest.len() > MAX_UNSENT {
            return Err(ErrorKind::StorageFull.into());
        }
        self.out.extend_from_slice(rest);
        Ok(())
    }

    fn flush(&mut self) -> io::Result<()> {
        let out = std::mem::take(&mut self.out);
        let sent = self.write(&out)?;
        // Otherwise the memory that a slow peer needed is released.
        if sent < out.len() {
            self.out = out;
            self.out.drain(..sent);
        }
        Ok(())
    }

    /// Writes until the socket accepts no more.
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        let mut sent = 0;
        while let Some(rest) = bytes.get(sent..).filter(|rest| !rest.is_empty()) {
            match self.stream.write(rest) {
                Ok(count) => sent += count,
                Err(error) if error.kind() == ErrorKind::WouldBlock => break,
                Err(error) if error.kind() == ErrorKind::Interrupted => {}
                Err(error) => return Err(error),
            }
        }
        Ok(sent)
    }
}

/// What epoll has for the shell's calls; no connection has this number.
const BELL: u64 = u64::MAX;
/// Events of one wait.
const EVENTS: usize = 128;
/// After so many rounds others may run.
const ROUNDS: u64 = 64;

#[cfg(test)]
#[path = "modbus_tests.rs"]
mod tests;
