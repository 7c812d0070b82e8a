//! FDCAN1: registers, message RAM, FIFOs, filters, error states. RM0433, "Controller area network with flexible
//! data rate", and Bosch's M_CAN manual where that is incomplete. Classic frames only.
//!
//! Refused: writes that need INIT and CCE without these, CCE before a change of INIT has taken effect, wrong
//! indices in TXBAR and in acknowledges, a write to a transmit buffer with a pending request, and leaving INIT
//! without bypassing the clock calibration unit.

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
    /// The bus at its pins.
    pub bus: CanBus,
    /// A change of INIT, and when it has crossed to the CAN clock domain.
    init_change: Option<(bool, Picos)>,
    is_on_bus: bool,
    transmit_errors: u32,
    receive_errors: u32,
    is_bus_off: bool,
    /// End of the bus-off recovery sequence.
    recovers: Option<Picos>,
    waiting: VecDeque<u32>,
    put: u32,
    sending: Option<(u32, Frame, Attempt, Picos)>,
    /// Get index, put index and fill level.
    fifos: [(u32, u32, u32); 2],
}

impl Fdcan {
    /// The state after power-on.
    pub fn new() -> Self {
        Self {
            bank: Bank::new(&REGISTERS),
            // Its contents are undefined after power-on.
            ram: vec![0xDEAD_BEEF; WORDS],
            bus: CanBus::default(),
            init_change: None,
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

    /// Whether it takes part in the bus' traffic.
    pub fn is_on_bus(&self) -> bool {
        self.is_on_bus && self.bank.get(CCCR) & RESTRICTED == 0
    }

    /// A message RAM access failure: sets MRAF and enters restricted operation mode.
    pub fn fail_message_ram(&mut self) {
        self.bank.set(CCCR, self.bank.get(CCCR) | RESTRICTED);
        self.raise(1 << 17);
    }

    fn raise(&mut self, flags: u32) {
        self.bank.set(IR, self.bank.get(IR) | flags);
    }

    /// Bit time; `None` without a clock.
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

    /// Changes the error counters, and sets the flags of a changed error state.
    fn update_errors(&mut self, change: impl FnOnce(&mut Self)) {
        let before = self.error_state();
        change(self);
        let changed = before ^ self.error_state();
        let flag = |place: u32, flag: u32| if changed >> place & 1 != 0 { flag } else { 0 };
        self.raise(flag(5, EP) | flag(6, EW) | flag(7, BO));
    }

    fn finish(&mut self, index: u32, frame: Frame, attempt: Attempt, at: Picos) {
        match attempt {
            Attempt::Acknowledged => {
                self.bus.sent.push((at, frame));
                let bit = 1 << index;
                self.bank.set(TXBTO, self.bank.get(TXBTO) | bit);
                if self.bank.get(TXBTIE) & bit != 0 {
                    self.raise(TC);
                }
                self.update_errors(|can| can.transmit_errors = can.transmit_errors.saturating_sub(1));
                return;
            }
            // An error-passive node does not count missing acknowledges (ISO 11898-1).
            Attempt::NotAcknowledged if self.transmit_errors >= 128 => {}
            Attempt::NotAcknowledged | Attempt::BitError => {
                self.update_errors(|can| can.transmit_errors += 8)
            }
        }
        if self.transmit_errors > 255 {
            self.update_errors(|can| can.is_bus_off = true);
            self.is_on_bus = false;
            self.bank.set(CCCR, self.bank.get(CCCR) | INIT);
            self.bus.bus_offs.push(at);
        }
        // It is retransmitted before the others.
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

    fn read(&mut self, offset: u32, at: &Context<'_>) -> Result<u32, Refusal> {
        self.advance(at)?;
        let pending = self.waiting.iter().fold(0_u32, |bits, index| bits | 1 << index);
        let status = |fifo: usize| {
            let (get, put, fill) = self.fifos[fifo];
            let size = self.bank.get(RXFC[fifo]) >> 16 & 0x7F;
            fill | get << 8 | put << 16 | u32::from(size > 0 && fill == size) << 24
        };
        Ok(match offset {
            // REC has 7 bits; from 128 on, RP is set.
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

    fn write(&mut self, offset: u32, value: u32, at: &Context<'_>) -> Result<(), Refusal> {
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
                // A frame on the bus is completed; pending ones are cancelled at once ("Transmit cancellation").
                let is_meant = |index: &u32| value >> index & 1 != 0;
                let cancelled = self.waiting.iter().filter(|index| is_meant(index));
                let bits = cancelled.fold(0, |bits, index| bits | 1 << index);
                self.waiting.retain(|index| !is_meant(index));
                self.bank.set(TXBCF, self.bank.get(TXBCF) | bits);
                self.raise(if bits & self.bank.get(0xE4) != 0 { TCF } else { 0 });
                Ok(())
            }
            _ if offset == RXFA[0] => self.acknowledge(0, value),
            _ if offset == RXFA[1] => self.acknowledge(1, value),
            _ => self.bank.write(offset, value),
        }
    }

    fn advance(&mut self, at: &Context<'_>) -> Result<(), Refusal> {
        if let Some((is_init, when)) = self.init_change
            && at.now >= when
        {
            self.init_change = None;
            self.bank.set(CCCR, self.bank.get(CCCR) & !INIT | u32::from(is_init));
            let bit = self.bit(at.clocks).unwrap_or(0);
            if is_init {
                self.is_on_bus = false;
                self.recovers = None;
                if self.sending.is_some() {
                    self.cancel_all();
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
            self.update_errors(|can| {
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
                self.finish(index, frame, attempt, until);
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
                    self.bus.received += 1;
                    // A received frame ends error-passive (ISO 11898-1).
                    self.update_errors(|can| {
                        can.receive_errors = can.receive_errors.saturating_sub(1).min(127)
                    });
                    self.store(&frame);
                }
                Arrival::ErrorFrame if self.is_on_bus => {
                    self.update_errors(|can| can.receive_errors = (can.receive_errors + 1).min(128));
                }
                Arrival::Frame(_) | Arrival::ErrorFrame => self.bus.missed += 1,
            }
        }
        Ok(())
    }

    fn deadline(&self, _: &Context<'_>) -> Option<Picos> {
        let sent = self.sending.map(|(.., until)| until);
        let init = self.init_change.map(|(_, when)| when);
        [sent, init, self.recovers, self.bus.next_arrival()].into_iter().flatten().min()
    }

    fn interrupt_line(&self) -> bool {
        self.bank.get(IR) & self.bank.get(IE) & !self.bank.get(0x58) != 0 && self.bank.get(ILE) & 1 != 0
    }

    fn reset(&mut self) {
        let (bus, ram) = (std::mem::take(&mut self.bus), std::mem::take(&mut self.ram));
        *self = Self { bus, ram, ..Self::new() };
    }
}
