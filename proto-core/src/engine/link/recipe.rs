//! A recipe link: the controller's own recipe port, the fast route in both directions.
//!
//! Frames to the controller are whole, so every variable in them needs a value that its owner sent or that was read
//! back (docs/engine.md section 5). Received frames go into the image.

use super::connection::Connection;
use super::flight::Flight;
use crate::config::Name;
use crate::engine::counters::{LinkCounters, add, bump};
use crate::engine::io::{LinkId, LinkKind, Transport};
use crate::engine::latency::Since;
use crate::engine::values::confirmed::is_gap;
use crate::engine::values::outbox::Outbox;
use crate::engine::values::store::Store;
use crate::image::{GroupId, Image, InputSet};
use crate::link::{LinkTimings, Supervisor};
use crate::recipe::PlacedField;
use crate::recipe::StreamLayout;
use crate::recipe::model::{Field, Framing};
use crate::recipe::{Deframer, datagram};
use crate::sysvar::BIT_INPUT_COUNT;
use crate::time::{Duration, Instant};

/// Maximum age of a value that was read back, for use in a frame.
const READ_BACK_MAX_AGE: Duration = Duration::from_millis(500);
/// Interval at which a safe value is repeated until the controller shows it.
const REPEAT_EVERY: Duration = Duration::from_millis(4);
/// The interval if nothing can show it, after [`REPEAT_FAST`].
const REPEAT_SLOWLY: Duration = Duration::from_millis(100);
const REPEAT_FAST: Duration = Duration::from_secs(1);
/// Maximum number of unacknowledged frames: 250 ms of one frame every 4 ms.
const MOST_UNACKNOWLEDGED: usize = 64;
/// Interval of greetings without frames: the UDP server streams to everyone who has sent it something (D24).
const GREET_EVERY: Duration = Duration::from_millis(500);
/// The server may forget a client that was silent for 60 s (D30).
const SPEAK_EVERY: Duration = Duration::from_secs(20);

#[derive(Debug, Clone)]
pub(crate) struct RecipeLink {
    pub id: LinkId,
    pub kind: LinkKind,
    /// The configured name of a listening port.
    pub name: Option<Name>,
    pub transport: Transport,
    pub supervisor: Supervisor,
    pub counters: LinkCounters,
    framing: Framing,
    input: Option<StreamLayout>,
    output: Option<StreamLayout>,
    deframer: Deframer,
    /// Variables in the frames to the controller.
    set: InputSet,
    /// Variables of `set` that this link writes: a frame is sent when one has a new value.
    pub writes: InputSet,
    /// The group of the variables in received frames.
    pub group: Option<GroupId>,
    /// Variables of `writes` whose value in the controller is shown by something.
    pub shown: InputSet,
    /// Since when a value from a field frame has waited to be handed over.
    pub offered: Since,
    /// The time in which a frame must be acknowledged.
    patience: Duration,
    busy: bool,
    flight: Flight<MOST_UNACKNOWLEDGED>,
    greet_at: Instant,
    /// When to send so that the controller does not forget the gateway (D30).
    speak_at: Instant,
    /// When safe values are sent again.
    repeat_at: Instant,
    /// When the newest frame since the link came up was handed over, and in which era of the controller.
    handed_over: Option<(Instant, u32)>,
}

/// The configuration of a recipe link, compiled.
pub(crate) struct RecipeLinkSetup {
    pub id: LinkId,
    pub kind: LinkKind,
    pub name: Option<Name>,
    pub transport: Transport,
    pub timings: &'static LinkTimings,
    pub input: Option<StreamLayout>,
    pub output: Option<StreamLayout>,
    /// Variables in the frames to the controller; `writes`: those that this link writes.
    pub set: InputSet,
    pub writes: InputSet,
    pub group: Option<GroupId>,
    pub patience: Duration,
}

impl RecipeLink {
    pub(crate) fn new(
        RecipeLinkSetup { id, kind, name, transport, timings, input, output, set, writes, group, patience }: RecipeLinkSetup,
    ) -> Self {
        let framing = match kind {
            LinkKind::RecipeTcpListen { .. } => Framing::Bytes,
            _ => Framing::Datagram,
        };
        Self {
            id,
            kind,
            name,
            transport,
            supervisor: Supervisor::new(timings),
            counters: LinkCounters::default(),
            framing,
            input,
            output,
            deframer: Deframer::new(),
            set,
            writes,
            group,
            shown: InputSet::EMPTY,
            offered: Since::NONE,
            patience,
            busy: false,
            flight: Flight::new(),
            greet_at: Instant::NEVER,
            speak_at: Instant::NEVER,
            repeat_at: Instant::NEVER,
            handed_over: None,
        }
    }

