//! A CAN port with one bit and one command field; the bit goes by Modbus, `run` and `stop` by port 2000.

use proto_core::config::{CanFramePart, CommandWhen, GatewayConfig, InputBinding, Parts};
use proto_core::engine::{BusState, Input, LinkId};
use proto_core::recipe::model::Mode;
use proto_core::time::{Duration, Instant};
use proto_core::wire::can::{CanFrame, CanId};
use proto_core::wire::scalar::ScalarType;

use crate::command_judge::{BIT, FIRST_COIL, Facts, GARBAGE, Header, OTHER_WORDS, SAFE};
use crate::driver::{Broken, Conns, Gateway, Is, PORT, STEADY, Small};
use crate::orders::{NONE, Order, RUN, STOP};
use crate::rig::{Cell, user_in, var};
use crate::scribe::{LookBack, Scribe};
use crate::search::World;
use crate::values::TIMEOUT;

/// Value and command of the frames that the device sends.
const FRAMES: [(u8, u8); 4] = [(0, NONE), (1, NONE), (1, RUN), (0, STOP)];
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
    /// Words come that the gateway does not know.
    OtherWords(LinkId),
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
        let judge = Facts::new();
        Self { gateway: Gateway::new(engine, conns, now), judge }
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
                add(OtherWords(link), judge.orders.is_without_words(link));
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
            OtherWords(link) => self.answer(link, OTHER_WORDS),
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
