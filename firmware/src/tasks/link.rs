//! One link to the controller or a device: opened, closed and fed as the engine requests.
//!
//! A link is one task. It owns its socket, reports received data to the engine and sends what is in its
//! outbox. It knows no protocol and makes no decision: a link that fails reports this once and waits to be
//! opened again.
//!
//! Sent is not delivered. For a TCP link the engine gets two reports: that the socket has accepted everything, and how
//! much the peer has not acknowledged. If the engine gives up a link, its connection is closed whatever the task waits
//! for, and nothing but a reset is sent.

mod tcp;
mod udp;

use core::net::Ipv4Addr;
use core::pin::pin;

use embassy_net::dns::DnsQueryType;
use embassy_net::{IpAddress, Stack};
use heapless::String;
use proto_core::config::{Bus, GatewayConfig, listen_address};
use proto_core::engine::{INPUT_BUFFER, Input, LinkId, LinkKind};

use super::control::LinkControl;
use super::gateway::Gateway;
use super::watchdog::Pulse;

/// The remote end of a link.
#[derive(Debug, Clone)]
pub enum Endpoint {
    /// The TCP server of the controller, or of a device.
    Tcp {
        /// Address or name.
        host: String<64>,
        /// TCP port.
        port: u16,
    },
    /// The controller's UDP server.
    Udp {
        /// Address or name.
        host: String<64>,
        /// UDP port.
        port: u16,
    },
    /// The controller's TCP client; connections of other hosts are refused.
    TcpListen {
        /// TCP port.
        port: u16,
        /// The controller's address or name.
        host: String<64>,
    },
    /// The controller's UDP client; datagrams of other hosts are refused.
    UdpListen {
        /// UDP port.
        port: u16,
        /// The controller's address or name.
        host: String<64>,
    },
}

impl Endpoint {
    /// The remote end of a link. A board has one address, so of `listen` only the port is used.
    pub fn of(config: &GatewayConfig, kind: LinkKind) -> Self {
        let controller = &config.controller;
        let host = controller.address.clone();
        let listen = |port: usize| match config.ports.get(port).map(|port| &port.bus) {
            Some(Bus::TcpListen { listen } | Bus::UdpListen { listen }) => {
                listen_address(listen).map_or(0, |address| address.port())
            }
            _ => 0,
        };
        match kind {
            LinkKind::Command | LinkKind::Urgent => Self::Tcp { host, port: controller.command_port },
            LinkKind::State => Self::Tcp { host, port: controller.state_port },
            LinkKind::Modbus => Self::Tcp { host, port: controller.modbus_port },
            LinkKind::RecipeUdp => {
                Self::Udp { host, port: controller.recipe_link.map_or(0, |link| link.udp_port) }
            }
            LinkKind::RecipeTcpListen { port } => Self::TcpListen { port: listen(usize::from(port.0)), host },
            LinkKind::RecipeUdpListen { port } => Self::UdpListen { port: listen(usize::from(port.0)), host },
            LinkKind::ModbusDevice { port } => {
                match config.ports.get(usize::from(port.0)).map(|port| &port.bus) {
                    Some(Bus::ModbusTcp { host, port }) => Self::Tcp { host: host.clone(), port: *port },
                    _ => unreachable!("another port"),
                }
            }
            other => unreachable!("no such link: {}", other.name()),
        }
    }
}

/// A link's socket buffers.
#[derive(Debug)]
pub struct LinkBuffers<'a> {
    rx: &'a mut [u8],
    tx: &'a mut [u8],
    chunk: &'a mut [u8],
}

impl<'a> LinkBuffers<'a> {
    /// Size in bytes.
    pub const SIZE: usize = 6 * 1024;

    /// Takes [`LinkBuffers::SIZE`] bytes from the front of `memory`; `None` if there are fewer.
    pub fn take(memory: &mut &'a mut [u8], endpoint: &Endpoint) -> Option<Self> {
        let memory = memory.split_off_mut(..Self::SIZE)?;
        let (rx, chunk) = match endpoint {
            Endpoint::TcpListen { .. } => (RX_FRAMES, CHUNK_FRAMES),
            Endpoint::Tcp { .. } | Endpoint::Udp { .. } | Endpoint::UdpListen { .. } => (RX, CHUNK),
        };
        let (rx, rest) = memory.split_at_mut_checked(rx)?;
        let (chunk, tx) = rest.split_at_mut_checked(chunk)?;
        Some(Self { rx, tx, chunk })
    }
}

/// Runs the link forever.
pub async fn run(
    gateway: &Gateway,
    pulse: &Pulse,
    link: LinkId,
    stack: Stack<'_>,
    endpoint: &Endpoint,
    mut buffers: LinkBuffers<'_>,
) -> ! {
    let buffers = &mut buffers;
    let Some(control) = gateway.link(link) else { core::future::pending().await };
    let driver = LinkDriver { gateway, pulse, link, control, stack };
    loop {
        let turn = pulse.idle(pin!(control.opened())).await;
        match endpoint {
            Endpoint::Tcp { host, port } => driver.tcp(turn, host, LinkRole::Client(*port), buffers).await,
            Endpoint::TcpListen { port, host } => {
                driver.tcp(turn, host, LinkRole::Server(*port), buffers).await
            }
            Endpoint::Udp { host, port } => driver.udp(turn, host, LinkRole::Client(*port), buffers).await,
            Endpoint::UdpListen { port, host } => {
                driver.udp(turn, host, LinkRole::Server(*port), buffers).await
            }
        }
        // If the turn is over, the engine has closed the link itself and expects no report.
        if control.is_turn(turn) {
            control.close();
            gateway.input(Input::LinkDown { link });
        }
    }
}

/// Which side connects, and to which port.
#[derive(Clone, Copy)]
enum LinkRole {
    /// The board connects to this port of the controller or device.
    Client(u16),
    /// The controller connects to this port of the board.
    Server(u16),
}

struct LinkDriver<'a> {
    gateway: &'a Gateway,
    pulse: &'a Pulse,
    link: LinkId,
    control: &'a LinkControl,
    stack: Stack<'a>,
}

impl LinkDriver<'_> {
    /// Reports to the engine if the turn is not over; returns whether it goes on.
    fn report(&self, turn: u32, input: Input<'_>) -> bool {
        if self.control.is_turn(turn) {
            self.gateway.input(input);
        }
        self.control.is_turn(turn)
    }
}

/// The address of a host; `None` if it is not found.
pub(super) async fn resolve(stack: Stack<'_>, host: &str) -> Option<IpAddress> {
    if let Ok(address) = host.parse::<Ipv4Addr>() {
        return Some(IpAddress::Ipv4(address));
    }
    let addresses = stack.dns_query(host, DnsQueryType::A).await.ok()?;
    addresses.first().copied()
}

/// Receive buffer: a state packet, but a receive window too small for a burst that overruns the Ethernet controller.
const RX: usize = INPUT_BUFFER;
/// Bytes handed to the engine at once: a state packet, and more than any frame, so that a datagram that is too
/// long is noticed.
const CHUNK: usize = INPUT_BUFFER;
/// Receive buffer of a connection for recipe frames: two of the longest. The rest of the memory is the transmit
/// buffer, so that a controller that acknowledges late does not slow the frames down: 64 frames of 72 bytes, as
/// many as the engine sends, or 70 ms of frames of 256 bytes.
const RX_FRAMES: usize = 1024;
const CHUNK_FRAMES: usize = 512;

#[cfg(test)]
mod tests;
