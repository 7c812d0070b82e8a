//! The firmware in QEMU (firmware/README.md): RS-485 on UART 0 and 1, CAN as slcan on UART 2, the log on
//! UART 3.

use std::collections::BTreeMap;
use std::ffi::OsString;
use std::io::{BufRead, BufReader, Write};
use std::net::{Ipv4Addr, SocketAddr};
use std::os::unix::net::UnixStream;
use std::path::{Path, PathBuf};
use std::process::Command;
use std::time::Duration;

use proto_core::config::Bus;
use serde_json::{Value, json};

use super::case::{Case, until};
use super::environment::{Cable, Environment, Gateway, Link, LinkStatus, Plan, PortStatus, ports};
use super::field::{CanClient, Line};
use super::program::Program;
use super::refusal::Spoil;

/// The firmware in QEMU.
pub(crate) struct Qemu {
    pub(crate) elf: PathBuf,
}

/// The host as the guest sees it.
const HOST: &str = "10.0.2.2";
/// The board's stack (firmware/boards/mps2-an500/memory.x), and what it is filled with at the start.
const STACK: u64 = 0x2030_0000;
const STACK_SIZE: u64 = 1 << 20;
const PAINT: u8 = 0xC5;
/// RS-485, RS-485, CAN.
const UARTS: usize = 3;
/// The UART of the CAN port.
const CAN_UART: usize = 2;

impl Environment for Qemu {
    fn name(&self) -> &'static str {
        "qemu"
    }

    /// The guest's timers stand still while the machine is stopped, as those of a processor that a debugger
    /// halts together with them: no time has passed, and nothing that a program could look at says so
    /// (docs/architecture.md section 3).
    fn sleeps_noticeably(&self) -> bool {
        false
    }

    /// The board's is one.
    fn lay_true_cable(&self, _case: &Case) {}

    #[track_caller]
    fn start(&self, plan: &Plan<'_>) -> Box<dyn Gateway> {
        let image = plan.case.folder.path().join("gateway.img");
        make_image(plan, &image);
        let mut board = Board::start(&self.elf, plan, &image);
        board.until_log("configuration: ");
        // Others can connect from now on.
        if !ports(&plan.config(), listens).is_empty() {
            board.until_log("address 10.0.2.15");
        }
        Box::new(board)
    }

    #[track_caller]
    fn refuses(&self, plan: &Plan<'_>, spoil: Spoil) -> String {
        let image = plan.case.folder.path().join("gateway.img");
        make_image(plan, &image);
        let mut bytes = std::fs::read(&image).unwrap();
        match spoil {
            Spoil::Damaged => bytes[40] ^= 1,
            Spoil::Cut => bytes.truncate(bytes.len() - 1),
            Spoil::Missing => std::fs::remove_file(&image).unwrap(),
            Spoil::NoDevice => {}
        }
        if spoil != Spoil::Missing {
            std::fs::write(&image, bytes).unwrap();
        }
        let mut board = Board::start(&self.elf, plan, &image);
        board.until_log("nothing runs: ");
        let reason = until("the whole line", || {
            let log = board.log();
            let (_, rest) = log.split_once("nothing runs: ")?;
            Some(rest.split_once('\r')?.0.to_owned())
        });
        for uart in 0..UARTS {
            let mut line = Line::new(Box::new(board.uart(uart)));
            line.send(b"\xFF\xFF\x01\xEE\xEEO\rt001101\r");
            line.is_silent(Duration::from_millis(300));
        }
        board.must_run();
        reason
    }
}

fn listens(bus: &Bus) -> bool {
    matches!(bus, Bus::TcpListen { .. } | Bus::UdpListen { .. })
}

/// `host-sim image`.
#[track_caller]
fn make_image(plan: &Plan<'_>, image: &Path) {
    let mut command = Command::new(env!("CARGO_BIN_EXE_host-sim"));
    command.arg("image").arg(plan.file()).arg("-o").arg(image);
    for value in plan.overrides(HOST, &plan.server_ports()) {
        command.arg("--set").arg(value);
    }
    let output = command.output().unwrap();
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
}

/// QEMU with the firmware.
struct Board {
    program: Program,
    folder: PathBuf,
    log: PathBuf,
    /// Field ports by name: the number in the log, and the UART.
    ports: BTreeMap<String, (usize, usize)>,
    /// Listening ports by name, as the host reaches them.
    listens: BTreeMap<String, SocketAddr>,
}

