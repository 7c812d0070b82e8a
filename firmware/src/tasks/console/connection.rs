//! A connection: one request, with limits on its length and time.

use core::net::Ipv4Addr;
use core::ops::Range;
use core::pin::pin;

use embassy_futures::yield_now;
use embassy_net::tcp::TcpSocket;
use embassy_net::{IpAddress, Stack};
use embassy_time::{Duration, Instant, Timer, with_deadline, with_timeout};
use recipe_api::guard::{Admitted, Refusal, Site};
use recipe_api::key::BodyHash;
use recipe_api::request::{HeadBuffer, HeadError, HttpHead, MAX_HEAD, Method};
use recipe_api::response::{CONTINUE, StatusCode};
use recipe_api::route::{ApiOperation, Served};

use super::answer::{Reply, RequestOutcome, Responder, SendError, busy, nothing_kept};
use super::arguments::{Arguments, ConsoleRequest, HeadArguments};
use super::read::PAGE;
use super::{ConnectionPermit, Console, MAX_TIME, PORT};
use crate::clock::now;
use crate::tasks::watchdog::Pulse;

/// Buffers of a connection.
#[derive(Debug)]
pub struct ConnectionBuffers<'a> {
    rx: &'a mut [u8],
    tx: &'a mut [u8],
    buf: &'a mut [u8],
}

impl<'a> ConnectionBuffers<'a> {
    /// Size in bytes.
    pub const SIZE: usize = RX + TX + BUFFER;

    /// Takes [`ConnectionBuffers::SIZE`] bytes from the front of `memory`; `None` if there are fewer.
    pub fn take(memory: &mut &'a mut [u8]) -> Option<Self> {
        let memory = memory.split_off_mut(..Self::SIZE)?;
        let (rx, rest) = memory.split_at_mut_checked(RX)?;
        let (tx, buf) = rest.split_at_mut_checked(TX)?;
        Some(Self { rx, tx, buf })
    }
}

impl Console {
    /// Serves connections with one socket, forever.
    pub async fn serve(&self, pulse: &Pulse, stack: Stack<'_>, buffers: ConnectionBuffers<'_>) -> ! {
        let ConnectionBuffers { rx, tx, buf } = buffers;
        loop {
            let mut socket = TcpSocket::new(stack, rx, tx);
            // A peer that never completes the handshake must not occupy the socket.
            socket.set_timeout(Some(MAX_TIME));
            let connection = async {
                if socket.accept(PORT).await.is_err() {
                    Timer::after(PAUSE).await;
                    return;
                }
                // Catches peers that lost power. Longest of all timeouts, so that the others take effect first.
                socket.set_timeout(Some(SILENT));
                // No limit is needed here, because the number of tasks limits the connections.
                let _one = ConnectionPermit::of(&self.connections, usize::MAX);
                self.count(|counters| &mut counters.connections);
                match self.connection(&mut socket, buf).await {
                    Err(SendError::Slow) => self.count(|counters| &mut counters.slow_readers),
                    Err(SendError::TooLong) => self.count(|counters| &mut counters.cut_off),
                    Ok(()) => {
                        socket.close();
                        if with_timeout(MAX_TIME, socket.flush()).await.is_ok() {
                            // Read the rest of the request: a reset because of unread data could destroy the reply.
                            let rest = async { while socket.read(buf).await.is_ok_and(|count| count > 0) {} };
                            let _ = with_timeout(LINGER, rest).await;
                        }
                    }
                    Err(SendError::Gone) => {}
                }
            };
            pulse.idle(pin!(connection)).await;
            socket.abort();
            let _ = with_timeout(CLOSE, socket.flush()).await;
            yield_now().await;
        }
    }

