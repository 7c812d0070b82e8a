//! The cell's run loop: what is due, whom it is for, and what that leads to.

use proto_core::engine::{Input, LinkId, LinkKind, OUTPUT_BUFFER, Output, PortId};
use proto_core::recipe::CanFrame;
use proto_core::recipe::model::CanId;
use proto_core::time::{Duration, Instant};
use std::net::SocketAddr;

use super::line::Chunk;
use super::network::{Arrived, Connection, Door, Item, Peer, Way};
use super::{BusId, CLIENT_RETRY, Cell, End, LineId, Owner, What, udp_peer};
use crate::controller::{ConnId, ControllerInput, ControllerOutput, Link};

/// What is to happen at a later instant.
#[derive(Debug)]
pub(super) enum Due {
    LinkUp {
        link: LinkId,
        turn: u64,
    },
    LinkDown {
        link: LinkId,
        turn: u64,
    },
    LinkSent {
        link: LinkId,
        turn: u64,
    },
    Arrival {
        conn: u64,
        way: Way,
    },
    DatagramUp {
        link: LinkId,
        peer: SocketAddr,
        bytes: Vec<u8>,
    },
    DatagramDown {
        link: LinkId,
        peer: SocketAddr,
        bytes: Vec<u8>,
    },
    ClientDatagramUp {
        port: usize,
        bytes: Vec<u8>,
    },
    ClientDatagramDown {
        link: LinkId,
        bytes: Vec<u8>,
    },
    Unreachable {
        peer: SocketAddr,
    },
    ClientTries {
        port: usize,
    },
    Chunk {
        line: LineId,
        chunk: Chunk,
    },
    CanDone {
        bus: BusId,
    },
    DeviceSends {
        line: LineId,
        bytes: Vec<u8>,
    },
    /// TCP itself gives a dead connection up.
    TimedOut {
        conn: u64,
    },
}

impl Cell {
    /// Lets time go by: the clock jumps from deadline to deadline.
    pub fn run(&mut self, span: Duration) {
        let end = self.now + span;
        let mut turns_at_once = 0_u32;
        loop {
            let next = self.next_deadline();
            if next > end {
                self.now = end;
                return;
            }
            turns_at_once = if next > self.now { 0 } else { turns_at_once + 1 };
            assert!(turns_at_once < MAX_TURNS, "the cell does not come to rest at {:?}", self.now);
            self.now = self.now.max(next);
            self.turn();
        }
    }

    /// Everything that is due now, once.
    fn turn(&mut self) {
        if let Some(due) = self.queue.pop_due(self.now) {
            self.carry_out(due);
            return;
        }
        self.poll_devices();
        if self.engine_wake <= self.now {
            self.engine_input(Input::Tick);
        }
        if self.controller_wake <= self.now {
            self.controller_input(ControllerInput::Tick);
        }
    }

    fn next_deadline(&self) -> Instant {
        let lines = self.lines.iter().filter_map(|line| line.device.as_ref()).map(|device| device.deadline());
        let buses = self.buses.iter().filter_map(|bus| bus.device.as_ref()).map(|device| device.deadline());
        let devices = lines.chain(buses).min().unwrap_or(Instant::NEVER);
        self.queue.next().min(self.engine_wake).min(self.controller_wake).min(devices)
    }

    fn poll_devices(&mut self) {
        for nth in 0..self.lines.len() {
            let now = self.now;
            let device = self.lines[nth].device.as_mut().filter(|device| device.deadline() <= now);
            for bytes in device.map_or_else(Vec::new, |device| device.poll(now)) {
                self.transmit(LineId(nth), End::Device, &bytes);
            }
        }
        for nth in 0..self.buses.len() {
            let now = self.now;
            let device = self.buses[nth].device.as_mut().filter(|device| device.deadline() <= now);
            for frame in device.map_or_else(Vec::new, |device| device.poll(now)) {
                self.transmit_can(BusId(nth), End::Device, frame);
            }
        }
    }

