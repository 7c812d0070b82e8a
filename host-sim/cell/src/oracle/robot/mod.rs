//! The robot's side: the age of each value and command when the controller receives it, and whether everything that
//! must arrive does arrive (docs/cell.md section 4).
//!
//! In: the content of each transmission, when it arrives, and which paths to the controller work. Out: violations. Does
//! not know what the engine considers delivered.

mod due;

use std::collections::{BTreeMap, VecDeque};

use proto_core::engine::LinkId;
use proto_core::sysvar::SysVar;
use proto_core::time::{Duration, Instant};

use due::SAFE_ARRIVES;

use super::commands::Command;
use super::field::show;
use super::frame::Raw;
use super::invariant::Wrong;
use super::spec::Spec;
use super::upward::Carried;
use super::{Invariant, Oracle};
use crate::network::Sender;
use crate::tcp::USER_TIMEOUT;

/// The current state of one path to the controller.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Path {
    pub link: LinkId,
    /// The connection; `None` if there is none, or the link uses datagrams.
    pub conn: Option<u64>,
    /// Sent data arrives.
    pub is_sound: bool,
    /// The server executes requests and replies.
    pub is_served: bool,
}

/// A transmission.
#[derive(Debug, Clone)]
struct Transmission {
    sent_at: Instant,
    /// Offset of the end of the transmission in the connection's bytes.
    end: u64,
    /// Maximum time in flight, not counting the delay of the network.
    not_after: Duration,
    slowest: Duration,
    values: Vec<(SysVar, Raw, Carried)>,
    command: Option<InFlightCommand>,
}

/// A command in flight.
#[derive(Debug, Clone)]
struct InFlightCommand {
    command: Command,
    /// Since when it is no longer requested.
    unasked: Option<Instant>,
}

/// A device's request to stop the robot.
#[derive(Debug, Clone)]
struct StopRequest {
    command: Command,
    has_arrived: bool,
    /// Until then it may wait behind an equal command.
    not_before: Instant,
}

/// The transmissions of a connection that have not arrived.
#[derive(Debug, Clone, Default)]
struct InFlight {
    sent: u64,
    arrived: u64,
    transmissions: VecDeque<Transmission>,
}

/// Transmissions in flight, and what must be at the controller.
#[derive(Debug, Clone, Default)]
pub(super) struct Robot {
    /// Content of the transmission that the engine is sending.
    values: Vec<(SysVar, Raw, Carried)>,
    command: Option<InFlightCommand>,
    /// Buffers for values, reused.
    spare: Vec<Vec<(SysVar, Raw, Carried)>>,
    in_flight: BTreeMap<u64, InFlight>,
    /// The newest datagrams; the first one has this number.
    datagrams: VecDeque<Transmission>,
    first_tag: u64,
    stop_requests: Vec<StopRequest>,
    /// The newest urgent command.
    stopped_by: Option<Command>,
    /// Since when each path has worked without a fault, and been served.
    sound: BTreeMap<LinkId, Instant>,
    served: BTreeMap<LinkId, Instant>,
    conns: BTreeMap<LinkId, Option<u64>>,
    all_sound_since: Option<Instant>,
    /// When the controller was last restarted.
    started_at: Option<Instant>,
    /// Since when the frames of each recipe link could be sent.
    ready: BTreeMap<LinkId, Instant>,
    /// Beginning and end of the gateway's stalls.
    stalls: VecDeque<(Instant, Instant)>,
    /// The controller's inputs after the newest arrival, and when another program changed each byte.
    inputs: Vec<u8>,
    foreign_writes: BTreeMap<usize, Instant>,
    /// The sender of the newest frame to each port where the gateway listens.
    senders: BTreeMap<LinkId, Sender>,
}

impl Robot {
    pub(super) fn hands_over_nothing(&mut self) {
        self.values.clear();
        self.command = None;
    }

    pub(super) fn note_sent(&mut self, var: SysVar, raw: Raw, carried: Carried) {
        self.values.push((var, raw, carried));
    }

    pub(super) fn hands_over_command(&mut self, command: Command) {
        self.command = Some(InFlightCommand { command, unasked: None });
    }

    /// Devices request that the robot stops.
    pub(super) fn asked(&mut self, commands: Vec<Command>, waits_until: impl Fn(&Command) -> Instant) {
        for command in commands {
            self.stop_requests.retain(|request| {
                request.command.place != command.place || request.command.text != command.text
            });
            let not_before = waits_until(&command);
            self.stop_requests.push(StopRequest { command, has_arrived: false, not_before });
        }
    }

