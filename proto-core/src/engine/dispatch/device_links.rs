//! Link inputs of connections to devices: a Modbus TCP port is up while its connection is.

use super::EngineView;
use crate::engine::clock::Dirty;
use crate::engine::counters::{add, bump};
use crate::engine::field::event::Event;
use crate::engine::field::port::find_port;
use crate::engine::field::turns::Cause;
use crate::engine::io::{LinkId, PortId};
use crate::engine::link::device::{DeviceLink, PATIENCE};
use crate::time::Instant;

impl EngineView<'_> {
    /// The connection to devices with this id, if there is one.
    pub(crate) fn device_link(&mut self, id: LinkId) -> Option<&mut DeviceLink> {
        self.links.devices.iter_mut().find(|link| link.id() == id)
    }

    /// Whether a port reaches its devices over a connection.
    pub(crate) fn has_connection(&self, port: PortId) -> bool {
        self.links.devices.iter().any(|link| link.port == port)
    }

    pub(crate) fn device_up(&mut self, id: LinkId) {
        let now = self.store.now;
        let Some(link) = self.device_link(id) else { return };
        link.supervisor.up(now);
        self.after_device(id, now);
    }

    pub(crate) fn device_down(&mut self, id: LinkId) {
        let now = self.store.now;
        let Some(link) = self.device_link(id) else { return };
        if link.supervisor.down(now) {
            link.due_at = Instant::NEVER;
        }
        self.after_device(id, now);
    }

    /// The transport has taken what was handed over.
    pub(crate) fn device_sent(&mut self, id: LinkId) {
        let Some(link) = self.device_link(id) else { return };
        let (port, is_up) = (link.port, link.supervisor.is_up());
        if is_up {
            self.port_sent(port);
        }
    }

    pub(crate) fn device_acked(&mut self, id: LinkId, left: u32) {
        let Some(link) = self.device_link(id) else { return };
        if left == 0 {
            link.due_at = Instant::NEVER;
        }
    }

    /// Takes bytes of a connection that is up. Bytes of a connection that was given up are ignored.
    pub(crate) fn device_bytes(&mut self, id: LinkId, bytes: &[u8], now: Instant) {
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

    /// Notes a request that was handed over to a port's connection; false if the port has none.
    pub(crate) fn goes_over_link(&mut self, id: PortId, now: Instant) -> bool {
        if self.links.devices.is_empty() {
            return false;
        }
        let Some(port) = find_port(self.ports, id) else { return false };
        let mut view = self.exchanges.view();
        let until = port.line().and_then(|line| {
            let flight = line.flight()?;
            let (items, table) = view.of(line);
            let nth = usize::from(flight.exchange);
            let (item, row) = (items.get(nth)?, table.rows.get(nth)?);
            Some(match item.event {
                Event::Sent { until, .. } if flight.cause == Cause::Event => until,
                _ => now + row.timeout().max(PATIENCE),
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

    pub(crate) fn advance_connections(&mut self, now: Instant) {
        self.links.devices.iter_mut().for_each(|link| link.advance(now));
        self.carry_connections(now);
    }

    /// Brings ports up and down with their connections.
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
