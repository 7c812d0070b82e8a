//! The benchmark's CAN frames by the C functions that cantools writes for a database.

use std::os::unix::process::CommandExt;
use std::path::PathBuf;
use std::process::Command;

use crate::can;
use crate::workload::FRAMES;

/// The version that stands in the table; another one is refused.
const VERSION: &str = "45.1.0";

/// `CANTOOLS=PROGRAM`, or the one in `PATH`.
fn cantools() -> Command {
    Command::new(std::env::var_os("CANTOOLS").unwrap_or_else(|| "cantools".into()))
}

fn folder() -> PathBuf {
    let us = std::env::current_exe().expect("a program knows where it is");
    us.with_file_name("compare-cantools")
}

/// Makes the program.
///
/// # Errors
/// Text for people, when a tool is missing or fails.
pub(crate) fn build() -> Result<(), String> {
    let output = cantools().arg("--version").output().map_err(|error| {
        format!("cantools: {error}\n`pip install cantools=={VERSION}`, or name one: CANTOOLS=PROGRAM")
    })?;
    let found = String::from_utf8_lossy(&output.stdout);
    if found.trim() != VERSION {
        return Err(format!("cantools {VERSION} is wanted, not {:?}", found.trim()));
    }
    let folder = folder();
    let failed = |what: &str| format!("{what} in {}", folder.display());
    std::fs::create_dir_all(&folder).map_err(|error| failed(&error.to_string()))?;
    let frames = can::frames();
    let write = |name: &str, bytes: &[u8]| {
        std::fs::write(folder.join(name), bytes).map_err(|error| failed(&format!("{name}: {error}")))
    };
    let bytes: Vec<u8> = frames.iter().flat_map(|(id, data)| [&id.to_le_bytes(), &**data].concat()).collect();
    write("frames", &bytes)?;
    let ids = can::ids();
    write("frames.dbc", can::database(&ids).as_bytes())?;
    write("ids.h", ids.iter().map(|id| format!("FRAME({id})\n")).collect::<String>().as_bytes())?;
    let mut generate = cantools();
    generate.args(["generate_c_source", "--use-float", "--database-name", "frames", "frames.dbc"]);
    let mut cc = Command::new("cc");
    cc.args(["-O2", "-Wall", "-Wextra", "-Werror", "-I.", "-o", "can", "frames.c"]);
    cc.arg(concat!(env!("CARGO_MANIFEST_DIR"), "/c/can.c"));
    for mut command in [generate, cc] {
        let output = command.current_dir(&folder).output();
        let output = output.map_err(|error| failed(&format!("{command:?}: {error}")))?;
        if !output.status.success() {
            return Err(failed(&format!("{command:?}: {}", String::from_utf8_lossy(&output.stderr))));
        }
    }
    Ok(())
}

/// Becomes that program, for `frames` frames.
pub(crate) fn run(frames: u64) {
    let folder = folder();
    let passes = (frames / FRAMES as u64).to_string();
    let error = Command::new(folder.join("can")).arg(folder.join("frames")).arg(passes).exec();
    panic!("{}: {error}", folder.join("can").display());
}
