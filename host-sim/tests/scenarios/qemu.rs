//! The firmware in QEMU (firmware/README.md): RS-485 on UART 0 and 1, CAN as slcan on UART 2, the log on
//! UART 3.

use std::collections::BTreeMap;
use std::ffi::OsString;
use std::net::SocketAddr;
use std::os::unix::net::UnixStream;
use std::path::{Path, PathBuf};
use std::time::Duration;

use proto_core::config::Bus;
use serde_json::{Value, json};

use super::board;
use super::case::{Case, until};
use super::environment::{Cable, Environment, Gateway, Link, LinkStatus, Plan, PortStatus, ports};
use super::field::{CanClient, Line};
use super::program::Program;
use super::refusal::Spoil;

/// The firmware in QEMU.
pub(crate) struct Qemu {
    pub(crate) elf: PathBuf,
}

/// The board's stack (firmware/boards/mps2-an500/memory.x).
const STACK: u64 = 0x2030_0000;
const STACK_SIZE: u64 = 1 << 20;
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
        board::make_image(plan, &image);
        let mut board = Board::start(&self.elf, plan, &image);
        board.until_log("configuration: ");
        // Others can connect from now on.
        if !ports(&plan.config(), board::listens).is_empty() {
            board.until_log(board::ADDRESS);
        }
        Box::new(board)
    }

    #[track_caller]
    fn refuses(&self, plan: &Plan<'_>, spoil: Spoil) -> String {
        let image = plan.case.folder.path().join("gateway.img");
        board::make_spoilt_image(plan, &image, spoil);
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
        let mut network = vec!["user,id=n0,mac=02:11:22:33:44:55".to_owned()];
        network.extend(board::forwards(&config));
        let network = network.join(",");
        let (mut lines, mut buses) = (0..CAN_UART, CAN_UART..UARTS);
        for (number, port) in config.ports.iter().enumerate() {
            let name = port.name.as_str().to_owned();
            let uart = match &port.bus {
                Bus::Rs485(_) => lines.next(),
                Bus::Can { .. } => buses.next(),
                Bus::TcpListen { .. } | Bus::UdpListen { .. } => continue,
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
        board.listens = board::forwarded(&config, &board.folder.join("qmp")).into_iter().collect();
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
        board::qmp(&self.folder.join("qmp"), command, arguments)
    }
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

    fn link(&self, link: Link<'_>) -> LinkStatus {
        board::link(&self.log(), link)
    }

    fn port(&self, port: &str) -> PortStatus {
        board::port(&self.log(), self.field(port).0)
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
        board::own_address(&self.log())
    }

    fn processor_time(&self) -> Duration {
        self.program.processor_time()
    }

    /// Its stack, which is painted before it is used; everything else is static.
    #[track_caller]
    fn memory(&self) -> u64 {
        let path = self.folder.join("memory");
        self.qmp("pmemsave", json!({ "val": STACK, "size": STACK_SIZE, "filename": path }));
        board::stack_used(&path)
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
