//! The gateway's side: the expected result of each input of the engine, and checks of what its field ports send.

use proto_core::device::Boundary;
use proto_core::engine::{Engine, LinkId, PortId};
use proto_core::sysvar::SysVar;
use proto_core::time::{Duration, Instant};
use proto_core::wire::can::{CanFrame, CanId};

use super::counters::differ;
use super::field::{self, LineWatch, Refused, Verdict};
use super::frame::Raw;
use super::invariant::Wrong;
use super::wire::Safe;
use super::{Invariant, LinkWatch, Oracle, PortWatch, place};

/// A transmission of a field port.
#[derive(Debug, Clone, Copy)]
pub(super) struct Leaving<'a> {
    /// The id, for a CAN frame.
    pub id: Option<CanId>,
    pub is_remote: bool,
    pub bytes: &'a [u8],
}

impl Oracle {
    /// Handles deadlines that have passed. After a sleep (`has_slept`), waiting input is not read.
    pub(super) fn pass(&mut self, has_slept: bool, now: Instant) {
        let overdue = self.up.overdue(&self.spec, now);
        for &(nth, frame) in &overdue {
            self.forget_commands(nth, Some(frame), now);
        }
        let (commands, any) = self.up.overdue_alone(&self.spec, now);
        for place in commands {
            self.forget_command(place, now);
        }
        if !overdue.is_empty() || any {
            self.values_changed(now);
        }
        self.up.expire(&self.spec, now);
        for (watch, port) in self.ports.iter_mut().zip(&self.spec.ports) {
            watch.line.tick(port, now);
            watch.down.tick(port, now);
        }
        for nth in 0..self.ports.len() {
            self.line_silent(nth, has_slept, now);
        }
        for nth in 0..self.ports.len() {
            self.exchange_tick(nth, now);
            self.served_tick(nth, now);
        }
        if now >= self.rewrite_at {
            self.write_refused_again();
        }
        let given_up = self.modbus.tick(now);
        self.safe_again(given_up);
        self.commands.tick(now);
    }

    /// The gateway slept: frames that were received in part are not continued.
    pub(super) fn slept(&mut self, now: Instant) {
        for (watch, port) in self.ports.iter_mut().zip(&self.spec.ports) {
            watch.down.slept();
            watch.line.discard_of(port);
            if watch.exchanges.waits() && !port.is_can {
                watch.down.sent();
            }
            watch.exchanges.abandon(port.exchanges.as_ref(), now);
            watch.exchanges.fault_at = now + DISCARD_AFTER_SLEEP;
        }
        self.discards_until = Some(now + DISCARD_AFTER_SLEEP);
    }

    pub(super) fn forget_commands(&mut self, nth: usize, frame: Option<usize>, now: Instant) {
        self.commands.forget(nth, frame, now);
        let commands = &self.commands;
        self.robot.no_longer_asked(|command| commands.is_asked(command), now);
    }

    fn forget_command(&mut self, place: super::commands::Place, now: Instant) {
        self.commands.forget_one(place, now);
        let commands = &self.commands;
        self.robot.no_longer_asked(|command| commands.is_asked(command), now);
    }

    /// Finds the links that the engine has given up on its own. `reported` is the link of the current input, which
    /// handles that link itself.
    pub(super) fn find_lost_links(&mut self, engine: &Engine, reported: Option<LinkId>, now: Instant) {
        let mut left = self.up.are_up;
        while left != 0 {
            let link = LinkId(left.trailing_zeros() as u8);
            left &= left - 1;
            if Some(link) != reported && !engine.is_up(link) {
                self.link_lost(link, now);
            }
        }
    }

    pub(super) fn link_lost(&mut self, link: LinkId, now: Instant) {
        if !self.up.is_up(link) {
            return;
        }
        match link {
            LinkId::MODBUS => {
                let given_up = self.modbus.lost();
                self.safe_again(given_up);
                self.write_refused_again();
            }
            LinkId::COMMAND | LinkId::URGENT => self.commands.lost(link, now),
            _ => {}
        }
        self.links[place(link)] = LinkWatch::default();
        self.up.link_lost(&self.spec, link);
    }

