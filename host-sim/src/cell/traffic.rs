//! What travels between the gateway and the controller: connections come and go, bytes and
//! datagrams arrive.

use std::net::SocketAddr;

use proto_core::engine::{Input, LinkId, LinkKind};

use super::drive::Due;
use super::network::{Arrived, Connection, Door, Item, Peer, Way};
use super::{CLIENT_RETRY, Cell, End, HERE, Owner, What, udp_peer};
use crate::controller::{ConnId, ControllerInput, Link};

impl Cell {
    /// The gateway opens a link.
    pub(super) fn open(&mut self, link: LinkId) {
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
    pub(super) fn close(&mut self, link: LinkId) {
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
    pub(super) fn controller_closes(&mut self, id: u64) {
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
    pub(super) fn send_up(&mut self, link: LinkId, bytes: Vec<u8>) {
        let now = self.now;
        let client = self.clients.iter().find(|(_, client)| client.link == Some(link)).map(|(&port, _)| port);
        if let (Some(oracle), Some(gate)) = (&mut self.oracle, self.gates.get(&link)) {
            match (gate.kind, gate.conn) {
                (LinkKind::RecipeUdp | LinkKind::RecipeUdpListen { .. }, _) => {
                    oracle.sent_datagram(link, &bytes)
                }
                (_, Some(conn)) => oracle.sent(conn, &bytes),
                (_, None) => {}
            }
        }
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
    pub(super) fn udp_down(&mut self, peer: SocketAddr, bytes: &[u8]) {
        let (now, link) = (self.now, LinkId::RECIPE_UDP);
        let Some(gate) = self.gates.get_mut(&link) else { return };
        for at in gate.datagram_arrivals(now) {
            self.queue.push(at, Due::DatagramDown { link, peer, bytes: bytes.to_vec() });
        }
    }

    pub(super) fn controller_port_sends(&mut self, port: usize, bytes: Vec<u8>) {
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
    pub(super) fn client_tries(&mut self, port: usize) {
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
    pub(super) fn arrive(&mut self, id: u64, way: Way) {
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
            Peer::Server(Link::Command) => ControllerInput::CommandOpened { conn, from: HERE },
            Peer::Server(Link::State) => ControllerInput::StateOpened { conn, from: HERE },
            Peer::Server(Link::Modbus) => ControllerInput::ModbusOpened { conn, from: HERE },
            Peer::Client(port) => ControllerInput::PortUp { port },
        });
    }

    pub(super) fn controller_closed(&mut self, id: u64, peer: Peer) {
        let conn = ConnId(id);
        if let Some(oracle) = &mut self.oracle {
            oracle.conn_gone(id);
        }
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
        let before = self.inputs_before();
        self.controller_input(match peer {
            Peer::Server(Link::Command) => ControllerInput::CommandBytes { conn, bytes },
            Peer::Server(Link::Modbus) => ControllerInput::ModbusBytes { conn, bytes },
            // Port 2001 takes nothing.
            Peer::Server(Link::State) => return,
            Peer::Client(port) => ControllerInput::PortBytes { port, bytes },
        });
        let link = match peer {
            Peer::Server(Link::Command) => LinkId::COMMAND,
            Peer::Server(Link::Modbus) => LinkId::MODBUS,
            Peer::Server(Link::State) => LinkId::STATE,
            Peer::Client(port) => match self.clients.get(&port).and_then(|client| client.link) {
                Some(link) => link,
                None => return,
            },
        };
        let after = self.inputs_before();
        if let (Some(oracle), Some(before), Some(after)) = (&mut self.oracle, before, after) {
            oracle.arrived(id, link, bytes, &before, &after, self.now);
        }
    }
}
