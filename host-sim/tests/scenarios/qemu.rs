//! The firmware in QEMU (firmware/README.md): RS-485 on UART 0 and 1, CAN as slcan on UART 2, the log on
//! UART 3.

use std::ffi::OsString;
use std::path::{Path, PathBuf};
use std::time::Duration;

use recipe_test_kit::qemu;
use serde_json::{Value, json};

use super::board::{self, Machine, Wires};
use super::environment::{Cable, Environment, Gateway, Plan};
use super::field::LineClient;
use super::program::Program;
use super::refusal::Defect;

/// The firmware in QEMU.
pub(crate) struct Qemu {
    pub(crate) elf: PathBuf,
}

/// The board's stack (firmware/boards/mps2-an500/mps2-an500.x).
const STACK: u64 = 0x2030_0000;
const STACK_SIZE: u64 = 1 << 20;
/// The sockets of the UARTs: RS-485, RS-485, CAN.
const UARTS: [&str; 3] = ["uart0", "uart1", "uart2"];

impl Environment for Qemu {
    fn name(&self) -> &'static str {
        "qemu"
    }

    #[track_caller]
    fn start(&self, plan: &Plan<'_>) -> Box<dyn Gateway> {
        let mut board = Board::start(&self.elf, plan, &board::make_image(plan));
        board.until_started(&plan.config());
        Box::new(board)
    }

    #[track_caller]
    fn refuses(&self, plan: &Plan<'_>, defect: Defect) -> String {
        let mut board = Board::start(&self.elf, plan, &board::make_defective_image(plan, defect));
        let reason = board.until_refused();
        for uart in UARTS {
            let mut line = LineClient::new(Box::new(board.wires.socket(uart)));
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
    log: PathBuf,
    wires: Wires,
}

impl Board {
    #[track_caller]
    fn start(elf: &Path, plan: &Plan<'_>, image: &Path) -> Self {
        let log = plan.case.logs.join("board.log");
        let config = plan.config();
        let wires = Wires::new(plan, &config, &UARTS[..2], &UARTS[2..]);
        let mut network = vec!["user,id=n0,mac=02:11:22:33:44:55".to_owned()];
        network.extend(board::forwards(&config));
        let network = network.join(",");
        let mut arguments: Vec<OsString> =
            ["-M", "mps2-an500", "-display", "none", "-monitor", "none", "-nic", &network]
                .map(OsString::from)
                .into();
        arguments.extend(qemu::MACHINE.map(OsString::from));
        for uart in UARTS {
            arguments.extend(qemu::line(uart, &wires.folder.join(uart)).map(OsString::from));
        }
        let mut add = |words: [String; 2]| arguments.extend(words.map(OsString::from));
        add(["-chardev".into(), format!("file,id=log,path={}", log.display())]);
        add(["-serial".into(), "chardev:log".into()]);
        add(["-qmp".into(), format!("unix:{},server=on,wait=off", wires.folder.join("qmp").display())]);
        let named = format!("enable=on,target=native,arg=firmware,arg={}", image.display());
        add(["-semihosting-config".into(), named]);
        arguments.extend(["-kernel".into(), elf.into()]);
        let program = qemu::on_one_processor(|| {
            Program::start(plan.case, "qemu", Path::new("qemu-system-arm"), &arguments)
        });
        let mut board = Self { program, log, wires };
        // By the last socket that QEMU opens.
        board.wires.read_forwarded(&config, "qmp");
        board
    }

    /// One command to QEMU; what it returns.
    #[track_caller]
    fn qmp(&self, command: &str, arguments: Value) -> Value {
        board::qmp(&self.wires.folder.join("qmp"), command, arguments)
    }
}

impl Machine for Board {
    fn program(&self) -> &Program {
        &self.program
    }

    fn program_mut(&mut self) -> &mut Program {
        &mut self.program
    }

    fn wires(&self) -> &Wires {
        &self.wires
    }

    fn log(&self) -> String {
        String::from_utf8_lossy(&std::fs::read(&self.log).unwrap_or_default()).into_owned()
    }

    #[track_caller]
    fn cable(&self, cable: Cable) {
        self.qmp("set_link", json!({ "name": "lan9118.0", "up": cable == Cable::Plugged }));
    }

    #[track_caller]
    fn stop(&self) {
        self.qmp("stop", json!({}));
    }

    #[track_caller]
    fn go_on(&self) {
        self.qmp("cont", json!({}));
    }

    #[track_caller]
    fn save_stack(&self, to: &Path) {
        self.qmp("pmemsave", json!({ "val": STACK, "size": STACK_SIZE, "filename": to }));
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
