//! One field port: frames in, frames out, and the timing of a shared line.
//!
//! In: bytes and CAN frames. Out: values in the store, and frames when they are due. Does not know how values reach the
//! controller.

use super::bindings::{InputBind, forget_commands};
use super::codec::{Codec, DeviceCodec};
use super::frames::{Accepted, FrameContext};
use super::line_timing::LineTiming;
use super::sender::Sender;
use crate::config::{Name, Span};
use crate::engine::clock::Dirty;
use crate::engine::counters::{PortCounters, add, bump};
use crate::engine::io::{BusState, PortId, PortState, ReplyCode};
use crate::engine::link::command::CommandLink;
use crate::engine::link::outcome::Outcome;
use crate::engine::rejection::{LastRejection, Rejection};
use crate::engine::tap::{Tap, TapDirection, TapPlace, TapVerdict, Tapped};
use crate::engine::values::store::Store;
use crate::recipe::model::Mode;
use crate::recipe::{CanLayout, CanReject};
use crate::time::{Duration, Instant};
use crate::wire::can::{CanFrame, CanId};

#[derive(Debug, Clone)]
pub(crate) struct FieldPort {
    pub id: PortId,
    /// Its name in the configuration; `recipe`: the index of its recipe there.
    pub name: Name,
    pub recipe: u8,
    pub codec: Codec,
    pub mode: Mode,
    pub line: LineTiming,
    /// Whether there is a partial frame that silence can end. Updated after each change, because deadlines are computed
    /// far more often.
    pub is_partial: bool,
    pub sender: Sender,
    /// The port's range of the input bindings; those of its CAN frames are consecutive.
    pub inputs: Span,
    /// The port's range of the output bindings.
    pub outputs: Span,
    /// Index of the port's first frame in the store.
    pub first_frame: u8,
    pub is_up: bool,
    pub bus: BusState,
    pub reply: ReplyCode,
    pub counters: PortCounters,
    pub last_rejection: Option<LastRejection>,
}

impl FieldPort {
    pub(crate) fn up(&mut self) {
        self.is_up = true;
    }

    /// The device is gone: nothing that has begun is continued later.
    pub(crate) fn down(
        &mut self,
        bindings: &[InputBind],
        commands: Option<&mut CommandLink>,
        tap: &mut Tap,
        now: Instant,
    ) {
        if self.is_up {
            bump(&mut self.counters.downs);
        }
        self.is_up = false;
        self.sender.reset();
        self.discard_partial(tap, now);
        forget_commands(self.inputs.of(bindings), commands, now);
    }

    /// The CAN controller reports its error state. Bus-off is handled like a device that is gone.
    pub(crate) fn bus_state(
        &mut self,
        state: BusState,
        bindings: &[InputBind],
        commands: Option<&mut CommandLink>,
        now: Instant,
    ) {
        if state == BusState::BusOff && self.bus != BusState::BusOff {
            bump(&mut self.counters.bus_offs);
            self.sender.reset();
            forget_commands(self.inputs.of(bindings), commands, now);
        }
        self.bus = state;
    }

    /// The gateway itself slept: nothing that has begun is continued.
    pub(crate) fn slept(&mut self, tap: &mut Tap, now: Instant) {
        self.sender.skip();
        self.discard_partial(tap, now);
    }

    /// Discards input that waited while the gateway itself slept, because its age is unknown.
    pub(crate) fn discard(&mut self, bytes: &[u8], can_id: Option<CanId>, tap: &mut Tap, now: Instant) {
        tap.record(|| came(self.id, now, Err(Rejection::Asleep), can_id, [bytes, &[], &[]]));
        keep(&mut self.last_rejection, Rejection::Asleep, can_id, bytes, now);
        add(&mut self.counters.bytes_in, bytes.len());
        bump(&mut self.counters.asleep);
        let reads_bytes = match &self.codec {
            Codec::Stream { input, .. } => input.is_some(),
            Codec::Device(device) => device.reader.is_some(),
            Codec::Can { .. } => false,
        };
        if reads_bytes {
            add(&mut self.counters.discarded_bytes, bytes.len());
            self.lose(bytes);
        }
        self.line.heard = now;
        self.note_partial();
    }

    /// Notes bytes from the line, which [`Self::frames`] then reads.
    pub(crate) fn heard(&mut self, bytes: &[u8], now: Instant) {
        add(&mut self.counters.bytes_in, bytes.len());
        self.line.heard = now;
    }