    /// Commands that are no longer requested need not arrive. After a while they must not arrive any more.
    pub(super) fn no_longer_asked(&mut self, is_asked: impl Fn(&Command) -> bool, now: Instant) {
        self.stop_requests.retain(|request| is_asked(&request.command));
        let transmissions = self.in_flight.values_mut().flat_map(|in_flight| &mut in_flight.transmissions);
        for in_flight in transmissions.filter_map(|transmission| transmission.command.as_mut()) {
            if in_flight.unasked.is_none() && !is_asked(&in_flight.command) {
                in_flight.unasked = Some(now);
            }
        }
    }

    /// The gateway slept: earlier requests no longer count.
    pub(super) fn forget_all(&mut self, now: Instant) {
        self.no_longer_asked(|_| false, now);
    }

    pub(super) fn restarted(&mut self, now: Instant) {
        self.forget_all(now);
        self.senders.clear();
        self.reset_soundness(now);
    }

    /// Counts all paths as working since now only.
    fn reset_soundness(&mut self, now: Instant) {
        self.sound.values_mut().chain(self.served.values_mut()).for_each(|since| *since = now);
    }

    fn transmission(&mut self, spec: &Spec, link: LinkId, slowest: Duration, now: Instant) -> Transmission {
        Transmission {
            sent_at: now,
            end: 0,
            not_after: not_after(spec, link),
            slowest,
            values: std::mem::replace(&mut self.values, self.spare.pop().unwrap_or_default()),
            command: self.command.take(),
        }
    }

    /// Whether a stall of the gateway ends now.
    pub(super) fn has_stalled(&self, now: Instant) -> bool {
        self.stalls.back().is_some_and(|(_, to)| *to == now)
    }

    /// Whether the gateway is not called at the moment.
    pub(super) fn is_stalled(&self, now: Instant) -> bool {
        self.stalls.back().is_some_and(|(from, to)| *from <= now && now <= *to)
    }

    /// Since when all paths that carry values have worked.
    pub(super) fn all_sound_since(&self) -> Option<Instant> {
        self.all_sound_since
    }

    /// For how long the gateway was not called since `since`.
    pub(super) fn stalled_since(&self, since: Instant, now: Instant) -> Duration {
        let part = |&(from, to): &(Instant, Instant)| to.min(now).saturating_since(from.max(since));
        self.stalls.iter().map(part).fold(Duration::ZERO, |sum, part| sum + part)
    }

    /// Whether the controller has restarted since `then` and the gateway must know.
    fn has_started_since(&self, then: Instant, now: Instant) -> bool {
        let knows = self.all_sound_since.is_some_and(|since| now.saturating_since(since) > SAFE_ARRIVES);
        knows && self.started_at.is_some_and(|began| began > then)
    }

    /// A transmission arrives: checks the age of its values and of its command.
    fn judge(&mut self, transmission: &Transmission, slowest: Duration, now: Instant) -> Result<(), Wrong> {
        let network = transmission.slowest.max(slowest) + ALLOWANCE;
        // While the engine is not called, only the transport's timeout ends connections.
        let stalled = self.stalled_since(transmission.sent_at, now).min(USER_TIMEOUT);
        for &(var, raw, carried) in &transmission.values {
            let (arrived, timeout) = match carried {
                Carried::Safe => continue,
                Carried::Held { accepted } if self.has_started_since(accepted, now) => {
                    let what = format!("{var} = {} is from before the controller restarted", show(var, raw));
                    return Err((Invariant::NoReplay, what));
                }
                Carried::Held { .. } => continue,
                Carried::Of { arrived, timeout } => (arrived, timeout),
            };
            let (age, most) =
                (now.saturating_since(arrived), timeout + transmission.not_after + network + stalled);
            if age > most {
                let what = format!(
                    "{var} = {} is {age} old at the controller; at most {most} is allowed",
                    show(var, raw)
                );
                return Err((Invariant::ValueAge, what));
            }
        }
        let Some(InFlightCommand { command, unasked }) = &transmission.command else { return Ok(()) };
        let (since, most) = match command.is_urgent() {
            true => (unasked.unwrap_or(now), URGENT_TTL),
            false => (command.picked, COMMAND_TTL),
        };
        let overtaken = self.stopped_by.as_ref().is_some_and(|stop| command.picked < stop.picked);
        if overtaken && !command.is_urgent() {
            let what = format!("{} arrives after an urgent command, but was picked before it", command.text);
            return Err((Invariant::Overtaken, what));
        }
        if command.is_urgent() {
            self.stopped_by = Some(command.clone());
        }
        let (age, most) = (now.saturating_since(since), most + network + stalled);
        if age > most {
            let what =
                format!("{} arrives {age} after it was asked for; at most {most} is allowed", command.text);
            return Err((Invariant::CommandAge, what));
        }
        for request in self.stop_requests.iter_mut().filter(|request| request.command.text == command.text) {
            request.has_arrived = true;
        }
        Ok(())
    }

