//! Traffic between ports and their devices: bytes on lines, frames on buses.

use proto_core::config::Echo;
use proto_core::engine::Input;
use proto_core::time::Instant;
use proto_core::wire::can::CanFrame;

use super::due::Due;
use super::line::{Chunk, Chunking};
use super::sleep::PortEvent;
use super::{AnyPort, BusId, Cell, Done, End, LineId, SlaveDone};
use recipe_controller::ControllerInput;

impl Cell {
    pub(super) fn transmit(&mut self, line: LineId, from: End, bytes: &[u8]) {
        let queue = &mut self.queue;
        let each = |at, chunk| queue.push(at, Due::Chunk { line, chunk });
        self.lines[line.0].send(self.now, from, bytes, each);
    }

    pub(super) fn chunk_arrives(&mut self, id: LineId, mut chunk: Chunk) {
        let now = self.now;
        let line = &mut self.lines[id.0];
        let owner = line.owner;
        let garbled = line.counters.garbled_bytes;
        let arrives = line.deliver(now, &mut chunk);
        if !arrives || line.counters.garbled_bytes != garbled {
            self.line_garbled(id);
        }
        let line = &mut self.lines[id.0];
        match chunk.from {
            End::Device if !arrives => {}
            End::Device => self.hand_on(id, owner, &chunk.bytes),
            End::Port => {
                let mut answers = Vec::new();
                if (line.gives_back || line.settings().echo == Echo::Yes) && line.is_plugged {
                    // The adapter echoes what the port sends, whether or not it reaches the device.
                    self.hand_on(id, owner, &chunk.bytes);
                }
                let line = &mut self.lines[id.0];
                if arrives {
                    line.hear(now, &chunk.bytes, chunk.is_first);
                    answers = line.device.as_mut().map_or_else(Vec::new, |d| d.receive(now, &chunk.bytes));
                    self.line_did(id);
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

    /// The port's receiver got bytes; its driver reports them at once or later.
    fn hand_on(&mut self, id: LineId, owner: AnyPort, bytes: &[u8]) {
        let line = &mut self.lines[id.0];
        let Chunking::Gathered(every) = line.chunking else { return self.port_receives(owner, bytes) };
        if line.gathered.is_empty() {
            let every = every.as_micros().max(1);
            let at = Instant::from_micros(self.now.as_micros().div_ceil(every) * every);
            self.queue.push(at, Due::Gathered { line: id });
        }
        line.gathered.extend_from_slice(bytes);
    }

    /// Tells the model what the devices of a line did.
    pub(super) fn line_did(&mut self, id: LineId) {
        let line = &mut self.lines[id.0];
        let done = line.device.as_mut().map_or_else(Vec::new, |device| device.take_done());
        self.note_deadlines();
        self.device_did(self.lines[id.0].owner, done);
    }

    /// Tells the model what the devices of a bus did.
    pub(super) fn bus_did(&mut self, id: BusId) {
        let bus = &mut self.buses[id.0];
        let done = bus.device.as_mut().map_or_else(Vec::new, |device| device.take_done());
        self.note_deadlines();
        self.device_did(self.buses[id.0].owner, done);
    }

    fn device_did(&mut self, owner: AnyPort, done: Vec<SlaveDone>) {
        if let Some(judge) = &mut self.judge {
            for done in done {
                if let Done::Acted(act) = done.what {
                    judge.did(act, self.now);
                }
            }
            return;
        }
        if let (AnyPort::Gateway(port), Some(oracle)) = (owner, &mut self.oracle) {
            done.into_iter().for_each(|done| oracle.slave_did(usize::from(port.0), done, self.now));
        }
    }

    /// Tells the model that bytes were corrupted on a line.
    pub(super) fn line_garbled(&mut self, id: LineId) {
        if let (AnyPort::Gateway(port), Some(oracle)) = (self.lines[id.0].owner, &mut self.oracle) {
            oracle.line_garbled(usize::from(port.0), self.now);
        }
    }

    pub(super) fn port_receives(&mut self, owner: AnyPort, bytes: &[u8]) {
        match owner {
            AnyPort::Gateway(port) if self.is_asleep() => {
                self.report_port_event(port, PortEvent::Bytes(bytes.to_vec()));
            }
            AnyPort::Gateway(port) => self.engine_input(Input::PortBytes { port, bytes }),
            AnyPort::Controller(port) => self.controller_input(ControllerInput::PortBytes { port, bytes }),
        }
    }

    pub(super) fn transmit_can(&mut self, bus: BusId, from: End, frame: CanFrame) {
        if let Some(at) = self.buses[bus.0].send(self.now, from, frame) {
            self.queue.push(at, Due::CanDone { bus });
        }
    }

    pub(super) fn can_done(&mut self, id: BusId) {
        let now = self.now;
        let bus = &mut self.buses[id.0];
        let owner = bus.owner;
        let Some(crossed) = bus.finish(now) else { return };
        let mut answers = Vec::new();
        match crossed.from {
            End::Device if crossed.arrives => match owner {
                AnyPort::Gateway(port) => self.report_port_event(port, PortEvent::Frame(crossed.frame)),
                AnyPort::Controller(port) => {
                    self.controller_input(ControllerInput::PortCan { port, frame: crossed.frame });
                }
            },
            End::Device => {}
            End::Port => {
                if let Some(device) = bus.device.as_mut().filter(|_| crossed.arrives) {
                    answers = device.receive(now, &crossed.frame);
                    self.bus_did(id);
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

    fn port_sent(&mut self, owner: AnyPort) {
        match owner {
            AnyPort::Gateway(port) => self.report_port_event(port, PortEvent::Sent),
            AnyPort::Controller(port) => self.controller_input(ControllerInput::PortSent { port }),
        }
    }

    pub(super) fn line_at(&self, owner: AnyPort) -> Option<LineId> {
        self.lines.iter().position(|line| line.owner == owner).map(LineId)
    }

    pub(super) fn bus_at(&self, owner: AnyPort) -> Option<BusId> {
        self.buses.iter().position(|bus| bus.owner == owner).map(BusId)
    }

    pub(super) fn port_input(&mut self, owner: AnyPort, is_up: bool) {
        if let (AnyPort::Gateway(_), Some(judge)) = (owner, &mut self.judge) {
            judge.port_begins(self.now);
        }
        match owner {
            AnyPort::Gateway(port) => {
                self.report_port_event(port, if is_up { PortEvent::Up } else { PortEvent::Down })
            }
            AnyPort::Controller(port) if is_up => self.controller_input(ControllerInput::PortUp { port }),
            AnyPort::Controller(port) => self.controller_input(ControllerInput::PortDown { port }),
        }
    }
}
