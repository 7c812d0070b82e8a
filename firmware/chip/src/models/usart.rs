//! A USART with FIFOs and driver-enable, and the RS-485 line at its pins. RM0433, "Universal
//! synchronous receiver transmitter".
//!
//! Time is exact: characters have the length that BRR and PRESC give them, and driver-enable the times of
//! DEAT and DEDT. Characters that arrive are sampled three times in the middle of each bit, so a wrong speed,
//! a wrong parity and noise show as they would. The transceiver's receiver is off while its driver is on (DE
//! and /RE are tied). Settings that only a disabled USART takes are refused while it runs (said at each
//! field).

use std::collections::VecDeque;

use crate::device::*;

pub use super::line::{Format, Line, Sent};

const CR1: u32 = 0x00;
const CR2: u32 = 0x04;
const CR3: u32 = 0x08;
const BRR: u32 = 0x0C;
const ISR: u32 = 0x1C;
const ICR: u32 = 0x20;
const RDR: u32 = 0x24;
const TDR: u32 = 0x28;
const PRESC: u32 = 0x2C;

static REGISTERS: [Register; 10] = [
    keeps(CR1, "CR1", 0, !0),
    keeps(CR2, "CR2", 0, 0xFFFF_FF79),
    keeps(CR3, "CR3", 0, !0x0001_0000),
    keeps(BRR, "BRR", 0, 0xFFFF),
    does(0x18, "RQR", 0x1F),
    reads(ISR, "ISR", 0),
    does(ICR, "ICR", 0x0012_3BFF),
    reads(RDR, "RDR", 0),
    does(TDR, "TDR", 0x1FF),
    keeps(PRESC, "PRESC", 0, 0xF),
];

const PE: u32 = 1;
const FE: u32 = 1 << 1;
const NE: u32 = 1 << 2;
const ORE: u32 = 1 << 3;
const IDLE: u32 = 1 << 4;
const RXFNE: u32 = 1 << 5;
const TC: u32 = 1 << 6;
const TXFNF: u32 = 1 << 7;
const TXFE: u32 = 1 << 23;
const RXFT: u32 = 1 << 26;
const TXFT: u32 = 1 << 27;

const UE: u32 = 1;
const RE: u32 = 1 << 2;
const TE: u32 = 1 << 3;
const PCE: u32 = 1 << 10;
const OVER8: u32 = 1 << 15;
const FIFOEN: u32 = 1 << 29;
const ONEBIT: u32 = 1 << 11;
const DEM: u32 = 1 << 14;
const DEP: u32 = 1 << 15;
const FIFO: usize = 16;

/// The pins of a USART and their alternate function.
#[derive(Debug, Clone, Copy)]
pub struct Pins {
    /// Transmit.
    pub tx: Pin,
    /// Receive.
    pub rx: Pin,
    /// Driver-enable.
    pub de: Pin,
    /// Of all three.
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
    /// Each with its parity bit and its error flags.
    received: VecDeque<(u16, u32)>,
    waiting: VecDeque<u8>,
    /// What is on the line: its start, its end.
    sending: Option<(u8, Picos, Picos)>,
    /// When driver-enable falls.
    releases: Option<Picos>,
    /// When the character that is being received began.
    receiving: Option<Picos>,
    /// When the line counts as idle.
    idles: Option<Picos>,
}

impl Usart {
    /// As after power came.
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

    /// How long a bit is.
    fn bit(&self, clocks: Clocks) -> Picos {
        const PRESCALERS: [u64; 16] = [1, 2, 4, 6, 8, 10, 12, 16, 32, 64, 128, 256, 256, 256, 256, 256];
        let prescaler = PRESCALERS[self.bank.get(PRESC) as usize & 0xF];
        let divider = u64::from(self.bank.get(BRR).max(1));
        SECOND / 1_000 * prescaler * divider / u64::from((clocks.usart / 1_000).max(1))
    }

    /// Bits of data, the parity bit included.
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

    /// As it sends, and as another device has to that it is to understand.
    pub fn format(&self, clocks: Clocks) -> Format {
        let odd_parity = self.has(CR1, 1 << 10).then(|| self.has(CR1, 1 << 9));
        let baud = (SECOND / self.bit(clocks).max(1)) as u32;
        Format { baud, odd_parity, stop_bits: self.stop_bits() as u8 }
    }

    /// Whether it is switched on.
    pub fn is_on(&self) -> bool {
        self.has(CR1, UE)
    }

    fn character(&self, clocks: Clocks) -> Picos {
        Picos::from(1 + self.data_bits() + self.stop_bits()) * self.bit(clocks)
    }

    /// The pin of driver-enable, as the transceiver sees it: pulled down while nobody drives it. One that is
    /// not set up for driver-enable is the request to send, which is high at rest.
    fn show_driver(&mut self, is_active: bool, at: &Moment<'_>) {
        let is_connected = self.pins.de.is(at.functions, self.pins.function);
        let is_set_up = self.has(CR1, UE) && self.has(CR3, DEM);
        let level = is_connected && (!is_set_up || is_active != self.has(CR3, DEP));
        self.line.drive(at.now, level);
    }

    fn is_driving(&self) -> bool {
        self.sending.is_some() || self.releases.is_some()
    }

    fn begin(&mut self, byte: u8, from: Picos, clocks: Clocks) {
        // The parity bit takes the place of the word's last bit.
        let bits = self.data_bits() - u32::from(self.has(CR1, PCE));
        let byte = byte & (0xFF >> 8_u32.saturating_sub(bits));
        self.sending = Some((byte, from, from + self.character(clocks)));
    }

    fn parity_bit(&self, byte: u8) -> Option<bool> {
        self.has(CR1, PCE).then(|| byte.count_ones().is_multiple_of(2) == self.has(CR1, 1 << 9))
    }

