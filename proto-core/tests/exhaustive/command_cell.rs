//! A CAN port with one bit and one command field; the bit goes by Modbus, `run` and `stop` by port 2000.

use proto_core::config::{CanFramePart, CommandWhen, GatewayConfig, InputBinding, Parts};
use proto_core::engine::{BusState, Input, LinkId, PortState};
use proto_core::recipe::CanFrame;
use proto_core::recipe::model::{CanId, Mode};
use proto_core::time::{Duration, Instant};
use proto_core::wire::scalar::{Scalar, ScalarType};

use crate::driver::{Broken, Conns, Gateway, Is, Judge, PORT, Small};
use crate::orders::{NONE, Order, Orders, RUN, STOP};
use crate::rig::{Cell, user_in, var};
use crate::scribe::{LookBack, Scribe};
use crate::search::World;
use crate::values::{Bits, TIMEOUT};

/// Value and command of the frames that the device sends.
const FRAMES: [(u8, u8); 4] = [(0, NONE), (1, NONE), (1, RUN), (0, STOP)];
const SAFE: u8 = 4;
const BIT: &str = "BitInputReg[3]";
const FIRST_COIL: u16 = 32;
const ANSWER_TIMEOUT: Duration = Duration::from_millis(500);
const REFUSED_PAUSE: Duration = Duration::from_millis(500);
const TIMEOUTS_IN_A_ROW: u8 = 3;
/// The device repeats a frame so often that it is never overdue.
const STEADY: Duration = Duration::from_millis(90);
/// What waited while the gateway was asleep may be read for so long after it.
const DEAF: Duration = Duration::from_millis(50);

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Event {
    /// The device sends one of [`FRAMES`].
    Frame(u8),
    /// The device repeats its newest frame for a while, often enough, and the driver keeps its time.
    Steady,
    /// The engine is called when it wants to be.
    Tick,
    /// That instant comes, and the driver has something else to tell first.
    Late,
    /// The driver is late, but not so late that it was asleep.
    Step,
    /// The gateway was asleep; the driver finds a frame first, or an answer.
    SleepPort,
    SleepLink,
    Up(LinkId),
    Down(LinkId),
    Taken(LinkId),
    /// All of what is under way is acknowledged, or only the first of it.
    Acked(LinkId),
    AckedFirst(LinkId),
    /// The Modbus request is answered.
    Answered,
    /// It is refused.
    Refused,
    /// The answer to the request before comes.
    LateAnswer,
    /// What comes is not Modbus.
    Garbage,
    /// A command is replied to: done, or failed.
    Replied(LinkId, Order, bool),
    /// A reply comes that answers nothing.
    Stray,
    Gone,
    Back,
    BusOff,
    BusOn,
}
use Event::*;

const LINKS: [LinkId; 3] = [LinkId::COMMAND, LinkId::URGENT, LinkId::MODBUS];

#[derive(Debug, Clone)]
pub struct CommandCell {
    gateway: Gateway,
    judge: Facts,
}

/// What is so.
#[derive(Debug, Clone)]
struct Facts {
    is_up: bool,
    /// The device's newest frame.
    repeats: Option<u8>,
    is_bus_off: bool,
    deaf_until: Option<Instant>,
    bits: Bits,
    orders: Orders,
    /// The write that is unanswered: whether it is of the safe value, and since when.
    asked: Option<Asked>,
    /// The header of the newest request, and of one that was given up on this connection.
    newest: Header,
    given_up: Option<Header>,
    timeouts: u8,
    /// A safe value was refused: it is written again then.
    again_at: Option<Instant>,
    /// Frames accepted and discarded after a sleep; not part of the state.
    counted: [u32; 2],
}

#[derive(Debug, Clone)]
struct Asked {
    is_safe: bool,
    from: Instant,
}

/// A transaction's number; not part of the state.
#[derive(Debug, Clone, Copy, Default)]
struct Header {
    transaction: u16,
}

