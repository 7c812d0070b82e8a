//! TCP connections of a link.

use core::cell::RefCell;
use core::future::{Future, poll_fn};
use core::pin::pin;
use core::task::Poll;

use embassy_futures::select::{Either, select, select3};
use embassy_net::tcp::{TcpReader, TcpSocket, TcpWriter};
use embassy_net::{IpAddress, IpEndpoint};
use embassy_time::{Duration, Timer, with_timeout};
use proto_core::engine::Input;

use super::{LinkBuffers, LinkDriver, LinkRole, resolve};

impl LinkDriver<'_> {
    /// One connection, until the peer closes it, it fails, or the turn is over.
    pub(super) async fn tcp(
        &self,
        turn: u32,
        controller: &str,
        role: LinkRole,
        buffers: &mut LinkBuffers<'_>,
    ) {
        let mut socket = TcpSocket::new(self.stack, buffers.rx, buffers.tx);
        socket.set_nagle_enabled(false);
        let opening = async {
            let Some(address) = resolve(self.stack, controller).await else { return false };
            match role {
                LinkRole::Client(port) => socket.connect(IpEndpoint::new(address, port)).await.is_ok(),
                LinkRole::Server(port) => self.accept(&mut socket, port, address).await,
            }
        };
        let opened = self.pulse.idle(pin!(select(self.control.over(turn), opening))).await;
        if let Either::Second(true) = opened
            && self.report(turn, Input::LinkUp { link: self.link })
        {
            self.exchange(turn, &mut socket).await;
            // The peer closed the connection, or it failed.
            if self.control.is_turn(turn) {
                socket.close();
                let closing = select(self.control.over(turn), socket.flush());
                let _ = with_timeout(CLOSE_TIMEOUT, closing).await;
            }
        }
        // Unacknowledged data must not be delivered after newer values. So from here on only a reset is sent, which
        // also ends the connection on the peer's side.
        socket.abort();
        let _ = with_timeout(CLOSE_TIMEOUT, socket.flush()).await;
    }

    /// Waits for a connection of the controller. Others are refused, because data on this link is trusted.
    async fn accept(&self, socket: &mut TcpSocket<'_>, port: u16, controller: IpAddress) -> bool {
        loop {
            // A peer that never completes the handshake must not occupy the only socket.
            socket.set_keep_alive(None);
            socket.set_timeout(Some(HANDSHAKE_TIMEOUT));
            if socket.accept(port).await.is_err() {
                return false;
            }
            match socket.remote_endpoint() {
                Some(peer) if peer.addr == controller && socket.may_send() => {
                    // Keep-alives detect that the controller was switched off, so that it finds the socket free again.
                    socket.set_keep_alive(Some(KEEP_ALIVE_PERIOD));
                    socket.set_timeout(Some(KEEP_ALIVE_TIMEOUT));
                    return true;
                }
                Some(peer) if peer.addr != controller => self.control.count_refused_peer(),
                _ => {}
            }
            socket.abort();
            let _ = with_timeout(CLOSE_TIMEOUT, socket.flush()).await;
        }
    }

    /// Moves bytes both ways, until the peer closes the connection, it fails, or the turn is over.
    async fn exchange(&self, turn: u32, socket: &mut TcpSocket<'_>) {
        let (reader, writer) = socket.split();
        let writer = RefCell::new(writer);
        // Reading is polled first, because acknowledgements cannot be read any more after an error.
        let reading = self.read(turn, reader, &writer);
        let writing = self.write(turn, &writer);
        let looking = self.watch_acknowledgements(turn, &writer);
        self.pulse.idle(pin!(select3(reading, writing, looking))).await;
    }

    async fn read(&self, turn: u32, mut reader: TcpReader<'_>, writer: &RefCell<TcpWriter<'_>>) {
        let received = self.gateway.received();
        loop {
            let reading = poll_fn(|cx| pin!(reader.read(received.borrow_mut().as_mut_slice())).poll(cx));
            let Ok(len) = reading.await else { return };
            // A reply also acknowledges its request.
            let goes_on = self.report_acknowledged(turn, writer);
            let received = received.borrow();
            let bytes = received.get(..len).unwrap_or(&[]);
            if !goes_on || bytes.is_empty() || !self.report(turn, Input::LinkBytes { link: self.link, bytes })
            {
                return;
            }
        }
    }

    async fn write(&self, turn: u32, writer: &RefCell<TcpWriter<'_>>) {
        while self.control.next(turn).await {
            // Waits until the socket accepts some of the bytes. Neither the writer nor the outbox is borrowed longer
            // than a poll.
            let writing = poll_fn(|cx| {
                let mut writer = writer.borrow_mut();
                self.control.rest(|rest| pin!(writer.write(rest)).poll(cx)).unwrap_or(Poll::Ready(Ok(0)))
            });
            let is_all = self.control.accepted(0)
                || match select(self.control.over(turn), writing).await {
                    Either::Second(Ok(count @ 1..)) => self.control.accepted(count),
                    _ => return,
                };
            if is_all && !self.report(turn, Input::LinkSent { link: self.link }) {
                return;
            }
        }
    }

    /// Reports acknowledgements to the engine while something is unacknowledged.
    async fn watch_acknowledgements(&self, turn: u32, writer: &RefCell<TcpWriter<'_>>) {
        loop {
            // No waker is registered, because data from the engine wakes this task anyway.
            poll_fn(|_| if self.control.unacknowledged() > 0 { Poll::Ready(()) } else { Poll::Pending })
                .await;
            Timer::after(ACK_PERIOD).await;
            if !self.report_acknowledged(turn, writer) {
                return;
            }
        }
    }

    /// Reports unacknowledged bytes to the engine if their number has changed; returns whether the
    /// turn goes on.
    fn report_acknowledged(&self, turn: u32, writer: &RefCell<TcpWriter<'_>>) -> bool {
        if !self.control.is_turn(turn) {
            return false;
        }
        match self.control.acknowledged(writer.borrow().send_queue()) {
            Some(left) => self.report(turn, Input::LinkAcked { link: self.link, left }),
            None => true,
        }
    }
}

/// Interval of checking for acknowledgements.
const ACK_PERIOD: Duration = Duration::from_millis(10);
/// Limit of a handshake at a listening socket.
const HANDSHAKE_TIMEOUT: Duration = Duration::from_secs(2);
/// Interval of keep-alives to the controller's client.
const KEEP_ALIVE_PERIOD: Duration = Duration::from_secs(5);
/// How long keep-alives may be unanswered.
const KEEP_ALIVE_TIMEOUT: Duration = Duration::from_secs(20);
/// Limit of closing a socket.
const CLOSE_TIMEOUT: Duration = Duration::from_millis(100);
