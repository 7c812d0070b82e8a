//! The driver beside the engine, and what holds for every cell: one connection a link, what was handed
//! over on it and not acknowledged (P1), when the engine may sleep, and how much it may say at once.
//!
//! In: what a cell tells. Out: what the engine answers, to the cell's [`Judge`].

use proto_core::engine::{Engine, Input, LinkId, OUTPUT_BUFFER, Output, PortId};
use proto_core::link::LinkState;
use proto_core::time::{Duration, Instant};

use crate::rig::MS;
use crate::scribe::Scribe;

/// Room for one field port beside a listening port, one recipe link, a few fields and so many exchanges.
pub type Room<const EXCHANGES: usize> = Engine<2, 1, 4, 0, EXCHANGES>;
/// The same without exchanges.
pub type Small = Room<0>;
/// A promise that was broken, in words.
pub type Broken = String;

/// A driver that stays away for longer was asleep.
const ASLEEP: Duration = Duration::from_millis(500);
/// The engine asks to be called at least so often.
const HEARTBEAT: Duration = Duration::from_millis(250);
/// What waited while the gateway was asleep may be read for so long after it.
pub const AFTER_SLEEP: Duration = Duration::from_millis(50);
/// A device repeats a frame so often that it is never overdue.
pub const STEADY: Duration = Duration::from_millis(90);
/// More than a cell of one port and three links can have to say after one input: each link closed,
/// opened and spoken to once.
const MOST_OUTPUTS: usize = 9;
/// A connection that takes longer is given up.
const CONNECT_TIMEOUT: Duration = Duration::from_secs(2);

pub const PORT: PortId = PortId(0);

/// A connection, as its driver knows it.
#[derive(Debug, Clone)]
pub struct Conn {
    pub link: LinkId,
    pub is: Is,
    /// When that began.
    pub from: Instant,
    /// The transport has not taken what was handed over last.
    pub unsent: bool,
    /// Bytes handed over since it came up.
    total: u32,
    /// What is not acknowledged.
    pub under_way: Vec<UnderWay>,
    /// The engine has to close it before it sleeps.
    must_close: bool,
    /// Whether the peer's TCP acknowledges anything.
    acknowledges: bool,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Is {
    Closed,
    Opening,
    Open,
    /// Never opened: the other connection does its work (D26).
    GivenUp,
}

#[derive(Debug, Clone)]
pub struct UnderWay {
    end: u32,
    /// Not to be delivered after this.
    until: Instant,
}

#[derive(Debug, Clone)]
pub struct Conns(pub Vec<Conn>);

/// What a cell knows of the promises.
pub trait Judge<const EXCHANGES: usize = 0> {
    /// An input is about to be told, other than that a connection is lost.
    fn told(&mut self, now: Instant, input: &Input<'_>, conns: &mut Conns);
    /// The driver reports that a connection is gone or could not be opened; [`Self::lost`] came before.
    fn down(&mut self, now: Instant, link: LinkId, was: Is, conns: &mut Conns);
    /// Deadlines pass: what that makes due, or old.
    fn deadlines(&mut self, now: Instant, conns: &mut Conns) -> Result<(), Broken>;
    /// A connection is gone, whoever closed it.
    fn lost(&mut self, now: Instant, link: LinkId);
    /// The gateway was asleep: before its deadlines pass, and before the input counts.
    fn slept(&mut self, now: Instant);
    /// Bytes were handed over; returns until when they may be delivered.
    fn sent(
        &mut self,
        now: Instant,
        link: LinkId,
        bytes: &[u8],
        conns: &mut Conns,
    ) -> Result<Instant, Broken>;
    /// Something goes to the field.
    fn shown(&mut self, now: Instant, bytes: &[u8]) -> Result<(), Broken>;
    /// The engine has nothing more to do. `is_late`: a deadline has come and its tick was not told, so
    /// nothing may be sent yet.
    fn rested(
        &mut self,
        now: Instant,
        until: Instant,
        engine: &Room<EXCHANGES>,
        conns: &Conns,
        is_late: bool,
    ) -> Result<(), Broken>;
}

#[derive(Debug, Clone)]
pub struct Gateway<const EXCHANGES: usize = 0> {
    pub engine: Box<Room<EXCHANGES>>,
    pub conns: Conns,
    pub now: Instant,
    /// When the engine was called last, and when it wants to be called at the latest.
    pub called: Instant,
    pub until: Instant,
}

impl Conn {
    pub fn new(link: LinkId, acknowledges: bool) -> Self {
        Self {
            link,
            is: Is::Closed,
            from: Instant::ZERO,
            unsent: false,
            total: 0,
            under_way: Vec::new(),
            must_close: false,
            acknowledges,
        }
    }

