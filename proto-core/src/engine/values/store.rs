//! The state that ports and links share: the image, the outbox, and when each field frame is overdue.

use heapless::{Vec, VecView};

use super::bits::{Bits, SafeBytes, TimedOut};
use super::counts::Counts;
use super::outbox::{EdgeQueue, Outbox};
use super::withheld::{Withheld, members};
use crate::config::Span;
use crate::engine::counters::{PortCounters, add, bump};
use crate::engine::latency::Latency;
use crate::engine::rejection::FieldRejection;
use crate::image::{BitSet, GroupId, Image, InputSet};
use crate::time::{Duration, Instant, Stamp};

/// Maximum number of input frames over all field ports: a stream recipe has one, a CAN recipe one per id.
pub(crate) const MAX_INPUT_FRAMES: usize = 48;

/// One input frame of a device.
#[derive(Debug, Clone, Copy)]
pub(crate) struct InputFrame {
    pub set: InputSet,
    /// Index of the port in the engine.
    pub port: u8,
    /// Its range in the user-defined bindings.
    pub bindings: Span,
    /// When it is overdue; [`Instant::NEVER`] before the first frame, and once it is overdue.
    pub overdue_at: Instant,
    pub timeout: Duration,
    /// Whether its absence counts; false for a reply that is requested only occasionally.
    pub is_expected: bool,
}

impl InputFrame {
    /// Whether it is overdue or has never arrived.
    pub(crate) fn is_overdue(&self) -> bool {
        self.is_expected && self.overdue_at == Instant::NEVER
    }
}

#[derive(Debug, Clone, Copy)]
pub(crate) enum Overdue {
    /// A frame, and how many waiting values were dropped.
    Frame(InputFrame, usize),
    /// Rejected fields of a port's frames, and how many waiting values were dropped.
    Fields(u8, usize),
    /// A rejected command field.
    Command(u8),
    /// The variables of the health of ports, which are due.
    Health,
}

#[derive(Debug, Clone)]
pub(crate) struct Store<Q: ?Sized = VecView<EdgeQueue>> {
    pub latency: Latency,
    pub counts: Counts,
    /// The instant of the current call of the engine.
    pub now: Instant,
    /// Some port sends on a rising bit, or shows the health of ports in frames without a cycle, so the image is checked
    /// after each frame, even if several arrive at once.
    pub watches_bits: bool,
    pub image: Image,
    pub outbox: Outbox,
    /// Their indices are their groups in the image.
    pub frames: Vec<InputFrame, MAX_INPUT_FRAMES>,
    /// Variables with a value of their owner: received in time, or a configured safe value.
    pub live: InputSet,
    /// Variables at their safe value since their owner became overdue.
    pub safe: InputSet,
    /// Variables of `safe` that the controller is not known to have.
    pub unconfirmed: InputSet,
    /// When a variable was last added to `unconfirmed`; `confirmed_at`: when one was last confirmed.
    pub unconfirmed_since: Instant,
    pub(crate) confirmed_at: Instant,
    /// Variables written through recipe links, which do not reply.
    pub unanswered: InputSet,
    /// Variables that the state stream has brought since their owner became overdue, or ever.
    pub read_back: InputSet,
    /// Variables whose owner became overdue before its last value was handed over.
    pub unsent: InputSet,
    /// When the newest state packet or recipe frame arrived; the controller sends these steadily.
    pub(crate) heard_at: Option<Instant>,
    /// Number of gaps between these, wrapping: the controller may have restarted in each.
    pub era: u32,
    /// Variables whose link is up, except those whose bits have owners.
    pub reachable: InputSet,
    /// Variables that are live, reachable and not safe, so that their next frame changes none of these sets. May lack
    /// some.
    settled: InputSet,
    /// Variables whose bits have owners.
    pub bits: Bits,
    /// Variables that report the health of ports to the robot.
    pub health: InputSet,
    /// When the health of ports is checked again.
    health_at: Stamp,
    /// A queue has counted values that were lost with a link.
    has_lost: bool,
    /// No frame is overdue before this.
    pub(crate) next_overdue: Stamp,
    /// No waiting value expires before this.
    next_expiry: Stamp,
    /// Fields that are rejected while their frames are accepted.
    pub withheld: Withheld,
    /// The first rejected field of the newest frame, until its port has noted it.
    pub rejected_field: Vec<FieldRejection, 1>,
    /// One queue per field port.
    pub edges: Q,
}

