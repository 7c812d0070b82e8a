//! Replies, written into the buffer of a connection and sent from there.

use core::fmt::{self, Display, Write};

use embassy_net::tcp::TcpSocket;
use embassy_time::{Instant, with_deadline};
use heapless::Vec;
use recipe_api::guard::Refusal;
use recipe_api::json;
use recipe_api::key::SCHEME;
use recipe_api::nonces::NonceText;
use recipe_api::response::{ContentType, LAST_CHUNK, Length, Response, StatusCode};
use recipe_api::revisions::{Etag, Revision};

use super::MAX_TIME;

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum SendError {
    /// The client has closed or reset the connection.
    Gone,
    /// It did not read in time.
    Slow,
    /// A piece does not fit into the buffer.
    TooLong,
}

/// A reply whose body is in the buffer of its connection. It is built without awaiting and sent in one place, because
/// each await point costs flash.
#[derive(Debug, Clone, Copy)]
pub(super) struct Reply {
    status: StatusCode,
    kind: ContentType,
    etag: Option<Revision>,
    allow: Option<&'static str>,
    retry_after_s: Option<u64>,
    /// Length of the body; `None` if it did not fit.
    len: Option<usize>,
}

impl Reply {
    /// A reply whose body is written by `write`.
    pub(super) fn new(
        buf: &mut [u8],
        status: StatusCode,
        kind: ContentType,
        write: impl FnOnce(&mut TextBuffer<'_>) -> fmt::Result,
    ) -> Self {
        let mut buf = TextBuffer::new(buf);
        let len = write(&mut buf).is_ok().then_some(buf.len);
        Self { status, kind, etag: None, allow: None, retry_after_s: None, len }
    }

    pub(super) fn error(buf: &mut [u8], status: StatusCode, text: impl Display) -> Self {
        Self::refusing(buf, status, &text)
    }

    /// Adds the ETag of this revision.
    pub(super) fn about(self, etag: Option<Revision>) -> Self {
        Self { etag, ..self }
    }

    fn refusing(buf: &mut [u8], status: StatusCode, text: &dyn Display) -> Self {
        Self::new(buf, status, ContentType::Json, |out| {
            out.write_str("{\"error\":")?;
            json::write_text(out, text)?;
            out.write_char('}')
        })
    }

    pub(super) fn refused(buf: &mut [u8], refusal: &Refusal) -> Self {
        let reply = Self::error(buf, refusal.status, refusal.text);
        Self { allow: refusal.allow, retry_after_s: refusal.retry_after_s, ..reply }
    }
}

pub(super) enum RequestOutcome {
    /// A reply that remains to be sent.
    Reply(Reply),
    Sent,
}

/// Sends the reply to a request.
pub(super) struct Responder<'s, 'a> {
    pub(super) socket: &'s mut TcpSocket<'a>,
    /// Holds one piece of a reply, or its head and a short body.
    pub(super) buf: &'s mut [u8],
    pub(super) is_head: bool,
    /// Next nonce for a client that signs its requests or must do so.
    pub(super) nonce: Option<NonceText>,
}

impl Responder<'_, '_> {
    pub(super) async fn send(&mut self, mut bytes: &[u8], until: Instant) -> Result<(), SendError> {
        while !bytes.is_empty() {
            match with_deadline(until, self.socket.write(bytes)).await {
                Ok(Ok(count @ 1..)) => bytes = bytes.get(count..).unwrap_or(&[]),
                Ok(_) => return Err(SendError::Gone),
                Err(_) => return Err(SendError::Slow),
            }
        }
        Ok(())
    }

    pub(super) async fn send_part(
        &mut self,
        from: usize,
        to: usize,
        until: Instant,
    ) -> Result<(), SendError> {
        let mut sent = from;
        while let Some(rest @ [_, ..]) = self.buf.get(sent..to) {
            match with_deadline(until, self.socket.write(rest)).await {
                Ok(Ok(count @ 1..)) => sent = sent.saturating_add(count),
                Ok(_) => return Err(SendError::Gone),
                Err(_) => return Err(SendError::Slow),
            }
        }
        Ok(())
    }

    pub(super) async fn answer(&mut self, reply: &Reply) -> Result<(), SendError> {
        let body = reply.len.ok_or(SendError::TooLong)?;
        // The head is written behind the body, because it contains the body's length.
        let head = self.write_head(body, Length::Bytes(body as u64), reply).ok_or(SendError::TooLong)?;
        let until = Instant::now() + MAX_TIME;
        self.send_part(body, body.saturating_add(head), until).await?;
        self.send_part(0, if self.is_head { 0 } else { body }, until).await
    }

