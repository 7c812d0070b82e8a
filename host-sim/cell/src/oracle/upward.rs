//! The values to be written to the controller, and checks of each write (proto-core/docs/engine.md section 5).

mod bits;

use std::collections::{BTreeMap, BTreeSet, VecDeque};

use proto_core::engine::LinkId;
use proto_core::sysvar::{COUNT, SysVar};
use proto_core::time::{Duration, Instant};
use proto_core::wire::scalar::ScalarType;

use super::Invariant;
use super::field::{Accepted, show};
use super::frame::Raw;
use super::invariant::Wrong;
use super::spec::{LinkSpec, Origin, Owned, Spec};
use bits::Waits;

/// Maximum number of values per port that wait behind the next value of their variable.
pub(super) const EDGES: usize = 16;
/// Maximum number of groups of rejected fields that have separate timeouts at once.
const GROUPS: usize = 12;
/// Maximum age of a value that was read back.
const READ_BACK: Duration = Duration::from_millis(500);

/// After this long without the data that the controller normally sends steadily, it may have restarted.
const AWAY: Duration = Duration::from_millis(500);

/// Whether no data has come for longer than [`AWAY`].
pub(super) fn is_gap(last: Option<Instant>, now: Instant) -> bool {
    last.is_none_or(|at| now.saturating_since(at) > AWAY)
}

/// The state of one variable.
#[derive(Debug, Clone, Default)]
pub(super) struct Known {
    /// The value that a port would send now, and when it arrived.
    pub value: Option<(Raw, Instant)>,
    /// Values to be written, the next one first, each with the time of its frame.
    pub waiting: VecDeque<(Raw, Instant)>,
    /// When the newest field frame with the variable was accepted.
    pub accepted: Option<Instant>,
    /// As `accepted`, but also when a frame of the owner reported that it has no news.
    pub heard: Option<Instant>,
    /// The owner is not overdue, or the variable has its safe value.
    pub live: bool,
    /// The variable has its safe value.
    pub safe: bool,
    /// When the safe value was last set, including repetitions.
    pub safe_at: Instant,
    /// The state stream has shown the variable since its owner became overdue, or ever.
    pub read_back: bool,
    /// The newest value from the controller was not finite.
    pub unreadable: bool,
    /// The variable has its safe value, but the controller is not known to have it.
    pub unconfirmed: bool,
    /// The owner became overdue before the last value was sent.
    pub unsent: bool,
    /// Values that waited while the gateway slept; `None` once a frame has arrived since.
    pub slept: Option<Vec<Raw>>,
    /// The variable's field was rejected in the newest frame of its owner.
    pub alone: Option<Alone>,
    /// The variable has its safe value, and never had another value.
    pub unknown: bool,
}

/// The timeout of a rejected field.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub(super) struct Alone {
    /// When the field is overdue; `None` once it was.
    pub overdue: Option<Instant>,
    /// When its newest value arrived.
    pub since: Option<Instant>,
}

impl Known {
    /// Whether it is neither the current value nor waiting.
    fn is_news(&self, raw: Raw) -> bool {
        self.value.is_none_or(|value| value.0 != raw) && self.waiting.iter().all(|next| next.0 != raw)
    }
}

/// The origin of a value that was sent.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Carried {
    /// A safe value.
    Safe,
    /// As far as is known, the controller has held the value since the last frame of its overdue owner.
    Held { accepted: Instant },
    /// The value arrived at this time, in a frame of its owner or from the state stream, and may be this old when it is
    /// sent.
    Of { arrived: Instant, timeout: Duration },
}

/// The counters that a port is expected to have.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct Counted {
    pub edges_lost: u32,
    pub values_expired: u32,
    pub undelivered: u32,
    pub timeouts: u32,
}

