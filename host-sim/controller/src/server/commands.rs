//! Port 2000: commands are carried out one after the other, and answered when they are done
//! (proto-core/docs/wire/command.md section 8, D25).
//!
//! A command that begins a transition is answered at its end. What else comes on the connection
//! meanwhile waits for that; other connections are served.

use std::collections::VecDeque;

use proto_core::command::{Action, CommandServer, Outcome, Percent, Reply, Request, ServerEvent, StateCodes};
use proto_core::time::{Duration, Instant};
use proto_core::wire::state::ProgramState;

use super::Link;
use crate::machine::{ErrorId, Progress, Transition};
use crate::program::Script;
use crate::{ConnId, Controller, ControllerOutput};

/// A connection of port 2000.
#[derive(Debug, Default)]
pub(super) struct Session {
    parser: CommandServer,
    /// Commands behind the one that is not answered yet.
    orders: VecDeque<Order>,
    awaited: Option<Awaited>,
}

/// A command that is answered when its transition is over.
#[derive(Debug, Clone, Copy)]
struct Awaited {
    transition: Transition,
    until: Instant,
}

/// A command, whole.
#[derive(Debug, Clone, PartialEq)]
enum Order {
    Run { program: String, speed: Option<Percent> },
    Speed(Option<Percent>),
    Do(Action),
    State,
    IsProgFinish,
    GetLastError,
    Unknown,
}

/// What a connection is to do next.
enum Turn {
    Answer(Action, Progress),
    CarryOut(Order),
}

impl From<ServerEvent<'_>> for Order {
    fn from(event: ServerEvent<'_>) -> Self {
        match event {
            ServerEvent::Request(Request::Run { program, speed }) => {
                Self::Run { program: program.to_owned(), speed }
            }
            ServerEvent::Request(Request::Speed(speed)) => Self::Speed(speed),
            ServerEvent::Request(Request::Do(action)) => Self::Do(action),
            ServerEvent::Request(Request::State) => Self::State,
            ServerEvent::Request(Request::IsProgFinish) => Self::IsProgFinish,
            ServerEvent::Request(Request::GetLastError) => Self::GetLastError,
            ServerEvent::Unknown(_) => Self::Unknown,
        }
    }
}

impl Session {
    /// When silence completes a command, or the patience with a transition ends.
    pub(super) fn deadline(&self) -> Option<Instant> {
        let awaited = self.awaited.map(|awaited| awaited.until);
        [self.parser.deadline(), awaited].into_iter().flatten().min()
    }
}

impl Controller {
    pub(crate) fn command_bytes(&mut self, now: Instant, conn: ConnId, bytes: &[u8]) {
        if self.server.command.contains_key(&conn) {
            self.counters.command.bytes_in += bytes.len() as u64;
        }
        let mut rest = bytes;
        // Carrying one out may end the connection.
        while let Some(session) = self.server.command.get_mut(&conn)
            && let Some(event) = session.parser.receive(now, &mut rest)
        {
            let order = event.into();
            self.take(now, conn, order);
        }
    }

    /// What silence completes.
    pub(super) fn poll_commands(&mut self, now: Instant) {
        let due = |session: &Session| session.parser.deadline().is_some_and(|deadline| now >= deadline);
        let sessions = self.server.command.iter();
        let ready: Vec<ConnId> =
            sessions.filter(|(_, session)| due(session)).map(|(&conn, _)| conn).collect();
        for conn in ready {
            while let Some(session) = self.server.command.get_mut(&conn)
                && let Some(event) = session.parser.poll(now)
            {
                let order = event.into();
                self.take(now, conn, order);
            }
        }
    }

    fn take(&mut self, now: Instant, conn: ConnId, order: Order) {
        self.counters.command.requests += 1;
        if order != Order::Unknown {
            self.server.places.asked(now, conn);
        }
        let Some(session) = self.server.command.get_mut(&conn) else { return };
        if session.orders.len() >= MAX_ORDERS {
            self.counters.command.violations += 1;
            self.closed(Link::Command, conn);
            self.outputs.push_back(ControllerOutput::Close { conn });
            return;
        }
        session.orders.push_back(order);
        self.settle(now);
    }

