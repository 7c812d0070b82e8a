//! The simulated controller at the other end of the cable, in the chip's virtual time, with smoltcp as its
//! network stack.

use std::collections::{HashMap, VecDeque};
use std::net::{IpAddr, SocketAddr};

use proto_core::time::Instant;
use recipe_chip_model::device::{MICRO, Picos};
use recipe_chip_model::models::ethernet::Ethernet;
use recipe_config::SimConfig;
use recipe_controller::{ConnId, Controller, ControllerCounters, ControllerInput, ControllerOutput};
use smoltcp::iface::{Config, Interface, SocketHandle, SocketSet};
use smoltcp::phy::{Device, DeviceCapabilities, Medium, RxToken, TxToken};
use smoltcp::socket::{tcp, udp};
use smoltcp::wire::{EthernetAddress, IpCidr, IpEndpoint, Ipv4Address};

pub(crate) struct Robot {
    cable: Cable,
    interface: Interface,
    sockets: SocketSet<'static>,
    servers: Vec<Server>,
    datagrams: SocketHandle,
    controller: Controller,
    connections: HashMap<ConnId, usize>,
    unsent: HashMap<ConnId, VecDeque<u8>>,
    numbers: u64,
    /// Of connections to the board.
    next_port: u16,
    wake: Instant,
    /// Frames from the board.
    pub(crate) frames: Vec<(Picos, Vec<u8>)>,
}

/// A socket for one connection to a port.
struct Server {
    port: u16,
    socket: SocketHandle,
    conn: Option<ConnId>,
}

/// 192.168.12.10/24.
pub(crate) const ADDRESS: Ipv4Address = Ipv4Address::new(192, 168, 12, 10);
const COMMAND: u16 = 2000;
const STATE: u16 = 2001;
const MODBUS: u16 = 502;
const RECIPE: u16 = 2011;

#[derive(Default)]
struct Cable {
    to_robot: VecDeque<Vec<u8>>,
    to_board: VecDeque<Vec<u8>>,
}

impl Robot {
    pub(crate) fn new(config: &SimConfig) -> Self {
        let mut cable = Cable::default();
        let own = Config::new(EthernetAddress([2, 0, 0, 0, 0, 1]).into());
        let mut interface = Interface::new(own, &mut cable, smoltcp::time::Instant::ZERO);
        interface.update_ip_addrs(|addresses| {
            addresses.push(IpCidr::new(ADDRESS.into(), 24)).expect("room for one");
        });
        let mut sockets = SocketSet::new(Vec::new());
        let servers = [COMMAND, STATE, STATE, MODBUS, MODBUS]
            .map(|port| {
                let buffer = || tcp::SocketBuffer::new(vec![0; 8192]);
                let mut socket = tcp::Socket::new(buffer(), buffer());
                socket.set_nagle_enabled(false);
                Server { port, socket: sockets.add(socket), conn: None }
            })
            .into();
        let buffer = || udp::PacketBuffer::new(vec![udp::PacketMetadata::EMPTY; 16], vec![0; 8192]);
        let mut socket = udp::Socket::new(buffer(), buffer());
        socket.bind(RECIPE).expect("a port");
        Self {
            cable,
            interface,
            datagrams: sockets.add(socket),
            sockets,
            servers,
            controller: Controller::new(config).expect("a right configuration"),
            connections: HashMap::new(),
            unsent: HashMap::new(),
            numbers: 0,
            next_port: 5_001,
            wake: Instant::ZERO,
            frames: Vec::new(),
        }
    }

    /// Opens a connection to the board. `size` bytes are buffered for reading.
    pub(crate) fn connect(&mut self, to: IpEndpoint, size: usize) -> SocketHandle {
        let buffer = |len| tcp::SocketBuffer::new(vec![0; len]);
        let mut socket = tcp::Socket::new(buffer(size), buffer(8192));
        socket.connect(self.interface.context(), to, self.next_port).expect("it is new");
        self.next_port += 1;
        self.sockets.add(socket)
    }