impl<Q> Store<Q> {
    pub(crate) const fn new(edges: Q) -> Self {
        Self {
            now: Instant::ZERO,
            watches_bits: false,
            latency: Latency::new(),
            counts: Counts::new(),
            image: Image::new(),
            outbox: Outbox::new(),
            frames: Vec::new(),
            live: InputSet::EMPTY,
            safe: InputSet::EMPTY,
            unconfirmed: InputSet::EMPTY,
            unconfirmed_since: Instant::ZERO,
            confirmed_at: Instant::ZERO,
            unanswered: InputSet::EMPTY,
            read_back: InputSet::EMPTY,
            unsent: InputSet::EMPTY,
            heard_at: None,
            era: 0,
            reachable: InputSet::EMPTY,
            settled: InputSet::EMPTY,
            bits: Bits::new(),
            health: InputSet::EMPTY,
            health_at: Stamp::NEVER,
            has_lost: false,
            next_overdue: Stamp::NEVER,
            next_expiry: Stamp::NEVER,
            withheld: Withheld::new(),
            rejected_field: Vec::new(),
            edges,
        }
    }
}

impl Store {
    /// The values of an accepted frame are in the image: queues them to be written. Returns those whose link is up.
    // The cost is in docs/performance.md section 1, like that of the other attributes here.
    #[inline(always)]
    pub(crate) fn accepted(&mut self, nth: usize, counters: &mut PortCounters) -> InputSet {
        let now = self.now;
        let Some(frame) = self.frames.get_mut(nth) else { return InputSet::EMPTY };
        frame.overdue_at = now + frame.timeout;
        self.next_overdue.or_earlier(frame.overdue_at);
        self.next_expiry.or_earlier(too_old_at(now, frame.timeout));
        let (set, port) = (frame.set, usize::from(frame.port));
        self.image.stamp(GroupId(nth as u8), now);
        debug_assert!(self.settled.minus(&self.live.and(&self.reachable).minus(&self.safe)).is_empty());
        if !set.minus(&self.settled).is_empty() && !self.settle(&set) {
            return self.accepted_in_part(nth, counters);
        }
        self.offer(port, &set, counters);
        set
    }

    /// These variables have a value of their owner again. Returns whether all are reachable.
    fn settle(&mut self, set: &InputSet) -> bool {
        self.live = self.live.or(set);
        if !self.safe.and(set).is_empty() {
            // Waiting safe values begin to age now, and may have expired already.
            self.next_expiry = Stamp::at(self.now);
            self.safe = self.safe.minus(set);
            self.unconfirmed = self.unconfirmed.minus(set);
        }
        let are_reachable = set.minus(&self.reachable).is_empty();
        if are_reachable {
            self.settled = self.settled.or(set);
        }
        are_reachable
    }

    /// A frame arrived without a value: its variables keep theirs, and it is not overdue.
    pub(crate) fn not_overdue(&mut self, nth: usize) {
        let Some(frame) = self.frames.get_mut(nth) else { return };
        frame.overdue_at = self.now + frame.timeout;
        self.next_overdue.or_earlier(frame.overdue_at);
    }

    /// The values of the newest frame may be as old as this: their age counts from the earliest request that they may
    /// answer.
    pub(crate) fn was_asked(&mut self, nth: usize, since: Instant) {
        let group = GroupId(nth as u8);
        let Some(frame) = self.frames.get_mut(nth) else { return };
        if self.image.stamp_of(group) != Some(self.now) {
            return;
        }
        self.image.stamp(group, since);
        frame.overdue_at = since + frame.timeout;
        self.next_overdue.or_earlier(frame.overdue_at);
    }

    /// [`Self::accepted`] out of line, for callers that can afford a call.
    pub(crate) fn accepted_apart(&mut self, nth: usize, counters: &mut PortCounters) -> InputSet {
        self.accepted(nth, counters)
    }

    fn offer(&mut self, port: usize, vars: &InputSet, counters: &mut PortCounters) {
        self.outbox.offer_analog(&vars.minus(&InputSet::BYTES));
        if !vars.and(&InputSet::BYTES).is_empty() {
            self.offer_bits(port, vars, counters);
        }
    }

