//! Connections: one request each, with limits on their number, length and time.

use std::io;
use std::net::SocketAddr;
use std::rc::Rc;
use std::time::Duration;

use recipe_api::guard::{Admitted, Refusal, Site};
use recipe_api::key::{BodyHash, SCHEME};
use recipe_api::request::{HeadBuffer, HeadError, HttpHead};
use recipe_api::response::{CONTINUE, ContentType, Length, Page, Response, StatusCode};
use recipe_io::tcp_options;
use recipe_io::timer::now;
use serde_json::{Value, json};
use tokio::io::{AsyncReadExt, AsyncWriteExt};
use tokio::net::{TcpListener, TcpStream};
use tokio::task::spawn_local;
use tokio::time::{Instant, timeout, timeout_at};
use tracing::{debug, warn};

use super::{ConsoleServer, stream};

/// A response with its body.
#[derive(Debug)]
pub(super) struct HttpReply {
    pub(super) status: StatusCode,
    pub(super) kind: ContentType,
    pub(super) body: ReplyBody,
    pub(super) fields: Vec<(&'static str, String)>,
}

/// What a response carries.
#[derive(Debug)]
pub(super) enum ReplyBody {
    /// A text.
    Text(Rc<str>),
    /// Part of the program.
    Bytes(&'static [u8]),
    /// Made for this request.
    Made(Vec<u8>),
}

impl ReplyBody {
    fn as_bytes(&self) -> &[u8] {
        match self {
            Self::Text(text) => text.as_bytes(),
            Self::Bytes(bytes) => bytes,
            Self::Made(bytes) => bytes,
        }
    }
}

impl<T: Into<Rc<str>>> From<T> for ReplyBody {
    fn from(text: T) -> Self {
        Self::Text(text.into())
    }
}

impl HttpReply {
    /// A document that was made before.
    pub(super) fn text(kind: ContentType, body: Rc<str>) -> Self {
        Self { status: StatusCode::OK, kind, body: ReplyBody::Text(body), fields: Vec::new() }
    }

    /// The page for people, unless the client has it.
    pub(super) fn page(if_none_match: Option<&str>) -> Self {
        let status = PAGE.status(if_none_match);
        let body = ReplyBody::Bytes(if status == StatusCode::OK { PAGE.bytes } else { &[] });
        Self { status, kind: ContentType::Page, body, fields: Vec::new() }
    }

    /// A configuration image.
    pub(super) fn image(bytes: Vec<u8>) -> Self {
        Self {
            status: StatusCode::OK,
            kind: ContentType::Image,
            body: ReplyBody::Made(bytes),
            fields: Vec::new(),
        }
    }

    /// A JSON value.
    pub(super) fn json(status: StatusCode, value: &Value) -> Self {
        Self { status, kind: ContentType::Json, body: value.to_string().into(), fields: Vec::new() }
    }

    /// An object with `error`.
    pub(super) fn error(status: StatusCode, text: &str) -> Self {
        Self::json(status, &json!({ "error": text }))
    }

    pub(super) fn with(mut self, name: &'static str, value: impl ToString) -> Self {
        self.fields.push((name, value.to_string()));
        self
    }
}

impl From<Refusal> for HttpReply {
    fn from(refusal: Refusal) -> Self {
        let reply = Self::error(refusal.status, refusal.text);
        let reply = match refusal.allow {
            Some(allow) => reply.with("Allow", allow),
            None => reply,
        };
        match refusal.retry_after_s {
            Some(seconds) => reply.with("Retry-After", seconds),
            None => reply,
        }
    }
}

/// A request with what belongs to it.
pub(super) struct HttpRequest<'a> {
    pub(super) head: HttpHead<'a>,
    pub(super) admitted: Admitted,
    pub(super) body: Vec<u8>,
    pub(super) peer: SocketAddr,
}

impl ConsoleServer {
    /// Accepts connections for ever.
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
            // Without waiting for anything: there may be thousands.
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

    /// Serves one request.
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

    /// Reads a body; `None` if it did not arrive.
    async fn body(
        &self,
        stream: &mut TcpStream,
        admitted: &Admitted,
        rest: Vec<u8>,
        deadline: Instant,
    ) -> io::Result<Option<Vec<u8>>> {
        // The guard has limited it.
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

/// A whole response.
pub(super) fn bytes_of(reply: &HttpReply) -> Vec<u8> {
    let body = reply.body.as_bytes();
    let mut bytes = head_of(reply, Length::Bytes(body.len() as u64)).into_bytes();
    bytes.extend_from_slice(body);
    bytes
}

/// The text of a head.
pub(super) fn head_of(reply: &HttpReply, length: Length) -> String {
    let fields: Vec<(&str, &dyn std::fmt::Display)> =
        reply.fields.iter().map(|(name, value)| (*name, value as &dyn std::fmt::Display)).collect();
    let mut text = String::new();
    // Writing to a `String` cannot fail.
    let _ = match reply.kind {
        ContentType::Page => PAGE.write_head(reply.status, &mut text),
        kind => Response::new(reply.status, kind, length).with(&fields).write(&mut text),
    };
    text
}

/// Reads what is left of a request: closing before that would reset the connection, and the client would not
/// see why it was refused.
async fn linger(mut stream: TcpStream) -> io::Result<()> {
    let mut chunk = vec![0; 4_096];
    let read = async { while stream.read(&mut chunk).await.is_ok_and(|count| count > 0) {} };
    let _ = timeout(LINGER, read).await;
    Ok(())
}

/// The page for people.
const PAGE: Page =
    Page { bytes: &recipe_console::PAGE, policy: recipe_console::POLICY, etag: recipe_console::ETAG };
/// Maximum number of connections.
const MAX_CONNECTIONS: usize = 8;
/// How long a request may take to arrive, and a response to be read.
pub(super) const MAX_TIME: Duration = Duration::from_secs(5);
/// How long a refused client may go on sending.
const LINGER: Duration = Duration::from_millis(300);