    /// Both are told that their ports are there.
    pub(super) fn switch_on(&mut self) {
        let ports: Vec<_> = self.engine.field_ports().collect();
        for port in ports {
            self.engine_input(Input::PortUp { port });
        }
        self.controller_input(ControllerInput::Tick);
        let mut owned: Vec<usize> = Vec::new();
        let owners = self.lines.iter().map(|line| line.owner).chain(self.buses.iter().map(|bus| bus.owner));
        owned.extend(owners.filter_map(|owner| match owner {
            Owner::Controller(port) => Some(port),
            Owner::Gateway(_) => None,
        }));
        owned.extend(self.clients.iter().filter(|(_, client)| !client.is_tcp).map(|(&port, _)| port));
        for port in owned {
            self.controller_input(ControllerInput::PortUp { port });
        }
        let tcp: Vec<usize> =
            self.clients.iter().filter(|(_, client)| client.is_tcp).map(|(&port, _)| port).collect();
        for port in tcp {
            self.queue.push(self.now, Due::ClientTries { port });
        }
    }

    pub(super) fn engine_input(&mut self, input: Input<'_>) {
        let now = self.now;
        match input {
            Input::LinkUp { link } => self.trace.add(now, What::LinkUp, link.0.into(), &[]),
            Input::LinkDown { link } => self.trace.add(now, What::LinkDown, link.0.into(), &[]),
            Input::LinkBytes { link, bytes } => {
                self.trace.add(now, What::LinkReceived, link.0.into(), bytes);
            }
            Input::PortBytes { port, bytes } => {
                self.trace.add(now, What::PortReceived, port.0.into(), bytes);
            }
            Input::PortCan { port, frame } => {
                self.trace.add(now, What::PortReceived, port.0.into(), &can_bytes(&frame));
            }
            _ => {}
        }
        self.engine.handle(now, input);
        let mut buf = [0; OUTPUT_BUFFER];
        loop {
            match self.engine.poll_output(now, &mut buf) {
                Output::Sleep { until } => {
                    self.engine_wake = until;
                    return;
                }
                Output::PortSend { port, bytes } => {
                    self.trace.add(now, What::PortSent, port.0.into(), bytes);
                    if let Some(line) = self.line_at(Owner::Gateway(port)) {
                        let bytes = bytes.to_vec();
                        self.transmit(line, End::Port, &bytes);
                    }
                }
                Output::PortSendCan { port, frame } => {
                    self.trace.add(now, What::PortSent, port.0.into(), &can_bytes(&frame));
                    if let Some(bus) = self.bus_at(Owner::Gateway(port)) {
                        self.transmit_can(bus, End::Port, frame);
                    }
                }
                Output::LinkOpen { link } => {
                    self.trace.add(now, What::LinkOpen, link.0.into(), &[]);
                    self.open(link);
                }
                Output::LinkClose { link } => {
                    self.trace.add(now, What::LinkClose, link.0.into(), &[]);
                    self.close(link);
                }
                Output::LinkSend { link, bytes } => {
                    self.trace.add(now, What::LinkSent, link.0.into(), bytes);
                    let bytes = bytes.to_vec();
                    self.send_up(link, bytes);
                }
            }
        }
    }

    pub(super) fn controller_input(&mut self, input: ControllerInput<'_>) {
        let now = self.now;
        match input {
            ControllerInput::PortBytes { port, bytes } => {
                self.trace.add(now, What::ControllerPortReceived, port as u64, bytes);
            }
            ControllerInput::PortCan { port, frame } => {
                self.trace.add(now, What::ControllerPortReceived, port as u64, &can_bytes(&frame));
            }
            _ => {}
        }
        self.controller.handle(now, input);
        self.drain_controller();
    }

