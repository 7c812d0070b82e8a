//! Port 2000: executes the commands of a connection one after the other, and answers each when it is done
//! (proto-core/docs/wire/command.md section 8, D25).
//!
//! A command that begins a transition is answered at the end of the transition. Until then, further commands of the
//! connection wait; other connections are served.

use std::collections::VecDeque;

use proto_core::command::{
    Action, ActionOutcome, CommandServer, MAX_COMMAND, Percent, Reply, Request, ServerEvent, StateCodes,
    UnknownCommand,
};
use proto_core::time::{Duration, Instant};
use proto_core::wire::dialect::{Dialect, RepeatReply};
use proto_core::wire::state::ProgramState;

use super::Link;
use crate::events::Happened;
use crate::machine::{ErrorId, Transition, TransitionProgress};
use crate::program;
use crate::{ConnId, Controller, ControllerOutput};

#[derive(Debug, Default)]
pub(super) struct Session {
    parser: CommandServer,
    /// Commands that wait for the answer to the previous one.
    waiting: VecDeque<(Command, EventText)>,
    pending: Option<Pending>,
    current: EventText,
}

/// A command's text, for events; `None` while events are not recorded.
type EventText = Option<String>;

/// A command that is answered at the end of its transition.
#[derive(Debug, Clone, Copy)]
struct Pending {
    transition: Transition,
    /// After this time, the command is answered with fail.
    until: Instant,
}

#[derive(Debug, Clone, PartialEq)]
enum Command {
    Run { program: String, speed: Option<Percent> },
    Speed(Option<Percent>),
    Do(Action),
    State,
    IsProgFinish,
    GetLastError,
    Unknown,
}

enum Next {
    Answer(Action, TransitionProgress),
    Execute(Command),
}

impl From<ServerEvent<'_>> for Command {
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
    /// When silence completes a command, or the time limit of a transition expires.
    pub(super) fn deadline(&self) -> Option<Instant> {
        let pending = self.pending.map(|pending| pending.until);
        [self.parser.deadline(), pending].into_iter().flatten().min()
    }
}

impl Controller {
    pub(crate) fn command_bytes(&mut self, now: Instant, conn: ConnId, bytes: &[u8]) {
        if self.server.command.contains_key(&conn) {
            self.counters.command.bytes_in += bytes.len() as u64;
        }
        let mut rest = bytes;
        // A command may close the connection.
        while let Some(session) = self.server.command.get_mut(&conn)
            && let Some(event) = session.parser.receive(now, &mut rest)
        {
            let text = self.recorder.is_on().then(|| text_of(&event, &self.dialect));
            let command = event.into();
            self.queue(now, conn, command, text);
        }
    }

    pub(super) fn poll_commands(&mut self, now: Instant) {
        let due = |session: &Session| session.parser.deadline().is_some_and(|deadline| now >= deadline);
        let sessions = self.server.command.iter();
        let ready: Vec<ConnId> =
            sessions.filter(|(_, session)| due(session)).map(|(&conn, _)| conn).collect();
        for conn in ready {
            while let Some(session) = self.server.command.get_mut(&conn)
                && let Some(event) = session.parser.poll(now)
            {
                let text = self.recorder.is_on().then(|| text_of(&event, &self.dialect));
                let command = event.into();
                self.queue(now, conn, command, text);
            }
        }
    }

    fn queue(&mut self, now: Instant, conn: ConnId, command: Command, text: EventText) {
        self.counters.command.requests += 1;
        if let Some(text) = &text {
            self.happened(now, || Happened::Command { client: conn.0, text: text.clone() });
        }
        if command != Command::Unknown {
            self.server.places.active(now, conn);
        }
        let Some(session) = self.server.command.get_mut(&conn) else { return };
        if session.waiting.len() >= MAX_ORDERS {
            self.counters.command.violations += 1;
            self.closed(now, Link::Command, conn);
            self.outputs.push_back(ControllerOutput::Close { conn });
            return;
        }
        session.waiting.push_back((command, text));
        self.settle(now);
    }

    /// Answers commands whose transitions have ended, and executes waiting commands. Call it after every change of the
    /// state machines.
    pub(crate) fn settle(&mut self, now: Instant) {
        self.note_states(now);
        while let Some((conn, step)) = self.next_step(now) {
            match step {
                Next::Execute(command) => self.execute(now, conn, command),
                Next::Answer(action, progress) => {
                    let outcome = match progress {
                        TransitionProgress::Done => ActionOutcome::Success,
                        TransitionProgress::Superseded => {
                            self.machine.not_completed(action, "another operation began before it was done");
                            ActionOutcome::Fail
                        }
                        TransitionProgress::InProgress => {
                            let why = format!("not done after {} s", MAX_TRANSITION.as_millis() / 1_000);
                            self.machine.not_completed(action, &why);
                            ActionOutcome::Fail
                        }
                    };
                    self.server.places.active(now, conn);
                    self.reply(now, conn, &Reply::Did { action, outcome });
                }
            }
            self.note_states(now);
        }
    }

