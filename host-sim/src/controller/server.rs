//! The controller's TCP servers and its UDP server: connections in, answers out.
//!
//! Every number of connections is bounded; one too many is closed at once and counted. An answer
//! is handed over whole, for the shell to send as the connection takes it.

use std::collections::{BTreeMap, BTreeSet, VecDeque};
use std::net::SocketAddr;

use proto_core::command::{CommandServer, Outcome, Reply, Request, ServerEvent, StateCodes};
use proto_core::modbus::adu::MAX_ADU;
use proto_core::modbus::server::{RegisterBank, Server as ModbusServer};
use proto_core::modbus::{Coils, Exception, Registers as Words};
use proto_core::time::{Duration, Instant};
use proto_core::wire::state::ProgramState;

use super::faults::Link;
use super::machine::ErrorId;
use super::program::Script;
use super::registers::Registers;
use super::{ConnId, Controller, ControllerOutput, Counters, ServerCounters};

/// Most clients of port 2000 at a time.
pub const MAX_COMMAND_CONNECTIONS: usize = 32;
/// Most clients of port 2001 at a time.
pub const MAX_STATE_CONNECTIONS: usize = 32;
/// Most Modbus clients at a time.
pub const MAX_MODBUS_CONNECTIONS: usize = 128;
/// A connection that has asked for nothing for this long makes room when there are too many.
const NOVICE: Duration = Duration::from_secs(5);
/// Most delayed answers at a time, when a test asked for delays; further ones get lost.
const MAX_DELAYED: usize = 1_024;

/// The connections.
#[derive(Debug, Default)]
pub(super) struct Server {
    command: BTreeMap<ConnId, Box<CommandServer>>,
    state: BTreeSet<ConnId>,
    modbus: BTreeMap<ConnId, Box<ModbusServer>>,
    delayed: VecDeque<(Instant, ConnId, Vec<u8>)>,
    /// Connections of port 2000 and Modbus that have never asked for anything whole, and since when they are
    /// there: a host that only holds them must not keep out those that have something to ask.
    novices: BTreeMap<ConnId, (Link, Instant)>,
}

impl Server {
    pub(super) fn has_subscribers(&self) -> bool {
        !self.state.is_empty()
    }

    pub(super) fn deadline(&self) -> Option<Instant> {
        let commands = self.command.values().filter_map(|session| session.deadline());
        commands.chain(self.delayed.iter().map(|delayed| delayed.0)).min()
    }

    pub(super) fn close_link(&mut self, link: Link, outputs: &mut VecDeque<ControllerOutput>) {
        let conns: Vec<ConnId> = match link {
            Link::Command => std::mem::take(&mut self.command).into_keys().collect(),
            Link::State => std::mem::take(&mut self.state).into_iter().collect(),
            Link::Modbus => std::mem::take(&mut self.modbus).into_keys().collect(),
        };
        self.delayed.retain(|delayed| !conns.contains(&delayed.1));
        self.novices.retain(|_, novice| novice.0 != link);
        outputs.extend(conns.into_iter().map(|conn| ControllerOutput::Close { conn }));
    }

    pub(super) fn close_all(&mut self, outputs: &mut VecDeque<ControllerOutput>) {
        for link in [Link::Command, Link::State, Link::Modbus] {
            self.close_link(link, outputs);
        }
    }

    /// The connection that has been there longest without ever asking for anything.
    fn oldest_novice(&self, link: Link, now: Instant) -> Option<ConnId> {
        let novices = self.novices.iter().filter(|(_, novice)| novice.0 == link);
        let (&conn, &(_, since)) = novices.min_by_key(|(_, novice)| novice.1)?;
        (now.saturating_since(since) >= NOVICE).then_some(conn)
    }

    /// How many connections a server has.
    pub(super) fn open(&self, link: Link) -> usize {
        match link {
            Link::Command => self.command.len(),
            Link::State => self.state.len(),
            Link::Modbus => self.modbus.len(),
        }
    }
}

