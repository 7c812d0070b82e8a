//! The programs that are compared: host-sim, and those in C, which are built here.

use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};

/// The folder of this program, `target/release`.
fn folder() -> PathBuf {
    std::env::current_exe().expect("a program knows where it is").parent().expect("in a folder").to_owned()
}

/// A command that runs host-sim of the same profile.
///
/// # Panics
/// If it was not built.
pub(crate) fn host_sim() -> Command {
    let path = folder().join("host-sim");
    assert!(path.exists(), "{} is not there: cargo build --release -p host-sim", path.display());
    piped(Command::new(path))
}

/// A command that runs this program again.
pub(crate) fn this() -> Command {
    piped(Command::new(std::env::current_exe().expect("a program knows where it is")))
}

/// A command that runs `c/NAME.c`, built by `cc -O2`.
///
/// # Panics
/// If it cannot be built.
pub(crate) fn in_c(name: &str, libraries: &[&str]) -> Command {
    let source = Path::new(env!("CARGO_MANIFEST_DIR")).join("c").join(name).with_extension("c");
    let program = folder().join(format!("compare-{name}"));
    let mut cc = Command::new("cc");
    cc.args(["-O2", "-Wall", "-Wextra", "-Werror", "-o"]).arg(&program).arg(source).args(libraries);
    let is_built = cc.status().unwrap_or_else(|error| panic!("cc: {error}")).success();
    assert!(is_built, "c/{name}.c was not built; Debian has what it needs in gcc and libmodbus-dev");
    piped(Command::new(program))
}

fn piped(mut command: Command) -> Command {
    command.stdin(Stdio::null()).stdout(Stdio::piped()).stderr(Stdio::piped());
    command
}