/// The values of all variables, and their progress.
#[derive(Debug, Clone)]
pub(super) struct Upward {
    pub known: Vec<Known>,
    pub shares: Vec<Waits>,
    /// When each input frame of each port is overdue.
    overdue: Vec<Vec<Option<Instant>>>,
    /// When each input frame was last accepted.
    taken: Vec<Vec<Option<Instant>>>,
    /// The command fields that are rejected, by port, frame and field.
    pub commands_alone: BTreeMap<(usize, usize, usize), Alone>,
    pub counted: Vec<Counted>,
    /// When the links that carry values came up; `None` while they are down.
    pub up: [Option<Instant>; 16],
    /// The links that are up, as a bit set.
    pub are_up: u16,
    pub state_at: Option<Instant>,
    /// When the newest frame of each recipe link arrived, on any connection.
    pub frame_at: [Option<Instant>; 16],
    /// When data that the controller sends steadily last arrived, and how often it arrived after a gap.
    heard_at: Option<Instant>,
    pub era: u64,
    /// When a frame was last sent on the current connection of each recipe link, and in which era.
    pub handed_over: [Option<(Instant, u64)>; 16],
    /// When a safe value last became unconfirmed.
    pub unconfirmed_at: Instant,
    /// When a safe value of a recipe link was last confirmed.
    pub confirmed_at: Option<Instant>,
    /// When each recipe link repeats safe values.
    pub rewrite_at: [Instant; 16],
    /// No frame becomes overdue before this.
    next_overdue: Instant,
    /// No waiting value expires before this.
    pub next_expiry: Instant,
    /// Bit set of variables that may have waiting values, by ordinal: inputs come first.
    pub waits: u128,
}

impl Upward {
    pub(super) fn new(spec: &Spec) -> Self {
        Self {
            known: vec![Known::default(); COUNT],
            shares: vec![Waits::default(); spec.shares.len()],
            overdue: spec.ports.iter().map(|port| vec![None; port.inputs.len()]).collect(),
            taken: spec.ports.iter().map(|port| vec![None; port.inputs.len()]).collect(),
            commands_alone: BTreeMap::new(),
            counted: vec![Counted::default(); spec.ports.len()],
            up: [None; 16],
            are_up: 0,
            state_at: None,
            frame_at: [None; 16],
            heard_at: None,
            era: 0,
            handed_over: [None; 16],
            unconfirmed_at: Instant::ZERO,
            confirmed_at: None,
            rewrite_at: [Instant::NEVER; 16],
            next_overdue: Instant::NEVER,
            next_expiry: Instant::NEVER,
            waits: 0,
        }
    }

    pub(super) fn known(&self, var: SysVar) -> &Known {
        &self.known[var.ordinal()]
    }

    fn known_mut(&mut self, var: SysVar) -> &mut Known {
        &mut self.known[var.ordinal()]
    }

    pub(super) fn is_up(&self, link: LinkId) -> bool {
        self.are_up >> link.0 & 1 == 1
    }

    /// The frames that have become overdue, as port and index. Their variables get safe values, or hold.
    pub(super) fn overdue(&mut self, spec: &Spec, now: Instant) -> Vec<(usize, usize)> {
        let mut overdue = Vec::new();
        if now < self.next_overdue {
            return overdue;
        }
        self.next_overdue = Instant::NEVER;
        for (nth, port) in spec.ports.iter().enumerate().filter(|(_, port)| port.is_field) {
            for (frame, part) in port.inputs.iter().enumerate() {
                match self.overdue[nth][frame] {
                    Some(at) if now >= at => {}
                    Some(at) => {
                        self.next_overdue = self.next_overdue.min(at);
                        continue;
                    }
                    None => continue,
                }
                self.overdue[nth][frame] = None;
                self.counted[nth].timeouts += 1;
                overdue.push((nth, frame));
                for &var in &part.written {
                    if self.known(var).alone.is_none() {
                        self.fell_silent(spec, var, now);
                    }
                }
                self.bits_silent(spec, nth, frame, now);
            }
        }
        overdue
    }

    /// Handles rejected fields whose own timeout is over. Returns the command fields among them, and whether there were
    /// any.
    pub(super) fn overdue_alone(&mut self, spec: &Spec, now: Instant) -> (Vec<(usize, usize, usize)>, bool) {
        let is_over =
            |alone: &Option<Alone>| alone.and_then(|alone| alone.overdue).is_some_and(|at| now >= at);
        let vars: Vec<SysVar> =
            SysVar::all().filter(|var| is_over(&self.known[var.ordinal()].alone)).collect();
        for &var in &vars {
            let known = self.known_mut(var);
            known.alone = known.alone.map(|alone| Alone { overdue: None, ..alone });
            let has_safe = spec.owned[var.ordinal()].is_some_and(|owned| owned.safe.is_some());
            if known.accepted.is_none() && has_safe {
                (known.accepted, known.unknown, known.live) = (Some(now), true, true);
            }
            self.fell_silent(spec, var, now);
        }
        let shares: Vec<usize> =
            (0..self.shares.len()).filter(|&nth| is_over(&self.shares[nth].alone)).collect();
        for &nth in &shares {
            let alone = &mut self.shares[nth].alone;
            *alone = alone.map(|alone| Alone { overdue: None, ..alone });
            self.share_silent(spec, nth, now);
        }
        let over = self.commands_alone.iter().filter(|(_, alone)| is_over(&Some(**alone)));
        let commands: Vec<_> = over.map(|(place, _)| *place).collect();
        commands.iter().for_each(|place| _ = self.commands_alone.remove(place));
        let any = !vars.is_empty() || !shares.is_empty() || !commands.is_empty();
        (commands, any)
    }