fn config() -> GatewayConfig {
    let mut cell = Cell::new();
    let table = cell.commands(&[(i64::from(RUN), "run(a.jspf)"), (i64::from(STOP), "stop")]);
    let bit = InputBinding::Variable { var: var(BIT), scale: 1.0, offset: 0.0 };
    let commands = InputBinding::Commands { table, when: CommandWhen::Change };
    let fields = cell.fields([user_in(ScalarType::Byte, bit), user_in(ScalarType::Byte, commands)]);
    let frame = CanFramePart { id: CanId::Standard(1), fields };
    let parts = Parts::Can { input: [frame].into_iter().collect(), output: Default::default() };
    let recipe = cell.recipe(Mode::User, parts);
    cell.can_port(recipe);
    cell.last_port().timeout = TIMEOUT;
    cell.safe(BIT, f64::from(SAFE));
    cell.0
}

impl CommandCell {
    pub fn new(now: Instant) -> Self {
        let engine = Small::new(&config()).unwrap_or_else(|error| panic!("{error}: {error:?}"));
        let conns = Conns::new(&LINKS.map(|link| (link, true)));
        let judge = Facts {
            is_up: false,
            repeats: None,
            is_bus_off: false,
            deaf_until: None,
            bits: Bits::new(SAFE),
            orders: Orders::new(),
            asked: None,
            newest: Header::default(),
            given_up: None,
            timeouts: 0,
            again_at: None,
            counted: [0; 2],
        };
        Self { gateway: Gateway::new(engine, conns, now), judge }
    }

    /// The same after these events.
    #[track_caller]
    pub fn after(mut self, events: &[Event]) -> Self {
        for (nth, &event) in events.iter().enumerate() {
            assert!(self.events().contains(&event), "{event:?}, number {nth}, cannot happen");
            self.happen(event).unwrap_or_else(|broken| panic!("{event:?}, number {nth}: {broken}"));
        }
        self
    }

    fn steady(&mut self) -> Result<(), Broken> {
        let nth = self.judge.repeats.expect("the device has sent something");
        for _ in 0..5 {
            let next = self.gateway.now + STEADY;
            while self.gateway.until < next {
                self.gateway.wait_until_due();
                self.tell(Input::Tick)?;
            }
            self.gateway.now = next;
            self.frame(nth)?;
        }
        self.tell(Input::Tick)
    }

    fn tell(&mut self, input: Input<'_>) -> Result<(), Broken> {
        self.gateway.tell(input, &mut self.judge)
    }

    fn frame(&mut self, nth: u8) -> Result<(), Broken> {
        self.judge.repeats = Some(nth);
        let (value, command) = FRAMES[usize::from(nth)];
        let frame = CanFrame::new(CanId::Standard(1), &[value, command]).expect("two bytes");
        self.tell(Input::PortCan { port: PORT, frame })
    }

    /// The peer answered, so it has acknowledged: the driver tells that first.
    fn answer(&mut self, link: LinkId, bytes: &[u8]) -> Result<(), Broken> {
        if !self.gateway.conns.of(link).under_way.is_empty() {
            self.tell(Input::LinkAcked { link, left: 0 })?;
        }
        self.tell(Input::LinkBytes { link, bytes })
    }
}

fn written(header: Header) -> [u8; 12] {
    let [t1, t0] = header.transaction.to_be_bytes();
    [t1, t0, 0, 0, 0, 6, 1, 15, 0, FIRST_COIL as u8, 0, 8]
}

/// Another protocol's id.
const GARBAGE: [u8; 9] = [0, 1, 9, 9, 0, 3, 1, 15, 4];

/// Slave device failure.
fn exception(header: Header) -> [u8; 9] {
    let [t1, t0] = header.transaction.to_be_bytes();
    [t1, t0, 0, 0, 0, 3, 1, 15 | 0x80, 4]
}

impl World for CommandCell {
    type Event = Event;