    async fn connection(&self, socket: &mut TcpSocket<'_>, buf: &mut [u8]) -> Result<(), SendError> {
        let mut responder = Responder { socket, buf, is_head: false, nonce: None };
        let deadline = Instant::now() + MAX_TIME;
        let (decided, rest) = match self.receive_head(&mut responder, deadline).await? {
            Some(received) => received,
            None => return self.was_incomplete(&mut responder).await,
        };
        let reply = match self.admit(&mut responder, decided) {
            Ok((admitted, mut request)) => {
                match self.receive_body(&mut responder, &admitted, &mut request, rest, deadline).await? {
                    BodyRead::Whole => match self.execute(&mut responder, request).await? {
                        RequestOutcome::Sent => return Ok(()),
                        RequestOutcome::Reply(reply) => reply,
                    },
                    BodyRead::Other => {
                        let text = "the body is not the one that was signed";
                        Reply::error(responder.buf, StatusCode::UNAUTHORIZED, text)
                    }
                    BodyRead::Incomplete => return self.was_incomplete(&mut responder).await,
                }
            }
            Err(reply) => reply,
        };
        responder.answer(&reply).await
    }

    async fn was_incomplete(&self, responder: &mut Responder<'_, '_>) -> Result<(), SendError> {
        self.count(|counters| &mut counters.incomplete);
        let reply = Reply::refused(responder.buf, &HeadError::Incomplete.into());
        responder.answer(&reply).await
    }

    /// Receives the head of a request into the buffer of the reply. Returns the result of admitting the request, and
    /// the part of the buffer with the beginning of the body; `None` on timeout.
    async fn receive_head(
        &self,
        responder: &mut Responder<'_, '_>,
        deadline: Instant,
    ) -> Result<Option<(Result<Decided, Refusal>, Range<usize>)>, SendError> {
        let Some((head, chunk)) = responder.buf.split_at_mut_checked(MAX_HEAD) else {
            return Err(SendError::TooLong);
        };
        let chunk = chunk.get_mut(..CHUNK).unwrap_or(&mut []);
        let mut buffer = HeadBuffer::within(head);
        loop {
            let count = match with_deadline(deadline, responder.socket.read(chunk)).await {
                Ok(Ok(count @ 1..)) => count,
                // Browsers open connections that they may never use.
                _ if buffer.is_empty() => return Err(SendError::Gone),
                Err(_) => return Ok(None),
                Ok(_) => {
                    self.count(|counters| &mut counters.incomplete);
                    return Err(SendError::Gone);
                }
            };
            let taken = buffer.push(chunk.get(..count).unwrap_or(&[]));
            let head = buffer.head();
            if head != Err(HeadError::Incomplete) {
                let decided = self.decide(responder.socket, head);
                let place = |of: usize| MAX_HEAD.saturating_add(of);
                return Ok(Some((decided, place(taken)..place(count))));
            }
        }
    }

    #[inline(never)]
    fn decide(
        &self,
        socket: &TcpSocket<'_>,
        head: Result<HttpHead<'_>, HeadError>,
    ) -> Result<Decided, Refusal> {
        let (local, peer) = match (socket.local_endpoint(), socket.remote_endpoint()) {
            (Some(local), Some(peer)) => (address(local.addr), address(peer.addr)),
            _ => (Ipv4Addr::UNSPECIFIED, Ipv4Addr::UNSPECIFIED),
        };
        let site = Site { local: local.into(), peer: peer.into(), names: &[&self.name] };
        let head = head?;
        let admitted = self.guard.borrow_mut().admit(now(), &head, &site, Served::Board)?;
        let port = |name: &str| {
            self.gateway.report(|status| status.ports().find(|port| port.name == name).map(|port| port.id))
        };
        let arguments = HeadArguments::of(&head, PAGE.status(head.if_none_match), port);
        Ok(Decided { admitted, arguments, peer })
    }

    /// Prepares an admitted request, or the reply to one that is not admitted.
    #[inline(never)]
    fn admit(
        &self,
        responder: &mut Responder<'_, '_>,
        decided: Result<Decided, Refusal>,
    ) -> Result<(Admitted, ConsoleRequest<'_>), Reply> {
        let mut guard = self.guard.borrow_mut();
        let Decided { admitted, arguments: head, peer } = decided.map_err(|refusal| {
            if refusal.status == StatusCode::UNAUTHORIZED {
                responder.nonce = Some(guard.nonce(now()));
            }
            Reply::refused(responder.buf, &refusal)
        })?;
        responder.is_head = admitted.is_head;
        if admitted.is_signed() {
            responder.nonce = Some(guard.nonce(now()));
        }
        let operation = admitted.operation;
        let mut request = ConsoleRequest { head, operation, arguments: Arguments::None, image: None, peer };
        if let Some(store) = self.store {
            store.note_reached();
        }
        if matches!(operation, ApiOperation::PutConfig | ApiOperation::PutUpdate | ApiOperation::PutEdge) {
            let Some(store) = self.store else { return Err(nothing_kept(responder.buf)) };
            let Some(lock) = store.take() else { return Err(busy(responder.buf)) };
            // The guard has checked the length.
            request.image = Some((usize::try_from(admitted.length).unwrap_or(0), lock));
        }
        Ok((admitted, request))
    }

