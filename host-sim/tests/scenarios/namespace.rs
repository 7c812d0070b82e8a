//! A network namespace for the programs of a case, without root: its only cable is the loopback interface.
//! When that is down nothing is acknowledged; behind a proxy, the proxy's kernel would acknowledge.

use std::ffi::OsString;
use std::path::Path;
use std::process::Command;

use recipe_test_kit::until;

use super::case::Case;
use super::environment::Cable;
use super::program::{Program, exists};

/// The tools that make it, from util-linux and iproute2.
const TOOLS: [&str; 3] = ["unshare", "nsenter", "ip"];

/// Why none can be made here.
pub(crate) fn refused() -> Option<String> {
    if let Some(tool) = TOOLS.into_iter().find(|tool| !exists(tool)) {
        return Some(format!("there is no {tool}"));
    }
    let made = Command::new("unshare").args(["-Urn", "ip", "link", "set", "lo", "up"]).output();
    match made {
        Ok(output) if output.status.success() => None,
        Ok(output) => Some(String::from_utf8_lossy(&output.stderr).trim().to_owned()),
        Err(error) => Some(error.to_string()),
    }
}

/// A network namespace that exists until it is dropped.
#[derive(Debug)]
pub(crate) struct Namespace {
    holder: Program,
}

impl Namespace {
    /// Makes one with the cable plugged in.
    #[track_caller]
    pub(crate) fn new(case: &Case) -> Self {
        let arguments = ["-Urn", "sleep", "infinity"].map(OsString::from);
        let holder = Program::start(case, "namespace", Path::new("unshare"), &arguments);
        let mut namespace = Self { holder };
        // The shell becomes `sleep` once everything is set up.
        let name = format!("/proc/{}/comm", namespace.holder.pid().as_raw_pid());
        until("the namespace", || {
            namespace.holder.must_run();
            std::fs::read_to_string(&name).is_ok_and(|name| name.trim() == "sleep").then_some(())
        });
        namespace.set(Cable::Plugged);
        namespace
    }

    /// Pulls the cable or plugs it in.
    #[track_caller]
    pub(crate) fn set(&self, cable: Cable) {
        let state = if cable == Cable::Plugged { "up" } else { "down" };
        let mut command = self.inside();
        let output = command.args(["ip", "link", "set", "lo", state]).output().unwrap();
        assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    }

    /// A command that runs its first argument as a program in the namespace, in the same process.
    pub(crate) fn inside(&self) -> Command {
        let mut command = Command::new("nsenter");
        let target = self.holder.pid().as_raw_pid().to_string();
        command.args(["-t", &target, "-U", "-n", "--preserve-credentials", "--"]);
        command
    }
}
