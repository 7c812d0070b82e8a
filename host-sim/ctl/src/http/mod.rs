//! One request over one connection, and its answer.
//!
//! In: a request, limits, a timeout. Out: a head and a body, or why there is none. A server's answer is untrusted
//! input: its head, body and events are limited, and the whole answer has a timeout.
//!
//! No library is used: small ones read a body to its end or not at all, none lets Ctrl-C end a stream, and following a
//! redirect would carry a signature to another server. The server closes the connection after each answer, so no
//! connection is kept.

mod body;
mod events;
mod head;

use std::io::{self, Read, Write};
use std::net::{SocketAddr, TcpStream};
use std::time::{Duration, Instant};

use crate::stop::{LOOK, Stop};
use body::Unframer;
use events::EventParser;
use head::{HeadError, HttpHead, MAX_HEAD};

pub(crate) use events::ServerEvent;

/// Maximum length of a body that is read as a whole.
const MAX_BODY: usize = 1 << 20;

/// Maximum number of interim responses.
const MAX_ANNOUNCED: usize = 8;

#[derive(Debug, Clone, Copy)]
pub(crate) struct HttpRequest<'a> {
    pub(crate) method: &'static str,
    /// The address that the server knows itself by; `None`: the address of the connection.
    pub(crate) host: Option<&'a str>,
    pub(crate) target: &'a str,
    /// Lines of the head, each with a name and a value.
    pub(crate) fields: &'a [(&'static str, String)],
    pub(crate) body: &'a [u8],
}

#[derive(Debug, Clone)]
pub(crate) struct HttpReply {
    head: HttpHead,
    pub(crate) body: Vec<u8>,
}

impl HttpReply {
    pub(crate) fn status(&self) -> u16 {
        self.head.status
    }

    /// The value of a field with this lower-case name.
    pub(crate) fn field(&self, name: &str) -> Option<&str> {
        self.head.field(name)
    }
}

/// Why there is no answer.
#[derive(Debug)]
pub(crate) enum NoReply {
    /// No connection was made; nothing was sent.
    Unreached(io::Error),
    Reset(String),
    /// The connection ended, a timeout expired, or the answer is malformed.
    Broken(String),
    Stopped,
}

/// A connection that a request was sent on.
#[derive(Debug)]
pub(crate) struct HttpExchange {
    stream: TcpStream,
    /// The deadline for the head, and for a body that is read as a whole.
    deadline: Instant,
    timeout: Duration,
    rest: Vec<u8>,
    head: HttpHead,
    stop: Stop,
}

impl HttpExchange {
    /// Sends a request and reads the head of its answer, within `timeout`.
    pub(crate) fn start(
        place: SocketAddr,
        request: &HttpRequest<'_>,
        timeout: Duration,
        stop: &Stop,
    ) -> Result<Self, NoReply> {
        let deadline = Instant::now() + timeout;
        let mut stream = TcpStream::connect_timeout(&place, timeout).map_err(NoReply::Unreached)?;
        stream.set_nodelay(true).map_err(NoReply::Unreached)?;
        let broken = |error: io::Error| NoReply::Broken(words(&error));
        stream.set_write_timeout(Some(timeout)).map_err(broken)?;
        // The server may refuse the request before its end; the answer then says why.
        let sent = stream.write_all(&text_of(place, request));
        let mut bytes = Vec::new();
        let mut announced = 0;
        let mut exchange = |bytes: &mut Vec<u8>| loop {
            match HttpHead::parse(bytes) {
                // An interim response.
                Ok((head, len)) if head.status < 200 && announced < MAX_ANNOUNCED => {
                    announced += 1;
                    drop(bytes.drain(..len));
                }
                Err(HeadError::Incomplete) => match receive(&mut stream, bytes, deadline, stop)? {
                    0 if bytes.is_empty() => {
                        return Err(match &sent {
                            // A reset is reported once, to the first read or write.
                            Err(error) if is_reset(error) => {
                                NoReply::Reset(format!("no answer: {}", words(error)))
                            }
                            Err(error) => NoReply::Broken(format!("no answer: {}", words(error))),
                            Ok(()) => NoReply::Broken("no answer: it closed the connection".into()),
                        });
                    }
                    0 => return Err(NoReply::Broken(HeadError::Incomplete.to_string())),
                    _ => {}
                },
                parsed => return parsed.map_err(|error| NoReply::Broken(error.to_string())),
            }
        };
        let (head, len) = exchange(&mut bytes)?;
        let rest = bytes.split_off(len);
        Ok(Self { stream, deadline, timeout, rest, head, stop: stop.clone() })
    }

    pub(crate) fn status(&self) -> u16 {
        self.head.status
    }

    pub(crate) fn field(&self, name: &str) -> Option<&str> {
        self.head.field(name)
    }

    /// Reads the whole body within the timeout of the request.
    pub(crate) fn finish(mut self) -> Result<HttpReply, NoReply> {
        let (mut unframer, mut body) = (self.unframer()?, Vec::new());
        let too_long = || NoReply::Broken(format!("the answer is longer than {MAX_BODY} bytes"));
        let broken = |_| NoReply::Broken("the answer's body is malformed".into());
        let mut bytes = std::mem::take(&mut self.rest);
        loop {
            unframer.push(&bytes, &mut body).map_err(broken)?;
            if body.len() > MAX_BODY {
                return Err(too_long());
            }
            if unframer.has_ended() {
                return Ok(HttpReply { head: self.head, body });
            }
            bytes.clear();
            if receive(&mut self.stream, &mut bytes, self.deadline, &self.stop)? == 0 {
                return match unframer.may_end() {
                    true => Ok(HttpReply { head: self.head, body }),
                    false => Err(NoReply::Broken("the answer ends early".into())),
                };
            }
        }
    }

