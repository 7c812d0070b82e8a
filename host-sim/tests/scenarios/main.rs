//! The cell's scenarios, written once and run against the gateway on this host, against the firmware in
//! QEMU, and against the NUCLEO's firmware on its modelled chip.
//!
//! Each scenario is counted three times, as `host::NAME`, `qemu::NAME` and `nucleo::NAME`. Scenarios that stop
//! the gateway for seconds run on the host only, since a guest's clock stops with it. The field devices are on
//! pseudoterminals and slcan over TCP, on emulated UARTs, or on modelled lines and a modelled CAN bus; or they
//! are TCP servers. Those, and the controller, which is always `host-sim controller`, are reached over loopback or
//! over the emulated Ethernet.
//!
//! * `HOST_SIM_FIRMWARE=ELF` names the firmware for QEMU (`qemu-system-arm` has to be installed). Without it
//!   the cases of QEMU are counted as ignored.
//! * `HOST_SIM_NUCLEO=ELF` names the firmware for the NUCLEO; `CHIP_UNICORN` the library that emulates its
//!   instructions (docs/chip.md). Run `cargo build -p recipe-chip-model` before; `qemu-system-arm` is the network. Without
//!   it the cases of the NUCLEO are counted as ignored.
//! * `HOST_SIM_NAMESPACES=required` fails if no user and network namespace can be made (Debian: util-linux,
//!   iproute2). Otherwise the cases that need one are counted as ignored.
//! * `HOST_SIM_LOAD_SECONDS` is the length of the run under full load.
//!
//! The logs of all programs are under `target/tmp/scenarios/`; they are kept if a case fails.

mod board;
mod case;
mod checked;
mod commands;
mod devices;
mod environment;
mod examples;
mod faults;
mod field;
mod garbage;
mod host;
mod load;
mod modbus_device;
mod namespace;
mod network;
mod nucleo;
mod program;
mod qemu;
mod refusal;
mod robot;
mod rtu;
mod safe;
mod terminals;
mod traffic;
mod unreadable;

use std::path::{Path, PathBuf};
use std::process::ExitCode;
use std::sync::{Arc, RwLock};

use libtest_mimic::{Arguments, Trial};

use case::Scenario;
use environment::Environment;

/// How to get the firmware.
const HOW: &str = "HOST_SIM_FIRMWARE=ELF cargo test --test scenarios (Debian: apt-get install \
                   qemu-system-arm; the ELF: rustup target add thumbv7em-none-eabihf, cargo firmware-qemu, \
                   then it is target/thumbv7em-none-eabihf/firmware/firmware)";
/// Same, for the NUCLEO.
const HOW_NUCLEO: &str =
    "HOST_SIM_NUCLEO=ELF CHIP_UNICORN=LIBRARY cargo test --test scenarios (docs/chip.md)";
/// Number of cases at a time. They mostly wait.
const THREADS: usize = 4;

