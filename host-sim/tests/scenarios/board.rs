//! What emulated boards have in common: a configuration image, a log, QEMU's user network.

use std::collections::BTreeMap;
use std::io::{BufRead, BufReader, Write};
use std::net::{Ipv4Addr, SocketAddr};
use std::os::unix::net::UnixStream;
use std::path::{Path, PathBuf};
use std::process::Command;
use std::time::Duration;

use proto_core::config::{Bus, GatewayConfig};
use recipe_test_kit::until;
use serde_json::{Value, json};

use super::environment::{Cable, Gateway, Link, LinkStatus, Plan, PortStatus};
use super::field::{CanClient, LineClient};
use super::program::Program;
use super::refusal::Defect;

/// The host's address for QEMU's guest.
const HOST: &str = "10.0.2.2";
/// The log's line about the guest's address, which is QEMU's first.
const ADDRESS: &str = "address 10.0.2.15";
/// What an unused stack is filled with.
pub(crate) const PAINT: u8 = 0xC5;

pub(crate) fn listens(bus: &Bus) -> bool {
    matches!(bus, Bus::TcpListen { .. } | Bus::UdpListen { .. })
}

/// The configuration image, made by `host-sim image`.
#[track_caller]
pub(crate) fn make_image(plan: &Plan<'_>) -> PathBuf {
    let image = plan.case.folder.path().join("gateway.img");
    let mut command = Command::new(env!("CARGO_BIN_EXE_host-sim"));
    command.arg("image").arg(plan.file()).arg("-o").arg(&image);
    for value in plan.overrides(HOST, &plan.server_ports()) {
        command.arg("--set").arg(value);
    }
    let output = command.output().unwrap();
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    image
}

/// Same, with a defect.
#[track_caller]
pub(crate) fn make_defective_image(plan: &Plan<'_>, defect: Defect) -> PathBuf {
    let image = make_image(plan);
    let mut bytes = std::fs::read(&image).unwrap();
    match defect {
        Defect::Damaged => bytes[40] ^= 1,
        Defect::Cut => bytes.truncate(bytes.len() - 1),
        Defect::Missing => {
            std::fs::remove_file(&image).unwrap();
            return image;
        }
        Defect::NoDevice => {}
    }
    std::fs::write(&image, bytes).unwrap();
    image
}

/// How the host reaches a board: sockets, in a new folder since an ended board leaves its own behind, and
/// forwarded ports of the user network.
pub(crate) struct Wires {
    pub(crate) folder: PathBuf,
    /// The sockets of the field ports, by name.
    ports: BTreeMap<String, &'static str>,
    /// Addresses of the listening ports, by name.
    listens: BTreeMap<String, SocketAddr>,
}

impl Wires {
    /// Gives the file's RS-485 and CAN ports these sockets, in order.
    pub(crate) fn new(
        plan: &Plan<'_>,
        config: &GatewayConfig,
        lines: &[&'static str],
        buses: &[&'static str],
    ) -> Self {
        let folder = tempfile::Builder::new().tempdir_in(plan.case.folder.path()).unwrap().keep();
        let (mut lines, mut buses) = (lines.iter(), buses.iter());
        let mut ports = BTreeMap::new();
        for port in &config.ports {
            let socket = match &port.bus {
                Bus::Rs485(_) => lines.next(),
                Bus::Can { .. } => buses.next(),
                Bus::ModbusTcp { .. } | Bus::TcpListen { .. } | Bus::UdpListen { .. } => None,
            };
            ports.extend(socket.map(|socket| (port.name.as_str().to_owned(), *socket)));
        }
        Self { folder, ports, listens: BTreeMap::new() }
    }

    /// Reads the forwarded ports from QEMU, by its QMP socket.
    #[track_caller]
    pub(crate) fn read_forwarded(&mut self, config: &GatewayConfig, socket: &str) {
        self.listens = forwarded(config, &self.folder.join(socket)).into_iter().collect();
    }

    #[track_caller]
    pub(crate) fn socket(&self, name: &str) -> UnixStream {
        UnixStream::connect(self.folder.join(name)).unwrap()
    }

    #[track_caller]
    fn field(&self, port: &str) -> &'static str {
        self.ports.get(port).unwrap_or_else(|| panic!("no port {port}"))
    }

    #[track_caller]
    pub(crate) fn line(&self, port: &str) -> LineClient {
        LineClient::new(Box::new(self.socket(self.field(port))))
    }

    #[track_caller]
    pub(crate) fn can(&self, port: &str) -> CanClient {
        CanClient::join(Box::new(self.socket(self.field(port))))
    }

    #[track_caller]
    pub(crate) fn listens(&self, port: &str) -> SocketAddr {
        self.listens[port]
    }
}

/// An emulator that runs a board's firmware. Its state is read from the log.
pub(crate) trait Machine {
    fn program(&self) -> &Program;

