//! What becomes of commands: `run`, which is sent once, soon, or not at all, and `stop`, which never
//! waits (P3, P7, D26).

use proto_core::engine::{LinkId, ReplyCode};
use proto_core::time::{Duration, Instant};

use crate::driver::{Broken, Conns, Is};

/// Values of the command field.
pub const NONE: u8 = 0;
pub const RUN: u8 = 1;
pub const STOP: u8 = 2;

/// A command has so long to be acknowledged, and a stop that nobody asks for any more to be sent.
const SOON: Duration = Duration::from_secs(1);
/// A reply that does not come in so long ends the connection.
const REPLY: Duration = Duration::from_secs(10);
const TOGETHER: Duration = Duration::from_secs(1);
const STRIKES: Duration = Duration::from_secs(10);
/// No connection makes way for a stop this soon after another is gone, and after the stop is asked for.
const OPEN_AGAIN: Duration = Duration::from_millis(500);
const ROOM_WITHIN: Duration = Duration::from_millis(20);
const QUEUE: usize = 8;

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Order {
    Run,
    Stop,
}

/// Something picked a command.
#[derive(Debug, Clone)]
struct Picked {
    nth: u32,
    /// Of a stop: since when nobody has asked for it any more.
    since: Instant,
}

/// Handed over, and not answered.
#[derive(Debug, Clone)]
struct Asked {
    link: LinkId,
    order: Order,
    picked: Picked,
    at: Instant,
    /// The controller has answered it in words that nobody knows.
    has_words: bool,
}

#[derive(Debug, Clone)]
pub struct Orders {
    /// The field's value in the frame before; none after silence.
    base: Option<u8>,
    /// The gateway slept after a frame with the field, and none has come since.
    woke: bool,
    /// How many were picked, and how many of them were not sent.
    pub total: u32,
    pub dropped: u32,
    runs: Vec<Picked>,
    stop: Option<Picked>,
    asked: Vec<Asked>,
    pub reply: ReplyCode,
    /// When the second connection was refused, or the first lost because of it.
    struck: Option<Instant>,
    /// No connection is closed to make way for a stop before this.
    way_made_until: Instant,
}

impl Orders {
    pub fn new() -> Self {
        Self {
            base: None,
            woke: false,
            total: 0,
            dropped: 0,
            runs: Vec::new(),
            stop: None,
            asked: Vec::new(),
            reply: ReplyCode::None,
            struck: None,
            way_made_until: Instant::ZERO,
        }
    }

    /// An accepted frame brought the field.
    pub fn received(&mut self, value: u8, conns: &Conns, now: Instant) {
        let before = self.base.replace(value);
        // What asked for it may have been discarded.
        let is_held = std::mem::take(&mut self.woke) && value == STOP;
        if !is_held && before.is_none_or(|before| before == value) {
            return;
        }
        self.not_asked(now);
        let picked = Picked { nth: self.total + 1, since: now };
        match value {
            RUN => {
                self.total += 1;
                if conns.is_open(LinkId::COMMAND) && self.runs.len() < QUEUE {
                    self.reply = ReplyCode::Pending;
                    self.runs.push(picked);
                } else {
                    self.not_sent(&picked);
                }
            }
            STOP => {
                self.total += 1;
                self.drop_runs();
                self.stop = Some(picked);
                self.way_made_until = self.way_made_until.max(now + ROOM_WITHIN);
                self.reply = ReplyCode::Pending;
            }
            _ => {}
        }
    }

    /// The device is gone: its next frame says how things are.
    pub fn gone(&mut self, now: Instant) {
        self.woke = false;
        self.forget(now);
    }

    /// The device is silent: what it asked for goes with it.
    pub fn forget(&mut self, now: Instant) {
        if self.base.take().is_some() {
            self.not_asked(now);
        }
        self.drop_runs();
    }

