//! Judges the exchanges of a port with the slaves of a Modbus RTU line, or with devices that have frames of their own:
//! what the gateway sends and accepts, and what devices and controller really had (docs/cell.md section 4).

pub(super) mod line;
pub(super) mod served;
#[cfg(test)]
mod tests;
pub(super) mod truth;

use proto_core::time::{Duration, Instant};
use proto_core::wire::can::CanFrame;

use self::line::{Ended, ExchangesWatch};
use super::device::Look;
use super::downward::Downward;
use super::field::{Accepted, Verdict};
use super::frame::Frame;
use super::gateway::Leaving;
use super::invariant::Wrong;
use super::spec::PortSpec;
use super::spec::exchanges::{ExchangesSpec, Kind, RowSpec};
use super::spec::frames::Seen;
use super::upward::Upward;
use super::varying::look;
use super::{Invariant, Oracle};
use crate::SlaveDone;

impl Oracle {
    /// Bytes were received on a line.
    pub(super) fn exchange_bytes(&mut self, nth: usize, bytes: &[u8], now: Instant) {
        self.ports[nth].line.heard = now;
        let mut verdicts = Vec::new();
        // One by one: a complete frame is taken before the next byte is interpreted.
        for &byte in bytes {
            self.ports[nth].line.held.push(byte);
            self.exchange_held(nth, &mut verdicts, now);
        }
        self.take(nth, verdicts, now);
    }

    /// Interprets the bytes received so far.
    fn exchange_held(&mut self, nth: usize, verdicts: &mut Vec<Verdict>, now: Instant) {
        loop {
            let (port, watch) = (&self.spec.ports[nth], &mut self.ports[nth]);
            let Some(exchanges) = &port.exchanges else { return };
            if watch.line.held.is_empty() {
                return;
            }
            match watch.exchanges.see(port, exchanges, &watch.line.held, now) {
                Seen::Begins { .. } => return,
                Seen::No => watch.line.drop_one(),
                Seen::Echo(len) => {
                    watch.line.take_front(len);
                    watch.exchanges.echoed();
                }
                Seen::Wrong(len) => {
                    if watch.line.drop_wrong(len, true) {
                        watch.exchanges.heard_wrong();
                        verdicts.push(Verdict::WrongChecksum);
                    }
                }
                Seen::Other(len) => {
                    watch.line.take_front(len);
                    verdicts.push(Verdict::OtherDevice);
                }
                Seen::ReplyOrEcho(len) => {
                    watch.line.take_front(len);
                    watch.exchanges.heard_reply_or_echo();
                }
                Seen::Late(len, row) => {
                    watch.line.take_front(len);
                    let started = watch.exchanges.came_late(exchanges, row, now);
                    self.started(nth, started);
                }
                Seen::Ambiguous(len) => {
                    watch.line.take_front(len);
                    let started = watch.exchanges.came_ambiguous(exchanges, now);
                    self.started(nth, started);
                }
                Seen::Unasked(len, frame) => {
                    let whole = watch.line.take_front(len);
                    verdicts.push(watch.line.judge(&port.inputs[frame], frame, &whole));
                    let started = heard_unasked(&mut watch.exchanges, exchanges, frame, now);
                    self.started(nth, started);
                }
                Seen::Refusal(len) => {
                    let refusal = watch.line.take_front(len);
                    let is_modbus =
                        watch.exchanges.pending(exchanges).is_some_and(|(row, _)| row.frames.is_none());
                    let ended = Ended::refused(refusal.get(2).copied().unwrap_or(0), is_modbus);
                    self.answered(nth, &refusal, ended, now);
                }
                Seen::Reply(len) => {
                    let reply = watch.line.take_front(len);
                    verdicts.extend(self.answered(nth, &reply, Ended::Good, now));
                }
            }
        }
    }

