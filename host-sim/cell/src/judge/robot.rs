//! The robot's log: its registers, and what its Modbus server has sent on which connection.

use std::collections::{BTreeMap, VecDeque};

use proto_core::sysvar::{ModbusPlace, SysVar};
use proto_core::time::{Duration, Instant};

use super::rules::{MOVE_BIT, Rules, STOP_BIT, Source, var};

/// The log of the robot's registers and replies.
#[derive(Debug)]
pub(super) struct Robot {
    bits: SysVar,
    first_coil: u16,
    /// When the bit that requests a motion rose, and whether that rise was executed.
    rises: VecDeque<(Instant, bool)>,
    was_on: bool,
    words: Vec<Word>,
    readings: VecDeque<Reading>,
    conns: BTreeMap<u64, Conn>,
    /// When the gateway started.
    started: Instant,
    /// When the gateway was last called again after a sleep, at which it may discard what has arrived.
    woke: Instant,
    /// When the gateway was last not called.
    pub not_called: Instant,
}

/// A variable that is sent to the device.
#[derive(Debug)]
struct Word {
    var: SysVar,
    register: u16,
    had: VecDeque<(Instant, u16)>,
    /// When the variable was read in a reply that the gateway has received.
    read: VecDeque<Instant>,
}

/// The bits as the gateway read them over a connection.
#[derive(Debug, Clone, Copy)]
struct Reading {
    conn: u64,
    asked: Instant,
    answered: Instant,
    moves: bool,
    stops: bool,
    /// When the gateway had certainly received the reply.
    taken: Option<Instant>,
}

/// A connection to the Modbus server.
#[derive(Debug, Default)]
struct Conn {
    came: Vec<u8>,
    went: Vec<u8>,
    /// The pending requests by transaction: when each was received, function, address and count.
    pending: BTreeMap<u16, (Instant, u8, u16, u16)>,
    /// When the newest request arrived.
    newest: Option<Instant>,
    /// Registers in the newest reply, which the gateway may not have received yet.
    open: Vec<usize>,
}

/// The rise for which an order was executed.
#[derive(Debug, Clone, Copy)]
pub(super) struct Rise {
    /// When the controller sent the reply with the rise.
    pub read: Instant,
    /// When the controller had sent a reply with a stop, at the latest this one.
    pub stop: Option<Instant>,
}

impl Robot {
    pub(super) fn new(rules: &Rules) -> Self {
        let bits = var("BitOutputReg[3]");
        let first_coil = match bits.modbus() {
            Some(ModbusPlace::Coils { first, .. }) => first,
            _ => panic!("{bits} has no coils"),
        };
        let register = |var: SysVar| match var.modbus() {
            Some(ModbusPlace::Register { address }) => address,
            _ => panic!("{var} has no register"),
        };
        let words = rules.sources().map(|var| Word {
            var,
            register: register(var),
            had: VecDeque::new(),
            read: VecDeque::new(),
        });
        Self {
            bits,
            first_coil,
            rises: VecDeque::new(),
            was_on: false,
            words: words.collect(),
            readings: VecDeque::new(),
            conns: BTreeMap::new(),
            started: Instant::ZERO,
            woke: Instant::ZERO,
            not_called: Instant::ZERO,
        }
    }

    /// How long data that the gateway has sent since then may have waited in the transport. A gateway that is not
    /// called cannot withdraw it.
    pub(super) fn transport(&self, rules: &Rules, since: Instant) -> Duration {
        if self.not_called >= since { rules.transport } else { Duration::ZERO }
    }

    /// The gateway has started, and knows nothing of earlier readings.
    pub(super) fn gateway_starts(&mut self, now: Instant) {
        self.started = now;
    }

    /// The gateway wakes. It may never process replies that were sent before, except those that it certainly received.
    pub(super) fn gateway_wakes(&mut self, now: Instant) {
        self.woke = now;
    }

    /// Reports the current variables of the controller.
    pub(super) fn sees(&mut self, image: &[u8], now: Instant) {
        let on = image[self.bits.image_offset()] >> MOVE_BIT & 1 == 1;
        if on && !std::mem::replace(&mut self.was_on, on) {
            self.rises.push_back((now, false));
        }
        self.was_on = on;
        for Word { var, had, .. } in &mut self.words {
            let value = word(image, *var);
            if had.back().is_none_or(|(_, newest)| *newest != value) {
                had.push_back((now, value));
            }
        }
    }

    /// Bytes arrived on a connection of the Modbus server.
    pub(super) fn asked(&mut self, id: u64, bytes: &[u8], now: Instant) {
        let conn = self.conns.entry(id).or_default();
        conn.came.extend_from_slice(bytes);
        while let Some(frame) = next_frame(&mut conn.came) {
            // The gateway has one request in flight, and gives it up after half a second. A new request before then
            // shows that it has received the reply.
            let before = conn.newest.replace(now);
            if let Some(before) = before.filter(|before| now.saturating_since(*before) < SURELY_TAKEN) {
                for nth in conn.open.drain(..) {
                    self.words[nth].read.push_back(now);
                }
                let newest = self.readings.iter_mut().rev().find(|reading| reading.conn == id);
                // The gateway ignores a reply to a request that it has given up.
                let woke = self.woke;
                let is_open = |reading: &&mut Reading| reading.asked >= before && reading.answered >= woke;
                if let Some(reading) = newest.filter(is_open) {
                    reading.taken.get_or_insert(now);
                }
            }
            conn.open.clear();
            if let &[high, low, _, _, _, _, _, function @ (1 | 3), a, b, c, d] = &frame[..] {
                let asked = (now, function, u16::from_be_bytes([a, b]), u16::from_be_bytes([c, d]));
                conn.pending.insert(u16::from_be_bytes([high, low]), asked);
            }
        }
    }

