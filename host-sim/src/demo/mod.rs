//! A whole cell in one process: simulated controller, gateway, field devices.
//!
//! The devices use pseudoterminals, sockets and slcan connections like any other client; nothing is passed
//! inside the process.

mod cell;
mod device;
mod examples;
mod folder;
mod living;
mod show;

use std::io;
use std::process::ExitCode;
use std::time::Instant;

use folder::TempFolder;
pub use living::run_living;
use recipe_runtime::Signals;
use recipe_runtime::out::print_stderr;
use show::Show;

/// Runs the cell and prints what it does, until the reader is gone; success if all examples that were run
/// passed.
pub fn run() -> ExitCode {
    let started = Instant::now();
    let folder = match prepare() {
        Ok(folder) => folder,
        Err(error) => {
            print_stderr(format_args!("no folder for the devices: {error}"));
            return ExitCode::FAILURE;
        }
    };
    let mut show = Show::new();
    show.introduce(INTRODUCTION);
    examples::run_all(&mut show, &folder);
    show.verdict(started.elapsed().as_secs_f64())
}

/// The folder for the devices. Ctrl-C and other signals remove it; everything else ends with the process.
fn prepare() -> io::Result<TempFolder> {
    let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build()?;
    let mut signals = {
        let _inside = runtime.enter();
        Signals::catch()?
    };
    let folder = TempFolder::new()?;
    let remover = folder.remover();
    std::thread::Builder::new().name("signals".to_owned()).spawn(move || {
        let signal = runtime.block_on(signals.next());
        print_stderr("interrupted");
        // The exit code as a command line shell reports it.
        remover.remove_and_exit(128 + signal)
    })?;
    Ok(folder)
}

const INTRODUCTION: &str = "\
A DUCO CORE robot controller talks to devices in recipes: frames of bytes or CAN frames
that carry chosen variables. This runs the interface description's six examples, each
twice: with the device on the simulated controller's own port, and with the device on a
port of the gateway, which passes it on to the controller over the network.

Everything below goes over real pseudoterminals and sockets of this machine.
  >  sent by the device     <  received by the device     (no hardware is used)";