    #[inline(never)]
    fn offer_bits(&mut self, port: usize, vars: &InputSet, counters: &mut PortCounters) {
        let Some(queue) = self.edges.get_mut(port) else { return };
        for var in vars.and(&InputSet::BYTES).iter() {
            let value = self.image.bytes().get(var.image_offset()).copied().unwrap_or(0);
            self.outbox.offer_bits(queue, counters, var, value, self.now);
        }
    }

    /// [`Self::accepted`] for a frame with unreachable variables or with bits that have owners.
    #[cold]
    fn accepted_in_part(&mut self, nth: usize, counters: &mut PortCounters) -> InputSet {
        let Some(frame) = self.frames.get(nth) else { return InputSet::EMPTY };
        let (set, port) = (frame.set, usize::from(frame.port));
        let Some(queue) = self.edges.get_mut(port) else { return InputSet::EMPTY };
        let now = self.now;
        let whole = set.minus(&self.bits.bytes);
        let mut reachable = whole.and(&self.reachable);
        let mut undelivered = reachable != whole;
        // The owner is back, so a safe value that waits for the link is dropped.
        self.outbox.forget(queue, &whole.minus(&reachable));
        let mut bits = InputSet::EMPTY;
        if whole != set {
            let offered = self.bits.accepted(nth, queue, counters, &self.image, now);
            undelivered |= offered.undelivered;
            bits = offered.reachable;
            if offered.was_safe {
                self.next_expiry = Stamp::at(now);
            }
        }
        if undelivered {
            bump(&mut counters.undelivered);
        }
        self.offer(port, &reachable, counters);
        self.bits_changed();
        reachable = reachable.or(&bits);
        reachable
    }

    /// Bits with owners, or their bytes in the image, have changed: updates the sets of whole variables.
    pub(crate) fn bits_changed(&mut self) {
        for var in self.bits.bytes.iter() {
            let value = self.bits.next_byte(var, &self.image);
            self.outbox.set_shared(var, self.bits.dirty.byte(var) != 0, value);
            for (set, is_in) in [
                (&mut self.live, self.bits.live.byte(var) == var.valid_bits()),
                (&mut self.safe, self.bits.safe.byte(var) != 0),
                (&mut self.unconfirmed, self.bits.unconfirmed.byte(var) != 0),
            ] {
                if is_in {
                    set.insert(var);
                } else {
                    set.remove(var);
                }
            }
        }
    }

    /// Handles the first thing that is overdue; the variables of a frame take their safe values. Call it until it
    /// returns `None`.
    pub(crate) fn next_timeout(&mut self, safe: &[SafeBytes]) -> Option<Overdue> {
        let now = self.now;
        if now < self.next_overdue.get() {
            return None;
        }
        let overdue = self.frames.iter_mut().enumerate().find(|(_, frame)| frame.overdue_at <= now);
        let Some((nth, frame)) = overdue else {
            if self.withheld.is_used
                && let Some(overdue) = self.next_field_timeout(safe)
            {
                return Some(overdue);
            }
            if self.health_at.get() <= now {
                self.health_at = Stamp::NEVER;
                return Some(Overdue::Health);
            }
            let next = self.frames.iter().map(|frame| frame.overdue_at).min();
            let mut next = next.unwrap_or(Instant::NEVER).min(self.health_at.get());
            if self.withheld.is_used {
                next = next.min(self.withheld.deadline());
            }
            self.next_overdue = Stamp::at(next);
            return None;
        };
        let is_from_start = frame.overdue_at == Instant::ZERO;
        frame.overdue_at = Instant::NEVER;
        let frame = *frame;
        if !is_from_start && self.image.stamp_of(GroupId(nth as u8)).is_none() {
            // The device has only sent frames without a value so far: nothing was written.
            return Some(Overdue::Frame(frame, 0));
        }
        let dropped = self.time_out((GroupId(nth as u8), frame.port), &frame.set, safe);
        Some(Overdue::Frame(frame, dropped))
    }

    /// Handles the first rejected field that is overdue.
    fn next_field_timeout(&mut self, safe: &[SafeBytes]) -> Option<Overdue> {
        if let Some(field) = self.withheld.next_command(self.now) {
            return Some(Overdue::Command(field));
        }
        let (group, frame) = self.withheld.next_overdue(self.now)?;
        let port = self.frames.get(usize::from(frame))?.port;
        let dropped = self.time_out((group, port), &members(&self.image, group), safe);
        Some(Overdue::Fields(port, dropped))
    }

