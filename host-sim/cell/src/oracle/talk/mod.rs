//! Conversations with the slaves of a Modbus RTU line: what the gateway asks and takes, and what slaves and
//! controller really had (docs/cell.md section 4).

pub(super) mod line;
pub(super) mod spec;
pub(super) mod truth;

use proto_core::time::{Duration, Instant};

use self::spec::Seen;
use super::field::judge_data;
use super::upward::Wrong;
use super::{Invariant, Oracle};
use crate::SlaveDone;

impl Oracle {
    /// Bytes of a line came.
    pub(super) fn talk_bytes(&mut self, nth: usize, bytes: &[u8], now: Instant) {
        self.ports[nth].line.heard = now;
        self.ports[nth].line.held.extend_from_slice(bytes);
        loop {
            let (port, watch) = (&self.spec.ports[nth], &mut self.ports[nth]);
            let Some(talk) = &port.talk else { return };
            if watch.line.held.is_empty() {
                return;
            }
            let taken = match watch.talk.see(talk, &watch.line.held) {
                Seen::Begins => return,
                Seen::No => {
                    watch.line.drop_one();
                    continue;
                }
                Seen::Wrong(len) => {
                    if watch.line.drop_wrong(len) {
                        watch.talk.heard_wrong();
                        watch.counters.rejected_checksum += 1;
                    }
                    continue;
                }
                Seen::Refusal => 5,
                Seen::Reply(len) => len,
            };
            let reply = watch.line.take_front(taken);
            let is_refusal = reply[1] & 0x80 != 0;
            let began = watch.talk.began;
            let Some(flight) = watch.talk.answered(talk, is_refusal, now) else { continue };
            let row = &talk.rows[flight.row];
            let result = self.truth.taken((nth, port), row, &flight, (&reply, began), now);
            let frame = row.reply.filter(|_| !is_refusal);
            let data = || &reply[3..reply.len() - 2];
            let verdict = frame.map(|frame| judge_data(&port.inputs[frame], frame, data()));
            self.judge(now, &[Invariant::Held], result);
            self.take(nth, verdict.into_iter().collect(), now);
        }
    }

    /// The gateway asks.
    pub(super) fn talk_send(&mut self, nth: usize, bytes: &[u8], now: Instant) -> Result<(), Wrong> {
        let port = &self.spec.ports[nth];
        let Some(talk) = &port.talk else { return Ok(()) };
        let (robot, watch) = (&self.robot, &mut self.ports[nth]);
        if !watch.down.is_up {
            return Err((Invariant::Line, "asked while the line was gone".to_owned()));
        }
        let row = talk.row_of(bytes).filter(|_| spec::is_right(bytes));
        let Some(row) = row else {
            return Err((Invariant::Shown, format!("asked {bytes:02x?}, which no exchange asks")));
        };
        // What is held is too old to be the reply.
        watch.line.discard();
        let stalled = |since| robot.stalled_since(since, now);
        self.checks[Invariant::Periods as usize] +=
            watch.talk.keeps_periods(port, talk, watch.line.heard, stalled, now)?;
        watch.talk.hands_over(port, talk, (row, bytes), watch.line.heard, now)?;
        let asked = &talk.rows[row];
        if let Some(request) = &asked.request {
            watch.down.may_show_all(&self.spec, port, &self.up, asked.shown(), now)?;
            if !watch.down.agrees(request, &self.up, &asked.data_of(bytes)) {
                let what = format!("{}: the request does not have the newest values", line::name(asked));
                return Err((Invariant::Shown, what));
            }
        }
        watch.down.asked(bytes.len());
        self.truth.asks(nth, row, asked, bytes, now);
        Ok(())
    }

    /// Replies that have not come in time fail.
    pub(super) fn talk_tick(&mut self, nth: usize, now: Instant) {
        let Some(talk) = &self.spec.ports[nth].talk else { return };
        let watch = &mut self.ports[nth];
        if let Some(slave) = watch.talk.tick(talk, watch.line.heard, now) {
            self.truth.missed(nth, slave);
        }
    }

    /// A value may have changed: looks for bits that ask.
    pub(super) fn talk_values_changed(&mut self) {
        for (watch, port) in self.ports.iter_mut().zip(&self.spec.ports) {
            let Some(talk) = &port.talk else { continue };
            watch.talk.watch(talk, |row| {
                let (var, bit) = row.rising?;
                self.up.known(var).value.map(|(raw, _)| raw[0] >> bit & 1 == 1)
            });
        }
    }

    /// A slave of a line did something.
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

    /// Bytes were changed or lost on a line, or came from nobody's slave.
    pub(crate) fn line_garbled(&mut self, port: usize, now: Instant) {
        self.truth.garbled(port, now);
    }

    /// Whether [`Self::sees_controller`] is to be called.
    pub(crate) fn wants_controller(&self) -> bool {
        self.truth.wants_controller()
    }

    /// The controller's variables as they are now.
    pub(crate) fn sees_controller(&mut self, image: &[u8], now: Instant) {
        self.truth.sees_controller(image, now);
    }

    /// Checks periods, and what slaves must have been told. Called at intervals.
    pub(super) fn survey_talks(&mut self, now: Instant) {
        for nth in 0..self.ports.len() {
            let port = &self.spec.ports[nth];
            let Some(talk) = &port.talk else { continue };
            let (robot, watch) = (&self.robot, &mut self.ports[nth]);
            if self.discards_until.is_some() || !watch.down.is_up || robot.is_stalled(now) {
                watch.talk.disturbed_at = watch.talk.disturbed_at.max(now);
                continue;
            }
            let stalled = |since| robot.stalled_since(since, now);
            let mut result = watch.talk.keeps_periods(port, talk, watch.line.heard, stalled, now);
            self.checks[Invariant::Periods as usize] += *result.as_ref().unwrap_or(&1);
            let all = robot.all_sound_since();
            for (row, exchange) in talk.rows.iter().enumerate() {
                let is_told = exchange.on_change || exchange.every.is_some();
                let (true, Some(all), Some(could)) = (is_told, all, watch.talk.could_ask(talk, row)) else {
                    continue;
                };
                let settle = SETTLE + exchange.every.unwrap_or_default();
                if now.saturating_since(all.max(could)) <= settle {
                    continue;
                }
                let Some(told) = self.truth.is_told(nth, exchange, now - settle) else { continue };
                self.checks[Invariant::Told as usize] += 1;
                result = result.and_then(|checked| told.map(|()| checked));
            }
            self.judge(now, &[], result.map(drop));
        }
    }
}

/// The controller's values are at a slave this long after they have come to rest, if everything works.
const SETTLE: Duration = Duration::from_millis(1_500);