    /// The controller sends on a connection. Returns when it sent replies with a new stop. `heard`: when the device
    /// last received a stop.
    pub(super) fn answered(
        &mut self,
        id: u64,
        bytes: &[u8],
        now: Instant,
        heard: Option<Instant>,
    ) -> Vec<Instant> {
        let mut stops = Vec::new();
        let Some(conn) = self.conns.get_mut(&id) else { return stops };
        conn.went.extend_from_slice(bytes);
        while let Some(frame) = next_frame(&mut conn.went) {
            let transaction = u16::from_be_bytes([frame[0], frame[1]]);
            let Some((asked, function, address, count)) = conn.pending.remove(&transaction) else { continue };
            if frame.len() < 9 || frame[7] != function {
                continue;
            }
            let data = &frame[9..];
            if function == 3 {
                let read = |word: &Word| (address..address.saturating_add(count)).contains(&word.register);
                let words = self.words.iter().enumerate();
                conn.open.extend(words.filter(|(_, word)| read(word)).map(|(nth, _)| nth));
                continue;
            }
            let coil = |bit: u8| {
                let nth = usize::from((self.first_coil + u16::from(bit)).checked_sub(address)?);
                (nth < usize::from(count))
                    .then(|| data.get(nth / 8).map(|byte| byte >> (nth % 8) & 1 == 1))?
            };
            if let (Some(moves), Some(stops_now)) = (coil(MOVE_BIT), coil(STOP_BIT)) {
                let before = self
                    .readings
                    .iter()
                    .rev()
                    .find(|reading| reading.taken.is_some() && reading.answered >= self.started);
                let is_new = before
                    .is_none_or(|before| !before.stops && heard.is_none_or(|heard| heard < before.answered));
                if stops_now && is_new {
                    stops.push(now);
                }
                self.readings.push_back(Reading {
                    conn: id,
                    asked,
                    answered: now,
                    moves,
                    stops: stops_now,
                    taken: None,
                });
            }
        }
        stops
    }

    /// When the gateway had certainly received the reply sent at this instant.
    pub(super) fn taken(&self, conn: u64, answered: Instant) -> Option<Instant> {
        let reading =
            self.readings.iter().find(|reading| (reading.conn, reading.answered) == (conn, answered));
        reading?.taken
    }

    /// Finds and uses up the rise for which an order with these values is executed now. If several fit, it is the first
    /// one before which the device had received every stop; `heard` is when it last received one.
    pub(super) fn rise_for(
        &mut self,
        rules: &Rules,
        values: &[u32],
        heard: Option<Instant>,
        now: Instant,
    ) -> Result<Rise, String> {
        let (sources, trigger) = &rules.moves;
        let mut found = None;
        let mut why = "it was carried out, and the bit was not read rising".to_owned();
        for nth in 0..self.readings.len() {
            let on = self.readings[nth];
            // Requests that the gateway sent before its restart may still be on the line.
            let is_of_before = on.answered < self.started && now > self.started + super::ON_THE_LINE;
            if !on.moves || is_of_before {
                continue;
            }
            let before = self.readings.range(..nth).rev().find(|reading| reading.conn == on.conn);
            let Some(off) = before.filter(|before| !before.moves) else { continue };
            // Time in the network, and in the socket of a gateway that is not called.
            let known = on.taken.unwrap_or(on.answered + ON_ITS_WAY);
            let until = known + *trigger + super::ON_THE_LINE + self.transport(rules, on.answered);
            let late = now.saturating_since(until);
            if late > Duration::ZERO {
                why = format!("it was carried out {late} after the rise was over");
                continue;
            }
            let apart = on.answered.saturating_since(off.answered);
            if apart > rules.stale_after + ON_ITS_WAY {
                why = format!("it was carried out for a rise from a 0 that was read {apart} before");
                continue;
            }
            let between = |at: Instant| at >= off.asked && at <= on.answered;
            let rise = self.rises.iter().position(|(at, used)| between(*at) && !used);
            let Some(rise) = rise else {
                why = "it was carried out twice for one rise".to_owned();
                continue;
            };
            if !self.had(sources, values, on.answered, now) {
                why = format!(
                    "it was carried out with {values:?}, which the robot did not have since the rise"
                );
                continue;
            }
            let stop = self.stop_before(nth);
            let is_stopped = stop.is_some_and(|stop| heard.is_none_or(|heard| heard < stop));
            if !is_stopped || found.is_none() {
                found = Some((rise, off.asked, Rise { read: on.answered, stop }));
            }
            if !is_stopped {
                break;
            }
        }
        let Some((rise, from, found)) = found else { return Err(why) };
        // The gateway sees all rises between two readings as one.
        let between = |at: Instant| at >= from && at <= found.read;
        self.rises.iter_mut().skip(rise).filter(|(at, _)| between(*at)).for_each(|(_, used)| *used = true);
        Ok(found)
    }

