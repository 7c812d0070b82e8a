//! `host-sim ctl` as a person runs it.

use std::net::SocketAddr;
use std::path::PathBuf;
use std::process::{Command, Output};

use recipe_test_kit::until;
use serde_json::Value;

use crate::BINARY;

/// A gateway and the key to it.
#[derive(Debug, Clone)]
pub(crate) struct Ctl {
    pub(crate) to: SocketAddr,
    /// The address that it knows itself by, if it is another one.
    pub(crate) host: Option<&'static str>,
    pub(crate) key: Option<PathBuf>,
    /// How long it waits for an answer.
    pub(crate) timeout: &'static str,
}

/// For a machine that other programs keep busy.
pub(crate) const TIMEOUT: &str = "60s";

/// What a command printed.
#[derive(Debug)]
pub(crate) struct Printed {
    pub(crate) code: i32,
    pub(crate) out: String,
    pub(crate) err: String,
}

impl Ctl {
    /// The command with these arguments.
    pub(crate) fn command(&self, args: &[&str]) -> Command {
        let mut command = BINARY.command();
        command.env_remove("HOST_SIM_GATEWAY").env_remove("HOST_SIM_GATEWAY_KEY");
        command.args(["ctl", "--to", &self.to.to_string(), "--timeout", self.timeout]);
        command.args(self.host.map(|host| format!("--host={host}")));
        if let Some(key) = &self.key {
            command.arg("--key").arg(key);
        }
        command.args(args);
        command
    }

    /// Runs it to its end.
    #[track_caller]
    pub(crate) fn run(&self, args: &[&str]) -> Printed {
        Printed::of(self.command(args).output().unwrap())
    }

    /// Runs it, and it must say that it is done.
    #[track_caller]
    pub(crate) fn done(&self, args: &[&str]) -> String {
        self.run(args).must_be(0).out
    }

    /// The document of a command that is done.
    #[track_caller]
    pub(crate) fn json(&self, args: &[&str]) -> Value {
        let out = self.done(&[&["--json"], args].concat());
        serde_json::from_str(&out).unwrap_or_else(|error| panic!("{error}: {out}"))
    }

    /// Runs it until it ends with this code.
    #[track_caller]
    pub(crate) fn until(&self, code: i32, args: &[&str]) -> Printed {
        until(&format!("exit code {code} of {args:?}"), || {
            let printed = self.run(args);
            (printed.code == code).then_some(printed)
        })
    }
}

impl Printed {
    pub(crate) fn of(output: Output) -> Self {
        Self {
            code: output.status.code().unwrap_or(-1),
            out: String::from_utf8(output.stdout).unwrap(),
            err: String::from_utf8(output.stderr).unwrap(),
        }
    }

    #[track_caller]
    pub(crate) fn must_be(self, code: i32) -> Self {
        assert_eq!(self.code, code, "{self:#?}");
        self
    }
}
