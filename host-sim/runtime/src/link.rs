//! A link of the gateway to the controller, opened and closed as the engine decides.
//!
//! A link is one task. It owns its socket, reports what arrives, and sends what is in its outbox. It does not
//! know protocols. The engine supervises it: a link that fails reports it once and waits to be opened again.
//!
//! Data that waited in a socket while the link was closed is never reported, because its age is unknown.

mod outbox;
mod tcp;
mod udp;

use std::cell::{Cell, RefCell};
use std::io;
use std::net::{IpAddr, Ipv4Addr, Ipv6Addr, SocketAddr};
use std::time::Duration;

use serde::Serialize;
use tokio::net::{TcpListener, UdpSocket};
use tokio::sync::Notify;
use tokio::time::Instant;
use tracing::{debug, info, warn};

use recipe_doctor::Reach;
use recipe_io::connect::connect;
use recipe_io::fairness::yield_fairly;
use recipe_io::log_limit::LogLimit;
use recipe_io::timer::now;

use outbox::{DirectSocket, Outbox};

/// The other end of a link.
#[derive(Debug)]
pub(super) enum LinkEndpoint {
    /// The controller's TCP server.
    Tcp { host: String, port: u16 },
    /// The controller's UDP server.
    Udp { host: String, port: u16 },
    /// A server for the controller's TCP client; others are refused.
    TcpListen { listener: TcpListener, controller: String },
    /// A server for the controller's UDP client; others are ignored.
    UdpListen { socket: UdpSocket, controller: String },
}

#[derive(Debug)]
pub(super) enum LinkEvent<'a> {
    Up,
    Down,
    Bytes(&'a [u8]),
    /// The kernel has accepted everything sent so far.
    Sent,
    /// Number of bytes sent since the link came up that are not acknowledged.
    Acked(u32),
}

/// The engine's side of a link. It never waits.
#[derive(Debug, Default)]
pub(super) struct LinkControl {
    session: Cell<LinkSession>,
    outbox: RefCell<Outbox>,
    /// Bytes sent in this session.
    sent: Cell<u64>,
    changed: Notify,
    refusals: Cell<Refusals>,
    log_limit: LogLimit,
    /// How the newest attempt to reach the controller ended, and when; `None` while data comes.
    reach: RefCell<Option<(Instant, Reach)>>,
}

/// Counts openings and closings: odd while the link should be open.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
struct LinkSession(u64);

impl LinkSession {
    const FIRST: Self = Self(1);

    const fn is_open(self) -> bool {
        !self.0.is_multiple_of(2)
    }
}

/// Connections and datagrams that a listening link did not accept.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize)]
pub(super) struct Refusals {
    /// Connections and datagrams from other addresses than the controller's.
    pub(super) strangers: u64,
    /// Connections from the controller's address while there was one already, or while the link was closed.
    pub(super) refused: u64,
}

impl LinkControl {
    pub(super) fn open(&self) {
        if !self.session.get().is_open() {
            self.next_session();
        }
    }

    pub(super) fn close(&self) {
        if self.session.get().is_open() {
            self.next_session();
        }
    }

    /// Sends bytes at once if the kernel accepts them. The link's task reports that and sends the rest.
    pub(super) fn send(&self, bytes: &[u8]) {
        if self.outbox.borrow_mut().take(bytes) {
            self.sent.set(self.sent.get() + bytes.len() as u64);
        }
        self.changed.notify_one();
    }

    /// Counters of refused connections and datagrams.
    pub(super) fn refusals(&self) -> Refusals {
        self.refusals.get()
    }

    /// The result of a recent attempt to reach the controller.
    pub(super) fn reach(&self) -> Option<Reach> {
        let reach = self.reach.borrow();
        reach.as_ref().filter(|(at, _)| at.elapsed() < REACH_COUNTS).map(|(_, reach)| reach.clone())
    }

    fn note_reach(&self, reach: Reach) {
        self.reach.replace(Some((Instant::now(), reach)));
    }

    /// Data has arrived, so the controller is reachable.
    fn heard(&self) {
        if self.reach.borrow().is_some() {
            self.reach.replace(None);
        }
    }

