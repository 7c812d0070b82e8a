//! A Modbus RTU line with one slave, which may be slow: two registers that are read with a period, a write
//! that a bit of the controller starts, and one that stops the slave. The controller's frames come over TCP,
//! and it is told the registers.

use proto_core::config::*;
use proto_core::device::{ByteOrder, Encoding, Overflow};
use proto_core::engine::{Engine, Input, LinkId, PortId};
use proto_core::modbus::rtu::Operation;
use proto_core::recipe::model::Mode;
use proto_core::time::{Duration, Instant};
use proto_core::wire::scalar::ScalarType;

use crate::driver::{Broken, Conns, Gateway, Is, PORT};
use crate::exchange_judge::{
    Answer, BITS, EXCHANGES, FLOATING, Facts, LATE, PERIOD, READ, STALE_AFTER, START, STOP, TARGET, TIMEOUT,
    TRIGGER, What,
};
use crate::rig::{Cell, var, with_crc};
use crate::scribe::{LookBack, Scribe};
use crate::search::World;

/// The line's adapter, which the file does not describe.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Adapter {
    /// It gives back nothing of what is sent.
    Silent,
    /// It gives back each request.
    Echoes,
}

/// The controller's frames: the bits that start and stop, and the target.
const FRAMES: [(u8, u16); 4] = [(0, 1), (START, 2), (START, 3), (STOP, 1)];
/// Time passes in these steps; all other times are multiples of it.
const STEP: Duration = Duration::from_millis(50);
pub const LINK: LinkId = LinkId::of_port(PortId(1));
pub const SLAVE: u8 = 3;

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Event {
    /// One of [`FRAMES`] comes.
    Frame(u8),
    /// The engine is called when it wants to be.
    Tick,
    /// Time passes, and the driver keeps its time.
    Step,
    /// The instant for which the engine asked comes, and the driver has something else to tell first.
    Late,
    /// The gateway was asleep.
    Sleep,
    Up,
    Down,
    /// The slave answers its newest request, or the oldest, if it has not answered that.
    Newest(Answer),
    Oldest(Answer),
    /// The line's device is gone, or back.
    Gone,
    Back,
}
use Event::*;

#[derive(Debug, Clone)]
pub struct ExchangeCell {
    gateway: Gateway<EXCHANGES>,
    judge: Facts,
}

fn config(adapter: Adapter) -> GatewayConfig {
    let mut cell = Cell::new();
    let word = Encoding { order: ByteOrder::Big, ..Encoding::scalar(ScalarType::Word) };
    let mut read = |what: What| {
        let to = InputBinding::Variable { var: var(READ[what as usize]), scale: 1.0, offset: 0.0 };
        let read = cell.fields([FieldSpec::DeviceInput { encoding: word, overflow: Overflow::Usual, to }]);
        let operation = Operation::ReadHoldingRegisters { address: what.address(), count: 1 };
        let talk = Transaction::Rtu { operation, written: Span::default(), read };
        Exchange::new(SLAVE, talk, Triggers::every(PERIOD))
    };
    let reads = [read(What::First), read(What::Second)];
    let mut write = |from, bit: u8| {
        let written =
            cell.fields([FieldSpec::DeviceOutput { encoding: word, overflow: Overflow::Usual, from }]);
        let address = What::Start.address();
        // The answer to the shorter request equals it.
        let operation = match adapter {
            Adapter::Silent => Operation::WriteRegisters { address, count: 1 },
            Adapter::Echoes => Operation::WriteRegister { address },
        };
        let when = Triggers { rising: Some((var(BITS), bit)), ..Triggers::NEVER };
        Exchange::new(SLAVE, Transaction::Rtu { operation, written, read: Span::default() }, when)
    };
    let mut start = write(OutputBinding::Variable { var: var(TARGET), scale: 1.0, offset: 0.0 }, 0);
    start.trigger = Some(TRIGGER);
    let mut stop = write(OutputBinding::Constant(FLOATING.into()), 1);
    stop.stop = true;
    let recipe = cell.recipe(Mode::User, Parts::Stream { input: None, output: None });
    cell.last_recipe().exchanges = Span { start: 0, len: EXCHANGES as u16 };
    for exchange in reads.into_iter().chain([start, stop]) {
        // Registers age, and nothing here depends on it.
        let overdue = Some(Port::NEVER);
        let exchange = Exchange { timeout: TIMEOUT, late: Some(LATE), overdue, ..exchange };
        cell.0.exchanges.push(exchange).expect("there is room");
    }
    cell.rs485(recipe);
    (cell.last_port().timeout, cell.last_port().stale_after) = (TIMEOUT, STALE_AFTER);
    let up = cell.stream(&[READ[0], READ[1]], &[BITS, TARGET]);
    let listen = heapless::String::try_from("0.0.0.0:50000").expect("short");
    cell.port(Bus::TcpListen { listen }, up);
    cell.0
}

