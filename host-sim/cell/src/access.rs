//! Access to the parts of a cell by name, for tests that inspect and change them.

use std::collections::BTreeMap;

use proto_core::config::GatewayConfig;
use proto_core::engine::{Engine, LinkId, LinkInfo, PortCounters, PortId};
use proto_core::time::Instant;
use proto_core::wire::can::CanFrame;

use super::due::Due;
use super::{BusId, CanBus, Cell, Device, End, Line, LineId, Medium, Network, Rng, Trace};
use recipe_config::InitialTarget;
use recipe_controller::Controller;

impl Cell {
    /// The present instant.
    pub fn now(&self) -> Instant {
        self.now
    }

    /// The gateway's configuration.
    pub fn gateway(&self) -> &GatewayConfig {
        &self.gateway
    }

    /// Sets how many transmissions each line and bus keeps for inspection; initially [`crate::MAX_HEARD`].
    pub fn keep_heard(&mut self, limit: usize) {
        self.lines.iter_mut().for_each(|line| line.keep_heard = limit);
        self.buses.iter_mut().for_each(|bus| bus.keep_heard = limit);
    }

    /// The gateway.
    pub fn engine(&self) -> &Engine {
        &self.engine
    }

    /// The controller.
    pub fn controller(&self) -> &Controller {
        &self.controller
    }

    /// The controller, to inject faults, which take effect with the next [`Self::run`].
    pub fn controller_mut(&mut self) -> &mut Controller {
        self.controller_wake = self.now;
        self.controller_is_seen = false;
        &mut self.controller
    }

    /// The controller's item of this name, such as `DO[1]` or `WordInputReg[3]`.
    ///
    /// # Panics
    /// If there is no such item.
    #[track_caller]
    pub fn value(&self, name: &str) -> f64 {
        self.controller.registers().value(target(name))
    }

    /// Sets an item of the controller from outside, as a wired input does.
    ///
    /// # Panics
    /// If there is no such item, or the value does not fit.
    #[track_caller]
    pub fn set_value(&mut self, name: &str, value: f64) {
        if let Err(error) = self.controller_mut().force(target(name), value) {
            panic!("{name} = {value}: {error}");
        }
    }

    /// A link of the gateway.
    ///
    /// # Panics
    /// If the configuration does not need this link.
    #[track_caller]
    pub fn link(&self, id: LinkId) -> LinkInfo<'_> {
        match self.engine.links().find(|link| link.id == id) {
            Some(link) => link,
            None => panic!("the gateway has no {id:?}"),
        }
    }

    /// The counters of the gateway's field port of this name.
    ///
    /// # Panics
    /// If there is no such field port.
    #[track_caller]
    pub fn port(&self, name: &str) -> &PortCounters {
        let nth = self.gateway.ports.iter().position(|port| port.name == name);
        match nth.and_then(|nth| self.engine.port_counters(PortId(nth as u8))) {
            Some(counters) => counters,
            None => panic!("the gateway has no field port {name}"),
        }
    }

    /// The line of the gateway's RS-485 port of this name; if there is none, of the controller's.
    ///
    /// # Panics
    /// If neither has one.
    #[track_caller]
    pub fn line_of(&self, port: &str) -> LineId {
        match self.names.get(port).or_else(|| self.controller_names.get(port)) {
            Some(Medium::Line(line)) => *line,
            _ => panic!("there is no RS-485 port {port}"),
        }
    }

    /// The bus of the gateway's CAN port of this name; if there is none, of the controller's.
    ///
    /// # Panics
    /// If neither has one.
    #[track_caller]
    pub fn bus_of(&self, port: &str) -> BusId {
        match self.names.get(port).or_else(|| self.controller_names.get(port)) {
            Some(Medium::Bus(bus)) => *bus,
            _ => panic!("there is no CAN port {port}"),
        }
    }

    /// All lines.
    pub fn lines(&self) -> impl Iterator<Item = LineId> + use<> {
        (0..self.lines.len()).map(LineId)
    }

    /// All buses.
    pub fn buses(&self) -> impl Iterator<Item = BusId> + use<> {
        (0..self.buses.len()).map(BusId)
    }

    /// A line, to inspect and to change.
    pub fn line(&mut self, id: LineId) -> &mut Line {
        &mut self.lines[id.0]
    }

    /// A bus, to inspect and to change.
    pub fn bus(&mut self, id: BusId) -> &mut CanBus {
        &mut self.buses[id.0]
    }

    /// The network of a link, to inspect and to change.
    ///
    /// # Panics
    /// If the configuration does not need this link.
    #[track_caller]
    pub fn network(&mut self, link: LinkId) -> &mut Network {
        &mut self.gate(link).network
    }

    /// The network of each link.
    pub fn networks(&self) -> BTreeMap<LinkId, Network> {
        self.gates.iter().map(|(&link, gate)| (link, gate.network)).collect()
    }

    /// Changes the network of every link.
    pub fn every_network(&mut self, mut change: impl FnMut(&mut Network)) {
        for gate in self.gates.values_mut() {
            change(&mut gate.network);
        }
    }

    /// Attaches a device to a line; it replaces the previous one.
    pub fn attach(&mut self, line: LineId, device: impl Device<Vec<u8>> + 'static) {
        self.lines[line.0].device = Some(Box::new(device));
        self.note_deadlines();
    }

    /// Attaches a device to a bus; it replaces the previous one.
    pub fn attach_can(&mut self, bus: BusId, device: impl Device<CanFrame> + 'static) {
        self.buses[bus.0].device = Some(Box::new(device));
        self.note_deadlines();
    }

    /// Sends as the device on the line, after its previous transmission.
    pub fn send(&mut self, line: LineId, bytes: &[u8]) {
        self.line_garbled(line);
        self.transmit(line, End::Device, bytes);
    }

    /// As [`Self::send`], at a later instant.
    pub fn send_at(&mut self, at: Instant, line: LineId, bytes: &[u8]) {
        self.queue.push(at, Due::DeviceSends { line, bytes: bytes.to_vec() });
    }

    /// Sends as the device on the bus.
    pub fn send_can(&mut self, bus: BusId, frame: CanFrame) {
        self.transmit_can(bus, End::Device, frame);
    }

    /// The trace.
    pub fn trace(&self) -> &Trace {
        &self.trace
    }

    /// Keeps the next `limit` entries of the trace.
    pub fn keep_trace(&mut self, limit: usize) {
        self.trace.keep(limit);
    }

    /// The recording, in the format of `proto_core::record`; empty if the cell was not made with [`Self::recorded`].
    pub fn into_recording(self) -> Vec<u8> {
        self.recorder.map_or_else(Vec::new, |mut recorder| {
            recorder.totals(&self.engine);
            recorder.into_bytes()
        })
    }

    /// A generator derived from the cell's seed.
    pub fn fork_rng(&mut self) -> Rng {
        self.rng.fork()
    }
}

#[track_caller]
fn target(name: &str) -> InitialTarget {
    match name.parse() {
        Ok(target) => target,
        Err(error) => panic!("{name}: {error}"),
    }
}
