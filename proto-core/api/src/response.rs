//! The head of a response, and the chunks of a body whose length is not known in advance.
//!
//! Every response closes its connection. It forbids other pages to frame it, browsers to guess its type, and, except
//! for the page for people, caches to store it.

use core::fmt::{self, Write};

use crate::number::Whole;
use crate::request::{cut, trim};

/// A status code.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct StatusCode(pub u16);

impl StatusCode {
    /// 200.
    pub const OK: Self = Self(200);
    /// 201: a configuration was stored.
    pub const CREATED: Self = Self(201);
    /// 202: an operation was started; its result is shown elsewhere.
    pub const ACCEPTED: Self = Self(202);
    /// 304: the client has the current version.
    pub const NOT_MODIFIED: Self = Self(304);
    /// 400.
    pub const BAD_REQUEST: Self = Self(400);
    /// 401: the key is missing or wrong.
    pub const UNAUTHORIZED: Self = Self(401);
    /// 403: from a page of another origin, or the server has no key.
    pub const FORBIDDEN: Self = Self(403);
    /// 404.
    pub const NOT_FOUND: Self = Self(404);
    /// 405, with `Allow`.
    pub const METHOD_NOT_ALLOWED: Self = Self(405);
    /// 408: the request took too long.
    pub const TIMEOUT: Self = Self(408);
    /// 409: not possible in the current state.
    pub const CONFLICT: Self = Self(409);
    /// 411: the body has no length.
    pub const LENGTH_REQUIRED: Self = Self(411);
    /// 412: `If-Match` names another revision.
    pub const PRECONDITION_FAILED: Self = Self(412);
    /// 413: the body is too long.
    pub const TOO_LARGE: Self = Self(413);
    /// 415: the body has another type.
    pub const UNSUPPORTED_TYPE: Self = Self(415);
    /// 417: an unknown `Expect`.
    pub const EXPECTATION_FAILED: Self = Self(417);
    /// 421: this server is not the host of the request.
    pub const MISDIRECTED: Self = Self(421);
    /// 422: the body is well-formed, but its content is wrong.
    pub const UNPROCESSABLE: Self = Self(422);
    /// 428: `If-Match` is needed.
    pub const PRECONDITION_REQUIRED: Self = Self(428);
    /// 429, with `Retry-After`.
    pub const TOO_MANY: Self = Self(429);
    /// 431: the head is too long.
    pub const HEAD_TOO_LARGE: Self = Self(431);
    /// 500: the operation failed, for example because the disk is full.
    pub const INTERNAL: Self = Self(500);
    /// 501: this server does not support the operation.
    pub const NOT_IMPLEMENTED: Self = Self(501);
    /// 503: no room for another connection or stream, or no configuration runs at the moment.
    pub const UNAVAILABLE: Self = Self(503);
    /// 505: the version is not HTTP/1.1.
    pub const VERSION: Self = Self(505);

    /// The usual reason phrase.
    pub const fn reason(self) -> &'static str {
        match self.0 {
            200 => "OK",
            201 => "Created",
            202 => "Accepted",
            304 => "Not Modified",
            400 => "Bad Request",
            401 => "Unauthorized",
            403 => "Forbidden",
            404 => "Not Found",
            405 => "Method Not Allowed",
            408 => "Request Timeout",
            409 => "Conflict",
            411 => "Length Required",
            412 => "Precondition Failed",
            413 => "Content Too Large",
            415 => "Unsupported Media Type",
            417 => "Expectation Failed",
            421 => "Misdirected Request",
            422 => "Unprocessable Content",
            428 => "Precondition Required",
            429 => "Too Many Requests",
            431 => "Request Header Fields Too Large",
            501 => "Not Implemented",
            503 => "Service Unavailable",
            505 => "HTTP Version Not Supported",
            _ => "Internal Server Error",
        }
    }
}

/// The media type of a body.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[non_exhaustive]
pub enum ContentType {
    /// JSON.
    Json,
    /// A configuration as TOML.
    Toml,
    /// OpenMetrics.
    Metrics,
    /// Text for people and tools.
    Text,
    /// Server-sent events.
    Events,
    /// A capture (pcapng).
    Capture,
    /// The console.
    Page,
    /// A configuration image.
    Image,
}

