//! The robot's side: how old each value and command is when the controller receives it, and whether
//! everything arrives that must (docs/cell.md section 4).
//!
//! In: the content of each transmission, when it arrives, and which paths to the controller work.
//! Does not know what the engine considers delivered.

mod must_arrive;

use std::collections::{BTreeMap, VecDeque};

use proto_core::engine::LinkId;
use proto_core::sysvar::SysVar;
use proto_core::time::{Duration, Instant};

use must_arrive::SAFE_ARRIVES;

use super::field::show;
use super::orders::Order;
use super::sheet::{Raw, Sheet};
use super::upward::{Carried, Wrong};
use super::{Invariant, Oracle};
use crate::network::Speaker;
use crate::tcp::USER_TIMEOUT;

/// One path to the controller, in the present state of the network.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Path {
    pub link: LinkId,
    /// Which connection it is, of those that are.
    pub conn: Option<u64>,
    /// There is a connection, and data sent on it arrives.
    pub is_sound: bool,
    /// The server there carries out and answers requests.
    pub is_served: bool,
}

/// One transmission.
#[derive(Debug, Clone)]
struct Parcel {
    sent_at: Instant,
    /// Number of the connection's bytes that have arrived when it has.
    end: u64,
    /// How long it may be in flight, apart from the network's own delay.
    not_after: Duration,
    slowest: Duration,
    values: Vec<(SysVar, Raw, Carried)>,
    order: Option<Errand>,
}

/// A command in flight.
#[derive(Debug, Clone)]
struct Errand {
    order: Order,
    /// Since when it is not asked for any more.
    unasked: Option<Instant>,
}

/// A device asks to stop the robot.
#[derive(Debug, Clone)]
struct Demand {
    order: Order,
    is_met: bool,
}

/// A connection's transmissions that have not arrived.
#[derive(Debug, Clone, Default)]
struct Road {
    sent: u64,
    arrived: u64,
    parcels: VecDeque<Parcel>,
}

/// Transmissions in flight, and what must be at the controller.
#[derive(Debug, Clone, Default)]
pub(super) struct Robot {
    /// The transmission that the engine hands over now.
    values: Vec<(SysVar, Raw, Carried)>,
    order: Option<Errand>,
    roads: BTreeMap<u64, Road>,
    /// The newest transmissions; the first has this number.
    datagrams: VecDeque<Parcel>,
    first_tag: u64,
    demands: Vec<Demand>,
    /// The newest urgent command.
    stopped_by: Option<Order>,
    /// Since when each path has worked without a fault, and answered; by the link's place.
    sound: BTreeMap<LinkId, Instant>,
    served: BTreeMap<LinkId, Instant>,
    conns: BTreeMap<LinkId, Option<u64>>,
    all_sound_since: Option<Instant>,
    /// When the controller restarted.
    began_at: Option<Instant>,
    /// Since when the frames of each recipe link could be sent.
    ready: BTreeMap<LinkId, Instant>,
    /// When the gateway was not called.
    stalls: VecDeque<(Instant, Instant)>,
    /// The controller's inputs after the newest arrival, and when somebody else wrote which.
    inputs: Vec<u8>,
    foreign: BTreeMap<usize, Instant>,
    /// Who sent the newest frame to a port where the gateway listens.
    speakers: BTreeMap<LinkId, Speaker>,
}

impl Robot {
    pub(super) fn hands_over_nothing(&mut self) {
        self.values.clear();
        self.order = None;
    }

    pub(super) fn hands_over(&mut self, var: SysVar, raw: Raw, carried: Carried) {
        self.values.push((var, raw, carried));
    }

    pub(super) fn hands_over_order(&mut self, order: Order) {
        self.order = Some(Errand { order, unasked: None });
    }

    /// Devices ask to stop the robot.
    pub(super) fn asked(&mut self, orders: Vec<Order>) {
        for order in orders {
            self.demands
                .retain(|demand| demand.order.place != order.place || demand.order.text != order.text);
            self.demands.push(Demand { order, is_met: false });
        }
    }

