//! Where a link goes, kept from the configuration for when it is to be opened.

use heapless::String;
use proto_core::config::{Bus, GatewayConfig, MAX_PORTS, listen_address};
use proto_core::engine::LinkId;

use crate::Transport;

/// Where all links go.
#[derive(Debug)]
pub(crate) struct Endpoints {
    host: String<64>,
    command: u16,
    state: u16,
    modbus: u16,
    recipe: u16,
    listening: [(bool, u16); MAX_PORTS],
}

impl Endpoints {
    pub(crate) const NONE: Self = Self {
        host: String::new(),
        command: 0,
        state: 0,
        modbus: 0,
        recipe: 0,
        listening: [(false, 0); MAX_PORTS],
    };

    pub(crate) fn of(config: &GatewayConfig) -> Self {
        let controller = &config.controller;
        let mut listening = Self::NONE.listening;
        for (place, port) in listening.iter_mut().zip(&config.ports) {
            let (is_tcp, text) = match &port.bus {
                Bus::TcpListen { listen } => (true, listen),
                Bus::UdpListen { listen } => (false, listen),
                _ => continue,
            };
            *place = (is_tcp, listen_address(text).map_or(0, |address| address.port()));
        }
        Self {
            host: controller.address.clone(),
            command: controller.command_port,
            state: controller.state_port,
            modbus: controller.modbus_port,
            recipe: controller.recipe_link.map_or(0, |link| link.udp_port),
            listening,
        }
    }

    /// How a link is opened, at which port, and the controller's address or name.
    pub(crate) fn find(&self, link: LinkId) -> (Transport, u16, &str) {
        let (transport, port) = match link {
            LinkId::COMMAND | LinkId::URGENT => (Transport::Tcp, self.command),
            LinkId::STATE => (Transport::Tcp, self.state),
            LinkId::MODBUS => (Transport::Tcp, self.modbus),
            LinkId::RECIPE_UDP => (Transport::Udp, self.recipe),
            other => {
                let place = other.port().and_then(|port| self.listening.get(usize::from(port.0)));
                let &(is_tcp, port) = place.unwrap_or(&(false, 0));
                (if is_tcp { Transport::TcpListen } else { Transport::UdpListen }, port)
            }
        };
        (transport, port, &self.host)
    }
}
