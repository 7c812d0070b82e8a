//! One link of the gateway to the controller: opened, closed and fed as the engine says.
//!
//! A link is one task. It owns its socket, hands what arrives to the gateway and sends what is in
//! its outbox; it knows no protocol and makes no decision. Supervision is the engine's: a link that
//! fails says so once and waits to be opened again.
//!
//! What waited in a socket while its link was closed is never reported: nothing tells how old it is.

mod tcp;
mod udp;

use std::cell::{Cell, RefCell};
use std::collections::VecDeque;
use std::io;
use std::net::{IpAddr, Ipv4Addr, Ipv6Addr, SocketAddr};
use std::time::Duration;

use serde::Serialize;
use tokio::net::{TcpListener, UdpSocket};
use tokio::sync::Notify;
use tokio::time::Instant;
use tracing::{debug, info, warn};

use recipe_net::quota::Quota;
use recipe_net::timer::now;

/// What a link connects to.
#[derive(Debug)]
pub(super) enum Endpoint {
    /// The controller's TCP server.
    Tcp { host: String, port: u16 },
    /// The controller's UDP server.
    Udp { host: String, port: u16 },
    /// Where the controller's TCP client connects to. Nobody else does.
    TcpListen { listener: TcpListener, controller: String },
    /// Where the controller's UDP client sends to. Nobody else does.
    UdpListen { socket: UdpSocket, controller: String },
}

/// What a link tells the gateway.
#[derive(Debug)]
pub(super) enum LinkEvent<'a> {
    Up,
    Down,
    Bytes(&'a [u8]),
    /// Everything that was handed over was taken by the system.
    Sent,
    /// Of the bytes that were handed over since the link came up, so many are not acknowledged.
    Acked(u32),
}

/// The engine's side of a link: never waits.
#[derive(Debug, Default)]
pub(super) struct LinkControl {
    turn: Cell<Turn>,
    outbox: RefCell<VecDeque<Vec<u8>>>,
    /// Bytes that were handed over in this turn.
    handed: Cell<u64>,
    changed: Notify,
    turned_away: Cell<TurnedAway>,
    complaints: Quota,
}

/// One more for each opening and closing: odd while the link is to be open.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
struct Turn(u64);

impl Turn {
    const FIRST: Self = Self(1);

    const fn is_open(self) -> bool {
        !self.0.is_multiple_of(2)
    }
}

/// Who came to a listening link and was not taken.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize)]
pub(super) struct TurnedAway {
    /// Connections and datagrams from other addresses than the controller's.
    pub(super) strangers: u64,
    /// Connections of the controller's address while there was one, or while the link was closed.
    pub(super) refused: u64,
}

/// One transmission is in flight at a time, so this is never reached by a living link.
const MAX_QUEUED: usize = 8;

impl LinkControl {
    pub(super) fn open(&self) {
        if !self.turn.get().is_open() {
            self.turn_over();
        }
    }

    pub(super) fn close(&self) {
        if self.turn.get().is_open() {
            self.turn_over();
        }
    }

    pub(super) fn send(&self, bytes: &[u8]) {
        let mut outbox = self.outbox.borrow_mut();
        if outbox.len() < MAX_QUEUED {
            self.handed.set(self.handed.get() + bytes.len() as u64);
            outbox.push_back(bytes.to_vec());
        }
        self.changed.notify_one();
    }

    /// Who was not taken so far.
    pub(super) fn turned_away(&self) -> TurnedAway {
        self.turned_away.get()
    }

    fn turn_away(&self, name: &str, peer: SocketAddr, why: &str, count: impl FnOnce(&mut TurnedAway)) {
        let mut turned_away = self.turned_away.get();
        count(&mut turned_away);
        self.turned_away.set(turned_away);
        if let Some(more) = self.complaints.take(now()) {
            warn!(link = name, %peer, more, "refused: {why}");
        }
    }