    /// Ended transitions come first: a further command would supersede them.
    fn next_step(&mut self, now: Instant) -> Option<(ConnId, Next)> {
        for (&conn, session) in &mut self.server.command {
            let Some(Pending { transition, until }) = session.pending else { continue };
            let progress = self.machine.progress(transition);
            if progress != TransitionProgress::InProgress || now >= until {
                session.pending = None;
                return Some((conn, Next::Answer(transition.action(), progress)));
            }
        }
        let mut free = self.server.command.iter_mut().filter(|(_, session)| session.pending.is_none());
        free.find_map(|(&conn, session)| {
            let (command, text) = session.waiting.pop_front()?;
            session.current = text;
            Some((conn, Next::Execute(command)))
        })
    }

    fn execute(&mut self, now: Instant, conn: ConnId, command: Command) {
        match command {
            Command::Run { program, speed } => {
                let outcome = match self.run(now, Some(conn), &program, speed) {
                    Ok(()) => ActionOutcome::Success,
                    Err(_) => ActionOutcome::Fail,
                };
                self.reply(now, conn, &Reply::Run(outcome));
            }
            Command::Speed(speed) => {
                let reply = match self.machine.set_speed(speed) {
                    Ok(()) => Reply::SpeedSet(speed),
                    Err(_) => Reply::SpeedRefused,
                };
                self.speed_changed(now);
                self.reply(now, conn, &reply);
            }
            Command::Do(action)
                if self.dialect.repeat_reply == RepeatReply::Already && self.machine.is_already(action) =>
            {
                self.reply(now, conn, &Reply::Already(action));
            }
            Command::Do(action) => match self.act(now, action) {
                Ok(transition) => {
                    if let Some(session) = self.server.command.get_mut(&conn) {
                        session.pending = Some(Pending { transition, until: now + MAX_TRANSITION });
                    }
                }
                Err(_) => self.reply(now, conn, &Reply::Did { action, outcome: ActionOutcome::Fail }),
            },
            Command::State => {
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
            Command::IsProgFinish => {
                let finished = self.machine.program() == ProgramState::Stopped;
                self.reply(now, conn, &Reply::ProgramFinished(finished));
            }
            Command::GetLastError => {
                let (id, message) = match self.machine.error() {
                    Some(error) => (error.id.code(), error.message.clone()),
                    None => (0, "no error".to_owned()),
                };
                self.reply(now, conn, &Reply::LastError { id, message: message.as_bytes() });
            }
            Command::Unknown => self.reply(now, conn, &Reply::UnknownCommand),
        }
    }

    /// The command `run`. The program is looked up first, so a missing program is reported in every state.
    pub(crate) fn run(
        &mut self,
        now: Instant,
        asked_by: Option<ConnId>,
        name: &str,
        speed: Option<Percent>,
    ) -> Result<(), ErrorId> {
        let Some(script) = program::named(&self.scripts, name).cloned() else {
            self.machine.fail(ErrorId::NoSuchProgram, format!("run: there is no program {name}"));
            return Err(ErrorId::NoSuchProgram);
        };
        self.machine.check_run()?;
        if speed.is_some() {
            self.machine.set_speed(speed)?;
        }
        let by = if asked_by.is_some() { "command" } else { "function" };
        self.start_program(now, &script, asked_by, by)
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
                | Reply::Run(ActionOutcome::Fail)
                | Reply::Did { outcome: ActionOutcome::Fail, .. }
        );
        self.counters.command.refusals += u64::from(refused);
        let mut out = [0; MAX_REPLY];
        if let Ok(len) = reply.encode(&self.dialect, &mut out) {
            if self.recorder.is_on() {
                let text = String::from_utf8_lossy(out.get(..len).unwrap_or(&[])).trim_end().to_owned();
                let current = self.server.command.get(&conn).and_then(|session| session.current.clone());
                let to = current.filter(|_| *reply != Reply::ScriptFinish);
                self.happened(now, || Happened::Reply { client: conn.0, text, to });
            }
            self.send(now, Link::Command, conn, out.get(..len).unwrap_or(&[]).to_vec());
        }
    }
}

/// A command as text, without its terminator.
fn text_of(event: &ServerEvent<'_>, dialect: &Dialect) -> String {
    let mut out = [0; MAX_COMMAND];
    let bytes = match event {
        ServerEvent::Request(request) => {
            let len = request.encode(dialect, &mut out).unwrap_or(0);
            out.get(..len).unwrap_or(&[])
        }
        ServerEvent::Unknown(UnknownCommand::Text(bytes)) => bytes,
        ServerEvent::Unknown(_) => return "(too long)".to_owned(),
    };
    String::from_utf8_lossy(bytes).trim_end().to_owned()
}

/// Time limit of a transition: its command is answered with fail, and the transition continues.
const MAX_TRANSITION: Duration = Duration::from_secs(5);
/// Maximum number of waiting commands of a connection; a further command closes it.
pub const MAX_ORDERS: usize = 64;
/// Maximum length of a reply, with an error's text.
const MAX_REPLY: usize = 1_024;