impl Counters {
    fn of(&mut self, link: Link) -> &mut ServerCounters {
        match link {
            Link::Command => &mut self.command,
            Link::State => &mut self.state,
            Link::Modbus => &mut self.modbus,
        }
    }
}

impl Controller {
    pub(super) fn opened(&mut self, now: Instant, link: Link, conn: ConnId) {
        let most = match link {
            Link::Command => MAX_COMMAND_CONNECTIONS,
            Link::State => MAX_STATE_CONNECTIONS,
            Link::Modbus => MAX_MODBUS_CONNECTIONS,
        };
        let full = self.server.open(link) >= most;
        let gives = self.server.oldest_novice(link, now).filter(|_| full);
        if self.faults.refuses(link) || full && gives.is_none() {
            self.counters.of(link).refused += 1;
            self.outputs.push_back(ControllerOutput::Close { conn });
            return;
        }
        if let Some(novice) = gives {
            self.counters.of(link).displaced += 1;
            self.closed(link, novice);
            self.outputs.push_back(ControllerOutput::Close { conn: novice });
        }
        if link != Link::State {
            self.server.novices.insert(conn, (link, now));
        }
        match link {
            Link::Command => {
                self.server.command.insert(conn, Box::new(CommandServer::new()));
            }
            Link::State => {
                self.server.state.insert(conn);
            }
            Link::Modbus => {
                self.server.modbus.insert(conn, Box::new(ModbusServer::new()));
            }
        }
        self.counters.of(link).opened += 1;
    }

    pub(super) fn closed(&mut self, link: Link, conn: ConnId) {
        match link {
            Link::Command => {
                self.server.command.remove(&conn);
            }
            Link::State => {
                self.server.state.remove(&conn);
            }
            Link::Modbus => {
                self.server.modbus.remove(&conn);
            }
        }
        self.server.delayed.retain(|delayed| delayed.1 != conn);
        self.server.novices.remove(&conn);
    }

    pub(super) fn command_bytes(&mut self, now: Instant, conn: ConnId, bytes: &[u8]) {
        // Taken out while its requests are carried out, which may touch everything else.
        let Some(mut session) = self.server.command.remove(&conn) else { return };
        self.counters.command.bytes_in += bytes.len() as u64;
        let mut rest = bytes;
        while let Some(event) = session.receive(now, &mut rest) {
            self.command_event(now, conn, event);
        }
        self.server.command.insert(conn, session);
    }

    pub(super) fn modbus_bytes(&mut self, now: Instant, conn: ConnId, bytes: &[u8]) {
        let Some(session) = self.server.modbus.get_mut(&conn) else { return };
        let counters = &mut self.counters.modbus;
        counters.bytes_in += bytes.len() as u64;
        let mut bank = Bank { registers: &mut self.registers, exception: self.faults.exception() };
        let mut rest = bytes;
        let mut answer = [0; MAX_ADU];
        let mut answers = Vec::new();
        let mut violated = false;
        while let Some(result) = session.receive(&mut rest, &mut bank, &mut answer) {
            let Ok(len) = result else {
                violated = true;
                break;
            };
            self.server.novices.remove(&conn);
            counters.requests += 1;
            // The function code follows the seven bytes of the header.
            counters.refusals += u64::from(answer[7] & 0x80 != 0);
            answers.extend_from_slice(answer.get(..len).unwrap_or(&[]));
        }
        if !answers.is_empty() {
            self.send(now, Link::Modbus, conn, answers);
        }
        if violated {
            self.counters.modbus.violations += 1;
            self.closed(Link::Modbus, conn);
            self.outputs.push_back(ControllerOutput::Close { conn });
        }
    }