    /// Takes bytes that only begin or continue a frame and at most set a deadline. Returns the deadline if it may be
    /// earlier than before, else [`Instant::NEVER`]. `None` if [`Self::frames`] has to read the bytes; nothing was
    /// taken then.
    // The cost is in docs/performance.md section 1, like that of the other attributes here.
    #[inline]
    pub(crate) fn hold(&mut self, bytes: &[u8], now: Instant) -> Option<Instant> {
        let Codec::Stream { input: Some(layout), deframer, .. } = &mut self.codec else { return None };
        let had_begun = deframer.pending() > 0;
        if !deframer.hold(layout, bytes) {
            return None;
        }
        self.heard(bytes, now);
        self.is_partial = true;
        // Further bytes only make the deadline later.
        Some(if had_begun { Instant::NEVER } else { self.partial_until() })
    }

    /// Reads the frames in `rest`; stops after the first accepted one if the image has to be checked after each frame.
    pub(crate) fn frames(
        &mut self,
        rest: &mut &[u8],
        bindings: &[InputBind],
        store: &mut Store,
        commands: Option<&mut CommandLink>,
        tap: &mut Tap,
    ) -> Accepted {
        let mut accepted = Accepted::default();
        let now = store.now;
        let bytes = core::mem::take(rest);
        let usable = self.is_usable();
        let Codec::Stream { input, deframer, .. } = &mut self.codec else {
            // A separate variable, so that `rest` can stay in registers.
            let mut left = bytes;
            accepted = self.device_frames(&mut left, bindings, store, commands, tap);
            *rest = left;
            self.note_partial();
            return accepted;
        };
        let Some(layout) = input else {
            self.reject_without_input(bytes, tap, now);
            return accepted;
        };
        let (reply, counters) = (&mut self.reply, &mut self.counters);
        let mut frames = FrameContext::new((self.id, self.mode), reply, counters, bindings, store, commands);
        let mut left = bytes;
        while let Some(payload) = deframer.next_frame(layout, &mut left) {
            let verdict = frames.take(layout, payload, usize::from(self.first_frame), &mut accepted);
            tap.record(|| came(self.id, now, verdict, None, [layout.head(), payload, layout.tail()]));
            match verdict {
                Ok(()) if left.is_empty() || frames.store.watches_bits => break,
                Ok(()) => {}
                Err(why) => keep(&mut self.last_rejection, why, None, payload, now),
            }
        }
        *rest = left;
        self.is_partial = deframer.pending() > 0;
        let stats = deframer.stats();
        self.counters.tail_mismatches = stats.tail_mismatches as u32;
        let skipped = (stats.skipped_bytes as u32).wrapping_sub(self.counters.resync_bytes);
        if skipped > 0 {
            self.counters.resync_bytes = stats.skipped_bytes as u32;
            self.no_frame(bytes, skipped as usize, tap, now);
        }
        self.sender.frames_accepted(accepted.frames, usable, &mut self.counters, now);
        accepted
    }

    /// Rejects bytes for a port whose recipe has no input part.
    pub(crate) fn reject_without_input(&mut self, bytes: &[u8], tap: &mut Tap, now: Instant) {
        bump(&mut self.counters.rejected_no_input);
        tap.record(|| came(self.id, now, Err(Rejection::NoInput), None, [bytes, &[], &[]]));
        keep(&mut self.last_rejection, Rejection::NoInput, None, bytes, now);
    }

    /// Reads a CAN frame.
    pub(crate) fn can(
        &mut self,
        frame: &CanFrame,
        bindings: &[InputBind],
        store: &mut Store,
        commands: Option<&mut CommandLink>,
        tap: &mut Tap,
    ) -> Accepted {
        let now = store.now;
        let mut accepted = Accepted::default();
        let verdict = self.take_can(frame, bindings, store, commands, &mut accepted);
        tap.record(|| came(self.id, now, verdict, Some(frame.id()), [frame.data(), &[], &[]]));
        if verdict.is_ok() || verdict.is_err_and(|why| self.is_news(why, now)) {
            keep_why(&mut self.last_rejection, verdict, store, Some(frame.id()), frame.data());
        }
        accepted
    }

    /// Whether a rejected CAN frame is worth keeping. On a shared bus frames for other nodes are not, unless none of
    /// the recipe's ids has ever arrived: then the id may be misconfigured. Keeping a frame takes longer than rejecting
    /// it, so at most one per 100 ms is kept.
    pub(crate) fn is_news(&self, why: Rejection, now: Instant) -> bool {
        let may_be_meant = |last: &LastRejection| {
            self.counters.frames_in == 0
                && last.why == Rejection::ForeignId
                && now.saturating_since(last.at) >= FOREIGN_PAUSE
        };
        why != Rejection::ForeignId || self.last_rejection.as_ref().is_none_or(may_be_meant)
    }

