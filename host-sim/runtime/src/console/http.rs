//! Connections: one request each, with limits on their number, length and time.

use std::io;
use std::net::SocketAddr;
use std::rc::Rc;
use std::time::Duration;

use recipe_api::guard::{Admitted, Refusal, Site};
use recipe_api::key::{BodyHash, SCHEME};
use recipe_api::request::{HeadBuffer, HeadError, HttpHead};
use recipe_api::response::{CONTINUE, StatusCode};
use recipe_io::tcp_options;
use recipe_io::timer::now;
use tokio::io::{AsyncReadExt, AsyncWriteExt};
use tokio::net::{TcpListener, TcpStream};
use tokio::task::spawn_local;
use tokio::time::{Instant, timeout, timeout_at};
use tracing::{debug, warn};

use super::reply::{HttpReply, MAX_TIME, bytes_of};
use super::{ConsoleServer, stream};

pub(super) struct HttpRequest<'a> {
    pub(super) head: HttpHead<'a>,
    pub(super) admitted: Admitted,
    pub(super) body: Vec<u8>,
    pub(super) peer: SocketAddr,
}

impl ConsoleServer {
    pub(super) async fn accept(self: Rc<Self>, listener: TcpListener) {
        tcp_options::limit_buffers(&listener);
        loop {
            let failed = |error: &io::Error| {
                if let Some(more) = self.log_limit.allow(now()) {
                    warn!(%error, more, "cannot accept a connection of the console");
                }
            };
            let (stream, peer) = tcp_options::accept(&listener, failed).await;
            self.welcome(stream, peer);
            tokio::task::yield_now().await;
        }
    }

    fn welcome(self: &Rc<Self>, stream: TcpStream, peer: SocketAddr) {
        self.count(|counters| counters.connections += 1);
        if self.connections.get() >= MAX_CONNECTIONS {
            self.count(|counters| counters.turned_away += 1);
            // Do not wait for the client: there may be thousands of them.
            let reply = HttpReply::error(StatusCode::UNAVAILABLE, "too many connections; try again");
            let _ = stream.try_write(&bytes_of(&reply));
            return;
        }
        self.connections.set(self.connections.get() + 1);
        let server = Rc::clone(self);
        spawn_local(async move {
            if let Err(error) = server.serve(stream, peer).await {
                debug!(%peer, %error, "a connection of the console ended early");
            }
            server.connections.set(server.connections.get() - 1);
        });
    }