    /// Adds a socket for another listener.
    pub(crate) fn add_server(&mut self) -> SocketHandle {
        let buffer = || tcp::SocketBuffer::new(vec![0; 2048]);
        self.sockets.add(tcp::Socket::new(buffer(), buffer()))
    }

    /// Adds a socket for datagrams to this port.
    pub(crate) fn add_datagrams(&mut self, port: u16) -> SocketHandle {
        let buffer = || udp::PacketBuffer::new(vec![udp::PacketMetadata::EMPTY; 4], vec![0; 1024]);
        let mut socket = udp::Socket::new(buffer(), buffer());
        socket.bind(port).expect("a port");
        self.sockets.add(socket)
    }

    /// A socket of [`Self::add_datagrams`].
    pub(crate) fn udp(&mut self, handle: SocketHandle) -> &mut udp::Socket<'static> {
        self.sockets.get_mut(handle)
    }

    /// Drops a connection that has ended.
    pub(crate) fn forget(&mut self, handle: SocketHandle) {
        self.sockets.remove(handle);
    }

    /// A connection that was opened from here.
    pub(crate) fn connection(&mut self, handle: SocketHandle) -> &mut tcp::Socket<'static> {
        self.sockets.get_mut(handle)
    }

    pub(crate) fn controller(&self) -> &Controller {
        &self.controller
    }

    pub(crate) fn counters(&self) -> ControllerCounters {
        self.controller.counters()
    }

    /// Moves frames both ways, and lets the controller do what is due.
    pub(crate) fn exchange(&mut self, now: Picos, board: &mut Ethernet) {
        let time = Instant::from_micros(now / MICRO);
        let has_frames = !board.sent.is_empty();
        while let Some(frame) = board.sent.pop_front() {
            self.frames.push((now, frame.clone()));
            self.cable.to_robot.push_back(frame);
        }
        let stamp = smoltcp::time::Instant::from_micros((now / MICRO) as i64);
        let is_due = self.interface.poll_at(stamp, &self.sockets).is_some_and(|at| at <= stamp);
        if !has_frames && !is_due && time < self.wake {
            return;
        }
        self.interface.poll(stamp, &mut self.cable, &mut self.sockets);
        self.take(time);
        self.controller.handle(time, ControllerInput::Tick);
        self.drain(time);
        self.push();
        self.interface.poll(stamp, &mut self.cable, &mut self.sockets);
        for frame in self.cable.to_board.drain(..) {
            board.receive(&frame);
        }
    }

    /// Handles received data.
    fn take(&mut self, now: Instant) {
        for index in 0..self.servers.len() {
            let Server { port, socket, conn } = self.servers[index];
            let socket = self.sockets.get_mut::<tcp::Socket<'_>>(socket);
            if !socket.is_open() {
                socket.listen(port).expect("it is closed");
            }
            let from = socket.remote_endpoint().map(|endpoint| IpAddr::from(endpoint.addr));
            let conn = match (conn, from) {
                (None, Some(from)) if socket.may_recv() => {
                    self.numbers += 1;
                    let conn = ConnId(self.numbers);
                    self.servers[index].conn = Some(conn);
                    self.connections.insert(conn, index);
                    let input = match port {
                        COMMAND => ControllerInput::CommandOpened { conn, from },
                        STATE => ControllerInput::StateOpened { conn, from },
                        _ => ControllerInput::ModbusOpened { conn, from },
                    };
                    self.controller.handle(now, input);
                    conn
                }
                (Some(conn), _) => conn,
                _ => continue,
            };
            let mut bytes = [0; 2048];
            while let Ok(len @ 1..) = socket.recv_slice(&mut bytes) {
                let bytes = &bytes[..len];
                match port {
                    COMMAND => self.controller.handle(now, ControllerInput::CommandBytes { conn, bytes }),
                    MODBUS => self.controller.handle(now, ControllerInput::ModbusBytes { conn, bytes }),
                    _ => {}
                }
            }
            if !socket.may_recv() {
                self.servers[index].conn = None;
                self.connections.remove(&conn);
                let input = match port {
                    COMMAND => ControllerInput::CommandClosed { conn },
                    STATE => ControllerInput::StateClosed { conn },
                    _ => ControllerInput::ModbusClosed { conn },
                };
                self.controller.handle(now, input);
                socket.abort();
            }
        }
        let socket = self.sockets.get_mut::<udp::Socket<'_>>(self.datagrams);
        let mut bytes = [0; 2048];
        while let Ok((len, meta)) = socket.recv_slice(&mut bytes) {
            let peer = SocketAddr::new(meta.endpoint.addr.into(), meta.endpoint.port);
            self.controller.handle(now, ControllerInput::Udp2011 { peer, bytes: &bytes[..len] });
        }
    }

    /// Sends the controller's output.
    fn drain(&mut self, now: Instant) {
        loop {
            match self.controller.poll_output(now) {
                ControllerOutput::Sleep { until } => {
                    self.wake = until;
                    return;
                }
                ControllerOutput::Send { conn, bytes } => {
                    self.unsent.entry(conn).or_default().extend(bytes);
                }
                ControllerOutput::StatePacket { bytes } => {
                    let open = self.servers.iter().filter(|server| server.port == STATE);
                    for conn in open.filter_map(|server| server.conn) {
                        self.unsent.entry(conn).or_default().extend(bytes.iter());
                    }
                }
                ControllerOutput::UdpSend { peer, bytes } => {
                    let IpAddr::V4(address) = peer.ip() else { continue };
                    let to = IpEndpoint { addr: address.into(), port: peer.port() };
                    let socket = self.sockets.get_mut::<udp::Socket<'_>>(self.datagrams);
                    let _ = socket.send_slice(&bytes, to);
                }
                ControllerOutput::Close { conn } => {
                    if let Some(index) = self.connections.remove(&conn) {
                        self.sockets.get_mut::<tcp::Socket<'_>>(self.servers[index].socket).close();
                        self.servers[index].conn = None;
                    }
                }
                _ => {}
            }
        }
    }

    fn push(&mut self) {
        for (conn, bytes) in &mut self.unsent {
            let Some(index) = self.connections.get(conn) else {
                bytes.clear();
                continue;
            };
            let socket = self.sockets.get_mut::<tcp::Socket<'_>>(self.servers[*index].socket);
            let sent = socket.send_slice(bytes.make_contiguous()).unwrap_or(0);
            bytes.drain(..sent);
        }
    }
}