    fn transmit(&mut self, at: &Moment<'_>) -> Result<(), Refusal> {
        let bit = self.bit(at.clocks);
        while let Some((byte, start, end)) = self.sending {
            if at.now < end {
                break;
            }
            let is_connected = self.pins.tx.is(at.functions, self.pins.function);
            if !is_connected {
                return refuse(format!("a character was sent, but {:?} is not its pin", self.pins.tx));
            }
            let is_driven = self.line.is_driven(start) && self.line.is_driven(end);
            let (parity, stop_bits) = (self.parity_bit(byte), self.stop_bits() as u8);
            self.line.sent.push(Sent { byte, start, end, bit, parity, stop_bits, is_driven });
            self.sending = None;
            match self.waiting.pop_front() {
                Some(next) => self.begin(next, end, at.clocks),
                None => {
                    self.flags |= TC;
                    let sixteenths = u64::from(self.bank.get(CR1) >> 16 & 0x1F);
                    self.releases = Some(end + sixteenths * bit / 16);
                }
            }
        }
        if let Some(until) = self.releases
            && at.now >= until
        {
            self.releases = None;
            let then = Moment { now: until, ..*at };
            self.show_driver(false, &then);
        }
        Ok(())
    }

    /// A bit by the majority of its three samples, and whether they disagree ("Noise error"); `middle` is when
    /// the second is taken.
    fn sample(&self, middle: Picos, bit: Picos) -> (bool, bool) {
        let levels = [middle - spread(bit), middle, middle + spread(bit)].map(|at| self.line.level(at));
        if self.has(CR3, ONEBIT) {
            return (levels[1], false);
        }
        let highs = levels.into_iter().filter(|level| *level).count();
        (highs >= 2, highs % 3 != 0)
    }

    fn receive(&mut self, at: &Moment<'_>) {
        let is_on = self.has(CR1, UE | RE) && self.pins.rx.is(at.functions, self.pins.function);
        let bit = self.bit(at.clocks);
        let bits = self.data_bits();
        // Up to the middle of the first stop bit, and to the last sample of it.
        let middle = Picos::from(bits + 1) * bit + bit / 2;
        let sampled = middle + spread(bit);
        loop {
            let start = match self.receiving {
                Some(start) => start,
                None => match self.line.start_bit(at.now) {
                    Some(start) => start,
                    None => break,
                },
            };
            // What comes before the line has been at rest long enough is not behind a rest.
            self.idles = self.idles.filter(|idle| *idle <= start);
            // A glitch is none: the middle of the start bit is looked at too.
            if at.now < start + sampled {
                self.receiving = Some(start);
                break;
            }
            self.receiving = None;
            let sample = |index: u32| self.sample(start + Picos::from(index) * bit + bit / 2, bit);
            let level = |index: u32| sample(index).0;
            if level(0) || !is_on {
                self.line.heard(start + bit);
                continue;
            }
            let word = (0..bits).fold(0_u32, |word, index| word | u32::from(level(index + 1)) << index);
            let is_stopped = level(bits + 1);
            let is_noisy = (0..=bits + 1).any(|index| sample(index).1);
            self.line.heard(start + sampled);
            let mut flags = if is_stopped { 0 } else { FE } | if is_noisy { NE } else { 0 };
            let data = word & !(1 << (bits - 1));
            if let Some(parity) = self.parity_bit(data as u8)
                && (word >> (bits - 1) & 1 != 0) != parity
            {
                flags |= PE;
            }
            if self.received.len() == FIFO {
                self.flags |= ORE;
            } else {
                self.received.push_back((word as u16, flags));
            }
            self.idles = Some(start + middle + self.character(at.clocks));
        }
        if let Some(idle) = self.idles
            && at.now >= idle
        {
            self.idles = None;
            self.flags |= IDLE;
        }
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

    /// What only a disabled USART takes.
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

/// From the middle sample of a bit to its neighbours ("Oversampling by 16").
fn spread(bit: Picos) -> Picos {
    bit / 16
}

impl Peripheral for Usart {
    fn registers(&self) -> &'static [Register] {
        &REGISTERS
    }

    fn read(&mut self, offset: u32, at: &Moment<'_>) -> Result<u32, Refusal> {
        self.advance(at)?;
        match offset {
            ISR => Ok(self.status()),
            RDR => match self.received.pop_front() {
                Some((word, flags)) => {
                    // Not cleared before, they stay, and are there for the next character too.
                    self.flags |= flags;
                    Ok(word.into())
                }
                None => refuse("nothing was received"),
            },
            TDR | ICR => refuse("nothing to read there"),
            _ => self.bank.read(offset),
        }
    }

    fn write(&mut self, offset: u32, value: u32, at: &Moment<'_>) -> Result<(), Refusal> {
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
                // Behind the last stop bit the driver is still on, or it is switched on first.
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

    fn advance(&mut self, at: &Moment<'_>) -> Result<(), Refusal> {
        self.transmit(at)?;
        // The function of the pin may have come since.
        self.show_driver(self.is_driving(), at);
        self.receive(at);
        Ok(())
    }

    fn deadline(&self, at: &Moment<'_>) -> Option<Picos> {
        let bits = Picos::from(self.data_bits() + 1);
        let bit = self.bit(at.clocks);
        // Edges inside of a character are looked at when it is sampled.
        let start = self.receiving.or_else(|| self.line.next_start_bit());
        let sampled = start.map(|start| start + bits * bit + bit / 2 + spread(bit));
        let sent = self.sending.map(|(_, _, end)| end);
        [sent, self.releases, sampled, self.idles].into_iter().flatten().min()
    }

    fn interrupts(&self) -> bool {
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