    /// Deadlines pass.
    pub fn deadlines(&mut self, now: Instant, conns: &mut Conns) {
        for link in [LinkId::URGENT, LinkId::COMMAND] {
            let is_asked = |asked: &Asked| asked.link == link && now >= asked.at + REPLY;
            if self.asked.iter().any(is_asked) || conns.overdue(now).contains(&link) {
                conns.must_close(now, link);
                self.lost(link, now);
            }
        }
        if let Some((link, at)) = self.crowded(conns)
            && now >= at
        {
            conns.must_close(now, link);
            self.lost(link, now);
        }
        // What becomes of the first says what it means for the second.
        for link in [LinkId::COMMAND, LinkId::URGENT] {
            if conns.not_opened(now).contains(&link) {
                conns.must_close(now, link);
                match link {
                    LinkId::COMMAND => self.was_away(conns),
                    _ if conns.is_open(LinkId::COMMAND) => self.strike(conns, now),
                    _ => {}
                }
            }
        }
        while self.runs.first().is_some_and(|run| now >= run.since + SOON) {
            let run = self.runs.remove(0);
            self.not_sent(&run);
        }
        if !self.is_asked()
            && let Some(stop) = self.stop.take_if(|stop| now >= stop.since + SOON)
        {
            self.not_sent(&stop);
        }
    }

    /// A connection is gone.
    pub fn lost(&mut self, link: LinkId, now: Instant) {
        let (gone, asked) = std::mem::take(&mut self.asked).into_iter().partition(|asked| asked.link == link);
        self.asked = asked;
        let gone: Vec<Asked> = gone;
        if !gone.is_empty() {
            self.way_made_until = self.way_made_until.max(now + OPEN_AGAIN);
        }
        // Of two, the newer one waits again.
        for asked in gone.into_iter().rev() {
            if asked.has_words {
                self.settle(asked.picked.nth, ReplyCode::Other);
            } else if asked.order == Order::Stop && self.is_asked() {
                self.stop.get_or_insert(Picked { since: now, ..asked.picked });
            } else {
                self.settle(asked.picked.nth, ReplyCode::NoReply);
            }
        }
        if link == LinkId::COMMAND {
            self.drop_runs();
        }
    }

    /// The driver reports that one is gone.
    pub fn down(&mut self, link: LinkId, was: Is, conns: &mut Conns, now: Instant) {
        let urgent = conns.of(LinkId::URGENT);
        match (link, was) {
            (LinkId::URGENT, Is::Opening | Is::Open) if conns.is_open(LinkId::COMMAND) => {
                self.strike(conns, now);
            }
            (LinkId::COMMAND, Is::Open)
                if urgent.is == Is::Open && now.saturating_since(urgent.from) <= TOGETHER =>
            {
                self.strike(conns, now);
            }
            // They went together: that was no verdict on the second one.
            (LinkId::COMMAND | LinkId::URGENT, Is::Open) => {
                self.struck = self.struck.filter(|&at| now.saturating_since(at) > TOGETHER);
            }
            (LinkId::COMMAND, Is::Opening) => self.was_away(conns),
            _ => {}
        }
    }

    /// The gateway was asleep.
    pub fn slept(&mut self) {
        self.woke |= self.base.take().is_some();
        for asked in std::mem::take(&mut self.asked) {
            let reply = if asked.has_words { ReplyCode::Other } else { ReplyCode::NoReply };
            self.settle(asked.picked.nth, reply);
        }
        self.drop_runs();
        if let Some(stop) = self.stop.take() {
            self.not_sent(&stop);
        }
    }

