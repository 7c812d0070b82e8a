//! The head of a response of HTTP/1.1.
//!
//! In: received bytes. Out: the status, fields, and how the body ends. Refuses ambiguous heads.

use std::fmt;

/// Maximum length of a head in bytes.
pub(crate) const MAX_HEAD: usize = 16 << 10;
const MAX_FIELDS: usize = 100;

#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct HttpHead {
    pub(crate) status: u16,
    fields: Vec<(String, String)>,
}

/// How the end of a body is found.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Framing {
    /// The body has this many bytes.
    Length(u64),
    /// The body is sent in chunks.
    Chunked,
    /// The body ends when the connection is closed.
    Close,
}

/// Why bytes are not a head.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum HeadError {
    Incomplete,
    /// The head is longer than [`MAX_HEAD`].
    TooLong,
    /// The bytes are not HTTP/1.1, or are ambiguous.
    Malformed,
}

impl fmt::Display for HeadError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Incomplete => "the answer ends within its head",
            Self::TooLong => "the answer's head is too long",
            Self::Malformed => "the answer is not one of HTTP/1.1",
        })
    }
}

impl HttpHead {
    /// The head at the front of `bytes`, and its length.
    pub(crate) fn parse(bytes: &[u8]) -> Result<(Self, usize), HeadError> {
        if !b"HTTP/1.".starts_with(&bytes[..bytes.len().min(7)]) {
            return Err(HeadError::Malformed);
        }
        let end = bytes.windows(4).take(MAX_HEAD).position(|four| four == b"\r\n\r\n");
        let Some(end) = end else {
            return Err(if bytes.len() >= MAX_HEAD { HeadError::TooLong } else { HeadError::Incomplete });
        };
        let text = std::str::from_utf8(&bytes[..end]).map_err(|_| HeadError::Malformed)?;
        let head = Self::parse_text(text).ok_or(HeadError::Malformed)?;
        Ok((head, end + 4))
    }

    fn parse_text(text: &str) -> Option<Self> {
        let mut lines = text.split("\r\n");
        let rest = lines.next()?.strip_prefix("HTTP/1.")?.strip_prefix(['0', '1'])?.strip_prefix(' ')?;
        let (code, reason) = rest.split_at_checked(3)?;
        let is_code = code.bytes().all(|byte| byte.is_ascii_digit());
        let status = code.parse().ok().filter(|status| (100..600).contains(status) && is_code)?;
        if !(reason.is_empty() || reason.starts_with(' ')) || reason.contains(char::is_control) {
            return None;
        }
        let mut fields = Vec::new();
        for line in lines {
            let (name, value) = line.split_once(':')?;
            let is_token = |byte: u8| byte.is_ascii_alphanumeric() || b"!#$%&'*+-.^_`|~".contains(&byte);
            let value = value.trim_matches([' ', '\t']);
            let is_fit = !name.is_empty()
                && name.bytes().all(is_token)
                && !value.contains(|c: char| c.is_control() && c != '\t');
            if !is_fit || fields.len() >= MAX_FIELDS {
                return None;
            }
            fields.push((name.to_ascii_lowercase(), value.to_owned()));
        }
        Some(Self { status, fields })
    }

    /// The value of a field with this lower-case name; `None` if it is absent or repeated.
    pub(crate) fn field(&self, name: &str) -> Option<&str> {
        let mut values = self.values(name);
        let value = values.next()?;
        values.next().is_none().then_some(value)
    }

    fn values(&self, name: &str) -> impl Iterator<Item = &str> {
        self.fields.iter().filter(move |(known, _)| known == name).map(|(_, value)| value.as_str())
    }

    pub(crate) fn framing(&self) -> Result<Framing, HeadError> {
        if self.status < 200 {
            // Too many interim responses.
            return Err(HeadError::Malformed);
        }
        if matches!(self.status, 204 | 304) {
            return Ok(Framing::Length(0));
        }
        let mut lengths = self.values("content-length");
        let (length, second) = (lengths.next(), lengths.next());
        let mut encodings = self.values("transfer-encoding");
        match (encodings.next(), length) {
            (Some(encoding), None) if encoding.eq_ignore_ascii_case("chunked") => {
                encodings.next().is_none().then_some(Framing::Chunked).ok_or(HeadError::Malformed)
            }
            (None, Some(length)) => {
                let is_number = length.bytes().all(|byte| byte.is_ascii_digit());
                let length = length.parse().ok().filter(|_| is_number && second.is_none());
                length.map(Framing::Length).ok_or(HeadError::Malformed)
            }
            (None, None) => Ok(Framing::Close),
            _ => Err(HeadError::Malformed),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_head_is_found_wherever_it_is_cut() {
        let text = b"HTTP/1.1 200 OK\r\nContent-Length: 3\r\nNext-Nonce:\tab \r\n\r\nxyz";
        for cut in 0..text.len() - 3 {
            assert_eq!(HttpHead::parse(&text[..cut]).unwrap_err(), HeadError::Incomplete, "{cut}");
        }
        let (head, len) = HttpHead::parse(text).unwrap();
        assert_eq!((head.status, &text[len..]), (200, &b"xyz"[..]));
        assert_eq!(head.field("next-nonce"), Some("ab"));
        assert_eq!(head.framing(), Ok(Framing::Length(3)));
    }

    #[track_caller]
    fn framing(fields: &str) -> Result<Framing, HeadError> {
        HttpHead::parse(format!("HTTP/1.1 200 OK\r\n{fields}\r\n").as_bytes())?.0.framing()
    }

    #[test]
    fn the_end_of_a_body_is_known_in_one_way_only() {
        assert_eq!(framing(""), Ok(Framing::Close));
        assert_eq!(framing("transfer-ENCODING: Chunked\r\n"), Ok(Framing::Chunked));
        for wrong in [
            "Content-Length: 3\r\nContent-Length: 3\r\n",
            "Content-Length: 3\r\nTransfer-Encoding: chunked\r\n",
            "Content-Length: +3\r\n",
            "Content-Length: 99999999999999999999\r\n",
            "Transfer-Encoding: gzip, chunked\r\n",
            "Transfer-Encoding: chunked\r\nTransfer-Encoding: chunked\r\n",
            "No colon\r\n",
            " folded: 1\r\n",
            "name : 1\r\n",
            "a: b\rc\r\n",
            "a: \u{1b}\r\n",
        ] {
            assert_eq!(framing(wrong), Err(HeadError::Malformed), "{wrong:?}");
        }
    }

    #[test]
    fn other_protocols_and_endless_heads_are_refused_early() {
        for wrong in
            ["SSH-2.0-x\r\n", "HTTP/2 200 OK\r\n\r\n", "HTTP/1.1 2x0 OK\r\n\r\n", "HTTP/1.1 200OK\r\n\r\n"]
        {
            assert_eq!(HttpHead::parse(wrong.as_bytes()).unwrap_err(), HeadError::Malformed, "{wrong:?}");
        }
        let endless = [b"HTTP/1.1 200 OK\r\na: ".as_slice(), &[b'x'; MAX_HEAD]].concat();
        assert_eq!(HttpHead::parse(&endless).unwrap_err(), HeadError::TooLong);
    }
}