    /// A command that is not asked for any more need not arrive, and soon must not.
    pub(super) fn no_longer_asked(&mut self, is_asked: impl Fn(&Order) -> bool, now: Instant) {
        self.demands.retain(|demand| is_asked(&demand.order));
        let parcels = self.roads.values_mut().flat_map(|road| &mut road.parcels);
        for errand in parcels.filter_map(|parcel| parcel.order.as_mut()) {
            if errand.unasked.is_none() && !is_asked(&errand.order) {
                errand.unasked = Some(now);
            }
        }
    }

    /// The gateway slept: earlier requests do not count.
    pub(super) fn forget_all(&mut self, now: Instant) {
        self.no_longer_asked(|_| false, now);
    }

    pub(super) fn restarted(&mut self, now: Instant) {
        self.forget_all(now);
        self.speakers.clear();
        self.disturbed(now);
    }

    /// Nothing has worked for longer than since now.
    fn disturbed(&mut self, now: Instant) {
        self.sound.values_mut().chain(self.served.values_mut()).for_each(|since| *since = now);
    }

    fn parcel(&mut self, sheet: &Sheet, link: LinkId, slowest: Duration, now: Instant) -> Parcel {
        Parcel {
            sent_at: now,
            end: 0,
            not_after: not_after(sheet, link),
            slowest,
            values: std::mem::take(&mut self.values),
            order: self.order.take(),
        }
    }

    /// Whether the gateway was not called until now.
    pub(super) fn has_stalled(&self, now: Instant) -> bool {
        self.stalls.back().is_some_and(|(_, to)| *to == now)
    }

    /// How long the gateway was not called since then.
    fn stalled_since(&self, since: Instant, now: Instant) -> Duration {
        let part = |&(from, to): &(Instant, Instant)| to.min(now).saturating_since(from.max(since));
        self.stalls.iter().map(part).fold(Duration::ZERO, |sum, part| sum + part)
    }

    /// Whether the controller has restarted since then, and the gateway must know.
    fn has_begun_since(&self, then: Instant, now: Instant) -> bool {
        let knows = self.all_sound_since.is_some_and(|since| now.saturating_since(since) > SAFE_ARRIVES);
        knows && self.began_at.is_some_and(|began| began > then)
    }

    /// A transmission arrives: checks whether its values are recent enough.
    fn judge(&mut self, parcel: &Parcel, slowest: Duration, now: Instant) -> Result<(), Wrong> {
        let network = parcel.slowest.max(slowest) + ALLOWANCE;
        // Only the system's TCP timeout ends connections of an engine that is not called.
        let stalled = self.stalled_since(parcel.sent_at, now).min(USER_TIMEOUT);
        for &(var, raw, carried) in &parcel.values {
            let (arrived, timeout) = match carried {
                Carried::Safe => continue,
                Carried::Held { accepted } if self.has_begun_since(accepted, now) => {
                    let what = format!("{var} = {} is from before the controller restarted", show(var, raw));
                    return Err((Invariant::NoReplay, what));
                }
                Carried::Held { .. } => continue,
                Carried::Of { arrived, timeout } => (arrived, timeout),
            };
            let (age, most) = (now.saturating_since(arrived), timeout + parcel.not_after + network + stalled);
            if age > most {
                let what = format!(
                    "{var} = {} is {age} old at the controller; at most {most} is allowed",
                    show(var, raw)
                );
                return Err((Invariant::ValueAge, what));
            }
        }
        let Some(Errand { order, unasked }) = &parcel.order else { return Ok(()) };
        let (since, most) = match order.is_urgent() {
            true => (unasked.unwrap_or(now), URGENT_TTL),
            false => (order.picked, COMMAND_TTL),
        };
        let overtaken = self.stopped_by.as_ref().is_some_and(|stop| order.picked < stop.picked);
        if overtaken && !order.is_urgent() {
            let what = format!("{} arrives after an urgent command, but was picked before it", order.text);
            return Err((Invariant::Overtaken, what));
        }
        if order.is_urgent() {
            self.stopped_by = Some(order.clone());
        }
        let (age, most) = (now.saturating_since(since), most + network + stalled);
        if age > most {
            let what =
                format!("{} arrives {age} after it was asked for; at most {most} is allowed", order.text);
            return Err((Invariant::CommandAge, what));
        }
        for demand in self.demands.iter_mut().filter(|demand| demand.order.text == order.text) {
            demand.is_met = true;
        }
        Ok(())
    }