    /// The variables of a group take their safe values or hold. Returns how many waiting values were dropped.
    fn time_out(&mut self, (group, port): (GroupId, u8), set: &InputSet, safe: &[SafeBytes]) -> usize {
        let now = self.now;
        self.settled = self.settled.minus(set);
        let Some(queue) = self.edges.get_mut(usize::from(port)) else { return 0 };
        let mut dropped = 0_usize;
        for var in set.minus(&self.bits.bytes).iter() {
            let Some(value) = safe.iter().find(|safe| safe.var == var) else {
                if !self.live.contains(var) {
                    // It never had a value.
                    continue;
                }
                let waited = self.outbox.forget(queue, &InputSet::from_iter([var]));
                dropped = dropped.saturating_add(waited);
                match waited {
                    0 => self.unsent.remove(var),
                    _ => self.unsent.insert(var),
                }
                self.live.remove(var);
                self.read_back.remove(var);
                continue;
            };
            let place = self.image.bytes_mut().get_mut(var.image_offset()..);
            for (target, byte) in place.into_iter().flatten().zip(value.bytes).take(var.size()) {
                *target = byte;
            }
            self.outbox.offer_safe(queue, var, value.bytes[0], now);
            // The owner may never have sent it.
            self.live.insert(var);
            self.safe.insert(var);
            self.unconfirmed.insert(var);
            self.unconfirmed_since = now;
        }
        if self.bits.is_used {
            let TimedOut { dropped: bits, is_safe, held } =
                self.bits.time_out(group, queue, &mut self.image, safe, now);
            dropped = dropped.saturating_add(bits);
            self.read_back = self.read_back.minus(&held);
            if is_safe {
                self.unconfirmed_since = now;
            }
            self.bits_changed();
        }
        dropped
    }

    /// The frames that are overdue from the start are handled at the first tick.
    pub(crate) fn overdue_from_start(&mut self) {
        self.next_overdue = Stamp::at(Instant::ZERO);
    }

    /// Makes all frames that are not overdue yet overdue at the next tick.
    pub(crate) fn all_overdue(&mut self) {
        for frame in self.frames.iter_mut().filter(|frame| frame.overdue_at != Instant::NEVER) {
            frame.overdue_at = Instant::ZERO;
        }
        self.withheld.all_overdue();
        self.next_overdue = Stamp::at(Instant::ZERO);
    }

    /// Sets when the health of ports is checked next.
    pub(crate) fn check_health_at(&mut self, at: Instant) {
        self.health_at = Stamp::at(at);
        self.next_overdue.or_earlier(at);
    }

    /// These variables of the health of ports have new values: they are written at once if their link is up, else when
    /// it comes up.
    pub(crate) fn tell(&mut self, vars: &InputSet) {
        self.live = self.live.or(vars);
        self.outbox.again(&vars.and(&self.reachable));
    }

    /// Whether a waiting value may have expired.
    pub(crate) fn may_expire(&self) -> bool {
        self.now >= self.next_expiry.get()
    }

    /// Drops values that have waited for longer than their port's timeout, and counts them there.
    pub(crate) fn expire_waiting(&mut self, mut count: impl FnMut(usize, usize)) {
        self.next_expiry = Stamp::NEVER;
        for nth in 0..self.frames.len() {
            let Some(frame) = self.frames.get(nth) else { break };
            if !frame.set.and(&self.outbox.dirty()).is_empty() {
                let frame = *frame;
                self.expire_set((GroupId(nth as u8), nth), &frame, &mut count);
            }
        }
        if self.withheld.is_used {
            // Groups that are overdue already only wait with their safe values.
            for (group, nth) in self.withheld.groups() {
                if let Some(frame) = self.frames.get(usize::from(nth)).copied() {
                    let own = InputFrame { set: members(&self.image, group), ..frame };
                    self.expire_set((group, usize::from(nth)), &own, &mut count);
                }
            }
        }
        if self.bits.is_used {
            self.bits_changed();
        }
    }