    /// A frame was received on a bus.
    pub(super) fn exchange_can(&mut self, nth: usize, frame: &CanFrame, now: Instant) {
        let (port, watch) = (&self.spec.ports[nth], &mut self.ports[nth]);
        let Some(exchanges) = &port.exchanges else { return };
        if frame.is_remote() {
            watch.counters.rejected_remote += 1;
            return;
        }
        let booted = exchanges.booted(frame.id(), frame.data());
        if let Some(slave) = booted {
            watch.exchanges.booted(exchanges, slave, now);
            self.truth.started(nth, slave);
        }
        let (port, watch) = (&self.spec.ports[nth], &mut self.ports[nth]);
        let is_it = |own: &Frame| {
            own.id == Some(frame.id()) && look(own, frame.data()) == Look::Frame(frame.data().len())
        };
        let pending = watch.exchanges.pending(exchanges);
        let frames = pending.and_then(|(row, _)| row.frames.as_ref());
        let is_reply = frames.and_then(|frames| frames.reply.as_ref()).is_some_and(is_it);
        let is_refusal = frames.and_then(|frames| frames.refusal.as_ref()).is_some_and(is_it)
            || pending.is_some_and(|(row, request)| row.is_abort(request, frame.id(), frame.data()));
        let is_answer = |row: &RowSpec| {
            let frames = row.frames.as_ref().filter(|frames| frames.is_asked);
            frames.is_some_and(|frames| frames.reply.iter().chain(&frames.refusal).any(is_it))
        };
        let late = watch.exchanges.late_of(exchanges, is_answer, now).filter(|_| !is_reply);
        match (is_reply || is_refusal, late) {
            (true, None) => {
                let ended = if is_reply { Ended::Good } else { Ended::Refused };
                let verdict = self.answered(nth, frame.data(), ended, now);
                return self.take(nth, verdict, now);
            }
            (true, Some(_)) => {
                let started = watch.exchanges.came_ambiguous(exchanges, now);
                return self.started(nth, started);
            }
            (false, Some(row)) => {
                let started = watch.exchanges.came_late(exchanges, row, now);
                return self.started(nth, started);
            }
            (false, None) => {}
        }
        let answers = frames.into_iter().flat_map(|frames| frames.reply.iter().chain(&frames.refusal));
        let answers = answers.map(|own| (usize::MAX, own));
        let unasked = exchanges.unasked.iter().map(|&unasked| (unasked, &port.inputs[unasked]));
        let which = exchanges.unasked.iter().copied().find(|&unasked| is_it(&port.inputs[unasked]));
        let verdict = super::field::can_of(answers.chain(unasked), port.mode, &mut watch.line, frame);
        if let (Ok(Verdict::Accepted(_)), Some(which)) = (&verdict, which) {
            let started = heard_unasked(&mut watch.exchanges, exchanges, which, now);
            self.started(nth, started);
        }
        self.take_can(nth, verdict, now);
    }

    /// Notes that a slave, if any, has started, and that the gateway knows it.
    fn started(&mut self, nth: usize, slave: Option<u8>) {
        if let Some(slave) = slave {
            self.truth.started(nth, slave);
        }
    }

    /// A device has answered. Returns the verdict on the values of its reply.
    fn answered(&mut self, nth: usize, reply: &[u8], ended: Ended, now: Instant) -> Option<Verdict> {
        let (port, watch) = (&self.spec.ports[nth], &mut self.ports[nth]);
        let exchanges = port.exchanges.as_ref()?;
        let waits = watch.exchanges.waits();
        let (flight, started) = watch.exchanges.answered(exchanges, ended, now)?;
        if waits && !port.is_can {
            watch.down.sent();
        }
        let row = &exchanges.rows[flight.row];
        let result = self.truth.taken((nth, port), row, &flight, reply, now);
        let verdict = row.reply.filter(|_| ended == Ended::Good).map(|frame| match row.frames {
            Some(_) => watch.line.judge(&port.inputs[frame], frame, reply),
            None => watch.line.judge_data(&port.inputs[frame], frame, &reply[3..reply.len() - 2]),
        });
        self.judge(now, &[Invariant::Held], result);
        self.started(nth, started);
        verdict.map(|verdict| match verdict {
            Verdict::Accepted(frame) => Verdict::Accepted(Accepted { asked: flight.timed_out, ..frame }),
            other => other,
        })
    }