    pub(super) fn write_refused_again(&mut self) {
        let refused = std::mem::take(&mut self.refused);
        self.safe_again(refused);
        self.rewrite_at = Instant::NEVER;
    }

    fn safe_again(&mut self, safe: Safe) {
        self.up.write_again(&self.spec, safe.vars);
        self.up.bits_again(&self.spec, safe.bits);
    }

    /// Sent values may have changed: looks for rising bits that trigger a port.
    pub(super) fn values_changed(&mut self, now: Instant) {
        self.exchange_values_changed(now);
        if !self.spec.has_triggers {
            return;
        }
        for (watch, port) in self.ports.iter_mut().zip(&self.spec.ports) {
            watch.down.watch(port, &self.up);
        }
    }

    pub(super) fn port_bytes(&mut self, nth: usize, bytes: &[u8], now: Instant) {
        let port = &self.spec.ports[nth];
        let watch = &mut self.ports[nth];
        watch.counters.bytes_in = watch.counters.bytes_in.wrapping_add(bytes.len() as u32);
        watch.down.heard = now;
        if port.exchanges.is_some() || port.served.is_some() {
            watch.line.heard = now;
            if self.discards_until.is_none() {
                return match port.served {
                    Some(_) => self.served_bytes(nth, bytes, now),
                    None => self.exchange_bytes(nth, bytes, now),
                };
            }
            watch.counters.asleep += 1;
            watch.line.discarded += bytes.len() as u64;
            return;
        }
        if self.discards_until.is_some() {
            watch.counters.asleep += 1;
            if !port.inputs.is_empty() {
                watch.line.discarded += bytes.len() as u64;
                watch.line.lose(port, bytes);
                let mut apart = LineWatch { held: bytes.to_vec(), ..LineWatch::default() };
                let verdicts = apart.bytes(port, &[], now);
                self.waited_in_sleep(verdicts);
            }
            return;
        }
        if port.inputs.is_empty() {
            watch.counters.rejected_no_input += 1;
            return;
        }
        let verdicts = watch.line.bytes(port, bytes, now);
        self.take(nth, verdicts, now);
    }

    pub(super) fn port_can(&mut self, nth: usize, frame: &CanFrame, now: Instant) {
        let port = &self.spec.ports[nth];
        let counters = &mut self.ports[nth].counters;
        counters.bytes_in = counters.bytes_in.wrapping_add(frame.data().len() as u32);
        if self.discards_until.is_some() {
            counters.asleep += 1;
            let verdict = field::can(port, &mut LineWatch::default(), frame);
            self.waited_in_sleep(verdict.ok());
            return;
        }
        if port.exchanges.is_some() {
            return self.exchange_can(nth, frame, now);
        }
        if port.inputs.is_empty() {
            counters.rejected_no_input += 1;
            return;
        }
        let verdict = field::can(port, &mut self.ports[nth].line, frame);
        self.take_can(nth, verdict, now);
    }

    pub(super) fn take_can(&mut self, nth: usize, verdict: Result<Verdict, Refused>, now: Instant) {
        let counters = &mut self.ports[nth].counters;
        match verdict {
            Ok(verdict) => self.take(nth, [verdict], now),
            Err(Refused::Remote) => counters.rejected_remote += 1,
            Err(Refused::Id) => counters.rejected_id += 1,
            Err(Refused::Length) => counters.rejected_length += 1,
        }
    }

    /// The device of a port is present.
    pub(super) fn port_up(&mut self, nth: usize, now: Instant) {
        self.ports[nth].down.is_up = true;
        self.begin_exchanges(nth, now);
    }

    /// Restarts the exchanges of a port.
    pub(super) fn begin_exchanges(&mut self, nth: usize, now: Instant) {
        let watch = &mut self.ports[nth];
        watch.line.discarded += watch.served.discard();
        if watch.exchanges.waits() && !self.spec.ports[nth].is_can {
            watch.down.sent();
        }
        watch.exchanges.begin(self.spec.ports[nth].exchanges.as_ref(), now);
        // From now on, rising bits request exchanges.
        self.exchange_values_changed(now);
    }

