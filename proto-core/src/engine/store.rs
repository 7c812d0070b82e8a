//! What the ports and links of one engine share: the image, the outbox, and for each field frame
//! when it is overdue.

use heapless::Vec;

use super::counters::{PortCounters, bump};
use super::outbox::{EdgeQueue, Outbox};
use crate::config::SafeValue;
use crate::image::{GroupId, Image, InputSet};
use crate::sysvar::SysVar;
use crate::time::{Duration, Instant};

/// Input frames over all field ports: a stream recipe has one, a CAN recipe one an id.
pub const MAX_INPUT_FRAMES: usize = 48;

/// One frame that a device sends.
#[derive(Debug, Clone, Copy)]
pub(super) struct InputFrame {
    /// The variables it carries.
    pub set: InputSet,
    /// The port's place in the engine.
    pub port: u8,
    /// When it is overdue; [`Instant::NEVER`] before the first one and after it was.
    pub overdue_at: Instant,
    /// How long it may take.
    pub timeout: Duration,
}

/// A safe value as it stands in the image.
#[derive(Debug, Clone, Copy)]
pub(super) struct SafeBytes {
    var: SysVar,
    bytes: [u8; 4],
}

impl SafeBytes {
    pub(super) fn new(safe: &SafeValue) -> Self {
        let mut bytes = [0; 4];
        // Every variable has at most four bytes, and validation saw to the type.
        safe.value.encode(&mut bytes);
        Self { var: safe.var, bytes }
    }
}

#[derive(Debug, Clone)]
pub(super) struct Store<const PORTS: usize> {
    pub image: Image,
    pub outbox: Outbox,
    /// One queue a field port.
    pub edges: Vec<EdgeQueue, PORTS>,
    /// Their indices are the frames' groups in the image.
    pub frames: Vec<InputFrame, MAX_INPUT_FRAMES>,
    /// Variables whose value is their owner's: received in time, or configured as safe.
    pub live: InputSet,
    /// Variables whose link is up.
    pub reachable: InputSet,
    /// No frame is overdue before this.
    pub next_overdue: Instant,
}

impl<const PORTS: usize> Store<PORTS> {
    pub(super) const fn new() -> Self {
        Self {
            image: Image::new(),
            outbox: Outbox::new(),
            edges: Vec::new(),
            frames: Vec::new(),
            live: InputSet::EMPTY,
            reachable: InputSet::EMPTY,
            next_overdue: Instant::NEVER,
        }
    }

    /// The values of an accepted frame stand in the image: they are to be written.
    pub(super) fn accepted(&mut self, nth: usize, counters: &mut PortCounters, now: Instant) {
        let Some(frame) = self.frames.get_mut(nth) else { return };
        frame.overdue_at = now + frame.timeout;
        self.next_overdue = self.next_overdue.min(frame.overdue_at);
        let (set, port) = (frame.set, usize::from(frame.port));
        self.image.stamp(GroupId(nth as u8), now);
        self.live = self.live.or(&set);
        let reachable = set.and(&self.reachable);
        if reachable != set {
            bump(&mut counters.undelivered);
        }
        self.outbox.offer_analog(&reachable.minus(&InputSet::BYTES));
        let Some(queue) = self.edges.get_mut(port) else { return };
        for var in reachable.and(&InputSet::BYTES).iter() {
            let value = self.image.bytes().get(var.image_offset()).copied().unwrap_or(0);
            self.outbox.offer_bits(queue, counters, var, value, now);
        }
    }

    /// The first frame that is overdue at `now`, with its variables set to their safe values; call
    /// again until `None`.
    pub(super) fn next_timeout(&mut self, safe: &[SafeBytes], now: Instant) -> Option<InputFrame> {
        if now < self.next_overdue {
            return None;
        }
        let Some(frame) = self.frames.iter_mut().find(|frame| frame.overdue_at <= now) else {
            let next = self.frames.iter().map(|frame| frame.overdue_at).min();
            self.next_overdue = next.unwrap_or(Instant::NEVER);
            return None;
        };
        frame.overdue_at = Instant::NEVER;
        let frame = *frame;
        let queue = self.edges.get_mut(usize::from(frame.port))?;
        for var in frame.set.iter() {
            let Some(value) = safe.iter().find(|safe| safe.var == var) else {
                self.outbox.drop_all(queue, var);
                self.live.remove(var);
                continue;
            };
            let place = self.image.bytes_mut().get_mut(var.image_offset()..);
            for (target, byte) in place.into_iter().flatten().zip(value.bytes).take(var.size()) {
                *target = byte;
            }
            self.outbox.offer_safe(queue, var, value.bytes[0], now);
        }
        Some(frame)
    }

    /// Drops what has waited for longer than its port's timeout and counts it there.
    pub(super) fn expire_waiting(&mut self, mut count: impl FnMut(usize, usize), now: Instant) {
        for frame in &self.frames {
            let waiting = frame.set.and(&InputSet::BYTES).and(&self.outbox.dirty());
            if waiting.is_empty() {
                continue;
            }
            let port = usize::from(frame.port);
            if let Some(queue) = self.edges.get_mut(port) {
                let dropped = self.outbox.expire(queue, &waiting, frame.timeout, now);
                if dropped > 0 {
                    count(port, dropped);
                }
            }
        }
    }

    /// These values have been handed to their link.
    pub(super) fn taken(&mut self, vars: &InputSet) {
        for var in vars.iter() {
            let owner = self.image.group(var).and_then(|group| self.frames.get(usize::from(group.0)));
            let queue = owner.and_then(|frame| self.edges.get_mut(usize::from(frame.port)));
            if let Some(queue) = queue {
                self.outbox.taken(queue, var);
            }
        }
    }

    /// A link came up: from now on frames are passed on to it. What was received before is not.
    pub(super) fn link_up(&mut self, vars: &InputSet) {
        self.reachable = self.reachable.or(vars);
    }

    /// A link was lost: nothing that waited for it is written later, safe values excepted.
    pub(super) fn link_lost(&mut self, vars: &InputSet) {
        self.reachable = self.reachable.minus(vars);
        self.outbox.drop_unsafe(vars);
        for queue in &mut self.edges {
            queue.clear_vars(vars);
        }
    }
}