    /// The gateway sends a request.
    pub(super) fn exchange_send(
        &mut self,
        nth: usize,
        sent: &Leaving<'_>,
        now: Instant,
    ) -> Result<(), Wrong> {
        let bytes = sent.bytes;
        let asked = |exchanges: &ExchangesSpec| exchanges.row_of((sent.id, sent.is_remote), bytes);
        let row = self.spec.ports[nth].exchanges.as_ref().and_then(asked);
        if self.ports[nth].exchanges.repeated_request().is_some_and(|failed| failed != bytes) {
            self.gives_up(nth, now);
        }
        let port = &self.spec.ports[nth];
        let Some(exchanges) = &port.exchanges else { return Ok(()) };
        let (robot, watch) = (&self.robot, &mut self.ports[nth]);
        if !watch.down.is_usable() {
            return Err((Invariant::Line, "asked while the line was gone".to_owned()));
        }
        let Some(row) = row else {
            return Err((Invariant::Shown, format!("asked {bytes:02x?}, which no exchange asks")));
        };
        if exchanges.unasked.is_empty() {
            // The bytes received so far are too old to belong to the reply.
            watch.line.discard();
        }
        let stalled = |since| robot.stalled_since(since, now);
        let line = (watch.line.heard, watch.down.is_busy());
        self.checks[Invariant::Periods as usize] +=
            watch.exchanges.keeps_periods(port, exchanges, line, stalled, now)?;
        self.checks[Invariant::Cycle as usize] += 1;
        look_at_opening(&mut watch.exchanges, port, |row| {
            Downward::may_show_all(port, &self.up, row.shown(), now).is_ok()
        });
        watch.exchanges.note_sent(port, exchanges, (row, bytes), line, now)?;
        let asked = &exchanges.rows[row];
        // The values of an event were fixed when it happened.
        if let Some(request) = asked.request.as_ref().filter(|_| asked.kind != Kind::Event) {
            let hidden = Downward::may_show_all(port, &self.up, asked.shown(), now);
            hidden.map_err(|hidden| hidden.wrong(&self.spec))?;
            if !agrees(&watch.down, asked, request, &self.up, bytes) {
                let what = format!("{}: the request does not have the newest values", line::name(asked));
                return Err((Invariant::Shown, what));
            }
        }
        watch.down.asked(bytes.len());
        self.truth.asks(nth, row, asked, bytes, now);
        Ok(())
    }

    /// A transmission has left.
    pub(super) fn port_sent(&mut self, nth: usize, now: Instant) {
        let (port, watch) = (&self.spec.ports[nth], &mut self.ports[nth]);
        watch.down.sent();
        if let Some(exchanges) = &port.exchanges {
            watch.exchanges.left(exchanges, port.turnaround, now);
            if watch.exchanges.waits() && !port.is_can {
                // The line belongs to the device until it has replied.
                watch.down.hold();
            }
        }
    }

    /// Lets requests fail whose replies are overdue.
    pub(super) fn exchange_tick(&mut self, nth: usize, now: Instant) {
        let Some(exchanges) = &self.spec.ports[nth].exchanges else { return };
        let watch = &mut self.ports[nth];
        look_at_opening(&mut watch.exchanges, &self.spec.ports[nth], |row| {
            Downward::may_show_all(&self.spec.ports[nth], &self.up, row.shown(), now).is_ok()
        });
        let waited = watch.exchanges.waits();
        let started = watch.exchanges.tick(exchanges, watch.line.heard, now);
        if let Some(slave) = started {
            self.truth.started(nth, slave);
        }
        if waited && !watch.exchanges.waits() && !self.spec.ports[nth].is_can {
            watch.down.sent();
        }
    }

    /// Gives up a repetition whose values may no longer be sent, or have changed; an event is repeated with its values.
    /// Returns whether it is given up.
    fn gives_up(&mut self, nth: usize, now: Instant) -> bool {
        let (port, watch) = (&self.spec.ports[nth], &mut self.ports[nth]);
        let Some((exchanges, failed)) = port.exchanges.as_ref().zip(watch.exchanges.repeats()) else {
            return false;
        };
        let row = &exchanges.rows[failed];
        let is_same = |request: &[u8]| {
            row.request.as_ref().is_none_or(|own| agrees(&watch.down, row, own, &self.up, request))
        };
        let is_event = row.kind == Kind::Event;
        if is_event
            || Downward::may_show_all(port, &self.up, row.shown(), now).is_ok()
                && watch.exchanges.repeated_request().is_some_and(is_same)
        {
            return false;
        }
        let started = watch.exchanges.is_not_repeated(exchanges, now);
        self.started(nth, started);
        true
    }

    /// Checks that an idle engine has no repetition waiting that could be sent.
    pub(super) fn exchange_rests(&mut self, nth: usize, now: Instant) -> Result<(), Wrong> {
        let (port, watch) = (&self.spec.ports[nth], &self.ports[nth]);
        if watch.exchanges.repeats().is_none() {
            return Ok(());
        }
        let is_free = watch.down.is_usable()
            && !watch.down.is_busy()
            && self.discards_until.is_none()
            && now >= watch.line.heard + port.turnaround;
        if is_free && !self.gives_up(nth, now) {
            return Err((Invariant::Periods, "a repetition waits although the line is free".to_owned()));
        }
        Ok(())
    }

