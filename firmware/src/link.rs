//! One link to the controller: opened, closed and fed as the engine says.
//!
//! A link is one task. It owns its socket, hands what arrives to the engine and sends what is in its
//! outbox; it knows no protocol and makes no decision. Supervision is the engine's: a link that fails
//! says so once and waits to be opened again.

use core::cell::Cell;
use core::net::Ipv4Addr;
use core::pin::pin;

use embassy_futures::select::{Either, select};
use embassy_net::dns::DnsQueryType;
use embassy_net::tcp::{TcpReader, TcpSocket, TcpWriter};
use embassy_net::udp::{PacketMetadata, UdpSocket};
use embassy_net::{IpAddress, IpEndpoint, Stack};
use embassy_time::{Duration, with_timeout};
use heapless::String;
use proto_core::config::{Bus, GatewayConfig, listen_address};
use proto_core::engine::{Input, LinkId, LinkKind};

use crate::gateway::{Gateway, LinkControl};
use crate::watchdog::Pulse;

/// What a link connects to.
#[derive(Debug, Clone)]
pub enum Endpoint {
    /// The controller's TCP server.
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
    /// Where the controller's TCP client connects to. Nobody else does.
    TcpListen {
        /// TCP port.
        port: u16,
        /// The controller's address or name.
        host: String<64>,
    },
    /// Where the controller's UDP client sends to. Nobody else does.
    UdpListen {
        /// UDP port.
        port: u16,
        /// The controller's address or name.
        host: String<64>,
    },
}

impl Endpoint {
    /// Where a link of the configuration goes. A board has one address, so of `listen` only the port
    /// counts.
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
        }
    }
}

/// A link's socket buffers.
#[derive(Debug)]
pub struct Buffers<'a> {
    rx: &'a mut [u8],
    tx: &'a mut [u8],
    chunk: &'a mut [u8],
}

impl<'a> Buffers<'a> {
    /// Bytes that a link needs.
    pub const SIZE: usize = RX + TX + CHUNK;

    /// Takes [`Buffers::SIZE`] bytes from the front of `memory`; `None` when there are fewer.
    pub fn take(memory: &mut &'a mut [u8]) -> Option<Self> {
        Some(Self {
            rx: memory.split_off_mut(..RX)?,
            tx: memory.split_off_mut(..TX)?,
            chunk: memory.split_off_mut(..CHUNK)?,
        })
    }
}

/// Drives the link for ever.
pub async fn run(
    gateway: &Gateway,
    pulse: &Pulse,
    link: LinkId,
    stack: Stack<'_>,
    endpoint: &Endpoint,
    mut buffers: Buffers<'_>,
) -> ! {
    let buffers = &mut buffers;
    let Some(control) = gateway.link(link) else { core::future::pending().await };
    let driver = Driver { gateway, pulse, link, control, stack };
    loop {
        let turn = pulse.idle(pin!(control.opened())).await;
        match endpoint {
            Endpoint::Tcp { host, port } => driver.tcp(turn, host, Way::To(*port), buffers).await,
            Endpoint::TcpListen { port, host } => driver.tcp(turn, host, Way::At(*port), buffers).await,
            Endpoint::Udp { host, port } => driver.udp(turn, host, Way::To(*port), buffers).await,
            Endpoint::UdpListen { port, host } => driver.udp(turn, host, Way::At(*port), buffers).await,
        }
        // A turn that is over was ended by the engine: it expects no report.
        if control.is_turn(turn) {
            control.close();
            gateway.input(Input::LinkDown { link });
        }
    }
}

/// Who begins.
#[derive(Clone, Copy)]
enum Way {
    /// We do, to this port of the controller.
    To(u16),
    /// The controller does, at this port of ours.
    At(u16),
}

struct Driver<'a> {
    gateway: &'a Gateway,
    pulse: &'a Pulse,
    link: LinkId,
    control: &'a LinkControl,
    stack: Stack<'a>,
}