    fn events(&self) -> Vec<Event> {
        let (gateway, judge) = (&self.gateway, &self.judge);
        let mut events = Vec::with_capacity(32);
        let mut add = |event, is_possible: bool| {
            if is_possible {
                events.push(event);
            }
        };
        let sends = judge.is_up && !judge.is_bus_off;
        for nth in 0..FRAMES.len() {
            add(Frame(nth as u8), sends);
        }
        add(Steady, sends && judge.repeats.is_some());
        add(Tick, true);
        add(Late, !gateway.is_late());
        add(Step, true);
        add(SleepPort, sends);
        let is_open = |link| gateway.conns.is_open(link);
        let is_asked = judge.asked.is_some() && !gateway.conns.of(LinkId::MODBUS).unsent;
        add(SleepLink, is_asked || !sends);
        for conn in &gateway.conns.0 {
            let link = conn.link;
            add(Up(link), conn.is == Is::Opening);
            add(Down(link), matches!(conn.is, Is::Opening | Is::Open));
            add(Taken(link), conn.unsent);
            add(Acked(link), !conn.unsent && !conn.under_way.is_empty());
            add(AckedFirst(link), !conn.unsent && conn.under_way.len() > 1);
            if !conn.unsent {
                for order in judge.orders.unanswered(link) {
                    add(Replied(link, order, true), true);
                    add(Replied(link, order, false), true);
                }
            }
        }
        add(Answered, is_asked);
        add(Refused, is_asked);
        add(LateAnswer, judge.given_up.is_some() && is_open(LinkId::MODBUS));
        add(Garbage, is_open(LinkId::MODBUS));
        let mut unanswered = judge.orders.unanswered(LinkId::COMMAND);
        add(Stray, is_open(LinkId::COMMAND) && unanswered.all(|order| order != Order::Run));
        add(Gone, judge.is_up);
        add(Back, !judge.is_up);
        add(BusOff, sends);
        add(BusOn, judge.is_up && judge.is_bus_off);
        events
    }

    fn happen(&mut self, event: Event) -> Result<(), Broken> {
        let port = PORT;
        match event {
            Frame(nth) => self.frame(nth),
            Steady => self.steady(),
            Tick => {
                self.gateway.wait_until_due();
                self.tell(Input::Tick)
            }
            Late => {
                self.gateway.wait_until_due();
                Ok(())
            }
            Step => {
                self.gateway.step();
                self.tell(Input::Tick)
            }
            SleepPort => {
                self.gateway.sleep();
                self.frame(2)?;
                self.tell(Input::Tick)
            }
            SleepLink => {
                self.gateway.sleep();
                if self.judge.asked.is_some() {
                    let bytes = written(self.judge.newest);
                    self.tell(Input::LinkBytes { link: LinkId::MODBUS, bytes: &bytes })?;
                }
                self.tell(Input::Tick)
            }
            Up(link) => self.tell(Input::LinkUp { link }),
            Down(link) => self.tell(Input::LinkDown { link }),
            Taken(link) => self.tell(Input::LinkSent { link }),
            Acked(link) => self.tell(Input::LinkAcked { link, left: 0 }),
            AckedFirst(link) => {
                let left = self.gateway.conns.of(link).all_but_first();
                self.tell(Input::LinkAcked { link, left })
            }
            Answered => {
                let bytes = written(self.judge.newest);
                self.answer(LinkId::MODBUS, &bytes)
            }
            Refused => {
                let bytes = exception(self.judge.newest);
                self.answer(LinkId::MODBUS, &bytes)
            }
            LateAnswer => {
                let bytes = written(self.judge.given_up.take().expect("it was given up"));
                self.tell(Input::LinkBytes { link: LinkId::MODBUS, bytes: &bytes })
            }
            Garbage => self.tell(Input::LinkBytes { link: LinkId::MODBUS, bytes: &GARBAGE }),
            Stray => self.tell(Input::LinkBytes { link: LinkId::COMMAND, bytes: b"run start" }),
            Replied(link, order, is_done) => {
                let text: &[u8] = match (order, is_done) {
                    (Order::Run, true) => b"run start",
                    (Order::Run, false) => b"run fail",
                    (Order::Stop, true) => b"stop success",
                    (Order::Stop, false) => b"stop fail",
                };
                self.answer(link, text)
            }
            Gone => self.tell(Input::PortDown { port }),
            Back => self.tell(Input::PortUp { port }),
            BusOff => self.tell(Input::PortBus { port, state: BusState::BusOff }),
            BusOn => self.tell(Input::PortBus { port, state: BusState::Active }),
        }
    }