    /// The next output: a frame with new values, or a greeting.
    pub(crate) fn next_frame(
        &mut self,
        store: &mut Store,
        state: Option<GroupId>,
        out: &mut [u8],
    ) -> Option<usize> {
        if !self.supervisor.is_up() || self.busy || self.flight.is_full() {
            return None;
        }
        let wanted = !store.outbox.dirty().and(&self.writes).is_empty();
        if !wanted {
            self.offered = Since::NONE;
            if store.now < self.speaks_at() {
                return None;
            }
        }
        self.send(wanted, store, state, out)
    }

    /// The rest of [`Self::next_frame`], separate to keep the frequent check short.
    fn send(
        &mut self,
        wanted: bool,
        store: &mut Store,
        state: Option<GroupId>,
        out: &mut [u8],
    ) -> Option<usize> {
        let (now, mut born) = (store.now, Since::NONE);
        let len = match &self.input {
            Some(layout) if wanted && self.is_ready(store, || state) => {
                let len = encode(layout, store, out)?;
                born = core::mem::replace(&mut self.offered, Since::NONE);
                born.record(now, &mut store.latency.handed_over);
                store.taken(&self.writes);
                self.handed_over = Some((now, store.era));
                if !store.unconfirmed.and(&self.writes).is_empty()
                    && (self.repeat_at == Instant::NEVER || is_new(store))
                {
                    self.repeat_at = self.repeat_at.min(now + REPEAT_EVERY);
                }
                bump(&mut self.counters.sent);
                if self.greets() {
                    self.greet_at = self.greet_at.max(now + GREET_EVERY);
                }
                len
            }
            _ if now >= self.speaks_at() => {
                self.greet_at = now + GREET_EVERY;
                self.greeting(out)?
            }
            _ => return None,
        };
        self.busy = true;
        match self.framing {
            Framing::Bytes => self.flight.sent(len, now + self.patience, born),
            Framing::Datagram if self.speak_at != Instant::NEVER => self.speak_at = now + SPEAK_EVERY,
            Framing::Datagram => {}
        }
        Some(len)
    }

    /// The transport has taken everything, and nothing else is to be sent before `until`: returns when something is.
    /// `None` if something may have to be sent earlier; nothing has changed then.
    pub(crate) fn sent_before_next(&mut self, outbox: &Outbox, until: Instant) -> Option<Instant> {
        let speaks_at = self.speaks_at();
        if !self.supervisor.is_up()
            || self.flight.is_full()
            || speaks_at < until
            || !outbox.dirty().and(&self.writes).is_empty()
        {
            return None;
        }
        self.busy = false;
        self.offered = Since::NONE;
        Some(speaks_at)
    }

    /// Whether a datagram is a frame of the output part.
    pub(crate) fn is_frame(&self, bytes: &[u8]) -> bool {
        self.output.as_ref().is_some_and(|layout| datagram(layout, bytes).is_ok())
    }

    /// When a greeting is due.
    fn speaks_at(&self) -> Instant {
        self.greet_at.min(self.speak_at)
    }

    /// Whether every variable of the frame has a value that its owner sent or that was just read back.
    pub(crate) fn is_ready(&self, store: &Store, state: impl FnOnce() -> Option<GroupId>) -> bool {
        let others = self.set.minus(&store.live);
        others.is_empty() || self.are_known(&others, store, state())
    }

    /// Like [`Self::is_ready`], for variables without a value of their owner.
    fn are_known(&self, others: &InputSet, store: &Store, state: Option<GroupId>) -> bool {
        let read_back = state
            .and_then(|group| store.image.stamp_of(group))
            .is_some_and(|at| store.now.saturating_since(at) <= READ_BACK_MAX_AGE);
        // Without a connection, only received frames show that the controller has been there all along.
        let is_there = |era| self.framing == Framing::Bytes || era == store.era && store.is_heard();
        let since = self.handed_over.filter(|&(_, era)| is_there(era)).map(|(at, _)| at);
        others.iter().all(|var| match var.stream() {
            Some(_) => read_back && store.read_back.contains(var),
            // The newest frame had the variable's last value, and the controller has kept it since.
            None => {
                store.image.known_since(var).is_some_and(|at| since >= Some(at))
                    && !store.unsent.contains(var)
            }
        })
    }

    /// Whether the controller only sends frames after a greeting.
    fn greets(&self) -> bool {
        self.kind == LinkKind::RecipeUdp && self.output.is_some()
    }

    /// Writes a datagram that cannot be a frame.
    fn greeting(&self, out: &mut [u8]) -> Option<usize> {
        let is_frame = |len| self.input.as_ref().is_some_and(|layout| layout.frame_len() == len);
        let len = if is_frame(1) { 2 } else { 1 };
        out.get_mut(..len)?.fill(0);
        Some(len)
    }
}

impl Connection for RecipeLink {
    fn opened(&mut self, store: &mut Store) {
        self.busy = false;
        self.handed_over = None;
        self.flight.clear();
        store.link_up(&self.writes);
        self.greet_at = if self.greets() { store.now } else { Instant::NEVER };
        self.speak_at = self.greet_at;
    }