impl Driver<'_> {
    fn up(&self) {
        self.gateway.input(Input::LinkUp { link: self.link });
    }

    fn bytes(&self, bytes: &[u8]) {
        self.gateway.input(Input::LinkBytes { link: self.link, bytes });
    }

    /// One connection, until the peer closes it, an error, or the turn is over.
    async fn tcp(&self, turn: u32, controller: &str, way: Way, buffers: &mut Buffers<'_>) {
        let mut socket = TcpSocket::new(self.stack, buffers.rx, buffers.tx);
        socket.set_nagle_enabled(false);
        let opening = async {
            let Some(address) = resolve(self.stack, controller).await else { return false };
            match way {
                Way::To(port) => socket.connect(IpEndpoint::new(address, port)).await.is_ok(),
                Way::At(port) => self.accept(&mut socket, port, address).await,
            }
        };
        let opened = self.pulse.idle(pin!(select(opening, self.control.over(turn)))).await;
        if let Either::First(true) = opened {
            self.up();
            let (reader, writer) = socket.split();
            let (reading, writing) = (self.read(turn, reader, buffers.chunk), self.write(turn, writer));
            self.pulse.idle(pin!(select(reading, writing))).await;
            // What the engine has given up must not be delivered later, after newer values.
            if self.control.is_turn(turn) {
                socket.close();
                let _ = with_timeout(FAREWELL, socket.flush()).await;
            }
        }
        // The peer must not go on believing in a connection whose socket is gone.
        socket.abort();
        let _ = with_timeout(FAREWELL, socket.flush()).await;
    }

    /// Waits for a connection of the controller. All others are turned away: what comes here is believed.
    async fn accept(&self, socket: &mut TcpSocket<'_>, port: u16, controller: IpAddress) -> bool {
        loop {
            // Who begins a connection and never completes it must not keep the only socket.
            socket.set_keep_alive(None);
            socket.set_timeout(Some(HANDSHAKE));
            if socket.accept(port).await.is_err() {
                return false;
            }
            match socket.remote_endpoint() {
                Some(peer) if peer.addr == controller && socket.may_send() => {
                    // A controller that was switched off has to find the socket free.
                    socket.set_keep_alive(Some(PROBE));
                    socket.set_timeout(Some(VANISHED));
                    return true;
                }
                Some(peer) if peer.addr != controller => self.control.turn_away(),
                _ => {}
            }
            socket.abort();
            let _ = with_timeout(FAREWELL, socket.flush()).await;
        }
    }

    async fn read(&self, turn: u32, mut reader: TcpReader<'_>, chunk: &mut [u8]) {
        while let Ok(len) = reader.read(chunk).await
            && let Some(bytes @ [_, ..]) = chunk.get(..len)
            && self.control.is_turn(turn)
        {
            self.bytes(bytes);
        }
    }

    async fn write(&self, turn: u32, mut writer: TcpWriter<'_>) {
        while let Some(transmission) = self.control.next(turn).await {
            let mut rest = transmission.as_slice();
            while !rest.is_empty() {
                match writer.write(rest).await {
                    Ok(len) if len > 0 => rest = rest.get(len..).unwrap_or(&[]),
                    _ => return,
                }
            }
            if self.control.is_turn(turn) {
                self.gateway.input(Input::LinkSent { link: self.link });
            }
        }
    }

    /// Datagrams both ways; of a listening socket, answers where the controller sent from last.
    async fn udp(&self, turn: u32, controller: &str, way: Way, buffers: &mut Buffers<'_>) {
        let mut received = [PacketMetadata::EMPTY; DATAGRAMS];
        let mut waiting = [PacketMetadata::EMPTY; DATAGRAMS];
        let mut socket = UdpSocket::new(self.stack, &mut received, buffers.rx, &mut waiting, buffers.tx);
        let own = match way {
            Way::To(_) => 0,
            Way::At(port) => port,
        };
        if socket.bind(own).is_err() {
            return;
        }
        let resolving = select(resolve(self.stack, controller), self.control.over(turn));
        let Either::First(Some(address)) = self.pulse.idle(pin!(resolving)).await else { return };
        let fixed = match way {
            Way::To(port) => Some(IpEndpoint::new(address, port)),
            Way::At(_) => None,
        };
        let peer = Cell::new(fixed);
        if fixed.is_some() {
            self.up();
        }
        let reading = async {
            loop {
                // A datagram that is too long for any frame is none of ours.
                let Ok((len, from)) = socket.recv_from(buffers.chunk).await else { continue };
                if !self.control.is_turn(turn) {
                    return;
                }
                match fixed {
                    Some(fixed) if from.endpoint != fixed => continue,
                    Some(_) => {}
                    None if from.endpoint.addr != address => {
                        self.control.turn_away();
                        continue;
                    }
                    None if peer.replace(Some(from.endpoint)).is_none() => self.up(),
                    None => {}
                }
                self.bytes(buffers.chunk.get(..len).unwrap_or(&[]));
            }
        };
        let writing = async {
            while let Some(datagram) = self.control.next(turn).await {
                if let Some(peer) = peer.get()
                    && socket.send_to(&datagram, peer).await.is_err()
                {
                    return;
                }
                if self.control.is_turn(turn) {
                    self.gateway.input(Input::LinkSent { link: self.link });
                }
            }
        };
        self.pulse.idle(pin!(select(reading, writing))).await;
    }
}

async fn resolve(stack: Stack<'_>, host: &str) -> Option<IpAddress> {
    if let Ok(address) = host.parse::<Ipv4Addr>() {
        return Some(IpAddress::Ipv4(address));
    }
    let addresses = stack.dns_query(host, DnsQueryType::A).await.ok()?;
    addresses.first().copied()
}

/// A state packet, and a receive window that a burst cannot overrun the Ethernet controller with.
const RX: usize = 1536;
/// The longest frame or request, and another.
const TX: usize = 1024;
/// Bytes handed to the engine at once: a state packet, and longer than any frame, so that a datagram
/// that is too long is seen to be.
const CHUNK: usize = 1536;
/// Datagrams that wait, each way.
const DATAGRAMS: usize = 8;
/// How long a connection may take to come about at a listening socket.
const HANDSHAKE: Duration = Duration::from_secs(2);
/// Between two questions whether the controller's client is still there.
const PROBE: Duration = Duration::from_secs(5);
/// How long it may leave them without an answer.
const VANISHED: Duration = Duration::from_secs(20);
/// How long a closing socket is waited for.
const FAREWELL: Duration = Duration::from_millis(100);

#[cfg(test)]
mod tests;
