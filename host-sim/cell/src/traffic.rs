//! What travels between the gateway and the controller: connections come and go, bytes and
//! datagrams arrive.

use std::net::SocketAddr;

use proto_core::engine::{Input, LinkId, LinkKind};
use proto_core::time::Duration;

use super::connection::{Connection, Peer};
use super::due::Due;
use super::network::{Door, Item, Speaker, Way};
use super::tcp::{Again, Arrived, TCP_TIMEOUT, USER_TIMEOUT};
use super::{CLIENT_RETRY, Cell, End, HERE, Owner, What, udp_peer};
use recipe_controller::{ConnId, ControllerInput, Link};

impl Cell {
    /// The gateway opens a link.
    pub(super) fn open(&mut self, link: LinkId) {
        let gate = self.gate(link);
        gate.set_open(true);
        let turn = gate.turn;
        match gate.kind {
            LinkKind::RecipeUdp => self.queue.push(self.now, Due::LinkUp { link, turn }),
            LinkKind::RecipeTcpListen { .. } | LinkKind::RecipeUdpListen { .. } => {}
            _ => self.knock(link, turn, FIRST_KNOCK),
        }
    }

    /// A connection is asked for; without an answer again, after twice the time.
    pub(super) fn knock(&mut self, link: LinkId, turn: u64, pause: Duration) {
        let now = self.now;
        let gate = self.gate(link);
        if gate.turn != turn || gate.conn.is_some() {
            return;
        }
        let delay = gate.network.delay;
        let server = match gate.kind {
            LinkKind::Command | LinkKind::Urgent => Link::Command,
            LinkKind::State => Link::State,
            _ => Link::Modbus,
        };
        match gate.door {
            Door::Open => {
                let id = self.new_conn(link, Peer::Server(server));
                self.send_item(id, Way::Up, Item::Opened);
            }
            Door::Refuses if !gate.is_cut(Way::Up) && !gate.is_cut(Way::Down) => {
                self.queue.push(now + delay + delay, Due::LinkDown { link, turn });
            }
            Door::Refuses | Door::Silent => {
                let pause_after = pause.saturating_mul(2);
                self.queue.push(now + pause, Due::Knock { link, turn, pause: pause_after });
            }
        }
    }

    /// The gateway closes a link with a reset, and wants to hear nothing more of it: what has not
    /// arrived never does.
    pub(super) fn close(&mut self, link: LinkId) {
        let now = self.now;
        let gate = self.gate(link);
        let conn = gate.conn;
        gate.set_open(false);
        let delay = gate.network.delay;
        let Some(id) = conn else { return };
        let Some(conn) = self.conns.get_mut(&id) else { return };
        conn.up.forget();
        if conn.closing || conn.forgotten {
            self.drop_conn(id);
        } else if !conn.accepted {
            self.never_opened(id);
        } else {
            conn.abandoned = true;
            // On a dead path it does not get far; the other end finds out by itself.
            if !conn.up.dead {
                self.queue.push(now + delay, Due::ResetUp { conn: id });
            }
        }
    }

    /// Nothing is left of a connection.
    pub(super) fn drop_conn(&mut self, id: u64) -> Option<Connection> {
        if let Some(oracle) = &mut self.oracle {
            oracle.conn_gone(id);
        }
        self.conns.remove(&id)
    }

    /// A connection that the controller was never told of.
    fn never_opened(&mut self, id: u64) {
        if let Some(Connection { peer: Peer::Client(port), .. }) = self.drop_conn(id) {
            self.client_lost(port);
        }
    }

    /// The gateway's reset reaches the controller.
    pub(super) fn reset_up(&mut self, id: u64) {
        let Some(conn) = self.conns.get(&id) else { return };
        let (link, peer) = (conn.link, conn.peer);
        if self.gate(link).is_cut(Way::Up) {
            // It learns of it when it sends something, or at last by TCP's own patience.
            self.queue.push(self.now + TCP_TIMEOUT, Due::TimedOut { conn: id });
            return;
        }
        self.drop_conn(id);
        self.controller_closed(id, peer);
    }

