//! A client of the API: one request per connection, signed as over a network.

use std::io::{Read, Write};
use std::net::{SocketAddr, TcpStream};

use recipe_api::key::{BodyHash, Hex, Key, SCHEME, Signed};
use serde_json::Value;

use crate::PATIENCE;

/// A response.
#[derive(Debug)]
pub struct Response {
    /// The status code.
    pub status: u16,
    /// Status line and fields.
    pub head: String,
    /// The body, with its chunks joined.
    pub body: Vec<u8>,
    /// Whether the body has the announced length, or ends with the last chunk.
    pub is_whole: bool,
}

impl Response {
    /// Parses what a server has sent; `None` if the head is incomplete or invalid.
    pub fn parse(bytes: &[u8]) -> Option<Self> {
        let end = bytes.windows(4).position(|four| four == b"\r\n\r\n")?;
        let head = String::from_utf8(bytes[..end].to_vec()).ok()?;
        let status = head.split(' ').nth(1)?.parse().ok()?;
        let mut response = Self { status, head, body: bytes[end + 4..].to_vec(), is_whole: true };
        if response.field("Transfer-Encoding") == Some("chunked") {
            response.is_whole = response.join_chunks().is_some();
        } else if let Some(length) = response.field("Content-Length") {
            response.is_whole = length.parse() == Ok(response.body.len());
        }
        Some(response)
    }

    /// Joins the chunks of the body; `None` if the last one is missing.
    fn join_chunks(&mut self) -> Option<()> {
        let framed = std::mem::take(&mut self.body);
        let mut rest = &framed[..];
        loop {
            let end = rest.windows(2).position(|two| two == b"\r\n")?;
            let len = usize::from_str_radix(str::from_utf8(&rest[..end]).ok()?, 16).ok()?;
            rest = rest.get(end + 2..)?;
            if len == 0 {
                return (rest == b"\r\n").then_some(());
            }
            self.body.extend_from_slice(rest.get(..len)?);
            rest = rest.get(len..)?.strip_prefix(b"\r\n")?;
        }
    }

    /// A field of the head.
    pub fn field(&self, name: &str) -> Option<&str> {
        let mut lines = self.head.lines().skip(1).filter_map(|line| line.split_once(": "));
        lines.find(|(other, _)| other.eq_ignore_ascii_case(name)).map(|(_, value)| value)
    }

    /// The body as text.
    ///
    /// # Panics
    /// If it is not UTF-8.
    #[track_caller]
    pub fn text(&self) -> &str {
        str::from_utf8(&self.body).unwrap()
    }

    /// The body as JSON.
    ///
    /// # Panics
    /// If it is not JSON.
    #[track_caller]
    pub fn json(&self) -> Value {
        serde_json::from_slice(&self.body).unwrap_or_else(|error| panic!("{error}: {}", self.text()))
    }

    /// Returns the response if it is complete and has this status.
    ///
    /// # Panics
    /// If it is incomplete or has another status.
    #[track_caller]
    pub fn must_be(self, status: u16) -> Self {
        assert!(
            self.status == status && self.is_whole,
            "{}\n{}",
            self.head,
            String::from_utf8_lossy(&self.body)
        );
        self
    }
}

/// A client of one server.
#[derive(Debug, Clone)]
pub struct Client {
    /// The server's address.
    pub to: SocketAddr,
    /// The value of the `Host` field.
    pub host: String,
    /// The key; `None` to sign nothing.
    pub key: Option<Key>,
}

impl Client {
    /// Sends bytes and returns everything received until the end of the connection, or until it is reset.
    ///
    /// # Errors
    /// The connection cannot be opened.
    pub fn exchange(&self, bytes: &[u8]) -> std::io::Result<Vec<u8>> {
        let mut stream = TcpStream::connect(self.to)?;
        stream.set_read_timeout(Some(PATIENCE))?;
        // The server may close the connection before it has read everything.
        let _ = stream.write_all(bytes);
        let mut answer = Vec::new();
        let mut chunk = [0; 4096];
        while let Ok(count @ 1..) = stream.read(&mut chunk) {
            answer.extend_from_slice(&chunk[..count]);
        }
        Ok(answer)
    }

