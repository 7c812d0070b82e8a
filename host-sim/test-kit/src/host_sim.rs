//! A running `host-sim` process that is ready.

use std::io::{Read, Write};
use std::net::{SocketAddr, TcpStream};
use std::ops::{Deref, DerefMut};
use std::path::Path;
use std::process::{Command, Stdio};

use rustix::process::Signal;
use serde_json::Value;

use super::{PATIENCE, Process, until};

/// The controller's servers.
pub const SERVERS: [&str; 4] = ["command", "state", "modbus", "udp2011"];

/// Arguments that make a controller's servers listen on free ports.
pub fn free_servers() -> [String; 4] {
    SERVERS.map(|server| format!("--set=listen.{server}=0"))
}

/// Path of the program: `Binary(env!("CARGO_BIN_EXE_host-sim"))`. Cargo sets this variable only for tests of the
/// program's package.
#[derive(Debug, Clone, Copy)]
pub struct Binary(pub &'static str);

impl Binary {
    /// A command that runs the program without stdin, with stdout and stderr piped.
    pub fn command(self) -> Command {
        let mut command = Command::new(self.0);
        command.stdin(Stdio::null()).stdout(Stdio::piped()).stderr(Stdio::piped());
        command
    }

    /// `host-sim KIND -c FILE` with statistics every 50 ms.
    pub fn run(self, kind: &str, file: &Path) -> Command {
        let mut command = self.command();
        command.args([kind, "--stats", "50ms", "-c"]).arg(file);
        command
    }

    /// A simulated controller on free ports.
    ///
    /// # Panics
    /// If it is not ready in time.
    #[track_caller]
    pub fn controller(self, file: &Path, extra: &[&str]) -> HostSim {
        HostSim::start(self.run("controller", file).args(free_servers()).args(extra))
    }

    /// A gateway that is connected to this controller, with all links up.
    ///
    /// # Panics
    /// If the links are not up in time.
    #[track_caller]
    pub fn gateway(self, file: &Path, robot: &HostSim, extra: &[&str]) -> HostSim {
        let links = robot.links(&["command", "state", "modbus"]);
        let gateway = HostSim::start(self.run("gateway", file).args(links).args(extra));
        gateway.stats("links up", |stats| {
            stats["links"].as_object().is_some_and(|links| links.values().all(|link| link["state"] == "up"))
        });
        gateway
    }
}

/// Sends a command to a controller's port 2000, at `address`, and checks the reply.
///
/// # Panics
/// If there is no reply, or another one.
#[track_caller]
pub fn command(address: SocketAddr, request: &str, reply: &str) {
    let mut stream = TcpStream::connect(address).unwrap();
    stream.set_read_timeout(Some(PATIENCE)).unwrap();
    stream.write_all(request.as_bytes()).unwrap();
    let mut answer = vec![0; reply.len()];
    stream.read_exact(&mut answer).unwrap();
    assert_eq!(String::from_utf8_lossy(&answer), reply);
}

/// A `host-sim` that has printed its `ready` line.
#[derive(Debug)]
pub struct HostSim {
    process: Process,
    /// The JSON of the `ready` line.
    pub ready: Value,
}

impl HostSim {
    /// Starts it and waits until it is ready.
    ///
    /// # Panics
    /// If it is not ready in time.
    #[track_caller]
    pub fn start(command: &mut Command) -> Self {
        let process = Process::start(command);
        let line = process.line();
        let json = line.strip_prefix("ready ").unwrap_or_else(|| panic!("not ready: {line}"));
        Self { ready: serde_json::from_str(json).unwrap(), process }
    }

    /// As [`Self::start`], without reading the output; `file` is the program's ready file.
    ///
    /// # Panics
    /// If it is not ready in time.
    #[track_caller]
    pub fn unread(command: &mut Command, file: &Path) -> Self {
        let process = Process::unread(command);
        let ready = until("the ready file", || {
            let text = std::fs::read_to_string(file).unwrap_or_default();
            serde_json::from_str(&text).ok()
        });
        Self { process, ready }
    }

    /// The address of a server, or of `ports/NAME`.
    ///
    /// # Panics
    /// If it has none.
    #[track_caller]
    pub fn at(&self, name: &str) -> SocketAddr {
        let place = self.ready.pointer(&format!("/{name}")).and_then(Value::as_str);
        place.unwrap_or_else(|| panic!("{name} is nowhere: {}", self.ready)).parse().unwrap()
    }

    /// Arguments that connect these links of a gateway to this controller.
    ///
    /// # Panics
    /// If it has no such server.
    #[track_caller]
    pub fn links(&self, names: &[&str]) -> Vec<String> {
        let link = |name: &&str| format!("--set=controller.ports.{name}={}", self.at(name).port());
        names.iter().map(link).collect()
    }

    /// The log lines so far that contain `words`.
    pub fn log(&self, words: &str) -> Vec<String> {
        self.errors().iter().filter(|line| line.contains(words)).cloned().collect()
    }

    /// Sends a command to this controller's port 2000 and checks the reply.
    ///
    /// # Panics
    /// If there is no reply, or another one.
    #[track_caller]
    pub fn command(&self, request: &str, reply: &str) {
        command(self.at("command"), request, reply);
    }

    /// Ends it with SIGINT, as Ctrl-C does.
    ///
    /// # Panics
    /// If the exit code is not 0.
    #[track_caller]
    pub fn end(self) {
        self.ended_by(Signal::INT);
    }

    /// Ends it with a signal.
    ///
    /// # Panics
    /// If the exit code is not 0.
    #[track_caller]
    pub fn ended_by(mut self, signal: Signal) {
        self.process.end_by(signal);
    }
}

impl Deref for HostSim {
    type Target = Process;

    fn deref(&self) -> &Process {
        &self.process
    }
}

impl DerefMut for HostSim {
    fn deref_mut(&mut self) -> &mut Process {
        &mut self.process
    }
}
