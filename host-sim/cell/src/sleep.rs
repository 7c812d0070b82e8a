//! A gateway that is not called for a while: its process was stopped, or its machine was busy or
//! suspended. Everything else continues, and input for it waits where a kernel keeps it.
//!
//! Bounds: 4 KiB per line, 256 frames per bus, 256 datagrams per link; more is lost. Connections
//! lose nothing: what does not fit stays with the sender. The kernel continues to send, acknowledge
//! and repeat what was handed over before.

use proto_core::engine::{BusState, Input, LinkId, PortId};
use proto_core::time::Duration;
use proto_core::wire::can::CanFrame;

use super::due::Due;
use super::network::Way;
use super::{Cell, What};

/// Events that wait for the gateway.
#[derive(Debug, Default)]
pub(super) struct Waiting {
    /// Of several stalls that overlap, only the one that ends last wakes it.
    turn: u64,
    ports: Vec<(PortId, Told)>,
    links: Vec<Due>,
}

/// An event of a port.
#[derive(Debug)]
pub(super) enum Told {
    Up,
    Down,
    Sent,
    Bus(BusState),
    Bytes(Vec<u8>),
    Frame(CanFrame),
}

impl Cell {
    /// The gateway is not called for this long; then it gets everything that waits, and then a
    /// tick. If it sleeps already, it sleeps longer.
    pub fn stall_gateway(&mut self, span: Duration) {
        self.trace.add(self.now, What::Fault, super::Entry::GATEWAY, &span.as_micros().to_le_bytes());
        self.stalls += 1;
        let turn = self.stalls;
        self.asleep.get_or_insert_default().turn = turn;
        self.wakes_at = self.wakes_at.max(self.now + span);
        self.queue.push(self.wakes_at, Due::Wake { turn });
        if let Some(oracle) = &mut self.oracle {
            oracle.stalled(self.wakes_at, self.now);
        }
    }

    /// It is called again now.
    pub fn wake_gateway(&mut self) {
        if let Some(turn) = self.asleep.as_ref().map(|waiting| waiting.turn) {
            self.wakes_at = self.now;
            self.queue.push(self.now, Due::Wake { turn });
        }
    }

    /// Whether the gateway is not called at present.
    pub fn is_asleep(&self) -> bool {
        self.asleep.is_some()
    }

    /// It is called again.
    pub(super) fn wake(&mut self, turn: u64) {
        if self.asleep.as_ref().is_none_or(|waiting| waiting.turn != turn) {
            return;
        }
        let Some(Waiting { ports, links, .. }) = self.asleep.take() else { return };
        self.disturb(None);
        // A driver reads its sources in any order.
        if self.rng.below(2) == 0 {
            self.tell_ports(ports);
            self.tell_links(links);
        } else {
            self.tell_links(links);
            self.tell_ports(ports);
        }
        self.engine_input(Input::Tick);
    }

    /// Its process has ended: waiting events are gone.
    pub(super) fn forget_waiting(&mut self) {
        self.asleep = None;
        self.wakes_at = self.now;
    }

    fn tell_ports(&mut self, waiting: Vec<(PortId, Told)>) {
        for (port, told) in waiting {
            self.engine_input(match &told {
                Told::Up => Input::PortUp { port },
                Told::Down => Input::PortDown { port },
                Told::Sent => Input::PortSent { port },
                Told::Bus(state) => Input::PortBus { port, state: *state },
                Told::Bytes(bytes) => Input::PortBytes { port, bytes },
                Told::Frame(frame) => Input::PortCan { port, frame: *frame },
            });
        }
    }

    fn tell_links(&mut self, waiting: Vec<Due>) {
        for due in waiting {
            self.carry_out(due);
        }
        let conns: Vec<u64> = self.gates.values().filter_map(|gate| gate.conn).collect();
        for conn in conns {
            self.arrive(conn, Way::Down);
        }
        let links: Vec<LinkId> = self.gates.keys().copied().collect();
        for link in links {
            self.tell_acked(link);
        }
    }

    /// A port has an event for the gateway.
    pub(super) fn tell_of_port(&mut self, port: PortId, told: Told) {
        match &mut self.asleep {
            Some(waiting) => waiting.keep(port, told),
            None => self.tell_ports(vec![(port, told)]),
        }
    }

    /// An event of a link waits, if it must.
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
        if link.is_none() || waiting.links.iter().filter(is_of).count() < MOST_DATAGRAMS {
            waiting.links.push(due);
        }
        None
    }
}

impl Waiting {
    fn keep(&mut self, port: PortId, told: Told) {
        let mut of_port = self.ports.iter_mut().filter(|(of, _)| *of == port).map(|(_, told)| told);
        match told {
            Told::Bytes(mut bytes) => {
                if let Some(Told::Bytes(waiting)) = of_port.next_back() {
                    bytes.truncate(LINE_BUFFER.saturating_sub(waiting.len()));
                    waiting.append(&mut bytes);
                } else {
                    bytes.truncate(LINE_BUFFER);
                    self.ports.push((port, Told::Bytes(bytes)));
                }
            }
            Told::Frame(_)
                if of_port.filter(|told| matches!(told, Told::Frame(_))).count() >= MOST_FRAMES => {}
            told => self.ports.push((port, told)),
        }
    }
}

/// Bytes of a line that a kernel keeps.
const LINE_BUFFER: usize = 4_096;
/// Frames of a bus that it keeps.
const MOST_FRAMES: usize = 256;
/// Datagrams of a socket that it keeps.
const MOST_DATAGRAMS: usize = 256;