    /// Silence may have ended a frame, or cut it off.
    fn line_silent(&mut self, nth: usize, has_slept: bool, now: Instant) {
        let (port, watch) = (&self.spec.ports[nth], &mut self.ports[nth]);
        let framing = port.framing;
        let is_over = now >= watch.down.heard + port.idle_gap;
        if framing == Boundary::Fields || !is_over || !watch.line.cut_has_begun(framing) {
            return;
        }
        if framing == Boundary::Tail {
            return watch.line.cut_off();
        }
        if has_slept {
            // Its age is unknown.
            watch.line.cut_off();
            watch.down.heard = now;
            return;
        }
        let piece = watch.line.cut_piece();
        let verdict = watch.line.judge_piece(port, &piece);
        self.take(nth, verdict, now);
    }

    /// Remembers discarded frames that had waited while the gateway slept.
    fn waited_in_sleep(&mut self, verdicts: impl IntoIterator<Item = Verdict>) {
        for verdict in verdicts {
            let Verdict::Accepted(frame) = verdict else { continue };
            self.checks[Invariant::FromSleep as usize] += 1;
            self.commands.waited_in_sleep(&self.spec, &frame);
            for (var, raw) in frame.values {
                self.up.known[var.ordinal()].slept.get_or_insert_default().push(raw);
            }
        }
    }

    /// Applies frames that arrived together.
    pub(super) fn take(&mut self, nth: usize, verdicts: impl IntoIterator<Item = Verdict>, now: Instant) {
        let (mut frames, mut ignored) = (0, 0);
        let mut newest: Option<Vec<(SysVar, Raw)>> = None;
        for verdict in verdicts {
            let counters = &mut self.ports[nth].counters;
            let mut frame = match verdict {
                Verdict::NotFinite => {
                    counters.rejected_not_finite += 1;
                    continue;
                }
                Verdict::OutOfRange => {
                    counters.rejected_out_of_range += 1;
                    continue;
                }
                Verdict::Unreadable => {
                    counters.rejected_unreadable += 1;
                    continue;
                }
                Verdict::WrongChecksum => {
                    counters.rejected_checksum += 1;
                    continue;
                }
                Verdict::OtherDevice => {
                    counters.rejected_other_device += 1;
                    continue;
                }
                Verdict::Repeated => {
                    counters.rejected_counter += 1;
                    continue;
                }
                Verdict::WrongLength => {
                    counters.rejected_length += 1;
                    continue;
                }
                Verdict::Ignored(frame) => {
                    counters.ignored += 1;
                    self.up.not_overdue(&self.spec, nth, frame, now);
                    frames += 1;
                    ignored += 1;
                    continue;
                }
                Verdict::Accepted(frame) => frame,
            };
            if !self.up.has_room(&self.spec, nth, &frame, now) {
                match frame.without.why {
                    Some(field::Unfit::Unreadable) => counters.rejected_unreadable += 1,
                    Some(field::Unfit::NotFinite) => counters.rejected_not_finite += 1,
                    _ => counters.rejected_out_of_range += 1,
                }
                continue;
            }
            counters.frames_in += 1;
            counters.rejected_fields += frame.without.rejected;
            counters.fields_without_value += frame.without.no_value;
            let number = f64::from(counters.frames_in as u16);
            let counted = std::mem::take(&mut frame.counted).into_iter();
            frame.values.extend(counted.filter_map(|var| Some((var, field::bound(var, number)?))));
            counters.masked += u32::from(frame.masked);
            counters.counter_jumps += frame.jumps;
            self.frames[nth].0 += 1;
            frames += 1;
            let commands_up = self.up.is_up(LinkId::COMMAND);
            if !frame.commands.is_empty() {
                let urgent = self.commands.accepted(&self.spec, nth, &frame, commands_up, now);
                let commands = &self.commands;
                self.robot.no_longer_asked(|command| commands.is_asked(command), now);
                self.robot.asked(urgent, |command| commands.waits_until(command));
            }
            self.up.accepted(&self.spec, nth, &frame, now);
            self.values_changed(now);
            newest = Some(frame.values);
            // The engine does this after each frame if there are triggers, otherwise once after all of them.
            if self.spec.has_triggers {
                self.after_frames(now);
            }
        }
        if frames > 0 {
            self.after_frames(now);
            self.ports[nth].down.answered(&self.spec.ports[nth], frames);
        }
        let Some(newest) = newest else { return };
        let waits = self.spec.links.iter().any(|link| {
            let wants = newest.iter().any(|(var, _)| {
                let way = self.spec.owned[var.ordinal()].map(|owned| owned.way);
                way == Some(link.id) && !self.up.known(*var).waiting.is_empty()
            });
            wants && self.up.is_up(link.id) && !self.up.is_ready(link, now)
        });
        if waits {
            self.ports[nth].counters.withheld += frames - ignored;
        }
    }