    /// When a stop was read over the same connection, in this reading at the latest.
    fn stop_before(&self, nth: usize) -> Option<Instant> {
        let conn = self.readings[nth].conn;
        let own = self.readings.range(..=nth).enumerate().filter(|(at, reading)| {
            // The gateway has received each of these readings.
            reading.conn == conn && (reading.taken.is_some() || *at == nth)
        });
        let own: Vec<&Reading> = own.map(|(_, reading)| reading).collect();
        let rises = (0..own.len()).rev().find(|&at| own[at].stops && (at == 0 || !own[at - 1].stops));
        // Old readings may have been removed here.
        let before = rises.filter(|&at| at > 0).map(|at| own[at - 1].answered)?;
        // The gateway may have received the stop in an earlier reply.
        let mut all = self.readings.range(..=nth).filter(|reading| reading.conn == conn && reading.stops);
        all.find(|reading| reading.answered > before).map(|first| first.answered)
    }

    /// Whether the robot had all these values at the same time, at some instant between `from` and `until`.
    pub(super) fn had(&self, sources: &[Source], values: &[u32], from: Instant, until: Instant) -> bool {
        if sources.len() != values.len() {
            return false;
        }
        let mut together = vec![(from, until)];
        for (source, value) in sources.iter().zip(values) {
            let var = match source {
                Source::Constant(constant) if constant == value => continue,
                Source::Constant(_) => return false,
                // The judge checks these with the device's log.
                Source::Own(_) => continue,
                Source::Word(var) => var,
            };
            let Some(word) = self.words.iter().find(|word| word.var == *var) else { return false };
            let ends = word.had.iter().skip(1).map(|(at, _)| *at).chain([until]);
            let spans: Vec<_> = word
                .had
                .iter()
                .zip(ends)
                .filter(|((_, had), _)| u32::from(*had) == *value)
                .map(|((since, _), end)| (*since, end))
                .collect();
            let both = together.iter().flat_map(|one| {
                let cut = spans.iter().map(|other| (one.0.max(other.0), one.1.min(other.1)));
                cut.filter(|(since, end)| since <= end)
            });
            together = both.collect();
        }
        !together.is_empty()
    }

    /// The robot's value of a variable, and since when it is unchanged.
    pub(super) fn rests(&self, var: SysVar) -> Option<(Instant, u16)> {
        self.words.iter().find(|word| word.var == var)?.had.back().copied()
    }

    /// Whether the gateway has read a variable regularly since this instant.
    pub(super) fn is_read_steadily(&self, var: SysVar, since: Instant, now: Instant) -> bool {
        let Some(word) = self.words.iter().find(|word| word.var == var) else { return false };
        let mut newest = since;
        for at in word.read.iter().copied().filter(|at| *at >= since).chain([now]) {
            if at.saturating_since(newest) > STEADILY {
                return false;
            }
            newest = at;
        }
        true
    }

    /// Removes entries that are too old.
    pub(super) fn forget(&mut self, now: Instant) {
        let is_old = |at: Instant| now.saturating_since(at) > REMEMBERED;
        while self.readings.front().is_some_and(|reading| is_old(reading.answered)) {
            self.readings.pop_front();
        }
        while self.rises.front().is_some_and(|(at, _)| is_old(*at)) {
            self.rises.pop_front();
        }
        for Word { had, read, .. } in &mut self.words {
            while had.len() > 1 && is_old(had[1].0) {
                had.pop_front();
            }
            while read.front().is_some_and(|at| is_old(*at)) {
                read.pop_front();
            }
        }
        self.conns.retain(|_, conn| conn.newest.is_none_or(|newest| !is_old(newest)));
    }
}

/// A word from the controller's image.
pub(super) fn word(image: &[u8], var: SysVar) -> u16 {
    let at = var.image_offset();
    u16::from_le_bytes([image[at], image[at + 1]])
}

/// Takes a complete Modbus TCP frame from the front.
fn next_frame(bytes: &mut Vec<u8>) -> Option<Vec<u8>> {
    let len = 6 + usize::from(u16::from_be_bytes([*bytes.get(4)?, *bytes.get(5)?]));
    (bytes.len() >= len).then(|| bytes.drain(..len).collect())
}

/// A request within this time of the previous one follows a reply: requests without reply are given up after 500 ms.
const SURELY_TAKEN: Duration = Duration::from_millis(150);
/// A reply arrives at the gateway within this time, or is ignored: 500 ms, and a stall.
const ON_ITS_WAY: Duration = Duration::from_secs(1);
/// A variable that is read at least this often is never stale.
const STEADILY: Duration = Duration::from_millis(250);
/// Older entries are not needed.
const REMEMBERED: Duration = Duration::from_secs(20);
