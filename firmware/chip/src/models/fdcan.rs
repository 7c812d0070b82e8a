//! FDCAN1 as the program sees it: registers, message RAM, FIFOs, filters, error states. RM0433,
//! "Controller area network with flexible data rate"; Bosch's M_CAN manual where that leaves something out. Classic frames only.
//!
//! Strict: what CCE and INIT protect (said at each register), INIT that needs some cycles to arrive
//! and CCE that is set before it has, the index of TXBAR and of the acknowledges, message RAM that is
//! written while it waits to be sent, and the clock calibration unit, which has to be bypassed.

mod control;
mod filters;
mod memory;
mod registers;

use std::collections::VecDeque;

use self::registers::*;
use super::can_bus::{Arrival, Attempt, CanBus, Frame};
use crate::device::*;

/// The model.
#[derive(Debug)]
pub struct Fdcan {
    bank: Bank,
    ram: Vec<u32>,
    /// The bus, and who else is there.
    pub bus: CanBus,
    /// INIT as the bus' side has it follows later.
    init_arrives: Option<(bool, Picos)>,
    is_on_bus: bool,
    transmit_errors: u32,
    receive_errors: u32,
    is_bus_off: bool,
    /// After bus-off, when enough of recessive bits were seen.
    recovers: Option<Picos>,
    waiting: VecDeque<u32>,
    put: u32,
    sending: Option<(u32, Frame, Attempt, Picos)>,
    /// Get index, put index and fill level.
    fifos: [(u32, u32, u32); 2],
}

impl Fdcan {
    /// As after power came.
    pub fn new() -> Self {
        Self {
            bank: Bank::new(&REGISTERS),
            // After power on it holds anything.
            ram: vec![0xDEAD_BEEF; WORDS],
            bus: CanBus::default(),
            init_arrives: None,
            is_on_bus: false,
            transmit_errors: 0,
            receive_errors: 0,
            is_bus_off: false,
            recovers: None,
            waiting: VecDeque::new(),
            put: 0,
            sending: None,
            fifos: [(0, 0, 0); 2],
        }
    }

    /// It takes part in what happens on the bus.
    pub fn is_on_bus(&self) -> bool {
        self.is_on_bus && self.bank.get(CCCR) & RESTRICTED == 0
    }

    /// A late access to the message RAM: MRAF, and from then on only listening ("Restricted operation mode").
    pub fn fail_message_ram(&mut self) {
        self.bank.set(CCCR, self.bank.get(CCCR) | RESTRICTED);
        self.raise(1 << 17);
    }

    fn raise(&mut self, flags: u32) {
        self.bank.set(IR, self.bank.get(IR) | flags);
    }

    /// How long a bit is; `None` without a clock.
    pub fn bit(&self, clocks: Clocks) -> Option<Picos> {
        let timing = self.bank.get(NBTP);
        let quanta = 3 + (timing >> 8 & 0xFF) + (timing & 0x7F);
        let cycles = u64::from((timing >> 16 & 0x1FF) + 1) * u64::from(quanta);
        (clocks.fdcan != 0).then(|| cycles * SECOND / u64::from(clocks.fdcan))
    }

    fn error_state(&self) -> u32 {
        u32::from(self.transmit_errors >= 128 || self.receive_errors >= 128) << 5
            | u32::from(self.transmit_errors >= 96 || self.receive_errors >= 96) << 6
            | u32::from(self.is_bus_off) << 7
    }

    /// Does something to the error counters, and tells of a changed state.
    fn count(&mut self, change: impl FnOnce(&mut Self)) {
        let before = self.error_state();
        change(self);
        let changed = before ^ self.error_state();
        let flag = |place: u32, flag: u32| if changed >> place & 1 != 0 { flag } else { 0 };
        self.raise(flag(5, EP) | flag(6, EW) | flag(7, BO));
    }

    fn end(&mut self, index: u32, frame: Frame, attempt: Attempt, at: Picos) {
        match attempt {
            Attempt::Acknowledged => {
                self.bus.sent.push((at, frame));
                let bit = 1 << index;
                self.bank.set(TXBTO, self.bank.get(TXBTO) | bit);
                if self.bank.get(TXBTIE) & bit != 0 {
                    self.raise(TC);
                }
                self.count(|can| can.transmit_errors = can.transmit_errors.saturating_sub(1));
                return;
            }
            // An error-passive node that is alone does not count its missing acknowledges (ISO 11898-1).
            Attempt::NotAcknowledged if self.transmit_errors >= 128 => {}
            Attempt::NotAcknowledged | Attempt::Disturbed => self.count(|can| can.transmit_errors += 8),
        }
        if self.transmit_errors > 255 {
            self.count(|can| can.is_bus_off = true);
            self.is_on_bus = false;
            self.bank.set(CCCR, self.bank.get(CCCR) | INIT);
            self.bus.bus_offs.push(at);
        }
        // It is sent again, before the others.
        self.waiting.push_front(index);
    }
}

impl Default for Fdcan {
    fn default() -> Self {
        Self::new()
    }
}

