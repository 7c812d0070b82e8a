//! What the gateway promises of a bit by Modbus and of commands by port 2000.

use proto_core::engine::{BusState, Input, LinkId, PortState};
use proto_core::time::{Duration, Instant};
use proto_core::wire::can::CanFrame;
use proto_core::wire::scalar::Scalar;

use crate::driver::{AFTER_SLEEP, Broken, Conns, Is, Judge, PORT, Small};
use crate::orders::{Order, Orders};
use crate::rig::var;
use crate::values::Bits;

pub const BIT: &str = "BitInputReg[3]";
pub const FIRST_COIL: u16 = 32;
pub const SAFE: u8 = 4;
/// Not Modbus: another protocol's id.
pub const GARBAGE: [u8; 9] = [0, 1, 9, 9, 0, 3, 1, 15, 4];
/// A text of port 2000 that is no reply.
pub const OTHER_WORDS: &[u8] = b"busy\n";

const ANSWER_TIMEOUT: Duration = Duration::from_millis(500);
const REFUSED_PAUSE: Duration = Duration::from_millis(500);
const TIMEOUTS_IN_A_ROW: u8 = 3;

/// What is so.
#[derive(Debug, Clone)]
pub struct Facts {
    pub is_up: bool,
    /// The device's newest frame.
    pub repeats: Option<u8>,
    pub is_bus_off: bool,
    slept_until: Option<Instant>,
    bits: Bits,
    pub orders: Orders,
    /// The write that is unanswered: whether it is of the safe value, and since when.
    pub asked: Option<Asked>,
    /// The header of the newest request, and of one that was given up on this connection.
    pub newest: Header,
    pub given_up: Option<Header>,
    timeouts: u8,
    /// A safe value was refused: it is written again then.
    again_at: Option<Instant>,
    /// Frames accepted and discarded after a sleep; not part of the state.
    counted: [u32; 2],
}

#[derive(Debug, Clone)]
pub struct Asked {
    is_safe: bool,
    from: Instant,
}

/// A transaction's number; not part of the state.
#[derive(Debug, Clone, Copy, Default)]
pub struct Header {
    pub transaction: u16,
}

impl Facts {
    pub fn new() -> Self {
        Self {
            is_up: false,
            repeats: None,
            is_bus_off: false,
            slept_until: None,
            bits: Bits::new(SAFE),
            orders: Orders::new(),
            asked: None,
            newest: Header::default(),
            given_up: None,
            timeouts: 0,
            again_at: None,
            counted: [0; 2],
        }
    }

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
        if self.slept_until.is_some() {
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
            Input::Tick => self.slept_until = self.slept_until.filter(|&until| now < until),
            Input::PortCan { frame, .. } => self.frame(now, &frame, conns),
            Input::PortUp { .. } => self.is_up = true,
            Input::PortDown { .. } => {
                self.is_up = false;
                self.orders.gone(now);
            }
            Input::PortBus { state, .. } => {
                let was_off = std::mem::replace(&mut self.is_bus_off, state == BusState::BusOff);
                if self.is_bus_off && !was_off {
                    self.orders.gone(now);
                }
            }
            Input::LinkUp { .. } => self.bits.controller_was_away(now),
            Input::LinkBytes { link, bytes } if conns.is_open(link) => match link {
                LinkId::MODBUS if bytes == GARBAGE => {
                    conns.must_close(now, link);
                    self.modbus_lost();
                }
                LinkId::MODBUS => self.modbus_answered(now, bytes),
                _ if bytes == OTHER_WORDS => self.orders.other_words(link),
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
        self.slept_until = Some(now + AFTER_SLEEP);
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

    fn rested(
        &mut self,
        now: Instant,
        until: Instant,
        engine: &Small,
        conns: &Conns,
        is_late: bool,
    ) -> Result<(), Broken> {
        if !is_late {
            if self.bits.is_waiting() && self.asked.is_none() && conns.of(LinkId::MODBUS).is_free() {
                return Err("lets a value wait though the link is free".to_owned());
            }
            self.orders.rested(conns, now, until)?;
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
        Ok(())
    }
}