    /// Sends the head of a reply whose body follows in pieces. Returns whether the body is wanted (not for HEAD).
    pub(super) async fn begin(
        &mut self,
        kind: ContentType,
        length: Length,
        etag: Option<Revision>,
    ) -> Result<bool, SendError> {
        let reply = Reply::new(self.buf, StatusCode::OK, kind, |_| Ok(())).about(etag);
        let head = self.write_head(0, length, &reply).ok_or(SendError::TooLong)?;
        self.send_part(0, head, Instant::now() + MAX_TIME).await?;
        Ok(!self.is_head)
    }

    /// Writes a head behind the first `from` bytes of the buffer; returns its length.
    #[inline(never)]
    fn write_head(&mut self, from: usize, length: Length, reply: &Reply) -> Option<usize> {
        let etag = reply.etag.map(Etag);
        let challenge = self.nonce.as_ref().map(Challenge);
        let mut fields: Vec<(&str, &dyn Display), 4> = Vec::new();
        // The capacity suffices for all fields.
        if let Some(etag) = &etag {
            let _ = fields.push(("ETag", etag));
        }
        if let Some(allow) = &reply.allow {
            let _ = fields.push(("Allow", allow));
        }
        if let Some(seconds) = &reply.retry_after_s {
            let _ = fields.push(("Retry-After", seconds));
        }
        match (&challenge, &self.nonce) {
            (Some(challenge), _) if reply.status == StatusCode::UNAUTHORIZED => {
                let _ = fields.push(("WWW-Authenticate", challenge));
            }
            (_, Some(nonce)) => drop(fields.push(("Next-Nonce", nonce))),
            _ => {}
        }
        let mut buf = TextBuffer::new(self.buf.get_mut(from..)?);
        Response::new(reply.status, reply.kind, length).with(&fields).write(&mut buf).ok()?;
        Some(buf.len)
    }

    /// Sends the first bytes of the buffer as a chunk, before `until`.
    pub(super) async fn chunk(&mut self, len: usize, until: Instant) -> Result<(), SendError> {
        if len == 0 {
            return Ok(());
        }
        let mut head = heapless::String::<12>::new();
        write!(head, "{len:x}\r\n").map_err(|_| SendError::TooLong)?;
        self.send(head.as_bytes(), until).await?;
        self.send_part(0, len, until).await?;
        self.send(b"\r\n", until).await
    }

    pub(super) async fn last_chunk(&mut self) -> Result<(), SendError> {
        self.send(LAST_CHUNK.as_bytes(), Instant::now() + MAX_TIME).await
    }
}

/// Writes text into a byte buffer.
pub(super) struct TextBuffer<'r> {
    bytes: &'r mut [u8],
    pub(super) len: usize,
}

impl<'r> TextBuffer<'r> {
    pub(super) fn new(bytes: &'r mut [u8]) -> Self {
        Self { bytes, len: 0 }
    }

    /// Free bytes.
    pub(super) fn left(&self) -> usize {
        self.bytes.len().saturating_sub(self.len)
    }
}

impl Write for TextBuffer<'_> {
    fn write_str(&mut self, text: &str) -> fmt::Result {
        let end = self.len.saturating_add(text.len());
        let place = self.bytes.get_mut(self.len..end).ok_or(fmt::Error)?;
        for (place, byte) in place.iter_mut().zip(text.bytes()) {
            *place = byte;
        }
        self.len = end;
        Ok(())
    }
}

/// The value of `WWW-Authenticate`.
struct Challenge<'n>(&'n NonceText);

impl Display for Challenge<'_> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{SCHEME} nonce=\"{}\"", self.0)
    }
}

pub(super) fn busy(buf: &mut [u8]) -> Reply {
    Reply::error(buf, StatusCode::CONFLICT, "something else is being done; try again")
}

pub(super) fn nothing_kept(buf: &mut [u8]) -> Reply {
    Reply::error(buf, StatusCode::UNAVAILABLE, "this board has no store; it cannot keep changes")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_has_no_room_is_noticed_and_nothing_is_written_behind_it() {
        let mut bytes = [0xA5; 8];
        let mut buf = TextBuffer::new(&mut bytes[..6]);
        assert!(buf.write_str("12345").is_ok() && buf.write_str("67").is_err());
        assert_eq!((buf.len, buf.left(), bytes), (5, 1, *b"12345\xA5\xA5\xA5"));
    }
}
