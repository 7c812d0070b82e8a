//! The controller of every gateway of the session, and the configuration for it.

use std::path::Path;

use recipe_test_kit::{HostSim, toml};

use crate::BINARY;

/// `host-sim controller`.
pub(crate) struct Robot(pub(crate) HostSim);

impl Robot {
    /// Starts it; its file is in this folder.
    pub(crate) fn new(folder: &Path) -> Self {
        let file = folder.join("robot.toml");
        std::fs::write(&file, "[listen]\naddress = \"127.0.0.1\"\n").unwrap();
        Self::of(&file)
    }

    /// With another file.
    pub(crate) fn of(file: &Path) -> Self {
        Self(BINARY.controller(file, &[]))
    }

    /// The text of a configuration of a gateway with a panel, which reaches this controller by its address on
    /// loopback.
    pub(crate) fn config(&self, timeout_ms: u32) -> String {
        let port = |name: &str| self.0.at(name).port();
        let ports = format!(
            "ports = {{ command = {}, state = {}, modbus = {} }}\n",
            port("command"),
            port("state"),
            port("modbus")
        );
        toml::panel("1 = \"stop\"", timeout_ms).replacen("[[recipe]]", &(ports + "\n[[recipe]]"), 1)
    }
}
