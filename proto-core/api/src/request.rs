//! The head of an HTTP/1.1 request: the request line and the header fields.
//!
//! In: received bytes, in pieces of any size. Out: an [`HttpHead`], or the reason why there is none. Does not know
//! paths, keys or bodies. An ambiguous request is refused, not interpreted: a field that matters may occur once, lines
//! end with CR LF, and a body has a `Content-Length`.

use core::str;

/// Maximum length of a head in bytes, with the empty line at its end.
pub const MAX_HEAD: usize = 2048;
/// Maximum number of header fields.
pub const MAX_FIELDS: usize = 32;

/// Collects the bytes of a head as they arrive, in a buffer of [`MAX_HEAD`] bytes.
#[derive(Debug, Clone)]
pub struct HeadBuffer<B = [u8; MAX_HEAD]> {
    bytes: B,
    len: usize,
    /// The last four bytes.
    tail: [u8; 4],
    is_complete: bool,
}

impl Default for HeadBuffer {
    fn default() -> Self {
        Self::new()
    }
}

impl HeadBuffer {
    /// An empty buffer.
    pub const fn new() -> Self {
        Self { bytes: [0; MAX_HEAD], len: 0, tail: [0; 4], is_complete: false }
    }
}

impl<'b> HeadBuffer<&'b mut [u8]> {
    /// An empty buffer in memory of the caller. With less than [`MAX_HEAD`] bytes, a head that does not fit never
    /// becomes complete.
    pub const fn within(bytes: &'b mut [u8]) -> Self {
        Self { bytes, len: 0, tail: [0; 4], is_complete: false }
    }
}

impl<B: AsRef<[u8]> + AsMut<[u8]>> HeadBuffer<B> {
    /// Whether nothing has arrived yet.
    pub const fn is_empty(&self) -> bool {
        self.len == 0
    }

    /// Takes received bytes up to the end of the head, and returns how many. The rest is the beginning of the body.
    /// Takes nothing if the head is complete or too long.
    pub fn push(&mut self, bytes: &[u8]) -> usize {
        if self.is_complete {
            return 0;
        }
        let mut taken = 0_usize;
        for (place, byte) in self.bytes.as_mut().iter_mut().take(MAX_HEAD).skip(self.len).zip(bytes) {
            *place = *byte;
            taken = taken.saturating_add(1);
            let [_, one, two, three] = self.tail;
            self.tail = [one, two, three, *byte];
            if self.tail == *b"\r\n\r\n" {
                self.is_complete = true;
                break;
            }
        }
        self.len = self.len.saturating_add(taken);
        taken
    }

    /// Parses the head.
    ///
    /// # Errors
    /// [`HeadError::Incomplete`] while more bytes are needed; otherwise why the request is refused.
    pub fn head(&self) -> Result<HttpHead<'_>, HeadError> {
        match (self.is_complete, self.bytes.as_ref().get(..self.len)) {
            (true, Some(head)) => HttpHead::parse(head),
            _ if self.len == MAX_HEAD => Err(HeadError::TooLong),
            _ => Err(HeadError::Incomplete),
        }
    }
}

/// The method of a request.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Method {
    /// `GET`.
    Get,
    /// `HEAD`: as `GET`, but only the head is returned.
    Head,
    /// `POST`.
    Post,
    /// `PUT`.
    Put,
    /// Any other method; no endpoint allows one.
    Other,
}

impl Method {
    /// The name on the wire; empty for [`Method::Other`].
    pub const fn name(self) -> &'static str {
        match self {
            Self::Get => "GET",
            Self::Head => "HEAD",
            Self::Post => "POST",
            Self::Put => "PUT",
            Self::Other => "",
        }
    }

    fn of(name: &str) -> Self {
        let known = [Self::Get, Self::Head, Self::Post, Self::Put];
        known.into_iter().find(|method| method.name() == name).unwrap_or(Self::Other)
    }
}

/// The head of a request.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[non_exhaustive]
pub struct HttpHead<'a> {
    /// The method.
    pub method: Method,
    /// Path and query, as sent.
    pub target: &'a str,
    /// `Host`: a name or address, with or without a port.
    pub host: &'a str,
    /// `Origin`: the origin of the page that makes the request. Only browsers send it.
    pub origin: Option<&'a str>,
    /// `Sec-Fetch-Site`: how that page is related to this server. Only browsers send it.
    pub fetch_site: Option<&'a str>,
    /// `Authorization`.
    pub authorization: Option<&'a str>,
    /// `Content-Type`.
    pub content_type: Option<&'a str>,
    /// `If-Match`.
    pub if_match: Option<&'a str>,
    /// `If-None-Match`.
    pub if_none_match: Option<&'a str>,
    /// Length of the body in bytes.
    pub length: u64,
    /// Whether the client waits for `100 Continue` before it sends the body.
    pub expects_continue: bool,
}