    fn refuse(&self, name: &str, peer: SocketAddr, why: &str, count: impl FnOnce(&mut Refusals)) {
        let mut refusals = self.refusals.get();
        count(&mut refusals);
        self.refusals.set(refusals);
        if let Some(more) = self.log_limit.allow(now()) {
            warn!(link = name, %peer, more, "refused: {why}");
        }
    }

    /// Whether the peer is the controller, or a program on this host, which could connect to the controller as well.
    fn is_controller(&self, name: &str, controller: &[IpAddr], peer: SocketAddr) -> bool {
        let address = peer.ip().to_canonical();
        let known = controller.contains(&address) || THIS_HOST.contains(&address);
        if !known {
            let count = |refusals: &mut Refusals| refusals.strangers += 1;
            self.refuse(name, peer, "not controller.address", count);
        }
        known
    }

    fn next_session(&self) {
        self.session.set(LinkSession(self.session.get().0 + 1));
        self.outbox.take();
        self.sent.set(0);
        self.changed.notify_one();
    }

    /// Waits until the link should be open, and returns the session.
    async fn opened(&self) -> LinkSession {
        loop {
            let session = self.session.get();
            if session.is_open() {
                return session;
            }
            self.changed.notified().await;
        }
    }

    fn is_over(&self, session: LinkSession) -> bool {
        self.session.get() != session
    }

    /// Waits until this session is over. It consumes notifications, so nothing else may wait for them.
    async fn over(&self, session: LinkSession) {
        while !self.is_over(session) {
            self.changed.notified().await;
        }
    }

    /// Lets [`Self::send`] write to a socket of this session until the guard is dropped.
    fn lend(&self, socket: DirectSocket) -> Lent<'_> {
        self.outbox.borrow_mut().open(socket);
        Lent(self)
    }

    /// Datagrams go to this peer from now on.
    fn answer(&self, peer: SocketAddr) {
        self.outbox.borrow_mut().answer(peer);
    }

    /// Sends queued bytes as far as `write` accepts them. Returns true once each time everything has been sent.
    fn flush(&self, write: impl FnMut(&[u8]) -> io::Result<usize>) -> io::Result<bool> {
        self.outbox.borrow_mut().flush(write)
    }

    /// Number of bytes that the system has not accepted.
    fn waiting(&self) -> usize {
        self.outbox.borrow().waiting()
    }
}

/// A socket that [`LinkControl::send`] may use.
struct Lent<'a>(&'a LinkControl);

impl Drop for Lent<'_> {
    fn drop(&mut self) {
        self.0.outbox.borrow_mut().close();
    }
}

struct LinkTask<'a> {
    name: &'a str,
    control: &'a LinkControl,
}

/// Runs the link until the future is dropped. `is_frame` returns whether a datagram is a frame of the
/// controller's client.
pub(super) async fn run(
    name: &str,
    endpoint: &LinkEndpoint,
    control: &LinkControl,
    is_frame: impl Fn(&[u8]) -> bool,
    mut events: impl FnMut(LinkEvent<'_>),
) {
    let link = LinkTask { name, control };
    let mut events = |event: LinkEvent<'_>| {
        if let LinkEvent::Bytes(_) = event {
            control.heard();
        }
        events(event);
    };
    loop {
        let session = control.opened().await;
        let result = match endpoint {
            LinkEndpoint::Tcp { host, port } => link.connect_tcp(session, host, *port, &mut events).await,
            LinkEndpoint::TcpListen { listener, controller } => {
                link.accept_tcp(session, listener, controller, &mut events).await
            }
            LinkEndpoint::Udp { host, port } => link.connect_udp(session, host, *port, &mut events).await,
            LinkEndpoint::UdpListen { socket, controller } => {
                link.await_udp(session, socket, controller, &is_frame, &mut events).await
            }
        };
        // A session that is over was closed by the engine, which expects no report.
        if !control.is_over(session) {
            match result {
                Ok(()) => info!(link = name, "closed by the controller"),
                Err(error) => {
                    debug!(link = name, %error, "cannot connect");
                    control.note_reach(reach_of(&error));
                }
            }
            control.close();
            events(LinkEvent::Down);
        }
    }
}

