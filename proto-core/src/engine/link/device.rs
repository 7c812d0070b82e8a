//! The connection of a port of Modbus TCP to its devices: when it is opened, and when it is given up.
//!
//! In: what the driver reports of the link. Out: its port is there, or gone; bytes for the port. What travels on it is the
//! port's business.

use heapless::String;

use crate::config::{MAX_ADDRESS, Name};
use crate::engine::counters::{LinkCounters, bump};
use crate::engine::io::{LinkId, LinkKind, PortId, Transport};
use crate::link::{LinkTimings, Supervisor};
use crate::time::{Duration, Instant};

/// The minimum time in which a request must be acknowledged that is no event: peers acknowledge up to 200 ms late.
pub(crate) const PATIENCE: Duration = Duration::from_millis(250);

#[derive(Debug, Clone)]
pub(crate) struct DeviceLink {
    pub port: PortId,
    /// The name of the port.
    pub name: Name,
    pub host: String<MAX_ADDRESS>,
    tcp_port: u16,
    pub supervisor: Supervisor,
    pub counters: LinkCounters,
    /// When what was handed over must have arrived; [`Instant::NEVER`] if nothing is on its way.
    pub due_at: Instant,
}

impl DeviceLink {
    pub(crate) fn new(port: PortId, name: Name, host: String<MAX_ADDRESS>, tcp_port: u16) -> Self {
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

    pub(crate) const fn id(&self) -> LinkId {
        LinkId::of_port(self.port)
    }

    pub(crate) const fn kind(&self) -> LinkKind {
        LinkKind::ModbusDevice { port: self.port }
    }

    pub(crate) const fn transport(&self) -> Transport {
        Transport::Tcp { port: self.tcp_port }
    }

    /// Closes the connection, to open it again after a wait.
    pub(crate) fn give_up(&mut self, now: Instant) {
        self.supervisor.give_up(now);
        self.due_at = Instant::NEVER;
    }

    /// A request was handed over, to arrive by `until`.
    pub(crate) fn handed_over(&mut self, until: Instant) {
        bump(&mut self.counters.sent);
        self.due_at = self.due_at.min(until);
    }

    /// Handles the clock. What is not acknowledged in time must not arrive later.
    pub(crate) fn advance(&mut self, now: Instant) {
        if now >= self.due_at {
            bump(&mut self.counters.unacknowledged);
            self.give_up(now);
        }
        if self.supervisor.advance(now) {
            self.due_at = Instant::NEVER;
        }
    }

    /// When it has something to do without an input.
    pub(crate) fn deadline(&self) -> Instant {
        self.supervisor.deadline().min(self.due_at)
    }
}