/// Why there is no [`HttpHead`].
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[non_exhaustive]
pub enum HeadError {
    /// More bytes are needed.
    Incomplete,
    /// The head is longer than [`MAX_HEAD`], or has more than [`MAX_FIELDS`] fields.
    TooLong,
    /// It is no HTTP/1.x request, for example because a field has no colon.
    Malformed,
    /// The version is not HTTP/1.1.
    Version,
    /// There is no `Host`.
    NoHost,
    /// A field that may occur once occurs twice.
    Repeated,
    /// The body has no known length, such as with `Transfer-Encoding`.
    NoLength,
    /// `Expect` is not `100-continue`.
    Expectation,
}

impl<'a> HttpHead<'a> {
    fn parse(bytes: &'a [u8]) -> Result<Self, HeadError> {
        // Other characters could be read in two ways, or hide something in a log.
        let is_text = |byte: &u8| matches!(byte, b' '..=b'~' | 0x80.. | b'\t' | b'\r' | b'\n');
        if !bytes.iter().all(is_text) {
            return Err(HeadError::Malformed);
        }
        let mut lines = Lines(bytes);
        let first = lines.next().ok_or(HeadError::Malformed)?;
        let (method, rest) = cut(first, b' ').ok_or(HeadError::Malformed)?;
        let (target, version) = cut(rest, b' ').ok_or(HeadError::Malformed)?;
        if method.is_empty()
            || !method.bytes().all(is_of_token)
            || !target.bytes().all(|byte| byte.is_ascii_graphic())
        {
            return Err(HeadError::Malformed);
        }
        match version {
            "HTTP/1.1" => {}
            _ if version.starts_with("HTTP/") => return Err(HeadError::Version),
            _ => return Err(HeadError::Malformed),
        }
        if !target.starts_with('/') {
            return Err(HeadError::Malformed);
        }
        let mut head = Self {
            method: Method::of(method),
            target,
            host: "",
            origin: None,
            fetch_site: None,
            authorization: None,
            content_type: None,
            if_match: None,
            if_none_match: None,
            length: 0,
            expects_continue: false,
        };
        let (mut host, mut length, mut expect) = (None, None, None);
        for nth in 0_usize.. {
            let Some(line) = lines.next() else { break };
            if nth >= MAX_FIELDS {
                return Err(HeadError::TooLong);
            }
            let (name, value) = cut(line, b':').ok_or(HeadError::Malformed)?;
            // Refuses blanks before the colon, and blanks at the start of a line, which would continue the one before.
            if name.is_empty() || !name.bytes().all(is_of_token) {
                return Err(HeadError::Malformed);
            }
            let place = match name {
                name if name.eq_ignore_ascii_case("host") => &mut host,
                name if name.eq_ignore_ascii_case("content-length") => &mut length,
                name if name.eq_ignore_ascii_case("expect") => &mut expect,
                name if name.eq_ignore_ascii_case("origin") => &mut head.origin,
                name if name.eq_ignore_ascii_case("sec-fetch-site") => &mut head.fetch_site,
                name if name.eq_ignore_ascii_case("authorization") => &mut head.authorization,
                name if name.eq_ignore_ascii_case("content-type") => &mut head.content_type,
                name if name.eq_ignore_ascii_case("if-match") => &mut head.if_match,
                name if name.eq_ignore_ascii_case("if-none-match") => &mut head.if_none_match,
                name if name.eq_ignore_ascii_case("transfer-encoding") => return Err(HeadError::NoLength),
                _ => continue,
            };
            // The fields that are read here are ASCII. Others, such as cookies, may contain anything.
            if !value.is_ascii() {
                return Err(HeadError::Malformed);
            }
            if place.replace(trim(value)).is_some() {
                return Err(HeadError::Repeated);
            }
        }
        // The loop ends at the empty line, but also at a malformed line, such as one that ends with CR alone.
        if lines.0 != b"\r\n" {
            return Err(HeadError::Malformed);
        }
        head.host = host.ok_or(HeadError::NoHost)?;
        head.length = length.map_or(Ok(0), decimal)?;
        head.expects_continue = match expect {
            None => false,
            Some(value) if value.eq_ignore_ascii_case("100-continue") => true,
            Some(_) => return Err(HeadError::Expectation),
        };
        Ok(head)
    }

