//! Events of exchanges: a rising bit, and the steps that follow it (docs/engine.md section 13).
//!
//! In: readings of the bits, how requests ended, the time. Out: requests, each made once with the values at the rise,
//! and their outcomes. A write that stops a peer is no event; it cancels the events of its peer. Does not know how
//! requests are sent.
//!
//! A rise needs a 0 read before it over the same connection that is not stale. Values that are read separately from the
//! bit must come from a read that was answered after the one that showed the rise.

use super::event::{Event, Outcome, Reading};
use super::exchanges::{ExchangeItem, Piece};
use super::line::{ExchangeTable, Line};
use super::requests::RequestBuilder;
use super::turns::{Ended, PeerChange, Turns};
use crate::image::GroupId;
use crate::modbus::rtu::MAX_ADU;
use crate::recipe::model::MAX_STREAM_FRAME;
use crate::time::{Duration, Instant};

/// Where the values of requests come from, as far as their age matters.
pub(crate) struct Sources<C> {
    /// Groups below this are frames of field ports, the others of links.
    pub first_of_links: u8,
    /// Since when the connection that brings a group's values is up.
    pub up_since: C,
    pub stale_after: Duration,
    /// Whether the port's device is up.
    pub is_usable: bool,
}

pub(crate) struct Events<'a, 't> {
    pub items: &'a mut [ExchangeItem],
    pub table: &'a mut ExchangeTable<'t>,
    pub line: &'a mut Line,
    pub now: Instant,
}

impl Events<'_, '_> {
    /// Values in the image have changed: checks the bits, and makes the requests of events whose values are complete.
    pub(crate) fn image_changed(
        &mut self,
        maker: &RequestBuilder<'_>,
        sources: &Sources<impl Fn(GroupId) -> Instant>,
        kept: &mut [Piece],
    ) {
        for nth in 0..self.items.len() {
            self.read_bit(nth, maker, sources);
        }
        for nth in 0..self.items.len() {
            self.freeze(nth, maker, sources, kept);
        }
        self.note_expiry();
    }

    fn read_bit(
        &mut self,
        nth: usize,
        maker: &RequestBuilder<'_>,
        sources: &Sources<impl Fn(GroupId) -> Instant>,
    ) {
        let Some(item) = self.items.get_mut(nth) else { return };
        let Some(trigger) = &mut item.trigger else { return };
        let Some(at) = maker.image.known_since(trigger.var) else { return trigger.forget() };
        let on = maker.image.bit(trigger.var, trigger.bit) == 1.0;
        let is_old = trigger.last.is_some_and(|last| last.at == at && last.on == on);
        if is_old {
            return;
        }
        let up_since = maker.image.group(trigger.var).map_or(Instant::ZERO, &sources.up_since);
        let [rises, stops] = trigger.read(Reading { on, at }, up_since, sources.stale_after);
        if item.stops {
            // Even while the device is away, because a stop is a state.
            if stops {
                self.stop(nth);
            }
        } else if rises {
            self.rise(nth, at, sources.is_usable);
        }
    }

    /// A write that stops its peer is wanted: it goes first, and the peer's waiting events are cancelled.
    pub(crate) fn stop(&mut self, nth: usize) {
        self.line.request(self.table, nth, self.now);
        self.line.yield_to_stops(self.table, self.now);
        let Some(peer) = self.table.rows.get(nth).map(|row| row.peer) else { return };
        for other in 0..self.items.len() {
            let is_of_peer = self.table.rows.get(other).is_some_and(|row| row.peer == peer);
            if is_of_peer && self.items.get(other).is_some_and(|item| item.event.waits()) {
                self.end(other, Outcome::Stopped, 0);
            }
        }
    }

    /// The bit of an event has risen.
    fn rise(&mut self, nth: usize, at: Instant, is_usable: bool) {
        let Some(item) = self.items.get(nth) else { return };
        if !item.event.is_over() {
            // The open event goes on; only the counter shows this one.
            return self.count(nth, Outcome::StillOpen);
        }
        if item.follow.is_some() {
            // Only the step before it starts this one.
            return;
        }
        let until = self.now + item.window;
        self.open(nth, Event::Risen { at, until });
        let Some(peer) = self.table.rows.get(nth).map(|row| row.peer) else { return };
        let is_away = self.line.turns(self.table, |turns| turns.is_known_to_be_away(peer));
        if is_away || !is_usable {
            self.end(nth, Outcome::Away, 0);
        } else if self.is_stopping(peer) {
            self.end(nth, Outcome::Stopped, 0);
        }
    }

