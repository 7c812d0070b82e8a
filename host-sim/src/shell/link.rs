//! One link of the gateway to the controller: opened, closed and fed as the engine says.
//!
//! A link is one task. It owns its socket, hands what arrives to the gateway and sends what is in
//! its outbox; it knows no protocol and makes no decision. Supervision is the engine's: a link that
//! fails says so once and waits to be opened again.

use std::cell::{Cell, RefCell};
use std::collections::VecDeque;
use std::io;
use std::net::{IpAddr, Ipv4Addr, Ipv6Addr, SocketAddr};

use serde::Serialize;
use tokio::io::{AsyncReadExt, AsyncWriteExt};
use tokio::net::{TcpListener, TcpStream, UdpSocket};
use tokio::sync::Notify;
use tracing::{debug, info, warn};

use crate::bus::connect::connect;
use crate::bus::peer;
use crate::bus::quota::Quota;
use crate::bus::timer::now;
use crate::bus::turns::give_way;

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
    Sent,
}

/// The engine's side of a link: never waits.
#[derive(Debug, Default)]
pub(super) struct LinkControl {
    /// Odd while the link is to be open; one more for each opening and closing.
    turn: Cell<u64>,
    outbox: RefCell<VecDeque<Vec<u8>>>,
    changed: Notify,
    turned_away: Cell<TurnedAway>,
    complaints: Quota,
}

/// Who came to a listening link and was not taken.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize)]
pub(super) struct TurnedAway {
    /// Connections and datagrams from other addresses than the controller's.
    pub(super) strangers: u64,
    /// Connections of the controller's address while there was one.
    pub(super) refused: u64,
}

/// One transmission is in flight at a time, so this is never reached by a living link.
const MAX_QUEUED: usize = 8;

impl LinkControl {
    pub(super) fn open(&self) {
        if self.turn.get().is_multiple_of(2) {
            self.turn_over();
        }
    }

    pub(super) fn close(&self) {
        if !self.turn.get().is_multiple_of(2) {
            self.turn_over();
        }
    }