    /// The body as a stream.
    pub(crate) fn stream(mut self) -> Result<Stream, NoReply> {
        let unframer = self.unframer()?;
        let rest = std::mem::take(&mut self.rest);
        Ok(Stream { exchange: self, unframer, events: EventParser::default(), rest, found: Vec::new() })
    }

    fn unframer(&self) -> Result<Unframer, NoReply> {
        let framing = self.head.framing().map_err(|error| NoReply::Broken(error.to_string()))?;
        Ok(Unframer::new(framing))
    }
}

/// A body that is read as a stream.
#[derive(Debug)]
pub(crate) struct Stream {
    exchange: HttpExchange,
    unframer: Unframer,
    events: EventParser,
    rest: Vec<u8>,
    /// Received events, the newest first.
    found: Vec<ServerEvent>,
}

impl Stream {
    /// The next bytes of the body; `None` at its end. Silence for longer than the timeout of a request is an error.
    pub(crate) fn bytes(&mut self) -> Result<Option<Vec<u8>>, NoReply> {
        let mut out = Vec::new();
        loop {
            let bytes = std::mem::take(&mut self.rest);
            let broken = |_| NoReply::Broken("the stream is malformed".into());
            self.unframer.push(&bytes, &mut out).map_err(broken)?;
            if !out.is_empty() {
                return Ok(Some(out));
            }
            if self.unframer.has_ended() {
                return Ok(None);
            }
            let exchange = &mut self.exchange;
            let deadline = Instant::now() + exchange.timeout;
            if receive(&mut exchange.stream, &mut self.rest, deadline, &exchange.stop)? == 0 {
                return match self.unframer.may_end() {
                    true => Ok(None),
                    false => Err(NoReply::Broken("the stream ends early".into())),
                };
            }
        }
    }

    /// The next event; `None` at the end of the stream.
    pub(crate) fn event(&mut self) -> Result<Option<ServerEvent>, NoReply> {
        loop {
            if let Some(event) = self.found.pop() {
                return Ok(Some(event));
            }
            let Some(bytes) = self.bytes()? else { return Ok(None) };
            let broken = |_| NoReply::Broken("the stream has an event that is too long or no text".into());
            self.events.push(&bytes, &mut self.found).map_err(broken)?;
            self.found.reverse();
        }
    }
}

/// Reads at least one byte; 0 at the end of the connection.
fn receive(
    stream: &mut TcpStream,
    bytes: &mut Vec<u8>,
    deadline: Instant,
    stop: &Stop,
) -> Result<usize, NoReply> {
    let mut chunk = [0; 4_096];
    loop {
        if stop.is_asked() {
            return Err(NoReply::Stopped);
        }
        let left = deadline.saturating_duration_since(Instant::now());
        if left.is_zero() {
            return Err(NoReply::Broken("no answer in time".into()));
        }
        let wait = left.min(LOOK).max(Duration::from_millis(1));
        let count = stream.set_read_timeout(Some(wait)).and_then(|()| stream.read(&mut chunk));
        match count {
            Ok(count) => {
                bytes.extend_from_slice(&chunk[..count]);
                return Ok(count);
            }
            Err(error) if is_wait(&error) => {}
            Err(error) if is_reset(&error) => return Err(NoReply::Reset(words(&error))),
            Err(error) => return Err(NoReply::Broken(words(&error))),
        }
    }
}

fn is_reset(error: &io::Error) -> bool {
    matches!(error.kind(), io::ErrorKind::ConnectionReset | io::ErrorKind::BrokenPipe)
}

fn is_wait(error: &io::Error) -> bool {
    matches!(error.kind(), io::ErrorKind::WouldBlock | io::ErrorKind::TimedOut | io::ErrorKind::Interrupted)
}

/// The text of a system error without its number.
pub(crate) fn words(error: &io::Error) -> String {
    let text = error.to_string();
    match text.split_once(" (os error") {
        Some((words, _)) => words.to_owned(),
        None => text,
    }
}

fn text_of(place: SocketAddr, request: &HttpRequest<'_>) -> Vec<u8> {
    // The address, not the name: a gateway has no name of its own and only answers for its address.
    let host = match (request.host, place) {
        (Some(host), _) => host.to_owned(),
        (None, SocketAddr::V4(place)) => place.to_string(),
        // Without the interface of a link-local address, which only this machine knows.
        (None, SocketAddr::V6(place)) => format!("[{}]:{}", place.ip(), place.port()),
    };
    let mut text = format!("{} {} HTTP/1.1\r\nHost: {host}\r\n", request.method, request.target);
    for (name, value) in request.fields {
        text += &format!("{name}: {value}\r\n");
    }
    if !request.body.is_empty() {
        text += &format!("Content-Length: {}\r\n", request.body.len());
    }
    text += "Connection: close\r\n\r\n";
    [text.as_bytes(), request.body].concat()
}

const _: () = assert!(MAX_HEAD < MAX_BODY);