    /// Opens a connection with a small receive buffer, so that the server soon notices a client that does not read.
    ///
    /// # Errors
    /// The connection cannot be opened.
    pub fn narrow_connection(&self) -> std::io::Result<TcpStream> {
        use rustix::net::{AddressFamily, SocketType, connect, socket, sockopt};
        let family = if self.to.is_ipv4() { AddressFamily::INET } else { AddressFamily::INET6 };
        let socket = socket(family, SocketType::STREAM, None)?;
        // Set before connecting, because the size of the window is announced then.
        sockopt::set_socket_recv_buffer_size(&socket, 4096)?;
        connect(&socket, &self.to)?;
        Ok(socket.into())
    }

    /// The bytes of a request; `line` is such as `GET /api/v1/info`, `fields` are further lines of its head.
    pub fn bytes(&self, line: &str, fields: &str, body: &[u8]) -> Vec<u8> {
        let length =
            if body.is_empty() { String::new() } else { format!("Content-Length: {}\r\n", body.len()) };
        let fields: String = fields.lines().map(|line| format!("{}\r\n", line.trim())).collect();
        let head = format!("{line} HTTP/1.1\r\nHost: {}\r\n{fields}{length}\r\n", self.host);
        [head.as_bytes(), body].concat()
    }

    /// Sends an unsigned request; `None` if the response has no complete head.
    pub fn try_request(&self, line: &str, fields: &str, body: &[u8]) -> Option<Response> {
        Response::parse(&self.exchange(&self.bytes(line, fields, body)).ok()?)
    }

    /// Sends an unsigned request.
    ///
    /// # Panics
    /// If there is no response.
    #[track_caller]
    pub fn request(&self, line: &str, fields: &str, body: &[u8]) -> Response {
        self.try_request(line, fields, body).unwrap_or_else(|| panic!("{line} was not answered"))
    }

    /// Requests a fresh nonce.
    ///
    /// # Panics
    /// If the server returns none.
    #[track_caller]
    pub fn nonce(&self) -> String {
        let answer = self.request("GET /api/v1/nonce", "", b"").must_be(200).json();
        answer["nonce"].as_str().unwrap().to_owned()
    }

    /// The `Authorization` field of a request, signed with the client's key, or with a wrong key if it has none.
    ///
    /// # Panics
    /// If `line` is not a request line.
    pub fn signature(&self, nonce: &str, line: &str, body: &[u8]) -> String {
        let (method, target) = line.split_once(' ').unwrap();
        let mut hash = BodyHash::new();
        hash.update(body);
        let body = Hex(&hash.finish()).to_string();
        let key = self.key.clone().unwrap_or(Key::new([0x5A; 16]));
        let mac = key.sign(&Signed { nonce, method, target, body: &body });
        format!("Authorization: {SCHEME} nonce={nonce}, body={body}, mac={}", Hex(&mac))
    }

    /// Sends a signed request.
    ///
    /// # Panics
    /// If there is no response.
    #[track_caller]
    pub fn signed(&self, line: &str, fields: &str, body: &[u8]) -> Response {
        let signature = self.signature(&self.nonce(), line, body);
        self.request(line, &format!("{signature}\n{fields}"), body)
    }

    /// Sends a signed `GET`.
    ///
    /// # Panics
    /// If there is no response.
    #[track_caller]
    pub fn get(&self, path: &str) -> Response {
        self.signed(&format!("GET /api/v1/{path}"), "", b"")
    }

    /// Sends a signed `GET`; `None` unless it succeeds. A board may have no free connection, or refuse the key.
    pub fn try_get(&self, path: &str) -> Option<Response> {
        let nonce = self.try_request("GET /api/v1/nonce", "", b"")?.json();
        let line = format!("GET /api/v1/{path}");
        let signature = self.signature(nonce["nonce"].as_str()?, &line, b"");
        self.try_request(&line, &signature, b"").filter(|answer| answer.status == 200)
    }

    /// Sends a signed `POST` with a JSON body.
    ///
    /// # Panics
    /// If there is no response.
    #[track_caller]
    pub fn post(&self, path: &str, body: &str) -> Response {
        self.signed(&format!("POST /api/v1/{path}"), "Content-Type: application/json", body.as_bytes())
    }
}