    fn lost(&mut self, store: &mut Store) {
        self.busy = false;
        self.offered = Since::NONE;
        self.flight.clear();
        self.greet_at = Instant::NEVER;
        self.speak_at = Instant::NEVER;
        self.repeat_at = Instant::NEVER;
        self.deframer.discard();
        store.link_lost(&self.writes);
    }

    fn received<'b>(&mut self, bytes: &'b [u8], store: &mut Store) -> &'b [u8] {
        let now = store.now;
        let (Some(layout), Some(group)) = (&self.output, self.group) else {
            bump(&mut self.counters.malformed);
            return &[];
        };
        let (mut fresh, mut left): (bool, &[u8]) = (false, &[]);
        let unreadable = &mut self.counters.unreadable;
        let mut take = |payload: &[u8]| {
            fresh = true;
            add(unreadable, take_frame(layout, payload, &mut store.image));
        };
        match self.framing {
            Framing::Datagram => match datagram(layout, bytes) {
                Ok(payload) => {
                    take(payload);
                    bump(&mut self.counters.received);
                }
                Err(_) => bump(&mut self.counters.malformed),
            },
            Framing::Bytes => {
                let mut rest = bytes;
                while let Some(payload) = self.deframer.next_frame(layout, &mut rest) {
                    take(payload);
                    bump(&mut self.counters.received);
                    if store.watches_bits {
                        left = rest;
                        break;
                    }
                }
                self.counters.resync_bytes = self.deframer.stats().skipped_bytes as u32;
            }
        }
        if fresh {
            let before = store.image.stamp_of(group);
            store.heard();
            if before.is_some() && is_gap(before, now) && !store.safe.is_empty() {
                store.controller_was_away();
            }
            store.image.stamp(group, now);
            store.unconfirm_by_witnesses();
            if self.greets() {
                self.greet_at = now + GREET_EVERY;
            }
        }
        left
    }

    fn sent(&mut self) {
        self.busy = false;
    }

    fn acked(&mut self, left: u32, store: &mut Store) {
        let now = store.now;
        self.flight.acked(left, |born| born.record(now, &mut store.latency.arrived));
    }

    fn advance(&mut self, store: &mut Store) {
        let now = store.now;
        if now >= self.flight.deadline() {
            bump(&mut self.counters.unacknowledged);
            self.supervisor.give_up(now);
            self.lost(store);
        }
        if now < self.repeat_at {
            return;
        }
        self.repeat_at = Instant::NEVER;
        store.confirm_by_witnesses();
        let wanted = store.unconfirmed.and(&self.writes);
        if wanted.is_empty() || !self.supervisor.is_up() {
            return;
        }
        store.again(&wanted);
        let fast = is_new(store) || !wanted.and(&self.shown).is_empty();
        self.repeat_at = now + if fast { REPEAT_EVERY } else { REPEAT_SLOWLY };
    }

    fn deadline(&self) -> Instant {
        let speaks_at = if self.busy { Instant::NEVER } else { self.speaks_at() };
        speaks_at.min(self.flight.deadline()).min(self.repeat_at)
    }
}

/// Whether a safe value became unconfirmed only recently.
fn is_new(store: &Store) -> bool {
    store.now.saturating_since(store.unconfirmed_since) < REPEAT_FAST
}

/// Writes a frame into the image. A value that is not finite makes its variable unknown; the others are used. Returns
/// the number of such values.
fn take_frame(layout: &StreamLayout, payload: &[u8], image: &mut Image) -> usize {
    let system = |field: PlacedField| match field.field {
        Field::System(var) => Some(var),
        Field::User(_) => None,
    };
    if layout.apply(payload, image.bytes_mut()).is_ok() {
        image.all_readable(layout.fields().filter_map(system));
        return 0;
    }
    let fields = layout.fields().zip(layout.values(payload));
    let values = fields.filter_map(|(field, value)| Some((system(field)?, value)));
    values.fold(0, |sum: usize, (var, value)| sum.saturating_add(usize::from(!image.receive(var, value))))
}

/// Encodes a frame with byte variables as they are to be written next, not as they were last received.
fn encode(layout: &StreamLayout, store: &mut Store, out: &mut [u8]) -> Option<usize> {
    let waiting = store.outbox.dirty().and(&InputSet::BYTES);
    if waiting.is_empty() {
        return layout.encode(store.image.bytes(), out).ok();
    }
    let newest: [u8; BIT_INPUT_COUNT] = *store.image.bytes().first_chunk()?;
    let mut next = newest;
    for var in waiting.iter() {
        if let Some(slot) = next.get_mut(var.image_offset()) {
            *slot = store.outbox.bit_value(var);
        }
    }
    *store.image.bytes_mut().first_chunk_mut()? = next;
    let encoded = layout.encode(store.image.bytes(), out);
    *store.image.bytes_mut().first_chunk_mut()? = newest;
    encoded.ok()
}
