//! What becomes of one variable between its device and the controller: what waits, what is safe, and
//! what is repeated (P2).

use proto_core::time::{Duration, Instant};

use crate::driver::Broken;

/// What the controller shows this soon may be older than the safe value.
const SHOWN_AFTER: Duration = Duration::from_millis(200);

/// So long after it was confirmed, another value that is shown takes that back.
pub const DOUBT: Duration = Duration::from_secs(3);

/// The port's `timeout_ms`: longer than a link stays closed, so that what waited for it could be sent.
pub const TIMEOUT: Duration = Duration::from_millis(150);

/// A byte variable: each of its values is written, in order.
#[derive(Debug, Clone)]
pub struct Bits {
    safe_value: u8,
    /// As everybody sees it; `None` before the first frame.
    pub newest: Option<u8>,
    /// What is to be written, and since when.
    waiting: Vec<Edge>,
    /// When its owner is silent; `None` while it is, and before the first frame.
    overdue_at: Option<Instant>,
    /// Its owner is silent: the safe value stands. It is as old as the silence, however often it is
    /// written.
    safe: Option<Edge>,
    /// Since when the controller is not known to have it.
    pub unconfirmed_since: Option<Instant>,
    /// When the controller showed it, and since when it was not known to have it then.
    confirmed_at: Option<Instant>,
    doubted_since: Option<Instant>,
}

#[derive(Debug, Clone)]
struct Edge {
    value: u8,
    at: Instant,
}

impl Bits {
    pub fn new(safe_value: u8) -> Self {
        Self {
            safe_value,
            newest: None,
            waiting: Vec::new(),
            overdue_at: None,
            safe: None,
            unconfirmed_since: None,
            confirmed_at: None,
            doubted_since: None,
        }
    }

    /// Its owner sent it; the way up is open or not.
    pub fn received(&mut self, value: u8, is_reachable: bool, now: Instant) {
        self.newest = Some(value);
        self.overdue_at = Some(now + TIMEOUT);
        self.safe = None;
        self.unconfirmed_since = None;
        if !is_reachable {
            self.waiting.clear();
            return;
        }
        match self.waiting.last_mut() {
            Some(last) if last.value == value => last.at = now,
            _ => self.waiting.push(Edge { value, at: now }),
        }
        self.expire(now);
    }

    /// A deadline may have passed. Whether the owner has just fallen silent.
    pub fn deadlines(&mut self, now: Instant) -> bool {
        let is_overdue = self.overdue_at.is_some_and(|at| now >= at);
        if is_overdue {
            self.overdue_at = None;
            self.newest = Some(self.safe_value);
            let safe = Edge { value: self.safe_value, at: now };
            self.waiting = vec![safe.clone()];
            self.safe = Some(safe);
            self.unconfirmed_since = Some(now);
        }
        self.expire(now);
        is_overdue
    }

    /// A safe value that was written is to be written again, if it still stands.
    pub fn again(&mut self) {
        if self.waiting.is_empty() {
            self.waiting.extend(self.safe.clone());
        }
    }

    /// A link came up, or the controller was away: it may have started anew.
    pub fn controller_was_away(&mut self, now: Instant) {
        if self.is_safe() {
            self.unconfirmed_since = Some(now);
            self.again();
        }
    }

    /// The way up is gone: only a safe value is written later.
    pub fn lost(&mut self) {
        if !self.is_safe() {
            self.waiting.clear();
        }
    }

    /// The controller answered that it has what was written.
    pub fn confirm(&mut self) {
        self.unconfirmed_since = None;
    }

    /// The controller shows this value.
    pub fn shown(&mut self, value: u8, now: Instant) {
        match self.unconfirmed_since {
            Some(at) if value == self.safe_value && now >= at + SHOWN_AFTER => {
                (self.confirmed_at, self.doubted_since) = (Some(now), Some(at));
                self.unconfirmed_since = None;
            }
            None if self.is_safe()
                && value != self.safe_value
                && self.confirmed_at.is_some_and(|at| now < at + DOUBT) =>
            {
                self.unconfirmed_since = self.doubted_since;
                self.again();
            }
            _ => {}
        }
    }

