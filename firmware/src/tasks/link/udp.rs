//! Datagrams of a link, both ways.

use core::cell::Cell;
use core::future::poll_fn;
use core::pin::pin;
use core::task::Poll;

use embassy_futures::select::{Either, Either3, select, select3};
use embassy_net::udp::{PacketMetadata, UdpSocket};
use embassy_net::{IpAddress, IpEndpoint};
use embassy_time::{Duration, Timer};
use proto_core::engine::Input;

use super::{LinkBuffers, LinkDriver, LinkRole, resolve};

impl LinkDriver<'_> {
    /// Datagrams both ways; on a listening socket, answers go to the sender of the controller's
    /// newest frame.
    pub(super) async fn udp(
        &self,
        turn: u32,
        controller: &str,
        role: LinkRole,
        buffers: &mut LinkBuffers<'_>,
    ) {
        let mut received = [PacketMetadata::EMPTY; DATAGRAMS];
        // One datagram at a time, so that it is known when it has left.
        let mut waiting = [PacketMetadata::EMPTY; 1];
        let mut socket = UdpSocket::new(self.stack, &mut received, buffers.rx, &mut waiting, buffers.tx);
        let own = match role {
            LinkRole::Client(_) => 0,
            LinkRole::Server(port) => port,
        };
        if socket.bind(own).is_err() {
            return;
        }
        let own = socket.endpoint().port;
        let resolving = select(self.control.over(turn), resolve(self.stack, controller));
        let Either::Second(Some(address)) = self.pulse.idle(pin!(resolving)).await else { return };
        let fixed = match role {
            LinkRole::Client(port) => Some(IpEndpoint::new(address, port)),
            LinkRole::Server(_) => None,
        };
        let peer = Cell::new(fixed);
        if fixed.is_some() && !self.report(turn, Input::LinkUp { link: self.link }) {
            return;
        }
        loop {
            let over = async {
                self.receive(turn, &socket, fixed, address, &peer).await;
                SocketEnd::End
            };
            let sending = self.send(turn, &socket, &peer);
            let after = match self.pulse.idle(pin!(select(over, sending))).await {
                Either::First(after) | Either::Second(after) => after,
            };
            match after {
                SocketEnd::End => return,
                // The peer is not found on the network. Drop the waiting datagram: it would be sent when the peer comes
                // back, however old it is then.
                SocketEnd::Reopen => {
                    socket.close();
                    if socket.bind(own).is_err() || !self.report(turn, Input::LinkSent { link: self.link }) {
                        return;
                    }
                }
            }
        }
    }

    async fn receive(
        &self,
        turn: u32,
        socket: &UdpSocket<'_>,
        fixed: Option<IpEndpoint>,
        controller: IpAddress,
        peer: &Cell<Option<IpEndpoint>>,
    ) {
        let received = self.gateway.received();
        loop {
            // Datagrams longer than the buffer are dropped.
            let receiving = poll_fn(|cx| socket.poll_recv_from(received.borrow_mut().as_mut_slice(), cx));
            let Ok((len, from)) = receiving.await else { continue };
            let from = from.endpoint;
            let received = received.borrow();
            let bytes = received.get(..len).unwrap_or(&[]);
            if !self.control.is_turn(turn) {
                return;
            }
            match (fixed, peer.get()) {
                (Some(fixed), _) if from != fixed => continue,
                (Some(_), _) => {}
                (None, _) if from.addr != controller => {
                    self.control.count_refused_peer();
                    continue;
                }
                (None, None) => {
                    peer.set(Some(from));
                    if !self.report(turn, Input::LinkUp { link: self.link }) {
                        return;
                    }
                }
                // Other datagrams of the controller's host do not redirect the answers.
                (None, Some(_)) if self.gateway.is_frame(self.link, bytes) => peer.set(Some(from)),
                (None, Some(_)) => {}
            }
            if !self.report(turn, Input::LinkBytes { link: self.link, bytes }) {
                return;
            }
        }
    }

    async fn send(&self, turn: u32, socket: &UdpSocket<'_>, peer: &Cell<Option<IpEndpoint>>) -> SocketEnd {
        while self.control.next(turn).await {
            if let Some(peer) = peer.get() {
                let sending = poll_fn(|cx| {
                    let sending = self.control.rest(|datagram| socket.poll_send_to(datagram, peer, cx));
                    sending.unwrap_or(Poll::Ready(Ok(())))
                });
                if sending.await.is_err() {
                    return SocketEnd::End;
                }
                self.control.taken();
                let left =
                    select3(self.control.over(turn), socket.wait_send_ready(), Timer::after(SEND_TIMEOUT));
                match left.await {
                    Either3::First(()) => return SocketEnd::End,
                    Either3::Second(()) => {}
                    Either3::Third(()) => return SocketEnd::Reopen,
                }
            }
            self.control.taken();
            if !self.report(turn, Input::LinkSent { link: self.link }) {
                return SocketEnd::End;
            }
        }
        SocketEnd::End
    }
}

enum SocketEnd {
    /// The turn is over or the socket failed.
    End,
    /// A datagram cannot be sent: open the socket again.
    Reopen,
}

/// Datagrams in the receive buffer.
const DATAGRAMS: usize = 8;
/// Maximum age of a datagram when it is sent: the same as that of a frame on TCP when it is delivered.
const SEND_TIMEOUT: Duration = Duration::from_millis(250);