    /// Whether it is the controller that came, or somebody on this host, who could speak to the controller as
    /// well.
    fn knows(&self, name: &str, controller: &[IpAddr], peer: SocketAddr) -> bool {
        let address = peer.ip().to_canonical();
        let known = controller.contains(&address) || THIS_HOST.contains(&address);
        if !known {
            let count = |turned_away: &mut TurnedAway| turned_away.strangers += 1;
            self.turn_away(name, peer, "not controller.address", count);
        }
        known
    }

    fn turn_over(&self) {
        self.turn.set(Turn(self.turn.get().0 + 1));
        self.outbox.borrow_mut().clear();
        self.handed.set(0);
        self.changed.notify_one();
    }

    /// Waits until the link is to be open; the turn it is.
    async fn opened(&self) -> Turn {
        loop {
            let turn = self.turn.get();
            if turn.is_open() {
                return turn;
            }
            self.changed.notified().await;
        }
    }

    fn is_over(&self, turn: Turn) -> bool {
        self.turn.get() != turn
    }

    /// Waits until this turn is over. Eats notifications, so nothing else may wait for them.
    async fn over(&self, turn: Turn) {
        while !self.is_over(turn) {
            self.changed.notified().await;
        }
    }

    /// The next transmission.
    fn next(&self) -> Option<Vec<u8>> {
        self.outbox.borrow_mut().pop_front()
    }

    /// Bytes of the transmissions that nobody has taken up.
    fn waiting(&self) -> usize {
        self.outbox.borrow().iter().map(Vec::len).sum()
    }
}

/// What a link's task works with.
struct Link<'a> {
    name: &'a str,
    control: &'a LinkControl,
}

/// Drives the link until the future is dropped. `is_frame` tells whether a datagram is one that the
/// controller's client sends.
pub(super) async fn run(
    name: &str,
    endpoint: &Endpoint,
    control: &LinkControl,
    is_frame: impl Fn(&[u8]) -> bool,
    mut events: impl FnMut(LinkEvent<'_>),
) {
    let link = Link { name, control };
    loop {
        let turn = control.opened().await;
        let result = match endpoint {
            Endpoint::Tcp { host, port } => link.connect_tcp(turn, host, *port, &mut events).await,
            Endpoint::TcpListen { listener, controller } => {
                link.accept_tcp(turn, listener, controller, &mut events).await
            }
            Endpoint::Udp { host, port } => link.connect_udp(turn, host, *port, &mut events).await,
            Endpoint::UdpListen { socket, controller } => {
                link.await_udp(turn, socket, controller, &is_frame, &mut events).await
            }
        };
        // A turn that is over was ended by the engine: it expects no report.
        if !control.is_over(turn) {
            match result {
                Ok(()) => info!(link = name, "closed by the controller"),
                Err(error) => debug!(link = name, %error, "cannot connect"),
            }
            control.close();
            events(LinkEvent::Down);
        }
    }
}

impl Link<'_> {
    /// What `opening` gives; `None` when the turn is over, even if both happen in one moment.
    async fn while_open<T>(
        &self,
        turn: Turn,
        opening: impl Future<Output = io::Result<T>>,
    ) -> io::Result<Option<T>> {
        let opened = tokio::select! {
            opened = opening => opened?,
            () = self.control.over(turn) => return Ok(None),
        };
        Ok((!self.control.is_over(turn)).then_some(opened))
    }

    /// The controller's addresses, and whether what waits at a listening socket may be from before this
    /// opening. What came before the first one came while the gateway started.
    async fn look_up(&self, turn: Turn, controller: &str) -> io::Result<(Vec<IpAddr>, bool)> {
        let began = Instant::now();
        let found = tokio::net::lookup_host((controller, 0)).await?;
        let known = found.map(|address| address.ip().to_canonical()).collect();
        Ok((known, turn != Turn::FIRST || began.elapsed() >= FRESH))
    }
}

/// Where a process of this host comes from when it does not choose.
const THIS_HOST: [IpAddr; 2] = [IpAddr::V4(Ipv4Addr::LOCALHOST), IpAddr::V6(Ipv6Addr::LOCALHOST)];
/// A name that takes longer to look up than this makes what waits meanwhile old.
const FRESH: Duration = Duration::from_millis(100);

#[cfg(test)]
#[path = "link_tests.rs"]
mod tests;