    /// The timeout of fields that are rejected in this frame but were not in the previous one.
    fn alone(&self, spec: &Spec, nth: usize, frame: usize, now: Instant) -> Alone {
        let since = self.taken[nth][frame];
        let timeout = spec.ports[nth].timeout;
        let overdue = match since {
            Some(at) => self.overdue[nth][frame].map(|_| at + timeout),
            None => Some(now + timeout),
        };
        Alone { overdue, since }
    }

    /// Whether the rejected fields of a frame can have a separate timeout, in addition to all others.
    pub(super) fn has_room(&self, spec: &Spec, nth: usize, frame: &Accepted, now: Instant) -> bool {
        let of_var = |var: &SysVar| {
            let owned = spec.owned[var.ordinal()];
            let key = owned.map(|owned| (owned.port, owned.frame));
            key.zip(self.known(*var).alone)
        };
        let vars = SysVar::all().filter_map(|var| of_var(&var));
        let shares = self.shares.iter().zip(&spec.shares);
        let shares = shares.filter_map(|(state, share)| Some(((share.port, share.frame), state.alone?)));
        let commands = self.commands_alone.iter().map(|(place, alone)| ((place.0, place.1), *alone));
        let groups: BTreeSet<_> =
            vars.chain(shares).chain(commands).filter(|(_, alone)| alone.overdue.is_some()).collect();
        let without = &frame.without;
        let is_new = without.vars.iter().any(|var| self.known(*var).alone.is_none())
            || spec.shares.iter().zip(&self.shares).any(|(share, state)| {
                (share.port, share.frame) == (nth, frame.frame)
                    && without.bytes.contains(&share.var)
                    && state.alone.is_none()
            })
            || without.commands.iter().any(|at| !self.commands_alone.contains_key(&(nth, frame.frame, *at)));
        let own = ((nth, frame.frame), self.alone(spec, nth, frame.frame, now));
        !is_new || groups.contains(&own) || groups.len() < GROUPS
    }

    /// Drops values that have waited too long.
    pub(super) fn expire(&mut self, spec: &Spec, now: Instant) {
        if now < self.next_expiry {
            return;
        }
        self.next_expiry = Instant::NEVER;
        for (nth, port) in spec.ports.iter().enumerate().filter(|(_, port)| port.is_field) {
            for &var in &port.written {
                let known = &mut self.known[var.ordinal()];
                if known.safe {
                    continue;
                }
                let before = known.waiting.len();
                known.waiting.retain(|(_, at)| now.saturating_since(*at) <= port.timeout);
                self.counted[nth].values_expired += (before - known.waiting.len()) as u32;
                for (_, at) in &known.waiting {
                    self.next_expiry = self.next_expiry.min(*at + port.timeout + Duration::from_micros(1));
                }
            }
            self.expire_bits(spec, nth, port.timeout, now);
        }
    }

    fn fell_silent(&mut self, spec: &Spec, var: SysVar, now: Instant) {
        let Some(Owned { port, safe, .. }) = spec.owned[var.ordinal()] else { return };
        if self.known(var).accepted.is_none() {
            return;
        }
        self.waits |= 1 << var.ordinal();
        let known = self.known_mut(var);
        if let Some(safe) = safe {
            known.waiting.clear();
            known.waiting.push_back((safe, now));
            known.value = Some((safe, known.value.map_or(now, |value| value.1)));
            known.safe = true;
            known.safe_at = now;
            known.unconfirmed = true;
            self.unconfirmed_at = now;
        } else {
            let waited = known.waiting.len() as u32;
            known.waiting.clear();
            known.live = false;
            known.read_back = false;
            known.unsent = waited > 0;
            self.counted[port].values_expired += waited;
        }
    }

    /// A frame without news arrived, so its device is present.
    pub(super) fn not_overdue(&mut self, spec: &Spec, nth: usize, frame: usize, now: Instant) {
        let at = now + spec.ports[nth].timeout;
        self.overdue[nth][frame] = Some(at);
        self.next_overdue = self.next_overdue.min(at);
        for &var in &spec.ports[nth].inputs[frame].written {
            let known = self.known_mut(var);
            if known.alone.is_none() {
                known.heard = Some(now);
            }
        }
    }

