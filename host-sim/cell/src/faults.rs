//! Faults that a test or a soak run can inject, and their repair.

use proto_core::engine::{BusState, Engine, Input, LinkId, LinkKind};

use super::connection::{Connection, Peer};
use super::due::Due;
use super::network::{ConnectPolicy, Sender, Way};
use super::sleep::PortEvent;
use super::tcp::TCP_TIMEOUT;
use super::{AnyPort, BusId, Cell, Entry, LineId, What};

/// Faults of the network.
impl Cell {
    /// New connections are refused; on a datagram link, everything is lost.
    pub fn refuse(&mut self, link: LinkId) {
        self.set_connect_policy(link, ConnectPolicy::Refuse);
    }

    /// New connections get no answer; on a datagram link, everything is lost.
    pub fn black_hole(&mut self, link: LinkId) {
        self.set_connect_policy(link, ConnectPolicy::Silent);
    }

    /// New connections and datagrams get through again.
    pub fn admit(&mut self, link: LinkId) {
        self.set_connect_policy(link, ConnectPolicy::Open);
    }

    /// The link's connection is reset: both ends are told, and data in flight is lost.
    pub fn reset(&mut self, link: LinkId) {
        self.note(link);
        if let Some(conn) = self.gate(link).conn {
            self.reset_conn(conn);
        }
    }

    /// The connection is reset after this many more bytes have arrived.
    pub fn reset_after(&mut self, link: LinkId, way: Way, bytes: usize) {
        self.note(link);
        if let Some(conn) = self.connection(link) {
            conn.pipe(way).reset_after = Some(bytes);
        }
    }

    /// Holds back everything in this direction until [`Self::release`]; nothing is lost.
    pub fn hold(&mut self, link: LinkId, way: Way) {
        self.note(link);
        if let Some(conn) = self.connection(link) {
            conn.pipe(way).held = true;
        }
    }

    /// Held data arrives now, in as few pieces as possible.
    pub fn release(&mut self, link: LinkId, way: Way) {
        self.note(link);
        let Some(id) = self.gate(link).conn else { return };
        if let Some(conn) = self.conns.get_mut(&id) {
            conn.pipe(way).held = false;
            self.queue.push(self.now, Due::Arrival { conn: id, way });
            if way == Way::Down {
                // Acknowledgements were held, too.
                self.queue.push(self.now, Due::Ack { conn: id, upto: conn.up.arrived });
            }
        }
    }

    /// Everything sent in this direction is lost until [`Self::repair_way`] has been called as often as this. TCP
    /// retransmits it.
    pub fn cut_way(&mut self, link: LinkId, way: Way) {
        self.note(link);
        self.gate(link).cuts[way as usize] += 1;
    }

    /// Ends one [`Self::cut_way`].
    pub fn repair_way(&mut self, link: LinkId, way: Way) {
        self.note(link);
        let cuts = &mut self.gate(link).cuts[way as usize];
        *cuts = cuts.saturating_sub(1);
    }

    /// Pulls the cable between the gateway and the controller, for this link only.
    pub fn cut_cable(&mut self, link: LinkId) {
        Way::BOTH.into_iter().for_each(|way| self.cut_way(link, way));
    }

    /// Ends one [`Self::cut_cable`].
    pub fn repair_cable(&mut self, link: LinkId) {
        Way::BOTH.into_iter().for_each(|way| self.repair_way(link, way));
    }

    /// Another program on the controller's host sends a datagram to a port where the gateway listens.
    pub fn stranger_sends(&mut self, link: LinkId, bytes: &[u8]) {
        self.note(link);
        let due = Due::ClientDatagramDown { link, from: Sender::Stranger, bytes: bytes.to_vec() };
        self.queue.push(self.now, due);
    }

    /// Makes the connection half-open: neither end is told, and data that they send is lost. TCP gives up after
    /// [`TCP_TIMEOUT`].
    pub fn half_open(&mut self, link: LinkId) {
        self.note(link);
        let Some(id) = self.gate(link).conn else { return };
        if let Some(conn) = self.conns.get_mut(&id) {
            conn.up.dead = true;
            conn.down.dead = true;
            self.queue.push(self.now + TCP_TIMEOUT, Due::TimedOut { conn: id });
        }
    }

    /// Whether the network has a connection for this link.
    pub fn is_connected(&self, link: LinkId) -> bool {
        self.gates.get(&link).is_some_and(|gate| gate.conn.is_some())
    }

    /// The next state packet lacks its first bytes. The connection continues, so all later packets are misaligned.
    pub fn lose_state_bytes(&mut self, count: usize) {
        self.note(LinkId::STATE);
        self.state_bytes_lost = count;
    }

