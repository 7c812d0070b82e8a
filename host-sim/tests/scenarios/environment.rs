//! What a scenario asks of a gateway, whoever it is.

use std::net::SocketAddr;
use std::path::{Path, PathBuf};
use std::time::Duration;

use proto_core::config::{Bus, GatewayConfig};
use serde_json::Value;

use recipe_test_kit::{SERVERS, until};

use super::case::Case;
use super::field::{CanClient, LineClient};
use super::refusal::Spoil;
use super::robot::Robot;

/// Where gateways run.
pub(crate) trait Environment: Send + Sync {
    /// As in the names of the tests.
    fn name(&self) -> &'static str;

    /// Whether the clock of a gateway goes on while it is stopped.
    fn sleeps_noticeably(&self) -> bool;

    /// Makes a cable of which no end acknowledges what did not get through to the other.
    fn lay_true_cable(&self, case: &Case);

    /// Starts a gateway; its field ports are there when this returns.
    fn start(&self, plan: &Plan<'_>) -> Box<dyn Gateway>;

    /// Starts a gateway whose configuration cannot be used. Returns what it says about it, once it
    /// is certain that its field ports stay silent.
    fn refuses(&self, plan: &Plan<'_>, spoil: Spoil) -> String;
}

/// A running gateway. It fails the scenario when it panics or ends.
pub(crate) trait Gateway {
    /// The device at an RS-485 port.
    fn line(&self, port: &str) -> LineClient;

    /// A node on the bus of a CAN port.
    fn can(&self, port: &str) -> CanClient;

    /// Where the controller's client reaches a listening port.
    fn listens(&self, port: &str) -> SocketAddr;

    /// What has become of a link so far.
    fn link(&self, link: Link<'_>) -> LinkStatus;

    /// What went through a field port so far.
    fn port(&self, port: &str) -> PortStatus;

    /// Pulls the Ethernet cable, or plugs it in.
    fn cable(&self, cable: Cable);

    /// Stops it where it is; its clock goes on.
    fn freeze(&self);

    /// Lets it go on.
    fn thaw(&self);

    /// The address that it says it has; a host's gateway says none.
    fn own_address(&self) -> Option<String>;

    /// The processor time that its host spent on it.
    fn processor_time(&self) -> Duration;

    /// The memory that it took so far at most, in bytes.
    fn memory(&self) -> u64;

    /// What its emulator counts, where there is one that counts.
    fn figures(&self) -> Value {
        Value::Null
    }

    /// Fails when it has ended, or said that it panicked.
    fn must_run(&mut self);
}

impl dyn Gateway + '_ {
    /// Waits until a link has come up for the `connects`th time, or more often, and is up.
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

    /// Waits until a field port has received so many bytes.
    #[track_caller]
    pub(crate) fn until_bytes_in(&mut self, port: &str, bytes: u64) -> PortStatus {
        let mut newest = PortStatus::default();
        until(&format!("{bytes} bytes from {port}"), || {
            self.must_run();
            newest = self.port(port);
            (newest.bytes_in >= bytes).then_some(())
        });
        newest
    }

    /// Waits until a field port has accepted so many frames.
    #[track_caller]
    pub(crate) fn until_frames_in(&mut self, port: &str, frames: u64) -> PortStatus {
        let mut newest = PortStatus::default();
        until(&format!("{frames} frames from {port}"), || {
            self.must_run();
            newest = self.port(port);
            (newest.frames_in >= frames).then_some(())
        });
        newest
    }
}

/// A link to the controller.
#[derive(Debug, Clone, Copy)]
pub(crate) enum Link<'a> {
    Command,
    State,
    Modbus,
    /// The controller's UDP 2011 server.
    Udp2011,
    /// A port of this name that the controller's TCP client connects to.
    TcpListen(&'a str),
    /// One that its UDP client sends to.
    UdpListen(&'a str),
}

/// What has become of a link.
#[derive(Debug, Clone, Copy, Default)]
pub(crate) struct LinkStatus {
    pub(crate) is_up: bool,
    /// How often it came up.
    pub(crate) connects: u32,
}

/// What went through a field port.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub(crate) struct PortStatus {
    pub(crate) frames_in: u64,
    pub(crate) bytes_in: u64,
    pub(crate) frames_out: u64,
    pub(crate) bytes_out: u64,
    pub(crate) skipped_bytes: u64,
    pub(crate) skipped_cycles: u64,
}

/// The Ethernet cable.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Cable {
    Pulled,
    Plugged,
}

/// No silence ends a frame here, since a busy machine makes silences that no line has. QEMU hands a UART
/// one byte at a time, and may be stopped between two: by the guest's own clock tens of milliseconds passed
/// within a frame that was sent at once. A pseudoterminal's bytes are moved by a worker of the kernel, which
/// the gateway preempts in the middle of a frame.
const IDLE_GAP_MS: u32 = 1_000;

/// How a gateway is started.
pub(crate) struct Plan<'a> {
    pub(crate) case: &'a Case,
    pub(crate) file: PathBuf,
    /// `KEY=VALUE`, for what is the scenario's own.
    pub(crate) sets: Vec<String>,
    /// The controller's servers; none when the gateway is there first.
    pub(crate) servers: Vec<(&'static str, SocketAddr)>,
    /// Whether the scenario pulls the cable.
    pub(crate) pulls_cable: bool,
}

impl<'a> Plan<'a> {
    pub(crate) fn new(case: &'a Case, file: PathBuf) -> Self {
        Self { case, file, sets: Vec::new(), servers: Vec::new(), pulls_cable: false }
    }

    /// Overrides a key of the file.
    pub(crate) fn set(mut self, key: &str, value: impl std::fmt::Display) -> Self {
        self.sets.push(format!("{key}={value}"));
        self
    }

    /// The controller that it is to be connected to.
    pub(crate) fn robot(mut self, robot: &Robot) -> Self {
        self.servers = SERVERS.map(|server| (server, robot.address(server))).into();
        self
    }

    /// One of the controller's servers is reached somewhere else.
    pub(crate) fn server_at(mut self, server: &str, address: SocketAddr) -> Self {
        for (name, place) in &mut self.servers {
            if *name == server {
                *place = address;
            }
        }
        self
    }

    /// The controller will be on these ports of this host, later.
    pub(crate) fn set_servers(&mut self, ports: [u16; 4]) {
        let place = |port| SocketAddr::from(([127, 0, 0, 1], port));
        self.servers = SERVERS.into_iter().zip(ports.map(place)).collect();
    }

    /// The scenario will pull the Ethernet cable.
    pub(crate) fn with_cable(self) -> Self {
        Self { pulls_cable: true, ..self }
    }

    /// Starts it.
    #[track_caller]
    pub(crate) fn start(&self) -> Box<dyn Gateway> {
        self.case.environment.start(self)
    }

    /// Starts it with a configuration that cannot be used; what it says.
    #[track_caller]
    pub(crate) fn refused(&self, spoil: Spoil) -> String {
        self.case.environment.refuses(self, spoil)
    }

    /// All overrides, for a controller at `host` whose servers are on these ports.
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

    /// What `host-sim` is given as the file.
    pub(crate) fn file(&self) -> &Path {
        &self.file
    }
}

/// The names of the ports with such a bus, in file order.
pub(crate) fn ports(config: &GatewayConfig, bus: impl Fn(&Bus) -> bool) -> Vec<String> {
    config.ports.iter().filter(|port| bus(&port.bus)).map(|port| port.name.as_str().to_owned()).collect()
}