    pub fn is_waiting(&self) -> bool {
        !self.waiting.is_empty()
    }

    /// What is handed over now must be what waits first, and not too old.
    pub fn take(&mut self, value: u8, now: Instant) -> Result<(), Broken> {
        if self.waiting.is_empty() {
            return Err(format!("writes {value}, which nobody asked for"));
        }
        let first = self.waiting.remove(0);
        if first.value != value {
            return Err(format!("writes {value} instead of {}", first.value));
        }
        let age = now.saturating_since(first.at);
        if age > TIMEOUT && !self.is_safe() {
            return Err(format!("writes {value}, which is {age} old"));
        }
        Ok(())
    }

    /// A frame is overdue, or has never come.
    pub fn is_silent(&self) -> bool {
        self.overdue_at.is_none()
    }

    pub fn is_safe(&self) -> bool {
        self.safe.is_some()
    }

    fn expire(&mut self, now: Instant) {
        if !self.is_safe() {
            self.waiting.retain(|edge| now.saturating_since(edge.at) <= TIMEOUT);
        }
    }
}

/// What stands in a float's place when its owner falls silent.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Instead {
    Safe(f32),
    /// What the controller shows.
    Shown,
    /// What its owner sent last, for as long as the controller is the same.
    Last,
}

/// A float: the newest value wins.
#[derive(Debug, Clone)]
pub struct Float {
    instead: Instead,
    /// What would be written; `None` when that is not known.
    pub newest: Option<f32>,
    /// Its value is its owner's, or the safe one.
    pub is_live: bool,
    is_waiting: bool,
    /// The controller, as it is known now, was given the newest value.
    is_there: bool,
    /// When its owner is silent; `None` while it is, and before the first frame.
    overdue_at: Option<Instant>,
}

impl Float {
    pub fn new(instead: Instead) -> Self {
        Self { instead, newest: None, is_live: false, is_waiting: false, is_there: false, overdue_at: None }
    }

    pub fn received(&mut self, value: f32, is_reachable: bool, now: Instant) {
        self.newest = Some(value);
        self.overdue_at = Some(now + TIMEOUT);
        self.is_live = true;
        self.is_there = false;
        self.is_waiting = is_reachable;
    }

    /// A deadline may have passed: its owner may have fallen silent.
    pub fn deadlines(&mut self, now: Instant) {
        if self.overdue_at.take_if(|at| now >= *at).is_none() {
            return;
        }
        (self.is_live, self.is_waiting) = (false, false);
        match self.instead {
            Instead::Safe(value) => {
                self.newest = Some(value);
                (self.is_live, self.is_waiting) = (true, true);
            }
            Instead::Shown => self.newest = None,
            Instead::Last => self.newest = self.newest.filter(|_| self.is_there),
        }
    }

    /// The controller may be another by now, which has nothing of what a silent owner sent last.
    pub fn controller_is_new(&mut self) {
        self.is_there = false;
        if self.instead == Instead::Last && !self.is_live {
            self.newest = None;
        }
    }

    /// A frame is overdue, or has never come.
    pub fn is_silent(&self) -> bool {
        self.overdue_at.is_none()
    }

    /// The controller shows it, and nobody else sends it.
    pub fn read_back(&mut self, value: Option<f32>) {
        self.newest = value;
    }

    /// The way up is gone.
    pub fn lost(&mut self, is_safe: bool) {
        self.is_waiting &= is_safe && self.has_safe_value();
    }

    pub fn again(&mut self, is_safe: bool) {
        self.is_waiting |= is_safe && self.has_safe_value();
    }

    pub fn is_waiting(&self) -> bool {
        self.is_waiting
    }

    pub fn taken(&mut self) {
        self.is_waiting = false;
        self.is_there = true;
    }

    fn has_safe_value(&self) -> bool {
        matches!(self.instead, Instead::Safe(_))
    }
}