    /// Drops overtaken commands, and values that have waited too long.
    fn after_frames(&mut self, now: Instant) {
        self.commands.drop_overtaken();
        self.up.expire(&self.spec, now);
    }

    pub(super) fn port_send(&mut self, port: PortId, sent: &Leaving<'_>, now: Instant) {
        let nth = usize::from(port.0);
        self.frames[nth].1 += 1;
        let spec = &self.spec.ports[nth];
        if spec.served.is_some() {
            let result = self.served_send(nth, sent, now);
            return self.judge(now, &[Invariant::Shown, Invariant::Line, Invariant::Cycle], result);
        }
        let is_asked = spec.exchanges.as_ref().is_some_and(|exchanges| {
            spec.outputs.is_empty() || exchanges.row_of((sent.id, sent.is_remote), sent.bytes).is_some()
        });
        if is_asked {
            let result = self.exchange_send(nth, sent, now);
            let invariants = [Invariant::Known, Invariant::Age, Invariant::Shown, Invariant::Line];
            return self.judge(now, &invariants, result);
        }
        let result = self.ports[nth].down.check(&self.spec, nth, &self.up, sent.id, sent.bytes, now);
        let invariants = [
            Invariant::Known,
            Invariant::Age,
            Invariant::OwnAge,
            Invariant::Unreadable,
            Invariant::Shown,
            Invariant::Line,
        ];
        self.judge(now, &invariants, result);
    }

    /// Compares the engine's counters with those of the model.
    pub(super) fn count(&mut self, nth: usize, engine: &Engine) -> Result<(), Wrong> {
        let Some(actual) = engine.port_counters(PortId(nth as u8)) else { return Ok(()) };
        let PortWatch { line, down, counters, exchanges, .. } = &self.ports[nth];
        let up = self.up.counted[nth];
        let commands = self.commands.counted[nth];
        let mut expected = *counters;
        expected.tail_mismatches = line.mismatches as u32;
        expected.resync_bytes = line.dropped as u32;
        expected.discarded_bytes = line.discarded as u32;
        expected.frames_out = down.frames_out;
        expected.bytes_out = down.bytes_out;
        expected.skipped_cycles = down.skipped;
        expected.stale_cycles = down.stale;
        expected.unanswered = exchanges.unanswered;
        expected.refused = counters.refused.wrapping_add(exchanges.refused);
        expected.edges_lost = up.edges_lost;
        expected.values_expired = up.values_expired;
        expected.undelivered = up.undelivered;
        expected.timeouts = up.timeouts;
        expected.commands = commands.picked;
        expected.commands_dropped = commands.dropped;
        expected.commands_unknown = commands.unknown;
        expected.commands_based = commands.based;
        if actual.timeouts > expected.timeouts {
            let what = format!("port {nth} counted a timeout although its device was not silent");
            return Err((Invariant::FalseTimeout, what));
        }
        if differ(actual, &expected) {
            return Err((Invariant::Counted, format!("port {nth} counted {actual:?}, not {expected:?}")));
        }
        let accounted = line.frame_bytes + line.dropped + line.discarded + line.held.len() as u64;
        let spec = &self.spec.ports[nth];
        let reads = !spec.inputs.is_empty() || spec.exchanges.is_some();
        if !spec.is_can && spec.served.is_none() && reads && accounted as u32 != actual.bytes_in {
            let what =
                format!("port {nth} received {} bytes, {accounted} are accounted for", actual.bytes_in);
            return Err((Invariant::Bytes, what));
        }
        Ok(())
    }
}

/// After sleep, the gateway discards input from the field for this long.
const DISCARD_AFTER_SLEEP: Duration = Duration::from_millis(50);
