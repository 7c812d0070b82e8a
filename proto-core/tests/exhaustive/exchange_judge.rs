//! What the gateway promises of requests to a slave: events, stops, replies that come late (P8 to P11,
//! docs/engine.md section 13).
//!
//! In: what the slave was asked and when, how it answered, the controller's frames, the driver's calls. It
//! knows the configuration of the cell and nothing of the engine's queues.

use proto_core::engine::{Input, LinkId};
use proto_core::time::{Duration, Instant};
use proto_core::wire::scalar::Scalar;

use crate::driver::{AFTER_SLEEP, Broken, Conns, Is, Judge, Room};
use crate::exchange_cell::{Adapter, LINK};
use crate::rig::var;

pub const EXCHANGES: usize = 4;
/// What the registers become: what only the link carries.
pub const READ: [&str; 2] = ["ForceEnd[1]", "ForceEnd[2]"];
/// The bits that start and stop the slave, and where to.
pub const BITS: &str = "BitOutputReg[3]";
pub const TARGET: &str = "WordOutputReg[1]";
pub const START: u8 = 1;
pub const STOP: u8 = 2;
/// What is written to stop.
pub const FLOATING: u16 = 9;

pub const TIMEOUT: Duration = Duration::from_millis(100);
pub const TRIGGER: Duration = Duration::from_millis(150);
pub const LATE: Duration = Duration::from_millis(250);
pub const PERIOD: Duration = Duration::from_millis(400);
pub const STALE_AFTER: Duration = Duration::from_millis(200);
/// A silent controller is not there.
const SILENCE: Duration = Duration::from_secs(2);
const PATIENCE: Duration = Duration::from_millis(250);
/// A slave that was busy is left alone for so long at most.
const BUSY: Duration = Duration::from_millis(800);
/// Behind a damaged reply the line is silent for so long at most.
const QUIET: Duration = Duration::from_millis(10);

/// The exchanges, in their order in the recipe.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum What {
    First,
    Second,
    Start,
    Stop,
}

/// What the slave answers.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Answer {
    Good,
    /// A Modbus exception.
    Refused(u8),
    /// The good answer with a wrong checksum.
    Damaged,
}

/// A transmission that the slave has not answered.
#[derive(Debug, Clone)]
pub struct Asked {
    pub what: What,
    pub request: Vec<u8>,
    pub at: Instant,
    /// The slave's register, or what is written to it.
    pub value: u16,
    /// The line's newest request, or one that it repeats. Of a stop, any since it was wanted.
    is_newest: bool,
}

/// The request that the line waits for.
#[derive(Debug, Clone, Copy)]
struct Awaited {
    what: What,
    until: Instant,
    /// Since when a damaged reply is there, and its value: it fails once the line is silent, unless the
    /// bytes were noise.
    damaged: Option<(Instant, u16)>,
    /// It was refused, or another request was.
    is_doubtful: bool,
}

/// The controller's newest frame.
#[derive(Debug, Clone, Copy)]
struct Reading {
    bits: u8,
    at: Instant,
}

/// A rise of the bit that starts.
#[derive(Debug, Clone, Copy)]
struct Rise {
    target: u16,
    until: Instant,
    is_sent: bool,
    /// The slave was busy: the gateway waits before it asks again.
    was_busy: bool,
}

/// What becomes of an event.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum End {
    Done,
    Refused,
    Unknown,
    Expired,
    Away,
    StillOpen,
    Stopped,
}

