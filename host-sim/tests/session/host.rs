//! The gateway on this host.

use std::io::Write;
use std::net::{SocketAddr, TcpStream};
use std::path::Path;

use recipe_test_kit::HostSim;
use tempfile::TempDir;

use crate::BINARY;
use crate::ctl::{Ctl, TIMEOUT};
use crate::panel::Panel;
use crate::robot::Robot;
use crate::target::Target;

/// `host-sim gateway`, its panel on TCP.
pub(crate) struct Host {
    folder: TempDir,
    robot: Robot,
    gateway: Option<HostSim>,
    panel: Option<Panel>,
}

impl Host {
    pub(crate) fn new() -> Self {
        let folder = tempfile::tempdir().unwrap();
        let robot = Robot::new(folder.path());
        Self { folder, robot, gateway: None, panel: None }
    }
}

impl Target for Host {
    fn folder(&self) -> &TempDir {
        &self.folder
    }

    fn config(&self, timeout_ms: u32) -> String {
        self.robot.config(timeout_ms)
    }

    fn start(&mut self, file: &Path) {
        let path = |name: &str| self.folder.path().join(name);
        let mut command = BINARY.run("gateway", file);
        command.args(["--no-realtime", "--bind=device=tcp-listen:127.0.0.1:0", "--console=127.0.0.1:0"]);
        command.arg("--console-key").arg(path("key")).arg("--console-state").arg(path("revisions"));
        self.gateway = Some(HostSim::start(&mut command));
    }

    fn kill(&mut self) {
        if let Some(gateway) = &mut self.gateway {
            gateway.kill();
        }
        self.gateway = None;
    }

    fn address(&self) -> SocketAddr {
        self.gateway.as_ref().expect("it runs").at("console")
    }

    fn plug(&mut self) {
        let ctl = Ctl { to: self.address(), host: None, key: None, timeout: TIMEOUT };
        // A gateway that is replaced has another address.
        self.panel = Some(Panel::start(move || {
            let stream = TcpStream::connect(place(&ctl)?).ok()?;
            Some(Box::new(stream) as Box<dyn Write>)
        }));
    }

    fn pull(&mut self) {
        self.panel = None;
    }
}

/// Where the panel's port is now, if the gateway runs.
fn place(ctl: &Ctl) -> Option<SocketAddr> {
    let printed = ctl.run(&["--json", "info"]);
    let info: serde_json::Value = serde_json::from_str(&printed.out).ok()?;
    info["places"]["ports"]["device"].as_str()?.parse().ok()
}
