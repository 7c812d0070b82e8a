//! The connection of a Modbus TCP port to its devices: when to open it, and when to give it up.
//!
//! In: what the driver reports about the link. Out: whether its port is up; bytes for the port. Does not know what
//! travels on it.

use heapless::String;

use crate::config::{MAX_ADDRESS, Name};
use crate::engine::counters::{LinkCounters, bump};
use crate::engine::io::{LinkId, LinkKind, PortId, Transport};
use crate::link::{LinkTimings, Supervisor};
use crate::time::{Duration, Instant};

/// The minimum time in which a request that is no event must be acknowledged: peers acknowledge up to 200 ms late.
pub(crate) const PATIENCE: Duration = Duration::from_millis(250);

#[derive(Debug, Clone)]
pub(crate) struct DeviceLink {
    pub port: PortId,
    pub name: Name,
    pub host: String<MAX_ADDRESS>,
    tcp_port: u16,
    pub supervisor: Supervisor,
    pub counters: LinkCounters,
    /// When everything handed over must have arrived; [`Instant::NEVER`] if nothing is in flight.
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

    /// Closes the connection and reopens it after a wait.
    pub(crate) fn give_up(&mut self, now: Instant) {
        self.supervisor.give_up(now);
        self.due_at = Instant::NEVER;
    }

    /// A request was handed over; it must arrive by `until`.
    pub(crate) fn handed_over(&mut self, until: Instant) {
        bump(&mut self.counters.sent);
        self.due_at = self.due_at.min(until);
    }

    /// Handles what is due. What is not acknowledged in time must not arrive later.
    pub(crate) fn advance(&mut self, now: Instant) {
        if now >= self.due_at {
            bump(&mut self.counters.unacknowledged);
            self.give_up(now);
        }
        if self.supervisor.advance(now) {
            self.due_at = Instant::NEVER;
        }
    }

    pub(crate) fn deadline(&self) -> Instant {
        self.supervisor.deadline().min(self.due_at)
    }
}