    /// Answers the commands whose transitions are over and carries out what waited for that. To be
    /// called after everything that happens to the state machines.
    pub(crate) fn settle(&mut self, now: Instant) {
        while let Some((conn, turn)) = self.next_turn(now) {
            match turn {
                Turn::CarryOut(order) => self.carry_out(now, conn, order),
                Turn::Answer(action, progress) => {
                    let outcome = match progress {
                        Progress::Done => Outcome::Success,
                        Progress::BrokenOff => {
                            self.machine.not_completed(action, "another operation began before it was done");
                            Outcome::Fail
                        }
                        Progress::UnderWay => {
                            let why = format!("not done after {} s", LIMIT.as_millis() / 1_000);
                            self.machine.not_completed(action, &why);
                            Outcome::Fail
                        }
                    };
                    self.server.places.asked(now, conn);
                    self.reply(now, conn, &Reply::Did { action, outcome });
                }
            }
        }
    }

    /// First those that are over, so that none is looked at too late.
    fn next_turn(&mut self, now: Instant) -> Option<(ConnId, Turn)> {
        for (&conn, session) in &mut self.server.command {
            let Some(Awaited { transition, until }) = session.awaited else { continue };
            let progress = self.machine.progress(transition);
            if progress != Progress::UnderWay || now >= until {
                session.awaited = None;
                return Some((conn, Turn::Answer(transition.action(), progress)));
            }
        }
        let mut free = self.server.command.iter_mut().filter(|(_, session)| session.awaited.is_none());
        free.find_map(|(&conn, session)| Some((conn, Turn::CarryOut(session.orders.pop_front()?))))
    }

    fn carry_out(&mut self, now: Instant, conn: ConnId, order: Order) {
        match order {
            Order::Run { program, speed } => {
                let outcome = match self.run(now, conn, &program, speed) {
                    Ok(()) => Outcome::Success,
                    Err(_) => Outcome::Fail,
                };
                self.reply(now, conn, &Reply::Run(outcome));
            }
            Order::Speed(speed) => {
                let reply = match self.machine.set_speed(speed) {
                    Ok(()) => Reply::SpeedSet(speed),
                    Err(_) => Reply::SpeedRefused,
                };
                self.speed_changed(now);
                self.reply(now, conn, &reply);
            }
            Order::Do(action) => match self.machine.act(now, action) {
                Ok((effect, transition)) => {
                    self.apply(now, effect);
                    if let Some(session) = self.server.command.get_mut(&conn) {
                        session.awaited = Some(Awaited { transition, until: now + LIMIT });
                    }
                }
                Err(_) => self.reply(now, conn, &Reply::Did { action, outcome: Outcome::Fail }),
            },
            Order::State => {
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
            Order::IsProgFinish => {
                let finished = self.machine.program() == ProgramState::Stopped;
                self.reply(now, conn, &Reply::ProgramFinished(finished));
            }
            Order::GetLastError => {
                let (id, message) = match self.machine.error() {
                    Some(error) => (error.id.code(), error.message.clone()),
                    None => (0, "no error".to_owned()),
                };
                self.reply(now, conn, &Reply::LastError { id, message: message.as_bytes() });
            }
            Order::Unknown => self.reply(now, conn, &Reply::UnknownCommand),
        }
    }

    /// `run`: the program is found first, so that its absence is reported in every state.
    fn run(&mut self, now: Instant, conn: ConnId, name: &str, speed: Option<Percent>) -> Result<(), ErrorId> {
        let Some(script) = self.script_named(name) else {
            self.machine.fail(ErrorId::NoSuchProgram, format!("run: there is no program {name}"));
            return Err(ErrorId::NoSuchProgram);
        };
        self.machine.check_run()?;
        if speed.is_some() {
            self.machine.set_speed(speed)?;
        }
        self.start_program(now, &script, conn)
    }

    /// A program by its name as configured, or by the last part of a path.
    fn script_named(&self, name: &str) -> Option<Script> {
        let base = name.rsplit('/').next().unwrap_or(name);
        let by = |wanted: &str| self.scripts.iter().find(|script| script.name() == wanted);
        by(name).or_else(|| by(base)).cloned()
    }

    pub(crate) fn send_finish_notice(&mut self, now: Instant, conn: ConnId) {
        if self.server.command.contains_key(&conn) {
            self.reply(now, conn, &Reply::ScriptFinish);
        }
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
}

/// A transition that takes longer is answered with fail, and goes on.
const LIMIT: Duration = Duration::from_secs(5);
/// Most commands of a connection behind one that is not answered yet; the connection ends with one more.
pub const MAX_ORDERS: usize = 64;
/// Longest reply, the error's text included.
const MAX_REPLY: usize = 1_024;