    /// Applies a frame.
    pub(super) fn accepted(&mut self, spec: &Spec, nth: usize, frame: &Accepted, now: Instant) {
        let timeout = spec.ports[nth].timeout;
        let alone = self.alone(spec, nth, frame.frame, now);
        for var in &frame.without.vars {
            self.known_mut(*var).alone.get_or_insert(alone);
        }
        for (state, share) in self.shares.iter_mut().zip(&spec.shares) {
            if (share.port, share.frame) == (nth, frame.frame) {
                match frame.without.bytes.contains(&share.var) {
                    true => _ = state.alone.get_or_insert(alone),
                    false => state.alone = None,
                }
            }
        }
        for (at, ..) in &frame.commands {
            self.commands_alone.remove(&(nth, frame.frame, *at));
        }
        if alone.since.is_some() && alone.overdue.is_some() {
            for at in &frame.without.commands {
                self.commands_alone.entry((nth, frame.frame, *at)).or_insert(alone);
            }
        }
        self.taken[nth][frame.frame] = Some(now);
        self.overdue[nth][frame.frame] = Some(now + timeout);
        self.next_overdue = self.next_overdue.min(now + timeout);
        self.next_expiry = self.next_expiry.min(now + timeout + Duration::from_micros(1));
        let mut undelivered = self.bits_accepted(spec, nth, frame, now);
        for &(var, raw) in &frame.values {
            let Some(Owned { way, .. }) = spec.owned[var.ordinal()] else { continue };
            self.waits |= 1 << var.ordinal();
            let is_up = self.is_up(way);
            let queued: usize = if var.is_bits() { self.queued(spec, nth) } else { 0 };
            let known = self.known_mut(var);
            known.value = Some((raw, now));
            (known.accepted, known.heard) = (Some(now), Some(now));
            known.live = true;
            known.alone = None;
            known.unknown = false;
            known.unconfirmed = false;
            known.unreadable = false;
            known.slept = None;
            if std::mem::take(&mut known.safe) {
                // Its safe value may still wait, and can expire from now on.
                self.next_expiry = now;
            }
            let known = &mut self.known[var.ordinal()];
            if !is_up {
                undelivered = true;
                known.waiting.clear();
                continue;
            }
            if !var.is_bits() {
                known.waiting.clear();
                known.waiting.push_back((raw, now));
                continue;
            }
            match known.waiting.back_mut() {
                None => known.waiting.push_back((raw, now)),
                Some(newest) if newest.0 == raw => newest.1 = now,
                Some(newest) if queued >= EDGES => {
                    *newest = (raw, now);
                    self.counted[nth].edges_lost += 1;
                }
                Some(_) => known.waiting.push_back((raw, now)),
            }
        }
        self.counted[nth].undelivered += u32::from(undelivered);
        if let Some(since) = frame.asked {
            self.was_asked(nth, frame, timeout, since);
        }
    }

    /// The values of a frame may be as old as this.
    fn was_asked(&mut self, nth: usize, frame: &Accepted, timeout: Duration, since: Instant) {
        self.taken[nth][frame.frame] = Some(since);
        self.overdue[nth][frame.frame] = Some(since + timeout);
        self.next_overdue = self.next_overdue.min(since + timeout);
        self.next_expiry = self.next_expiry.min(since + timeout + Duration::from_micros(1));
        for &(var, _) in frame.values.iter().filter(|(var, _)| !var.is_bits()) {
            let known = self.known_mut(var);
            (known.accepted, known.heard) = (Some(since), Some(since));
            if let Some(value) = &mut known.value {
                value.1 = since;
            }
            if let Some(newest) = known.waiting.back_mut() {
                newest.1 = since;
            }
        }
    }

    /// Number of the port's values that wait behind others.
    pub(super) fn queued(&self, spec: &Spec, nth: usize) -> usize {
        let waiting = spec.ports[nth].written_bits.iter();
        let whole: usize = waiting.map(|var| self.known(*var).waiting.len().saturating_sub(1)).sum();
        whole + self.queued_bits(spec, nth)
    }

    /// A link came up.
    pub(super) fn link_up(&mut self, link: LinkId, now: Instant) {
        self.up[usize::from(link.0)] = Some(now);
        self.are_up |= 1 << link.0;
        self.handed_over[usize::from(link.0)] = None;
    }

