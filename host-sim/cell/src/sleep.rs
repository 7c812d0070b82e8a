//! A gateway that is not called for a while: its process is stopped, or its machine is busy or suspended. Everything
//! else goes on, and its input waits in buffers like those of a kernel.
//!
//! The buffers hold 4 KiB per line, 256 frames per bus and 256 datagrams per link; more is lost. Connections lose
//! nothing: data stays with the sender. The kernel still sends, acknowledges and retransmits what was sent before.

use proto_core::engine::{BusState, Input, LinkId, PortId};
use proto_core::time::Duration;
use proto_core::wire::can::CanFrame;

use super::due::Due;
use super::network::Way;
use super::{Cell, What};

/// Events that wait for the gateway.
#[derive(Debug, Default)]
pub(super) struct Waiting {
    /// Number of the stall. If several overlap, only the newest one wakes the gateway.
    generation: u64,
    ports: Vec<(PortId, PortEvent)>,
    links: Vec<Due>,
}

/// An event of a port.
#[derive(Debug)]
pub(super) enum PortEvent {
    Up,
    Down,
    Sent,
    Bus(BusState),
    Bytes(Vec<u8>),
    Frame(CanFrame),
}

impl Cell {
    /// Stops calling the gateway for this long. After that it gets everything that waits, and a tick. Called during a
    /// stall, it prolongs the stall.
    pub fn stall_gateway(&mut self, span: Duration) {
        self.trace.add(self.now, What::Fault, super::Entry::GATEWAY, &span.as_micros().to_le_bytes());
        self.stalls += 1;
        let generation = self.stalls;
        self.asleep.get_or_insert_default().generation = generation;
        self.wakes_at = self.wakes_at.max(self.now + span);
        self.queue.push(self.wakes_at, Due::Wake { generation });
        if let Some(judge) = &mut self.judge {
            judge.not_called(self.now);
        }
        if let Some(oracle) = &mut self.oracle {
            oracle.stalled(self.wakes_at, self.now);
        }
    }

    /// Ends a stall now.
    pub fn wake_gateway(&mut self) {
        if let Some(generation) = self.asleep.as_ref().map(|waiting| waiting.generation) {
            self.wakes_at = self.now;
            self.queue.push(self.now, Due::Wake { generation });
        }
    }

    /// Whether the gateway is not called at present.
    pub fn is_asleep(&self) -> bool {
        self.asleep.is_some()
    }

    /// Ends a stall, if it is still the newest one.
    pub(super) fn wake(&mut self, generation: u64) {
        if self.asleep.as_ref().is_none_or(|waiting| waiting.generation != generation) {
            return;
        }
        let Some(Waiting { ports, links, .. }) = self.asleep.take() else { return };
        self.note_fault(None);
        if let Some(judge) = &mut self.judge {
            judge.gateway_wakes(self.now);
        }
        // A driver may read its sources in any order.
        if self.rng.below(2) == 0 {
            self.report_port_events(ports);
            self.report_link_events(links);
        } else {
            self.report_link_events(links);
            self.report_port_events(ports);
        }
        self.engine_input(Input::Tick);
    }

    /// The gateway's process has ended: waiting events are lost.
    pub(super) fn forget_waiting(&mut self) {
        self.asleep = None;
        self.wakes_at = self.now;
    }

    fn report_port_events(&mut self, waiting: Vec<(PortId, PortEvent)>) {
        for (port, event) in waiting {
            self.engine_input(event.input(port));
        }
    }

    fn report_link_events(&mut self, waiting: Vec<Due>) {
        for due in waiting {
            self.execute(due);
        }
        let conns: Vec<u64> = self.gates.values().filter_map(|gate| gate.conn).collect();
        for conn in conns {
            self.arrive(conn, Way::Down);
        }
        let links: Vec<LinkId> = self.gates.keys().copied().collect();
        for link in links {
            self.report_acked(link);
        }
    }

    /// Reports an event of a port, now or after the stall.
    pub(super) fn report_port_event(&mut self, port: PortId, event: PortEvent) {
        match &mut self.asleep {
            Some(waiting) => waiting.keep(port, event),
            None => self.engine_input(event.input(port)),
        }
    }

    /// Keeps an event of a link until the stall ends; returns it if it can be handled now.
    pub(super) fn keep_for_later(&mut self, due: Due) -> Option<Due> {
        let Some(waiting) = &mut self.asleep else { return Some(due) };
        let link = match &due {
            Due::LinkUp { .. } | Due::LinkDown { .. } | Due::LinkSent { .. } => None,
            Due::DatagramDown { link, .. } | Due::ClientDatagramDown { link, .. } => Some(*link),
            _ => return Some(due),
        };
        let is_of = |due: &&Due| match due {
            Due::DatagramDown { link: of, .. } | Due::ClientDatagramDown { link: of, .. } => {
                Some(*of) == link
            }
            _ => false,
        };
        if link.is_none() || waiting.links.iter().filter(is_of).count() < MAX_DATAGRAMS {
            waiting.links.push(due);
        }
        None
    }
}

impl PortEvent {
    fn input(&self, port: PortId) -> Input<'_> {
        match self {
            Self::Up => Input::PortUp { port },
            Self::Down => Input::PortDown { port },
            Self::Sent => Input::PortSent { port },
            Self::Bus(state) => Input::PortBus { port, state: *state },
            Self::Bytes(bytes) => Input::PortBytes { port, bytes },
            Self::Frame(frame) => Input::PortCan { port, frame: *frame },
        }
    }
}

impl Waiting {
    fn keep(&mut self, port: PortId, event: PortEvent) {
        let mut of_port = self.ports.iter_mut().filter(|(of, _)| *of == port).map(|(_, event)| event);
        match event {
            PortEvent::Bytes(mut bytes) => {
                if let Some(PortEvent::Bytes(waiting)) = of_port.next_back() {
                    bytes.truncate(LINE_BUFFER.saturating_sub(waiting.len()));
                    waiting.append(&mut bytes);
                } else {
                    bytes.truncate(LINE_BUFFER);
                    self.ports.push((port, PortEvent::Bytes(bytes)));
                }
            }
            PortEvent::Frame(_)
                if of_port.filter(|event| matches!(event, PortEvent::Frame(_))).count() >= MAX_FRAMES => {}
            event => self.ports.push((port, event)),
        }
    }
}

/// Number of bytes that a kernel buffers for a line.
const LINE_BUFFER: usize = 4_096;
/// Number of frames that a kernel buffers for a bus.
const MAX_FRAMES: usize = 256;
/// Number of datagrams that a kernel buffers for a socket.
const MAX_DATAGRAMS: usize = 256;