    /// Whether something can be handed over.
    pub fn is_free(&self) -> bool {
        self.is == Is::Open && !self.unsent
    }

    fn change(&mut self, now: Instant, is: Is) {
        self.is = is;
        self.from = if is == Is::Closed { Instant::ZERO } else { now };
        self.unsent = false;
        self.total = 0;
        self.under_way.clear();
    }

    fn handed_over(&mut self, len: usize, until: Instant) {
        self.unsent = true;
        if self.acknowledges {
            self.total += len as u32;
            self.under_way.push(UnderWay { end: self.total, until });
        }
    }

    fn acked(&mut self, left: u32) {
        let acked = self.total - left;
        self.under_way.retain(|sent| sent.end > acked);
    }

    /// What is left when the first of what is under way is acknowledged, and no more.
    pub fn all_but_first(&self) -> u32 {
        self.under_way.first().map_or(0, |first| self.total - first.end)
    }
}

impl Conns {
    pub fn new(links: &[(LinkId, bool)]) -> Self {
        Self(links.iter().map(|&(link, acknowledges)| Conn::new(link, acknowledges)).collect())
    }

    pub fn of(&self, link: LinkId) -> &Conn {
        self.0.iter().find(|conn| conn.link == link).expect("a link of this cell")
    }

    pub fn get(&mut self, link: LinkId) -> &mut Conn {
        self.0.iter_mut().find(|conn| conn.link == link).expect("a link of this cell")
    }

    pub fn is_open(&self, link: LinkId) -> bool {
        self.of(link).is == Is::Open
    }

    /// The engine has to close this connection before it sleeps, and to send nothing more on it.
    pub fn must_close(&mut self, now: Instant, link: LinkId) {
        let conn = self.get(link);
        if matches!(conn.is, Is::Opening | Is::Open) {
            conn.change(now, Is::Closed);
            conn.must_close = true;
        }
    }

    /// Connections with something on them that may not be delivered any more.
    pub fn overdue(&self, now: Instant) -> Vec<LinkId> {
        let is_overdue = |conn: &&Conn| conn.under_way.iter().any(|sent| sent.until <= now);
        self.0.iter().filter(is_overdue).map(|conn| conn.link).collect()
    }

    /// Connections that did not come about in time.
    pub fn not_opened(&self, now: Instant) -> Vec<LinkId> {
        let waits = |conn: &&Conn| conn.is == Is::Opening && conn.link.port().is_none();
        let late = |conn: &&Conn| now >= conn.from + CONNECT_TIMEOUT;
        self.0.iter().filter(waits).filter(late).map(|conn| conn.link).collect()
    }
}

impl<const EXCHANGES: usize> Gateway<EXCHANGES> {
    pub fn new(engine: Room<EXCHANGES>, conns: Conns, now: Instant) -> Self {
        Self { engine: Box::new(engine), conns, now, called: Instant::ZERO, until: Instant::ZERO }
    }

    /// The engine's deadline has come, or passed, and was not told.
    pub fn is_late(&self) -> bool {
        self.now >= self.until
    }

    /// One input, and all that follows from it at this instant.
    pub fn tell(&mut self, input: Input<'_>, judge: &mut impl Judge<EXCHANGES>) -> Result<(), Broken> {
        let now = self.now;
        let is_tick = matches!(input, Input::Tick);
        let is_late = self.is_late() && !is_tick;
        let sleeps = self.engine.sleeps();
        let slept = self.called != Instant::ZERO && now.saturating_since(self.called) > ASLEEP;
        if slept {
            judge.slept(now);
            for nth in 0..self.conns.0.len() {
                let link = self.conns.0[nth].link;
                self.conns.must_close(now, link);
                judge.lost(now, link);
            }
        }
        if is_tick || slept {
            judge.deadlines(now, &mut self.conns)?;
        }
        match input {
            Input::LinkUp { link } => self.conns.get(link).change(now, Is::Open),
            Input::LinkSent { link } => self.conns.get(link).unsent = false,
            Input::LinkAcked { link, left } => self.conns.get(link).acked(left),
            _ => {}
        }
        if let Input::LinkDown { link } = input {
            let was = self.conns.of(link).is;
            self.conns.get(link).change(now, Is::Closed);
            judge.lost(now, link);
            judge.down(now, link, was, &mut self.conns);
        } else {
            judge.told(now, &input, &mut self.conns);
        }
        self.engine.handle(now, input);
        self.called = now;
        let until = self.drain(judge, is_late)?;
        if until > now + HEARTBEAT {
            return Err(format!("sleeps for {}", until.saturating_since(now)));
        }
        if !is_late && until <= now {
            return Err(format!("sleeps until {} ago", now.saturating_since(until)));
        }
        if self.engine.sleeps().wrapping_sub(sleeps) != u32::from(slept) {
            return Err(format!("counts that it slept {} times", self.engine.sleeps()));
        }
        self.until = until;
        judge.rested(now, until, &self.engine, &self.conns, is_late)?;
        self.links_are_tended(is_tick)
    }

