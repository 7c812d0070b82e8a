//! A whole cell in one process: simulated controller, gateway, field devices.
//!
//! The devices are pseudoterminals, sockets and slcan connections like those of any other client;
//! nothing is passed on inside the process.

mod cell;
mod device;
mod examples;
mod show;

use std::process::ExitCode;
use std::time::Instant;

use cell::Folder;
use show::Show;

/// Runs the cell and prints what it does; success only when every example passes.
pub fn run() -> ExitCode {
    let started = Instant::now();
    let folder = match Folder::new() {
        Ok(folder) => folder,
        Err(error) => {
            eprintln!("no folder for the devices: {error}");
            return ExitCode::FAILURE;
        }
    };
    clean_up_on_interrupt(folder.root());
    anstream::println!("{INTRODUCTION}");
    let mut show = Show::default();
    examples::run_all(&mut show, &folder);
    if show.verdict(started.elapsed().as_secs_f64()) { ExitCode::SUCCESS } else { ExitCode::FAILURE }
}

/// Ctrl-C leaves nothing behind. Everything else ends with the process.
fn clean_up_on_interrupt(folder: std::path::PathBuf) {
    std::thread::spawn(move || {
        let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build();
        let interrupted = runtime.is_ok_and(|runtime| runtime.block_on(tokio::signal::ctrl_c()).is_ok());
        if interrupted {
            let _ = std::fs::remove_dir_all(folder);
            anstream::eprintln!("interrupted");
            std::process::exit(INTERRUPTED);
        }
    });
}

/// 128 + SIGINT, as shells have it.
const INTERRUPTED: i32 = 130;

const INTRODUCTION: &str = "\
A DUCO CORE robot controller talks to devices in recipes: frames of bytes or CAN frames
that carry chosen variables. This runs the interface description's six examples, each
twice: with the device on the simulated controller's own port, and with the device on a
port of the gateway, which passes it on to the controller over the network.

Everything below goes over real pseudoterminals and sockets of this machine.
  >  sent by the device     <  received by the device     (no hardware is used)";