/// Checks whether the controller is reachable without sending anything: connects and closes, or waits for its client.
pub(super) async fn probe(
    name: &str,
    endpoint: &LinkEndpoint,
    control: &LinkControl,
    is_frame: impl Fn(&[u8]) -> bool,
) {
    let link = LinkTask { name, control };
    let result = match endpoint {
        LinkEndpoint::Tcp { host, port } => {
            let connected = tokio::time::timeout(MAX_CONNECT, connect((host.as_str(), *port))).await;
            match connected {
                Ok(connected) => connected.map(|_| Reach::Reached),
                Err(_) => Ok(Reach::NoAnswer),
            }
        }
        LinkEndpoint::Udp { host, port } => {
            tokio::net::lookup_host((host.as_str(), *port)).await.map(|_| Reach::Untried)
        }
        LinkEndpoint::TcpListen { listener, controller } => link.await_client(listener, controller).await,
        LinkEndpoint::UdpListen { socket, controller } => {
            link.await_frame(socket, controller, is_frame).await
        }
    };
    let reach = result.unwrap_or_else(|error| reach_of(&error));
    control.reach.replace(Some((Instant::now() + REACH_STAYS, reach)));
}

fn reach_of(error: &io::Error) -> Reach {
    match error.kind() {
        io::ErrorKind::ConnectionRefused => Reach::Refused,
        io::ErrorKind::TimedOut => Reach::NoAnswer,
        io::ErrorKind::NotFound => Reach::NoSuchHost,
        _ if error.to_string().starts_with("failed to lookup") => Reach::NoSuchHost,
        _ => Reach::Failed(error.to_string()),
    }
}

impl LinkTask<'_> {
    /// Waits until the controller's client connects.
    async fn await_client(&self, listener: &TcpListener, controller: &str) -> io::Result<Reach> {
        let (known, _) = self.look_up(LinkSession::FIRST, controller).await?;
        loop {
            let (_, peer) = listener.accept().await?;
            if self.control.is_controller(self.name, &known, peer) {
                return Ok(Reach::Reached);
            }
            yield_fairly().await;
        }
    }

    /// Waits until the controller's client sends a frame.
    async fn await_frame(
        &self,
        socket: &UdpSocket,
        controller: &str,
        is_frame: impl Fn(&[u8]) -> bool,
    ) -> io::Result<Reach> {
        let (known, _) = self.look_up(LinkSession::FIRST, controller).await?;
        let mut datagram = [0; 2_048];
        loop {
            let (len, peer) = socket.recv_from(&mut datagram).await?;
            if self.control.is_controller(self.name, &known, peer) && is_frame(&datagram[..len]) {
                return Ok(Reach::Reached);
            }
            yield_fairly().await;
        }
    }

    /// The result of `opening`; `None` if the session is over, even if both happen together.
    async fn while_open<T>(
        &self,
        session: LinkSession,
        opening: impl Future<Output = io::Result<T>>,
    ) -> io::Result<Option<T>> {
        let opened = tokio::select! {
            opened = opening => opened?,
            () = self.control.over(session) => return Ok(None),
        };
        Ok((!self.control.is_over(session)).then_some(opened))
    }

    /// The controller's addresses, and whether data at a listening socket may be from before this session. In
    /// the first session it is not: the gateway has just started.
    async fn look_up(&self, session: LinkSession, controller: &str) -> io::Result<(Vec<IpAddr>, bool)> {
        let began = Instant::now();
        let found = tokio::net::lookup_host((controller, 0)).await?;
        let known = found.map(|address| address.ip().to_canonical()).collect();
        Ok((known, session != LinkSession::FIRST || began.elapsed() >= MAX_LOOKUP))
    }
}

/// The default source addresses of programs on this host.
const THIS_HOST: [IpAddr; 2] = [IpAddr::V4(Ipv4Addr::LOCALHOST), IpAddr::V6(Ipv6Addr::LOCALHOST)];
/// How long a controller may take to accept a connection; the same as in the engine.
const MAX_CONNECT: Duration = Duration::from_secs(2);
/// How long the result of an attempt counts. A working link is not tried again.
const REACH_COUNTS: Duration = Duration::from_secs(10);
/// The same for a probe, which makes only one attempt.
const REACH_STAYS: Duration = Duration::from_secs(365 * 24 * 3_600);
/// If the name lookup takes longer, data that waited meanwhile is old.
const MAX_LOOKUP: Duration = Duration::from_millis(100);

#[cfg(test)]
#[path = "link_tests.rs"]
mod tests;
