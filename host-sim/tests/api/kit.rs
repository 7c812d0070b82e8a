//! A client as small as a request, and the processes that it asks.

use std::io::{Read, Write};
use std::net::{SocketAddr, TcpStream};
use std::path::PathBuf;

use recipe_api::key::{BodyHash, Hex, Key, SCHEME, Signed};
use recipe_test_kit::{Binary, HostSim, PATIENCE, toml, until};
use serde_json::Value;
use tempfile::TempDir;

pub(crate) const BINARY: Binary = Binary(env!("CARGO_BIN_EXE_host-sim"));
pub(crate) const KEY: &str = "00112233445566778899aabbccddeeff";

/// A response.
#[derive(Debug)]
pub(crate) struct Response {
    pub(crate) status: u16,
    pub(crate) head: String,
    pub(crate) body: String,
}

impl Response {
    /// A field of the head.
    pub(crate) fn field(&self, name: &str) -> Option<&str> {
        let mut lines = self.head.lines().skip(1).filter_map(|line| line.split_once(": "));
        lines.find(|(other, _)| other.eq_ignore_ascii_case(name)).map(|(_, value)| value)
    }

    /// The body as JSON.
    #[track_caller]
    pub(crate) fn json(&self) -> Value {
        serde_json::from_str(&self.body).unwrap_or_else(|error| panic!("{error}: {self:?}"))
    }

    #[track_caller]
    pub(crate) fn must_be(self, status: u16) -> Self {
        assert_eq!(self.status, status, "{self:?}");
        self
    }
}

/// Sends bytes and reads what comes until the end; `None` if the connection was reset.
pub(crate) fn send(to: SocketAddr, bytes: &[u8]) -> Option<String> {
    let mut stream = TcpStream::connect(to).unwrap();
    stream.set_read_timeout(Some(PATIENCE)).unwrap();
    // The server may have refused it before its end.
    let _ = stream.write_all(bytes);
    let mut answer = Vec::new();
    stream.read_to_end(&mut answer).ok()?;
    // The page is compressed; everything else is text.
    Some(String::from_utf8_lossy(&answer).into_owned())
}

pub(crate) fn parse(answer: &str) -> Response {
    let (head, body) = answer.split_once("\r\n\r\n").unwrap_or_else(|| panic!("no head: {answer:?}"));
    let status = head.split(' ').nth(1).and_then(|code| code.parse().ok()).unwrap();
    Response { status, head: head.to_owned(), body: body.to_owned() }
}

/// A request with these further lines of its head, and a body.
#[track_caller]
pub(crate) fn request(to: SocketAddr, line: &str, fields: &str, body: &str) -> Response {
    let length = if body.is_empty() { String::new() } else { format!("Content-Length: {}\r\n", body.len()) };
    let fields: String = fields.lines().map(|line| format!("{}\r\n", line.trim())).collect();
    let host = if fields.contains("Host:") { String::new() } else { format!("Host: {to}\r\n") };
    let text = format!("{line} HTTP/1.1\r\n{host}{fields}{length}\r\n{body}");
    parse(&send(to, text.as_bytes()).unwrap_or_else(|| panic!("{line}: the connection was reset")))
}

#[track_caller]
pub(crate) fn get(to: SocketAddr, path: &str) -> Response {
    request(to, &format!("GET /api/v1/{path}"), "", "")
}

/// With the key.
#[track_caller]
pub(crate) fn post(to: SocketAddr, path: &str, body: &str) -> Response {
    let fields = format!("Authorization: Bearer {KEY}\nContent-Type: application/json");
    request(to, &format!("POST /api/v1/{path}"), &fields, body)
}

/// A configuration that was made from the revision with this ETag.
#[track_caller]
pub(crate) fn put(to: SocketAddr, etag: &str, config: &str) -> Response {
    let fields = format!("Authorization: Bearer {KEY}\nContent-Type: application/toml\nIf-Match: {etag}");
    request(to, "PUT /api/v1/config", &fields, config)
}

/// The fields of a signed request.
pub(crate) fn sign(nonce: &str, method: &str, target: &str, body: &str) -> String {
    let mut hash = BodyHash::new();
    hash.update(body.as_bytes());
    let body = Hex(&hash.finish()).to_string();
    let mac = Key::parse(KEY).unwrap().sign(&Signed { nonce, method, target, body: &body });
    format!(
        "Authorization: {SCHEME} nonce={nonce}, body={body}, mac={}\nContent-Type: application/json",
        Hex(&mac)
    )
}

