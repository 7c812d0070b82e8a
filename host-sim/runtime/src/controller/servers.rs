//! The controller's servers: TCP connections and datagrams of port 2011.

use std::io;
use std::net::SocketAddr;
use std::rc::Rc;
use std::time::Duration as StdDuration;

use rustix::net::sockopt;
use tokio::net::{TcpListener, TcpStream};
use tokio::task::spawn_local;
use tracing::{debug, info, warn};

use super::{ControllerRuntime, ServerClient, TaskReport, closed};
use crate::tcp::{Connection, ConnectionEvent};
use crate::udp;
use recipe_controller::{ConnId, ControllerInput, Link};
use recipe_io::fairness::yield_fairly;
use recipe_io::tcp_options;
use recipe_io::timer::now;

impl ControllerRuntime {
    /// Accepts the connections of one TCP server.
    pub(super) async fn serve(self: Rc<Self>, link: Link, listener: TcpListener) {
        tcp_options::limit_buffers(&listener);
        loop {
            let failed = |error: &io::Error| {
                self.count(|counters| counters.accept_failures += 1);
                if let Some(more) = self.log_limit.allow(now()) {
                    warn!(?link, %error, more, "cannot accept a connection");
                }
            };
            let (stream, peer) = tcp_options::accept(&listener, failed).await;
            self.accept(link, stream, peer);
            yield_fairly().await;
        }
    }

    fn accept(self: &Rc<Self>, link: Link, stream: TcpStream, peer: SocketAddr) {
        let conn = ConnId(self.next_connection.get());
        self.next_connection.set(conn.0 + 1);
        match link {
            // Waiting packets become old: a second of the stream is enough.
            Link::State => drop(sockopt::set_socket_send_buffer_size(&stream, STATE_BUFFER)),
            Link::Command | Link::Modbus => tcp_options::set_user_timeout(&stream, ANSWER_TIMEOUT),
        }
        tcp_options::enable_keepalive(&stream);
        let (connection, read) = Connection::split(stream);
        let client = ServerClient { link, connection: Rc::clone(&connection), subscribed: false };
        self.connections.borrow_mut().insert(conn, client);
        // An IPv4 client of an IPv6 listener has a mapped address.
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
            if let Some(more) = self.refusal_log.allow(now()) {
                warn!(?link, %peer, more, "refused");
            }
            return;
        }
        info!(?link, %peer, conn = conn.0, "connected");
        let runtime = Rc::clone(self);
        spawn_local(async move {
            let ended = connection.run(read, |event| {
                // After a close, nothing more is reported.
                if let ConnectionEvent::Bytes(bytes) = event
                    && !connection.is_closed()
                {
                    match link {
                        Link::Command => runtime.input(ControllerInput::CommandBytes { conn, bytes }),
                        Link::Modbus => runtime.input(ControllerInput::ModbusBytes { conn, bytes }),
                        // Port 2001 reads nothing.
                        Link::State => {}
                    }
                }
            });
            let ended = ended.await;
            runtime.lingering.borrow_mut().retain(|other| !Rc::ptr_eq(other, &connection));
            debug!(?link, %peer, conn = conn.0, ?ended, "disconnected");
            let known = runtime.connections.borrow_mut().remove(&conn).is_some();
            if known {
                runtime.input(closed(link, conn));
            }
        });
    }

    /// Receives the datagrams of port 2011, and the errors of datagrams that were sent.
    pub(super) async fn serve_udp(self: Rc<Self>) {
        let mut buf = [0; 2_048];
        for nth in 1_u64.. {
            if nth.is_multiple_of(DATAGRAMS_AT_ONCE) {
                yield_fairly().await;
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

    pub(super) fn send_datagram(&self, peer: SocketAddr, bytes: &[u8]) {
        // One call may fail with the error of an earlier datagram.
        for _ in 0..2 {
            match self.udp.try_send_to(bytes, peer) {
                Ok(_) => return,
                Err(error) if error.kind() == io::ErrorKind::WouldBlock => break,
                Err(_) => {
                    let peers = udp::unreachable_peers(&self.udp);
                    if peers.contains(&peer) {
                        self.reports.borrow_mut().extend(peers.into_iter().map(TaskReport::Unreachable));
                        return;
                    }
                    self.reports.borrow_mut().extend(peers.into_iter().map(TaskReport::Unreachable));
                }
            }
        }
        self.count(|counters| counters.dropped_datagrams += 1);
    }
}

/// About a second of the state stream.
const STATE_BUFFER: usize = 16 * 1_024;
/// How long a client of port 2000 or Modbus may leave answers unacknowledged.
const ANSWER_TIMEOUT: StdDuration = StdDuration::from_secs(30);
/// Number of datagrams before other tasks run.
pub(super) const DATAGRAMS_AT_ONCE: u64 = 16;

#[cfg(test)]
#[path = "servers_tests.rs"]
mod tests;