    /// Receives the body, part of which came with the head.
    async fn receive_body(
        &self,
        responder: &mut Responder<'_, '_>,
        admitted: &Admitted,
        request: &mut ConsoleRequest<'_>,
        rest: Range<usize>,
        deadline: Instant,
    ) -> Result<BodyRead, SendError> {
        let length = usize::try_from(admitted.length).unwrap_or(0);
        let mut hash = BodyHash::new();
        // Bytes behind the body belong to another request, which is ignored.
        let mut piece = rest.len().min(length);
        responder.buf.copy_within(rest.start..rest.start.saturating_add(piece), 0);
        if admitted.expects_continue && piece < length {
            responder.send(CONTINUE.as_bytes(), deadline).await?;
        }
        let (mut received, mut from) = (0_usize, 0_usize);
        loop {
            let bytes = responder.buf.get(from..from.saturating_add(piece)).unwrap_or(&[]);
            hash.update(bytes);
            match &mut request.image {
                Some((_, lock)) => lock.fill(received, bytes),
                // Arguments are short enough to stay in the buffer.
                None => from = from.saturating_add(piece),
            }
            received = received.saturating_add(piece);
            let left = length.saturating_sub(received);
            if left == 0 {
                break;
            }
            let chunk = responder.buf.get_mut(from..from.saturating_add(left.min(CHUNK))).unwrap_or(&mut []);
            piece = match with_deadline(deadline, responder.socket.read(chunk)).await {
                Ok(Ok(count @ 1..)) => count,
                Err(_) => return Ok(BodyRead::Incomplete),
                Ok(_) => {
                    self.count(|counters| &mut counters.incomplete);
                    return Err(SendError::Gone);
                }
            };
            // Hashing takes long enough to let other tasks run.
            yield_now().await;
        }
        if admitted.is_signed() && !admitted.is_body(&hash.finish()) {
            return Ok(BodyRead::Other);
        }
        if request.image.is_none() && request.head.method == Method::Post {
            let body = responder.buf.get(..length).unwrap_or(&[]);
            request.arguments = Arguments::parse(request.operation, body);
        }
        Ok(BodyRead::Whole)
    }
}

struct Decided {
    admitted: Admitted,
    arguments: HeadArguments,
    peer: Ipv4Addr,
}

enum BodyRead {
    Whole,
    /// The hash of the body differs from the signed one.
    Other,
    /// It did not arrive in time.
    Incomplete,
}

fn address(address: IpAddress) -> Ipv4Addr {
    match address {
        IpAddress::Ipv4(four) => four,
    }
}

/// Receive buffer of a socket.
const RX: usize = 1024;
/// Transmit buffer: unacknowledged data at a long round trip.
const TX: usize = 1536;
/// Buffer of a connection: for the longest piece of a reply, or for the head and a short body. Before the reply it
/// contains the head of the request and the bytes of one more read.
const BUFFER: usize = 3328;
const _: () = assert!(BUFFER >= MAX_HEAD + CHUNK);
/// Bytes per read; each chunk of an image is hashed in one go.
const CHUNK: usize = 512;
/// Time for a client to stop sending after its reply.
const LINGER: Duration = Duration::from_millis(300);
/// TCP timeout of a silent peer.
const SILENT: Duration = Duration::from_secs(15);
/// Time for the reset of a connection to be sent.
const CLOSE: Duration = Duration::from_millis(100);
/// Pause after a failed accept.
const PAUSE: Duration = Duration::from_millis(100);