    /// A value may have changed: checks the bits whose rise is an event.
    pub(super) fn exchange_values_changed(&mut self, now: Instant) {
        for (watch, port) in self.ports.iter_mut().zip(&self.spec.ports) {
            let Some(exchanges) = &port.exchanges else { continue };
            look_at_opening(&mut watch.exchanges, port, |row| {
                Downward::may_show_all(port, &self.up, row.shown(), now).is_ok()
            });
            let is_on = |row: &RowSpec| {
                let (var, bit) = row.rising?;
                self.up.known(var).value.map(|(raw, _)| raw[0] >> bit & 1 == 1)
            };
            watch.exchanges.watch(exchanges, is_on, now);
        }
    }

    /// A slave or a device with exchanges did something.
    pub(crate) fn slave_did(&mut self, port: usize, done: SlaveDone, now: Instant) {
        if self.violation.is_some() {
            return;
        }
        let robot = &self.robot;
        let stalled = |since| robot.stalled_since(since, now);
        let (checked, result) = self.truth.done(&self.spec, port, done, stalled, now);
        self.checks[Invariant::Carried as usize] += checked;
        self.judge(now, &[], result);
    }

    /// Bytes were corrupted or lost on a line, or were not sent by one of the simulated slaves.
    pub(crate) fn line_garbled(&mut self, port: usize, now: Instant) {
        self.truth.garbled(port, now);
    }

    /// Whether [`Self::sees_controller`] is needed.
    pub(crate) fn wants_controller(&self) -> bool {
        self.truth.wants_controller()
    }

    /// Reports the current variables of the controller.
    pub(crate) fn sees_controller(&mut self, image: &[u8], now: Instant) {
        self.truth.sees_controller(image, now);
    }

    /// Checks the periods, and that slaves have the newest values. Called at intervals.
    pub(super) fn survey_exchanges(&mut self, now: Instant) {
        for nth in 0..self.ports.len() {
            let port = &self.spec.ports[nth];
            let Some(exchanges) = &port.exchanges else { continue };
            let (robot, watch) = (&self.robot, &mut self.ports[nth]);
            if self.discards_until.is_some() || !watch.down.is_usable() || robot.is_stalled(now) {
                watch.exchanges.fault_at = watch.exchanges.fault_at.max(now);
                continue;
            }
            let stalled = |since| robot.stalled_since(since, now);
            let mut result = watch.exchanges.keeps_periods(
                port,
                exchanges,
                (watch.line.heard, watch.down.is_busy()),
                stalled,
                now,
            );
            self.checks[Invariant::Periods as usize] += *result.as_ref().unwrap_or(&1);
            let all = robot.all_sound_since();
            for (row, exchange) in exchanges.rows.iter().enumerate() {
                let is_kept = exchange.on_change || exchange.every.is_some();
                let (true, Some(all), Some(could)) =
                    (is_kept, all, watch.exchanges.could_ask(exchanges, row))
                else {
                    continue;
                };
                let settle = SETTLE + exchange.every.unwrap_or_default();
                if now.saturating_since(all.max(could)) <= settle {
                    continue;
                }
                let Some(updated) = self.truth.is_up_to_date(nth, exchange, now - settle) else { continue };
                self.checks[Invariant::Updated as usize] += 1;
                result = result.and_then(|checked| updated.map(|()| checked));
            }
            self.judge(now, &[], result.map(drop));
        }
    }
}

/// An unsolicited frame was received: a sign of life if it is also the reply of an exchange.
fn heard_unasked(
    watch: &mut ExchangesWatch,
    exchanges: &ExchangesSpec,
    frame: usize,
    now: Instant,
) -> Option<u8> {
    let row = exchanges.rows.iter().find(|row| row.reply == Some(frame))?;
    watch.heard(exchanges, row.slave, now)
}

/// Whether a request has the newest values.
fn agrees(down: &Downward, row: &RowSpec, request: &Frame, up: &Upward, bytes: &[u8]) -> bool {
    let data = row.data_of(bytes);
    let payload = if row.frames.is_some() { request.payload_of(&data) } else { Some(&data[..]) };
    payload.is_some_and(|payload| down.agrees(request, up, payload))
}

/// Notes the start exchanges that cannot be sent now because their values are unknown or stale.
fn look_at_opening(watch: &mut ExchangesWatch, port: &PortSpec, can_ask: impl Fn(&RowSpec) -> bool) {
    let rows = port.exchanges.as_ref().map_or(&[][..], |exchanges: &ExchangesSpec| &exchanges.rows);
    watch.look_at_opening(|row| rows.get(row).is_some_and(&can_ask));
}

/// If everything works, a slave has the controller's values this long after their last change.
const SETTLE: Duration = Duration::from_millis(1_500);
