//! The cell's run loop: handles what is due.

use proto_core::engine::{Input, LinkId, OUTPUT_BUFFER, Output};
use proto_core::time::{Duration, Instant};
use proto_core::wire::can::{CanFrame, CanId};

use super::connection::{Connection, Peer};
use super::due::Due;
use super::network::{ConnectPolicy, Item, Sender, Way};
use super::oracle::{Inputs, copied_inputs, inputs_of};
use super::{AnyPort, BusId, COMMAND_CLIENT, Cell, End, LineId, What, udp_peer};
use recipe_controller::{ControllerInput, ControllerOutput, Link};

impl Cell {
    /// Advances time: the clock jumps from deadline to deadline.
    pub fn run(&mut self, span: Duration) {
        let end = self.now + span;
        let mut steps_at_once = 0_u32;
        loop {
            let next = self.next_deadline();
            if self.violation().is_some() {
                return;
            }
            if next > end {
                self.now = end;
                return;
            }
            steps_at_once = if next > self.now { 0 } else { steps_at_once + 1 };
            assert!(steps_at_once < MAX_STEPS, "the cell does not come to rest at {:?}", self.now);
            self.now = self.now.max(next);
            self.step();
        }
    }

    /// Handles everything that is due now, once.
    fn step(&mut self) {
        if !std::mem::replace(&mut self.controller_is_seen, true) {
            self.show_controller();
        }
        if let Some(due) = self.queue.pop_due(self.now) {
            self.execute(due);
            return;
        }
        self.poll_devices();
        if self.engine_wake <= self.now && !self.is_asleep() {
            self.engine_input(Input::Tick);
        }
        if self.controller_wake <= self.now {
            self.controller_input(ControllerInput::Tick);
        }
    }

    fn next_deadline(&self) -> Instant {
        let engine = if self.is_asleep() { Instant::NEVER } else { self.engine_wake };
        self.queue.next().min(engine).min(self.controller_wake).min(self.devices_wake)
    }

    /// Something was done with a device, so its deadline may have changed.
    pub(super) fn note_deadlines(&mut self) {
        let lines = self.lines.iter().filter_map(|line| line.device.as_ref()).map(|device| device.deadline());
        let buses = self.buses.iter().filter_map(|bus| bus.device.as_ref()).map(|device| device.deadline());
        let servers = self.servers.values().map(|server| server.deadline());
        self.devices_wake = lines.chain(buses).chain(servers).min().unwrap_or(Instant::NEVER);
    }

    fn poll_devices(&mut self) {
        if self.now < self.devices_wake {
            return;
        }
        for nth in 0..self.lines.len() {
            let now = self.now;
            let device = self.lines[nth].device.as_mut().filter(|device| device.deadline() <= now);
            let Some(sent) = device.map(|device| device.poll(now)) else { continue };
            self.line_did(LineId(nth));
            for bytes in sent {
                self.transmit(LineId(nth), End::Device, &bytes);
            }
        }
        for nth in 0..self.buses.len() {
            let now = self.now;
            let device = self.buses[nth].device.as_mut().filter(|device| device.deadline() <= now);
            let Some(sent) = device.map(|device| device.poll(now)) else { continue };
            self.bus_did(BusId(nth));
            for frame in sent {
                self.transmit_can(BusId(nth), End::Device, frame);
            }
        }
        self.poll_servers();
    }