/// A gateway with a panel, a console and its controller.
pub(crate) struct Cell {
    pub(crate) gateway: HostSim,
    pub(crate) robot: HostSim,
    pub(crate) console: SocketAddr,
    pub(crate) folder: TempDir,
}

impl Cell {
    pub(crate) fn new() -> Self {
        Self::with("tcp-listen:127.0.0.1:0", &config(500))
    }

    /// With another device, in which FOLDER stands for the cell's, and another configuration.
    pub(crate) fn with(device: &str, config: &str) -> Self {
        let folder = tempfile::tempdir().unwrap();
        write_key(&folder);
        std::fs::write(folder.path().join("robot.toml"), ROBOT).unwrap();
        std::fs::write(folder.path().join("cell.toml"), config).unwrap();
        let robot = BINARY.controller(&folder.path().join("robot.toml"), &[]);
        let device = device.replace("FOLDER", folder.path().to_str().unwrap());
        let gateway = gateway(&folder, &robot, &device, &[]);
        let console = gateway.at("console");
        Self { gateway, robot, console, folder }
    }

    /// Ends the gateway and starts it again.
    pub(crate) fn restart(&mut self) {
        self.restart_with(&[]);
    }

    /// Same, with further options.
    pub(crate) fn restart_with(&mut self, options: &[&str]) {
        // One process uses the folder of revisions.
        self.gateway.end_by(rustix::process::Signal::TERM);
        self.gateway = gateway(&self.folder, &self.robot, "tcp-listen:127.0.0.1:0", options);
        self.console = self.gateway.at("console");
    }

    /// The panel's connection to the gateway that runs now.
    pub(crate) fn panel(&self) -> TcpStream {
        let info = get(self.console, "info").must_be(200).json();
        let place = info["places"]["ports"]["device"].as_str().unwrap().parse::<SocketAddr>().unwrap();
        TcpStream::connect(place).unwrap()
    }

    /// The panel switches its outputs, until the controller has them: a gateway that has just started drops
    /// what comes before its links are up.
    #[track_caller]
    pub(crate) fn switch(&self, panel: &mut impl Write, value: u8) {
        until(&format!("outputs {value}"), || {
            panel.write_all(&frame(value)).unwrap();
            let shown = self.robot.newest()["registers"]["DigitalOutputCommand[1]"].as_u64();
            (shown == Some(value.into())).then_some(())
        });
    }

    /// Waits until the controller has this value of the panel's outputs.
    #[track_caller]
    pub(crate) fn outputs_are(&self, value: u64) {
        let is_there = |stats: &Value| {
            let shown = stats["registers"].get("DigitalOutputCommand[1]").and_then(Value::as_u64);
            shown.unwrap_or(0) == value
        };
        self.robot.stats(&format!("outputs {value}"), is_there);
    }

    pub(crate) fn revisions(&self) -> Value {
        get(self.console, "revisions").must_be(200).json()
    }

    /// The ETag that the next change has to be based on.
    pub(crate) fn base(&self) -> String {
        self.revisions()["base"].as_str().unwrap().to_owned()
    }

    /// Waits until the revisions satisfy `found`.
    #[track_caller]
    pub(crate) fn until_revisions(&self, what: &str, found: impl Fn(&Value) -> bool) -> Value {
        until(what, || Some(self.revisions()).filter(&found))
    }
}

/// A gateway whose panel sends its outputs; `timeout_ms` tells revisions apart.
pub(crate) fn config(timeout_ms: u32) -> String {
    toml::panel("1 = \"stop\"", timeout_ms)
}

/// What the panel sends to switch its outputs.
pub(crate) fn frame(outputs: u8) -> [u8; 6] {
    [255, 255, 0, outputs, 238, 238]
}

pub(crate) fn write_key(folder: &TempDir) -> PathBuf {
    use std::os::unix::fs::PermissionsExt;
    let path = folder.path().join("key");
    std::fs::write(&path, format!("{KEY}\n")).unwrap();
    std::fs::set_permissions(&path, std::fs::Permissions::from_mode(0o600)).unwrap();
    path
}

fn gateway(folder: &TempDir, robot: &HostSim, device: &str, options: &[&str]) -> HostSim {
    let path = |name: &str| folder.path().join(name).display().to_string();
    let (key, state) = (path("key"), path("state"));
    let device = format!("--bind=device={device}");
    let mut extra = vec![
        &device,
        "--console",
        "127.0.0.1:0",
        "--console-key",
        &key,
        "--console-state",
        &state,
        "--no-realtime",
    ];
    extra.extend(options);
    BINARY.gateway(&folder.path().join("cell.toml"), robot, &extra)
}

pub(crate) const ROBOT: &str = "[listen]\naddress = \"127.0.0.1\"\n";