impl ExchangeCell {
    pub fn new(adapter: Adapter, now: Instant) -> Self {
        let engine = Engine::new(&config(adapter)).unwrap_or_else(|error| panic!("{error}: {error:?}"));
        let conns = Conns::new(&[(LINK, true)]);
        Self { gateway: Gateway::new(engine, conns, now), judge: Facts::new(adapter) }
    }

    /// One input; what the engine sends is acknowledged at once, and comes back if the adapter does that.
    fn tell(&mut self, input: Input<'_>) -> Result<(), Broken> {
        self.gateway.tell(input, &mut self.judge)?;
        if self.gateway.conns.of(LINK).unsent {
            self.tell(Input::LinkSent { link: LINK })?;
            self.tell(Input::LinkAcked { link: LINK, left: 0 })?;
        }
        match self.judge.echo.take() {
            Some(bytes) => self.tell(Input::PortBytes { port: PORT, bytes: &bytes }),
            None => Ok(()),
        }
    }

    fn tick(&mut self) -> Result<(), Broken> {
        self.gateway.wait_until_due();
        self.tell(Input::Tick)
    }

    fn frame(&mut self, nth: u8) -> Result<(), Broken> {
        let (bits, target) = FRAMES[usize::from(nth)];
        let [low, high] = target.to_le_bytes();
        self.tell(Input::LinkBytes { link: LINK, bytes: &[255, 255, bits, low, high, 254, 254] })
    }

    fn answer(&mut self, nth: usize, answer: Answer) -> Result<(), Broken> {
        let asked = &self.judge.asked[nth];
        let mut bytes = match (answer, asked.what) {
            (Answer::Refused(code), _) => with_crc(&[SLAVE, asked.request[1] | 0x80, code]),
            (_, What::First | What::Second) => {
                let [high, low] = asked.value.to_be_bytes();
                with_crc(&[SLAVE, 3, 2, high, low])
            }
            (_, What::Start | What::Stop) => with_crc(&asked.request[..6]),
        };
        if answer == Answer::Damaged {
            let last = bytes.len() - 1;
            bytes[last] ^= 0x55;
        }
        self.judge.answers(nth, answer);
        self.tell(Input::PortBytes { port: PORT, bytes: &bytes })
    }
}

impl World for ExchangeCell {
    type Event = Event;

    fn events(&self) -> Vec<Event> {
        let (gateway, judge) = (&self.gateway, &self.judge);
        let mut events = Vec::with_capacity(24);
        let mut add = |event, is_possible: bool| {
            if is_possible {
                events.push(event);
            }
        };
        let conn = gateway.conns.of(LINK);
        for nth in 0..FRAMES.len() {
            add(Frame(nth as u8), conn.is == Is::Open);
        }
        add(Tick, true);
        add(Step, true);
        add(Late, !gateway.is_late());
        add(Sleep, true);
        add(Up, conn.is == Is::Opening);
        add(Down, conn.is == Is::Open);
        // Beyond that time nothing is promised.
        let may_answer =
            |at: Instant| judge.is_up && gateway.now < at + LATE && !judge.may_have_failed(gateway.now);
        let newest = judge.asked.last().filter(|newest| may_answer(newest.at));
        for answer in [Answer::Good, Answer::BUSY, Answer::NO, Answer::Damaged] {
            add(
                Newest(answer),
                newest.is_some_and(|newest| answer == Answer::Good || judge.is_awaited(newest)),
            );
        }
        let oldest = judge.asked.first().filter(|_| judge.asked.len() > 1);
        add(Oldest(Answer::Good), oldest.is_some_and(|oldest| may_answer(oldest.at)));
        add(Gone, judge.is_up);
        add(Back, !judge.is_up);
        events
    }

    fn happen(&mut self, event: Event) -> Result<(), Broken> {
        match event {
            Frame(nth) => self.frame(nth),
            Tick => self.tick(),
            Step => {
                let next = self.gateway.now + STEP;
                while self.gateway.until <= next {
                    self.tick()?;
                }
                self.gateway.now = next;
                Ok(())
            }
            Late => {
                self.gateway.wait_until_due();
                Ok(())
            }
            Sleep => {
                self.gateway.sleep();
                self.tell(Input::Tick)
            }
            Up => self.tell(Input::LinkUp { link: LINK }),
            Down => self.tell(Input::LinkDown { link: LINK }),
            Newest(answer) => self.answer(self.judge.asked.len() - 1, answer),
            Oldest(answer) => self.answer(0, answer),
            Gone => self.tell(Input::PortDown { port: PORT }),
            Back => self.tell(Input::PortUp { port: PORT }),
        }
    }

    fn fingerprint(&self, unique: u64) -> u64 {
        let look_back = LookBack {
            bits: Duration::ZERO,
            stamps: STALE_AFTER,
            unconfirmed: Duration::ZERO,
            confirmed: Duration::ZERO,
        };
        let connects = self.gateway.engine.links().map(|link| link.history.connects).sum();
        let mut scribe = Scribe::new(self.gateway.now, connects, look_back, unique);
        self.gateway.describe(&mut scribe);
        scribe.describe(&self.judge);
        scribe.finish()
    }
}
