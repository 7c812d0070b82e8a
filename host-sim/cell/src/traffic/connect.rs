//! Connections: how they are opened, refused, closed and reset.

use proto_core::engine::{LinkId, LinkKind};
use proto_core::time::Duration;

use crate::connection::{Connection, Peer};
use crate::due::Due;
use crate::network::{ConnectPolicy, Item, Way};
use crate::tcp::TCP_TIMEOUT;
use crate::{CLIENT_IP, CLIENT_RETRY, Cell, What};
use recipe_controller::{ConnId, ControllerInput, Link};

impl Cell {
    /// The gateway opens a link.
    pub(crate) fn open(&mut self, link: LinkId) {
        let gate = self.gate(link);
        gate.set_open(true);
        let generation = gate.generation;
        match gate.kind {
            LinkKind::RecipeUdp => self.queue.push(self.now, Due::LinkUp { link, generation }),
            LinkKind::RecipeTcpListen { .. } | LinkKind::RecipeUdpListen { .. } => {}
            _ => self.connect(link, generation, FIRST_CONNECT_WAIT),
        }
    }

    /// Sends a connection request. While there is no answer, repeats it after `pause`, and doubles the pause each time.
    pub(crate) fn connect(&mut self, link: LinkId, generation: u64, pause: Duration) {
        let now = self.now;
        let gate = self.gate(link);
        if gate.generation != generation || gate.conn.is_some() {
            return;
        }
        let delay = gate.network.delay;
        let peer = match gate.kind {
            LinkKind::Command | LinkKind::Urgent => Peer::Server(Link::Command),
            LinkKind::State => Peer::Server(Link::State),
            LinkKind::ModbusDevice { .. } => Peer::Device,
            _ => Peer::Server(Link::Modbus),
        };
        match gate.connect_policy {
            ConnectPolicy::Open => {
                let id = self.new_conn(link, peer);
                self.send_item(id, Way::Up, Item::Opened);
            }
            ConnectPolicy::Refuse if !gate.is_cut(Way::Up) && !gate.is_cut(Way::Down) => {
                self.queue.push(now + delay + delay, Due::LinkDown { link, generation });
            }
            ConnectPolicy::Refuse | ConnectPolicy::Silent => {
                let pause_after = pause.saturating_mul(2);
                self.queue.push(now + pause, Due::Connect { link, generation, pause: pause_after });
            }
        }
    }

    /// The gateway closes a link with a reset: data that has not arrived is lost, in both directions.
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
            // On a half-open connection the reset is lost; the controller detects it by a timeout.
            if !conn.up.dead {
                self.queue.push(now + delay, Due::ResetUp { conn: id });
            }
        }
    }

    /// Removes a connection.
    pub(crate) fn drop_conn(&mut self, id: u64) -> Option<Connection> {
        if let Some(oracle) = &mut self.oracle {
            oracle.conn_gone(id);
        }
        self.conns.remove(&id)
    }

    /// Removes a connection that the controller has not accepted.
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
            // The controller notices it when it sends something, or by TCP's timeout.
            self.queue.push(self.now + TCP_TIMEOUT, Due::TimedOut { conn: id });
            return;
        }
        self.drop_conn(id);
        self.controller_closed(id, peer);
    }

    /// A reset from the controller's host, which has no such connection, reaches the gateway.
    pub(crate) fn reset_down(&mut self, id: u64) {
        let Some(conn) = self.conns.get(&id) else { return };
        let link = conn.link;
        let gate = self.gate(link);
        if gate.is_cut(Way::Down) {
            return;
        }
        let (generation, is_ours) = (gate.generation, gate.conn == Some(id));
        self.drop_conn(id);
        if is_ours {
            self.queue.push(self.now, Due::LinkDown { link, generation });
        }
    }

    /// The controller closes its end, after the data that it has already sent.
    pub(crate) fn controller_closes(&mut self, id: u64) {
        self.send_item(id, Way::Down, Item::Closed);
        let Some(conn) = self.conns.get_mut(&id) else { return };
        conn.up.dead = true;
        conn.closing = true;
        // If the gateway has closed its end too, the connection is gone.
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
        if !gate.is_open || gate.conn.is_some() || gate.connect_policy != ConnectPolicy::Open {
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
        if let Peer::Server(_) | Peer::Device = peer {
            self.send_item(id, Way::Down, Item::Opened);
        }
        self.controller_input(match peer {
            Peer::Server(Link::Command) => ControllerInput::CommandOpened { conn, from: CLIENT_IP },
            Peer::Server(Link::State) => ControllerInput::StateOpened { conn, from: CLIENT_IP },
            Peer::Server(Link::Modbus) => ControllerInput::ModbusOpened { conn, from: CLIENT_IP },
            Peer::Client(port) => ControllerInput::PortUp { port },
            Peer::Device => return self.device_accepts(id),
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
            Peer::Device => return self.device_loses(id),
        });
    }
}

/// How long the first connection request waits for a reply before it is repeated.
const FIRST_CONNECT_WAIT: Duration = Duration::from_secs(1);
