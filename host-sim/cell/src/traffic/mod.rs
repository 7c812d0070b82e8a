//! Bytes and datagrams between the gateway and the controller: how they are sent and how they arrive.

mod acks;
mod connect;

use std::net::SocketAddr;

use proto_core::engine::{Input, LinkId, LinkKind};

use super::connection::Peer;
use super::due::Due;
use super::network::{Item, Sender, Way};
use super::oracle::inputs_of;
use super::tcp::{Arrived, USER_TIMEOUT};
use super::{AnyPort, Cell, End, What, udp_peer};
use recipe_controller::{ConnId, ControllerInput, Link};

impl Cell {
    pub(crate) fn send_item(&mut self, id: u64, way: Way, item: Item) {
        let now = self.now;
        let Some(conn) = self.conns.get_mut(&id) else { return };
        let Some(gate) = self.gates.get_mut(&conn.link) else { return };
        let acks = match way {
            Way::Up => 0,
            Way::Down => {
                conn.owes_ack = false;
                conn.up.arrived
            }
        };
        let waited = conn.pipe(way).retransmit_at;
        let queue = &mut self.queue;
        let arrives = |at| queue.push(at, Due::Arrival { conn: id, way });
        conn.pipe(way).send(now, item, acks, gate, way, arrives);
        if waited.is_none()
            && let Some(at) = conn.pipe(way).retransmit_at
        {
            self.queue.push(at, Due::Retransmit { conn: id, way });
        }
        let is_too_much = way == Way::Down && !conn.down.dead && conn.down.on_the_way() > CONTROLLER_BUFFER;
        if is_too_much {
            self.reset_conn(id);
        }
    }

    /// The gateway sends on a link.
    pub(crate) fn send_up(&mut self, link: LinkId, bytes: Vec<u8>) {
        let now = self.now;
        let Some(gate) = self.gates.get_mut(&link) else { return };
        let generation = gate.generation;
        match gate.kind {
            LinkKind::RecipeUdp => {
                let slowest = gate.network.slowest();
                let oracle = self.oracle.as_mut();
                let tag = oracle.map_or(0, |oracle| oracle.sent_datagram(link, &bytes, slowest, now));
                let peer = udp_peer(generation);
                for at in gate.datagram_arrivals(now, Way::Up) {
                    self.queue.push(at, Due::DatagramUp { link, peer, tag, bytes: bytes.clone() });
                }
            }
            LinkKind::RecipeUdpListen { .. } => {
                let (slowest, answers_to) = (gate.network.slowest(), gate.answers_to);
                let mut tag = 0;
                if let Some(oracle) = &mut self.oracle {
                    oracle.answers(link, answers_to, now);
                    tag = oracle.sent_datagram(link, &bytes, slowest, now);
                }
                let client = self.clients.iter().find(|(_, client)| client.link == Some(link));
                let arrivals = gate.datagram_arrivals(now, Way::Up);
                // A datagram to another sender or to a closed socket is lost.
                if let Some((&port, client)) = client
                    && answers_to == Some(Sender::Client { socket: client.socket })
                {
                    for at in arrivals {
                        self.queue.push(at, Due::ClientDatagramUp { port, tag, bytes: bytes.clone() });
                    }
                }
            }
            _ => {
                let Some(id) = gate.conn else { return };
                let slowest = gate.network.slowest();
                if let Some(oracle) = &mut self.oracle {
                    oracle.sent(id, link, &bytes, slowest, now);
                }
                self.send_item(id, Way::Up, Item::Bytes(bytes));
                let Some(conn) = self.conns.get_mut(&id) else { return };
                let unacked = conn.up.unacked();
                if !std::mem::replace(&mut conn.is_watched, true) {
                    self.queue.push(now + USER_TIMEOUT, Due::UserTimeout { conn: id });
                }
                let gate = self.gate(link);
                if unacked > gate.network.send_buffer {
                    gate.is_full = true;
                    return;
                }
            }
        }
        self.queue.push(now, Due::LinkSent { link, generation });
    }

    /// The controller's UDP server sends.
    pub(crate) fn udp_down(&mut self, peer: SocketAddr, bytes: &[u8]) {
        let (now, link) = (self.now, LinkId::RECIPE_UDP);
        let Some(gate) = self.gates.get_mut(&link) else { return };
        for at in gate.datagram_arrivals(now, Way::Down) {
            self.queue.push(at, Due::DatagramDown { link, peer, bytes: bytes.to_vec() });
        }
    }