impl Device for Cable {
    type RxToken<'a> = Received;
    type TxToken<'a> = Sending<'a>;

    fn receive(&mut self, _: smoltcp::time::Instant) -> Option<(Received, Sending<'_>)> {
        let frame = self.to_robot.pop_front()?;
        Some((Received(frame), Sending(&mut self.to_board)))
    }

    fn transmit(&mut self, _: smoltcp::time::Instant) -> Option<Sending<'_>> {
        Some(Sending(&mut self.to_board))
    }

    fn capabilities(&self) -> DeviceCapabilities {
        let mut capabilities = DeviceCapabilities::default();
        capabilities.medium = Medium::Ethernet;
        capabilities.max_transmission_unit = 1514;
        capabilities
    }
}

struct Received(Vec<u8>);

impl RxToken for Received {
    fn consume<R, F: FnOnce(&[u8]) -> R>(self, take: F) -> R {
        take(&self.0)
    }
}

struct Sending<'a>(&'a mut VecDeque<Vec<u8>>);

impl TxToken for Sending<'_> {
    fn consume<R, F: FnOnce(&mut [u8]) -> R>(self, len: usize, fill: F) -> R {
        let mut frame = vec![0; len];
        let result = fill(&mut frame);
        self.0.push_back(frame);
        result
    }
}