    fn drain_controller(&mut self) {
        let now = self.now;
        loop {
            match self.controller.poll_output(now) {
                ControllerOutput::Sleep { until } => {
                    self.controller_wake = until;
                    return;
                }
                ControllerOutput::Send { conn, bytes } => {
                    self.send_item(conn.0, Way::Down, Item::Bytes(bytes))
                }
                ControllerOutput::Close { conn } => self.controller_closes(conn.0),
                ControllerOutput::StatePacket { bytes } => {
                    let subscribed = |conn: &Connection| {
                        conn.peer == Peer::Server(Link::State) && conn.accepted && !conn.closing
                    };
                    let conns = self.conns.iter().filter(|(_, conn)| subscribed(conn));
                    let conns: Vec<u64> = conns.map(|(&id, _)| id).collect();
                    for conn in conns {
                        self.send_item(conn, Way::Down, Item::Bytes(bytes.to_vec()));
                    }
                }
                ControllerOutput::UdpSend { peer, bytes } => self.udp_down(peer, &bytes),
                ControllerOutput::PortSend { port, bytes } => {
                    self.trace.add(now, What::ControllerPortSent, port as u64, &bytes);
                    self.controller_port_sends(port, bytes);
                }
                ControllerOutput::PortSendCan { port, frame } => {
                    self.trace.add(now, What::ControllerPortSent, port as u64, &can_bytes(&frame));
                    if let Some(bus) = self.bus_at(Owner::Controller(port)) {
                        self.transmit_can(bus, End::Port, frame);
                    }
                }
                ControllerOutput::PortClose { port } => {
                    if let Some(conn) = self.clients.get(&port).and_then(|client| client.conn) {
                        self.controller_closes(conn);
                        self.client_lost(port);
                    }
                }
                ControllerOutput::Shutdown => {
                    for gate in self.gates.values_mut() {
                        gate.door = Door::Refuses;
                    }
                }
            }
        }
    }

    fn carry_out(&mut self, due: Due) {
        match due {
            Due::LinkUp { link, turn } => {
                if self.is_turn(link, turn) {
                    self.gate(link).is_up = true;
                    self.engine_input(Input::LinkUp { link });
                }
            }
            Due::LinkDown { link, turn } => {
                if self.is_turn(link, turn) {
                    self.gate(link).set_open(false);
                    self.engine_input(Input::LinkDown { link });
                }
            }
            Due::LinkSent { link, turn } => {
                if self.is_turn(link, turn) {
                    self.engine_input(Input::LinkSent { link });
                }
            }
            Due::Arrival { conn, way } => self.arrive(conn, way),
            Due::DatagramUp { link, peer, bytes } => {
                self.trace.add(self.now, What::ControllerReceived, link.0.into(), &bytes);
                self.controller_input(ControllerInput::Udp2011 { peer, bytes: &bytes });
            }
            Due::DatagramDown { link, peer, bytes } => {
                let gate = self.gate(link);
                if gate.is_up && udp_peer(gate.turn) == peer {
                    self.engine_input(Input::LinkBytes { link, bytes: &bytes });
                } else {
                    let back = self.now + self.gate(link).network.delay;
                    self.queue.push(back, Due::Unreachable { peer });
                }
            }
            Due::ClientDatagramUp { port, bytes } => {
                self.controller_input(ControllerInput::PortBytes { port, bytes: &bytes });
            }
            Due::ClientDatagramDown { link, bytes } => {
                let gate = self.gate(link);
                if gate.is_open && !gate.is_up {
                    gate.is_up = true;
                    self.engine_input(Input::LinkUp { link });
                }
                if self.gate(link).is_up {
                    self.engine_input(Input::LinkBytes { link, bytes: &bytes });
                }
            }
            Due::Unreachable { peer } => self.controller_input(ControllerInput::Udp2011Unreachable { peer }),
            Due::ClientTries { port } => self.client_tries(port),
            Due::Chunk { line, chunk } => self.chunk_arrives(line, chunk),
            Due::CanDone { bus } => self.can_done(bus),
            Due::DeviceSends { line, bytes } => self.send(line, &bytes),
            Due::TimedOut { conn } => self.reset_conn(conn),
        }
    }

    fn is_turn(&self, link: LinkId, turn: u64) -> bool {
        self.gates.get(&link).is_some_and(|gate| gate.turn == turn)
    }

    /// The gateway opens a link.
    fn open(&mut self, link: LinkId) {
        let now = self.now;
        let gate = self.gate(link);
        gate.set_open(true);
        let (turn, delay) = (gate.turn, gate.network.delay);
        let server = match gate.kind {
            LinkKind::Command => Link::Command,
            LinkKind::State => Link::State,
            LinkKind::Modbus => Link::Modbus,
            LinkKind::RecipeUdp => {
                self.queue.push(now, Due::LinkUp { link, turn });
                return;
            }
            LinkKind::RecipeTcpListen { .. } | LinkKind::RecipeUdpListen { .. } => return,
        };
        match gate.door {
            Door::Silent => {}
            Door::Refuses => self.queue.push(now + delay + delay, Due::LinkDown { link, turn }),
            Door::Open => {
                let id = self.new_conn(link, Peer::Server(server));
                self.send_item(id, Way::Up, Item::Opened);
            }
        }
    }