    /// Counts a frame with an id that is not in the recipe, which is for another node. False if it is worth keeping; it
    /// was not counted then.
    #[inline(always)]
    pub(crate) fn passes_by(&mut self, frame: &CanFrame, now: Instant) -> bool {
        let Codec::Can { input: Some(layout), .. } = &self.codec else { return false };
        if layout.has(frame) || frame.is_remote() || self.is_news(Rejection::ForeignId, now) {
            return false;
        }
        add(&mut self.counters.bytes_in, frame.len());
        bump(&mut self.counters.rejected_id);
        true
    }

    fn take_can(
        &mut self,
        frame: &CanFrame,
        bindings: &[InputBind],
        store: &mut Store,
        commands: Option<&mut CommandLink>,
        accepted: &mut Accepted,
    ) -> Result<(), Rejection> {
        let now = store.now;
        add(&mut self.counters.bytes_in, frame.len());
        let usable = self.is_usable();
        let Codec::Can { input, .. } = &self.codec else {
            return self.device_can(frame, bindings, store, commands, accepted);
        };
        let Some(layout) = input else {
            bump(&mut self.counters.rejected_no_input);
            return Err(Rejection::NoInput);
        };
        let index = layout.accept_frame(frame);
        let (Ok(index), Some(frame_layout)) = (index, index.ok().and_then(|nth| layout.frame(nth))) else {
            let (counter, why) = match index {
                Err(CanReject::Remote { .. }) => (&mut self.counters.rejected_remote, Rejection::Remote),
                Err(CanReject::WrongLength { .. }) => {
                    (&mut self.counters.rejected_length, Rejection::WrongLength)
                }
                _ => (&mut self.counters.rejected_id, Rejection::ForeignId),
            };
            bump(counter);
            return Err(why);
        };
        let (reply, counters) = (&mut self.reply, &mut self.counters);
        let mut frames = FrameContext::new((self.id, self.mode), reply, counters, bindings, store, commands);
        let slot = usize::from(self.first_frame).saturating_add(index);
        frames.take(&frame_layout, frame.data(), slot, accepted)?;
        self.sender.frames_accepted(1, usable, &mut self.counters, now);
        Ok(())
    }

    /// One of the port's commands has a result.
    pub(crate) fn command_ended(&mut self, outcome: Outcome) {
        if outcome.code == ReplyCode::NotSent {
            bump(&mut self.counters.commands_dropped);
        }
        if self.counters.commands == outcome.nth {
            self.reply = outcome.code;
        }
    }

    /// Handles what is due: cycles and silence. Returns whether silence has ended a frame, which [`Self::frames`] still
    /// has to read.
    pub(crate) fn advance(&mut self, tap: &mut Tap, now: Instant) -> bool {
        let mut is_ended = false;
        if now >= self.partial_until() {
            is_ended = self.ends_by_silence();
            if !is_ended {
                self.discard_partial(tap, now);
            }
        }
        self.sender.advance(self.is_usable(), &mut self.counters, now);
        is_ended
    }

    /// When the port has something to do without an input.
    pub(crate) fn deadline(&self) -> Instant {
        self.partial_until().min(self.send_deadline())
    }

    /// The deadline after input that has begun a frame or made one due; `None` if it cannot have become earlier. Also
    /// flags a port that may have an output.
    pub(crate) fn deadline_of_heard(&self, ask: &mut Dirty) -> Option<Instant> {
        let is_due = self.sender.is_due();
        ask.add(Dirty::PORTS.when(is_due));
        (is_due || self.is_partial).then(|| self.deadline())
    }

    /// When something may be sent without an input.
    pub(crate) fn send_deadline(&self) -> Instant {
        self.sender.deadline(self.line.quiet_at())
    }

    /// When silence ends the partial frame; [`Instant::NEVER`] if there is none.
    pub(crate) fn partial_until(&self) -> Instant {
        debug_assert_eq!(self.is_partial, self.has_begun(), "not noted");
        self.line.partial_until(self.is_partial)
    }

    /// Whether a frame may be handed over now.
    pub(crate) fn may_send(&self, now: Instant) -> bool {
        self.sender.is_due() && self.is_usable() && now >= self.line.quiet_at()
    }

    /// Whether frames that are handed over can leave.
    pub(crate) fn is_usable(&self) -> bool {
        self.is_up && self.bus != BusState::BusOff
    }

    /// Whether there is a partial frame that silence can end.
    fn has_begun(&self) -> bool {
        match &self.codec {
            Codec::Stream { deframer, .. } => deframer.pending() > 0,
            Codec::Can { .. } => false,
            Codec::Device(device) => device.has_begun(),
        }
    }