impl Board {
    #[track_caller]
    fn start(elf: &Path, plan: &Plan<'_>, image: &Path) -> Self {
        // Each board has sockets of its own: those of one that was ended stay behind.
        let folder = tempfile::Builder::new().tempdir_in(plan.case.folder.path()).unwrap().keep();
        let log = plan.case.logs.join("board.log");
        let config = plan.config();
        let mut ports = BTreeMap::new();
        let mut network = "user,id=n0,mac=02:11:22:33:44:55".to_owned();
        let mut inside = BTreeMap::new();
        let (mut lines, mut buses) = (0..CAN_UART, CAN_UART..UARTS);
        for (number, port) in config.ports.iter().enumerate() {
            let name = port.name.as_str().to_owned();
            let uart = match &port.bus {
                Bus::Rs485(_) => lines.next(),
                Bus::Can { .. } => buses.next(),
                Bus::TcpListen { listen } | Bus::UdpListen { listen } => {
                    let kind = if matches!(port.bus, Bus::TcpListen { .. }) { "tcp" } else { "udp" };
                    let at = listen.parse::<SocketAddr>().unwrap().port();
                    network.push_str(&format!(",hostfwd={kind}:127.0.0.1:0-:{at}"));
                    inside.insert(name, (kind.to_uppercase(), at));
                    continue;
                }
            };
            if let Some(uart) = uart {
                ports.insert(name, (number, uart));
            }
        }
        let mut arguments: Vec<OsString> =
            ["-M", "mps2-an500", "-display", "none", "-monitor", "none", "-nic", &network]
                .map(OsString::from)
                .into();
        let mut add = |words: [String; 2]| arguments.extend(words.map(OsString::from));
        for uart in 0..UARTS {
            let path = folder.join(format!("uart{uart}"));
            let device = format!("socket,id=u{uart},path={},server=on,wait=off", path.display());
            add(["-chardev".into(), device]);
            add(["-serial".into(), format!("chardev:u{uart}")]);
        }
        add(["-chardev".into(), format!("file,id=log,path={}", log.display())]);
        add(["-serial".into(), "chardev:log".into()]);
        add(["-qmp".into(), format!("unix:{},server=on,wait=off", folder.join("qmp").display())]);
        let named = format!("enable=on,target=native,arg=firmware,arg={}", image.display());
        add(["-semihosting-config".into(), named]);
        arguments.extend(["-kernel".into(), elf.into()]);
        let program = Program::start(plan.case, "qemu", Path::new("qemu-system-arm"), &arguments);
        let mut board = Self { program, folder, log, ports, listens: BTreeMap::new() };
        // The last of its sockets. That its file is there does not mean that it listens.
        until("QEMU's sockets", || {
            board.must_run();
            UnixStream::connect(board.folder.join("qmp")).ok()
        });
        if !inside.is_empty() {
            let table = board.qmp("human-monitor-command", json!({ "command-line": "info usernet" }));
            for (name, (kind, port)) in inside {
                board.listens.insert(name, forwarded(table.as_str().unwrap(), &kind, port));
            }
        }
        board
    }

    fn log(&self) -> String {
        String::from_utf8_lossy(&std::fs::read(&self.log).unwrap_or_default()).into_owned()
    }

    #[track_caller]
    fn until_log(&mut self, text: &str) {
        until(&format!("{text:?} in the board's log"), || {
            self.must_run();
            self.log().contains(text).then_some(())
        });
    }

    #[track_caller]
    fn uart(&self, number: usize) -> UnixStream {
        UnixStream::connect(self.folder.join(format!("uart{number}"))).unwrap()
    }

    #[track_caller]
    fn field(&self, port: &str) -> (usize, usize) {
        *self.ports.get(port).unwrap_or_else(|| panic!("no port {port}"))
    }

    /// One command to QEMU; what it returns.
    #[track_caller]
    fn qmp(&self, command: &str, arguments: Value) -> Value {
        let mut stream = UnixStream::connect(self.folder.join("qmp")).unwrap();
        let mut lines = BufReader::new(stream.try_clone().unwrap()).lines();
        lines.next().unwrap().unwrap();
        let mut answer = Value::Null;
        for (command, arguments) in [("qmp_capabilities", json!({})), (command, arguments)] {
            writeln!(stream, "{}", json!({ "execute": command, "arguments": arguments })).unwrap();
            // Events come between.
            answer = loop {
                let line: Value = serde_json::from_str(&lines.next().unwrap().unwrap()).unwrap();
                if line.get("event").is_none() {
                    break line;
                }
            };
            assert!(answer.get("return").is_some(), "{command}: {answer}");
        }
        answer["return"].take()
    }
}

