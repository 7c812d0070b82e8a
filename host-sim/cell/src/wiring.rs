//! Assigns a line, bus or link to each port of the two configurations.

use proto_core::config::Bus;
use proto_core::engine::{LinkId, PortId};

use super::can::CanBus;
use super::line::Line;
use super::network::Gate;
use super::tcp_device::TcpDevice;
use super::{AnyPort, BusId, Cell, Client, LineId, Medium};
use recipe_config::{SimBus, SimConfig};

impl Cell {
    pub(super) fn wire_gateway(&mut self) {
        let links: Vec<_> = self.engine.links().map(|link| (link.id, link.kind)).collect();
        for (id, kind) in links {
            self.gates.insert(id, Gate::new(id, kind, self.rng.fork()));
        }
        let ports = self.gateway.ports.clone();
        for (nth, port) in (0..).zip(&ports) {
            let owner = AnyPort::Gateway(PortId(nth));
            let far = match port.bus {
                Bus::Rs485(settings) => Medium::Line(self.add_line(owner, settings)),
                Bus::Can { bitrate } => Medium::Bus(self.add_bus(owner, bitrate)),
                Bus::ModbusTcp { .. } => {
                    self.servers.insert(LinkId::of_port(PortId(nth)), TcpDevice::default());
                    continue;
                }
                Bus::TcpListen { .. } | Bus::UdpListen { .. } => continue,
            };
            self.names.insert(port.name.as_str().to_owned(), far);
        }
    }

    pub(super) fn wire_controller(&mut self, config: &SimConfig) {
        for (nth, port) in config.ports.iter().enumerate() {
            let owner = AnyPort::Controller(nth);
            let far = match &port.bus {
                SimBus::Rs485(settings) => Medium::Line(self.add_line(owner, *settings)),
                SimBus::Can { bitrate } => Medium::Bus(self.add_bus(owner, *bitrate)),
                SimBus::UdpServer => continue,
                SimBus::TcpClient { to } => {
                    let link = self.listener(to, true);
                    self.clients.insert(nth, Client { link, is_tcp: true, conn: None, socket: 0 });
                    continue;
                }
                SimBus::UdpClient { to } => {
                    let link = self.listener(to, false);
                    self.clients.insert(nth, Client { link, is_tcp: false, conn: None, socket: 0 });
                    continue;
                }
            };
            self.controller_names.insert(port.name.clone(), far);
        }
    }

    fn add_line(&mut self, owner: AnyPort, settings: proto_core::config::Rs485) -> LineId {
        self.lines.push(Line::new(owner, settings, self.rng.fork()));
        LineId(self.lines.len() - 1)
    }

    fn add_bus(&mut self, owner: AnyPort, bitrate: u32) -> BusId {
        self.buses.push(CanBus::new(owner, bitrate, self.rng.fork()));
        BusId(self.buses.len() - 1)
    }

    /// The gateway's link that listens on the port number of the address `to`.
    fn listener(&self, to: &str, tcp: bool) -> Option<LinkId> {
        let wanted = to.rsplit(':').next()?;
        let nth = self.gateway.ports.iter().position(|port| match &port.bus {
            Bus::TcpListen { listen } if tcp => listen.rsplit(':').next() == Some(wanted),
            Bus::UdpListen { listen } if !tcp => listen.rsplit(':').next() == Some(wanted),
            _ => false,
        })?;
        Some(LinkId::of_port(PortId(nth as u8)))
    }
}
