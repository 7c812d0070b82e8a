//! One TCP connection of a link, from its opening to the last segment.

use core::cell::{Cell, RefCell};
use core::future::{Future, poll_fn};
use core::pin::pin;
use core::task::Poll;

use embassy_futures::select::{Either, select, select3};
use embassy_net::tcp::{TcpReader, TcpSocket, TcpWriter};
use embassy_net::{IpAddress, IpEndpoint};
use embassy_time::{Duration, Timer, with_timeout};
use proto_core::engine::Input;

use super::{Buffers, Driver, Way, resolve};

impl Driver<'_> {
    /// One connection, until the peer closes it, an error, or the turn is over.
    pub(super) async fn tcp(&self, turn: u32, controller: &str, way: Way, buffers: &mut Buffers<'_>) {
        let mut socket = TcpSocket::new(self.stack, buffers.rx, buffers.tx);
        socket.set_nagle_enabled(false);
        let opening = async {
            let Some(address) = resolve(self.stack, controller).await else { return false };
            match way {
                Way::To(port) => socket.connect(IpEndpoint::new(address, port)).await.is_ok(),
                Way::At(port) => self.accept(&mut socket, port, address).await,
            }
        };
        let opened = self.pulse.idle(pin!(select(self.control.over(turn), opening))).await;
        if let Either::Second(true) = opened
            && self.tell(turn, Input::LinkUp { link: self.link })
        {
            self.exchange(turn, &mut socket, buffers.chunk).await;
            // The peer has closed it, or an error has.
            if self.control.is_turn(turn) {
                socket.close();
                let farewell = select(self.control.over(turn), socket.flush());
                let _ = with_timeout(FAREWELL, farewell).await;
            }
        }
        // Unacknowledged data must not be delivered later, after newer values: from here on only
        // the reset is sent. The peer must not keep a connection that is gone.
        socket.abort();
        let _ = with_timeout(FAREWELL, socket.flush()).await;
    }

    /// Waits for a connection of the controller. Others are refused, because data on this link is
    /// trusted.
    async fn accept(&self, socket: &mut TcpSocket<'_>, port: u16, controller: IpAddress) -> bool {
        loop {
            // A peer that begins a connection and never completes it must not keep the only socket.
            socket.set_keep_alive(None);
            socket.set_timeout(Some(HANDSHAKE));
            if socket.accept(port).await.is_err() {
                return false;
            }
            match socket.remote_endpoint() {
                Some(peer) if peer.addr == controller && socket.may_send() => {
                    // A controller that was switched off has to find the socket free.
                    socket.set_keep_alive(Some(PROBE));
                    socket.set_timeout(Some(VANISHED));
                    return true;
                }
                Some(peer) if peer.addr != controller => self.control.turn_away(),
                _ => {}
            }
            socket.abort();
            let _ = with_timeout(FAREWELL, socket.flush()).await;
        }
    }

    /// Bytes both ways, until the peer closes the connection, an error, or the turn is over.
    async fn exchange(&self, turn: u32, socket: &mut TcpSocket<'_>, chunk: &mut [u8]) {
        let (reader, writer) = socket.split();
        let outgoing = Outgoing { writer: RefCell::new(writer), held: Cell::new(0) };
        // Reading comes first: after an error nothing is known about acknowledgements.
        let reading = self.read(turn, reader, &outgoing, chunk);
        let writing = self.write(turn, &outgoing);
        let looking = self.look(turn, &outgoing);
        self.pulse.idle(pin!(select3(reading, writing, looking))).await;
    }

    async fn read(&self, turn: u32, mut reader: TcpReader<'_>, outgoing: &Outgoing<'_>, chunk: &mut [u8]) {
        while let Ok(len) = reader.read(chunk).await {
            // An answer comes with the acknowledgement of its request.
            let goes_on = self.tell_acknowledged(turn, outgoing);
            let bytes = chunk.get(..len).unwrap_or(&[]);
            if !goes_on || bytes.is_empty() || !self.tell(turn, Input::LinkBytes { link: self.link, bytes }) {
                return;
            }
        }
    }

    async fn write(&self, turn: u32, outgoing: &Outgoing<'_>) {
        while let Some(transmission) = self.control.next(turn).await {
            let mut rest = transmission.as_slice();
            while !rest.is_empty() {
                outgoing.held.set(rest.len());
                match select(self.control.over(turn), outgoing.write(rest)).await {
                    Either::Second(Some(len @ 1..)) => rest = rest.get(len..).unwrap_or(&[]),
                    _ => return,
                }
            }
            outgoing.held.set(0);
            if !self.tell(turn, Input::LinkSent { link: self.link }) {
                return;
            }
        }
    }

    /// Reports acknowledgements to the engine while something is unacknowledged.
    async fn look(&self, turn: u32, outgoing: &Outgoing<'_>) {
        loop {
            // No wake-up is needed: data that is handed over wakes this task.
            poll_fn(|_| if self.control.unacknowledged() > 0 { Poll::Ready(()) } else { Poll::Pending })
                .await;
            Timer::after(LOOK).await;
            if !self.tell_acknowledged(turn, outgoing) {
                return;
            }
        }
    }

    /// Reports unacknowledged bytes to the engine if their number has changed; returns whether the
    /// turn goes on.
    fn tell_acknowledged(&self, turn: u32, outgoing: &Outgoing<'_>) -> bool {
        if !self.control.is_turn(turn) {
            return false;
        }
        match self.control.acknowledged(outgoing.left()) {
            Some(left) => self.tell(turn, Input::LinkAcked { link: self.link, left }),
            None => true,
        }
    }
}

/// Data on its way to the peer.
struct Outgoing<'a> {
    writer: RefCell<TcpWriter<'a>>,
    /// Bytes for which the socket had no room yet.
    held: Cell<usize>,
}

impl Outgoing<'_> {
    /// Waits until the socket takes some of the bytes; `None` if it is closed. The socket can be
    /// used meanwhile.
    async fn write(&self, bytes: &[u8]) -> Option<usize> {
        poll_fn(|cx| pin!(self.writer.borrow_mut().write(bytes)).poll(cx)).await.ok()
    }

    /// Bytes that the peer has not acknowledged.
    fn left(&self) -> usize {
        self.held.get().saturating_add(self.writer.borrow().send_queue())
    }
}

/// Interval of reading the acknowledgements.
const LOOK: Duration = Duration::from_millis(10);
/// How long a connection may take to come about at a listening socket.
const HANDSHAKE: Duration = Duration::from_secs(2);
/// Interval of keep-alives to the controller's client.
const PROBE: Duration = Duration::from_secs(5);
/// How long they may be unanswered.
const VANISHED: Duration = Duration::from_secs(20);
/// How long to wait for a closing socket.
const FAREWELL: Duration = Duration::from_millis(100);