    /// The path, without the query.
    pub fn path(&self) -> &'a str {
        cut(self.target, b'?').map_or(self.target, |(path, _)| path)
    }

    /// The value of `name` in the query, such as `revision` in `?revision=3`, without percent-decoding.
    pub fn query(&self, name: &str) -> Option<&'a str> {
        let (_, mut rest) = cut(self.target, b'?')?;
        while !rest.is_empty() {
            let (item, behind) = cut(rest, b'&').unwrap_or((rest, ""));
            match cut(item, b'=') {
                Some((key, value)) if key == name => return Some(value),
                _ => rest = behind,
            }
        }
        None
    }

    /// Whether the query has only these arguments, each with a value and at most once.
    pub fn has_only(&self, arguments: &[&str]) -> bool {
        let Some((_, mut rest)) = cut(self.target, b'?') else { return true };
        while !rest.is_empty() {
            let (item, behind) = cut(rest, b'&').unwrap_or((rest, ""));
            let Some((name, _)) = cut(item, b'=') else { return false };
            if !arguments.contains(&name) || has_item(behind, name) {
                return false;
            }
            rest = behind;
        }
        true
    }

    /// `Host` without the port.
    pub fn host_name(&self) -> &'a str {
        // An IPv6 address contains colons, but is in brackets.
        let end = match self.host.bytes().position(|byte| byte == b']') {
            Some(at) => at.saturating_add(1),
            None => self.host.bytes().position(|byte| byte == b':').unwrap_or(self.host.len()),
        };
        self.host.get(..end).unwrap_or(self.host)
    }
}

/// Whether a query has an argument of this name.
fn has_item(mut query: &str, name: &str) -> bool {
    while !query.is_empty() {
        let (item, behind) = cut(query, b'&').unwrap_or((query, ""));
        if cut(item, b'=').is_some_and(|(other, _)| other == name) {
            return true;
        }
        query = behind;
    }
    false
}

/// The lines of a head. Each ends with CR LF and contains no control character but tabs.
struct Lines<'a>(&'a [u8]);

impl<'a> Lines<'a> {
    /// The next line; `None` at the empty line.
    fn next(&mut self) -> Option<&'a str> {
        let end = self.0.iter().position(|&byte| matches!(byte, b'\r' | b'\n'))?;
        let (line, rest) = self.0.split_at_checked(end).filter(|(line, _)| !line.is_empty())?;
        self.0 = rest.strip_prefix(b"\r\n")?;
        str::from_utf8(line).ok()
    }
}

/// What comes before and after the first `at`, which must be ASCII. `str::split_once` has panics that the optimiser
/// does not remove.
pub(crate) fn cut(text: &str, at: u8) -> Option<(&str, &str)> {
    let place = text.bytes().position(|byte| byte == at)?;
    Some((text.get(..place)?, text.get(place.saturating_add(1)..)?))
}

/// Removes blanks and tabs at both ends.
pub(crate) fn trim(mut text: &str) -> &str {
    while let Some(rest) = text.strip_prefix(' ').or_else(|| text.strip_prefix('\t')) {
        text = rest;
    }
    while let Some(rest) = text.strip_suffix(' ').or_else(|| text.strip_suffix('\t')) {
        text = rest;
    }
    text
}

/// Whether a field name may contain this byte (RFC 9110 section 5.6.2).
fn is_of_token(byte: u8) -> bool {
    byte.is_ascii_alphanumeric() || b"!#$%&'*+-.^_`|~".contains(&byte)
}