    /// A command is handed over; returns until when it may be delivered.
    pub fn sent(
        &mut self,
        link: LinkId,
        text: &[u8],
        conns: &mut Conns,
        now: Instant,
    ) -> Result<Instant, Broken> {
        let is_stopping = self.is_stopping();
        if text.starts_with(b"run") {
            if self.runs.is_empty() {
                return Err("runs, and nobody asked for it".to_owned());
            }
            let picked = self.runs.remove(0);
            let until = picked.since + SOON;
            if now > until {
                return Err(format!("runs {} after it was asked to", now.saturating_since(picked.since)));
            }
            if is_stopping {
                return Err("runs while it is to stop".to_owned());
            }
            // What holds nothing back any more has its own connection.
            let is_past = |asked: &Asked| asked.link == LinkId::URGENT && asked.has_words;
            if link != LinkId::COMMAND || !self.asked.iter().all(is_past) {
                return Err(format!("runs by {link:?} while {:?} is unanswered", self.asked));
            }
            self.asked.push(Asked { link, order: Order::Run, picked, at: now, has_words: false });
            return Ok(until);
        }
        // A line feed ends a keyword that is unanswered, so that the controller takes them for two.
        let is_beside = self.unanswered(link).any(|order| order == Order::Stop);
        if text != if is_beside { &b"\nstop"[..] } else { &b"stop"[..] } {
            return Err(format!("commands {text:?}"));
        }
        let Some(picked) = self.stop.take() else {
            return Err("stops, and nobody asked for it".to_owned());
        };
        if self.stop_is_under_way(now) {
            return Err("stops twice at once".to_owned());
        }
        if link == LinkId::COMMAND && self.is_free(LinkId::URGENT, conns) {
            return Err("stops by the other connection than the one for it".to_owned());
        }
        let is_running = self.unanswered(LinkId::COMMAND).any(|order| order == Order::Run);
        if link == LinkId::URGENT && is_running && !conns.of(LinkId::COMMAND).under_way.is_empty() {
            // What is under way there could arrive later and start the robot again.
            conns.must_close(now, LinkId::COMMAND);
            self.lost(LinkId::COMMAND, now);
        }
        self.asked.push(Asked { link, order: Order::Stop, picked, at: now, has_words: false });
        Ok(now + SOON)
    }

    /// What is unanswered on a connection.
    pub fn unanswered(&self, link: LinkId) -> impl Iterator<Item = Order> {
        self.asked.iter().filter(move |asked| asked.link == link).map(|asked| asked.order)
    }

    /// The controller said something that nobody knows: it may be the reply to the oldest that has had
    /// none of that.
    pub fn other_words(&mut self, link: LinkId) {
        let mut asked = self.asked.iter_mut().filter(|asked| asked.link == link);
        if let Some(asked) = asked.find(|asked| !asked.has_words) {
            asked.has_words = true;
        }
    }

    /// Whether something is unanswered on a connection, and no unknown words have come for it.
    pub fn is_without_words(&self, link: LinkId) -> bool {
        self.asked.iter().any(|asked| asked.link == link && !asked.has_words)
    }

    /// The controller replied; to something that nobody asked, it may be.
    pub fn replied(&mut self, link: LinkId, order: Order, is_done: bool) {
        let place = self.asked.iter().position(|asked| asked.link == link && asked.order == order);
        let Some(place) = place else { return };
        let asked = self.asked.remove(place);
        self.settle(asked.picked.nth, if is_done { ReplyCode::Success } else { ReplyCode::Fail });
    }

    /// Nothing waits that can go; and the engine is called when something can.
    pub fn rested(&self, conns: &Conns, now: Instant, until: Instant) -> Result<(), Broken> {
        let has_way = self.has_way(conns);
        if self.stop.is_some() && has_way && !self.stop_is_under_way(now) {
            return Err("lets a stop wait".to_owned());
        }
        let before = until - Duration::from_micros(1);
        if self.stop.is_some() && has_way && !self.stop_is_under_way(before) {
            return Err("sleeps longer than a stop has to wait".to_owned());
        }
        if self.crowded(conns).is_some_and(|(_, at)| at > now && at <= before) {
            return Err("sleeps longer than a stop has to wait for replies".to_owned());
        }
        if !self.runs.is_empty() && !self.is_stopping() && self.is_free(LinkId::COMMAND, conns) {
            return Err("lets a command wait though the link is free".to_owned());
        }
        Ok(())
    }

