//! The controller's TCP servers and its UDP server (docs/simulated-controller.md section 5).
//!
//! The number of connections is bounded; a further connection is closed at once and counted. A reply is sent as a
//! whole; the runtime sends it as fast as the connection accepts it.

mod commands;
mod displacement;

use std::collections::{BTreeMap, BTreeSet, VecDeque};
use std::net::{IpAddr, SocketAddr};

use proto_core::modbus::adu::MAX_ADU;
use proto_core::modbus::server::{RegisterBank, Server as ModbusServer};
use proto_core::modbus::{Coils, Exception, Registers as Words};
use proto_core::time::Instant;

use super::common::Link;
use super::events::{Before, Recorder};
use super::faults::CommandClients;
use super::registers::Registers;
use super::{ConnId, Controller, ControllerCounters, ControllerOutput, ServerCounters};
pub use commands::MAX_ORDERS;
use commands::Session;
use displacement::ClientActivities;

/// Maximum number of clients of port 2000.
pub const MAX_COMMAND_CONNECTIONS: usize = 32;
/// Maximum number of clients of port 2001.
pub const MAX_STATE_CONNECTIONS: usize = 32;
/// Maximum number of Modbus clients.
pub const MAX_MODBUS_CONNECTIONS: usize = 128;
/// Maximum number of replies that a fault delays; further replies are dropped.
const MAX_DELAYED: usize = 1_024;

#[derive(Debug, Default)]
pub(super) struct Server {
    command: BTreeMap<ConnId, Box<Session>>,
    state: BTreeSet<ConnId>,
    modbus: BTreeMap<ConnId, Box<ModbusServer>>,
    delayed: VecDeque<(Instant, ConnId, Vec<u8>)>,
    places: ClientActivities,
}

impl Server {
    pub(super) fn has_subscribers(&self) -> bool {
        !self.state.is_empty()
    }

    pub(super) fn deadline(&self) -> Option<Instant> {
        let commands = self.command.values().filter_map(|session| session.deadline());
        commands.chain(self.delayed.iter().map(|delayed| delayed.0)).min()
    }

    fn close_link(&mut self, link: Link, outputs: &mut VecDeque<ControllerOutput>) -> Vec<ConnId> {
        let conns: Vec<ConnId> = match link {
            Link::Command => std::mem::take(&mut self.command).into_keys().collect(),
            Link::State => std::mem::take(&mut self.state).into_iter().collect(),
            Link::Modbus => std::mem::take(&mut self.modbus).into_keys().collect(),
        };
        self.delayed.retain(|delayed| !conns.contains(&delayed.1));
        conns.iter().for_each(|&conn| self.places.closed(conn));
        outputs.extend(conns.iter().map(|&conn| ControllerOutput::Close { conn }));
        conns
    }

    pub(super) fn open(&self, link: Link) -> usize {
        match link {
            Link::Command => self.command.len(),
            Link::State => self.state.len(),
            Link::Modbus => self.modbus.len(),
        }
    }
}

impl ControllerCounters {
    fn of(&mut self, link: Link) -> &mut ServerCounters {
        match link {
            Link::Command => &mut self.command,
            Link::State => &mut self.state,
            Link::Modbus => &mut self.modbus,
        }
    }
}

impl Controller {
    pub(super) fn opened(&mut self, now: Instant, link: Link, conn: ConnId, from: IpAddr) {
        if self.faults.refuses(link) || !self.displace(now, link, from) {
            self.counters.of(link).refused += 1;
            self.outputs.push_back(ControllerOutput::Close { conn });
            return;
        }
        self.server.places.opened(now, link, conn, from);
        match link {
            Link::Command => {
                self.server.command.insert(conn, Box::default());
            }
            Link::State => {
                self.server.state.insert(conn);
            }
            Link::Modbus => {
                self.server.modbus.insert(conn, Box::new(ModbusServer::new()));
            }
        }
        self.counters.of(link).opened += 1;
        self.client_event(now, link, conn, true);
    }