    pub(super) fn send(&self, bytes: &[u8]) {
        let mut outbox = self.outbox.borrow_mut();
        if outbox.len() < MAX_QUEUED {
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
            warn!(link = name, %peer, more, "turned away: {why}");
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
        self.turn.set(self.turn.get() + 1);
        self.outbox.borrow_mut().clear();
        self.changed.notify_one();
    }

    /// Waits until the link is to be open; the turn it is.
    async fn opened(&self) -> u64 {
        loop {
            let turn = self.turn.get();
            if !turn.is_multiple_of(2) {
                return turn;
            }
            self.changed.notified().await;
        }
    }

    /// Waits until this turn is over. Eats notifications, so nothing else may wait for them.
    async fn over(&self, turn: u64) {
        while self.turn.get() == turn {
            self.changed.notified().await;
        }
    }

    /// The next transmission; `None` when this turn is over.
    async fn next(&self, turn: u64) -> Option<Vec<u8>> {
        loop {
            if self.turn.get() != turn {
                return None;
            }
            if let Some(bytes) = self.outbox.borrow_mut().pop_front() {
                return Some(bytes);
            }
            self.changed.notified().await;
        }
    }
}

/// Drives the link until the future is dropped.
pub(super) async fn run(
    name: &str,
    endpoint: &Endpoint,
    control: &LinkControl,
    mut events: impl FnMut(LinkEvent<'_>),
) {
    loop {
        let turn = control.opened().await;
        let result = match endpoint {
            Endpoint::Tcp { host, port } => {
                let connected = tokio::select! {
                    connected = connect((host.as_str(), *port)) => connected,
                    () = control.over(turn) => continue,
                };
                match connected {
                    Ok(stream) => pump_tcp(name, stream, None, control, turn, &mut events).await,
                    Err(error) => Err(error),
                }
            }
            Endpoint::TcpListen { listener, controller } => {
                let accepted = tokio::select! {
                    accepted = accept(name, listener, controller, control) => accepted,
                    () = control.over(turn) => continue,
                };
                match accepted {
                    Ok((stream, known)) => {
                        let others = Some((listener, &known[..]));
                        pump_tcp(name, stream, others, control, turn, &mut events).await
                    }
                    Err(error) => Err(error),
                }
            }
            Endpoint::Udp { host, port } => {
                let connected = tokio::select! {
                    connected = connect_udp(host, *port) => connected,
                    () = control.over(turn) => continue,
                };
                match connected {
                    Ok(socket) => {
                        events(LinkEvent::Up);
                        pump_udp(name, &socket, None, control, turn, &mut events).await
                    }
                    Err(error) => Err(error),
                }
            }
            Endpoint::UdpListen { socket, controller } => {
                let received = tokio::select! {
                    received = first_datagram(name, socket, controller, control) => received,
                    () = control.over(turn) => continue,
                };
                match received {
                    Ok((peer, known, datagram)) => {
                        info!(link = name, %peer, "the controller sends");
                        events(LinkEvent::Up);
                        events(LinkEvent::Bytes(&datagram));
                        let from = Some((peer, &known[..]));
                        pump_udp(name, socket, from, control, turn, &mut events).await
                    }
                    Err(error) => Err(error),
                }
            }
        };
        // A turn that is over was ended by the engine: it expects no report.
        if control.turn.get() == turn {
            match result {
                Ok(()) => info!(link = name, "closed by the controller"),
                Err(error) => debug!(link = name, %error, "not connected"),
            }
            control.close();
            events(LinkEvent::Down);
        }
    }
}

/// Moves bytes both ways until the peer closes, an error, or the turn is over.
async fn pump_tcp(
    name: &str,
    stream: TcpStream,
    others: Option<(&TcpListener, &[IpAddr])>,
    control: &LinkControl,
    turn: u64,
    events: &mut impl FnMut(LinkEvent<'_>),
) -> io::Result<()> {
    peer::watch(&stream);
    events(LinkEvent::Up);
    let (mut reader, mut writer) = stream.into_split();
    let events = RefCell::new(events);
    let reading = async {
        let mut chunk = vec![0; CHUNK];
        loop {
            match reader.read(&mut chunk).await? {
                0 => return Ok(()),
                len if control.turn.get() == turn => {
                    (events.borrow_mut())(LinkEvent::Bytes(&chunk[..len]));
                    if len == CHUNK {
                        give_way().await;
                    }
                }
                _ => return Ok(()),
            }
        }
    };
    let writing = async {
        while let Some(bytes) = control.next(turn).await {
            tokio::select! {
                written = writer.write_all(&bytes) => written?,
                // A peer that takes nothing must not keep the link from being closed.
                () = control.over(turn) => return Ok(()),
            }
            if control.turn.get() == turn {
                (events.borrow_mut())(LinkEvent::Sent);
            }
        }
        Ok(())
    };
    let done = tokio::select! {
        done = reading => done,
        done = writing => done,
        () = refuse_others(name, others, control) => Ok(()),
    };
    if control.turn.get() != turn {
        // The engine has given the connection up. What the peer has not got yet would otherwise still be
        // delivered when a pulled cable is plugged in again, after newer values.
        writer.as_ref().set_zero_linger()?;
    }
    done
}

/// The next connection of the controller, and its addresses.
async fn accept(
    name: &str,
    listener: &TcpListener,
    controller: &str,
    control: &LinkControl,
) -> io::Result<(TcpStream, Vec<IpAddr>)> {
    let known = addresses_of(controller).await?;
    loop {
        let (stream, peer) = listener.accept().await?;
        if control.knows(name, &known, peer) {
            info!(link = name, %peer, "the controller connected");
            return Ok((stream, known));
        }
        drop(stream);
        give_way().await;
    }
}

/// A second client of a listening link is turned away: one connection carries one recipe.
async fn refuse_others(name: &str, others: Option<(&TcpListener, &[IpAddr])>, control: &LinkControl) {
    let Some((listener, known)) = others else { return std::future::pending().await };
    loop {
        match listener.accept().await {
            Ok((stream, peer)) => {
                drop(stream);
                if control.knows(name, known, peer) {
                    let count = |turned_away: &mut TurnedAway| turned_away.refused += 1;
                    control.turn_away(name, peer, "there is a connection already", count);
                }
                give_way().await;
            }
            // Out of descriptors, most likely: they come back when connections end.
            Err(_) => tokio::time::sleep(std::time::Duration::from_millis(100)).await,
        }
    }
}

async fn addresses_of(host: &str) -> io::Result<Vec<IpAddr>> {
    Ok(tokio::net::lookup_host((host, 0)).await?.map(|address| address.ip().to_canonical()).collect())
}

async fn connect_udp(host: &str, port: u16) -> io::Result<UdpSocket> {
    let peer = tokio::net::lookup_host((host, port)).await?.next();
    let peer = peer.ok_or_else(|| io::Error::new(io::ErrorKind::NotFound, "no such host"))?;
    let any: SocketAddr = if peer.is_ipv4() { ([0, 0, 0, 0], 0).into() } else { ([0_u16; 8], 0).into() };
    let socket = UdpSocket::bind(any).await?;
    socket.connect(peer).await?;
    Ok(socket)
}

/// The controller's first datagram, where it came from, and the controller's addresses.
async fn first_datagram(
    name: &str,
    socket: &UdpSocket,
    controller: &str,
    control: &LinkControl,
) -> io::Result<(SocketAddr, Vec<IpAddr>, Vec<u8>)> {
    let known = addresses_of(controller).await?;
    let mut datagram = vec![0; MAX_DATAGRAM];
    for nth in 1_u64.. {
        let (len, peer) = socket.recv_from(&mut datagram).await?;
        if control.knows(name, &known, peer) {
            datagram.truncate(len);
            return Ok((peer, known, datagram));
        }
        take_turns(nth).await;
    }
    Err(io::ErrorKind::Interrupted.into())
}

/// However many datagrams there are, the others come first now and then.
async fn take_turns(nth: u64) {
    if nth.is_multiple_of(DATAGRAMS_AT_ONCE) {
        give_way().await;
    }
}

/// Moves datagrams both ways; of a listening socket, answers where the controller sent from last.
async fn pump_udp(
    name: &str,
    socket: &UdpSocket,
    from: Option<(SocketAddr, &[IpAddr])>,
    control: &LinkControl,
    turn: u64,
    events: &mut impl FnMut(LinkEvent<'_>),
) -> io::Result<()> {
    let peer = Cell::new(from.map(|(peer, _)| peer));
    let events = RefCell::new(events);
    let reading = async {
        let mut datagram = vec![0; MAX_DATAGRAM];
        for nth in 1_u64.. {
            take_turns(nth).await;
            let len = match from {
                None => socket.recv(&mut datagram).await?,
                Some((_, known)) => {
                    let (len, from) = socket.recv_from(&mut datagram).await?;
                    if !control.knows(name, known, from) {
                        continue;
                    }
                    peer.set(Some(from));
                    len
                }
            };
            if control.turn.get() != turn {
                return Ok(());
            }
            (events.borrow_mut())(LinkEvent::Bytes(&datagram[..len]));
        }
        Ok(())
    };
    let writing = async {
        while let Some(bytes) = control.next(turn).await {
            match peer.get() {
                None => socket.send(&bytes).await?,
                Some(peer) => socket.send_to(&bytes, peer).await?,
            };
            if control.turn.get() == turn {
                (events.borrow_mut())(LinkEvent::Sent);
            }
        }
        Ok(())
    };
    tokio::select! {
        done = reading => done,
        done = writing => done,
    }
}

/// Where a process of this host comes from when it does not choose.
const THIS_HOST: [IpAddr; 2] = [IpAddr::V4(Ipv4Addr::LOCALHOST), IpAddr::V6(Ipv6Addr::LOCALHOST)];
/// Most bytes read at once.
const CHUNK: usize = 2_048;
/// Most datagrams taken before the others have a turn.
const DATAGRAMS_AT_ONCE: u64 = 16;
/// Longer than any frame, so that a datagram that is too long is seen to be.
const MAX_DATAGRAM: usize = 2048;

#[cfg(test)]
#[path = "link_tests.rs"]
mod tests;