    /// The gateway closes a link and wants to hear nothing more of it.
    fn close(&mut self, link: LinkId) {
        let gate = self.gate(link);
        let conn = gate.conn;
        gate.set_open(false);
        if let Some(id) = conn {
            if let Some(conn) = self.conns.get_mut(&id) {
                conn.down.dead = true;
                conn.up.held = false;
                if conn.closing {
                    self.conns.remove(&id);
                }
            }
            self.send_item(id, Way::Up, Item::Closed);
        }
    }

    /// The controller closes its end, after what it has sent.
    fn controller_closes(&mut self, id: u64) {
        self.send_item(id, Way::Down, Item::Closed);
        let Some(conn) = self.conns.get_mut(&id) else { return };
        conn.up.dead = true;
        conn.closing = true;
        // The gateway may have closed its end as well: then nobody is left to be told.
        if self.gates.get(&conn.link).is_none_or(|gate| gate.conn != Some(id)) {
            self.conns.remove(&id);
        }
    }

    fn new_conn(&mut self, link: LinkId, peer: Peer) -> u64 {
        let id = self.next_conn;
        self.next_conn += 1;
        self.conns.insert(id, Connection::new(link, peer));
        self.gate(link).conn = Some(id);
        id
    }

    pub(super) fn send_item(&mut self, id: u64, way: Way, item: Item) {
        let Some(conn) = self.conns.get_mut(&id) else { return };
        let Some(gate) = self.gates.get_mut(&conn.link) else { return };
        for at in conn.pipe(way).send(self.now, item, gate) {
            self.queue.push(at, Due::Arrival { conn: id, way });
        }
    }

    /// The gateway sends on a link.
    fn send_up(&mut self, link: LinkId, bytes: Vec<u8>) {
        let now = self.now;
        let client = self.clients.iter().find(|(_, client)| client.link == Some(link)).map(|(&port, _)| port);
        let gate = self.gate(link);
        let turn = gate.turn;
        match gate.kind {
            LinkKind::RecipeUdp => {
                let peer = udp_peer(turn);
                for at in gate.datagram_arrivals(now) {
                    self.queue.push(at, Due::DatagramUp { link, peer, bytes: bytes.clone() });
                }
            }
            LinkKind::RecipeUdpListen { .. } => {
                let arrivals = gate.datagram_arrivals(now);
                for (at, port) in arrivals.into_iter().zip(client.into_iter().cycle()) {
                    self.queue.push(at, Due::ClientDatagramUp { port, bytes: bytes.clone() });
                }
            }
            _ => {
                if let Some(conn) = gate.conn {
                    self.send_item(conn, Way::Up, Item::Bytes(bytes));
                }
            }
        }
        self.queue.push(now, Due::LinkSent { link, turn });
    }

    /// The controller's UDP server sends.
    fn udp_down(&mut self, peer: SocketAddr, bytes: &[u8]) {
        let (now, link) = (self.now, LinkId::RECIPE_UDP);
        let Some(gate) = self.gates.get_mut(&link) else { return };
        for at in gate.datagram_arrivals(now) {
            self.queue.push(at, Due::DatagramDown { link, peer, bytes: bytes.to_vec() });
        }
    }

    fn controller_port_sends(&mut self, port: usize, bytes: Vec<u8>) {
        if let Some(line) = self.line_at(Owner::Controller(port)) {
            self.transmit(line, End::Port, &bytes);
            return;
        }
        let now = self.now;
        let Some(client) = self.clients.get(&port) else { return };
        match (client.is_tcp, client.conn, client.link) {
            (true, Some(conn), _) => self.send_item(conn, Way::Down, Item::Bytes(bytes)),
            (false, _, Some(link)) => {
                for at in self.gate(link).datagram_arrivals(now) {
                    self.queue.push(at, Due::ClientDatagramDown { link, bytes: bytes.clone() });
                }
            }
            _ => {}
        }
        self.controller_input_later(port);
    }

    /// What was handed over to a network port has left at once.
    fn controller_input_later(&mut self, port: usize) {
        self.controller.handle(self.now, ControllerInput::PortSent { port });
    }