    pub(super) fn close_clients(&mut self, link: Link) {
        let now = self.recorder.now();
        for conn in self.server.close_link(link, &mut self.outputs) {
            self.client_event(now, link, conn, false);
        }
    }

    pub(super) fn close_all_clients(&mut self) {
        for link in [Link::Command, Link::State, Link::Modbus] {
            self.close_clients(link);
        }
    }

    /// Whether a further client is accepted. Another client may be disconnected for it.
    fn displace(&mut self, now: Instant, link: Link, from: IpAddr) -> bool {
        let open = self.server.open(link);
        match (link, self.faults.command_clients()) {
            (Link::Command, CommandClients::RefuseSecond) => return open == 0,
            (Link::Command, CommandClients::DropFirst) => {
                self.counters.command.displaced += open as u64;
                self.close_clients(link);
                return true;
            }
            _ => {}
        }
        let max = match link {
            Link::Command => MAX_COMMAND_CONNECTIONS,
            Link::State => MAX_STATE_CONNECTIONS,
            Link::Modbus => MAX_MODBUS_CONNECTIONS,
        };
        if open < max {
            return true;
        }
        let Some(displaced) = self.server.places.to_displace(now, link, from, max) else { return false };
        self.counters.of(link).displaced += 1;
        self.closed(now, link, displaced);
        self.outputs.push_back(ControllerOutput::Close { conn: displaced });
        true
    }

    pub(super) fn closed(&mut self, now: Instant, link: Link, conn: ConnId) {
        let was_open = match link {
            Link::Command => self.server.command.remove(&conn).is_some(),
            Link::State => self.server.state.remove(&conn),
            Link::Modbus => self.server.modbus.remove(&conn).is_some(),
        };
        if was_open {
            self.client_event(now, link, conn, false);
        }
        self.server.delayed.retain(|delayed| delayed.1 != conn);
        self.server.places.closed(conn);
    }

    /// Answers the requests in these bytes. Returns the values before the first write, if there was a write and writes
    /// are recorded.
    pub(super) fn modbus_bytes(
        &mut self,
        now: Instant,
        conn: ConnId,
        bytes: &[u8],
    ) -> (Option<Before>, Requested) {
        let Some(session) = self.server.modbus.get_mut(&conn) else { return (None, Requested::Nothing) };
        let counters = &mut self.counters.modbus;
        counters.bytes_in += bytes.len() as u64;
        let mut bank = FaultyBank {
            registers: &mut self.registers,
            exception: self.faults.exception(),
            recorder: &self.recorder,
            before: None,
            has_written: false,
        };
        let mut rest = bytes;
        let mut answer = [0; MAX_ADU];
        let mut answers = Vec::new();
        let mut violated = false;
        let before_these = counters.requests;
        while let Some(result) = session.receive(&mut rest, &mut bank, &mut answer) {
            let Ok(len) = result else {
                violated = true;
                break;
            };
            counters.requests += 1;
            // The function code follows the seven bytes of the header.
            counters.refusals += u64::from(answer[7] & 0x80 != 0);
            answers.extend_from_slice(answer.get(..len).unwrap_or(&[]));
        }
        let (before, has_written) = (bank.before, bank.has_written);
        if counters.requests != before_these {
            self.server.places.active(now, conn);
            self.registers.were_read();
        }
        let sent = if answers.is_empty() {
            ResponseTiming::Now
        } else {
            self.send(now, Link::Modbus, conn, answers)
        };
        if violated {
            self.counters.modbus.violations += 1;
            self.closed(now, Link::Modbus, conn);
            self.outputs.push_back(ControllerOutput::Close { conn });
        }
        let changes = has_written || violated || sent == ResponseTiming::Later;
        (before, if changes { Requested::Changes } else { Requested::Nothing })
    }

    pub(super) fn udp_bytes(&mut self, now: Instant, peer: SocketAddr, bytes: &[u8]) {
        let listening = self.listening();
        match self.ports.iter_mut().find(|port| port.is_udp_server()) {
            Some(port) => {
                port.client_sent(now, peer);
                port.receive(now, bytes, &mut self.registers, listening);
            }
            None => self.counters.stray_datagrams += 1,
        }
    }

