//! The firmware in QEMU, as a board that is bought without a key.

use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};

use crate::board::{Board, LINE, Surroundings};
use crate::target::Target;

/// The sockets of its UARTs: RS-485 twice, the panel on the first one, and CAN as slcan.
pub(crate) const UARTS: [&str; 3] = [LINE, "line-b", "can"];

/// The board, its panel on the first line.
pub(crate) struct Qemu {
    elf: PathBuf,
    around: Surroundings,
    qemu: Option<Child>,
}

impl Qemu {
    /// A board with the firmware that `HOST_SIM_FIRMWARE` names.
    pub(crate) fn new() -> Self {
        Self::with(Surroundings::new())
    }

    /// The same around it.
    pub(crate) fn with(around: Surroundings) -> Self {
        Self { elf: Surroundings::named("HOST_SIM_FIRMWARE"), around, qemu: None }
    }

    fn path(&self, name: &str) -> String {
        self.around.path(name)
    }

    fn log(&self) -> String {
        std::fs::read_to_string(self.path("log")).unwrap_or_default()
    }
}

impl Board for Qemu {
    fn around(&self) -> &Surroundings {
        &self.around
    }

    fn around_mut(&mut self) -> &mut Surroundings {
        &mut self.around
    }

    fn start(&mut self, file: &Path) {
        let image = self.around.image(file);
        let _ = std::fs::remove_file(self.path("log"));
        for uart in UARTS {
            let _ = std::fs::remove_file(self.path(uart));
        }
        // As in firmware/README.md: image, fault, store, button.
        let arguments = format!(
            "enable=on,target=native,arg=firmware,arg={image},arg=none,arg={},arg={}",
            self.path("store"),
            self.path("button")
        );
        let qemu = Command::new("qemu-system-arm")
            .args("-M mps2-an500 -display none -monitor none".split(' '))
            .args(["-nic", &format!("user,{}", self.around.forward())])
            .args(UARTS.iter().flat_map(|uart| {
                ["-serial".to_owned(), format!("unix:{},server=on,wait=off", self.path(uart))]
            }))
            .args(["-serial", &format!("file:{}", self.path("log"))])
            .args(["-semihosting-config", &arguments, "-kernel"])
            .arg(&self.elf)
            .stdin(Stdio::null())
            .spawn();
        self.qemu = Some(qemu.expect("qemu-system-arm runs"));
    }

    fn press(&self) {
        std::fs::write(self.path("button"), "").unwrap();
    }

    fn let_go(&self) {
        std::fs::remove_file(self.path("button")).unwrap();
    }

    fn kill(&mut self) {
        if let Some(mut qemu) = self.qemu.take() {
            qemu.kill().unwrap();
            qemu.wait().unwrap();
        }
    }

    fn short_trial_s(&self) -> u32 {
        8
    }
}

impl Drop for Qemu {
    fn drop(&mut self) {
        if std::thread::panicking() {
            eprintln!("the board's log:\n{}", self.log());
        }
        self.pull();
        Board::kill(self);
    }
}
