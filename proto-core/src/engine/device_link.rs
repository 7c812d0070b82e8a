//! The connection of a port of Modbus TCP to its devices: when it is opened, and when it is given up.
//!
//! In: what the driver reports of the link. Out: its port is there, or gone; bytes for the port. What travels on it is the
//! port's business.

use heapless::String;

use super::clock::Dirty;
use super::counters::{LinkCounters, add, bump};
use super::events::Event;
use super::field_port::find_port;
use super::io::{LinkId, LinkKind, PortId, Transport};
use super::turns::Cause;
use super::view::EngineView;
use crate::config::{MAX_ADDRESS, Name};
use crate::link::{LinkTimings, Supervisor};
use crate::time::{Duration, Instant};

/// The minimum time in which a request must be acknowledged that is no event: peers acknowledge up to 200 ms late.
const PATIENCE: Duration = Duration::from_millis(250);

#[derive(Debug, Clone)]
pub(super) struct DeviceLink {
    pub port: PortId,
    /// The name of the port.
    pub name: Name,
    pub host: String<MAX_ADDRESS>,
    tcp_port: u16,
    pub supervisor: Supervisor,
    pub counters: LinkCounters,
    /// When what was handed over must have arrived; [`Instant::NEVER`] if nothing is on its way.
    due_at: Instant,
}

impl DeviceLink {
    pub(super) fn new(port: PortId, name: Name, host: String<MAX_ADDRESS>, tcp_port: u16) -> Self {
        Self {
            port,
            name,
            host,
            tcp_port,
            supervisor: Supervisor::new(&LinkTimings::TCP),
            counters: LinkCounters::ZERO,
            due_at: Instant::NEVER,
        }
    }

    pub(super) const fn id(&self) -> LinkId {
        LinkId::of_port(self.port)
    }

    pub(super) const fn kind(&self) -> LinkKind {
        LinkKind::ModbusDevice { port: self.port }
    }

    pub(super) const fn transport(&self) -> Transport {
        Transport::Tcp { port: self.tcp_port }
    }

    /// Closes the connection, to open it again after a wait.
    pub(super) fn give_up(&mut self, now: Instant) {
        self.supervisor.give_up(now);
        self.due_at = Instant::NEVER;
    }

    /// A request was handed over, to arrive by `until`.
    fn handed_over(&mut self, until: Instant) {
        bump(&mut self.counters.sent);
        self.due_at = self.due_at.min(until);
    }

    /// Handles the clock. What is not acknowledged in time must not arrive later.
    pub(super) fn advance(&mut self, now: Instant) {
        if now >= self.due_at {
            bump(&mut self.counters.unacknowledged);
            self.give_up(now);
        }
        if self.supervisor.advance(now) {
            self.due_at = Instant::NEVER;
        }
    }

    /// When it has something to do without an input.
    pub(super) fn deadline(&self) -> Instant {
        self.supervisor.deadline().min(self.due_at)
    }
}

impl EngineView<'_> {
    /// The connection of a port of Modbus TCP, if the link is one.
    #[inline]
    pub(super) fn device_link(&mut self, id: LinkId) -> Option<&mut DeviceLink> {
        self.links.devices.iter_mut().find(|link| link.id() == id)
    }

    /// Whether a port's devices are at the other end of a connection.
    pub(super) fn has_connection(&self, port: PortId) -> bool {
        self.links.devices.iter().any(|link| link.port == port)
    }

    #[cold]
    #[inline(never)]
    pub(super) fn device_up(&mut self, id: LinkId) {
        let now = self.store.now;
        let Some(link) = self.device_link(id) else { return };
        link.supervisor.up(now);
        self.after_device(id, now);
    }

    #[cold]
    #[inline(never)]
    pub(super) fn device_down(&mut self, id: LinkId) {
        let now = self.store.now;
        let Some(link) = self.device_link(id) else { return };
        if link.supervisor.down(now) {
            link.due_at = Instant::NEVER;
        }
        self.after_device(id, now);
    }

    /// The transport has taken what was handed over.
    #[cold]
    #[inline(never)]
    pub(super) fn device_sent(&mut self, id: LinkId) {
        let Some(link) = self.device_link(id) else { return };
        let (port, is_up) = (link.port, link.supervisor.is_up());
        if is_up {
            self.port_sent(port);
        }
    }

    #[cold]
    #[inline(never)]
    pub(super) fn device_acked(&mut self, id: LinkId, left: u32) {
        let Some(link) = self.device_link(id) else { return };
        if left == 0 {
            link.due_at = Instant::NEVER;
        }
    }

    /// Bytes of a connection that is up; those of one that was given up are nobody's.
    #[cold]
    #[inline(never)]
    pub(super) fn device_bytes(&mut self, id: LinkId, bytes: &[u8], now: Instant) {
        let Some(link) = self.device_link(id).filter(|link| link.supervisor.is_up()) else { return };
        link.supervisor.heard(now);
        add(&mut link.counters.bytes_in, bytes.len());
        let port = link.port;
        self.exchange_bytes(port, bytes, now);
        let line = find_port(self.ports, port).and_then(|port| port.line_mut());
        let is_lost = line.and_then(|line| line.transactions.as_ref()).is_some_and(|all| all.is_lost);
        if is_lost && let Some(link) = self.device_link(id) {
            bump(&mut link.counters.malformed);
            link.give_up(now);
            self.after_device(id, now);
        }
    }

    /// Notes a request that was handed over to a port's connection; false if the port is on a bus of its own.
    pub(super) fn goes_over_link(&mut self, id: PortId, now: Instant) -> bool {
        if self.links.devices.is_empty() {
            return false;
        }
        let Some(port) = find_port(self.ports, id) else { return false };
        let mut view = self.exchanges.view();
        let until = port.line().and_then(|line| {
            let flight = line.flight()?;
            let item = view.of(line).0.get(usize::from(flight.exchange))?;
            Some(match item.event {
                Event::Sent { until, .. } if flight.cause == Cause::Event => until,
                _ => now + item.times.timeout.max(PATIENCE),
            })
        });
        let Some(link) = self.device_link(LinkId::of_port(id)) else { return false };
        link.handed_over(until.unwrap_or(now));
        self.after_device(LinkId::of_port(id), now);
        true
    }

    fn after_device(&mut self, id: LinkId, now: Instant) {
        self.carry_connections(now);
        self.clock.dirty.add(Dirty::ACTIONS);
        if let Some(link) = self.device_link(id) {
            let deadline = link.deadline();
            self.arm(deadline);
        }
    }

    /// Handles the clock.
    #[cold]
    #[inline(never)]
    pub(super) fn advance_connections(&mut self, now: Instant) {
        self.links.devices.iter_mut().for_each(|link| link.advance(now));
        self.carry_connections(now);
    }

    /// A port is there while its connection is.
    #[inline(never)]
    fn carry_connections(&mut self, now: Instant) {
        for nth in 0..self.links.devices.len() {
            let Some(link) = self.links.devices.get(nth) else { break };
            let (id, is_up) = (link.port, link.supervisor.is_up());
            let was_up = find_port(self.ports, id).is_some_and(|port| port.is_up);
            match (was_up, is_up) {
                (false, true) => self.port_up(id),
                (true, false) => self.port_down(id, now),
                _ => {}
            }
        }
    }
}