    /// Reports to the gateway and to the controller that their ports are up.
    pub(super) fn switch_on(&mut self) {
        let ports: Vec<_> = self.engine.field_ports().collect();
        for port in ports {
            self.engine_input(Input::PortUp { port });
        }
        self.controller_input(ControllerInput::Tick);
        let mut owned: Vec<usize> = Vec::new();
        let owners = self.lines.iter().map(|line| line.owner).chain(self.buses.iter().map(|bus| bus.owner));
        owned.extend(owners.filter_map(|owner| match owner {
            AnyPort::Controller(port) => Some(port),
            AnyPort::Gateway(_) => None,
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
            Input::LinkDown { link } => {
                self.trace.add(now, What::LinkDown, link.0.into(), &[]);
                self.device_link_changed(link);
            }
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
        if let Some(recorder) = &mut self.recorder {
            recorder.input(now, input);
        }
        #[cfg(test)]
        let forged = self.forged_input(&input);
        #[cfg(test)]
        let given = super::corruption::instead(&input, forged.as_deref());
        #[cfg(not(test))]
        let given = input;
        self.engine.handle(now, given);
        if let Some(oracle) = &mut self.oracle {
            oracle.input(now, &input, &self.engine);
        }
        // Executing an output can cause another input, so each of these nested calls takes a buffer of its own.
        let mut buf = self.buffer.take().unwrap_or_else(|| Box::new([0; OUTPUT_BUFFER]));
        loop {
            let output = self.engine.poll_output(now, &mut buf);
            #[cfg(test)]
            if let Some(forged) = self.forged_outputs(&input, &output) {
                for forged in &forged {
                    self.execute_output(forged.as_output());
                }
                if !matches!(output, Output::Sleep { .. }) {
                    continue;
                }
            }
            if !self.execute_output(output) {
                break;
            }
        }
        self.buffer = Some(buf);
    }

    /// Executes an output of the engine; returns false if it was `Sleep`.
    fn execute_output(&mut self, output: Output<'_>) -> bool {
        let now = self.now;
        if let Some(recorder) = &mut self.recorder {
            recorder.output(output);
        }
        if let Some(oracle) = &mut self.oracle {
            match output {
                Output::Sleep { until } => {
                    oracle.rest(now, &self.engine, until, self.queue.len() + self.conns.len());
                }
                _ => oracle.output(now, &output),
            }
        }
        match output {
            Output::Sleep { until } => {
                self.engine_wake = until;
                return false;
            }
            Output::PortSend { port, bytes } => {
                self.trace.add(now, What::PortSent, port.0.into(), bytes);
                if let Some(line) = self.line_at(AnyPort::Gateway(port)) {
                    self.transmit(line, End::Port, bytes);
                }
            }
            Output::PortSendCan { port, frame } => {
                self.trace.add(now, What::PortSent, port.0.into(), &can_bytes(&frame));
                if let Some(bus) = self.bus_at(AnyPort::Gateway(port)) {
                    self.transmit_can(bus, End::Port, frame);
                }
            }
            Output::LinkOpen { link, .. } => {
                self.trace.add(now, What::LinkOpen, link.0.into(), &[]);
                self.open(link);
            }
            Output::LinkClose { link } => {
                self.trace.add(now, What::LinkClose, link.0.into(), &[]);
                self.device_link_changed(link);
                self.close(link);
            }
            Output::LinkSend { link, bytes } => {
                self.trace.add(now, What::LinkSent, link.0.into(), bytes);
                self.send_up(link, bytes.to_vec());
            }
            other => unreachable!("no such output: {other:?}"),
        }
        true
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
        self.show_controller();
        self.drain_controller();
        self.controller_is_seen = false;
    }

    /// Shows the controller's registers to the model, if it needs them.
    fn show_controller(&mut self) {
        if let Some(judge) = &mut self.judge {
            judge.sees_controller(self.controller.registers().image(), self.now);
        }
        if let Some(oracle) = self.oracle.as_mut().filter(|oracle| oracle.wants_controller()) {
            oracle.sees_controller(self.controller.registers().image(), self.now);
        }
    }

    fn drain_controller(&mut self) {
        let now = self.now;
        loop {
            match self.controller.poll_output(now) {
                ControllerOutput::Sleep { until } => {
                    self.controller_wake = until;
                    return;
                }
                ControllerOutput::Send { conn: COMMAND_CLIENT, bytes } => {
                    self.reply.extend_from_slice(&bytes)
                }
                ControllerOutput::Send { conn, bytes } => {
                    self.replied(conn.0, &bytes);
                    self.send_item(conn.0, Way::Down, Item::Bytes(bytes))
                }
                ControllerOutput::Close { conn } => self.controller_closes(conn.0),
                ControllerOutput::StatePacket { bytes } => {
                    let subscribed = |conn: &Connection| {
                        conn.peer == Peer::Server(Link::State) && conn.accepted && !conn.closing
                    };
                    let conns = self.conns.iter().filter(|(_, conn)| subscribed(conn));
                    let conns: Vec<u64> = conns.map(|(&id, _)| id).collect();
                    let lost = std::mem::take(&mut self.state_bytes_lost).min(bytes.len());
                    for conn in conns {
                        self.send_item(conn, Way::Down, Item::Bytes(bytes[lost..].to_vec()));
                    }
                }
                ControllerOutput::UdpSend { peer, bytes } => self.udp_down(peer, &bytes),
                ControllerOutput::PortSend { port, bytes } => {
                    self.trace.add(now, What::ControllerPortSent, port as u64, &bytes);
                    self.controller_port_sends(port, bytes);
                }
                ControllerOutput::PortSendCan { port, frame } => {
                    self.trace.add(now, What::ControllerPortSent, port as u64, &can_bytes(&frame));
                    if let Some(bus) = self.bus_at(AnyPort::Controller(port)) {
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
                    let devices = &self.servers;
                    for gate in self.gates.values_mut().filter(|gate| !devices.contains_key(&gate.id)) {
                        gate.connect_policy = ConnectPolicy::Refuse;
                    }
                }
            }
        }
    }

    pub(super) fn execute(&mut self, due: Due) {
        let Some(due) = self.keep_for_later(due) else { return };
        match due {
            Due::LinkUp { link, generation } => {
                if self.is_current(link, generation) {
                    self.gate(link).is_up = true;
                    self.engine_input(Input::LinkUp { link });
                }
            }
            Due::LinkDown { link, generation } => {
                if self.is_current(link, generation) {
                    self.gate(link).set_open(false);
                    self.engine_input(Input::LinkDown { link });
                }
            }
            Due::LinkSent { link, generation } => {
                if self.is_current(link, generation) {
                    self.engine_input(Input::LinkSent { link });
                }
            }
            Due::Arrival { conn, way } => self.arrive(conn, way),
            Due::DatagramUp { link, peer, tag, bytes } => {
                if self.gate(link).is_cut(Way::Up) {
                    return;
                }
                self.trace.add(self.now, What::ControllerReceived, link.0.into(), &bytes);
                let before = self.inputs_before();
                self.controller_input(ControllerInput::Udp2011 { peer, bytes: &bytes });
                self.datagram_arrived(link, tag, &bytes, before);
            }
            Due::DatagramDown { link, peer, bytes } => {
                let gate = self.gate(link);
                if gate.is_cut(Way::Down) {
                    return;
                }
                if gate.is_up && udp_peer(gate.generation) == peer {
                    self.engine_input(Input::LinkBytes { link, bytes: &bytes });
                } else {
                    let back = self.now + self.gate(link).network.delay;
                    self.queue.push(back, Due::Unreachable { peer });
                }
            }
            Due::ClientDatagramUp { port, tag, bytes } => {
                let Some(link) = self.clients.get(&port).and_then(|client| client.link) else { return };
                if self.gate(link).is_cut(Way::Up) {
                    return;
                }
                let before = self.inputs_before();
                self.controller_input(ControllerInput::PortBytes { port, bytes: &bytes });
                self.datagram_arrived(link, tag, &bytes, before);
            }
            Due::ClientDatagramDown { link, from, bytes } => self.client_datagram(link, from, &bytes),
            Due::Unreachable { peer } => self.controller_input(ControllerInput::Udp2011Unreachable { peer }),
            Due::ClientTries { port } => self.client_tries(port),
            Due::Chunk { line, chunk } => self.chunk_arrives(line, chunk),
            Due::Gathered { line } => {
                let bytes = std::mem::take(&mut self.lines[line.0].gathered);
                if !bytes.is_empty() {
                    self.port_receives(self.lines[line.0].owner, &bytes);
                }
            }
            Due::CanDone { bus } => self.can_done(bus),
            Due::DeviceSends { line, bytes } => self.send(line, &bytes),
            Due::TimedOut { conn } => self.reset_conn(conn),
            Due::Connect { link, generation, pause } => self.connect(link, generation, pause),
            Due::ResetUp { conn } => self.reset_up(conn),
            Due::ResetDown { conn } => self.reset_down(conn),
            Due::Retransmit { conn, way } => self.retransmit(conn, way),
            Due::AckLeaves { conn } => self.ack_leaves(conn),
            Due::Ack { conn, upto } => self.ack(conn, upto),
            Due::UserTimeout { conn } => self.user_timeout(conn),
            Due::ReadAcks { link, generation } => {
                if self.is_current(link, generation) && !self.is_asleep() {
                    self.report_acked(link);
                }
            }
            Due::Wake { generation } => self.wake(generation),
            Due::Survey => self.survey(),
        }
    }

    /// A datagram arrives at a listening port of the gateway. The gateway answers the first sender; later it switches
    /// only to the sender of a valid frame.
    fn client_datagram(&mut self, link: LinkId, from: Sender, bytes: &[u8]) {
        let gate = self.gate(link);
        if gate.is_cut(Way::Down) && from != Sender::Stranger || !gate.is_open {
            return;
        }
        if !gate.is_up {
            gate.is_up = true;
            gate.answers_to = Some(from);
            self.engine_input(Input::LinkUp { link });
        } else if gate.answers_to != Some(from) && self.engine.is_frame(link, bytes) {
            self.gate(link).answers_to = Some(from);
        }
        if let Some(oracle) = &mut self.oracle {
            oracle.datagram_received(link, from, bytes);
        }
        if self.gate(link).is_up {
            self.engine_input(Input::LinkBytes { link, bytes });
        }
    }

    /// The controller's inputs; `None` if no model compares them.
    pub(super) fn inputs_before(&self) -> Option<Inputs> {
        self.oracle.as_ref().map(|_| copied_inputs(self.controller.registers().image()))
    }

    fn datagram_arrived(&mut self, link: LinkId, tag: u64, bytes: &[u8], before: Option<Inputs>) {
        let slowest = self.gate(link).network.slowest();
        if let (Some(oracle), Some(before)) = (&mut self.oracle, before) {
            let after = inputs_of(self.controller.registers().image());
            oracle.arrived_datagram(link, tag, bytes, (&before, after), slowest, self.now);
        }
    }

    fn is_current(&self, link: LinkId, generation: u64) -> bool {
        self.gates.get(&link).is_some_and(|gate| gate.generation == generation)
    }
}

/// A CAN frame as bytes, as the trace has it.
pub(super) fn can_bytes(frame: &CanFrame) -> impl std::ops::Deref<Target = [u8]> {
    let id = match frame.id() {
        CanId::Standard(id) => u32::from(id),
        CanId::Extended(id) => id | 0x8000_0000,
    };
    let mut bytes = heapless::Vec::<u8, 12>::new();
    // Cannot fail: a frame has at most eight bytes.
    let _ = bytes.extend_from_slice(&id.to_be_bytes());
    let _ = bytes.extend_from_slice(frame.data());
    bytes
}

/// Maximum number of steps at one instant, far more than needed.
const MAX_STEPS: u32 = 1_000_000;
