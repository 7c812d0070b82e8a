//! CAN interfaces of a USB adapter with a real driver: the programs as separate processes, on a simulated
//! adapter ([`candlelight`]) with the kernel's `gs_usb`.
//!
//! `HOST_SIM_USB_CAN` chooses where:
//!
//! * `HOST_SIM_USB_CAN=qemu cargo test --test usb_can`: on Debian's stock kernel, which
//!   `host-sim/tests/pc/kernel` downloads, in an emulated PC (`tests/pc/run`); no privileges are needed.
//! * `HOST_SIM_USB_CAN=here cargo test --test usb_can`: on this machine's kernel, as root, after
//!   `modprobe -a vhci_hcd gs_usb`. There must be no interface `can0`.
//! * Without it every test is counted as ignored.
//!
//! Only what is different with a real driver is tested here; the rest is in `tests/socketcan`.

mod bus_off;
mod candlelight;
mod cases;
mod stand;
mod usb;

use std::os::unix::process::CommandExt;
use std::path::Path;
use std::process::{Command, ExitCode};

use libtest_mimic::{Arguments, Failed, Trial};
use recipe_test_kit::Binary;

const BINARY: Binary = Binary(env!("CARGO_BIN_EXE_host-sim"));

const HOW: &str = "host-sim/tests/pc/kernel && HOST_SIM_USB_CAN=qemu cargo test --test usb_can (Debian: apt-get \
                   install qemu-system-x86 busybox-static can-utils iproute2 xz-utils), or HOST_SIM_USB_CAN=here as root \
                   on a kernel with vhci_hcd and gs_usb";

fn main() -> ExitCode {
    let mut arguments = Arguments::from_args();
    // All tests use can0.
    arguments.test_threads = Some(1);
    let chosen = std::env::var("HOST_SIM_USB_CAN").unwrap_or_default();
    if chosen == "qemu" && !arguments.list {
        let runner = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/pc/run");
        let mut command = Command::new(&runner);
        command.args(std::env::current_exe()).args(std::env::args_os().skip(1));
        let error = command.env("HOST_SIM_USB_CAN", "here").exec();
        eprintln!("{}: {error}", runner.display());
        return ExitCode::FAILURE;
    }
    if chosen.is_empty() {
        eprintln!("usb_can: skipped, there is no adapter; {HOW}");
    }
    let trials = [cases::CASES, bus_off::CASES].concat().into_iter().map(|(name, test)| {
        let trial = Trial::test(name, move || {
            test();
            Ok::<(), Failed>(())
        });
        trial.with_ignored_flag(chosen.is_empty())
    });
    libtest_mimic::run(&arguments, trials.collect()).exit_code()
}

/// A test's name and function.
type Case = (&'static str, fn());
