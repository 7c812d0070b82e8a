//! Links over UDP.

use std::io;
use std::net::{IpAddr, SocketAddr};

use rustix::io::Errno;
use rustix::net::RecvFlags;
use tokio::net::UdpSocket;
use tracing::info;

use super::{Link, LinkEvent, Turn};
use recipe_net::turns::give_way;

impl Link<'_> {
    /// A socket of its own for each turn, connected to the controller's server.
    pub(super) async fn connect_udp(
        &self,
        turn: Turn,
        host: &str,
        port: u16,
        events: &mut impl FnMut(LinkEvent<'_>),
    ) -> io::Result<()> {
        let Some(socket) = self.while_open(turn, connect(host, port)).await? else { return Ok(()) };
        events(LinkEvent::Up);
        self.pump(turn, &socket, None, events).await
    }

    /// Waits for the controller's client, and answers where it sends from.
    pub(super) async fn await_udp(
        &self,
        turn: Turn,
        socket: &UdpSocket,
        controller: &str,
        is_frame: &dyn Fn(&[u8]) -> bool,
        events: &mut impl FnMut(LinkEvent<'_>),
    ) -> io::Result<()> {
        let first = self.while_open(turn, self.first_datagram(turn, socket, controller)).await?;
        let Some((peer, known, datagram)) = first else { return Ok(()) };
        info!(link = self.name, %peer, "the controller's first datagram");
        events(LinkEvent::Up);
        if !self.control.is_over(turn) {
            events(LinkEvent::Bytes(&datagram));
        }
        let client = Client { peer, known, is_frame };
        self.pump(turn, socket, Some(client), events).await
    }

    /// The controller's first datagram of this turn, where it came from, and the controller's addresses.
    async fn first_datagram(
        &self,
        turn: Turn,
        socket: &UdpSocket,
        controller: &str,
    ) -> io::Result<(SocketAddr, Vec<IpAddr>, Vec<u8>)> {
        let (known, is_late) = self.look_up(turn, controller).await?;
        if is_late {
            discard_waiting(socket);
        }
        let mut datagram = vec![0; MAX_DATAGRAM];
        for nth in 1_u64.. {
            let (len, peer) = socket.recv_from(&mut datagram).await?;
            if self.control.knows(self.name, &known, peer) {
                datagram.truncate(len);
                return Ok((peer, known, datagram));
            }
            take_turns(nth).await;
        }
        Err(io::ErrorKind::Interrupted.into())
    }

    /// Moves datagrams both ways until an error, or the turn is over.
    async fn pump(
        &self,
        turn: Turn,
        socket: &UdpSocket,
        mut client: Option<Client<'_>>,
        events: &mut impl FnMut(LinkEvent<'_>),
    ) -> io::Result<()> {
        let mut datagram = vec![0; MAX_DATAGRAM];
        let mut next = None;
        let mut reads = 0_u64;
        while !self.control.is_over(turn) {
            next = next.or_else(|| self.control.next());
            if let Some(bytes) = &next {
                let sent = match &client {
                    None => socket.try_send(bytes),
                    Some(client) => socket.try_send_to(bytes, client.peer),
                };
                match sent {
                    Ok(_) => {
                        next = None;
                        if self.control.waiting() == 0 {
                            events(LinkEvent::Sent);
                        }
                        continue;
                    }
                    Err(error) if error.kind() == io::ErrorKind::WouldBlock => {}
                    Err(error) => return Err(error),
                }
            }
            tokio::select! {
                received = receive(socket, client.is_some(), &mut datagram) => {
                    let (len, from) = received?;
                    let datagram = &datagram[..len];
                    let is_known = match (&mut client, from) {
                        (Some(client), Some(from)) => {
                            let is_known = self.control.knows(self.name, &client.known, from);
                            if is_known && (client.is_frame)(datagram) {
                                client.peer = from;
                            }
                            is_known
                        }
                        _ => true,
                    };
                    if is_known {
                        events(LinkEvent::Bytes(datagram));
                    }
                    reads += 1;
                    take_turns(reads).await;
                }
                ready = socket.writable(), if next.is_some() => ready?,
                () = self.control.changed.notified() => {}
            }
        }
        Ok(())
    }
}

/// The controller's client of a listening socket.
struct Client<'a> {
    /// Where its newest frame came from: there the answers go. What is no frame does not move it.
    peer: SocketAddr,
    known: Vec<IpAddr>,
    is_frame: &'a dyn Fn(&[u8]) -> bool,
}

async fn connect(host: &str, port: u16) -> io::Result<UdpSocket> {
    let peer = tokio::net::lookup_host((host, port)).await?.next();
    let peer = peer.ok_or_else(|| io::Error::new(io::ErrorKind::NotFound, "no such host"))?;
    let any: SocketAddr = if peer.is_ipv4() { ([0, 0, 0, 0], 0).into() } else { ([0_u16; 8], 0).into() };
    let socket = UdpSocket::bind(any).await?;
    socket.connect(peer).await?;
    Ok(socket)
}

/// The next datagram, and of a socket that is not connected where it came from.
async fn receive(
    socket: &UdpSocket,
    tells_sender: bool,
    datagram: &mut [u8],
) -> io::Result<(usize, Option<SocketAddr>)> {
    if tells_sender {
        let (len, from) = socket.recv_from(datagram).await?;
        Ok((len, Some(from)))
    } else {
        Ok((socket.recv(datagram).await?, None))
    }
}

/// Throws away what waits in the socket: nothing tells how old it is.
fn discard_waiting(socket: &UdpSocket) {
    for _ in 0..MOST_WAITING {
        // Asked of the system, since the reactor may not have looked yet. An error waited like a datagram.
        let discarded = rustix::net::recv(socket, &mut [0_u8; 1], RecvFlags::DONTWAIT | RecvFlags::TRUNC);
        if discarded == Err(Errno::AGAIN) {
            return;
        }
    }
}

/// However many datagrams there are, the others come first now and then.
async fn take_turns(nth: u64) {
    if nth.is_multiple_of(DATAGRAMS_AT_ONCE) {
        give_way().await;
    }
}

/// Most datagrams taken before the others have a turn.
const DATAGRAMS_AT_ONCE: u64 = 16;
/// Longer than any frame, so that a datagram that is too long is seen to be.
const MAX_DATAGRAM: usize = 2_048;
/// More datagrams than a socket's buffer holds: those behind them are not old.
const MOST_WAITING: usize = 4_096;
