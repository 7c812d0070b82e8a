//! The links to port 2000: commands that field values pick (docs/engine.md section 7).
//!
//! A command is sent once or not at all. A command that cannot be sent soon is dropped, and the port's reply code
//! ([`Outcomes`]) says so: a robot must not start late because a button was pressed earlier. A command that stops the
//! robot has its own connection, goes ahead of everything, and is not dropped while its device asks for it.

use heapless::{Deque, Vec};

use super::command_tables::{CommandField, Entry, Picked, Tables, is_asked};
use super::dropped::{DropReason, DroppedCommand};
use super::failed::FailedCommands;
use super::other_text::OtherText;
use super::outcome::Outcomes;
use super::session::{Event, Sent, Session, may_go_at};
use super::stops::{COMMAND_QUEUE, STOP_TTL, Stops, Waiting};
use crate::command::Keyword;
use crate::config::{CommandEntry, CommandText, CommandWhen, MAX_PORTS, Span, fill_in};
use crate::engine::io::{LinkId, PortId, ReplyCode, Transport};
use crate::engine::values::withheld::MAX_COMMAND_FIELDS;
use crate::link::LinkState;
use crate::time::{Duration, Instant};
use crate::wire::dialect::Dialect;
use crate::wire::scalar::Scalar;

/// A command that is not acknowledged this long after it was picked is dropped.
const COMMAND_TTL: Duration = Duration::from_secs(1);
/// Two losses of the second connection within this time mean that the controller accepts only one (D26).
const LOST_AGAIN_WITHIN: Duration = Duration::from_secs(10);
/// A lost connection normally reopens within this time; until then no other is given up for a stop.
const OPEN_AGAIN: Duration = Duration::from_millis(500);
/// Replies that arrive within this time may make room for a stop that was just picked.
const ROOM_WITHIN: Duration = Duration::from_millis(20);
/// A second loss within this time has the same cause as the first.
const TOGETHER: Duration = Duration::from_secs(1);

#[derive(Debug, Clone)]
pub(crate) struct CommandLink {
    /// The connection for all commands; `urgent`: the one for urgent commands only.
    pub ordinary: Session,
    pub urgent: Option<Session>,
    port: u16,
    dialect: Dialect,
    tables: Tables,
    fields: Vec<CommandField, MAX_COMMAND_FIELDS>,
    queue: Deque<Waiting, COMMAND_QUEUE>,
    stops: Stops,
    /// The frame being applied has picked an urgent command.
    stops_now: bool,
    /// Number of commands at the front of the queue that an urgent command has overtaken.
    overtaken: usize,
    /// When the second connection was last lost, or the first because of it.
    second_lost_at: Option<Instant>,
    /// Until then no connection is given up for a stop that cannot be sent.
    no_reopening_until: Instant,
    /// The newest command that each port's values picked, and the value.
    picked: [Option<(u16, i64)>; MAX_PORTS],
    /// The newest value of each port that gave no command.
    dropped: [Option<DroppedCommand>; MAX_PORTS],
    /// Commands that the controller replied to with a failure.
    pub failed: FailedCommands,
    /// Results of commands that the engine has not taken yet.
    pub outcomes: Outcomes,
}

impl CommandLink {
    /// `None` if the command texts are too long in total.
    pub(crate) fn new(port: u16, dialect: Dialect, entries: &[CommandEntry]) -> Option<Self> {
        let tables = Tables::new(entries)?;
        let stops = tables.has_urgent();
        Some(Self {
            ordinary: Session::new(),
            urgent: stops.then(Session::new),
            port,
            dialect,
            tables,
            fields: Vec::new(),
            queue: Deque::new(),
            stops: Stops::new(),
            stops_now: false,
            overtaken: 0,
            second_lost_at: None,
            no_reopening_until: Instant::ZERO,
            picked: [None; MAX_PORTS],
            dropped: [None; MAX_PORTS],
            failed: FailedCommands::NONE,
            outcomes: Outcomes::new(),
        })
    }