    /// The controller's host knows nothing of this connection, and says so.
    pub(super) fn reset_down(&mut self, id: u64) {
        let Some(conn) = self.conns.get(&id) else { return };
        let link = conn.link;
        let gate = self.gate(link);
        if gate.is_cut(Way::Down) {
            return;
        }
        let (turn, is_ours) = (gate.turn, gate.conn == Some(id));
        self.drop_conn(id);
        if is_ours {
            self.queue.push(self.now, Due::LinkDown { link, turn });
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
            self.drop_conn(id);
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
        let waited = conn.pipe(way).again_at;
        let arrivals = conn.pipe(way).send(now, item, acks, gate, way);
        if waited.is_none()
            && let Some(at) = conn.pipe(way).again_at
        {
            self.queue.push(at, Due::SendAgain { conn: id, way });
        }
        let is_too_much = way == Way::Down && !conn.down.dead && conn.down.on_the_way() > CONTROLLER_BUFFER;
        for at in arrivals {
            self.queue.push(at, Due::Arrival { conn: id, way });
        }
        if is_too_much {
            self.reset_conn(id);
        }
    }

    /// The gateway sends on a link.
    pub(super) fn send_up(&mut self, link: LinkId, bytes: Vec<u8>) {
        let now = self.now;
        let Some(gate) = self.gates.get_mut(&link) else { return };
        let turn = gate.turn;
        match gate.kind {
            LinkKind::RecipeUdp => {
                let slowest = gate.network.slowest();
                let oracle = self.oracle.as_mut();
                let tag = oracle.map_or(0, |oracle| oracle.sent_datagram(link, &bytes, slowest, now));
                let peer = udp_peer(turn);
                for at in gate.datagram_arrivals(now, Way::Up) {
                    self.queue.push(at, Due::DatagramUp { link, peer, tag, bytes: bytes.clone() });
                }
            }
            LinkKind::RecipeUdpListen { .. } => {
                let (slowest, partner) = (gate.network.slowest(), gate.partner);
                let mut tag = 0;
                if let Some(oracle) = &mut self.oracle {
                    oracle.answers(link, partner, now);
                    tag = oracle.sent_datagram(link, &bytes, slowest, now);
                }
                let client = self.clients.iter().find(|(_, client)| client.link == Some(link));
                let arrivals = gate.datagram_arrivals(now, Way::Up);
                // To somebody else, or to a socket that is gone, it is lost.
                if let Some((&port, client)) = client
                    && partner == Some(Speaker::Client { socket: client.socket })
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
        self.queue.push(now, Due::LinkSent { link, turn });
    }

    /// The gateway's transport looks whether its peer has acknowledged nothing for too long: it ends the
    /// connection, and the other end hears nothing of it.
    pub(super) fn user_timeout(&mut self, id: u64) {
        let now = self.now;
        let Some(conn) = self.conns.get_mut(&id) else { return };
        let Some(gate) = self.gates.get_mut(&conn.link) else { return };
        let (link, turn) = (conn.link, gate.turn);
        if gate.conn != Some(id) || conn.up.unacked() == 0 {
            conn.is_watched = false;
            return;
        }
        let at = conn.up.unacked_since + USER_TIMEOUT;
        if now < at {
            self.queue.push(at, Due::UserTimeout { conn: id });
            return;
        }
        conn.up.forget();
        conn.abandoned = true;
        let is_gone = conn.closing || conn.forgotten;
        if is_gone {
            self.drop_conn(id);
        } else {
            self.queue.push(now + TCP_TIMEOUT, Due::TimedOut { conn: id });
        }
        self.queue.push(now, Due::LinkDown { link, turn });
    }

    /// The gateway's transport knows that so much has arrived.
    pub(super) fn acknowledged(&mut self, id: u64, upto: u64) {
        let now = self.now;
        let Some(conn) = self.conns.get_mut(&id) else { return };
        if !conn.up.acknowledge(now, upto) {
            return;
        }
        let (link, unacked) = (conn.link, conn.up.unacked());
        let gate = self.gate(link);
        if gate.conn != Some(id) {
            return;
        }
        let turn = gate.turn;
        if gate.is_full && unacked <= gate.network.send_buffer {
            gate.is_full = false;
            self.queue.push(now, Due::LinkSent { link, turn });
        }
        let gate = self.gate(link);
        if !std::mem::replace(&mut gate.looks, true) {
            let at = now + gate.network.ack_report;
            self.queue.push(at, Due::Look { link, turn });
        }
    }

    /// The driver looks at what is acknowledged, and tells it when that is news.
    pub(super) fn tell_acked(&mut self, link: LinkId) {
        if self.is_asleep() {
            return;
        }
        let gate = self.gate(link);
        if !gate.is_up || !std::mem::take(&mut gate.looks) {
            return;
        }
        let Some(conn) = gate.conn.and_then(|id| self.conns.get(&id)) else { return };
        let left = u32::try_from(conn.up.unacked()).unwrap_or(u32::MAX);
        self.engine_input(Input::LinkAcked { link, left });
    }

    /// The controller's UDP server sends.
    pub(super) fn udp_down(&mut self, peer: SocketAddr, bytes: &[u8]) {
        let (now, link) = (self.now, LinkId::RECIPE_UDP);
        let Some(gate) = self.gates.get_mut(&link) else { return };
        for at in gate.datagram_arrivals(now, Way::Down) {
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
                let from = Speaker::Client { socket: client.socket };
                for at in self.gate(link).datagram_arrivals(now, Way::Down) {
                    self.queue.push(at, Due::ClientDatagramDown { link, from, bytes: bytes.clone() });
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

    /// It is time to send again what was not acknowledged.
    pub(super) fn send_again(&mut self, id: u64, way: Way) {
        let now = self.now;
        let Some(conn) = self.conns.get_mut(&id) else { return };
        let Some(gate) = self.gates.get_mut(&conn.link) else { return };
        match conn.pipe(way).send_again(now, gate, way) {
            Again::Nothing => {}
            Again::Arrives(at) => self.queue.push(at, Due::Arrival { conn: id, way }),
            Again::Acked(at) => {
                let upto = conn.up.arrived;
                self.queue.push(at, Due::Ack { conn: id, upto });
            }
            Again::Later(at) => self.queue.push(at, Due::SendAgain { conn: id, way }),
            Again::GivenUp => self.reset_conn(id),
        }
    }

    /// An acknowledgement of the controller's TCP comes to the gateway.
    pub(super) fn ack(&mut self, id: u64, upto: u64) {
        let now = self.now;
        let Some(conn) = self.conns.get_mut(&id) else { return };
        if conn.down.dead || conn.down.held {
            return;
        }
        if self.gates.get(&conn.link).is_some_and(|gate| gate.is_cut(Way::Down)) {
            if let Some(at) = conn.up.sends_again(now, now) {
                self.queue.push(at, Due::SendAgain { conn: id, way: Way::Up });
            }
            return;
        }
        self.acknowledged(id, upto);
    }

    /// The controller's TCP acknowledges what has come, unless something it sent did so already.
    pub(super) fn ack_leaves(&mut self, id: u64) {
        let Some(conn) = self.conns.get_mut(&id) else { return };
        if std::mem::take(&mut conn.owes_ack) {
            let (link, upto) = (conn.link, conn.up.arrived);
            let at = self.now + self.gate(link).network.delay;
            self.queue.push(at, Due::Ack { conn: id, upto });
        }
    }

    /// Bytes came to the controller.
    fn owe_ack(&mut self, id: u64) {
        let now = self.now;
        let Some(conn) = self.conns.get_mut(&id) else { return };
        let Some(gate) = self.gates.get(&conn.link) else { return };
        if !std::mem::replace(&mut conn.owes_ack, true) {
            // What the controller answers at once goes first.
            self.queue.push(now + gate.network.ack_delay, Due::AckLeaves { conn: id });
        }
    }

    /// Something may have arrived at one end of a connection.
    pub(super) fn arrive(&mut self, id: u64, way: Way) {
        let now = self.now;
        let is_asleep = self.is_asleep();
        let Some(conn) = self.conns.get_mut(&id) else { return };
        let (link, peer) = (conn.link, conn.peer);
        let Some(gate) = self.gates.get_mut(&link) else { return };
        if gate.is_cut(way) {
            if let Some(at) = conn.pipe(way).lose(now) {
                self.queue.push(at, Due::SendAgain { conn: id, way });
            }
            return;
        }
        if way == Way::Down && is_asleep && !conn.abandoned {
            // It lies in the gateway's socket.
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
                self.tell_acked(link);
            }
        }
        match (arrived, way) {
            (Arrived::Nothing, _) => {}
            (Arrived::Reset(bytes), way) => {
                match way {
                    Way::Up => self.controller_bytes(id, link, peer, &bytes),
                    Way::Down => self.engine_input(Input::LinkBytes { link, bytes: &bytes }),
                }
                self.reset_conn(id);
                return;
            }
            (Arrived::Item(Item::Bytes(bytes)), Way::Up) => {
                self.owe_ack(id);
                self.controller_bytes(id, link, peer, &bytes);
            }
            (Arrived::Item(Item::Opened), Way::Up) => self.controller_opened(id, peer),
            // The gateway's end is reset, never closed.
            (Arrived::Item(Item::Closed), Way::Up) => {}
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
                self.drop_conn(id);
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

    fn controller_bytes(&mut self, id: u64, link: LinkId, peer: Peer, bytes: &[u8]) {
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
        let (after, slowest) = (self.inputs_before(), self.gate(link).network.slowest());
        if let (Some(oracle), Some(before), Some(after)) = (&mut self.oracle, before, after) {
            oracle.arrived(id, link, bytes, (&before, &after), slowest, self.now);
        }
    }
}

/// How long an attempt to connect waits for an answer before it asks again, at first.
const FIRST_KNOCK: Duration = Duration::from_secs(1);
/// What the controller keeps of what it sends on one connection; a client that lets more pile up is
/// dropped.
const CONTROLLER_BUFFER: u64 = 256 * 1024;
