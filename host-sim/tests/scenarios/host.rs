//! The gateway on this host: `host-sim gateway`, its field ports on pseudoterminals and slcan by TCP.

use std::collections::BTreeMap;
use std::net::{SocketAddr, TcpStream};
use std::sync::Arc;
use std::time::Duration;

use proto_core::config::Bus;
use rustix::fs::{Mode, OFlags};
use rustix::process::Signal;

use super::case::Case;
use super::environment::{Cable, Environment, Gateway, Link, LinkStatus, Plan, PortStatus, ports};
use super::field::{CanClient, LineClient};
use super::namespace::Namespace;
use super::network::Network;
use super::program::HostSim;
use super::refusal::Defect;

/// This host.
pub(crate) struct Host;

impl Environment for Host {
    fn name(&self) -> &'static str {
        "host"
    }

    fn sleeps_noticeably(&self) -> bool {
        true
    }

    fn has_terminals(&self) -> bool {
        true
    }

    #[track_caller]
    fn lay_true_cable(&self, case: &Case) {
        let namespace = Arc::new(Namespace::new(case));
        case.namespace.set(namespace).expect("one for a case");
    }

    #[track_caller]
    fn start(&self, plan: &Plan<'_>) -> Box<dyn Gateway> {
        let namespace = plan.case.namespace.get().cloned();
        let mut network = (plan.pulls_cable && namespace.is_none()).then(Network::default);
        let servers = plan.servers.iter().map(|&(name, address)| match &mut network {
            Some(network) if name == "udp2011" => (name, network.udp(address).port()),
            Some(network) => (name, network.tcp(address).port()),
            None => (name, address.port()),
        });
        let servers: Vec<_> = servers.collect();
        let host_sim = HostSim::start(plan.case, "gateway", plan.file(), &arguments(plan, &servers));
        let place = |name: &str| host_sim.ready["ports"][name].as_str().unwrap().parse().unwrap();
        let mut listens = BTreeMap::new();
        for port in &plan.config().ports {
            let name = port.name.as_str();
            let reached = match (&port.bus, &mut network) {
                (Bus::Rs485(_) | Bus::Can { .. } | Bus::ModbusTcp { .. }, _) => continue,
                (Bus::TcpListen { .. }, Some(network)) => network.tcp(place(name)),
                (Bus::UdpListen { .. }, Some(network)) => network.udp(place(name)),
                (_, None) => place(name),
            };
            listens.insert(name.to_owned(), reached);
        }
        Box::new(HostGateway { host_sim, network, namespace, listens })
    }

    #[track_caller]
    fn refuses(&self, plan: &Plan<'_>, defect: Defect) -> String {
        let all = |plan: &Plan<'_>| arguments(plan, &plan.server_ports());
        let file = plan.case.folder.path().join("spoilt.toml");
        let text = std::fs::read_to_string(plan.file()).unwrap();
        let (text, arguments) = match defect {
            Defect::Damaged => (Some(text.replacen("[[port]]", "[[prot]]", 1)), all(plan)),
            Defect::Cut => (Some(text[..text.rfind('=').unwrap()].to_owned()), all(plan)),
            Defect::Missing => (None, all(plan)),
            // One bind is missing.
            Defect::NoDevice => {
                let mut arguments = all(plan);
                arguments.pop();
                (Some(text), arguments)
            }
        };
        if let Some(text) = text {
            std::fs::write(&file, text).unwrap();
        }
        let mut program = HostSim::spawn(plan.case, "gateway", &file, &arguments);
        let status = program.ended();
        assert_eq!(status.code(), Some(2), "{status}: {}", program.errors());
        let left: Vec<_> = ports(&plan.config(), |bus| matches!(bus, Bus::Rs485(_)))
            .into_iter()
            .map(|port| plan.case.folder.path().join(port))
            .filter(|link| link.symlink_metadata().is_ok())
            .collect();
        assert!(left.is_empty(), "it ended, and {left:?} are there");
        program.errors()
    }
}