    /// The text of the newest command that a port's values picked.
    pub(crate) fn newest_of(&self, port: PortId) -> Option<CommandText<'_>> {
        let (entry, value) = (*self.picked.get(usize::from(port.0))?)?;
        self.text(entry, value)
    }

    /// The newest text on a connection that was not recognized as a reply.
    pub(crate) fn other_text_of<'a>(&'a self, session: &'a Session) -> Option<OtherText<'a>> {
        let last = session.last_text.as_ref()?;
        let command = last.entry.and_then(|entry| self.text(entry, last.value));
        Some(OtherText { at: last.at, text: &last.text, command })
    }

    pub(crate) fn text(&self, entry: u16, value: i64) -> Option<CommandText<'_>> {
        self.tables.entry(entry).map(|(_, text)| CommandText { text, value })
    }

    /// The newest value of a port that gave no command.
    pub(crate) fn dropped_by(&self, port: PortId) -> Option<&DroppedCommand> {
        self.dropped.get(usize::from(port.0))?.as_ref()
    }

    pub(crate) fn transport(&self) -> Transport {
        Transport::Tcp { port: self.port }
    }

    /// Adds a field and returns its index; `None` if there are too many.
    pub(crate) fn add_field(&mut self, table: Span, when: CommandWhen, place: (u8, u8)) -> Option<u8> {
        let index = self.fields.len() as u8;
        let names_idle = self.tables.names_idle(table);
        self.fields.push(CommandField { table, when, last: None, place, woke: false, names_idle }).ok()?;
        Some(index)
    }

    /// Takes the value of a command field in an accepted frame. A picked command becomes `port`'s `nth`; the result
    /// says whether it waits or is not sent. [`Self::frame_ends`] and [`Self::drop_overtaken`] follow.
    pub(crate) fn value(
        &mut self,
        field: u8,
        value: Scalar,
        (port, nth): (PortId, u32),
        now: Instant,
    ) -> Picked {
        let Some(place) = self.fields.get_mut(usize::from(field)) else { return Picked::Nothing };
        // Only integer fields can be bound to a table.
        let value = value.as_f64() as i64;
        let before = place.last.replace(value);
        let woke = core::mem::take(&mut place.woke);
        let CommandField { table, when, names_idle, .. } = *place;
        let changed = before.is_some_and(|before| before != value);
        if changed {
            self.stops.no_longer_asked(field, now);
        }
        let acts = when == CommandWhen::Frame || changed;
        if !acts && before.is_some() {
            return Picked::Nothing;
        }
        let Some((entry, &Entry { keyword, len, .. })) = self.tables.find(table, value) else {
            if value == 0 && !names_idle {
                return Picked::Nothing;
            }
            self.note_dropped(port, DropReason::Unknown, (field, value), now);
            return Picked::Unknown;
        };
        if len == 0 {
            return Picked::Nothing;
        }
        // The press of a stop button may be among the input discarded after sleep; an extra stop does no harm.
        let is_held_stop = woke && keyword.is_urgent();
        if !acts && !is_held_stop {
            self.note_dropped(port, DropReason::Based, (field, value), now);
            return Picked::Based;
        }
        let mut waiting = Waiting { port, entry, field, value, since: now, nth };
        if keyword.is_urgent() {
            self.is_newest(&waiting);
            self.stops_now = true;
            self.stops.push(keyword, waiting);
            self.no_reopening_before(now + ROOM_WITHIN);
            return Picked::Command { reply: ReplyCode::Pending, is_dropped: false };
        }
        if self.stops_now {
            // Whatever the order of the fields, the port reports the result of the stop.
            self.stops.stays_newest(port, nth);
            waiting.nth = nth.wrapping_sub(1);
        } else {
            self.is_newest(&waiting);
        }
        let why = match self.ordinary.supervisor.is_up() {
            true => self.queue.push_back(waiting).err().map(|_| DropReason::QueueFull),
            false => Some(DropReason::NoLink),
        };
        if let Some(why) = why {
            self.note_dropped(port, why, (field, value), now);
        }
        let is_dropped = why.is_some();
        let reply = if is_dropped && !self.stops_now { ReplyCode::NotSent } else { ReplyCode::Pending };
        Picked::Command { reply, is_dropped }
    }

    /// Notes the newest command that its port's values picked.
    fn is_newest(&mut self, command: &Waiting) {
        if let Some(newest) = self.picked.get_mut(usize::from(command.port.0)) {
            *newest = Some((command.entry, command.value));
        }
    }

    /// Notes why a value gave no command.
    fn note_dropped(&mut self, port: PortId, why: DropReason, (field, value): (u8, i64), now: Instant) {
        let place = self.fields.get(usize::from(field)).map_or((0, 0), |field| field.place);
        if let Some(last) = self.dropped.get_mut(usize::from(port.0)) {
            *last = Some(DroppedCommand { at: now, why, frame: place.0, field: place.1, value });
        }
    }

    fn drop_command(&mut self, command: Waiting, why: DropReason, now: Instant) {
        self.note_dropped(command.port, why, (command.field, command.value), now);
        self.outcomes.push(command, ReplyCode::NotSent);
    }

    /// Drops all waiting commands that are not urgent.
    fn drop_queue(&mut self, why: DropReason, now: Instant) {
        while let Some(waiting) = self.queue.pop_front() {
            self.drop_command(waiting, why, now);
        }
    }

    /// All fields of a frame have been handled: an urgent command overtakes the others whatever their order.
    pub(crate) fn frame_ends(&mut self) {
        if core::mem::take(&mut self.stops_now) {
            self.overtaken = self.queue.len();
        }
    }

    /// Drops the commands that an urgent command has overtaken.
    pub(crate) fn drop_overtaken(&mut self, now: Instant) {
        for _ in 0..core::mem::take(&mut self.overtaken) {
            if let Some(waiting) = self.queue.pop_front() {
                self.drop_command(waiting, DropReason::Overtaken, now);
            }
        }
    }

    /// The field's frame is overdue. [`Self::drop_commands_of_gone`] follows.
    pub(crate) fn silent(&mut self, field: u8, now: Instant) {
        self.lose_base(field, now, CommandField::silent);
    }

    /// The field's device is gone. [`Self::drop_commands_of_gone`] follows.
    pub(crate) fn forget(&mut self, field: u8, now: Instant) {
        self.lose_base(field, now, CommandField::forget);
    }

    fn lose_base(&mut self, field: u8, now: Instant, lose: impl FnOnce(&mut CommandField) -> bool) {
        if self.fields.get_mut(usize::from(field)).is_some_and(lose) {
            self.stops.no_longer_asked(field, now);
        }
    }

    /// Drops the waiting commands of devices that are gone.
    pub(crate) fn drop_commands_of_gone(&mut self, now: Instant) {
        for _ in 0..self.queue.len() {
            let Some(waiting) = self.queue.pop_front() else { return };
            let is_there = self.fields.get(usize::from(waiting.field)).is_some_and(|f| f.last.is_some());
            // Cannot fail: the queue has just lost one.
            if !is_there || self.queue.push_back(waiting).is_err() {
                self.drop_command(waiting, DropReason::DeviceGone, now);
            }
        }
    }

    pub(crate) fn up(&mut self, link: LinkId, now: Instant) {
        if let Some(session) = self.session(link) {
            session.supervisor.up(now);
        }
    }

    /// The driver reports that a connection is lost or could not be opened.
    pub(crate) fn down(&mut self, link: LinkId, now: Instant) {
        let ordinary = self.ordinary.supervisor.state();
        let urgent = self.urgent.as_ref().map(|session| session.supervisor.state());
        let Some(session) = self.session(link) else { return };
        if session.supervisor.down(now) {
            self.lost(link, now);
        }
        match (link, ordinary, urgent) {
            (
                LinkId::URGENT,
                LinkState::Up { .. },
                Some(LinkState::Opening { .. } | LinkState::Up { .. }),
            ) => {
                self.second_connection_lost(now);
            }
            (LinkId::COMMAND, LinkState::Up { .. }, Some(LinkState::Up { since }))
                if now.saturating_since(since) <= TOGETHER =>
            {
                self.second_connection_lost(now);
            }
            // Both were lost together, which says nothing about the second one.
            (LinkId::COMMAND, LinkState::Up { .. }, _) | (LinkId::URGENT, _, Some(LinkState::Up { .. })) => {
                self.second_lost_at = self.second_lost_at.filter(|&at| now.saturating_since(at) > TOGETHER);
            }
            (LinkId::COMMAND, LinkState::Opening { .. }, _) => self.was_away(now),
            _ => {}
        }
    }

    /// The second connection was lost, or the first because of it.
    fn second_connection_lost(&mut self, now: Instant) {
        let Some(urgent) = &mut self.urgent else { return };
        let again = self.second_lost_at.is_some_and(|at| now.saturating_since(at) <= LOST_AGAIN_WITHIN);
        self.second_lost_at = Some(now);
        if again {
            urgent.supervisor.share(now);
            self.lost(LinkId::URGENT, now);
        }
    }

    /// The controller was away: it may have been replaced by another one.
    fn was_away(&mut self, now: Instant) {
        self.second_lost_at = None;
        if let Some(urgent) = &mut self.urgent {
            urgent.supervisor.unshare(now);
        }
    }

    /// A connection is gone: what waited for it is not sent later, except a stop that its device still asks for.
    fn lost(&mut self, link: LinkId, now: Instant) {
        let Some(session) = self.session(link) else { return };
        let [first, beside] = session.lost();
        if first.is_some() {
            self.no_reopening_before(now + OPEN_AGAIN);
        }
        // Of two commands of the same kind the newer one is sent again, because its result is the one shown.
        for sent in [beside, first].into_iter().flatten() {
            if sent.has_text {
                // The command has arrived; sending it again would give the same reply.
                self.outcomes.push(sent.command, ReplyCode::Other);
            } else if sent.keyword.is_urgent() && is_asked(&self.fields, &sent.command) {
                self.stops.push_again(sent.keyword, Waiting { since: now, ..sent.command });
            } else {
                self.outcomes.push(sent.command, ReplyCode::NoReply);
            }
        }
        if link == LinkId::COMMAND {
            self.drop_queue(DropReason::NoLink, now);
        }
    }

    fn no_reopening_before(&mut self, at: Instant) {
        self.no_reopening_until = self.no_reopening_until.max(at);
    }

    /// The gateway itself slept: drops commands picked before. The next value picks a stop again if the device still
    /// asks for it.
    pub(crate) fn slept(&mut self, now: Instant) {
        self.fields.iter_mut().for_each(CommandField::slept);
        self.drop_queue(DropReason::Asleep, now);
        for link in [LinkId::COMMAND, LinkId::URGENT] {
            if let Some(session) = self.session(link) {
                session.supervisor.give_up(now);
            }
            self.lost(link, now);
        }
        while let Some((_, waiting)) = self.stops.pop(|_| true) {
            self.drop_command(waiting, DropReason::Asleep, now);
        }
    }

    pub(crate) fn sent(&mut self, link: LinkId) {
        if let Some(session) = self.session(link) {
            session.taken();
        }
    }

    pub(crate) fn acked(&mut self, link: LinkId, left: u32) {
        if let Some(session) = self.session(link) {
            session.acked(left);
        }
    }

    /// Notes bytes that arrived on a connection. Returns whether it is up.
    pub(crate) fn heard(&mut self, link: LinkId, len: usize, now: Instant) -> bool {
        let session = self.session(link).filter(|session| session.supervisor.is_up());
        session.map(|session| session.heard(len, now)).is_some()
    }

    /// Takes replies from the controller.
    pub(crate) fn received(&mut self, link: LinkId, bytes: &[u8], now: Instant) {
        if let Some(session) = self.session(link) {
            let in_time = session.in_time(now);
            self.take(link, bytes, in_time);
        }
    }

    /// Handles what is due: replies completed by silence, timeouts, commands that waited too long.
    pub(crate) fn advance(&mut self, now: Instant) {
        for link in [LinkId::URGENT, LinkId::COMMAND] {
            let Some(session) = self.session(link) else { continue };
            if session.is_due(now) {
                self.take(link, &[], now);
            }
            let Some(session) = self.session(link) else { continue };
            if session.is_overdue(now) {
                session.supervisor.give_up(now);
                self.lost(link, now);
            }
        }
        if let Some((link, at)) = self.connection_to_reopen()
            && now >= at
        {
            // The peer does not reply: reopening the connection is faster than waiting.
            if let Some(session) = self.session(link) {
                session.supervisor.give_up(now);
            }
            self.lost(link, now);
        }
        // In this order, because a change of the first connection may open the second.
        for link in [LinkId::COMMAND, LinkId::URGENT] {
            self.supervise(link, now);
        }
        while let Some(&waiting) = self.queue.front()
            && now >= waiting.since + COMMAND_TTL
        {
            self.queue.pop_front();
            self.drop_command(waiting, DropReason::TooOld, now);
        }
        while let Some(old) = self.stops.pop_old(now, |waiting| is_asked(&self.fields, waiting)) {
            self.drop_command(old, DropReason::TooOld, now);
        }
    }

    /// Reopens a connection when it is due. A connection that fails to open in time shows whether the controller
    /// accepts two.
    fn supervise(&mut self, link: LinkId, now: Instant) {
        let ordinary_is_up = self.ordinary.supervisor.is_up();
        let Some(session) = self.session(link) else { return };
        let was_opening = matches!(session.supervisor.state(), LinkState::Opening { .. });
        // Silence is normal here, so a connection that is up is not given up for it.
        session.supervisor.advance(now);
        if was_opening && matches!(session.supervisor.state(), LinkState::Down { .. }) {
            match link {
                LinkId::COMMAND => self.was_away(now),
                _ if ordinary_is_up => self.second_connection_lost(now),
                _ => {}
            }
        }
    }

    /// The next urgent command that may be sent, and its connection.
    pub(crate) fn next_stop(&mut self, out: &mut [u8], now: Instant) -> Option<(LinkId, usize)> {
        while let Some(link) = self.connection_for_stops()
            && let Some(command) = self.pop_stop(now)
        {
            if let Some(len) = self.send(link, command, out, (now, now + STOP_TTL)) {
                return Some((link, len));
            }
        }
        None
    }

    /// The next other command that may be sent.
    pub(crate) fn next_command(&mut self, out: &mut [u8], now: Instant) -> Option<usize> {
        if self.queue.is_empty() || !self.ordinary.is_free() || self.is_stopping() {
            return None;
        }
        let waiting = self.queue.pop_front()?;
        let keyword = self.tables.entry(waiting.entry)?.0.keyword;
        let until = waiting.since + COMMAND_TTL;
        self.send(LinkId::COMMAND, (keyword, waiting), out, (now, until))
    }

    /// Whether an urgent command waits.
    pub(crate) fn has_stops(&self) -> bool {
        !self.stops.is_empty()
    }

    /// The connection on which an urgent command can be sent now.
    fn connection_for_stops(&self) -> Option<LinkId> {
        if self.stops.is_empty() {
            return None;
        }
        if self.urgent.as_ref().is_some_and(Session::is_free) {
            return Some(LinkId::URGENT);
        }
        self.ordinary.is_free_beside().then_some(LinkId::COMMAND)
    }

    /// The next urgent command of a kind that is not in flight, or has been for so long that its result is uncertain.
    fn pop_stop(&mut self, now: Instant) -> Option<(Keyword, Waiting)> {
        let sessions = [Some(&self.ordinary), self.urgent.as_ref()];
        self.stops.pop(|keyword| may_go_at(sessions, keyword) <= now)
    }

    /// When the first waiting urgent command may be sent, if a connection can take it.
    fn stop_may_go_at(&self) -> Instant {
        let sessions = [Some(&self.ordinary), self.urgent.as_ref()];
        self.stops.kinds().map(|keyword| may_go_at(sessions, keyword)).min().unwrap_or(Instant::NEVER)
    }

    /// If an urgent command has waited long enough, and only for replies: the connection whose newest command has been
    /// unanswered longest, and when to give it up.
    fn connection_to_reopen(&self) -> Option<(LinkId, Instant)> {
        let has_room = self.ordinary.supervisor.is_up() && self.ordinary.beside.is_none();
        if has_room || self.stops.is_empty() || self.connection_for_stops().is_some() {
            return None;
        }
        // Nothing is in flight on a connection that is down.
        let urgent = self.urgent.as_ref().and_then(|session| session.in_flight);
        let urgent = urgent.map(|sent| (LinkId::URGENT, sent.at));
        let ordinary = self.ordinary.beside.map(|sent| (LinkId::COMMAND, sent.at));
        let (link, at) = urgent.into_iter().chain(ordinary).min_by_key(|&(_, at)| at)?;
        Some((link, (at + STOP_TTL).max(self.stop_may_go_at()).max(self.no_reopening_until)))
    }

    fn send(
        &mut self,
        link: LinkId,
        command: (Keyword, Waiting),
        out: &mut [u8],
        times: (Instant, Instant),
    ) -> Option<usize> {
        let is_ordinary = |sent: Sent| !sent.keyword.is_urgent();
        if link == LinkId::URGENT
            && self.ordinary.is_unacknowledged()
            && self.ordinary.in_flight.is_some_and(is_ordinary)
        {
            // A command in flight there could arrive after this one and restart the robot.
            self.ordinary.supervisor.give_up(times.0);
            self.lost(LinkId::COMMAND, times.0);
        }
        let session = match link {
            LinkId::URGENT => self.urgent.as_mut()?,
            _ => &mut self.ordinary,
        };
        let (entry, text) = self.tables.entry(command.1.entry)?;
        let sent = match entry.has_value {
            false => session.send(command, text, &self.dialect, out, times).ok(),
            // Not too long: validation has refused such configurations.
            true => fill_in(text, command.1.value)
                .and_then(|text| session.send(command, &text, &self.dialect, out, times).ok()),
        };
        if sent.is_none() {
            self.drop_command(command.1, DropReason::Unwritable, times.0);
        }
        sent
    }

    /// Whether an urgent command waits or may not have arrived. A command that the controller has answered with an
    /// unknown text no longer holds back others.
    fn is_stopping(&self) -> bool {
        let holds = |sent: &Sent| sent.keyword.is_urgent() && !sent.has_text;
        let sessions = [Some(&self.ordinary), self.urgent.as_ref()].into_iter().flatten();
        let mut sent = sessions.flat_map(|session| [session.in_flight, session.beside]).flatten();
        !self.stops.is_empty() || sent.any(|sent| holds(&sent))
    }

    /// When something is due without an input. An event on one connection may concern the other.
    pub(crate) fn deadline(&self) -> Instant {
        let sessions = [Some(&self.ordinary), self.urgent.as_ref()].into_iter().flatten();
        let own = sessions.map(|session| session.deadline().min(session.supervisor.deadline()));
        let waiting = self.queue.front().map_or(Instant::NEVER, |waiting| waiting.since + COMMAND_TTL);
        let stops = match self.stops.is_empty() {
            true => Instant::NEVER,
            false => self.stops_deadline(),
        };
        own.min().unwrap_or(Instant::NEVER).min(waiting).min(stops)
    }

    fn stops_deadline(&self) -> Instant {
        let goes_at = match self.connection_for_stops() {
            Some(_) => self.stop_may_go_at(),
            None => self.connection_to_reopen().map_or(Instant::NEVER, |(_, at)| at),
        };
        goes_at.min(self.stops.deadline(|waiting| is_asked(&self.fields, waiting)))
    }

    fn session(&mut self, link: LinkId) -> Option<&mut Session> {
        match link {
            LinkId::URGENT => self.urgent.as_mut(),
            _ => Some(&mut self.ordinary),
        }
    }

    /// Takes the events in `bytes`, or those that are due.
    fn take(&mut self, link: LinkId, bytes: &[u8], now: Instant) {
        let mut rest = bytes;
        loop {
            let Some(session) = self.session(link) else { return };
            match session.step(&mut rest, now) {
                None => return,
                Some(Event::Other) => {}
                Some(Event::Answered(sent, code)) => {
                    self.failed.note(sent.command, code, now);
                    self.outcomes.push(sent.command, code);
                }
                Some(Event::TimedOut) => {
                    // A late reply would be taken for the next command's.
                    session.supervisor.give_up(now);
                    self.lost(link, now);
                    return;
                }
            }
        }
    }
}