/// Parses digits alone: no sign, no blanks, no list of equal lengths.
fn decimal(text: &str) -> Result<u64, HeadError> {
    if text.is_empty() || !text.bytes().all(|byte| byte.is_ascii_digit()) {
        return Err(HeadError::Malformed);
    }
    text.parse().map_err(|_| HeadError::Malformed)
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::format;
    use std::string::String;

    #[track_caller]
    fn error(request: &str) -> HeadError {
        let mut buffer = HeadBuffer::new();
        buffer.push(request.as_bytes());
        buffer.head().map(|head| format!("{head:?}")).unwrap_err()
    }

    #[test]
    fn a_head_is_the_same_however_it_is_cut() {
        let request = "PUT /api/v1/config?a=1&revision=3 HTTP/1.1\r\nhost: [::1]:8480\r\nContent-Length: 12\r\n\
                       If-Match:  \"3-9\" \r\nExpect: 100-Continue\r\nX: y\r\n\r\nrest";
        let (head_len, bytes) = (request.len() - 4, request.as_bytes());
        for cut in 0..bytes.len() {
            let mut buffer = HeadBuffer::new();
            let first = buffer.push(&bytes[..cut]);
            if cut < head_len {
                assert_eq!(first, cut);
                assert_eq!(buffer.head(), Err(HeadError::Incomplete));
            }
            let taken = first + buffer.push(&bytes[first..]);
            assert_eq!(taken, head_len);
            assert_eq!(buffer.push(b"more"), 0);
            let head = buffer.head().unwrap();
            assert_eq!((head.method, head.path(), head.length), (Method::Put, "/api/v1/config", 12));
            assert_eq!((head.query("revision"), head.query("b")), (Some("3"), None));
            assert_eq!((head.host, head.host_name()), ("[::1]:8480", "[::1]"));
            assert_eq!((head.if_match, head.expects_continue), (Some("\"3-9\""), true));
        }
    }

    #[test]
    fn what_is_not_clear_is_refused() {
        let start = "GET / HTTP/1.1\r\nHost: a\r\n";
        assert_eq!(error("GET / HTTP/1.1\r\n\r\n"), HeadError::NoHost);
        assert_eq!(error("GET / HTTP/1.0\r\nHost: a\r\n\r\n"), HeadError::Version);
        assert_eq!(error("GET http://a/ HTTP/1.1\r\nHost: a\r\n\r\n"), HeadError::Malformed);
        assert_eq!(error("GET / HTTP/1.1\nHost: a\r\n\r\n"), HeadError::Malformed);
        assert_eq!(error(&format!("{start}host: b\r\n\r\n")), HeadError::Repeated);
        assert_eq!(
            error(&format!("{start}Content-Length: 1\r\nContent-Length: 1\r\n\r\n")),
            HeadError::Repeated
        );
        assert_eq!(error(&format!("{start}Transfer-Encoding: chunked\r\n\r\n")), HeadError::NoLength);
        assert_eq!(error(&format!("{start}Expect: tea\r\n\r\n")), HeadError::Expectation);
        assert_eq!(error(&format!("{start}Origin: \u{e9}\r\n\r\n")), HeadError::Malformed);
        for wrong in ["", "+1", "-1", "1, 1", "0x1", "99999999999999999999"] {
            assert_eq!(
                error(&format!("{start}Content-Length: {wrong}\r\n\r\n")),
                HeadError::Malformed,
                "{wrong}"
            );
        }
        for wrong in [" Host: b\r\n", "Host : b\r\n", "no colon\r\n", "\0: 1\r\n"] {
            assert_eq!(error(&format!("{start}{wrong}\r\n")), HeadError::Malformed, "{wrong:?}");
        }
        for wrong in ["\r\n\r\n", "GET / HTTP/1.1\r\r\n\r\n", "GET / HTTP/1.1\r\nHost: a\rb\r\n\r\n"] {
            assert_eq!(error(wrong), HeadError::Malformed, "{wrong:?}");
        }
    }

    #[test]
    fn fields_that_nobody_asks_for_may_be_in_any_language() {
        let mut buffer = HeadBuffer::new();
        buffer.push("GET / HTTP/1.1\r\nCookie: n=é\r\nHost: a\r\n\r\n".as_bytes());
        assert_eq!(buffer.head().map(|head| head.host), Ok("a"));
    }

    #[test]
    fn a_head_may_be_in_other_memory_which_may_be_longer() {
        let mut memory = [0xA5; MAX_HEAD + 4];
        let mut buffer = HeadBuffer::within(&mut memory);
        assert_eq!(buffer.push(b"GET /a HTTP/1.1\r\nHost: a\r\n\r\nrest"), 28);
        assert_eq!(buffer.head().map(|head| (head.method, head.target)), Ok((Method::Get, "/a")));
        let mut buffer = HeadBuffer::within(&mut memory);
        assert_eq!(buffer.push(&[b'a'; MAX_HEAD + 4]), MAX_HEAD);
        assert_eq!(buffer.head(), Err(HeadError::TooLong));
        assert_eq!(memory[MAX_HEAD..], [0xA5; 4]);
    }

    #[test]
    fn a_head_has_a_limit() {
        let start = "GET / HTTP/1.1\r\nHost: a\r\nX: ";
        let of = |len: usize| format!("{start}{}\r\n\r\n", "x".repeat(len - start.len() - 4));
        let mut buffer = HeadBuffer::new();
        assert_eq!(buffer.push(of(MAX_HEAD).as_bytes()), MAX_HEAD);
        assert_eq!(buffer.head().map(|head| head.host), Ok("a"));
        assert_eq!(error(&of(MAX_HEAD + 1)), HeadError::TooLong);
        let fields: String = (0..MAX_FIELDS).map(|n| format!("F{n}: 1\r\n")).collect();
        assert_eq!(error(&format!("GET / HTTP/1.1\r\nHost: a\r\n{fields}\r\n")), HeadError::TooLong);
    }
}
