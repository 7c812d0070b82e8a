//! A server as small as a test needs.

use std::io::{Read, Write};
use std::net::{SocketAddr, TcpListener, TcpStream};
use std::path::PathBuf;
use std::sync::{Arc, Mutex};
use std::time::Duration;

use recipe_api::key::{BodyHash, Hex, Key, Signed};
use recipe_ctl::{Client, Stop, TableView};
use serde_json::Value;
use tempfile::TempDir;

pub(crate) const KEY: &str = "00112233445566778899aabbccddeeff";
pub(crate) const WIDE: TableView = TableView { width: None, is_terminal: false };

/// A request as it came.
#[derive(Debug, Clone)]
pub(crate) struct Asked {
    pub(crate) method: String,
    /// Behind `/api/v1/`.
    pub(crate) path: String,
    pub(crate) head: String,
    pub(crate) body: Vec<u8>,
}

impl Asked {
    pub(crate) fn field(&self, name: &str) -> Option<&str> {
        let mut lines = self.head.lines().filter_map(|line| line.split_once(": "));
        lines.find(|(known, _)| *known == name).map(|(_, value)| value)
    }

    /// The nonce of a request that is signed with [`KEY`], as docs/api.md says.
    pub(crate) fn signed_nonce(&self) -> Option<String> {
        let fields = self.field("Authorization")?.strip_prefix("RGW-HMAC-SHA256 ")?;
        let value = |name: &str| {
            let mut parts = fields.split(", ").filter_map(|part| part.split_once('='));
            parts.find(|(known, _)| *known == name).map(|(_, value)| value)
        };
        let mut hash = BodyHash::new();
        hash.update(&self.body);
        let body = Hex(&hash.finish()).to_string();
        let (nonce, target) = (value("nonce")?, format!("/api/v1/{}", self.path));
        let what = Signed { nonce, method: &self.method, target: &target, body: &body };
        let mac = recipe_api::key::from_hex(value("mac")?)?;
        let is_right = value("body") == Some(&body) && Key::parse(KEY)?.verify(&what, &mac);
        is_right.then(|| nonce.to_owned())
    }

    /// The body as JSON.
    pub(crate) fn json(&self) -> Value {
        serde_json::from_slice(&self.body).unwrap()
    }
}

/// What a connection gets.
pub(crate) enum Reply {
    /// These bytes, and the end.
    Bytes(Vec<u8>),
    /// The test writes to the connection until that fails.
    Write(Writing),
}

/// Writes to a connection.
type Writing = Box<dyn FnOnce(&mut TcpStream) -> std::io::Result<()> + Send>;

pub(crate) fn document(status: u16, fields: &str, body: &Value) -> Reply {
    bytes(status, "application/json", fields, body.to_string().as_bytes())
}

/// A body of any type; `fields` are lines that end with CR and LF.
pub(crate) fn bytes(status: u16, kind: &str, fields: &str, body: &[u8]) -> Reply {
    let head = format!(
        "HTTP/1.1 {status} x\r\nContent-Type: {kind}\r\nContent-Length: {}\r\n{fields}\r\n",
        body.len()
    );
    Reply::Bytes([head.as_bytes(), body].concat())
}

pub(crate) fn ok(body: &Value) -> Reply {
    document(200, "", body)
}

/// There is no such path.
pub(crate) fn not_found() -> Reply {
    document(404, "", &serde_json::json!({ "error": "there is no such path" }))
}

/// The head of an endless stream.
pub(crate) const ENDLESS: &[u8] = b"HTTP/1.1 200 OK\r\nContent-Type: text/event-stream\r\n\r\n";

/// A server that answers until it is dropped.
pub(crate) struct Server {
    pub(crate) at: SocketAddr,
    asked: Arc<Mutex<Vec<Asked>>>,
}

impl Server {
    /// Answers each request with what `answer` says.
    pub(crate) fn start(answer: impl Fn(&Asked) -> Reply + Send + Sync + 'static) -> Self {
        let listener = TcpListener::bind("127.0.0.1:0").unwrap();
        let at = listener.local_addr().unwrap();
        let asked = Arc::<Mutex<Vec<Asked>>>::default();
        let (answer, all) = (Arc::new(answer), Arc::clone(&asked));
        std::thread::spawn(move || {
            for stream in listener.incoming().map_while(Result::ok) {
                let (answer, all) = (Arc::clone(&answer), Arc::clone(&all));
                std::thread::spawn(move || serve(stream, &*answer, &all));
            }
        });
        Self { at, asked }
    }

    /// The requests so far.
    pub(crate) fn asked(&self) -> Vec<Asked> {
        self.asked.lock().unwrap().clone()
    }

    /// The paths of the requests so far.
    pub(crate) fn paths(&self) -> Vec<String> {
        self.asked().into_iter().map(|asked| format!("{} {}", asked.method, asked.path)).collect()
    }

    /// A client with or without [`KEY`].
    pub(crate) fn client(&self, has_key: bool) -> Client {
        self.patient(has_key, Duration::from_secs(20))
    }

    /// A client that waits so long for an answer.
    pub(crate) fn patient(&self, has_key: bool, timeout: Duration) -> Client {
        let key = has_key.then(|| Key::parse(KEY).unwrap());
        Client::new(self.at.to_string().parse().unwrap(), key, timeout, Stop::new()).unwrap()
    }
}

fn serve(mut stream: TcpStream, answer: &dyn Fn(&Asked) -> Reply, all: &Mutex<Vec<Asked>>) {
    let Some(asked) = read(&mut stream) else { return };
    all.lock().unwrap().push(asked.clone());
    let _ = match answer(&asked) {
        Reply::Bytes(bytes) => stream.write_all(&bytes),
        Reply::Write(write) => write(&mut stream),
    };
}

fn read(stream: &mut TcpStream) -> Option<Asked> {
    let (mut bytes, mut chunk) = (Vec::new(), [0; 4_096]);
    let end = loop {
        let count = stream.read(&mut chunk).ok().filter(|count| *count > 0)?;
        bytes.extend(&chunk[..count]);
        if let Some(end) = bytes.windows(4).position(|four| four == b"\r\n\r\n") {
            break end;
        }
    };
    let head = String::from_utf8(bytes[..end].to_vec()).ok()?;
    let mut words = head.split(' ');
    let (method, target) = (words.next()?.to_owned(), words.next()?.to_owned());
    let path = target.strip_prefix("/api/v1/")?.to_owned();
    let mut asked = Asked { method, path, head, body: bytes.split_off(end + 4) };
    let length: usize = asked.field("Content-Length").map_or(0, |length| length.parse().unwrap());
    while asked.body.len() < length {
        let count = stream.read(&mut chunk).ok().filter(|count| *count > 0)?;
        asked.body.extend(&chunk[..count]);
    }
    Some(asked)
}

/// Writes [`KEY`] to a file of this name; returns its path.
pub(crate) fn key_file(folder: &TempDir, name: &str) -> PathBuf {
    use std::os::unix::fs::OpenOptionsExt;
    let path = folder.path().join(name);
    let mut file = std::fs::File::options().write(true).create_new(true).mode(0o600).open(&path).unwrap();
    file.write_all(KEY.as_bytes()).unwrap();
    path
}