impl ContentType {
    /// The media type.
    pub const fn name(self) -> &'static str {
        match self {
            Self::Json => "application/json",
            Self::Toml => "application/toml",
            Self::Metrics => "application/openmetrics-text; version=1.0.0; charset=utf-8",
            Self::Text => "text/plain; charset=utf-8",
            Self::Events => "text/event-stream",
            Self::Capture => "application/x-pcapng",
            Self::Page => "text/html; charset=utf-8",
            Self::Image => "application/octet-stream",
        }
    }
}

/// How a client learns where the body ends.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Length {
    /// By its length in bytes.
    Bytes(u64),
    /// By chunked encoding ([`write_chunk`]).
    Chunked,
    /// The body goes on until the connection is closed.
    Endless,
}

/// The head of a response.
#[derive(Clone, Copy)]
pub struct Response<'a> {
    status: StatusCode,
    kind: ContentType,
    length: Length,
    policy: &'a str,
    fields: &'a [(&'a str, &'a dyn fmt::Display)],
}

impl<'a> Response<'a> {
    /// A response without further header fields.
    pub const fn new(status: StatusCode, kind: ContentType, length: Length) -> Self {
        Self { status, kind, length, policy: NOTHING, fields: &[] }
    }

    /// Adds header fields. Their values must be text without line ends.
    #[must_use]
    pub const fn with(self, fields: &'a [(&'a str, &'a dyn fmt::Display)]) -> Self {
        Self { fields, ..self }
    }

    /// Sets the `Content-Security-Policy`. The default lets a browser run and load nothing.
    #[must_use]
    pub const fn with_policy(self, policy: &'a str) -> Self {
        Self { policy, ..self }
    }

    /// Writes the head, including the empty line at its end.
    pub fn write(&self, out: &mut impl Write) -> fmt::Result {
        write!(out, "HTTP/1.1 {} {}\r\n", self.status.0, self.status.reason())?;
        // A 304 does not describe the body that the client has: the length here would be that of this response.
        if self.status != StatusCode::NOT_MODIFIED {
            write!(out, "Content-Type: {}\r\n", self.kind.name())?;
            match self.length {
                Length::Bytes(len) => write!(out, "Content-Length: {}\r\n", Whole(len))?,
                Length::Chunked => out.write_str("Transfer-Encoding: chunked\r\n")?,
                Length::Endless => {}
            }
        }
        write!(out, "Content-Security-Policy: {}\r\n", self.policy)?;
        for (name, value) in self.fields {
            write!(out, "{name}: {value}\r\n")?;
        }
        let keep = if self.kind == ContentType::Page { "no-cache" } else { "no-store" };
        write!(out, "Cache-Control: {keep}\r\n")?;
        out.write_str(
            "X-Content-Type-Options: nosniff\r\nReferrer-Policy: no-referrer\r\n\
             Cross-Origin-Resource-Policy: same-origin\r\nConnection: close\r\n\r\n",
        )
    }
}

/// The page for people, part of the program. A browser caches it, and asks each time whether it has changed.
#[derive(Debug, Clone, Copy)]
pub struct Page {
    /// The page, compressed with gzip.
    pub bytes: &'static [u8],
    /// Its `Content-Security-Policy`.
    pub policy: &'static str,
    /// Its `ETag`, with the quotes.
    pub etag: &'static str,
}

impl Page {
    /// [`StatusCode::OK`], or [`StatusCode::NOT_MODIFIED`] if `If-None-Match` shows that the client has the page. Then
    /// no body follows the head.
    pub fn status(&self, if_none_match: Option<&str>) -> StatusCode {
        let mut rest = if_none_match.unwrap_or("");
        while !rest.is_empty() {
            let (tag, behind) = cut(rest, b',').unwrap_or((rest, ""));
            let tag = trim(tag);
            if tag.strip_prefix("W/").unwrap_or(tag) == self.etag {
                return StatusCode::NOT_MODIFIED;
            }
            rest = behind;
        }
        StatusCode::OK
    }

