//! The controller's recipe ports: devices, and TCP and UDP clients.

use std::io;
use std::rc::Rc;
use std::time::Duration as StdDuration;

use tokio::net::UdpSocket;
use tracing::{debug, info};

use super::servers::DATAGRAMS_AT_ONCE;
use super::{ControllerRuntime, Outward, TaskReport};
use crate::tcp::{Accepted, Connection, ConnectionEvent};
use recipe_controller::ControllerInput;
use recipe_io::backoff::Backoff;
use recipe_io::connect::connect;
use recipe_io::fairness::yield_fairly;
use recipe_io::tcp_options;

impl ControllerRuntime {
    /// Sends on a port. Data that the socket accepts at once counts as sent.
    pub(super) fn send_port(&self, port: usize, bytes: &[u8]) {
        let sent = match self.ports.get(port) {
            Some(Outward::Device(tx)) => {
                tx.send(bytes);
                false
            }
            Some(Outward::Tcp(connection)) => match connection.borrow().as_ref() {
                Some(connection) => connection.send(bytes) == Accepted::All,
                None => false,
            },
            Some(Outward::Udp(socket)) => {
                if let Some(socket) = socket.borrow().as_ref() {
                    send_datagram(self, socket, bytes);
                }
                true
            }
            Some(Outward::UdpServer) | None => false,
        };
        if sent {
            self.reports.borrow_mut().push_back(TaskReport::PortSent(port));
        }
    }

    /// A TCP client port: connects, and reconnects when the connection is lost.
    pub(super) async fn connect_out(self: Rc<Self>, port: usize, to: String) {
        let Some(Outward::Tcp(slot)) = self.ports.get(port) else { return };
        let mut backoff = Backoff::new(MIN_PAUSE, MAX_PAUSE);
        loop {
            match tokio::time::timeout(CONNECT_TIMEOUT, connect(&to)).await {
                Ok(Ok(stream)) => {
                    info!(%to, "connected");
                    backoff.reset();
                    tcp_options::enable_keepalive(&stream);
                    let (connection, read) = Connection::split(stream);
                    *slot.borrow_mut() = Some(Rc::clone(&connection));
                    self.input(ControllerInput::PortUp { port });
                    let ended = connection.run(read, |event| match event {
                        ConnectionEvent::Bytes(bytes) => {
                            self.input(ControllerInput::PortBytes { port, bytes })
                        }
                        ConnectionEvent::Drained => self.input(ControllerInput::PortSent { port }),
                    });
                    let ended = ended.await;
                    info!(%to, ?ended, "connection lost");
                    *slot.borrow_mut() = None;
                    self.input(ControllerInput::PortDown { port });
                }
                Ok(Err(error)) => debug!(%to, %error, "cannot connect"),
                Err(_elapsed) => debug!(%to, "connecting timed out"),
            }
            backoff.wait().await;
        }
    }

    /// A UDP client port: up as soon as the peer's address is known, whether it can be reached or not.
    pub(super) async fn send_out(self: Rc<Self>, port: usize, to: String) {
        let Some(Outward::Udp(slot)) = self.ports.get(port) else { return };
        let mut backoff = Backoff::new(MIN_PAUSE, MAX_PAUSE);
        let socket = loop {
            match connected(&to).await {
                Ok(socket) => break Rc::new(socket),
                Err(error) => debug!(%to, %error, "cannot resolve the address"),
            }
            backoff.wait().await;
        };
        *slot.borrow_mut() = Some(Rc::clone(&socket));
        self.input(ControllerInput::PortUp { port });
        let mut buf = [0; 2_048];
        for nth in 1_u64.. {
            if nth.is_multiple_of(DATAGRAMS_AT_ONCE) {
                yield_fairly().await;
            }
            // An error means that a datagram could not be delivered; the peer may appear later.
            if let Ok(count) = socket.recv(&mut buf).await {
                self.input(ControllerInput::PortBytes { port, bytes: &buf[..count] });
            }
        }
    }
}

/// A socket connected to one peer.
async fn connected(to: &str) -> io::Result<UdpSocket> {
    let mut last = io::Error::from(io::ErrorKind::NotFound);
    for peer in tokio::net::lookup_host(to).await? {
        let any = if peer.is_ipv4() { "0.0.0.0:0" } else { "[::]:0" };
        let socket = UdpSocket::bind(any).await?;
        match socket.connect(peer).await {
            Ok(()) => {
                socket.writable().await?;
                return Ok(socket);
            }
            Err(error) => last = error,
        }
    }
    Err(last)
}

fn send_datagram(runtime: &ControllerRuntime, socket: &UdpSocket, bytes: &[u8]) {
    // One call fails with the error of an earlier datagram.
    if socket.try_send(bytes).or_else(|_| socket.try_send(bytes)).is_err() {
        runtime.count(|counters| counters.dropped_datagrams += 1);
    }
}

const CONNECT_TIMEOUT: StdDuration = StdDuration::from_secs(2);
const MIN_PAUSE: StdDuration = StdDuration::from_millis(20);
const MAX_PAUSE: StdDuration = StdDuration::from_secs(1);