    fn fingerprint(&self, unique: u64) -> u64 {
        let look_back = LookBack {
            bits: TIMEOUT,
            stamps: TIMEOUT,
            unconfirmed: Duration::ZERO,
            confirmed: Duration::ZERO,
        };
        let mut scribe = Scribe::new(self.gateway.now, self.judge.orders.total, look_back, unique);
        self.gateway.describe(&mut scribe);
        scribe.describe(&self.judge);
        scribe.finish()
    }
}

impl Facts {
    /// The connection is closed: nothing on it is answered.
    fn modbus_lost(&mut self) {
        self.bits.lost();
        if self.asked.take().is_some_and(|asked| asked.is_safe) || self.again_at.is_some() {
            self.bits.again();
        }
        self.again_at = None;
        self.given_up = None;
        self.timeouts = 0;
    }

    fn modbus_answered(&mut self, now: Instant, bytes: &[u8]) {
        if bytes[..2] != self.newest.transaction.to_be_bytes() {
            return;
        }
        let Some(asked) = self.asked.take() else { return };
        self.timeouts = 0;
        match (asked.is_safe, bytes[7] == 15) {
            (true, true) => self.bits.confirm(),
            (true, false) => {
                self.again_at = self.again_at.or(Some(now + REFUSED_PAUSE));
            }
            (false, _) => {}
        }
    }

    fn frame(&mut self, now: Instant, frame: &CanFrame, conns: &Conns) {
        if self.deaf_until.is_some() {
            self.counted[1] += 1;
            return;
        }
        let [value, command] = frame.data() else { return };
        self.counted[0] += 1;
        self.bits.received(*value, conns.is_open(LinkId::MODBUS), now);
        self.orders.received(*command, conns, now);
    }
}

impl Judge for Facts {
    fn told(&mut self, now: Instant, input: &Input<'_>, conns: &mut Conns) {
        match *input {
            Input::Tick => self.deaf_until = self.deaf_until.filter(|&until| now < until),
            Input::PortCan { frame, .. } => self.frame(now, &frame, conns),
            Input::PortUp { .. } => self.is_up = true,
            Input::PortDown { .. } => {
                self.is_up = false;
                self.orders.forget(now);
            }
            Input::PortBus { state, .. } => {
                self.is_bus_off = state == BusState::BusOff;
                if self.is_bus_off {
                    self.orders.forget(now);
                }
            }
            Input::LinkUp { .. } => self.bits.controller_was_away(now),
            Input::LinkBytes { link, bytes } if conns.is_open(link) => match link {
                LinkId::MODBUS if bytes == GARBAGE => {
                    conns.must_close(now, link);
                    self.modbus_lost();
                }
                LinkId::MODBUS => self.modbus_answered(now, bytes),
                _ => {
                    let order = if bytes.starts_with(b"run") { Order::Run } else { Order::Stop };
                    self.orders.replied(link, order, !bytes.ends_with(b"fail"));
                }
            },
            _ => {}
        }
    }

    fn down(&mut self, now: Instant, link: LinkId, was: Is, conns: &mut Conns) {
        if link != LinkId::MODBUS {
            self.orders.down(link, was, conns, now);
        }
    }