    /// Writes the head of a response with this status.
    pub fn write_head(&self, status: StatusCode, out: &mut impl Write) -> fmt::Result {
        let fields: [(&str, &dyn fmt::Display); 2] = [("ETag", &self.etag), ("Content-Encoding", &"gzip")];
        // A 304 has only the `ETag`.
        let fields = if status == StatusCode::NOT_MODIFIED { fields.get(..1) } else { fields.get(..) };
        Response::new(status, ContentType::Page, Length::Bytes(self.bytes.len() as u64))
            .with_policy(self.policy)
            .with(fields.unwrap_or(&[]))
            .write(out)
    }
}

/// The `Content-Security-Policy` of everything but the page.
const NOTHING: &str = "default-src 'none'; frame-ancestors 'none'";

/// Sent to a client that expects it before it sends its body.
pub const CONTINUE: &str = "HTTP/1.1 100 Continue\r\n\r\n";

/// Writes a chunk of a body. An empty chunk would end the body, so nothing is written for it.
pub fn write_chunk(out: &mut impl Write, piece: &str) -> fmt::Result {
    match piece.len() {
        0 => Ok(()),
        len => write!(out, "{len:x}\r\n{piece}\r\n"),
    }
}

/// The end of a chunked body.
pub const LAST_CHUNK: &str = "0\r\n\r\n";

#[cfg(test)]
mod tests {
    use super::*;
    use std::string::String;

    #[test]
    fn a_head_has_one_empty_line_and_forbids_what_browsers_may_guess() {
        let mut head = String::new();
        let fields: [(&str, &dyn fmt::Display); 1] = [("Allow", &"GET, HEAD")];
        Response::new(StatusCode::METHOD_NOT_ALLOWED, ContentType::Json, Length::Bytes(7))
            .with(&fields)
            .write(&mut head)
            .unwrap();
        assert!(head.starts_with("HTTP/1.1 405 Method Not Allowed\r\nContent-Type: application/json\r\n"));
        assert!(head.ends_with("\r\n\r\n"));
        assert_eq!(head.matches("\r\n\r\n").count(), 1);
        for field in [
            "Content-Length: 7",
            "Allow: GET, HEAD",
            "X-Content-Type-Options: nosniff",
            "Cache-Control: no-store",
            "Content-Security-Policy: default-src 'none'; frame-ancestors 'none'",
            "Connection: close",
        ] {
            assert!(head.contains(field), "{field}");
        }
        assert!(!head.contains("Access-Control"));
    }

    #[test]
    fn a_page_that_a_browser_has_is_not_sent_again() {
        let page = Page { bytes: b"packed", policy: "default-src 'self'", etag: "\"1234abcd\"" };
        for (shown, status) in [
            (None, 200),
            (Some("\"1234abcd\""), 304),
            (Some("W/\"1234abcd\""), 304),
            (Some("\"0\",  \"1234abcd\" "), 304),
            (Some("\"1234abce\""), 200),
            (Some("1234abcd"), 200),
            (Some(",,"), 200),
            (Some(""), 200),
        ] {
            assert_eq!(page.status(shown), StatusCode(status), "{shown:?}");
        }
        let mut head = String::new();
        page.write_head(StatusCode::OK, &mut head).unwrap();
        for field in [
            "Content-Type: text/html; charset=utf-8",
            "Content-Length: 6",
            "Content-Encoding: gzip",
            "ETag: \"1234abcd\"",
            "Content-Security-Policy: default-src 'self'\r\n",
            "Cache-Control: no-cache",
        ] {
            assert!(head.contains(field), "{field}: {head}");
        }
        head.clear();
        page.write_head(StatusCode::NOT_MODIFIED, &mut head).unwrap();
        assert!(head.starts_with("HTTP/1.1 304 ") && head.contains("ETag: \"1234abcd\""), "{head}");
        assert!(!head.contains("Content-Length") && !head.contains("Content-Encoding"), "{head}");
    }

    #[test]
    fn chunks_have_their_length_in_hexadecimal_and_none_is_empty() {
        let mut body = String::new();
        for piece in ["0123456789abcdef", "", "x"] {
            write_chunk(&mut body, piece).unwrap();
        }
        body.push_str(LAST_CHUNK);
        assert_eq!(body, "10\r\n0123456789abcdef\r\n1\r\nx\r\n0\r\n\r\n");
    }
}