fn main() -> ExitCode {
    if let Some(code) = program::is_started_to_end_with_us() {
        return code;
    }
    let mut arguments = Arguments::from_args();
    arguments.test_threads = arguments.test_threads.or(Some(THREADS));
    let found = [
        found("HOST_SIM_FIRMWARE", HOW, firmware("HOST_SIM_FIRMWARE")),
        found("HOST_SIM_NUCLEO", HOW_NUCLEO, nucleo()),
    ];
    let [Ok(firmware), Ok(nucleo)] = found else { return ExitCode::FAILURE };
    let no_namespaces = namespace::refused();
    if let Some(reason) = &no_namespaces {
        let must = std::env::var_os("HOST_SIM_NAMESPACES").is_some_and(|level| level == "required");
        eprintln!("scenarios: no user namespaces, so no cable of this host can be pulled truly: {reason}");
        if must {
            return ExitCode::FAILURE;
        }
    }
    let scenarios = |environment: &dyn Environment| {
        let sleeps = environment.sleeps_noticeably();
        let all = [
            examples::all(),
            faults::all(),
            garbage::all(),
            refusal::all(),
            safe::all(),
            commands::all(),
            checked::all(),
            rtu::all(),
            devices::all(),
            unreadable::all(),
            load::all(),
        ];
        all.into_iter().flatten().filter(move |scenario| sleeps || !scenario.is_of_sleep)
    };
    terminals::watch();
    // A case that measures runs alone.
    let machine = Arc::new(RwLock::new(()));
    let mut trials = Vec::new();
    let host: Arc<dyn Environment> = Arc::new(host::Host);
    for scenario in scenarios(&*host) {
        trials.push(match &no_namespaces {
            Some(_) if scenario.has_true_cable => ignored("host", &scenario, "needs user namespaces"),
            _ => trial(scenario, Arc::clone(&host), &machine),
        });
    }
    let qemu: Arc<dyn Environment> = Arc::new(qemu::Qemu { elf: firmware.clone().unwrap_or_default() });
    for scenario in scenarios(&*qemu) {
        trials.push(match &firmware {
            Some(_) => trial(scenario, Arc::clone(&qemu), &machine),
            None => ignored("qemu", &scenario, "needs HOST_SIM_FIRMWARE"),
        });
    }
    let emulator = Path::new(env!("CARGO_BIN_EXE_host-sim")).with_file_name("chip-model");
    let chip = nucleo::Nucleo { elf: nucleo.clone().unwrap_or_default(), emulator };
    let chip: Arc<dyn Environment> = Arc::new(chip);
    for scenario in scenarios(&*chip) {
        trials.push(match &nucleo {
            Some(_) => trial(scenario, Arc::clone(&chip), &machine),
            None => ignored("nucleo", &scenario, "needs HOST_SIM_NUCLEO"),
        });
    }
    libtest_mimic::run(&arguments, trials).exit_code()
}

fn ignored(environment: &str, scenario: &Scenario, why: &str) -> Trial {
    let name = format!("{environment}::{}", scenario.name);
    Trial::test(name, || Ok(())).with_kind(why).with_ignored_flag(true)
}

fn trial(scenario: Scenario, environment: Arc<dyn Environment>, machine: &Arc<RwLock<()>>) -> Trial {
    let name = format!("{}::{}", environment.name(), scenario.name);
    let machine = Arc::clone(machine);
    Trial::test(name.clone(), move || case::run(&name, &scenario, &environment, &machine))
}

/// Why there is no firmware to run.
enum Missing {
    Skip(String),
    Fail(String),
}

/// The firmware; `None` if its cases are to be ignored.
fn found(variable: &str, how: &str, firmware: Result<PathBuf, Missing>) -> Result<Option<PathBuf>, ()> {
    match firmware {
        Ok(firmware) => Ok(Some(firmware)),
        Err(Missing::Skip(reason)) => {
            eprintln!("scenarios: those of {variable} are skipped, {reason}; {how}");
            Ok(None)
        }
        Err(Missing::Fail(reason)) => {
            eprintln!("scenarios: {reason}");
            Err(())
        }
    }
}

fn firmware(variable: &str) -> Result<PathBuf, Missing> {
    let Some(named) = std::env::var_os(variable).filter(|named| !named.is_empty()) else {
        return Err(Missing::Skip("it names no firmware".into()));
    };
    // Cargo runs tests in the package's folder; the path is relative to the workspace.
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("..").join(&named);
    if !path.is_file() {
        return Err(Missing::Fail(format!("{variable}={}: no such file", named.display())));
    }
    if !program::exists("qemu-system-arm") {
        return Err(Missing::Skip("there is no qemu-system-arm".into()));
    }
    Ok(path)
}

/// The NUCLEO's firmware, which needs its emulator as well.
fn nucleo() -> Result<PathBuf, Missing> {
    let path = firmware("HOST_SIM_NUCLEO")?;
    if std::env::var_os("CHIP_UNICORN").is_none() {
        return Err(Missing::Fail("HOST_SIM_NUCLEO needs CHIP_UNICORN (docs/chip.md)".into()));
    }
    if !Path::new(env!("CARGO_BIN_EXE_host-sim")).with_file_name("chip-model").is_file() {
        return Err(Missing::Fail("HOST_SIM_NUCLEO needs 'cargo build -p recipe-chip-model' before".into()));
    }
    Ok(path)
}
