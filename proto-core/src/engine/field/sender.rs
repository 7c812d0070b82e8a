//! The trigger of a port's output part: its cycle, a change, an input frame, or a rising bit.
//!
//! The cycle keeps its phase and never bursts; cycles that could not be served are counted.

use crate::config::{OnStale, SendOn};
use crate::engine::counters::{PortCounters, add, bump};
use crate::engine::latency::Since;
use crate::image::{ExtraSet, GroupId, Image, MAX_GROUPS, VarSet};
use crate::schedule::Grid;
use crate::time::{Duration, Instant};

/// A set of groups of the image.
// In 32-bit words, because 128-bit numbers are slow on a Cortex-M.
#[derive(Debug, Clone, Copy, Default)]
pub(crate) struct GroupSet([u32; MAX_GROUPS.div_ceil(32)]);

impl GroupSet {
    pub(crate) fn insert(&mut self, group: GroupId) {
        if let Some(word) = self.0.get_mut(usize::from(group.0) / 32) {
            *word |= 1_u32.wrapping_shl(u32::from(group.0) % 32);
        }
    }

    fn all(self, is_true: impl Fn(GroupId) -> bool) -> bool {
        for (nth, word) in self.0.into_iter().enumerate() {
            let mut left = word;
            while left != 0 {
                let bit = left.trailing_zeros() as usize;
                left &= left.wrapping_sub(1);
                if !is_true(GroupId(nth.wrapping_mul(32).wrapping_add(bit) as u8)) {
                    return false;
                }
            }
        }
        true
    }
}

#[derive(Debug, Clone)]
pub(crate) struct Sender {
    on: SendOn,
    on_stale: OnStale,
    stale_after: Duration,
    grid: Option<Grid>,
    /// Groups of the values: all must be known, and fresh unless the recipe holds.
    pub sources: GroupSet,
    /// The variables and the values of the state packet: all must be readable.
    pub shown: VarSet,
    pub shown_extra: ExtraSet,
    /// Whether the output shows the health of ports.
    pub shows_health: bool,
    due: bool,
    /// Since when the frame has been due, until that is recorded.
    due_since: Since,
    in_flight: bool,
    /// The next CAN frame of a cycle that is being handed over.
    pub next_can: usize,
    digest: Option<u64>,
    /// A port that sends only changes also sends after this long without one.
    pub refresh: Duration,
    refresh_at: Instant,
    last_bit: Option<bool>,
    pub frames_sent: u32,
}

impl Sender {
    /// `has_output` is false for a recipe without an output part: nothing is ever due.
    pub(crate) fn new(
        on: SendOn,
        on_stale: OnStale,
        stale_after: Duration,
        cycle: Duration,
        has_output: bool,
    ) -> Self {
        let periodic = has_output && matches!(on, SendOn::Period | SendOn::Change);
        Self {
            on,
            on_stale,
            stale_after,
            grid: periodic.then(|| Grid::starting_at(Instant::ZERO, cycle)),
            sources: GroupSet::default(),
            shown: VarSet::EMPTY,
            shown_extra: ExtraSet::EMPTY,
            shows_health: false,
            due: false,
            due_since: Since::NONE,
            in_flight: false,
            next_can: 0,
            digest: None,
            refresh: Duration::MAX,
            refresh_at: Instant::NEVER,
            last_bit: None,
            frames_sent: 0,
        }
    }

    /// Whether a frame waits to be handed over.
    pub(crate) fn is_due(&self) -> bool {
        self.due && !self.in_flight
    }

    pub(crate) fn sends_changes(&self) -> bool {
        self.on == SendOn::Change
    }

    /// The port is down or bus-off: drops due frames.
    pub(crate) fn reset(&mut self) {
        self.due = false;
        self.in_flight = false;
        self.next_can = 0;
        self.digest = None;
    }

    /// The gateway slept: drops due frames. Frames already handed over are still reported as sent.
    pub(crate) fn skip(&mut self) {
        self.due = false;
        self.next_can = 0;
        self.digest = None;
    }

    /// When the next cycle after `now` begins; [`Instant::NEVER`] if frames are not sent by cycle.
    pub(crate) fn next_cycle(&self, now: Instant) -> Instant {
        self.grid.as_ref().map_or(Instant::NEVER, |grid| match grid.next() {
            next if next > now => next,
            next => (next + grid.period()).max(now + Duration::from_micros(1)),
        })
    }

    /// Whether what was handed over has not left yet, or the line is held.
    pub(crate) fn is_busy(&self) -> bool {
        self.in_flight
    }

    /// Keeps the output off the line until [`Self::sent`].
    pub(crate) fn hold(&mut self) {
        self.in_flight = true;
    }

    /// How old a value to be sent may be.
    pub(crate) const fn stale_after(&self) -> Duration {
        self.stale_after
    }

    /// Whether a value that arrived at `came` may be sent.
    pub(crate) fn is_fresh(&self, came: Instant, now: Instant) -> bool {
        self.on_stale == OnStale::Hold || now.saturating_since(came) <= self.stale_after
    }

    /// Everything handed over has left.
    pub(crate) fn sent(&mut self) {
        self.in_flight = false;
    }

