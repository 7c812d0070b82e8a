//! The NUCLEO's firmware, unchanged, on its modelled chip in real time (docs/chip.md section 5), as a board that is
//! bought without a key: its button is pressed, and its plug is pulled.

use std::ffi::OsString;
use std::os::unix::net::UnixStream;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};

use recipe_test_kit::{Process, chip, until};
use serde_json::Value;

use crate::board::{Board, LINE, Surroundings};
use crate::target::Target;

/// The emulator's socket for the board's button and plug.
pub(crate) fn control(around: &Surroundings) -> PathBuf {
    around.path("control").into()
}

/// Starts the emulator with a program and the image of a configuration file, on the board's line and network.
pub(crate) fn emulate(around: &Surroundings, elf: &Path, file: &Path, more: &[OsString]) -> Process {
    // Beside this program's binary: `cargo build -p recipe-chip-model` has made it.
    let mut command = Command::new(Path::new(env!("CARGO_BIN_EXE_host-sim")).with_file_name("chip-model"));
    command.arg(elf).arg(around.image(file)).arg("--realtime");
    command.arg("--rs485").arg(around.path(LINE));
    command.arg("--control").arg(control(around));
    command.arg("--network").arg(around.forward());
    command.args(more);
    let chip = Process::start(command.stdout(Stdio::piped()).stderr(Stdio::piped()));
    until("the emulator's sockets", || UnixStream::connect(control(around)).ok());
    chip
}

/// The board, its panel on RS-485 A.
pub(crate) struct Nucleo {
    elf: PathBuf,
    around: Surroundings,
    /// The emulator; it goes on when the board has no power.
    chip: Option<Process>,
}

impl Nucleo {
    /// A board with the firmware that `HOST_SIM_NUCLEO` names.
    pub(crate) fn new() -> Self {
        let elf = Surroundings::named("HOST_SIM_NUCLEO");
        Self { elf, around: Surroundings::new(), chip: None }
    }

    fn control(&self) -> PathBuf {
        control(&self.around)
    }

    fn log(&self) -> String {
        self.chip.as_ref().map_or_else(String::new, |chip| chip.lines().join("\n"))
    }
}

impl Board for Nucleo {
    fn around(&self) -> &Surroundings {
        &self.around
    }

    fn around_mut(&mut self) -> &mut Surroundings {
        &mut self.around
    }

    fn start(&mut self, file: &Path) {
        if self.chip.is_none() {
            self.chip = Some(emulate(&self.around, &self.elf, file, &[]));
        }
    }

    fn press(&self) {
        chip::command(&self.control(), "press 200");
    }

    /// Pulls its plug, and puts it in again.
    fn kill(&mut self) {
        chip::command(&self.control(), "power");
    }

    fn short_trial_s(&self) -> u32 {
        30
    }
}

impl Drop for Nucleo {
    fn drop(&mut self) {
        self.pull();
        if std::thread::panicking() {
            eprintln!("the board's log:\n{}", self.log());
            return;
        }
        let figures: Value = serde_json::from_str(&chip::request(&self.control(), "figures")).unwrap();
        assert_eq!(figures["resets"], 0, "the watchdog has reset the board");
        // Two trials and their ends: by itself, as no other reset has a cause.
        assert!(figures["restarts"].as_u64() >= Some(3), "{figures}");
        assert!(!self.log().contains("panicked"), "the firmware panicked");
    }
}