    /// [`Self::expire_waiting`] for one group: that of the `nth` frame, or of rejected fields of it.
    fn expire_set(
        &mut self,
        (group, nth): (GroupId, usize),
        frame: &InputFrame,
        count: &mut impl FnMut(usize, usize),
    ) {
        let now = self.now;
        let bits = self.outbox.dirty().and(&self.bits.bytes).and(&frame.set);
        let bytes = InputSet::BYTES.minus(&self.bits.bytes);
        let dirty = frame.set.and(&self.outbox.dirty()).minus(&self.safe);
        let waiting = dirty.and(&bytes);
        let newest = dirty.minus(&InputSet::BYTES);
        if dirty.is_empty() && bits.is_empty() {
            return;
        }
        let port = usize::from(frame.port);
        if let Some(queue) = self.edges.get_mut(port) {
            let (mut dropped, mut oldest) = (0, Instant::NEVER);
            if !newest.is_empty()
                && let Some(at) = self.image.stamp_of(group)
            {
                // Frames without a value keep the device from being overdue while its value waits.
                if now.saturating_since(at) > frame.timeout {
                    dropped = self.outbox.forget(queue, &newest);
                } else {
                    oldest = at;
                }
            }
            if !waiting.is_empty() {
                let (more, older) = self.outbox.expire(queue, &waiting, frame.timeout, now);
                (dropped, oldest) = (dropped.saturating_add(more), oldest.min(older));
            }
            if !bits.is_empty() {
                let (more, older) = self.bits.expire(nth, queue, frame.timeout, now);
                (dropped, oldest) = (dropped.saturating_add(more), oldest.min(older));
            }
            let too_old = too_old_at(oldest, frame.timeout);
            self.next_expiry.or_earlier(too_old);
            if dropped > 0 {
                count(port, dropped);
            }
        }
    }

    pub(crate) fn deadline(&self) -> Instant {
        self.next_overdue.get().min(self.next_expiry.get())
    }

    /// These values have been handed over to their link.
    pub(crate) fn taken(&mut self, vars: &InputSet) {
        self.outbox.taken(vars);
        let bits = vars.and(&InputSet::BYTES);
        if !bits.is_empty() {
            for queue in self.edges.iter_mut() {
                self.outbox.next_edges(queue, &bits);
            }
            if self.bits.is_used {
                self.bits_taken(BitSet::all_of(&bits));
            }
        }
    }

    /// These bits have been handed over to their link.
    pub(crate) fn bits_taken(&mut self, bits: BitSet) {
        self.bits.taken(bits, &mut self.edges);
        self.bits_changed();
    }

    /// A link came up: frames are passed on to it from now on, but no earlier ones. The health of ports is sent as it
    /// is now.
    pub(crate) fn link_up(&mut self, vars: &InputSet) {
        self.reachable = self.reachable.or(&vars.minus(&self.bits.bytes));
        self.outbox.again(&vars.and(&self.health).and(&self.live));
        self.bits.link_up(&vars.and(&self.bits.bytes));
    }

    /// A link was lost: drops waiting values, except safe values.
    pub(crate) fn link_lost(&mut self, vars: &InputSet) {
        self.reachable = self.reachable.minus(vars);
        self.settled = self.settled.minus(vars);
        for frame in &self.frames {
            let port = usize::from(frame.port);
            let Some(queue) = self.edges.get_mut(port) else { continue };
            let whole = frame.set.and(vars).minus(&self.bits.bytes);
            let dropped = self.outbox.forget(queue, &whole.minus(&self.safe));
            add(&mut queue.lost, dropped);
            self.has_lost |= dropped > 0;
        }
        if self.withheld.is_used {
            self.withheld_lost(vars);
        }
        let bytes = vars.and(&self.bits.bytes);
        if bytes.is_empty() {
            return;
        }
        self.has_lost |= self.bits.link_lost(&bytes, &mut self.edges);
        self.bits_changed();
    }

    /// [`Self::link_lost`] for variables whose fields are rejected.
    fn withheld_lost(&mut self, vars: &InputSet) {
        for (group, nth) in self.withheld.groups() {
            let Some(port) = self.frames.get(usize::from(nth)).map(|frame| usize::from(frame.port)) else {
                continue;
            };
            let Some(queue) = self.edges.get_mut(port) else { continue };
            let whole = members(&self.image, group).and(vars);
            let dropped = self.outbox.forget(queue, &whole.minus(&self.safe));
            add(&mut queue.lost, dropped);
            self.has_lost |= dropped > 0;
        }
    }

    /// Whether values have been lost with a link since the last call.
    pub(crate) fn take_has_lost(&mut self) -> bool {
        core::mem::take(&mut self.has_lost)
    }
}

/// When a value that waits since `at` has waited for longer than `timeout`.
fn too_old_at(at: Instant, timeout: Duration) -> Instant {
    at + timeout + Duration::from_micros(1)
}