    fn program_mut(&mut self) -> &mut Program;

    fn wires(&self) -> &Wires;

    /// The firmware's log so far.
    fn log(&self) -> String;

    fn cable(&self, cable: Cable);

    /// Stops the board.
    fn stop(&self);

    /// Continues it.
    fn go_on(&self);

    /// Writes the memory of the board's stack to a file.
    fn save_stack(&self, to: &Path);

    /// Waits for a whole line of the log with this text, and returns what follows it in the line.
    #[track_caller]
    fn until_log(&mut self, text: &str) -> String {
        until(&format!("{text:?} in the board's log"), || {
            self.program_mut().must_run();
            let log = self.log();
            let mut whole = log.split_inclusive('\n').filter(|line| line.ends_with('\n'));
            whole.find_map(|line| Some(line.split_once(text)?.1.trim_end().to_owned()))
        })
    }

    /// Waits until the firmware runs its configuration, and others can connect to it.
    #[track_caller]
    fn until_started(&mut self, config: &GatewayConfig) {
        self.until_log("configuration: ");
        if config.ports.iter().any(|port| listens(&port.bus)) {
            self.until_log(ADDRESS);
        }
    }

    /// Waits until the firmware refuses its configuration, and returns the reason.
    #[track_caller]
    fn until_refused(&mut self) -> String {
        self.until_log("nothing runs: ")
    }

    /// What the emulator counts, if it does.
    fn counts(&self) -> Value {
        Value::Null
    }
}

impl<M: Machine> Gateway for M {
    #[track_caller]
    fn line(&self, port: &str) -> LineClient {
        self.wires().line(port)
    }

    #[track_caller]
    fn can(&self, port: &str) -> CanClient {
        self.wires().can(port)
    }

    #[track_caller]
    fn listens(&self, port: &str) -> SocketAddr {
        self.wires().listens(port)
    }

    fn link(&self, link: Link<'_>) -> LinkStatus {
        link_status(&self.log(), link)
    }

    fn port(&self, port: &str) -> PortStatus {
        port_status(&self.log(), port)
    }

    #[track_caller]
    fn cable(&self, cable: Cable) {
        Machine::cable(self, cable);
    }

    #[track_caller]
    fn freeze(&self) {
        self.stop();
    }

    #[track_caller]
    fn thaw(&self) {
        self.go_on();
    }

    fn own_address(&self) -> Option<String> {
        own_address(&self.log())
    }

    fn processor_time(&self) -> Duration {
        self.program().processor_time()
    }

    /// The used part of its stack, which is painted at start; everything else is static.
    #[track_caller]
    fn memory(&self) -> u64 {
        let path = self.wires().folder.join("memory");
        self.save_stack(&path);
        stack_used(&path)
    }

    #[track_caller]
    fn figures(&self) -> Value {
        self.counts()
    }