    async fn serve(self: &Rc<Self>, mut stream: TcpStream, peer: SocketAddr) -> io::Result<()> {
        stream.set_nodelay(true)?;
        let local = stream.local_addr()?;
        let site = Site { local: local.ip(), peer: peer.ip(), names: &[] };
        let deadline = Instant::now() + MAX_TIME;
        let mut buffer = Box::new(HeadBuffer::new());
        let mut chunk = vec![0; 4_096];
        let (taken, count) = loop {
            let count = match timeout_at(deadline, stream.read(&mut chunk)).await {
                Ok(Ok(count)) if count > 0 => count,
                ended => {
                    // A browser opens connections that it may never use.
                    if !buffer.is_empty() {
                        self.count(|counters| counters.incomplete += 1);
                    }
                    if ended.is_err() && !buffer.is_empty() {
                        let refusal = Refusal::from(HeadError::Incomplete);
                        self.answer(&mut stream, &refusal.into(), false).await?;
                    }
                    return Ok(());
                }
            };
            let taken = buffer.push(chunk.get(..count).unwrap_or(&[]));
            match buffer.head() {
                Err(HeadError::Incomplete) => {}
                _ => break (taken, count),
            }
        };
        let rest = chunk.get(taken..count).unwrap_or(&[]).to_vec();
        drop(chunk);
        let admitted = match buffer.head() {
            Ok(head) => self
                .guard
                .borrow_mut()
                .admit(now(), &head, &site, self.source.served())
                .map(|admitted| (head, admitted)),
            Err(error) => Err(error.into()),
        };
        let (head, admitted) = match admitted {
            Ok(admitted) => admitted,
            Err(refusal) => {
                let mut reply = HttpReply::from(refusal);
                if refusal.status == StatusCode::UNAUTHORIZED {
                    let nonce = self.guard.borrow_mut().nonce(now());
                    let scheme = if site.is_loopback() { ", Bearer" } else { "" };
                    reply = reply.with("WWW-Authenticate", format!("{SCHEME} nonce=\"{nonce}\"{scheme}"));
                }
                self.answer(&mut stream, &reply, false).await?;
                return linger(stream).await;
            }
        };
        if admitted.operation.is_endless() {
            return stream::serve(self, stream, admitted.operation, &head).await;
        }
        let Some(body) = self.body(&mut stream, &admitted, rest, deadline).await? else { return Ok(()) };
        if admitted.is_signed() {
            let mut hash = BodyHash::new();
            hash.update(&body);
            if !admitted.is_body(&hash.finish()) {
                let text = "the body is not the one that was signed";
                return self
                    .answer(&mut stream, &HttpReply::error(StatusCode::UNAUTHORIZED, text), false)
                    .await;
            }
        }
        let mut reply = self.execute(HttpRequest { head, admitted, body, peer }).await;
        if admitted.is_signed() {
            reply = reply.with("Next-Nonce", self.guard.borrow_mut().nonce(now()));
        }
        self.answer(&mut stream, &reply, admitted.is_head).await
    }

    async fn body(
        &self,
        stream: &mut TcpStream,
        admitted: &Admitted,
        rest: Vec<u8>,
        deadline: Instant,
    ) -> io::Result<Option<Vec<u8>>> {
        // The guard has limited the length.
        let length = usize::try_from(admitted.length).unwrap_or(0);
        let mut body = rest;
        body.truncate(length);
        if admitted.expects_continue && body.len() < length {
            stream.write_all(CONTINUE.as_bytes()).await?;
        }
        let mut chunk = vec![0; 4_096];
        while body.len() < length {
            match timeout_at(deadline, stream.read(&mut chunk)).await {
                Ok(Ok(count)) if count > 0 => body.extend_from_slice(chunk.get(..count).unwrap_or(&[])),
                Ok(_) => {
                    self.count(|counters| counters.incomplete += 1);
                    return Ok(None);
                }
                Err(_) => {
                    self.count(|counters| counters.incomplete += 1);
                    let refusal = Refusal::from(HeadError::Incomplete);
                    self.answer(stream, &refusal.into(), false).await?;
                    return Ok(None);
                }
            }
        }
        body.truncate(length);
        Ok(Some(body))
    }

    async fn answer(&self, stream: &mut TcpStream, reply: &HttpReply, is_head: bool) -> io::Result<()> {
        let mut bytes = bytes_of(reply);
        if is_head {
            bytes.truncate(bytes.len() - reply.body.as_bytes().len());
        }
        let write = async {
            stream.write_all(&bytes).await?;
            stream.shutdown().await
        };
        timeout(MAX_TIME, write).await.unwrap_or_else(|_| {
            self.count(|counters| counters.slow_readers += 1);
            Err(io::ErrorKind::TimedOut.into())
        })
    }
}

/// Reads the rest of a request. Closing earlier would reset the connection, and the client would not see why it was
/// refused.
async fn linger(mut stream: TcpStream) -> io::Result<()> {
    let mut chunk = vec![0; 4_096];
    let read = async { while stream.read(&mut chunk).await.is_ok_and(|count| count > 0) {} };
    let _ = timeout(LINGER, read).await;
    Ok(())
}

const MAX_CONNECTIONS: usize = 8;
/// How long a refused client may go on sending.
const LINGER: Duration = Duration::from_millis(300);