    fn set_connect_policy(&mut self, link: LinkId, connect_policy: ConnectPolicy) {
        self.note(link);
        self.gate(link).connect_policy = connect_policy;
    }

    /// Adds a remark to the trace.
    pub(super) fn remark(&mut self, words: std::fmt::Arguments<'_>) {
        self.trace.remark(self.now, words);
    }

    fn note(&mut self, link: LinkId) {
        self.trace.add(self.now, What::Fault, link.0.into(), &[]);
        self.device_link_fault(link);
        self.note_fault(Some(link));
    }

    fn connection(&mut self, link: LinkId) -> Option<&mut Connection> {
        let id = self.gate(link).conn?;
        self.conns.get_mut(&id)
    }

    pub(super) fn reset_conn(&mut self, id: u64) {
        let Some(conn) = self.drop_conn(id) else { return };
        let gate = self.gate(conn.link);
        // The gateway may have closed its end and opened another connection.
        if gate.conn == Some(id) {
            let generation = gate.generation;
            self.queue.push(self.now, Due::LinkDown { link: conn.link, generation });
        }
        // The controller may have lost its end in a power cut.
        if !conn.forgotten {
            self.controller_closed(id, conn.peer);
        }
    }
}

/// Faults of the field.
impl Cell {
    /// The line is cut: bytes are lost, and neither end is told.
    pub fn cut(&mut self, line: LineId) {
        self.lines[line.0].connected = false;
    }

    /// The line is connected again, unless its adapter is pulled out.
    pub fn repair(&mut self, line: LineId) {
        self.lines[line.0].connected = self.lines[line.0].is_plugged;
    }

    /// The port's adapter is unplugged, which is reported to the owner of the port.
    pub fn unplug(&mut self, line: LineId) {
        self.cut(line);
        self.lines[line.0].is_plugged = false;
        self.lines[line.0].gathered.clear();
        self.port_input(self.lines[line.0].owner, false);
    }

    /// The port's adapter is plugged in again.
    pub fn plug_in(&mut self, line: LineId) {
        self.lines[line.0].is_plugged = true;
        self.repair(line);
        self.port_input(self.lines[line.0].owner, true);
    }

    /// The bus is cut: frames are lost, and neither end is told.
    pub fn cut_bus(&mut self, bus: BusId) {
        self.buses[bus.0].connected = false;
    }

    /// The bus is connected again.
    pub fn repair_bus(&mut self, bus: BusId) {
        self.buses[bus.0].connected = true;
    }

    /// The port's CAN controller goes bus-off: its waiting frames are lost, and it receives nothing.
    pub fn bus_off(&mut self, bus: BusId) {
        self.buses[bus.0].drop_port_frames();
        self.buses[bus.0].is_off = true;
        self.bus_state(bus, BusState::BusOff);
    }

    /// The port's CAN controller is error-active again.
    pub fn bus_on(&mut self, bus: BusId) {
        self.buses[bus.0].is_off = false;
        if let Some(judge) = &mut self.judge {
            judge.port_begins(self.now);
        }
        self.bus_state(bus, BusState::Active);
    }

    fn bus_state(&mut self, bus: BusId, state: BusState) {
        // The CAN ports of the simulated controller have no error states.
        if let AnyPort::Gateway(port) = self.buses[bus.0].owner {
            self.report_port_event(port, PortEvent::Bus(state));
        }
    }
}

/// Restarts and power cuts.
impl Cell {
    /// Restarts the controller: see [`recipe_controller::Controller::restart`].
    pub fn restart_controller(&mut self) {
        let now = self.now;
        self.trace.add(now, What::Fault, Entry::CONTROLLER, &[]);
        self.controller_mut().restart(now);
        self.controller_started();
    }

    /// As [`Self::restart_controller`], with all registers set to 0.
    pub fn clear_controller(&mut self) {
        let now = self.now;
        self.trace.add(now, What::Fault, Entry::CONTROLLER, &[0]);
        self.controller_mut().restart_cleared(now);
        self.controller_started();
    }

    /// The controller loses power: its ends of all connections disappear without notice. [`Self::power_up`] ends the
    /// power cut.
    pub fn power_cut(&mut self) {
        let links: Vec<LinkId> = self.controller_links().collect();
        links.into_iter().for_each(|link| self.cut_cable(link));
        let conns = self.conns.iter().filter(|(_, conn)| conn.peer != Peer::Device);
        let conns: Vec<(u64, Peer)> = conns.map(|(&id, conn)| (id, conn.peer)).collect();
        self.lose_power(conns);
    }