    /// A link was lost: waiting values are dropped, except safe values.
    pub(super) fn link_lost(&mut self, spec: &Spec, link: LinkId) {
        if self.up[usize::from(link.0)].take().is_none() {
            return;
        }
        self.are_up &= !(1 << link.0);
        self.rewrite_at[usize::from(link.0)] = Instant::NEVER;
        if link == LinkId::MODBUS {
            self.bits_lost(spec);
        }
        for (known, owned) in self.known.iter_mut().zip(&spec.owned) {
            if let Some(owned) = owned
                && owned.way == link
                && !known.safe
            {
                self.counted[owned.port].values_expired += known.waiting.len() as u32;
                known.waiting.clear();
            }
        }
    }

    /// A packet of the state stream was accepted.
    pub(super) fn state_packet(&mut self, spec: &Spec, packet: &[u8], now: Instant) {
        self.state_at = Some(now);
        self.heard(now);
        for &var in &spec.in_packet {
            let nth = var.ordinal();
            let is_shown = spec.origin[nth] == Some(Origin::State);
            let is_read_back = spec.read_back[nth] && !self.known[nth].live;
            if !is_shown && !is_read_back {
                continue;
            }
            let known = &mut self.known[nth];
            let raw = in_packet(var, packet);
            known.unreadable = raw.is_none();
            if is_read_back {
                known.read_back = raw.is_some();
            }
            if let Some(raw) = raw {
                known.value = Some((raw, now));
            }
        }
        if spec.safe_vars.iter().any(|var| self.known(*var).safe) {
            self.compare_safe(spec, packet, now);
        }
    }

    /// A packet or a recipe frame arrived. After a gap the controller may have restarted: what was sent before by
    /// datagram no longer counts.
    pub(super) fn heard(&mut self, now: Instant) {
        if is_gap(self.heard_at.replace(now), now) {
            self.era += 1;
        }
    }

    /// When a frame was last sent to a controller that has not restarted since, as far as is known.
    fn handed_over(&self, link: &LinkSpec, now: Instant) -> Option<Instant> {
        let (at, era) = self.handed_over[usize::from(link.id.0)]?;
        let is_there = !link.is_datagram || era == self.era && !is_gap(self.heard_at, now);
        is_there.then_some(at)
    }

    /// For a variable that is not read back: when its newest value was accepted; `None` if the controller
    /// does not have that value.
    fn held(&self, link: &LinkSpec, known: &Known, now: Instant) -> Option<Instant> {
        let handed_over = self.handed_over(link, now)?;
        known.accepted.filter(|&at| handed_over >= at && !known.unsent)
    }

    /// A value came on a link; one that is not finite makes the variable unreadable.
    pub(super) fn received(&mut self, var: SysVar, raw: Raw, now: Instant) {
        let known = self.known_mut(var);
        known.unreadable = var.ty() == ScalarType::Float && !f32::from_le_bytes(raw).is_finite();
        if !known.unreadable {
            known.value = Some((raw, now));
        }
    }

    /// Checks a write of a variable and takes its value from the queue; returns the value's origin.
    pub(super) fn wrote(
        &mut self,
        spec: &Spec,
        link: LinkId,
        var: SysVar,
        raw: Raw,
        now: Instant,
    ) -> Result<Carried, Wrong> {
        let Some(owned) = spec.owned[var.ordinal()].filter(|owned| owned.way == link) else {
            return Err((Invariant::Ownership, format!("{var} was written, but no port writes it there")));
        };
        let timeout = spec.ports[owned.port].timeout;
        let up = self.up[usize::from(link.0)];
        let known = &mut self.known[var.ordinal()];
        if known.slept.as_ref().is_some_and(|slept| slept.contains(&raw)) && known.is_news(raw) {
            let what = format!("{var} = {} had waited while the gateway slept", show(var, raw));
            return Err((Invariant::FromSleep, what));
        }
        let Some(accepted) = known.accepted else {
            let what = format!("{var} = {} was written before any frame had it", show(var, raw));
            return Err((Invariant::FirstFrame, what));
        };
        let wanted = known.waiting.front().map(|next| next.0);
        if known.live && !known.safe && owned.safe == Some(raw) && known.is_news(raw) && wanted != Some(raw) {
            let what = format!("{var} = {} is its safe value, but its owner is not silent", show(var, raw));
            return Err((Invariant::FalseTimeout, what));
        }
        let Some(&(next, at)) = known.waiting.front() else {
            let value = show(var, raw);
            if known.safe && owned.safe == Some(raw) {
                // Safe values may be repeated.
                return Ok(Carried::Safe);
            }
            return Err(if up.is_some_and(|up| accepted < up) {
                (Invariant::NoReplay, format!("{var} = {value} is from before the link came up"))
            } else if now.saturating_since(accepted) > timeout {
                (Invariant::InTime, format!("{var} = {value} was written after its owner fell silent"))
            } else {
                (Invariant::Sent, format!("{var} = {value} was written more often than its owner sent it"))
            });
        };
        if next != raw {
            let later = known.waiting.iter().any(|(value, _)| *value == raw);
            let what = format!("{var} = {} was written, but {} was next", show(var, raw), show(var, next));
            return Err((if later { Invariant::Edges } else { Invariant::Sent }, what));
        }
        if !known.safe && now.saturating_since(at) > timeout {
            return Err((
                Invariant::InTime,
                format!("{var} = {} had waited longer than {timeout}", show(var, raw)),
            ));
        }
        known.waiting.pop_front();
        Ok(if known.safe { Carried::Safe } else { Carried::Of { arrived: at, timeout } })
    }

