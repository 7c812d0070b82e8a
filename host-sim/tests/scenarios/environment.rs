//! What a scenario needs of a gateway, in every environment.

use std::net::SocketAddr;
use std::path::{Path, PathBuf};
use std::time::Duration;

use proto_core::config::{Bus, GatewayConfig};
use serde_json::Value;

use recipe_test_kit::{SERVERS, until, until_grown};

use super::case::Case;
use super::field::{CanClient, LineClient};
use super::refusal::Defect;
use super::robot::Robot;

/// A kind of gateway and how to run it.
pub(crate) trait Environment: Send + Sync {
    /// Its name in the names of the tests.
    fn name(&self) -> &'static str;

    /// Whether a gateway's clock goes on while it is stopped. That of an emulated board stops with it, as if a
    /// debugger halted the timers too: for the program no time has passed (proto-core/docs/engine.md section 2).
    fn sleeps_noticeably(&self) -> bool {
        false
    }

    /// Whether its field devices are on pseudoterminals.
    fn has_terminals(&self) -> bool {
        false
    }

    /// Makes a cable behind which nothing acknowledges what does not reach the other end. QEMU's network is one
    /// already.
    fn lay_true_cable(&self, _case: &Case) {}

    /// Starts a gateway, and waits for its field ports.
    fn start(&self, plan: &Plan<'_>) -> Box<dyn Gateway>;

    /// Starts a gateway with a configuration that cannot be used, and checks that its field ports stay silent.
    /// Returns its message.
    fn refuses(&self, plan: &Plan<'_>, defect: Defect) -> String;
}

/// A running gateway. The scenario fails if it panics or ends.
pub(crate) trait Gateway {
    /// The device at an RS-485 port.
    fn line(&self, port: &str) -> LineClient;

    /// A node on the bus of a CAN port.
    fn can(&self, port: &str) -> CanClient;

    /// The address at which the controller's client reaches a listening port.
    fn listens(&self, port: &str) -> SocketAddr;

    /// The state of a link.
    fn link(&self, link: Link<'_>) -> LinkStatus;

    /// The counters of a field port.
    fn port(&self, port: &str) -> PortStatus;

    /// Pulls the Ethernet cable, or plugs it in.
    fn cable(&self, cable: Cable);

    /// Stops it; its clock goes on.
    fn freeze(&self);

    /// Continues it.
    fn thaw(&self);

    /// The address in its log; `None` for a host's gateway.
    fn own_address(&self) -> Option<String>;

    /// The processor time that its process took.
    fn processor_time(&self) -> Duration;

    /// Its maximum memory so far, in bytes.
    fn memory(&self) -> u64;

    /// Its emulator's counters; null if there are none.
    fn figures(&self) -> Value {
        Value::Null
    }

    /// Fails if it has ended or panicked.
    fn must_run(&mut self);
}

impl dyn Gateway + '_ {
    /// Waits until a link is up and has come up at least `connects` times.
    #[track_caller]
    pub(crate) fn until_up(&mut self, link: Link<'_>, connects: u32) {
        until(&format!("{link:?} up ({connects})"), || {
            self.must_run();
            let status = self.link(link);
            (status.is_up && status.connects >= connects).then_some(())
        });
    }

    /// Waits until a link is down.
    #[track_caller]
    pub(crate) fn until_down(&mut self, link: Link<'_>) {
        until(&format!("{link:?} down"), || {
            self.must_run();
            (!self.link(link).is_up).then_some(())
        });
    }

    /// Waits until a field port has received this many bytes.
    #[track_caller]
    pub(crate) fn until_bytes_in(&mut self, port: &str, bytes: u64) -> PortStatus {
        let mut newest = PortStatus::default();
        until_grown(&format!("bytes from {port}"), bytes, || {
            self.must_run();
            newest = self.port(port);
            newest.bytes_in
        });
        newest
    }

    /// Waits until a field port has accepted this many frames.
    #[track_caller]
    pub(crate) fn until_frames_in(&mut self, port: &str, frames: u64) -> PortStatus {
        let mut newest = PortStatus::default();
        until_grown(&format!("frames from {port}"), frames, || {
            self.must_run();
            newest = self.port(port);
            newest.frames_in
        });
        newest
    }
}

/// A link to the controller.
#[derive(Debug, Clone, Copy)]
pub(crate) enum Link<'a> {
    Command,
    /// The connection for commands that stop the robot.
    Urgent,
    State,
    Modbus,
    /// The controller's UDP 2011 server.
    Udp2011,
    /// A listening port, to which the controller's TCP client connects.
    TcpListen(&'a str),
    /// A listening port, to which its UDP client sends.
    UdpListen(&'a str),
}

/// State of a link.
#[derive(Debug, Clone, Copy, Default)]
pub(crate) struct LinkStatus {
    pub(crate) is_up: bool,
    /// Number of times that it came up.
    pub(crate) connects: u32,
}

/// Counters of a field port.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub(crate) struct PortStatus {
    pub(crate) frames_in: u64,
    pub(crate) bytes_in: u64,
    pub(crate) frames_out: u64,
    pub(crate) bytes_out: u64,
    pub(crate) skipped_bytes: u64,
    pub(crate) skipped_cycles: u64,
    /// Bytes that found no room in the buffer of a host's pseudoterminal: its kernel thread, which moves them, may come
    /// seconds late on a busy machine.
    pub(crate) lost_bytes: u64,
}

/// The Ethernet cable.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Cable {
    Pulled,
    Plugged,
}

/// An idle gap that never ends a frame, since a busy machine makes pauses that no line has. QEMU passes a UART
/// one byte at a time and may be stopped in between: tens of milliseconds of the guest's clock can pass within a
/// frame. A pseudoterminal's bytes are moved by a kernel thread, which the gateway can preempt within a frame.
const IDLE_GAP_MS: u32 = 1_000;

/// How a gateway is started.
pub(crate) struct Plan<'a> {
    pub(crate) case: &'a Case,
    pub(crate) file: PathBuf,
    /// The scenario's own overrides, as `KEY=VALUE`.
    pub(crate) sets: Vec<String>,
    /// The controller's servers; empty if the gateway starts first.
    pub(crate) servers: Vec<(&'static str, SocketAddr)>,
    /// The TCP servers of devices, on this host, by their ports.
    pub(crate) devices: Vec<(&'static str, u16)>,
    /// Whether the scenario pulls the cable.
    pub(crate) pulls_cable: bool,
}

impl<'a> Plan<'a> {
    pub(crate) fn new(case: &'a Case, file: PathBuf) -> Self {
        Self { case, file, sets: Vec::new(), servers: Vec::new(), devices: Vec::new(), pulls_cable: false }
    }

    /// Overrides a key of the file.
    pub(crate) fn set(mut self, key: &str, value: impl std::fmt::Display) -> Self {
        self.sets.push(format!("{key}={value}"));
        self
    }

    /// Sets the controller.
    pub(crate) fn robot(mut self, robot: &Robot) -> Self {
        self.servers = SERVERS.map(|server| (server, robot.address(server))).into();
        self
    }

    /// Sets another address for one of the controller's servers.
    pub(crate) fn server_at(mut self, server: &str, address: SocketAddr) -> Self {
        for (name, place) in &mut self.servers {
            if *name == server {
                *place = address;
            }
        }
        self
    }

    /// Sets the address of the device that a port connects to.
    pub(crate) fn device_at(mut self, port: &'static str, address: SocketAddr) -> Self {
        self.devices.push((port, address.port()));
        self
    }

    /// The controller will be started later, on these ports of this host.
    pub(crate) fn set_servers(&mut self, ports: [u16; 4]) {
        let place = |port| SocketAddr::from(([127, 0, 0, 1], port));
        self.servers = SERVERS.into_iter().zip(ports.map(place)).collect();
    }

    /// The scenario will pull the Ethernet cable.
    pub(crate) fn with_cable(self) -> Self {
        Self { pulls_cable: true, ..self }
    }

    /// Starts the gateway.
    #[track_caller]
    pub(crate) fn start(&self) -> Box<dyn Gateway> {
        self.case.environment.start(self)
    }

    /// Starts it with a configuration that cannot be used; returns its message.
    #[track_caller]
    pub(crate) fn refused(&self, defect: Defect) -> String {
        self.case.environment.refuses(self, defect)
    }

    /// All overrides, for devices at `host`, and a controller there whose servers are on these ports.
    pub(crate) fn overrides(&self, host: &str, servers: &[(&'static str, u16)]) -> Vec<String> {
        let config = self.config();
        let mut overrides = vec![format!("controller.address={host}")];
        for (server, port) in servers {
            match *server {
                "udp2011" if config.controller.recipe_link.is_some() => {
                    overrides.push(format!("controller.recipe_link.udp={port}"));
                }
                "udp2011" => {}
                name => overrides.push(format!("controller.ports.{name}={port}")),
            }
        }
        let devices = self.devices.iter();
        overrides.extend(devices.map(|(port, server)| format!("port.{port}.to={host}:{server}")));
        for port in ports(&config, |bus| matches!(bus, Bus::Rs485(_))) {
            overrides.push(format!("port.{port}.idle_gap_ms={IDLE_GAP_MS}"));
        }
        overrides.extend(self.sets.iter().cloned());
        overrides
    }

    /// The configuration, with the scenario's own overrides.
    #[track_caller]
    pub(crate) fn config(&self) -> Box<GatewayConfig> {
        let config = recipe_config::file::load_gateway(&self.file, &self.sets);
        config.unwrap_or_else(|error| panic!("{error}"))
    }

    /// The controller's servers by their ports.
    pub(crate) fn server_ports(&self) -> Vec<(&'static str, u16)> {
        self.servers.iter().map(|(name, address)| (*name, address.port())).collect()
    }

    /// The path of the file for `host-sim`.
    pub(crate) fn file(&self) -> &Path {
        &self.file
    }
}

/// The names of the ports whose bus satisfies `bus`, in file order.
pub(crate) fn ports(config: &GatewayConfig, bus: impl Fn(&Bus) -> bool) -> Vec<String> {
    config.ports.iter().filter(|port| bus(&port.bus)).map(|port| port.name.as_str().to_owned()).collect()
}