    /// What the engine answers, until it sleeps.
    fn drain(&mut self, judge: &mut impl Judge<EXCHANGES>, is_late: bool) -> Result<Instant, Broken> {
        let now = self.now;
        let mut buf = [0xA5; OUTPUT_BUFFER];
        for _ in 0..=MOST_OUTPUTS {
            match self.engine.poll_output(now, &mut buf) {
                Output::Sleep { until } => {
                    if self.engine.poll_output(now, &mut buf) != (Output::Sleep { until }) {
                        return Err("does not stay at rest".to_owned());
                    }
                    return Ok(until);
                }
                Output::LinkOpen { link, .. } => {
                    let conn = self.conns.get(link);
                    if conn.is != Is::Closed || conn.must_close {
                        return Err(format!("opens {link:?}, which is {:?}", conn.is));
                    }
                    conn.change(now, Is::Opening);
                }
                Output::LinkClose { link } => {
                    let conn = self.conns.get(link);
                    if !std::mem::take(&mut conn.must_close) {
                        return Err(format!("closes {link:?} for no reason, which is {:?}", conn.is));
                    }
                }
                Output::LinkSend { link, bytes } => {
                    let conn = self.conns.of(link);
                    if conn.is != Is::Open {
                        return Err(format!("sends on {link:?}, which is {:?}", conn.is));
                    }
                    if conn.unsent {
                        return Err(format!("sends on {link:?}, which has not taken what was sent before"));
                    }
                    if is_late {
                        return Err(format!("sends on {link:?} between a deadline and its tick"));
                    }
                    let until = judge.sent(now, link, bytes, &mut self.conns)?;
                    self.conns.get(link).handed_over(bytes.len(), until);
                }
                Output::PortSend { bytes, .. } => {
                    if is_late {
                        return Err("sends to the field between a deadline and its tick".to_owned());
                    }
                    judge.shown(now, bytes)?;
                    self.engine.handle(now, Input::PortSent { port: PORT });
                }
                Output::PortSendCan { .. } => return Err("sends what no recipe has".to_owned()),
                other => return Err(format!("says {other:?}")),
            }
        }
        Err(format!("has more than {MOST_OUTPUTS} things to say"))
    }

    /// Nothing stays open that may not, and nothing stays closed for ever.
    fn links_are_tended(&self, is_tick: bool) -> Result<(), Broken> {
        for conn in &self.conns.0 {
            let link = conn.link;
            if conn.must_close {
                return Err(format!("leaves {link:?} open, which it has to close"));
            }
            let info = self.engine.links().find(|info| info.id == link).ok_or("a link is missing")?;
            let agrees = match info.state {
                LinkState::Down { retry_at } => conn.is == Is::Closed && !(is_tick && retry_at < self.now),
                LinkState::Opening { .. } => conn.is == Is::Opening,
                LinkState::Up { .. } => conn.is == Is::Open,
                LinkState::Shared => conn.is == Is::GivenUp,
            };
            if !agrees {
                return Err(format!("says that {link:?} is {:?}, and it is {:?}", info.state, conn.is));
            }
        }
        Ok(())
    }
}

impl<const EXCHANGES: usize> Gateway<EXCHANGES> {
    /// The instant for which the engine asked.
    pub fn wait_until_due(&mut self) {
        self.now = self.now.max(self.until);
    }

    /// The driver is as late as it may be.
    pub fn step(&mut self) {
        self.now = self.now.max(self.called + MS(450));
    }

    /// The gateway is asleep.
    pub fn sleep(&mut self) {
        self.now = self.now.max(self.called + MS(600));
    }

    /// What is to be told apart of it.
    pub fn describe(&self, scribe: &mut Scribe) {
        scribe.describe(&self.engine);
        scribe.bytes(self.engine.image().bytes());
        scribe.describe(&self.conns);
    }
}
