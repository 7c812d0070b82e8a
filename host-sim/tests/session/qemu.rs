//! The firmware in QEMU, as a board that is bought without a key.

use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};

use recipe_test_kit::qemu;

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
}

/// What the board has said since it was switched on.
pub(crate) fn log(around: &Surroundings) -> String {
    std::fs::read_to_string(around.path("log")).unwrap_or_default()
}

/// Starts QEMU with a program and the image of a configuration file, on the board's lines and network. Store and button
/// are files; `more` arguments follow.
pub(crate) fn emulate(around: &Surroundings, elf: &Path, file: &Path, more: &[&str]) -> Child {
    let image = around.image(file);
    let _ = std::fs::remove_file(around.path("log"));
    for uart in UARTS {
        let _ = std::fs::remove_file(around.path(uart));
    }
    // As in firmware/README.md: image, fault, store, button.
    let mut arguments = format!(
        "enable=on,target=native,arg=firmware,arg={image},arg=none,arg={},arg={}",
        around.path("store"),
        around.path("button")
    );
    arguments.extend(more.iter().map(|argument| format!(",arg={argument}")));
    let mut command = Command::new("qemu-system-arm");
    command
        .args("-M mps2-an500 -display none -monitor none".split(' '))
        .args(["-nic", &format!("user,{}", around.forward())])
        .args(qemu::MACHINE)
        .args(UARTS.iter().flat_map(|uart| qemu::line(uart, Path::new(&around.path(uart)))))
        .args(["-serial", &format!("file:{}", around.path("log"))])
        .args(["-semihosting-config", &arguments, "-kernel"])
        .arg(elf)
        .stdin(Stdio::null());
    qemu::on_one_processor(|| command.spawn()).expect("qemu-system-arm runs")
}

/// Presses the button of a board.
pub(crate) fn press(around: &Surroundings) {
    std::fs::write(around.path("button"), "").unwrap();
}

pub(crate) fn let_go(around: &Surroundings) {
    std::fs::remove_file(around.path("button")).unwrap();
}

/// Ends QEMU at once: the board has no power.
pub(crate) fn kill(qemu: &mut Option<Child>) {
    if let Some(mut qemu) = qemu.take() {
        qemu.kill().unwrap();
        qemu.wait().unwrap();
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
        self.qemu = Some(emulate(&self.around, &self.elf, file, &[]));
    }

    fn press(&self) {
        press(&self.around);
    }

    fn let_go(&self) {
        let_go(&self.around);
    }

    fn kill(&mut self) {
        kill(&mut self.qemu);
    }

    fn short_trial_s(&self) -> u32 {
        30
    }
}

impl Drop for Qemu {
    fn drop(&mut self) {
        if std::thread::panicking() {
            eprintln!("the board's log:\n{}", log(&self.around));
        }
        self.pull();
        Board::kill(self);
    }
}