/// What is so.
#[derive(Debug, Clone)]
pub struct Facts {
    adapter: Adapter,
    pub is_up: bool,
    slept_until: Option<Instant>,
    pub asked: Vec<Asked>,
    /// What the adapter gives back.
    pub echo: Option<Vec<u8>>,
    /// The answer that comes next.
    coming: Option<(Asked, Answer)>,
    awaited: Option<Awaited>,
    /// What was sent last, when, and how often in a row.
    last: Option<(What, Instant, u8)>,
    /// Nothing may be asked before: replies to what was asked before the line was there may come.
    closed_until: Option<Instant>,
    /// An event need not be sent before.
    held_until: Option<Instant>,
    /// A request was not answered since the slave was heard.
    is_silent: bool,
    /// Whether the next read of a register finds the second of its two values.
    is_odd: [bool; 2],
    read: [Option<f32>; 2],
    reading: Option<Reading>,
    last_bits: u8,
    /// That is read anew, because the line was not there.
    is_forgotten: bool,
    rise: Option<Rise>,
    /// Events by how they ended; not part of the state.
    counted: [u32; 7],
    /// A stop is wanted, or may be repeated all the same.
    is_stopping: bool,
    may_stop: bool,
    /// What answers the stop could be another's answer.
    is_unsure: bool,
    /// A stop that failed is not repeated before.
    stop_at: Option<Instant>,
    frame_by: Option<Instant>,
}

impl What {
    pub fn address(self) -> u16 {
        match self {
            What::First => 0x10,
            What::Second => 0x11,
            What::Start | What::Stop => 0x20,
        }
    }

    fn of(request: &[u8]) -> Option<Self> {
        let (function, address) = (request[1], u16::from_be_bytes([request[2], request[3]]));
        let writes = matches!(function, 6 | 16) && address == What::Start.address();
        match function {
            3 => [What::First, What::Second].into_iter().find(|what| what.address() == address),
            _ if writes && written(request) == FLOATING => Some(What::Stop),
            _ => writes.then_some(What::Start),
        }
    }

    /// Whether its reply could be taken for the other's.
    fn is_like(self, other: Self) -> bool {
        self.address() / 0x10 == other.address() / 0x10
    }
}

/// The value that is written.
fn written(request: &[u8]) -> u16 {
    let value = &request[request.len() - 4..];
    u16::from_be_bytes([value[0], value[1]])
}

impl Answer {
    /// Slave device busy, and illegal data address.
    pub const BUSY: Self = Self::Refused(6);
    pub const NO: Self = Self::Refused(2);
}

impl Facts {
    pub fn new(adapter: Adapter) -> Self {
        Self {
            adapter,
            is_up: false,
            slept_until: None,
            asked: Vec::new(),
            echo: None,
            coming: None,
            awaited: None,
            last: None,
            closed_until: None,
            held_until: None,
            is_silent: false,
            is_odd: [false; 2],
            read: [None; 2],
            reading: None,
            last_bits: 0,
            is_forgotten: false,
            rise: None,
            counted: [0; 7],
            is_stopping: false,
            may_stop: false,
            is_unsure: false,
            stop_at: None,
            frame_by: None,
        }
    }

    /// Whether the line waits for this request's answer.
    pub fn is_awaited(&self, asked: &Asked) -> bool {
        match self.awaited {
            // All replies to these are the same.
            Some(Awaited { what: What::Stop, .. }) => asked.what == What::Stop,
            awaited => awaited.is_some() && asked.is_newest,
        }
    }

    /// The slave answers one of its requests; the bytes are told next.
    pub fn answers(&mut self, nth: usize, answer: Answer) {
        self.coming = Some((self.asked.remove(nth), answer));
    }

    fn is_usable(&self) -> bool {
        self.is_up && self.slept_until.is_none()
    }

    /// What is over makes no difference any more.
    fn forget(&mut self, now: Instant) {
        self.asked.retain(|asked| now < asked.at + LATE);
        for until in [&mut self.closed_until, &mut self.held_until, &mut self.stop_at] {
            *until = until.filter(|until| now < *until);
        }
        self.last = self.last.filter(|(_, at, _)| now <= *at + TIMEOUT + QUIET);
    }

    fn hold(&mut self, until: Instant) {
        self.held_until = self.held_until.max(Some(until));
    }

    fn count(&mut self, end: End) {
        self.counted[end as usize] += 1;
    }

    fn end(&mut self, end: End) {
        self.rise = None;
        self.count(end);
    }

    fn end_if(&mut self, is_sent: bool, end: End) {
        if self.rise.is_some_and(|rise| rise.is_sent == is_sent) {
            self.end(end);
        }
    }