    fn deadlines(&mut self, now: Instant, conns: &mut Conns) -> Result<(), Broken> {
        if self.bits.deadlines(now) {
            self.orders.forget(now);
        }
        self.orders.deadlines(now, conns);
        if self.again_at.take_if(|at| now >= *at).is_some() {
            self.bits.again();
        }
        if let Some(asked) = self.asked.take_if(|asked| now >= asked.from + ANSWER_TIMEOUT) {
            if asked.is_safe {
                self.bits.again();
            }
            self.given_up = Some(self.newest);
            self.timeouts += 1;
            // It has not arrived, or nobody is there.
            let conn = conns.of(LinkId::MODBUS);
            if conn.unsent || !conn.under_way.is_empty() || self.timeouts >= TIMEOUTS_IN_A_ROW {
                conns.must_close(now, LinkId::MODBUS);
                self.modbus_lost();
            }
        }
        if conns.not_opened(now).contains(&LinkId::MODBUS) {
            conns.must_close(now, LinkId::MODBUS);
        }
        match conns.overdue(now).first() {
            Some(link) => Err(format!("{link:?} would deliver late, and no rule closes it")),
            None => Ok(()),
        }
    }

    fn lost(&mut self, now: Instant, link: LinkId) {
        match link {
            LinkId::MODBUS => self.modbus_lost(),
            _ => self.orders.lost(link, now),
        }
    }

    fn slept(&mut self, now: Instant) {
        self.orders.slept();
        self.deaf_until = Some(now + DEAF);
    }

    fn sent(
        &mut self,
        now: Instant,
        link: LinkId,
        bytes: &[u8],
        conns: &mut Conns,
    ) -> Result<Instant, Broken> {
        if link != LinkId::MODBUS {
            return self.orders.sent(link, bytes, conns, now);
        }
        let [t1, t0, 0, 0, 0, 8, 1, 15, 0, coil, 0, 8, 1, value] = *bytes else {
            return Err(format!("asks {bytes:?}"));
        };
        if u16::from(coil) != FIRST_COIL {
            return Err(format!("writes coil {coil}"));
        }
        if self.asked.is_some() {
            return Err("asks while a request is unanswered".to_owned());
        }
        self.bits.take(value, now)?;
        self.asked = Some(Asked { is_safe: self.bits.is_safe(), from: now });
        self.newest = Header { transaction: u16::from_be_bytes([t1, t0]) };
        Ok(now + ANSWER_TIMEOUT)
    }

    fn shown(&mut self, _: Instant, bytes: &[u8]) -> Result<(), Broken> {
        Err(format!("sends {bytes:?} to the field"))
    }

    fn rested(&mut self, now: Instant, engine: &Small, conns: &Conns, is_late: bool) -> Result<(), Broken> {
        if !is_late {
            if self.bits.is_waiting() && self.asked.is_none() && conns.of(LinkId::MODBUS).is_free() {
                return Err("lets a value wait though the link is free".to_owned());
            }
            self.orders.rested(conns)?;
        }
        let reply = engine.reply_code(PORT);
        if reply != Some(self.orders.reply) {
            return Err(format!("tells the device {reply:?} instead of {:?}", self.orders.reply));
        }
        let value = engine.image().is_known(var(BIT)).then(|| engine.image().value(var(BIT)));
        if value != self.bits.newest.map(Scalar::Byte) {
            return Err(format!("shows {value:?} instead of {:?}", self.bits.newest));
        }
        let state = match () {
            () if !self.is_up => PortState::Gone,
            () if self.is_bus_off => PortState::BusOff,
            () if self.bits.is_silent() => PortState::Silent,
            () => PortState::Working,
        };
        if engine.port_state(PORT) != Some(state) {
            return Err(format!("says that its port is {:?} instead of {state:?}", engine.port_state(PORT)));
        }
        let counters = engine.port_counters(PORT).ok_or("the port is missing")?;
        let counted = [counters.frames_in, counters.asleep, counters.commands, counters.commands_dropped];
        let [accepted, asleep] = self.counted;
        let expected = [accepted, asleep, self.orders.total, self.orders.dropped];
        if counted != expected {
            return Err(format!("counts {counted:?} instead of {expected:?}"));
        }
        let _ = now;
        Ok(())
    }
}