    /// The controller's TCP client connects to the gateway.
    fn client_tries(&mut self, port: usize) {
        let Some(client) = self.clients.get(&port) else { return };
        let (None, Some(link)) = (client.conn, client.link) else { return };
        let gate = self.gate(link);
        if !gate.is_open || gate.conn.is_some() || gate.door != Door::Open {
            self.queue.push(self.now + CLIENT_RETRY, Due::ClientTries { port });
            return;
        }
        let id = self.new_conn(link, Peer::Client(port));
        if let Some(client) = self.clients.get_mut(&port) {
            client.conn = Some(id);
        }
        self.send_item(id, Way::Down, Item::Opened);
    }

    /// The controller's TCP client has lost its connection and tries again later.
    pub(super) fn client_lost(&mut self, port: usize) {
        if let Some(client) = self.clients.get_mut(&port) {
            client.conn = None;
            self.queue.push(self.now + CLIENT_RETRY, Due::ClientTries { port });
        }
    }

    /// Something may have arrived at one end of a connection.
    fn arrive(&mut self, id: u64, way: Way) {
        let Some(conn) = self.conns.get_mut(&id) else { return };
        let (link, peer) = (conn.link, conn.peer);
        match (conn.pipe(way).next_arrived(self.now), way) {
            (Arrived::Nothing, _) => return,
            (Arrived::Reset(bytes), way) => {
                match way {
                    Way::Up => self.controller_bytes(id, peer, &bytes),
                    Way::Down => self.engine_input(Input::LinkBytes { link, bytes: &bytes }),
                }
                self.reset_conn(id);
                return;
            }
            (Arrived::Item(Item::Bytes(bytes)), Way::Up) => self.controller_bytes(id, peer, &bytes),
            (Arrived::Item(Item::Opened), Way::Up) => self.controller_opened(id, peer),
            (Arrived::Item(Item::Closed), Way::Up) => {
                self.conns.remove(&id);
                self.controller_closed(id, peer);
            }
            (Arrived::Item(Item::Bytes(bytes)), Way::Down) => {
                self.engine_input(Input::LinkBytes { link, bytes: &bytes });
            }
            (Arrived::Item(Item::Opened), Way::Down) => {
                self.gate(link).is_up = true;
                self.engine_input(Input::LinkUp { link });
                if let Peer::Client(_) = peer {
                    self.send_item(id, Way::Up, Item::Opened);
                }
            }
            (Arrived::Item(Item::Closed), Way::Down) => {
                self.conns.remove(&id);
                self.gate(link).set_open(false);
                self.engine_input(Input::LinkDown { link });
            }
        }
        // What came with it but is another item.
        self.arrive(id, way);
    }

    fn controller_opened(&mut self, id: u64, peer: Peer) {
        let conn = ConnId(id);
        self.trace.add(self.now, What::ControllerOpened, id, &[]);
        if let Some(conn) = self.conns.get_mut(&id) {
            conn.accepted = true;
        }
        if let Peer::Server(_) = peer {
            self.send_item(id, Way::Down, Item::Opened);
        }
        self.controller_input(match peer {
            Peer::Server(Link::Command) => ControllerInput::CommandOpened { conn },
            Peer::Server(Link::State) => ControllerInput::StateOpened { conn },
            Peer::Server(Link::Modbus) => ControllerInput::ModbusOpened { conn },
            Peer::Client(port) => ControllerInput::PortUp { port },
        });
    }

    pub(super) fn controller_closed(&mut self, id: u64, peer: Peer) {
        let conn = ConnId(id);
        self.trace.add(self.now, What::ControllerClosed, id, &[]);
        if let Peer::Client(port) = peer {
            self.client_lost(port);
        }
        self.controller_input(match peer {
            Peer::Server(Link::Command) => ControllerInput::CommandClosed { conn },
            Peer::Server(Link::State) => ControllerInput::StateClosed { conn },
            Peer::Server(Link::Modbus) => ControllerInput::ModbusClosed { conn },
            Peer::Client(port) => ControllerInput::PortDown { port },
        });
    }

    fn controller_bytes(&mut self, id: u64, peer: Peer, bytes: &[u8]) {
        let conn = ConnId(id);
        self.trace.add(self.now, What::ControllerReceived, id, bytes);
        self.controller_input(match peer {
            Peer::Server(Link::Command) => ControllerInput::CommandBytes { conn, bytes },
            Peer::Server(Link::Modbus) => ControllerInput::ModbusBytes { conn, bytes },
            // Port 2001 takes nothing.
            Peer::Server(Link::State) => return,
            Peer::Client(port) => ControllerInput::PortBytes { port, bytes },
        });
    }