    fn is_stopping(&mut self, peer: u8) -> bool {
        let on_its_way =
            self.line.occupied_by().and_then(|flight| self.table.rows.get(usize::from(flight.exchange)));
        on_its_way.is_some_and(|row| row.stops() && row.peer == peer)
            || self.line.turns(self.table, |turns: &mut Turns<'_>| turns.is_stopping(peer))
    }

    fn open(&mut self, nth: usize, event: Event) {
        if let Some(item) = self.items.get_mut(nth) {
            item.event = event;
            (item.reported.outcome, item.reported.code) = (Outcome::Open, 0);
            item.is_news = true;
        }
    }

    /// Makes the request of an event whose values are complete, and those of all steps that follow it.
    fn freeze(
        &mut self,
        nth: usize,
        maker: &RequestBuilder<'_>,
        sources: &Sources<impl Fn(GroupId) -> Instant>,
        kept: &mut [Piece],
    ) {
        let Some(ExchangeItem { event: Event::Risen { at, until }, .. }) = self.items.get(nth) else {
            return;
        };
        let (at, until) = (*at, *until);
        let bit_group = self
            .items
            .get(nth)
            .and_then(|item| item.trigger)
            .and_then(|trigger| maker.image.group(trigger.var));
        let (mut steps, mut count) = ([nth as u8; MAX_STEPS], 1_usize);
        // The steps that follow, the nearest first.
        let mut done = 0_usize;
        while let Some(&step) = steps.get(done).filter(|_| done < count) {
            for (other, item) in (0..).zip(self.items.iter()) {
                if item.follow == Some(step)
                    && let Some(slot) = steps.get_mut(count)
                {
                    *slot = other;
                    count = count.saturating_add(1);
                }
            }
            done = done.saturating_add(1);
        }
        let steps = steps.get(..count).unwrap_or(&[]);
        for &step in steps {
            let Some(item) = self.items.get(usize::from(step)) else { continue };
            let is_pending = |group: GroupId| {
                group.0 >= sources.first_of_links
                    && Some(group) != bit_group
                    && maker.image.stamp_of(group).is_none_or(|stamp| stamp <= at)
            };
            if maker.groups_of(item).any(is_pending) {
                return;
            }
        }
        let mut request = [0; if MAX_STREAM_FRAME > MAX_ADU { MAX_STREAM_FRAME } else { MAX_ADU }];
        for &step in steps {
            let step = usize::from(step);
            let Some(item) = self.items.get(step) else { continue };
            let len = match maker.make_event(item, &mut request) {
                Ok(len) => len,
                Err(outcome) => return self.end(nth, outcome, 0),
            };
            let room =
                kept.iter_mut().skip(usize::from(item.pieces.start)).take(usize::from(item.pieces.len));
            room.flatten().zip(request.get(..len).unwrap_or(&[])).for_each(|(slot, &byte)| *slot = byte);
            let len = len as u16;
            if step == nth {
                if let Some(item) = self.items.get_mut(step) {
                    item.event = Event::Ready { len, until };
                }
            } else {
                self.open(step, Event::Behind { len, until: Instant::NEVER });
            }
        }
        self.ready(nth);
    }

    fn ready(&mut self, nth: usize) {
        let now = self.now;
        self.line.turns(self.table, |turns| turns.set_event(nth, Some(now)));
        self.line.look(now);
    }

    /// An exchange was answered, or ended without a reply: its event ends or may be sent again, and the next step is
    /// sent or cancelled.
    pub(crate) fn ended(&mut self, nth: usize, is_event: bool, ended: Ended, code: u16) {
        let outcome = match ended {
            Ended::Good => Outcome::Done,
            Ended::Refused => Outcome::Refused,
            Ended::Accepted => Outcome::Accepted,
            Ended::Unclear | Ended::Unconfirmed => Outcome::Unknown,
            Ended::Busy if is_event => return self.busy(nth, code),
            // The line repeats the request.
            Ended::Busy => return,
        };
        if is_event {
            self.end(nth, outcome, code);
        }
        if outcome == Outcome::Done {
            self.follow(nth, is_event);
        }
        self.note_expiry();
    }

    /// The device was busy and did not execute it: it may be sent again.
    fn busy(&mut self, nth: usize, code: u16) {
        let Some(item) = self.items.get_mut(nth) else { return };
        let Event::Sent { len, until } = item.event else { return };
        if until <= self.now {
            return self.end(nth, Outcome::Expired, code);
        }
        item.event = Event::Ready { len, until };
        item.reported.code = code;
        self.ready(nth);
        self.note_expiry();
    }

    /// Starts the steps that follow an exchange that is done. Those that follow an event were made with it, unless they
    /// have ended since, such as by a stop.
    fn follow(&mut self, nth: usize, is_event: bool) {
        let peer = self.table.rows.get(nth).map(|row| row.peer);
        let is_stopping = peer.is_some_and(|peer| self.is_stopping(peer));
        for other in 0..self.items.len() {
            let Some(item) = self.items.get_mut(other).filter(|item| item.follow == Some(nth as u8)) else {
                continue;
            };
            let until = self.now + item.window;
            match item.event {
                Event::Behind { len, .. } => {
                    item.event = Event::Ready { len, until };
                    self.ready(other);
                }
                Event::Over if is_event => {}
                // The exchange it follows is no event, so the step becomes one now.
                Event::Over => {
                    self.open(other, Event::Risen { at: Instant::ZERO, until });
                    if is_stopping {
                        self.end(other, Outcome::Stopped, 0);
                    }
                }
                _ => self.count(other, Outcome::StillOpen),
            }
        }
    }

    /// Ends an event and, unless it was done, the waiting steps that follow it.
    pub(crate) fn end(&mut self, nth: usize, outcome: Outcome, code: u16) {
        let Some(item) = self.items.get_mut(nth) else { return };
        if item.event.is_over() {
            return;
        }
        item.event = Event::Over;
        (item.reported.outcome, item.reported.code) = (outcome, code);
        item.reported.ended = item.reported.ended.wrapping_add(1);
        item.is_news = true;
        self.line.turns(self.table, |turns| turns.set_event(nth, None));
        self.count(nth, outcome);
        if outcome == Outcome::Done {
            return;
        }
        // A loop instead of recursion: a step follows one exchange, so each is ended once.
        let mut left = self.items.len();
        while left > 0 {
            left = left.saturating_sub(1);
            let is_orphan = |item: &ExchangeItem| {
                let leader = item.follow.and_then(|leader| self.items.get(usize::from(leader)));
                matches!(item.event, Event::Behind { .. })
                    && leader.is_some_and(|leader| leader.event.is_over())
            };
            let Some(orphan) = self.items.iter().position(is_orphan) else { break };
            if let Some(item) = self.items.get_mut(orphan) {
                item.event = Event::Over;
                (item.reported.outcome, item.reported.code) = (Outcome::NotFollowed, 0);
                item.reported.ended = item.reported.ended.wrapping_add(1);
                item.is_news = true;
            }
            self.count(orphan, Outcome::NotFollowed);
        }
    }

    /// The request of an event without a reply has left.
    pub(crate) fn end_unanswered(&mut self, nth: usize) {
        self.follow(nth, true);
        self.end(nth, Outcome::Unknown, 0);
        self.note_expiry();
    }

    /// Applies what a failure or a sign of life says about the peer of an exchange.
    pub(crate) fn note(&mut self, nth: usize, news: PeerChange) {
        let Some(which) = self.table.rows.get(nth).map(|row| row.peer) else { return };
        match news {
            PeerChange::Nothing => {}
            PeerChange::Away => self.end_waiting(Some(which), Outcome::Away),
            PeerChange::Started => {
                for (item, row) in self.items.iter_mut().zip(self.table.rows.iter()) {
                    // Its earlier replies no longer count.
                    if let Some(sign) = item.restart.as_mut().filter(|_| row.peer == which) {
                        sign.was_there = None;
                    }
                }
                if let Some(peer) = self.table.peers.get_mut(usize::from(which)) {
                    peer.counters.starts = peer.counters.starts.wrapping_add(1);
                }
            }
        }
    }

    fn count(&mut self, nth: usize, outcome: Outcome) {
        let Some(peer) = self.table.rows.get(nth).map(|row| usize::from(row.peer)) else { return };
        if let Some(peer) = self.table.peers.get_mut(peer) {
            peer.counters.events.count(outcome);
        }
    }

    /// Ends all waiting events of a peer, or of all peers with `None`.
    pub(crate) fn end_waiting(&mut self, peer: Option<u8>, outcome: Outcome) {
        for nth in 0..self.items.len() {
            let is_of_peer =
                self.table.rows.get(nth).is_some_and(|row| peer.is_none_or(|peer| row.peer == peer));
            if is_of_peer && self.items.get(nth).is_some_and(|item| item.event.waits()) {
                self.end(nth, outcome, 0);
            }
        }
        self.note_expiry();
    }

    /// Ends waiting events whose time is over.
    pub(crate) fn expire(&mut self) {
        if self.now < self.line.expires_at {
            return;
        }
        for nth in 0..self.items.len() {
            if let Some(item) = self.items.get(nth).filter(|item| item.event.expires_at() <= self.now) {
                let code = item.reported.code;
                self.end(nth, Outcome::Expired, code);
            }
        }
        self.note_expiry();
    }

    fn note_expiry(&mut self) {
        let expiries = self.items.iter().map(|item| item.event.expires_at());
        self.line.expires_at = expiries.min().unwrap_or(Instant::NEVER);
    }
}

/// The most steps of one event.
const MAX_STEPS: usize = 16;