    /// Updates `is_partial` after bytes arrived or were discarded.
    pub(crate) fn note_partial(&mut self) {
        self.is_partial = self.has_begun();
    }

    pub(crate) fn discard_partial(&mut self, tap: &mut Tap, now: Instant) {
        let deframer = match &mut self.codec {
            Codec::Stream { deframer, .. } => deframer,
            Codec::Device(DeviceCodec { reader: Some(reader), .. }) => {
                let held = reader.held();
                if !held.is_empty() {
                    tap.record(|| came(self.id, now, Err(Rejection::Partial), None, [held, &[], &[]]));
                    keep(&mut self.last_rejection, Rejection::Partial, None, held, now);
                }
                let dropped = reader.discard();
                add(&mut self.counters.discarded_bytes, dropped);
                return self.note_partial();
            }
            _ => return,
        };
        let held = deframer.held();
        if !held.is_empty() {
            tap.record(|| came(self.id, now, Err(Rejection::Partial), None, [held, &[], &[]]));
            keep(&mut self.last_rejection, Rejection::Partial, None, held, now);
        }
        let dropped = deframer.discard();
        add(&mut self.counters.discarded_bytes, dropped);
        self.note_partial();
    }

    /// `skipped` bytes of a chunk, or of bytes held before it, belong to no frame. Without silence between them,
    /// further ones extend the same rejection.
    pub(crate) fn no_frame(&mut self, bytes: &[u8], skipped: usize, tap: &mut Tap, now: Instant) {
        tap.record(|| came(self.id, now, Err(Rejection::NoFrame), None, [bytes, &[], &[]]));
        match &mut self.last_rejection {
            Some(last) if last.goes_on(now, self.line.idle_gap) => last.append(now, skipped, bytes),
            last => *last = Some(LastRejection::no_frame(now, skipped, bytes)),
        }
    }

    /// Health of the port; `is_silent` says whether one of its input frames is overdue.
    pub(crate) fn state(&self, is_silent: bool) -> PortState {
        if !self.is_up {
            PortState::Gone
        } else if self.bus == BusState::BusOff {
            PortState::BusOff
        } else if is_silent {
            PortState::Silent
        } else {
            PortState::Working
        }
    }
}

pub(crate) fn keep(
    last: &mut Option<LastRejection>,
    why: Rejection,
    can_id: Option<CanId>,
    bytes: &[u8],
    now: Instant,
) {
    *last = Some(LastRejection::new(now, why, can_id, bytes));
}

/// Keeps why a device frame, or a field of it, was rejected.
pub(crate) fn keep_why(
    last: &mut Option<LastRejection>,
    verdict: Result<(), Rejection>,
    store: &mut Store,
    can_id: Option<CanId>,
    bytes: &[u8],
) {
    if verdict.is_err() || !store.rejected_field.is_empty() {
        let field = store.rejected_field.pop();
        if let Some(why) = field.map(|field| field.why).or(verdict.err()) {
            keep(last, why, can_id, bytes, store.now);
            if let Some(last) = last {
                last.field = field;
            }
        }
    }
}

/// The tap record of input from a field port's device.
pub(crate) fn came<'a>(
    port: PortId,
    at: Instant,
    verdict: Result<(), Rejection>,
    can_id: Option<CanId>,
    pieces: [&'a [u8]; 3],
) -> Tapped<'a> {
    let verdict = verdict.map_or_else(TapVerdict::Rejected, |()| TapVerdict::Taken);
    Tapped { at, place: TapPlace::Port(port), direction: TapDirection::In, verdict, can_id, pieces }
}

/// Number of fields in the part's frames before the `index`-th; the bindings of all frames are consecutive.
pub(crate) fn fields_before(layout: &CanLayout, index: usize) -> usize {
    let before = layout.frames().take(index);
    before.fold(0, |sum, frame| sum.saturating_add(frame.fields().count()))
}

/// Time between two kept frames with ids that are in no recipe.
const FOREIGN_PAUSE: Duration = Duration::from_millis(100);

/// The port with this id. Its index is the same unless a listening port comes before it.
pub(crate) fn find_port(ports: &mut [FieldPort], id: PortId) -> Option<&mut FieldPort> {
    let nth = usize::from(id.0);
    match ports.get(nth) {
        Some(port) if port.id == id => ports.get_mut(nth),
        _ => search_port(ports, id),
    }
}

fn search_port(ports: &mut [FieldPort], id: PortId) -> Option<&mut FieldPort> {
    ports.iter_mut().find(|port| port.id == id)
}
