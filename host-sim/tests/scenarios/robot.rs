//! The simulated controller of a case, as a separate process.

use std::net::{SocketAddr, TcpListener, UdpSocket};
use std::path::PathBuf;
use std::sync::atomic::{AtomicU16, Ordering};

use recipe_test_kit::{SERVERS, until};

use super::case::Case;
use super::program::HostSim;

/// How a controller is started.
pub(crate) struct RobotPlan<'a> {
    case: &'a Case,
    file: PathBuf,
    ports: [u16; 4],
    extra: Vec<String>,
}

impl<'a> RobotPlan<'a> {
    pub(crate) fn new(case: &'a Case, file: PathBuf) -> Self {
        Self { case, file, ports: [0; 4], extra: Vec::new() }
    }

    /// Overrides a key of the file.
    pub(crate) fn set(mut self, key: &str, value: impl std::fmt::Display) -> Self {
        self.extra.push(format!("--set={key}={value}"));
        self
    }

    /// Binds one of its own ports to a device.
    pub(crate) fn bind(mut self, port: &str, device: &str) -> Self {
        self.extra.push(format!("--bind={port}={device}"));
        self
    }

    /// Listens on these ports instead of free ones.
    pub(crate) fn on(self, ports: [u16; 4]) -> Self {
        Self { ports, ..self }
    }

    #[track_caller]
    pub(crate) fn start(mut self) -> Robot {
        for (name, port) in SERVERS.iter().zip(self.ports) {
            self = self.set(&format!("listen.{name}"), port);
        }
        Robot { host_sim: HostSim::start(self.case, "controller", &self.file, &self.extra) }
    }
}

/// A running controller.
#[derive(Debug)]
pub(crate) struct Robot {
    host_sim: HostSim,
}

impl Robot {
    /// The address of one of its servers.
    #[track_caller]
    pub(crate) fn address(&self, server: &str) -> SocketAddr {
        self.host_sim.ready[server].as_str().unwrap().parse().unwrap()
    }

    /// The present value of a variable.
    #[track_caller]
    pub(crate) fn variable(&self, name: &str) -> f64 {
        self.host_sim.program.fresh()["registers"][name].as_f64().unwrap_or(0.0)
    }

    /// The value of a variable in the newest statistics.
    pub(crate) fn newest(&self, name: &str) -> f64 {
        self.host_sim.program.newest()["registers"][name].as_f64().unwrap_or(0.0)
    }

    /// Waits until a variable has this value.
    #[track_caller]
    pub(crate) fn until(&self, name: &str, value: f64) {
        self.host_sim.program.stats(&format!("{name} = {value}"), |stats| {
            stats["registers"][name].as_f64().unwrap_or(0.0) == value
        });
    }

    /// Same, and calls `act` repeatedly until then.
    #[track_caller]
    pub(crate) fn until_after(&self, name: &str, value: f64, mut act: impl FnMut()) {
        until(&format!("{name} = {value}"), || {
            act();
            (self.newest(name) == value).then_some(())
        });
    }

    /// Waits until its statistics satisfy `found`.
    #[track_caller]
    pub(crate) fn until_stats(&self, what: &str, found: impl Fn(&serde_json::Value) -> bool) {
        self.host_sim.program.stats(what, found);
    }

    /// Whether a program runs, by the newest statistics.
    pub(crate) fn is_running(&self) -> bool {
        self.host_sim.program.newest()["program_state"].as_u64().is_some_and(|state| state != 0)
    }

    /// The present value of a counter in its statistics.
    #[track_caller]
    pub(crate) fn count(&self, pointer: &str) -> u64 {
        let stats = self.host_sim.program.fresh();
        let count = stats.pointer(pointer).and_then(serde_json::Value::as_u64);
        count.unwrap_or_else(|| panic!("no {pointer} in {stats}"))
    }

    /// Sends a command to port 2000 and checks the reply.
    #[track_caller]
    pub(crate) fn command(&self, request: &str, reply: &str) {
        recipe_test_kit::command(self.address("command"), request, reply);
    }

    /// Ends it by SIGINT.
    #[track_caller]
    pub(crate) fn end(mut self) {
        self.host_sim.program.interrupt();
    }
}

/// Ports for servers that are restarted. They are below the range for clients, so that no other program gets
/// them meanwhile.
#[track_caller]
pub(crate) fn reserved_ports() -> [u16; 4] {
    static NEXT: AtomicU16 = AtomicU16::new(0);
    let first = (std::process::id() % 1000) as u16 * 8;
    let mut candidates =
        std::iter::repeat_with(|| 20_000 + first.wrapping_add(NEXT.fetch_add(1, Ordering::Relaxed)) % 12_000);
    let is_free = |port: &u16| {
        let place = ("127.0.0.1", *port);
        TcpListener::bind(place).is_ok() && UdpSocket::bind(place).is_ok()
    };
    std::array::from_fn(|_| candidates.by_ref().take(1_000).find(is_free).expect("a free port"))
}
