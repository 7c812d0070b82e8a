//! The independent watchdog. RM0433, "Independent watchdog".
//!
//! It counts LSI's 32 kHz, which it switches on itself. PR and RLR may be written only behind the key
//! 0x5555, and not while an earlier value is still on its way (SR's PVU and RVU).

use crate::device::*;

const KR: u32 = 0x00;
const PR: u32 = 0x04;
const RLR: u32 = 0x08;
const SR: u32 = 0x0C;
const WINR: u32 = 0x10;

static REGISTERS: [Register; 5] = [
    does(KR, "KR", 0xFFFF),
    keeps(PR, "PR", 0, 7),
    keeps(RLR, "RLR", 0xFFF, 0xFFF),
    reads(SR, "SR", 0),
    keeps(WINR, "WINR", 0xFFF, 0xFFF),
];

/// The model.
#[derive(Debug)]
pub struct Watchdog {
    bank: Bank,
    is_open: bool,
    /// Since when it counts down.
    since: Option<Picos>,
    /// When PR and RLR have arrived.
    arrives: [Picos; 2],
    /// Each feed.
    pub feeds: Vec<Picos>,
}

impl Watchdog {
    /// As after power came.
    pub fn new() -> Self {
        Self { bank: Bank::new(&REGISTERS), is_open: false, since: None, arrives: [0; 2], feeds: Vec::new() }
    }

    /// Whether it was started.
    pub fn is_running(&self) -> bool {
        self.since.is_some()
    }

    /// How long it waits for its food.
    pub fn period(&self) -> Picos {
        let divider = 4_u64 << self.bank.get(PR).min(6);
        divider * Picos::from(self.bank.get(RLR) + 1) * cycle(LSI)
    }

    /// When it resets the chip.
    pub fn bites(&self) -> Option<Picos> {
        self.since.map(|since| since + self.period())
    }
}

impl Default for Watchdog {
    fn default() -> Self {
        Self::new()
    }
}

impl Peripheral for Watchdog {
    fn registers(&self) -> &'static [Register] {
        &REGISTERS
    }

    fn read(&mut self, offset: u32, at: &Moment<'_>) -> Result<u32, Refusal> {
        let busy = |index: usize| u32::from(at.now < self.arrives[index]) << index;
        match offset {
            KR => refuse("can only be written"),
            SR => Ok(busy(0) | busy(1)),
            _ => self.bank.read(offset),
        }
    }

    fn write(&mut self, offset: u32, value: u32, at: &Moment<'_>) -> Result<(), Refusal> {
        match (offset, value) {
            (KR, START) => {
                self.is_open = false;
                let _ = self.since.get_or_insert(at.now);
                Ok(())
            }
            (KR, FEED) => {
                self.is_open = false;
                if self.is_running() {
                    self.since = Some(at.now);
                    self.feeds.push(at.now);
                }
                Ok(())
            }
            (KR, OPEN) => {
                self.is_open = true;
                Ok(())
            }
            (KR, _) => refuse("no key"),
            (WINR, _) => refuse("the window is not modelled"),
            (PR | RLR, _) if !self.is_open => refuse("without the key 5555"),
            (PR | RLR, _) => {
                let index = usize::from(offset == RLR);
                if at.now < self.arrives[index] {
                    return refuse("the value before is still on its way");
                }
                self.arrives[index] = at.now + 6 * cycle(LSI);
                self.bank.write(offset, value)
            }
            _ => self.bank.write(offset, value),
        }
    }

    fn deadline(&self, _: &Moment<'_>) -> Option<Picos> {
        self.bites()
    }

    fn reset(&mut self) {
        let feeds = std::mem::take(&mut self.feeds);
        *self = Self { feeds, ..Self::new() };
    }
}

const LSI: u32 = 32_000;
const START: u32 = 0xCCCC;
const FEED: u32 = 0xAAAA;
const OPEN: u32 = 0x5555;