    /// An event expires, and a request fails, at the latest.
    fn passes(&mut self, now: Instant) {
        if self.rise.is_some_and(|rise| now >= rise.until) {
            self.end_if(false, End::Expired);
        }
        if self.awaited.is_some_and(|awaited| now >= awaited.until) {
            self.fails(now);
        }
    }

    /// Whether the line may not wait any more.
    pub fn may_have_failed(&self, now: Instant) -> bool {
        let has_failed =
            |awaited: Awaited| awaited.is_doubtful || awaited.damaged.is_some_and(|(at, _)| now > at);
        self.awaited.is_some_and(has_failed)
    }

    fn fails(&mut self, now: Instant) {
        let Some(awaited) = self.awaited.take() else { return };
        self.is_silent |= awaited.damaged.is_none() && !awaited.is_doubtful;
        self.end_if(true, End::Unknown);
        if awaited.what == What::Stop {
            self.stop_at = Some(now + TIMEOUT);
        }
    }

    /// The line does not wait any more.
    fn abandon(&mut self) {
        self.end_if(true, End::Unknown);
        self.end_if(false, End::Away);
        self.awaited = None;
        self.is_forgotten = true;
    }

    /// An answer has come.
    fn heard(&mut self, now: Instant, asked: &Asked, answer: Answer) {
        if !self.is_usable() {
            // Nobody knows of it.
            return self.hold(asked.at + LATE);
        }
        if answer == Answer::Damaged {
            self.hold(now + LATE);
            if let Some(awaited) = &mut self.awaited {
                awaited.damaged.get_or_insert((now, asked.value));
            }
            return;
        }
        self.is_silent = false;
        let Some(awaited) = self.awaited else { return };
        // The answers to both writes are the same, and a refusal says of none of them whose it is.
        let is_start_open = self.asked.iter().any(|other| other.what == What::Start);
        if awaited.what == What::Stop {
            let is_like = asked.what == What::Start && self.adapter == Adapter::Silent;
            let is_open = is_start_open || self.held_until.is_some() || self.closed_until.is_some();
            if answer != Answer::Good && is_open {
                // Whether it counts, nobody can tell.
                self.awaited = Some(Awaited { is_doubtful: true, ..awaited });
                return;
            }
            if asked.what == What::Stop || is_like && answer == Answer::Good {
                (self.awaited, self.last) = (None, None);
                self.stop_at = Some(now + TIMEOUT);
            }
            if asked.what == What::Stop && asked.is_newest && answer == Answer::Good {
                self.may_stop = std::mem::take(&mut self.is_unsure) || is_start_open;
                self.is_stopping = false;
            }
            return;
        }
        if !asked.is_newest || asked.what == What::Stop {
            return;
        }
        (self.awaited, self.last) = (None, None);
        match (asked.what, answer) {
            (What::First | What::Second, Answer::Good) => {
                self.read[asked.what as usize] = Some(f32::from(asked.value));
                if let Some(Reading { bits, at }) = self.reading.filter(|_| self.is_forgotten) {
                    self.read(at, bits, 0);
                } else if std::mem::take(&mut self.is_forgotten) {
                    // As it was over the connection that is lost.
                    self.may_stop |= self.last_bits & STOP != 0;
                }
            }
            (What::Start, Answer::Good) => self.end(End::Done),
            (What::Start, Answer::BUSY) => {
                self.hold(now + BUSY);
                match &mut self.rise {
                    Some(rise) if now < rise.until => (rise.is_sent, rise.was_busy) = (false, true),
                    _ => self.end(End::Expired),
                }
            }
            (What::Start, _) => self.end(End::Refused),
            _ => {}
        }
    }

    /// The controller's frame has come, or is read anew.
    fn read(&mut self, now: Instant, bits: u8, target: u16) {
        let before = self.reading.replace(Reading { bits, at: now }).filter(|_| !self.is_forgotten);
        (self.is_forgotten, self.last_bits) = (false, bits);
        if bits & START != 0
            && let Some(before) = before
            && before.bits & START == 0
            && now.saturating_since(before.at) <= STALE_AFTER
        {
            self.rises(Rise { target, until: now + TRIGGER, is_sent: false, was_busy: false });
        }
        if bits & STOP != 0 && before.is_none_or(|before| before.bits & STOP == 0) {
            if self.is_stopping {
                // It may be sent once more.
                self.is_unsure = true;
            } else {
                // What was sent before was another one.
                let stops = self.asked.iter_mut().filter(|asked| asked.what == What::Stop);
                stops.for_each(|asked| asked.is_newest = false);
            }
            self.is_stopping = true;
            self.end_if(false, End::Stopped);
        }
    }