/// Arguments of `host-sim gateway` besides the file; devices come last.
fn arguments(plan: &Plan<'_>, servers: &[(&'static str, u16)]) -> Vec<String> {
    let mut arguments = Vec::new();
    for value in plan.overrides("127.0.0.1", servers) {
        arguments.push(format!("--set={value}"));
    }
    let config = plan.config();
    for port in &config.ports {
        let name = port.name.as_str();
        match port.bus {
            Bus::TcpListen { .. } | Bus::UdpListen { .. } => {
                arguments.push(format!("--set=port.{name}.listen=127.0.0.1:0"));
            }
            Bus::Rs485(_) | Bus::Can { .. } | Bus::ModbusTcp { .. } => {}
        }
    }
    for port in &config.ports {
        let name = port.name.as_str();
        let device = match port.bus {
            Bus::Rs485(_) => format!("pty:{}", plan.case.folder.path().join(name).display()),
            Bus::Can { .. } => "slcan-tcp:127.0.0.1:0".to_owned(),
            Bus::ModbusTcp { .. } | Bus::TcpListen { .. } | Bus::UdpListen { .. } => continue,
        };
        arguments.push(format!("--bind={name}={device}"));
    }
    arguments
}

struct HostGateway {
    host_sim: HostSim,
    /// The proxy, if the scenario pulls the cable.
    network: Option<Network>,
    /// The network namespace, if the scenario needs one.
    namespace: Option<Arc<Namespace>>,
    /// Addresses at which the controller reaches listening ports.
    listens: BTreeMap<String, SocketAddr>,
}

impl HostGateway {
    #[track_caller]
    fn place(&self, port: &str) -> &str {
        self.host_sim.ready["ports"][port].as_str().unwrap_or_else(|| panic!("no port {port}"))
    }
}

impl Gateway for HostGateway {
    #[track_caller]
    fn line(&self, port: &str) -> LineClient {
        let flags = OFlags::RDWR | OFlags::NOCTTY;
        let line = rustix::fs::open(self.place(port), flags, Mode::empty()).unwrap();
        LineClient::new(Box::new(std::fs::File::from(line)))
    }

    #[track_caller]
    fn can(&self, port: &str) -> CanClient {
        let stream = TcpStream::connect(self.place(port)).unwrap();
        stream.set_nodelay(true).unwrap();
        CanClient::join(Box::new(stream))
    }

    #[track_caller]
    fn listens(&self, port: &str) -> SocketAddr {
        self.listens[port]
    }

    fn link(&self, link: Link<'_>) -> LinkStatus {
        let name = match link {
            Link::Command => "command",
            Link::Urgent => "urgent",
            Link::State => "state",
            Link::Modbus => "modbus",
            Link::Udp2011 => "udp2011",
            Link::TcpListen(port) | Link::UdpListen(port) => port,
        };
        let stats = &self.host_sim.program.newest()["links"][name];
        LinkStatus { is_up: stats["state"] == "up", connects: stats["connects"].as_u64().unwrap_or(0) as u32 }
    }

    fn port(&self, port: &str) -> PortStatus {
        let stats = &self.host_sim.program.newest()["ports"][port];
        let number = |name: &str| stats[name].as_u64().unwrap_or(0);
        PortStatus {
            frames_in: number("frames_in"),
            bytes_in: number("bytes_in"),
            frames_out: number("frames_out"),
            bytes_out: number("bytes_out"),
            skipped_bytes: number("resync_bytes"),
            skipped_cycles: number("skipped_cycles"),
            lost_bytes: stats["device"]["dropped"].as_u64().unwrap_or(0),
        }
    }

    #[track_caller]
    fn cable(&self, cable: Cable) {
        match &self.namespace {
            Some(namespace) => namespace.set(cable),
            None => self.network.as_ref().expect("Plan::with_cable").set(cable),
        }
    }

    #[track_caller]
    fn freeze(&self) {
        self.host_sim.program.freeze();
    }

    #[track_caller]
    fn thaw(&self) {
        self.host_sim.program.signal(Signal::CONT);
    }

    fn own_address(&self) -> Option<String> {
        None
    }

    fn processor_time(&self) -> Duration {
        self.host_sim.program.processor_time()
    }

    /// Its resident pages.
    #[track_caller]
    fn memory(&self) -> u64 {
        let path = format!("/proc/{}/status", self.host_sim.program.pid().as_raw_pid());
        let status = std::fs::read_to_string(path).unwrap();
        let most = status.lines().find_map(|line| line.strip_prefix("VmHWM:")).unwrap();
        1024 * most.trim().trim_end_matches(" kB").parse::<u64>().unwrap()
    }

    #[track_caller]
    fn must_run(&mut self) {
        self.host_sim.program.must_run();
    }
}

impl Drop for HostGateway {
    fn drop(&mut self) {
        if !std::thread::panicking() {
            self.host_sim.program.must_run();
            self.host_sim.program.interrupt();
            assert!(!self.host_sim.program.errors().contains("panicked"), "the gateway panicked");
        }
    }
}