    pub(crate) fn controller_port_sends(&mut self, port: usize, bytes: Vec<u8>) {
        if let Some(line) = self.line_at(AnyPort::Controller(port)) {
            self.transmit(line, End::Port, &bytes);
            return;
        }
        let now = self.now;
        let Some(client) = self.clients.get(&port) else { return };
        match (client.is_tcp, client.conn, client.link) {
            (true, Some(conn), _) => self.send_item(conn, Way::Down, Item::Bytes(bytes)),
            (false, _, Some(link)) => {
                let from = Sender::Client { socket: client.socket };
                for at in self.gate(link).datagram_arrivals(now, Way::Down) {
                    self.queue.push(at, Due::ClientDatagramDown { link, from, bytes: bytes.clone() });
                }
            }
            _ => {}
        }
        self.controller_input_later(port);
    }

    /// Network ports of the controller send without delay.
    fn controller_input_later(&mut self, port: usize) {
        self.controller.handle(self.now, ControllerInput::PortSent { port });
        self.controller_is_seen = false;
    }

    /// Handles what has arrived at one end of a connection.
    pub(crate) fn arrive(&mut self, id: u64, way: Way) {
        let now = self.now;
        let is_asleep = self.is_asleep();
        let Some(conn) = self.conns.get_mut(&id) else { return };
        let (link, peer) = (conn.link, conn.peer);
        let Some(gate) = self.gates.get_mut(&link) else { return };
        if gate.is_cut(way) {
            if let Some(at) = conn.pipe(way).lose(now) {
                self.queue.push(at, Due::Retransmit { conn: id, way });
            }
            return;
        }
        if way == Way::Down && is_asleep && !conn.abandoned {
            // The item waits in the gateway's socket.
            return;
        }
        let (arrived, acks) = conn.pipe(way).next_arrived(now);
        if arrived == Arrived::Nothing {
            return;
        }
        match way {
            Way::Up if conn.forgotten => {
                let back = now + gate.network.delay;
                self.queue.push(back, Due::ResetDown { conn: id });
                return;
            }
            Way::Up => {}
            Way::Down if conn.abandoned => {
                let back = now + gate.network.delay;
                self.queue.push(back, Due::ResetUp { conn: id });
                return;
            }
            Way::Down => {
                conn.down.acknowledge(now, conn.down.arrived);
                self.acknowledged(id, acks);
                self.report_acked(link);
            }
        }
        match (arrived, way) {
            (Arrived::Nothing, _) => {}
            (Arrived::Reset(bytes), way) => {
                match way {
                    Way::Up => self.controller_bytes(id, link, peer, &bytes),
                    Way::Down => self.engine_input(Input::LinkBytes { link, bytes: &bytes }),
                }
                self.device_link_changed(link);
                self.reset_conn(id);
                return;
            }
            (Arrived::Item(Item::Bytes(bytes)), Way::Up) => {
                self.owe_ack(id);
                self.controller_bytes(id, link, peer, &bytes);
            }
            (Arrived::Item(Item::Opened), Way::Up) => self.controller_opened(id, peer),
            // Cannot happen: the gateway always resets its end instead of closing it.
            (Arrived::Item(Item::Closed), Way::Up) => {}
            (Arrived::Item(Item::Bytes(bytes)), Way::Down) => {
                self.report_acts(id);
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
                self.gateway_hears_end(id);
                self.gate(link).set_open(false);
                self.engine_input(Input::LinkDown { link });
            }
        }
        // More may have arrived at the same time.
        self.arrive(id, way);
    }

    fn controller_bytes(&mut self, id: u64, link: LinkId, peer: Peer, bytes: &[u8]) {
        let conn = ConnId(id);
        self.trace.add(self.now, What::ControllerReceived, id, bytes);
        if peer == Peer::Device {
            return self.device_receives(id, bytes);
        }
        if let (Some(judge), Peer::Server(Link::Modbus)) = (&mut self.judge, peer) {
            judge.asked(id, bytes, self.now);
        }
        let before = self.inputs_before();
        self.controller_input(match peer {
            Peer::Server(Link::Command) => ControllerInput::CommandBytes { conn, bytes },
            Peer::Server(Link::Modbus) => ControllerInput::ModbusBytes { conn, bytes },
            // Port 2001 ignores what clients send.
            Peer::Server(Link::State) => return,
            Peer::Client(port) => ControllerInput::PortBytes { port, bytes },
            Peer::Device => return,
        });
        let slowest = self.gate(link).network.slowest();
        if let (Some(oracle), Some(before)) = (&mut self.oracle, before) {
            let after = inputs_of(self.controller.registers().image());
            oracle.arrived(id, link, bytes, (&before, after), slowest, self.now);
        }
    }
}

/// Bytes that the controller buffers for one connection. With more it resets the connection.
const CONTROLLER_BUFFER: u64 = 256 * 1024;