    pub(super) fn transmit(&mut self, line: LineId, from: End, bytes: &[u8]) {
        for (at, chunk) in self.lines[line.0].send(self.now, from, bytes) {
            self.queue.push(at, Due::Chunk { line, chunk });
        }
    }

    fn chunk_arrives(&mut self, id: LineId, mut chunk: Chunk) {
        let now = self.now;
        let line = &mut self.lines[id.0];
        let owner = line.owner;
        let arrives = line.deliver(now, &mut chunk);
        match chunk.from {
            End::Device => match owner {
                _ if !arrives => {}
                Owner::Gateway(port) => self.engine_input(Input::PortBytes { port, bytes: &chunk.bytes }),
                Owner::Controller(port) => {
                    self.controller_input(ControllerInput::PortBytes { port, bytes: &chunk.bytes });
                }
            },
            End::Port => {
                let mut answers = Vec::new();
                if arrives {
                    line.hear(now, &chunk.bytes, chunk.is_first);
                    answers = line.device.as_mut().map_or_else(Vec::new, |d| d.receive(now, &chunk.bytes));
                }
                if chunk.is_last {
                    self.port_sent(owner);
                }
                for answer in answers {
                    self.transmit(id, End::Device, &answer);
                }
            }
        }
    }

    pub(super) fn transmit_can(&mut self, bus: BusId, from: End, frame: CanFrame) {
        if let Some(at) = self.buses[bus.0].send(self.now, from, frame) {
            self.queue.push(at, Due::CanDone { bus });
        }
    }

    fn can_done(&mut self, id: BusId) {
        let now = self.now;
        let bus = &mut self.buses[id.0];
        let owner = bus.owner;
        let Some(crossed) = bus.finish(now) else { return };
        let mut answers = Vec::new();
        match crossed.from {
            End::Device if crossed.arrives => match owner {
                Owner::Gateway(port) => self.engine_input(Input::PortCan { port, frame: crossed.frame }),
                Owner::Controller(port) => {
                    self.controller_input(ControllerInput::PortCan { port, frame: crossed.frame });
                }
            },
            End::Device => {}
            End::Port => {
                if let Some(device) = bus.device.as_mut().filter(|_| crossed.arrives) {
                    answers = device.receive(now, &crossed.frame);
                }
                if crossed.was_last {
                    self.port_sent(owner);
                }
            }
        }
        for frame in answers {
            self.transmit_can(id, End::Device, frame);
        }
        if let Some(at) = self.buses[id.0].arbitrate(now) {
            self.queue.push(at, Due::CanDone { bus: id });
        }
    }

    fn port_sent(&mut self, owner: Owner) {
        match owner {
            Owner::Gateway(port) => self.engine_input(Input::PortSent { port }),
            Owner::Controller(port) => self.controller_input(ControllerInput::PortSent { port }),
        }
    }

    pub(super) fn line_at(&self, owner: Owner) -> Option<LineId> {
        self.lines.iter().position(|line| line.owner == owner).map(LineId)
    }

    pub(super) fn bus_at(&self, owner: Owner) -> Option<BusId> {
        self.buses.iter().position(|bus| bus.owner == owner).map(BusId)
    }

    pub(super) fn port_input(&mut self, owner: Owner, is_up: bool) {
        let engine = |port: PortId| if is_up { Input::PortUp { port } } else { Input::PortDown { port } };
        match owner {
            Owner::Gateway(port) => self.engine_input(engine(port)),
            Owner::Controller(port) if is_up => self.controller_input(ControllerInput::PortUp { port }),
            Owner::Controller(port) => self.controller_input(ControllerInput::PortDown { port }),
        }
    }
}

/// A frame as the trace shows it.
fn can_bytes(frame: &CanFrame) -> Vec<u8> {
    let id = match frame.id() {
        CanId::Standard(id) => u32::from(id),
        CanId::Extended(id) => id | 0x8000_0000,
    };
    id.to_be_bytes().into_iter().chain(frame.data().iter().copied()).collect()
}

/// Far more than one instant can need.
const MAX_TURNS: u32 = 1_000_000;