    /// The controller's inputs are `before` something arrives: other programs made the changes
    /// since.
    fn look_for_foreign(&mut self, before: &[u8], now: Instant) {
        if self.inputs.len() == before.len() && self.inputs != before {
            for (at, _) in before.iter().zip(&self.inputs).enumerate().filter(|(_, (new, old))| new != old) {
                self.foreign.insert(at, now);
            }
        }
        self.inputs.clear();
        self.inputs.extend_from_slice(before);
    }

    pub(super) fn applied(&mut self, before: &[u8], after: &[u8], now: Instant) {
        self.look_for_foreign(before, now);
        self.inputs.clear();
        self.inputs.extend_from_slice(after);
    }

    pub(super) fn len(&self) -> usize {
        self.roads.values().map(|road| road.parcels.len()).sum::<usize>() + self.datagrams.len()
    }
}

impl Oracle {
    /// The gateway's transport has taken bytes for a connection.
    pub(crate) fn sent(&mut self, conn: u64, link: LinkId, bytes: &[u8], slowest: Duration, now: Instant) {
        self.controller.sent(conn, bytes);
        let mut parcel = self.robot.parcel(&self.sheet, link, slowest, now);
        let road = self.robot.roads.entry(conn).or_default();
        road.sent += bytes.len() as u64;
        parcel.end = road.sent;
        road.parcels.push_back(parcel);
    }

    /// Same, for a datagram, which has this number from now on.
    pub(crate) fn sent_datagram(
        &mut self,
        link: LinkId,
        bytes: &[u8],
        slowest: Duration,
        now: Instant,
    ) -> u64 {
        self.controller.sent_datagram(u64::from(link.0), bytes);
        let parcel = self.robot.parcel(&self.sheet, link, slowest, now);
        let Robot { datagrams, first_tag, .. } = &mut self.robot;
        datagrams.push_back(parcel);
        if datagrams.len() > DATAGRAMS {
            datagrams.pop_front();
            *first_tag += 1;
        }
        *first_tag + datagrams.len() as u64 - 1
    }

    /// The controller has not understood what came on a connection of port 2000.
    pub(crate) fn not_understood(&mut self, link: LinkId, now: Instant) {
        let quiet = self.robot.sound.get(&link).map(|since| now.saturating_since(*since));
        let result = match quiet {
            // Nothing was delayed, which would join texts without terminators.
            Some(quiet) if quiet > Duration::from_secs(1) => {
                Err((Invariant::Understood, "the controller did not understand a command".to_owned()))
            }
            _ => Ok(()),
        };
        self.judge(now, &[], result);
    }

    pub(crate) fn conn_gone(&mut self, conn: u64) {
        self.controller.gone(conn);
        self.robot.roads.remove(&conn);
    }

    /// So many bytes of a connection have reached the controller's program.
    pub(super) fn came(&mut self, conn: u64, len: usize, slowest: Duration, now: Instant) {
        let Some(road) = self.robot.roads.get_mut(&conn) else { return };
        road.arrived += len as u64;
        let arrived = road.arrived;
        let mut came = Vec::new();
        while let Some(parcel) = road.parcels.pop_front_if(|parcel| parcel.end <= arrived) {
            came.push(parcel);
        }
        for parcel in came {
            self.judge_parcel(&parcel, slowest, now);
        }
    }

    pub(super) fn datagram_came(&mut self, tag: u64, slowest: Duration, now: Instant) {
        let nth = tag.checked_sub(self.robot.first_tag).map(|nth| nth as usize);
        if let Some(parcel) = nth.and_then(|nth| self.robot.datagrams.get(nth)).cloned() {
            self.judge_parcel(&parcel, slowest, now);
        }
    }