    /// Whether a stop has somewhere to go: beside a command that waits for its reply, but not with two
    /// that are not acknowledged.
    fn has_way(&self, conns: &Conns) -> bool {
        let command = conns.of(LinkId::COMMAND);
        let is_beside_free = self.unanswered(LinkId::COMMAND).count() < 2 && command.under_way.len() < 2;
        self.is_free(LinkId::URGENT, conns) || command.is_free() && is_beside_free
    }

    /// The connection that makes way for a stop that waits for replies alone, and when: the newest
    /// command on it is the oldest of these, and has not been answered for a second.
    fn crowded(&self, conns: &Conns) -> Option<(LinkId, Instant)> {
        let newest = |link| self.asked.iter().rfind(|asked| asked.link == link).map(|asked| asked.at);
        let is_full = self.unanswered(LinkId::COMMAND).count() == 2;
        if self.stop.is_none() || self.has_way(conns) || conns.is_open(LinkId::COMMAND) && !is_full {
            return None;
        }
        let urgent = newest(LinkId::URGENT).map(|at| (at, LinkId::URGENT));
        let command = newest(LinkId::COMMAND).filter(|_| is_full).map(|at| (at, LinkId::COMMAND));
        let (at, link) = [urgent, command].into_iter().flatten().min_by_key(|(at, _)| *at)?;
        let stops = self.asked.iter().filter(|asked| asked.order == Order::Stop).map(|asked| asked.at);
        let newest_stop = stops.max().unwrap_or(at);
        Some((link, (at.max(newest_stop) + SOON).max(self.way_made_until)))
    }

    fn is_free(&self, link: LinkId, conns: &Conns) -> bool {
        conns.of(link).is_free() && self.unanswered(link).next().is_none()
    }

    /// Whether the field still has the value that picked a stop.
    fn is_asked(&self) -> bool {
        self.base == Some(STOP)
    }

    fn not_asked(&mut self, now: Instant) {
        if let Some(stop) = &mut self.stop {
            stop.since = now;
        }
    }

    /// A stop is on its way or being carried out, and not yet for so long that nobody knows.
    fn stop_is_under_way(&self, now: Instant) -> bool {
        self.asked.iter().any(|asked| asked.order == Order::Stop && now < asked.at + SOON)
    }

    fn is_stopping(&self) -> bool {
        let holds = |asked: &Asked| asked.order == Order::Stop && !asked.has_words;
        self.stop.is_some() || self.asked.iter().any(holds)
    }

    fn drop_runs(&mut self) {
        for run in std::mem::take(&mut self.runs) {
            self.not_sent(&run);
        }
    }

    fn not_sent(&mut self, picked: &Picked) {
        self.dropped += 1;
        self.settle(picked.nth, ReplyCode::NotSent);
    }

    /// A command came to its end; the newest one's is told.
    fn settle(&mut self, nth: u32, reply: ReplyCode) {
        if nth == self.total {
            self.reply = reply;
        }
    }

    /// The controller seems to take one connection only.
    fn strike(&mut self, conns: &mut Conns, now: Instant) {
        let again = self.struck.is_some_and(|at| now.saturating_since(at) <= STRIKES);
        self.struck = Some(now);
        if again {
            conns.must_close(now, LinkId::URGENT);
            conns.get(LinkId::URGENT).is = Is::GivenUp;
            self.lost(LinkId::URGENT, now);
        }
    }

    /// Another controller may have come back.
    fn was_away(&mut self, conns: &mut Conns) {
        self.struck = None;
        let urgent = conns.get(LinkId::URGENT);
        if urgent.is == Is::GivenUp {
            urgent.is = Is::Closed;
        }
    }
}