    pub(super) fn udp_bytes(&mut self, now: Instant, peer: SocketAddr, bytes: &[u8]) {
        let listening = self.listening();
        match self.ports.iter_mut().find(|port| port.is_udp_server()) {
            Some(port) => {
                port.heard(now, peer);
                port.receive(now, bytes, &mut self.registers, listening);
            }
            None => self.counters.stray_datagrams += 1,
        }
    }

    /// What silence completes, and answers that were held back.
    pub(super) fn poll_server(&mut self, now: Instant) {
        let due = |deadline: Option<Instant>| deadline.is_some_and(|deadline| now >= deadline);
        let ready: Vec<ConnId> = {
            let sessions = self.server.command.iter();
            sessions.filter(|(_, session)| due(session.deadline())).map(|(&conn, _)| conn).collect()
        };
        for conn in ready {
            let Some(mut session) = self.server.command.remove(&conn) else { continue };
            while let Some(event) = session.poll(now) {
                self.command_event(now, conn, event);
            }
            self.server.command.insert(conn, session);
        }
        while let Some(nth) = self.server.delayed.iter().position(|delayed| now >= delayed.0) {
            if let Some((_, conn, bytes)) = self.server.delayed.remove(nth) {
                self.outputs.push_back(ControllerOutput::Send { conn, bytes });
            }
        }
    }

    pub(super) fn send_finish_notice(&mut self, now: Instant, conn: ConnId) {
        if self.server.command.contains_key(&conn) {
            self.reply(now, conn, &Reply::ScriptFinish);
        }
    }

    pub(super) fn send_cut_packet(&mut self, bytes: &[u8]) {
        for &conn in &self.server.state {
            self.outputs.push_back(ControllerOutput::Send { conn, bytes: bytes.to_vec() });
        }
        self.server.close_link(Link::State, &mut self.outputs);
    }

    fn command_event(&mut self, now: Instant, conn: ConnId, event: ServerEvent<'_>) {
        self.counters.command.requests += 1;
        match event {
            ServerEvent::Request(request) => {
                self.server.novices.remove(&conn);
                self.carry_out(now, conn, request);
            }
            ServerEvent::Unknown(_) => self.reply(now, conn, &Reply::UnknownCommand),
        }
    }

    fn carry_out(&mut self, now: Instant, conn: ConnId, request: Request<'_>) {
        let outcome = |result: Result<(), ErrorId>| match result {
            Ok(()) => Outcome::Success,
            Err(_) => Outcome::Fail,
        };
        match request {
            Request::Run { program, speed } => {
                let result = self.run(now, conn, program, speed.map(|speed| speed.value()));
                self.reply(now, conn, &Reply::Run(outcome(result)));
            }
            Request::Speed(speed) => {
                let reply = match self.machine.set_speed(speed) {
                    Ok(()) => Reply::SpeedSet(speed),
                    Err(_) => Reply::SpeedRefused,
                };
                self.speed_changed(now);
                self.reply(now, conn, &reply);
            }
            Request::Do(action) => {
                let result = self.machine.act(now, action);
                let effect = result.map(|effect| self.apply(now, effect));
                self.reply(now, conn, &Reply::Did { action, outcome: outcome(effect) });
            }
            Request::State => {
                let machine = &self.machine;
                let codes = StateCodes::new(
                    &self.dialect,
                    machine.robot(),
                    machine.program(),
                    machine.safety(),
                    machine.mode(),
                );
                self.reply(now, conn, &Reply::State(codes));
            }
            Request::IsProgFinish => {
                let finished = self.machine.program() == ProgramState::Stopped;
                self.reply(now, conn, &Reply::ProgramFinished(finished));
            }
            Request::GetLastError => {
                let (id, message) = match self.machine.error() {
                    Some(error) => (error.id.code(), error.message.clone()),
                    None => (0, "no error".to_owned()),
                };
                self.reply(now, conn, &Reply::LastError { id, message: message.as_bytes() });
            }
        }
    }