    #[track_caller]
    fn must_run(&mut self) {
        self.program_mut().must_run();
    }
}

/// Options of the user network that forward the listening ports.
pub(crate) fn forwards(config: &GatewayConfig) -> Vec<String> {
    let inside = config.ports.iter().filter_map(|port| forward(&port.bus));
    inside.map(|(kind, at)| format!("hostfwd={kind}:127.0.0.1:0-:{at}")).collect()
}

/// Protocol and number of a listening port.
fn forward(bus: &Bus) -> Option<(&'static str, u16)> {
    let (kind, listen) = match bus {
        Bus::TcpListen { listen } => ("tcp", listen),
        Bus::UdpListen { listen } => ("udp", listen),
        Bus::Rs485(_) | Bus::Can { .. } | Bus::ModbusTcp { .. } => return None,
    };
    Some((kind, listen.parse::<SocketAddr>().unwrap().port()))
}

/// The forwarded listening ports by name, read from QEMU by its QMP socket.
#[track_caller]
fn forwarded(config: &GatewayConfig, socket: &Path) -> Vec<(String, SocketAddr)> {
    let table = qmp(socket, "human-monitor-command", json!({ "command-line": "info usernet" }));
    let table = table.as_str().unwrap();
    let place = |(kind, port)| {
        let head = format!("{}[HOST_FORWARD]", str::to_uppercase(kind));
        let row = table.lines().map(|line| line.split_whitespace().collect::<Vec<_>>()).find(|words| {
            // Protocol[HOST_FORWARD] FD source-address source-port dest-address dest-port ...
            words.len() >= 6 && words[0] == head && words[5] == u16::to_string(&port)
        });
        let row = row.unwrap_or_else(|| panic!("{kind} port {port} is not forwarded:\n{table}"));
        (Ipv4Addr::LOCALHOST, row[3].parse::<u16>().unwrap()).into()
    };
    let ports = config.ports.iter();
    ports.filter_map(|port| Some((port.name.as_str().to_owned(), place(forward(&port.bus)?)))).collect()
}

/// Sends a command to QEMU, which may be carried out twice; returns the result. QEMU may not listen yet, and has one
/// place for a client: it may reset one that comes while it notices that the one before has gone.
#[track_caller]
pub(crate) fn qmp(socket: &Path, command: &str, arguments: Value) -> Value {
    let mut failed = None;
    let answer = || match try_qmp(socket, command, &arguments) {
        Ok(answer) => Some(answer),
        Err(error) => {
            failed = Some(error);
            // Or one comes after the other, each while the one before is going.
            std::thread::sleep(Duration::from_millis(100));
            None
        }
    };
    let mut answer = until(&format!("QEMU's answer to {command}"), answer);
    if let Some(error) = failed.filter(|error| error.kind() != std::io::ErrorKind::NotFound) {
        eprintln!("{command}: at first {error}");
    }
    assert!(answer.get("return").is_some(), "{command}: {answer}");
    answer["return"].take()
}

/// Same; returns the whole answer.
fn try_qmp(socket: &Path, command: &str, arguments: &Value) -> std::io::Result<Value> {
    let mut stream = UnixStream::connect(socket)?;
    let mut lines = BufReader::new(stream.try_clone()?).lines();
    let mut answer = Value::Null;
    for (command, arguments) in [("qmp_capabilities", &json!({})), (command, arguments)] {
        writeln!(stream, "{}", json!({ "execute": command, "arguments": arguments }))?;
        // Skip events and the greeting.
        answer = loop {
            let line = lines.next().ok_or(std::io::ErrorKind::UnexpectedEof)??;
            let line: Value = serde_json::from_str(&line)?;
            if line.get("event").is_none() && line.get("QMP").is_none() {
                break line;
            }
        };
    }
    Ok(answer)
}

/// From the lines `link NAME: up (COUNT)` and `link NAME: lost` of a log.
fn link_status(log: &str, link: Link<'_>) -> LinkStatus {
    let name = match link {
        Link::Command => "command",
        Link::Urgent => "urgent",
        Link::State => "state",
        Link::Modbus => "modbus",
        Link::Udp2011 => "udp2011",
        Link::TcpListen(port) | Link::UdpListen(port) => port,
    };
    let mut status = LinkStatus::default();
    for line in log.lines() {
        let Some((_, to_server)) = line.split_once(&format!("link {name}: ")) else { continue };
        status.is_up = to_server.starts_with("up");
        if let Some(count) = to_server.strip_prefix("up (").and_then(|rest| rest.trim_end().strip_suffix(')'))
        {
            status.connects = count.parse().unwrap();
        }
    }
    status
}

/// From the newest line `port NAME: in FRAMES frames, BYTES bytes; out ...` of a log.
fn port_status(log: &str, name: &str) -> PortStatus {
    let start = format!("port {name}: in ");
    // The newest line may be incomplete.
    let whole = log.split_inclusive('\n').filter(|line| line.ends_with('\n'));
    let Some(to_server) = whole.filter_map(|line| line.split_once(&start)).next_back() else {
        return PortStatus::default();
    };
    let mut numbers = to_server.1.split_whitespace().filter_map(|word| word.parse().ok());
    let mut next = || numbers.next().unwrap_or(0);
    PortStatus {
        frames_in: next(),
        bytes_in: next(),
        frames_out: next(),
        bytes_out: next(),
        skipped_bytes: next(),
        skipped_cycles: next(),
        lost_bytes: 0,
    }
}

/// The address in a log.
fn own_address(log: &str) -> Option<String> {
    let (_, to_server) = log.rsplit_once(" address ")?;
    to_server.split_whitespace().next().map(str::to_owned)
}

/// Number of used bytes of a stack: all but the painted ones at its lower end.
#[track_caller]
fn stack_used(memory: &Path) -> u64 {
    let memory = std::fs::read(memory).unwrap();
    let unused = memory.iter().take_while(|&&byte| byte == PAINT).count();
    assert!(unused > 0, "the stack is where it is not expected");
    (memory.len() - unused) as u64
}