/// Where the host reaches a port of the guest, from QEMU's table.
#[track_caller]
fn forwarded(table: &str, kind: &str, port: u16) -> SocketAddr {
    for line in table.lines() {
        // Protocol[HOST_FORWARD] FD source-address source-port dest-address dest-port ...
        let words: Vec<&str> = line.split_whitespace().collect();
        if words.len() >= 6 && words[0] == format!("{kind}[HOST_FORWARD]") && words[5] == port.to_string() {
            return (Ipv4Addr::LOCALHOST, words[3].parse::<u16>().unwrap()).into();
        }
    }
    panic!("{kind} port {port} is not forwarded:\n{table}");
}

impl Gateway for Board {
    #[track_caller]
    fn line(&self, port: &str) -> Line {
        Line::new(Box::new(self.uart(self.field(port).1)))
    }

    #[track_caller]
    fn can(&self, port: &str) -> CanClient {
        CanClient::join(Box::new(self.uart(self.field(port).1)))
    }

    #[track_caller]
    fn listens(&self, port: &str) -> SocketAddr {
        self.listens[port]
    }

    /// From the lines `link NAME: up (COUNT)` and `link NAME: lost`.
    fn link(&self, link: Link<'_>) -> LinkStatus {
        let name = match link {
            Link::Command => "command",
            Link::State => "state",
            Link::Modbus => "modbus",
            Link::Udp2011 => "udp2011",
            Link::TcpListen(_) => "tcp-listen",
            Link::UdpListen(_) => "udp-listen",
        };
        let mut status = LinkStatus::default();
        let log = self.log();
        for line in log.lines() {
            let Some((_, said)) = line.split_once(&format!("link {name}: ")) else { continue };
            status.is_up = said.starts_with("up");
            if let Some(count) = said.strip_prefix("up (").and_then(|rest| rest.trim_end().strip_suffix(')'))
            {
                status.connects = count.parse().unwrap();
            }
        }
        status
    }

    /// From the newest line `port NUMBER: in FRAMES frames, BYTES bytes; out ...`.
    fn port(&self, port: &str) -> PortStatus {
        let start = format!("port {}: in ", self.field(port).0);
        let log = self.log();
        // The newest line may not be whole yet.
        let whole = log.split_inclusive('\n').filter(|line| line.ends_with('\n'));
        let Some(said) = whole.filter_map(|line| line.split_once(&start)).next_back() else {
            return PortStatus::default();
        };
        let mut numbers = said.1.split_whitespace().filter_map(|word| word.parse().ok());
        let mut next = || numbers.next().unwrap_or(0);
        PortStatus {
            frames_in: next(),
            bytes_in: next(),
            frames_out: next(),
            bytes_out: next(),
            skipped_bytes: next(),
            skipped_cycles: next(),
        }
    }

    #[track_caller]
    fn cable(&self, cable: Cable) {
        self.qmp("set_link", json!({ "name": "lan9118.0", "up": cable == Cable::Plugged }));
    }

    #[track_caller]
    fn freeze(&self) {
        self.qmp("stop", json!({}));
    }

    #[track_caller]
    fn thaw(&self) {
        self.qmp("cont", json!({}));
    }

    fn own_address(&self) -> Option<String> {
        let log = self.log();
        let (_, said) = log.rsplit_once(" address ")?;
        said.split_whitespace().next().map(str::to_owned)
    }

    fn processor_time(&self) -> Duration {
        self.program.processor_time()
    }

    /// Its stack, which is painted before it is used; everything else is static.
    #[track_caller]
    fn memory(&self) -> u64 {
        let path = self.folder.join("memory");
        self.qmp("pmemsave", json!({ "val": STACK, "size": STACK_SIZE, "filename": path }));
        let unused = std::fs::read(&path).unwrap().iter().take_while(|&&byte| byte == PAINT).count() as u64;
        assert!(unused > 0, "the stack is where it is not expected");
        STACK_SIZE - unused
    }

    #[track_caller]
    fn must_run(&mut self) {
        self.program.must_run();
    }
}

impl Drop for Board {
    fn drop(&mut self) {
        if !std::thread::panicking() {
            self.program.must_run();
            assert!(!self.log().contains("panicked"), "the firmware panicked");
        }
    }
}