    /// Handles commands completed by silence, transitions that take too long, and delayed answers.
    pub(super) fn poll_server(&mut self, now: Instant) {
        self.poll_commands(now);
        self.settle(now);
        while let Some(nth) = self.server.delayed.iter().position(|delayed| now >= delayed.0) {
            if let Some((_, conn, bytes)) = self.server.delayed.remove(nth) {
                self.outputs.push_back(ControllerOutput::Send { conn, bytes });
            }
        }
    }

    pub(super) fn send_cut_packet(&mut self, bytes: &[u8]) {
        for &conn in &self.server.state {
            self.outputs.push_back(ControllerOutput::Send { conn, bytes: bytes.to_vec() });
        }
        self.close_clients(Link::State);
    }

    fn send(&mut self, now: Instant, link: Link, conn: ConnId, mut bytes: Vec<u8>) -> ResponseTiming {
        self.faults.corrupt_bytes(link, &mut bytes);
        let counters = self.counters.of(link);
        if self.faults.mutes(link) {
            counters.muted += 1;
            return ResponseTiming::Never;
        }
        counters.bytes_out += bytes.len() as u64;
        // Replies on a connection stay in order.
        let earlier = self.server.delayed.iter().rev().find(|delayed| delayed.1 == conn);
        let due = (now + self.faults.delay(link)).max(earlier.map_or(now, |delayed| delayed.0));
        if due <= now && earlier.is_none() {
            // Replies to requests that arrived together are sent together.
            match self.outputs.back_mut() {
                Some(ControllerOutput::Send { conn: last, bytes: waiting })
                    if *last == conn && waiting.len() < MAX_JOINED =>
                {
                    waiting.extend_from_slice(&bytes);
                }
                _ => self.outputs.push_back(ControllerOutput::Send { conn, bytes }),
            }
            ResponseTiming::Now
        } else if self.server.delayed.len() < MAX_DELAYED {
            self.server.delayed.push_back((due, conn, bytes));
            ResponseTiming::Later
        } else {
            counters.muted += 1;
            ResponseTiming::Never
        }
    }
}

/// The effect of Modbus requests, besides their replies.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Requested {
    Nothing,
    /// [`Controller::advance`] may have something to do.
    Changes,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum ResponseTiming {
    Now,
    Later,
    Never,
}

/// The registers, or the exception that a fault demands.
struct FaultyBank<'a> {
    registers: &'a mut Registers,
    exception: Option<Exception>,
    recorder: &'a Recorder,
    /// The values before the first write.
    before: Option<Before>,
    has_written: bool,
}

impl FaultyBank<'_> {
    fn check(&self) -> Result<(), Exception> {
        self.exception.map_or(Ok(()), Err)
    }

    fn note_before(&mut self) {
        self.has_written = true;
        if self.before.is_none() {
            self.before = self.recorder.before(self.registers);
        }
    }
}

impl RegisterBank for FaultyBank<'_> {
    fn read_coils(&self, address: u16, count: u16, packed: &mut [u8]) -> Result<(), Exception> {
        self.check()?;
        self.registers.read_coils(address, count, packed)
    }

    fn write_coils(&mut self, address: u16, coils: Coils<'_>) -> Result<(), Exception> {
        self.check()?;
        self.note_before();
        self.registers.write_coils(address, coils)
    }

    fn read_holding(&self, address: u16, words: &mut [[u8; 2]]) -> Result<(), Exception> {
        self.check()?;
        self.registers.read_holding(address, words)
    }

    fn write_holding(&mut self, address: u16, registers: Words<'_>) -> Result<(), Exception> {
        self.check()?;
        self.note_before();
        self.registers.write_holding(address, registers)
    }
}

/// Maximum number of bytes, approximately, up to which replies are joined.
const MAX_JOINED: usize = 4_096;