    /// Checks a variable in a frame that was sent because of other variables; returns the value's origin.
    pub(super) fn carried(
        &self,
        spec: &Spec,
        link: &LinkSpec,
        (var, raw): (SysVar, Raw),
        now: Instant,
    ) -> Result<Carried, Wrong> {
        let known = &self.known[var.ordinal()];
        let value = || show(var, raw);
        let Some((held, _)) = known.value else {
            return Err((
                Invariant::Sent,
                format!("{var} = {} was sent along, but was never known", value()),
            ));
        };
        let expected = known.waiting.front().map_or(held, |next| next.0);
        if expected != raw {
            let what = format!("{var} = {} was sent along, but it is {}", value(), show(var, expected));
            return Err((Invariant::Sent, what));
        }
        if known.live {
            let timeout = spec.owned[var.ordinal()].map(|owned| spec.ports[owned.port].timeout);
            return Ok(match (known.safe, known.accepted, timeout) {
                (false, Some(arrived), Some(timeout)) => Carried::Of { arrived, timeout },
                _ => Carried::Safe,
            });
        }
        if var.stream().is_none() {
            return match self.held(link, known, now) {
                Some(accepted) => Ok(Carried::Held { accepted }),
                None => {
                    let what =
                        format!("{var} = {} was sent along, but this controller never got it", value());
                    Err((Invariant::NoReplay, what))
                }
            };
        }
        if known.unreadable {
            let what = format!("{var} = {} was written back, but is unreadable", value());
            return Err((Invariant::Unreadable, what));
        }
        let is_fresh = self.state_at.is_some_and(|at| now.saturating_since(at) <= READ_BACK);
        if let (true, true, true, Some(arrived)) =
            (spec.read_back[var.ordinal()], known.read_back, is_fresh, self.state_at)
        {
            return Ok(Carried::Of { arrived, timeout: READ_BACK });
        }
        Err((Invariant::InTime, format!("{var} = {} was sent along, read back too long ago", value())))
    }

    /// Whether a recipe link's frame may be sent: each of its variables is known.
    pub(super) fn is_ready(&self, link: &LinkSpec, now: Instant) -> bool {
        let is_fresh = self.state_at.is_some_and(|at| now.saturating_since(at) <= READ_BACK);
        let mut vars = link.input.iter().flat_map(|up| &up.written);
        vars.all(|&var| {
            let known = self.known(var);
            match var.stream() {
                _ if known.live => true,
                Some(_) => known.read_back && is_fresh,
                None => self.held(link, known, now).is_some(),
            }
        })
    }
}

/// The value of a variable in a state packet; `None` if the packet does not have it, or it is not finite.
pub(super) fn in_packet(var: SysVar, packet: &[u8]) -> Option<Raw> {
    let place = var.stream()?;
    let bytes = packet.get(usize::from(place.offset)..)?.get(..usize::from(place.len))?;
    let mut raw = Raw::default();
    if var.is_bits() {
        raw[0] = bytes.iter().rev().fold(0, |bits, &bit| bits << 1 | u8::from(bit != 0)) & var.valid_bits();
    } else {
        raw[..bytes.len()].copy_from_slice(bytes);
        if var.ty() == ScalarType::Float && !f32::from_le_bytes(raw).is_finite() {
            return None;
        }
    }
    Some(raw)
}
