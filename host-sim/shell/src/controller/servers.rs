//! The controller's servers: connections and datagrams that come in.

use std::io;
use std::net::SocketAddr;
use std::rc::Rc;
use std::time::Duration as StdDuration;

use rustix::net::sockopt;
use tokio::net::{TcpListener, TcpStream};
use tokio::task::spawn_local;
use tracing::{debug, info, warn};

use super::{Client, ControllerShell, Report, closed};
use crate::tcp::{Connection, Event};
use crate::udp;
use recipe_controller::{ConnId, ControllerInput, Link};
use recipe_net::peer;
use recipe_net::timer::now;
use recipe_net::turns::give_way;

impl ControllerShell {
    /// Takes the connections of one TCP server.
    pub(super) async fn serve(self: Rc<Self>, link: Link, listener: TcpListener) {
        peer::bound(&listener);
        loop {
            match listener.accept().await {
                Ok((stream, peer)) => {
                    self.take(link, stream, peer);
                    give_way().await;
                }
                Err(error) => {
                    self.count(|counters| counters.accept_failures += 1);
                    if let Some(more) = self.complaints.take(now()) {
                        warn!(?link, %error, more, "cannot accept a connection");
                    }
                    tokio::time::sleep(StdDuration::from_millis(50)).await;
                }
            }
        }
    }

    fn take(self: &Rc<Self>, link: Link, stream: TcpStream, peer: SocketAddr) {
        let conn = ConnId(self.next_connection.get());
        self.next_connection.set(conn.0 + 1);
        match link {
            // What waits in the system is old when it is read: a second's worth is enough.
            Link::State => drop(sockopt::set_socket_send_buffer_size(&stream, STATE_BUFFER)),
            Link::Command | Link::Modbus => peer::give_up_after(&stream, ANSWER_PATIENCE),
        }
        peer::watch(&stream);
        let (connection, read) = Connection::split(stream);
        let client = Client { link, connection: Rc::clone(&connection), subscribed: false };
        self.connections.borrow_mut().insert(conn, client);
        // An IPv4 address is the same host however the listener names it.
        let from = peer.ip().to_canonical();
        self.input(match link {
            Link::Command => ControllerInput::CommandOpened { conn, from },
            Link::State => ControllerInput::StateOpened { conn, from },
            Link::Modbus => ControllerInput::ModbusOpened { conn, from },
        });
        if let Some(client) = self.connections.borrow_mut().get_mut(&conn) {
            client.subscribed = link == Link::State;
        }
        if connection.is_closed() {
            if let Some(more) = self.refusals.take(now()) {
                warn!(?link, %peer, more, "refused");
            }
            return;
        }
        info!(?link, %peer, conn = conn.0, "connected");
        let shell = Rc::clone(self);
        spawn_local(async move {
            let ended = connection.run(read, |event| {
                // After a close nothing more is reported.
                if let Event::Bytes(bytes) = event
                    && !connection.is_closed()
                {
                    match link {
                        Link::Command => shell.input(ControllerInput::CommandBytes { conn, bytes }),
                        Link::Modbus => shell.input(ControllerInput::ModbusBytes { conn, bytes }),
                        // Port 2001 only speaks.
                        Link::State => {}
                    }
                }
            });
            let ended = ended.await;
            shell.lingering.borrow_mut().retain(|other| !Rc::ptr_eq(other, &connection));
            debug!(?link, %peer, conn = conn.0, ?ended, "disconnected");
            let known = shell.connections.borrow_mut().remove(&conn).is_some();
            if known {
                shell.input(closed(link, conn));
            }
        });
    }

    /// Takes the datagrams of port 2011, and the errors that ours provoked.
    pub(super) async fn serve_udp(self: Rc<Self>) {
        let mut buf = [0; 2_048];
        for nth in 1_u64.. {
            if nth.is_multiple_of(DATAGRAMS_AT_ONCE) {
                give_way().await;
            }
            match self.udp.recv_from(&mut buf).await {
                Ok((count, peer)) => self.input(ControllerInput::Udp2011 { peer, bytes: &buf[..count] }),
                Err(_) => {
                    for peer in udp::unreachable_peers(&self.udp) {
                        self.input(ControllerInput::Udp2011Unreachable { peer });
                    }
                }
            }
        }
    }

    /// Sends a datagram from port 2011.
    pub(super) fn send_datagram(&self, peer: SocketAddr, bytes: &[u8]) {
        // The error of an earlier datagram makes one call fail that has nothing to do with it.
        for _ in 0..2 {
            match self.udp.try_send_to(bytes, peer) {
                Ok(_) => return,
                Err(error) if error.kind() == io::ErrorKind::WouldBlock => break,
                Err(_) => {
                    let peers = udp::unreachable_peers(&self.udp);
                    if peers.contains(&peer) {
                        self.pending.borrow_mut().extend(peers.into_iter().map(Report::Unreachable));
                        return;
                    }
                    self.pending.borrow_mut().extend(peers.into_iter().map(Report::Unreachable));
                }
            }
        }
        self.count(|counters| counters.dropped_datagrams += 1);
    }
}

/// About a second of the state stream.
const STATE_BUFFER: usize = 16 * 1_024;
/// How long a client of port 2000 or Modbus may leave its answers to us.
const ANSWER_PATIENCE: StdDuration = StdDuration::from_secs(30);
/// Most datagrams taken before the others have a turn.
pub(super) const DATAGRAMS_AT_ONCE: u64 = 16;
