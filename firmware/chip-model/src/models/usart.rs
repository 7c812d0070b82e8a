//! A USART with FIFOs and driver-enable, and the RS-485 line at its pins. RM0433, "Universal synchronous
//! receiver transmitter".
//!
//! Timing is exact: BRR and PRESC give the length of a bit, DEAT and DEDT the times of driver-enable. Received
//! bits are sampled three times in the middle, so a wrong baud rate, a wrong parity and noise have the effects
//! they have on the chip. The transceiver's receiver is off while its driver is on (DE and /RE are
//! connected). Fields that may be written only while the USART is disabled are refused otherwise.

mod receiver;
mod registers;
mod transmitter;

use std::collections::VecDeque;

use self::registers::*;
use crate::device::*;

pub use super::line::{Format, Line, Sent};

/// The pins of a USART and their alternate function.
#[derive(Debug, Clone, Copy)]
pub struct Pins {
    /// Transmit.
    pub tx: Pin,
    /// Receive.
    pub rx: Pin,
    /// Driver-enable.
    pub de: Pin,
    /// Alternate function of all three.
    pub function: u8,
}

/// The model.
#[derive(Debug)]
pub struct Usart {
    bank: Bank,
    pins: Pins,
    /// The line at its pins.
    pub line: Line,
    flags: u32,
    /// The receive FIFO: each character with its parity bit, and its error flags.
    received: VecDeque<(u16, u32)>,
    waiting: VecDeque<u8>,
    /// The character being sent, its start and its end.
    sending: Option<(u8, Picos, Picos)>,
    /// When driver-enable is released.
    releases: Option<Picos>,
    /// Start of the character being received.
    receiving: Option<Picos>,
    /// When the line is detected as idle.
    idles: Option<Picos>,
}

impl Usart {
    /// The state after power-on.
    pub fn new(pins: Pins) -> Self {
        Self {
            bank: Bank::new(&REGISTERS),
            pins,
            line: Line::default(),
            flags: TC,
            received: VecDeque::new(),
            waiting: VecDeque::new(),
            sending: None,
            releases: None,
            receiving: None,
            idles: None,
        }
    }

    fn has(&self, register: u32, bits: u32) -> bool {
        self.bank.get(register) & bits == bits
    }

    /// Bit time.
    fn bit(&self, clocks: Clocks) -> Picos {
        const PRESCALERS: [u64; 16] = [1, 2, 4, 6, 8, 10, 12, 16, 32, 64, 128, 256, 256, 256, 256, 256];
        let prescaler = PRESCALERS[self.bank.get(PRESC) as usize & 0xF];
        let divider = u64::from(self.bank.get(BRR).max(1));
        SECOND / 1_000 * prescaler * divider / u64::from((clocks.usart / 1_000).max(1))
    }

    /// Data bits, including the parity bit.
    fn data_bits(&self) -> u32 {
        match self.bank.get(CR1) >> 12 & 1 | self.bank.get(CR1) >> 27 & 2 {
            0 => 8,
            1 => 9,
            _ => 7,
        }
    }

    fn stop_bits(&self) -> u32 {
        if self.bank.get(CR2) >> 12 & 3 == 2 { 2 } else { 1 }
    }

    /// Its serial format.
    pub fn format(&self, clocks: Clocks) -> Format {
        let odd_parity = self.has(CR1, 1 << 10).then(|| self.has(CR1, 1 << 9));
        let baud = (SECOND / self.bit(clocks).max(1)) as u32;
        Format { baud, odd_parity, stop_bits: self.stop_bits() as u8 }
    }

    /// Whether it is enabled.
    pub fn is_on(&self) -> bool {
        self.has(CR1, UE)
    }

    fn character(&self, clocks: Clocks) -> Picos {
        Picos::from(1 + self.data_bits() + self.stop_bits()) * self.bit(clocks)
    }

    fn parity_bit(&self, byte: u8) -> Option<bool> {
        self.has(CR1, PCE).then(|| byte.count_ones().is_multiple_of(2) == self.has(CR1, 1 << 9))
    }

    fn status(&self) -> u32 {
        const THRESHOLDS: [usize; 8] = [2, 4, 8, 12, 14, 16, 17, 17];
        let threshold = |place: u32| THRESHOLDS[(self.bank.get(CR3) >> place & 7) as usize];
        let mut status = self.flags;
        let mut when = |is: bool, bits: u32| status |= if is { bits } else { 0 };
        when(self.has(CR1, UE | TE), 1 << 21);
        when(self.has(CR1, UE | RE), 1 << 22);
        when(!self.received.is_empty(), RXFNE);
        when(self.received.len() >= threshold(25), RXFT);
        when(self.waiting.len() < FIFO, TXFNF);
        when(self.waiting.is_empty(), TXFE);
        when(FIFO - self.waiting.len() >= threshold(29), TXFT);
        when(self.sending.is_some() || self.receiving.is_some(), 1 << 16);
        status | self.received.front().map_or(0, |(_, flags)| *flags)
    }