    fn rises(&mut self, rise: Rise) {
        match () {
            () if self.rise.is_some() => self.count(End::StillOpen),
            () if !self.is_up => self.count(End::Away),
            () if self.is_stopping => self.count(End::Stopped),
            () => self.rise = Some(rise),
        }
    }

    /// Where the promises leave the gateway a choice, it has made it.
    fn chooses(&mut self, now: Instant, counted: &[u32; 7]) {
        let before = self.counted;
        let is_more = |end: End| counted[end as usize] == before[end as usize] + 1;
        if is_more(End::Unknown) && self.may_have_failed(now) {
            self.fails(now);
        }
        let waits = self.rise.is_some_and(|rise| !rise.is_sent);
        if is_more(End::Away) && self.is_silent {
            // Whether it is away, or one request was lost.
            match waits {
                true => self.end(End::Away),
                false if counted[End::Stopped as usize] + 1 == self.counted[End::Stopped as usize] => {
                    self.counted[End::Stopped as usize] -= 1;
                    self.count(End::Away);
                }
                false => {}
            }
        } else if is_more(End::Stopped) && waits && self.may_stop {
            self.end(End::Stopped);
        }
    }
}

impl Judge<EXCHANGES> for Facts {
    fn told(&mut self, now: Instant, input: &Input<'_>, conns: &mut Conns) {
        self.forget(now);
        match *input {
            Input::Tick => self.slept_until = self.slept_until.filter(|&until| now < until),
            Input::PortBytes { .. } => {
                if let Some((asked, answer)) = self.coming.take() {
                    self.heard(now, &asked, answer);
                }
            }
            Input::PortUp { .. } => {
                (self.is_up, self.is_silent, self.stop_at) = (true, false, None);
                self.closed_until = Some(now + LATE);
            }
            Input::PortDown { .. } => {
                self.is_up = false;
                self.abandon();
            }
            Input::LinkUp { .. } => self.frame_by = Some(now + SILENCE),
            Input::LinkBytes { link, bytes } if conns.is_open(link) => {
                self.frame_by = Some(now + SILENCE);
                self.read(now, bytes[2], u16::from_le_bytes([bytes[3], bytes[4]]));
            }
            _ => {}
        }
    }

    fn down(&mut self, _: Instant, _: LinkId, _: Is, _: &mut Conns) {}

    fn deadlines(&mut self, now: Instant, conns: &mut Conns) -> Result<(), Broken> {
        self.forget(now);
        self.passes(now);
        let is_late = self.frame_by.is_some_and(|by| now >= by);
        for link in conns.overdue(now).into_iter().chain(is_late.then_some(LINK)) {
            conns.must_close(now, link);
            self.lost(now, link);
        }
        Ok(())
    }

    fn lost(&mut self, _: Instant, _: LinkId) {
        (self.reading, self.frame_by) = (None, None);
    }

    fn slept(&mut self, now: Instant) {
        // Its deadlines have passed before.
        self.passes(now);
        self.abandon();
        self.slept_until = Some(now + AFTER_SLEEP);
    }

    fn sent(&mut self, now: Instant, _: LinkId, bytes: &[u8], _: &mut Conns) -> Result<Instant, Broken> {
        let [255, 255, a, b, c, d, e, f, g, h, 238, 238] = *bytes else {
            return Err(format!("sends {bytes:?}"));
        };
        let read = [[a, b, c, d], [e, f, g, h]].map(|bytes| Some(f32::from_le_bytes(bytes)));
        if read != self.read {
            return Err(format!("tells the controller {read:?} instead of {:?}", self.read));
        }
        Ok(now + PATIENCE)
    }