    /// Compares the controller's inputs before an arrival with those after the previous one. Differences are writes of
    /// other programs.
    fn find_foreign_writes(&mut self, before: &[u8], now: Instant) {
        if self.inputs == before {
            return;
        }
        if self.inputs.len() == before.len() {
            for (at, _) in before.iter().zip(&self.inputs).enumerate().filter(|(_, (new, old))| new != old) {
                self.foreign_writes.insert(at, now);
            }
        }
        self.inputs.clear();
        self.inputs.extend_from_slice(before);
    }

    pub(super) fn applied(&mut self, before: &[u8], after: &[u8], now: Instant) {
        self.find_foreign_writes(before, now);
        if before != after {
            self.inputs.clear();
            self.inputs.extend_from_slice(after);
        }
    }

    pub(super) fn len(&self) -> usize {
        self.in_flight.values().map(|in_flight| in_flight.transmissions.len()).sum::<usize>()
            + self.datagrams.len()
    }
}

impl Oracle {
    /// The gateway sends bytes on a connection.
    pub(crate) fn sent(&mut self, conn: u64, link: LinkId, bytes: &[u8], slowest: Duration, now: Instant) {
        self.controller.sent(conn, bytes);
        let mut transmission = self.robot.transmission(&self.spec, link, slowest, now);
        let in_flight = self.robot.in_flight.entry(conn).or_default();
        in_flight.sent += bytes.len() as u64;
        transmission.end = in_flight.sent;
        in_flight.transmissions.push_back(transmission);
    }

    /// As [`Self::sent`], for a datagram; returns its number.
    pub(crate) fn sent_datagram(
        &mut self,
        link: LinkId,
        bytes: &[u8],
        slowest: Duration,
        now: Instant,
    ) -> u64 {
        self.controller.sent_datagram(u64::from(link.0), bytes);
        let transmission = self.robot.transmission(&self.spec, link, slowest, now);
        let Robot { datagrams, first_tag, .. } = &mut self.robot;
        datagrams.push_back(transmission);
        if datagrams.len() > DATAGRAMS {
            datagrams.pop_front();
            *first_tag += 1;
        }
        *first_tag + datagrams.len() as u64 - 1
    }

    /// The controller replied `unknown command` on a connection of port 2000.
    pub(crate) fn not_understood(&mut self, link: LinkId, now: Instant) {
        let quiet = self.robot.sound.get(&link).map(|since| now.saturating_since(*since));
        let result = match quiet {
            // After a delay, texts without terminators may have been received as one.
            Some(quiet) if quiet > Duration::from_secs(1) => {
                Err((Invariant::Understood, "the controller did not understand a command".to_owned()))
            }
            _ => Ok(()),
        };
        self.judge(now, &[], result);
    }

    pub(crate) fn conn_gone(&mut self, conn: u64) {
        self.controller.gone(conn);
        self.robot.in_flight.remove(&conn);
    }

    /// The controller has received this many more bytes on a connection.
    pub(super) fn delivered(&mut self, conn: u64, len: usize, slowest: Duration, now: Instant) {
        let Some(in_flight) = self.robot.in_flight.get_mut(&conn) else { return };
        in_flight.arrived += len as u64;
        let arrived = in_flight.arrived;
        let next = |robot: &mut Robot| {
            let transmissions = &mut robot.in_flight.get_mut(&conn)?.transmissions;
            transmissions.pop_front_if(|transmission| transmission.end <= arrived)
        };
        while let Some(mut transmission) = next(&mut self.robot) {
            self.judge_transmission(&transmission, slowest, now);
            transmission.values.clear();
            self.robot.spare.push(transmission.values);
        }
    }

    pub(super) fn datagram_delivered(&mut self, tag: u64, slowest: Duration, now: Instant) {
        let nth = tag.checked_sub(self.robot.first_tag).map(|nth| nth as usize);
        if let Some(transmission) = nth.and_then(|nth| self.robot.datagrams.get(nth)).cloned() {
            self.judge_transmission(&transmission, slowest, now);
        }
    }

    fn judge_transmission(&mut self, transmission: &Transmission, slowest: Duration, now: Instant) {
        self.checks[Invariant::ValueAge as usize] += transmission.values.len() as u64;
        self.checks[Invariant::CommandAge as usize] += u64::from(transmission.command.is_some());
        self.checks[Invariant::Understood as usize] += u64::from(transmission.command.is_some());
        self.checks[Invariant::Overtaken as usize] += u64::from(transmission.command.is_some());
        let result = self.robot.judge(transmission, slowest, now);
        self.judge(now, &[], result);
        let result = self.were_held(transmission, slowest, now);
        self.judge(now, &[], result);
    }