    /// Refuses changes of fields that are locked while the USART is enabled.
    fn check_locked(&self, offset: u32, value: u32) -> Result<(), Refusal> {
        if !self.has(CR1, UE) {
            return Ok(());
        }
        let locked: u32 = match offset {
            CR1 => 0x33FF_9E00,
            CR2 => 0x000F_FA70,
            CR3 => 0x0000_D83E,
            BRR | PRESC => !0,
            _ => 0,
        };
        match (self.bank.get(offset) ^ value) & locked {
            0 => Ok(()),
            bits => refuse(format!("bits {bits:08X} can only be changed while UE is 0")),
        }
    }
}

impl Peripheral for Usart {
    fn registers(&self) -> &'static [Register] {
        &REGISTERS
    }

    fn read(&mut self, offset: u32, at: &Context<'_>) -> Result<u32, Refusal> {
        self.advance(at)?;
        match offset {
            ISR => Ok(self.status()),
            RDR => match self.received.pop_front() {
                Some((word, flags)) => {
                    // Flags that were not cleared before the read stay set for the next character.
                    self.flags |= flags;
                    Ok(word.into())
                }
                None => refuse("nothing was received"),
            },
            TDR | ICR => refuse("nothing to read there"),
            _ => self.bank.read(offset),
        }
    }

    fn write(&mut self, offset: u32, value: u32, at: &Context<'_>) -> Result<(), Refusal> {
        self.advance(at)?;
        match offset {
            ICR => {
                self.bank.check(offset, value)?;
                self.flags &= !(value & (PE | FE | NE | ORE | IDLE | TC));
                if let Some((_, flags)) = self.received.front_mut() {
                    *flags &= !value;
                }
                return Ok(());
            }
            TDR => {
                self.bank.check(offset, value)?;
                if !self.has(CR1, UE | TE) {
                    return refuse("the transmitter is off");
                }
                if self.waiting.len() == FIFO {
                    return refuse("the FIFO is full (TXFNF was 0)");
                }
                self.flags &= !TC;
                if self.sending.is_some() {
                    self.waiting.push_back(value as u8);
                    return Ok(());
                }
                // Unless the driver is still enabled after the last character, the assertion time comes first.
                let sixteenths = u64::from(self.bank.get(CR1) >> 21 & 0x1F);
                let wait = if self.has(CR3, DEM) { sixteenths * self.bit(at.clocks) / 16 } else { 0 };
                let wait = if self.releases.take().is_some() { 0 } else { wait };
                self.show_driver(true, at);
                self.begin(value as u8, at.now + wait, at.clocks);
                return Ok(());
            }
            _ => {}
        }
        self.check_locked(offset, value)?;
        if offset == CR1 && value & OVER8 != 0 {
            return refuse("oversampling by 8 is not modelled");
        }
        if offset == CR1 && value & UE != 0 && value & FIFOEN == 0 {
            return refuse("a USART without its FIFOs (FIFOEN) is not modelled");
        }
        if offset == CR1 && value & UE != 0 && !self.has(CR1, UE) && self.bank.get(BRR) < 16 {
            return refuse("it is switched on with a BRR below 16");
        }
        self.bank.write(offset, value)?;
        self.show_driver(self.is_driving(), at);
        Ok(())
    }

    fn advance(&mut self, at: &Context<'_>) -> Result<(), Refusal> {
        self.transmit(at)?;
        // The pin's function may have changed.
        self.show_driver(self.is_driving(), at);
        self.receive(at);
        Ok(())
    }

    fn deadline(&self, at: &Context<'_>) -> Option<Picos> {
        let bits = Picos::from(self.data_bits() + 1);
        let bit = self.bit(at.clocks);
        // A character is handled when its last bit has been sampled.
        let start = self.receiving.or_else(|| self.line.next_start_bit());
        let sampled = start.map(|start| start + bits * bit + bit / 2 + receiver::spread(bit));
        let sent = self.sending.map(|(_, _, end)| end);
        [sent, self.releases, sampled, self.idles].into_iter().flatten().min()
    }

    fn interrupt_line(&self) -> bool {
        let (status, cr1, cr3) = (self.status(), self.bank.get(CR1), self.bank.get(CR3));
        let asked = [
            (IDLE | TC | TXFNF) & cr1,
            status & (RXFNE | ORE) & if cr1 & RXFNE != 0 { !0 } else { 0 },
            if cr1 >> 8 & 1 != 0 { PE } else { 0 },
            if cr3 & 1 != 0 { FE | NE | ORE } else { 0 },
            if cr3 >> 28 & 1 != 0 { RXFT } else { 0 },
            if cr3 >> 23 & 1 != 0 { TXFT } else { 0 },
            cr1 >> 30 << 23 & TXFE,
        ];
        cr1 & UE != 0 && asked.into_iter().any(|bits| status & bits != 0)
    }

    fn reset(&mut self) {
        let line = std::mem::take(&mut self.line);
        *self = Self { line, ..Self::new(self.pins) };
    }
}

const FIFO: usize = 16;