    /// [`Self::sent`] if no frame is due; otherwise returns false and changes nothing.
    pub(crate) fn sent_before_next(&mut self) -> bool {
        self.in_flight &= self.due;
        !self.due
    }

    /// Since when the frame, or the first CAN frame of the cycle, has been due; returned once.
    pub(crate) fn take_due_since(&mut self) -> Since {
        core::mem::replace(&mut self.due_since, Since::NONE)
    }

    /// The frame, or the last CAN frame of the cycle, was handed over.
    pub(crate) fn handed_over(&mut self) {
        self.due = false;
        self.in_flight = true;
        self.next_can = 0;
        self.frames_sent = self.frames_sent.wrapping_add(1);
    }

    /// A frame outside of the output part was handed over; the line is held until it has left.
    pub(crate) fn handed_over_beside(&mut self) {
        self.hold();
        self.frames_sent = self.frames_sent.wrapping_add(1);
    }

    /// Nothing is sent this time.
    pub(crate) fn dismiss(&mut self) {
        self.due = false;
        self.next_can = 0;
    }

    pub(crate) fn advance(&mut self, usable: bool, counters: &mut PortCounters, now: Instant) {
        let Some(grid) = &mut self.grid else { return };
        let Some(missed) = grid.due(now) else { return };
        if !usable {
            return;
        }
        let due_since = Since::at(grid.next()).earlier_by(grid.period());
        if self.frames_sent > 0 {
            add(&mut counters.skipped_cycles, usize::try_from(missed).unwrap_or(usize::MAX));
        }
        self.raise(counters, due_since);
    }

    /// This many input frames were accepted at once: the newest is answered.
    pub(crate) fn frames_accepted(
        &mut self,
        count: u32,
        usable: bool,
        counters: &mut PortCounters,
        now: Instant,
    ) {
        if matches!(self.on, SendOn::Frame) && usable && count > 0 {
            self.answer_newest(count, counters, now);
        }
    }

    fn answer_newest(&mut self, count: u32, counters: &mut PortCounters, now: Instant) {
        counters.skipped_cycles = counters.skipped_cycles.wrapping_add(count.wrapping_sub(1));
        self.raise(counters, Since::at(now));
    }

    /// Values in the image changed: checks the trigger bit.
    pub(crate) fn image_changed(
        &mut self,
        image: &Image,
        usable: bool,
        counters: &mut PortCounters,
        now: Instant,
    ) {
        let SendOn::Rising { var, bit } = self.on else { return };
        if !image.is_known(var) {
            return;
        }
        let on = image.bit(var, bit) == 1.0;
        if on && self.last_bit == Some(false) && usable {
            self.raise(counters, Since::at(now));
        }
        self.last_bit = Some(on);
    }

    /// Whether the values may be sent at `now`: all known, and fresh unless the recipe holds.
    pub(crate) fn may_show(&self, image: &Image, now: Instant) -> bool {
        (!image.has_unreadable() || self.can_show(image, now))
            && self.sources.all(|group| match image.stamp_of(group) {
                Some(at) => self.on_stale == OnStale::Hold || now.saturating_since(at) <= self.stale_after,
                None => false,
            })
    }

    /// Whether all values are readable, and those of rejected fields are fresh, which their frames' age does not show.
    fn can_show(&self, image: &Image, now: Instant) -> bool {
        image.can_read(&self.shown, self.shown_extra)
            && self
                .shown
                .inputs(&image.withheld())
                .all(|var| image.known_since(var).is_some_and(|at| self.is_fresh(at, now)))
    }

    /// On a port that sends only changes, whether a frame with this digest is new or to be repeated. Other ports
    /// compute no digest.
    pub(crate) fn is_news(&mut self, digest: impl FnOnce() -> u64, now: Instant) -> bool {
        self.on != SendOn::Change || self.is_change(digest(), now)
    }

    fn is_change(&mut self, digest: u64, now: Instant) -> bool {
        let news = self.digest != Some(digest) || now >= self.refresh_at;
        self.digest = Some(digest);
        if news {
            self.refresh_at = now + self.refresh;
        }
        news
    }

    /// When something is due without an input; `quiet_at` is when the line is free for the gateway.
    pub(crate) fn deadline(&self, quiet_at: Instant) -> Instant {
        let cycle = self.grid.as_ref().map_or(Instant::NEVER, Grid::next);
        if self.is_due() { cycle.min(quiet_at) } else { cycle }
    }

    fn raise(&mut self, counters: &mut PortCounters, since: Since) {
        if self.due {
            // This frame replaces the one that was due.
            bump(&mut counters.skipped_cycles);
        }
        self.due = true;
        self.due_since = since;
    }
}

/// FNV-1a: distinguishes frames without keeping them.
pub(crate) fn digest(seed: u64, bytes: &[u8]) -> u64 {
    bytes.iter().fold(seed, |hash, &byte| (hash ^ u64::from(byte)).wrapping_mul(0x0000_0100_0000_01B3))
}

/// Initial value of a digest.
pub(crate) const DIGEST_SEED: u64 = 0xCBF2_9CE4_8422_2325;