    /// Checks that the slaves of a line held the values of an arriving transmission.
    fn were_held(
        &mut self,
        transmission: &Transmission,
        slowest: Duration,
        now: Instant,
    ) -> Result<(), Wrong> {
        let stalled = self.robot.stalled_since(transmission.sent_at, now).min(USER_TIMEOUT);
        let way = transmission.not_after + transmission.slowest.max(slowest) + ALLOWANCE + stalled;
        for &(var, raw, carried) in &transmission.values {
            let (Carried::Of { timeout, .. }, Some(owned)) = (carried, self.spec.owned[var.ordinal()]) else {
                continue;
            };
            let Some(exchanges) = &self.spec.ports[owned.port].exchanges else { continue };
            // Nothing records the contents of input frames that belong to no exchange.
            let Some(row) = exchanges.rows.iter().find(|row| row.reply == Some(owned.frame)) else {
                continue;
            };
            self.checks[Invariant::Held as usize] += 1;
            // A reply was made at most this long before it is accepted.
            let asked = row.timeout.saturating_mul(u64::from(row.retries) + 3);
            let stalled = self.robot.stalled_since(now - timeout, now);
            let since = now - (timeout + way + asked + stalled);
            self.truth.was_held(owned.port, (var, raw), since, now)?;
        }
        Ok(())
    }

    /// A fault began or ended on a path, or on all of them.
    pub(crate) fn note_fault(&mut self, link: Option<LinkId>, now: Instant) {
        match link {
            Some(link) => {
                self.robot.sound.remove(&link);
                self.robot.served.remove(&link);
            }
            None => self.robot.reset_soundness(now),
        }
    }

    /// The controller restarts.
    pub(crate) fn controller_started(&mut self, now: Instant) {
        self.robot.inputs.clear();
        self.robot.foreign_writes.clear();
        self.robot.started_at = Some(now);
        self.robot.all_sound_since = None;
        self.robot.reset_soundness(now);
    }

    /// The gateway is not called from now until `until`.
    pub(crate) fn stalled(&mut self, until: Instant, now: Instant) {
        let stalls = &mut self.robot.stalls;
        stalls.retain(|(_, to)| now.saturating_since(*to) < REMEMBERED);
        // A prolonged stall counts as one stall.
        match stalls.back_mut() {
            Some((_, to)) if *to >= now => *to = until,
            _ => stalls.push_back((now, until)),
        }
        self.robot.reset_soundness(now);
    }

    /// A datagram arrives at a port where the gateway listens.
    pub(crate) fn datagram_received(&mut self, link: LinkId, from: Sender, bytes: &[u8]) {
        let frame = self.spec.link(link).and_then(|link| link.output.as_ref());
        if frame.is_some_and(|frame| frame.payload_of(bytes).is_some()) {
            self.robot.senders.insert(link, from);
        }
    }

    /// The link restarts: the gateway may answer whoever sends first.
    pub(super) fn forget_sender(&mut self, link: LinkId) {
        self.robot.senders.remove(&link);
    }

    /// The gateway sends a datagram on this link to `whom`.
    pub(crate) fn answers(&mut self, link: LinkId, whom: Option<Sender>, now: Instant) {
        let result = match self.robot.senders.get(&link) {
            Some(sender) if Some(*sender) != whom => Err((
                Invariant::Destination,
                format!("a datagram goes to {whom:?}, but {sender:?} sends frames"),
            )),
            _ => Ok(()),
        };
        self.judge(now, &[Invariant::Destination], result);
    }
}

/// How long data sent to a link may be in flight.
fn not_after(spec: &Spec, link: LinkId) -> Duration {
    spec.link(link).map_or(Duration::from_millis(500), |link| link.not_after)
}

/// A command arrives within this time after it was selected.
const COMMAND_TTL: Duration = Duration::from_secs(1);
/// An urgent command is sent within 1 s after the device last requested it, and acknowledged within another second.
const URGENT_TTL: Duration = Duration::from_secs(2);
/// Parts of a transmission that is split into segments arrive at least a microsecond apart.
const ALLOWANCE: Duration = Duration::from_millis(2);
/// Maximum number of datagrams that may still arrive.
const DATAGRAMS: usize = 4_096;
/// How long a stall is remembered.
const REMEMBERED: Duration = Duration::from_secs(60);
