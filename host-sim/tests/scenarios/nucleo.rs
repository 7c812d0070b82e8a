//! The NUCLEO-H743ZI2's firmware, unchanged, on its modelled chip in real time (docs/chip.md section 5): RS-485
//! lines and CAN on sockets, Ethernet by QEMU's user network, the log on the emulator's stdout.

use std::ffi::OsString;
use std::os::unix::net::UnixStream;
use std::path::{Path, PathBuf};
use std::time::Duration;

use serde_json::Value;

use recipe_test_kit::{chip, until};

use super::board::{self, Machine, Wires};
use super::environment::{Cable, Environment, Gateway, Plan};
use super::field::{CanClient, LineClient};
use super::program::Program;
use super::refusal::Defect;

/// The firmware for the board, on its modelled chip.
pub(crate) struct Nucleo {
    pub(crate) elf: PathBuf,
    /// The program of `firmware/chip-model`.
    pub(crate) emulator: PathBuf,
}

/// The board's stack above its guard (memory.x).
const STACK: [&str; 2] = ["20004000", "1C000"];
/// The emulator's sockets: RS-485 A and B, CAN.
const BUSES: [&str; 3] = ["a", "b", "can"];

impl Environment for Nucleo {
    fn name(&self) -> &'static str {
        "nucleo"
    }

    #[track_caller]
    fn start(&self, plan: &Plan<'_>) -> Box<dyn Gateway> {
        let mut chip = Chip::start(self, plan, &board::make_image(plan));
        chip.until_started(&plan.config());
        Box::new(chip)
    }

    #[track_caller]
    fn refuses(&self, plan: &Plan<'_>, defect: Defect) -> String {
        let image = board::make_defective_image(plan, defect);
        if defect == Defect::Missing {
            // Erased flash.
            std::fs::write(&image, []).unwrap();
        }
        let mut chip = Chip::start(self, plan, &image);
        let reason = chip.until_refused();
        for bus in ["a", "b"] {
            let mut line = LineClient::new(Box::new(chip.wires.socket(bus)));
            line.send(b"\xFF\xFF\x01\xEE\xEE");
            line.is_silent(Duration::from_millis(300));
        }
        // The slcan adapter belongs to the emulator: its answers are not from the board.
        let mut bus = CanClient::join(Box::new(chip.wires.socket("can"))).into_line();
        bus.send(b"t001101\r");
        assert_eq!(bus.take(2), b"z\r");
        bus.is_silent(Duration::from_millis(300));
        chip.must_run();
        reason
    }
}

/// The emulator with the firmware.
struct Chip {
    program: Program,
    wires: Wires,
}

impl Chip {
    #[track_caller]
    fn start(nucleo: &Nucleo, plan: &Plan<'_>, image: &Path) -> Self {
        let config = plan.config();
        let wires = Wires::new(plan, &config, &BUSES[..2], &BUSES[2..]);
        let place = |name: &str| wires.folder.join(name).into_os_string();
        let mut arguments: Vec<OsString> = vec![nucleo.elf.clone().into(), image.into(), "--realtime".into()];
        for (option, name) in ["--rs485", "--rs485", "--can"].into_iter().zip(BUSES) {
            arguments.extend([option.into(), place(name)]);
        }
        let network = board::forwards(&config).join(",");
        arguments.extend(["--network".into(), network.into(), "--qmp".into(), place("qmp")]);
        arguments.extend(["--control".into(), place("control")]);
        let program = Program::start(plan.case, "chip", &nucleo.emulator, &arguments);
        let mut chip = Self { program, wires };
        // The last socket that the emulator opens. Its file may exist before it listens.
        until("the emulator's sockets", || {
            chip.must_run();
            UnixStream::connect(chip.wires.folder.join("control")).ok()
        });
        // And that of QEMU's network.
        chip.wires.read_forwarded(&config, "qmp");
        chip
    }

    /// The emulator's socket.
    fn control(&self) -> PathBuf {
        self.wires.folder.join("control")
    }

    #[track_caller]
    fn command(&self, words: &str) {
        chip::command(&self.control(), words);
    }
}

impl Machine for Chip {
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
        self.program.lines().iter().flat_map(|line| [line.as_str(), "\n"]).collect()
    }

    #[track_caller]
    fn cable(&self, cable: Cable) {
        self.command(if cable == Cable::Plugged { "cable in" } else { "cable out" });
    }

    #[track_caller]
    fn stop(&self) {
        self.command("stop");
    }

    #[track_caller]
    fn go_on(&self) {
        self.command("go");
    }

    #[track_caller]
    fn save_stack(&self, to: &Path) {
        let [start, len] = STACK;
        self.command(&format!("save {start} {len} {}", to.display()));
    }

    #[track_caller]
    fn counts(&self) -> Value {
        serde_json::from_str(&chip::request(&self.control(), "figures")).unwrap()
    }
}

impl Drop for Chip {
    fn drop(&mut self) {
        if !std::thread::panicking() {
            self.program.must_run();
            let figures = self.counts();
            self.program.interrupt();
            assert!(!self.log().contains("panicked"), "the firmware panicked");
            assert_eq!(figures["resets"], 0, "the watchdog has reset the board");
            assert!(self.wires.folder.read_dir().unwrap().all(|left| left.unwrap().file_name() == "memory"));
        }
    }
}