    /// The far ends of these connections disappear without notice.
    pub(super) fn lose_power(&mut self, conns: Vec<(u64, Peer)>) {
        for (id, peer) in conns {
            let Some(conn) = self.conns.get_mut(&id) else { continue };
            match peer {
                _ if conn.forgotten => continue,
                _ if conn.abandoned || conn.closing => drop(self.drop_conn(id)),
                // The gateway repeats its connection request.
                Peer::Server(_) | Peer::Device if !conn.accepted => continue,
                Peer::Client(_) if !conn.accepted => {
                    let link = conn.link;
                    self.drop_conn(id);
                    self.gate(link).conn = None;
                }
                _ => {
                    conn.forgotten = true;
                    conn.down.forget();
                }
            }
            self.controller_closed(id, peer);
        }
    }

    /// Power is back; the controller starts with all registers at 0.
    pub fn power_up(&mut self) {
        let links: Vec<LinkId> = self.controller_links().collect();
        links.into_iter().for_each(|link| self.repair_cable(link));
        self.clear_controller();
    }

    fn controller_started(&mut self) {
        self.clients.values_mut().for_each(|client| client.socket += 1);
        if let Some(oracle) = &mut self.oracle {
            oracle.controller_started(self.now);
        }
    }

    /// The controller restarts with software that has this dialect.
    pub fn replace_controller(&mut self, dialect: &str) {
        let now = self.now;
        self.trace.add(now, What::Fault, Entry::CONTROLLER, dialect.as_bytes());
        self.controller_mut().replace_software(now, dialect);
        self.controller_started();
    }

    /// The gateway loses power and restarts: its connections are reset, and its counters start at 0.
    pub fn restart_gateway(&mut self) {
        self.count_outcomes();
        if let Some(judge) = &mut self.judge {
            judge.gateway_starts(self.now);
        }
        self.trace.add(self.now, What::Fault, Entry::GATEWAY, &[]);
        let known = self.conns.iter().filter(|(_, conn)| !conn.forgotten);
        let conns: Vec<(u64, Peer)> = known.map(|(&id, conn)| (id, conn.peer)).collect();
        for gate in self.gates.values_mut() {
            gate.set_open(false);
        }
        let all: Vec<u64> = self.conns.keys().copied().collect();
        for id in all {
            self.drop_conn(id);
        }
        self.forget_waiting();
        // Cannot fail: the previous engine had the same configuration.
        if let Ok(engine) = Engine::new(&self.gateway) {
            if let Some(recorder) = &mut self.recorder {
                recorder.totals(&self.engine);
                recorder.start();
            }
            *self.engine = engine;
        }
        if let Some(oracle) = &mut self.oracle {
            oracle.restarted(self.now);
        }
        self.engine_wake = self.now;
        let ports: Vec<_> = self.engine.field_ports().collect();
        for port in ports {
            self.engine_input(Input::PortUp { port });
        }
        for (id, peer) in conns {
            self.controller_closed(id, peer);
        }
    }

    /// The links that are TCP connections.
    pub fn tcp_links(&self) -> impl Iterator<Item = LinkId> + '_ {
        let is_tcp = |kind| !matches!(kind, LinkKind::RecipeUdp | LinkKind::RecipeUdpListen { .. });
        self.gates.values().filter(move |gate| is_tcp(gate.kind)).map(|gate| gate.id)
    }

    /// The links that use datagrams.
    pub fn datagram_links(&self) -> impl Iterator<Item = LinkId> + use<> {
        let is_udp = |kind| matches!(kind, LinkKind::RecipeUdp | LinkKind::RecipeUdpListen { .. });
        let links: Vec<LinkId> =
            self.gates.values().filter(|gate| is_udp(gate.kind)).map(|gate| gate.id).collect();
        links.into_iter()
    }

    /// The links where the gateway listens for datagrams, each with the length of the controller's frames.
    pub(super) fn listening_for_datagrams(&self) -> Vec<(LinkId, Option<usize>)> {
        let listen = self.gates.values().filter(|gate| matches!(gate.kind, LinkKind::RecipeUdpListen { .. }));
        listen.map(|gate| (gate.id, self.frame_len(gate.id))).collect()
    }

    /// The links to the controller.
    fn controller_links(&self) -> impl Iterator<Item = LinkId> + '_ {
        self.link_ids().filter(|link| !self.servers.contains_key(link))
    }

    /// The links to devices.
    pub fn device_links(&self) -> impl Iterator<Item = LinkId> + use<> {
        let links: Vec<LinkId> = self.servers.keys().copied().collect();
        links.into_iter()
    }

    /// Every link.
    pub fn link_ids(&self) -> impl Iterator<Item = LinkId> + '_ {
        self.gates.keys().copied()
    }
}