    /// `run`: the program is found first, so that its absence is reported in every state.
    fn run(&mut self, now: Instant, conn: ConnId, name: &str, speed: Option<f32>) -> Result<(), ErrorId> {
        let Some(script) = self.script_named(name) else {
            self.machine.fail(ErrorId::NoSuchProgram, format!("run: there is no program {name}"));
            return Err(ErrorId::NoSuchProgram);
        };
        self.machine.check_run()?;
        if let Some(speed) = speed {
            self.machine.set_speed(proto_core::command::Percent::new(speed))?;
        }
        self.start_program(now, &script, conn)
    }

    /// A program by its name as configured, or by the last part of a path.
    fn script_named(&self, name: &str) -> Option<Script> {
        let base = name.rsplit('/').next().unwrap_or(name);
        let by = |wanted: &str| self.scripts.iter().find(|script| script.name() == wanted);
        by(name).or_else(|| by(base)).cloned()
    }

    fn reply(&mut self, now: Instant, conn: ConnId, reply: &Reply<'_>) {
        let refused = matches!(
            reply,
            Reply::UnknownCommand
                | Reply::SpeedRefused
                | Reply::Run(Outcome::Fail)
                | Reply::Did { outcome: Outcome::Fail, .. }
        );
        self.counters.command.refusals += u64::from(refused);
        let mut out = [0; MAX_REPLY];
        if let Ok(len) = reply.encode(&self.dialect, &mut out) {
            self.send(now, Link::Command, conn, out.get(..len).unwrap_or(&[]).to_vec());
        }
    }

    fn send(&mut self, now: Instant, link: Link, conn: ConnId, bytes: Vec<u8>) {
        let counters = self.counters.of(link);
        if self.faults.mutes(link) {
            counters.muted += 1;
            return;
        }
        counters.bytes_out += bytes.len() as u64;
        // An answer never overtakes an earlier one of its connection.
        let earlier = self.server.delayed.iter().rev().find(|delayed| delayed.1 == conn);
        let due = (now + self.faults.delay(link)).max(earlier.map_or(now, |delayed| delayed.0));
        if due <= now && earlier.is_none() {
            // Answers to requests that came together leave together.
            match self.outputs.back_mut() {
                Some(ControllerOutput::Send { conn: last, bytes: waiting })
                    if *last == conn && waiting.len() < MAX_JOINED =>
                {
                    waiting.extend_from_slice(&bytes);
                }
                _ => self.outputs.push_back(ControllerOutput::Send { conn, bytes }),
            }
        } else if self.server.delayed.len() < MAX_DELAYED {
            self.server.delayed.push_back((due, conn, bytes));
        } else {
            counters.muted += 1;
        }
    }
}

/// The registers, or the exception that a test wants.
struct Bank<'a> {
    registers: &'a mut Registers,
    exception: Option<Exception>,
}

impl Bank<'_> {
    fn check(&self) -> Result<(), Exception> {
        self.exception.map_or(Ok(()), Err)
    }
}

impl RegisterBank for Bank<'_> {
    fn read_coils(&self, address: u16, count: u16, packed: &mut [u8]) -> Result<(), Exception> {
        self.check()?;
        self.registers.read_coils(address, count, packed)
    }

    fn write_coils(&mut self, address: u16, coils: Coils<'_>) -> Result<(), Exception> {
        self.check()?;
        self.registers.write_coils(address, coils)
    }

    fn read_holding(&self, address: u16, words: &mut [[u8; 2]]) -> Result<(), Exception> {
        self.check()?;
        self.registers.read_holding(address, words)
    }

    fn write_holding(&mut self, address: u16, registers: Words<'_>) -> Result<(), Exception> {
        self.check()?;
        self.registers.write_holding(address, registers)
    }
}

/// Answers are joined up to about this many bytes.
const MAX_JOINED: usize = 4_096;
/// Longest reply, the error's text included.
const MAX_REPLY: usize = 1_024;