    fn judge_parcel(&mut self, parcel: &Parcel, slowest: Duration, now: Instant) {
        self.checks[Invariant::ValueAge as usize] += parcel.values.len() as u64;
        self.checks[Invariant::CommandAge as usize] += u64::from(parcel.order.is_some());
        self.checks[Invariant::Understood as usize] += u64::from(parcel.order.is_some());
        self.checks[Invariant::Overtaken as usize] += u64::from(parcel.order.is_some());
        let result = self.robot.judge(parcel, slowest, now);
        self.judge(now, &[], result);
    }

    /// A fault began or ended on a path, or on all of them.
    pub(crate) fn disturbed(&mut self, link: Option<LinkId>, now: Instant) {
        match link {
            Some(link) => {
                self.robot.sound.remove(&link);
                self.robot.served.remove(&link);
            }
            None => self.robot.disturbed(now),
        }
    }

    /// The controller restarts: its inputs have their present values then.
    pub(crate) fn controller_began(&mut self, now: Instant) {
        self.robot.inputs.clear();
        self.robot.foreign.clear();
        self.robot.began_at = Some(now);
        self.robot.all_sound_since = None;
        self.robot.disturbed(now);
    }

    /// The gateway is not called from now until then.
    pub(crate) fn stalled(&mut self, until: Instant, now: Instant) {
        let stalls = &mut self.robot.stalls;
        stalls.retain(|(_, to)| now.saturating_since(*to) < REMEMBERED);
        // A prolonged stall is one stall.
        match stalls.back_mut() {
            Some((_, to)) if *to >= now => *to = until,
            _ => stalls.push_back((now, until)),
        }
        self.robot.disturbed(now);
    }

    /// A datagram came to a port where the gateway listens.
    pub(crate) fn spoke(&mut self, link: LinkId, from: Speaker, bytes: &[u8]) {
        let frame = self.sheet.link(link).and_then(|link| link.output.as_ref());
        if frame.is_some_and(|frame| frame.payload_of(bytes).is_some()) {
            self.robot.speakers.insert(link, from);
        }
    }

    /// The link restarts: the first sender is answered.
    pub(super) fn nobody_spoke(&mut self, link: LinkId) {
        self.robot.speakers.remove(&link);
    }

    /// The gateway's datagrams of this link go to somebody.
    pub(crate) fn answers(&mut self, link: LinkId, whom: Option<Speaker>, now: Instant) {
        let result = match self.robot.speakers.get(&link) {
            Some(speaker) if Some(*speaker) != whom => Err((
                Invariant::Destination,
                format!("a datagram goes to {whom:?}, but {speaker:?} sends frames"),
            )),
            _ => Ok(()),
        };
        self.judge(now, &[Invariant::Destination], result);
    }
}

/// How long data handed over to a link may be in flight: after that, unacknowledged data is given
/// up with its connection. Datagrams do not wait.
fn not_after(sheet: &Sheet, link: LinkId) -> Duration {
    match sheet.link(link) {
        None => Duration::from_millis(500),
        Some(link) if link.is_datagram => Duration::ZERO,
        Some(link) => {
            let owned = sheet.owned.iter().flatten().filter(|owned| owned.way == link.id);
            let timeouts = owned.map(|owned| sheet.ports[owned.port].timeout);
            timeouts.min().unwrap_or_default().max(Duration::from_millis(250))
        }
    }
}

/// A command arrives within this time after it was picked.
const COMMAND_TTL: Duration = Duration::from_secs(1);
/// An urgent command is handed over within a second after the device last asked for it, and
/// acknowledged within another.
const URGENT_TTL: Duration = Duration::from_secs(2);
/// Segments that are cut come a microsecond apart.
const ALLOWANCE: Duration = Duration::from_millis(2);
/// Datagrams that may still arrive.
const DATAGRAMS: usize = 4_096;
/// How long a stall may matter.
const REMEMBERED: Duration = Duration::from_secs(60);
