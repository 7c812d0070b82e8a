//! One link to the controller or a device: opened, closed and fed as the engine requests.
//!
//! A link is one task. It owns its socket, reports received data to the engine and sends the data in its outbox. It
//! does not know protocols and makes no decisions: if a link fails, its task reports this once and waits for the engine
//! to open the link again.
//!
//! Data that was sent need not have been delivered. For a TCP link the engine gets two reports: that the socket has
//! accepted everything, and how much the peer has not acknowledged. If the engine gives up a link, its connection is
//! closed whatever the task waits for, and only a reset is sent.

mod tcp;
mod udp;

use core::net::Ipv4Addr;
use core::pin::pin;

use embassy_net::dns::DnsQueryType;
use embassy_net::{IpAddress, Stack};
use heapless::String;
use proto_core::command::MAX_COMMAND;
use proto_core::config::{Bus, GatewayConfig, listen_address};
use proto_core::engine::{INPUT_BUFFER, Input, LinkId, LinkKind, OUTPUT_BUFFER};
use proto_core::modbus::adu::MAX_ADU;

use super::control::LinkControl;
use super::gateway::{Gateway, MAX_LINKS, MAX_UPLINKS};
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
    /// The remote end of a link. A board has only one address, so only the port of `listen` is used.
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
}

impl<'a> LinkBuffers<'a> {
    /// Size of the buffers of all links in bytes. Each recipe link may be a TCP connection for frames.
    pub const ALL: usize = MAX_UPLINKS * (RX_FRAMES + TX_FRAMES) + (MAX_LINKS - MAX_UPLINKS) * (RX + TX);

    /// Takes the buffers from the front of `memory`; `None` if it is too short.
    pub fn take(memory: &mut &'a mut [u8], endpoint: &Endpoint) -> Option<Self> {
        let (rx, tx) = match endpoint {
            Endpoint::TcpListen { .. } => (RX_FRAMES, TX_FRAMES),
            Endpoint::Tcp { .. } => (RX, TX),
            Endpoint::Udp { .. } | Endpoint::UdpListen { .. } => (RX, TX_DATAGRAM),
        };
        Some(Self { rx: memory.split_off_mut(..rx)?, tx: memory.split_off_mut(..tx)? })
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

/// Receive buffer: large enough for a state packet. The resulting receive window is too small for a burst that would
/// overrun the Ethernet controller.
const RX: usize = INPUT_BUFFER;
/// Transmit buffer: four of the longest commands or transactions. The engine leaves at most two commands or one
/// transaction unanswered, but one that was given up may still be unacknowledged.
const TX: usize = 4 * 256;
/// One datagram, the longest frame.
const TX_DATAGRAM: usize = OUTPUT_BUFFER;
/// Receive buffer of a connection for recipe frames: two of the longest.
const RX_FRAMES: usize = 1024;
/// Transmit buffer of a connection for recipe frames: 64 frames of 72 bytes, as many as the engine sends, or 70 ms of
/// frames of 256 bytes. So a controller that acknowledges late does not slow down the frames.
const TX_FRAMES: usize = 64 * 72;
const _: () = assert!(TX >= 4 * MAX_COMMAND && TX >= 3 * MAX_ADU);
const _: () = assert!(RX + TX_DATAGRAM <= RX_FRAMES + TX_FRAMES && RX + TX <= RX_FRAMES + TX_FRAMES);

#[cfg(test)]
mod tests;
