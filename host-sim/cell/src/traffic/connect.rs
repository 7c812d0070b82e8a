//! Connections: how they are opened, refused, closed and reset.

use proto_core::engine::{LinkId, LinkKind};
use proto_core::time::Duration;

use crate::connection::{Connection, Peer};
use crate::due::Due;
use crate::network::{Door, Item, Way};
use crate::tcp::TCP_TIMEOUT;
use crate::{CLIENT_RETRY, Cell, HERE, What};
use recipe_controller::{ConnId, ControllerInput, Link};

impl Cell {
    /// The gateway opens a link.
    pub(crate) fn open(&mut self, link: LinkId) {
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
    pub(crate) fn knock(&mut self, link: LinkId, turn: u64, pause: Duration) {
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
    pub(crate) fn close(&mut self, link: LinkId) {
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
    pub(crate) fn drop_conn(&mut self, id: u64) -> Option<Connection> {
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
    pub(crate) fn reset_up(&mut self, id: u64) {
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
    pub(crate) fn reset_down(&mut self, id: u64) {
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
    pub(crate) fn controller_closes(&mut self, id: u64) {
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

    /// The controller's TCP client connects to the gateway.
    pub(crate) fn client_tries(&mut self, port: usize) {
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
    pub(crate) fn client_lost(&mut self, port: usize) {
        if let Some(client) = self.clients.get_mut(&port) {
            client.conn = None;
            self.queue.push(self.now + CLIENT_RETRY, Due::ClientTries { port });
        }
    }

    pub(super) fn controller_opened(&mut self, id: u64, peer: Peer) {
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

    pub(crate) fn controller_closed(&mut self, id: u64, peer: Peer) {
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
}

/// How long an attempt to connect waits for an answer before it asks again, at first.
const FIRST_KNOCK: Duration = Duration::from_secs(1);