impl Peripheral for Fdcan {
    fn registers(&self) -> &'static [Register] {
        &REGISTERS
    }

    fn read(&mut self, offset: u32, at: &Moment<'_>) -> Result<u32, Refusal> {
        self.advance(at)?;
        let pending = self.waiting.iter().fold(0_u32, |bits, index| bits | 1 << index);
        let status = |fifo: usize| {
            let (get, put, fill) = self.fifos[fifo];
            let size = self.bank.get(RXFC[fifo]) >> 16 & 0x7F;
            fill | get << 8 | put << 16 | u32::from(size > 0 && fill == size) << 24
        };
        Ok(match offset {
            // From 128 on, RP says so in the place of REC's eighth bit.
            ECR => {
                let passive = u32::from(self.receive_errors >= 128) << 15;
                self.transmit_errors.min(255) | self.receive_errors.min(127) << 8 | passive
            }
            PSR => 0x707 | self.error_state(),
            TXBRP => pending | self.sending.map_or(0, |(index, ..)| 1 << index),
            TXFQS => {
                let size = self.bank.get(TXBC) >> 24 & 0x3F;
                let free = size.saturating_sub(self.used());
                free | self.put << 16 | u32::from(free == 0) << 21
            }
            _ if offset == RXFS[0] => status(0),
            _ if offset == RXFS[1] => status(1),
            _ => self.bank.read(offset)?,
        })
    }

    fn write(&mut self, offset: u32, value: u32, at: &Moment<'_>) -> Result<(), Refusal> {
        self.advance(at)?;
        self.bank.check(offset, value)?;
        if PROTECTED.contains(&offset) && self.bank.get(CCCR) & (INIT | CCE) != INIT | CCE {
            return refuse("can only be written while INIT and CCE are set");
        }
        match offset {
            CCCR => self.write_control(value, at),
            IR => {
                self.bank.set(IR, self.bank.get(IR) & !value);
                Ok(())
            }
            TXBAR => self.request(value),
            TXBCR => {
                // What is on the bus is ended first ("Transmit cancellation"); what waits is forgotten at once.
                let is_meant = |index: &u32| value >> index & 1 != 0;
                let cancelled = self.waiting.iter().filter(|index| is_meant(index));
                let bits = cancelled.fold(0, |bits, index| bits | 1 << index);
                self.waiting.retain(|index| !is_meant(index));
                self.bank.set(TXBCF, self.bank.get(TXBCF) | bits);
                self.raise(if bits & self.bank.get(0xE4) != 0 { TCF } else { 0 });
                Ok(())
            }
            _ if offset == RXFA[0] => self.take(0, value),
            _ if offset == RXFA[1] => self.take(1, value),
            _ => self.bank.write(offset, value),
        }
    }

    fn advance(&mut self, at: &Moment<'_>) -> Result<(), Refusal> {
        if let Some((is_init, when)) = self.init_arrives
            && at.now >= when
        {
            self.init_arrives = None;
            self.bank.set(CCCR, self.bank.get(CCCR) & !INIT | u32::from(is_init));
            let bit = self.bit(at.clocks).unwrap_or(0);
            if is_init {
                self.is_on_bus = false;
                self.recovers = None;
                if self.sending.is_some() {
                    self.forget();
                }
            } else if self.is_bus_off {
                self.recovers = Some(when + 129 * 11 * bit);
            } else {
                self.is_on_bus = true;
            }
        }
        if let Some(when) = self.recovers
            && at.now >= when
        {
            self.recovers = None;
            self.is_on_bus = true;
            self.count(|can| {
                can.is_bus_off = false;
                can.transmit_errors = 0;
                can.receive_errors = 0;
            });
        }
        let bit = self.bit(at.clocks).unwrap_or(0);
        loop {
            if let Some((index, frame, attempt, until)) = self.sending
                && at.now >= until
            {
                self.sending = None;
                self.end(index, frame, attempt, until);
                continue;
            }
            let can_send = self.is_on_bus && self.bank.get(CCCR) & RESTRICTED == 0;
            if self.sending.is_none()
                && can_send
                && let Some(index) = self.waiting.pop_front()
            {
                let frame = self.frame(index);
                let attempt = self.bus.attempt(bit, at)?;
                self.sending = Some((index, frame, attempt, at.now + frame.bits(attempt) * bit));
                continue;
            }
            let Some(arrival) = self.bus.arrival(at.now) else { break };
            match arrival {
                Arrival::Frame(frame) if self.is_on_bus && self.bus.is_understood(bit) => {
                    self.bus.heard += 1;
                    // Out of error-passive at once (ISO 11898-1).
                    self.count(|can| can.receive_errors = can.receive_errors.saturating_sub(1).min(127));
                    self.store(&frame);
                }
                Arrival::Broken if self.is_on_bus => {
                    self.count(|can| can.receive_errors = (can.receive_errors + 1).min(128));
                }
                Arrival::Frame(_) | Arrival::Broken => self.bus.missed += 1,
            }
        }
        Ok(())
    }

    fn deadline(&self, _: &Moment<'_>) -> Option<Picos> {
        let sent = self.sending.map(|(.., until)| until);
        let init = self.init_arrives.map(|(_, when)| when);
        [sent, init, self.recovers, self.bus.next_arrival()].into_iter().flatten().min()
    }

    fn interrupts(&self) -> bool {
        self.bank.get(IR) & self.bank.get(IE) & !self.bank.get(0x58) != 0 && self.bank.get(ILE) & 1 != 0
    }

    fn reset(&mut self) {
        let (bus, ram) = (std::mem::take(&mut self.bus), std::mem::take(&mut self.ram));
        *self = Self { bus, ram, ..Self::new() };
    }
}