    fn shown(&mut self, now: Instant, bytes: &[u8]) -> Result<(), Broken> {
        self.forget(now);
        if self.may_have_failed(now) {
            self.fails(now);
        }
        let what = What::of(bytes).ok_or_else(|| format!("asks {bytes:?}"))?;
        if !self.is_usable() || self.awaited.is_some() {
            return Err(format!("sends {what:?} while {:?} is awaited", self.awaited));
        }
        let in_a_row = match self.last {
            Some((last, _, nth)) if last == what && what != What::Start => nth + 1,
            _ => 0,
        };
        let is_repetition = in_a_row == 1;
        let mut like = self.asked.iter().filter(|asked| asked.what.is_like(what));
        let value = match what {
            What::Stop if !self.is_stopping && !self.may_stop => return Err("stops for no reason".to_owned()),
            What::Stop => {
                let is_open = self.held_until.is_some() || self.closed_until.is_some();
                self.is_unsure |= is_open || like.any(|asked| asked.what == What::Start || !asked.is_newest);
                FLOATING
            }
            _ if self.is_stopping && self.stop_at.is_none() => {
                return Err(format!("sends {what:?} before the stop"));
            }
            _ if self.closed_until.is_some() => {
                return Err(format!("sends {what:?} before older replies are over"));
            }
            _ if like.any(|asked| !is_repetition || !asked.is_newest) => {
                return Err(format!("sends {what:?} while the reply to one that is alike may come"));
            }
            What::Start => {
                let value = written(bytes);
                let rise = self.rise.filter(|rise| !rise.is_sent && now < rise.until);
                if rise.is_none_or(|rise| rise.target != value) {
                    return Err(format!("starts to {value}, and {rise:?} is open"));
                }
                self.rise = rise.map(|rise| Rise { is_sent: true, ..rise });
                value
            }
            What::First | What::Second => {
                let is_odd = &mut self.is_odd[what as usize];
                *is_odd = !*is_odd;
                10 * (1 + what as u16) + u16::from(*is_odd)
            }
        };
        for asked in self.asked.iter_mut().filter(|asked| !is_repetition && asked.what != What::Stop) {
            asked.is_newest = false;
        }
        self.asked.push(Asked { what, request: bytes.to_vec(), at: now, value, is_newest: true });
        self.last = Some((what, now, in_a_row));
        self.awaited = Some(Awaited { what, until: now + TIMEOUT, damaged: None, is_doubtful: false });
        self.echo = (self.adapter == Adapter::Echoes).then(|| bytes.to_vec());
        Ok(())
    }

    fn rested(
        &mut self,
        now: Instant,
        _: Instant,
        engine: &Room<EXCHANGES>,
        _: &Conns,
        is_late: bool,
    ) -> Result<(), Broken> {
        let image = engine.image();
        let known = |name| image.is_known(var(name)).then(|| image.value(var(name)));
        let read = READ.map(known);
        if read != self.read.map(|value| value.map(Scalar::Float)) {
            return Err(format!("has {read:?} instead of {:?}", self.read));
        }
        let status = engine.status(now);
        let peer =
            status.ports().next().and_then(|port| port.peers().next()).ok_or("the slave is missing")?;
        let events = peer.counters.events;
        let counted = [
            events.done,
            events.refused,
            events.unknown,
            events.expired,
            events.away,
            events.still_open,
            events.stopped,
        ];
        self.chooses(now, &counted);
        if counted != self.counted {
            return Err(format!("counts {counted:?} instead of {:?}", self.counted));
        }
        if is_late || !self.is_usable() || self.awaited.is_some() {
            return Ok(());
        }
        if self.is_stopping && self.stop_at.is_none() {
            return Err("lets the stop wait".to_owned());
        }
        let waits = self.rise.is_some_and(|rise| !rise.is_sent && !rise.was_busy);
        let is_held = self.is_stopping || self.may_stop || self.closed_until.is_some();
        let like = self.asked.iter().any(|asked| asked.what.is_like(What::Start));
        if waits && !is_held && !like && self.held_until.is_none() {
            return Err("lets the event wait".to_owned());
        }
        Ok(())
    }
}
