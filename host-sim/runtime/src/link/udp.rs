//! Links over UDP.

use std::io;
use std::net::{IpAddr, SocketAddr};

use rustix::io::Errno;
use rustix::net::RecvFlags;
use tokio::net::UdpSocket;
use tracing::info;

use super::outbox::DirectSocket;
use super::{LinkEvent, LinkSession, LinkTask};
use recipe_io::fairness::yield_fairly;

impl LinkTask<'_> {
    /// Opens a socket for this session, connected to the controller's server.
    pub(super) async fn connect_udp(
        &self,
        session: LinkSession,
        host: &str,
        port: u16,
        events: &mut impl FnMut(LinkEvent<'_>),
    ) -> io::Result<()> {
        let Some(socket) = self.while_open(session, connect(host, port)).await? else { return Ok(()) };
        events(LinkEvent::Up);
        self.pump(session, &socket, None, events).await
    }

    /// Waits for the controller's client, and sends to the address that it sends from.
    pub(super) async fn await_udp(
        &self,
        session: LinkSession,
        socket: &UdpSocket,
        controller: &str,
        is_frame: &dyn Fn(&[u8]) -> bool,
        events: &mut impl FnMut(LinkEvent<'_>),
    ) -> io::Result<()> {
        let first = self.while_open(session, self.first_datagram(session, socket, controller)).await?;
        let Some((peer, known, datagram)) = first else { return Ok(()) };
        info!(link = self.name, %peer, "the controller's first datagram");
        events(LinkEvent::Up);
        if !self.control.is_over(session) {
            events(LinkEvent::Bytes(&datagram));
        }
        let client = UdpPeer { peer, known, is_frame };
        self.pump(session, socket, Some(client), events).await
    }

    /// The controller's first datagram of this session: its sender, the controller's addresses, and the datagram.
    async fn first_datagram(
        &self,
        session: LinkSession,
        socket: &UdpSocket,
        controller: &str,
    ) -> io::Result<(SocketAddr, Vec<IpAddr>, Vec<u8>)> {
        let (known, is_late) = self.look_up(session, controller).await?;
        if is_late {
            discard_waiting(socket);
        }
        let mut datagram = vec![0; MAX_DATAGRAM];
        for nth in 1_u64.. {
            let (len, peer) = socket.recv_from(&mut datagram).await?;
            if self.control.is_controller(self.name, &known, peer) {
                datagram.truncate(len);
                return Ok((peer, known, datagram));
            }
            yield_sometimes(nth).await;
        }
        Err(io::ErrorKind::Interrupted.into())
    }

    /// Moves datagrams in both directions until an error, or the end of the session.
    async fn pump(
        &self,
        session: LinkSession,
        socket: &UdpSocket,
        mut client: Option<UdpPeer<'_>>,
        events: &mut impl FnMut(LinkEvent<'_>),
    ) -> io::Result<()> {
        let _lent = self.control.lend(DirectSocket::new(socket, client.as_ref().map(|client| client.peer))?);
        let mut datagram = vec![0; MAX_DATAGRAM];
        let mut reads = 0_u64;
        while !self.control.is_over(session) {
            let peer = client.as_ref().map(|client| client.peer);
            let is_sent = self.control.flush(|bytes| match peer {
                None => socket.try_send(bytes),
                Some(peer) => socket.try_send_to(bytes, peer),
            })?;
            if is_sent {
                events(LinkEvent::Sent);
                continue;
            }
            tokio::select! {
                received = receive(socket, client.is_some(), &mut datagram) => {
                    let (len, from) = received?;
                    let datagram = &datagram[..len];
                    let is_known = match (&mut client, from) {
                        (Some(client), Some(from)) => {
                            let is_known = self.control.is_controller(self.name, &client.known, from);
                            if is_known && (client.is_frame)(datagram) {
                                client.peer = from;
                                self.control.answer(from);
                            }
                            is_known
                        }
                        _ => true,
                    };
                    if is_known {
                        events(LinkEvent::Bytes(datagram));
                    }
                    reads += 1;
                    yield_sometimes(reads).await;
                }
                ready = socket.writable(), if self.control.waiting() > 0 => ready?,
                () = self.control.changed.notified() => {}
            }
        }
        Ok(())
    }
}

struct UdpPeer<'a> {
    /// The sender of the newest frame, which gets the replies. Other datagrams do not change it.
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

/// The next datagram, with its sender if the socket is not connected.
async fn receive(
    socket: &UdpSocket,
    wants_sender: bool,
    datagram: &mut [u8],
) -> io::Result<(usize, Option<SocketAddr>)> {
    if wants_sender {
        let (len, from) = socket.recv_from(datagram).await?;
        Ok((len, Some(from)))
    } else {
        Ok((socket.recv(datagram).await?, None))
    }
}

/// Drops datagrams that wait in the socket, because their age is unknown.
fn discard_waiting(socket: &UdpSocket) {
    for _ in 0..MAX_WAITING {
        // A system call, because the reactor may not have polled the socket yet. An error counts as a datagram.
        let discarded = rustix::net::recv(socket, &mut [0_u8; 1], RecvFlags::DONTWAIT | RecvFlags::TRUNC);
        if discarded == Err(Errno::AGAIN) {
            return;
        }
    }
}

/// Lets other tasks run after every few datagrams.
async fn yield_sometimes(nth: u64) {
    if nth.is_multiple_of(DATAGRAMS_AT_ONCE) {
        yield_fairly().await;
    }
}

/// Number of datagrams before other tasks run.
const DATAGRAMS_AT_ONCE: u64 = 16;
/// Longer than any frame, so that a datagram that is too long is recognised.
const MAX_DATAGRAM: usize = 2_048;
/// More than a socket's buffer holds: datagrams after these are not old.
const MAX_WAITING: usize = 4_096;
