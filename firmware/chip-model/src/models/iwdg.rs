//! The independent watchdog. RM0433, "Independent watchdog".
//!
//! It counts cycles of LSI (32 kHz), which it switches on itself. PR and RLR may be written only after the
//! key 0x5555, and not while an earlier write is being transferred (PVU and RVU in SR).

use crate::device::*;

const KR: u32 = 0x00;
const PR: u32 = 0x04;
const RLR: u32 = 0x08;
const SR: u32 = 0x0C;
const WINR: u32 = 0x10;

static REGISTERS: [Register; 5] = [
    command(KR, "KR", 0xFFFF),
    read_write(PR, "PR", 0, 7),
    read_write(RLR, "RLR", 0xFFF, 0xFFF),
    read_only(SR, "SR", 0),
    read_write(WINR, "WINR", 0xFFF, 0xFFF),
];

/// The model.
#[derive(Debug)]
pub struct Watchdog {
    bank: Bank,
    is_unlocked: bool,
    /// When the countdown began; `None` if it was not started.
    since: Option<Picos>,
    /// When the last writes of PR and RLR take effect.
    updated_at: [Picos; 2],
    /// Times of all feeds.
    pub feeds: Vec<Picos>,
}

impl Watchdog {
    /// The state after power-on.
    pub fn new() -> Self {
        Self {
            bank: Bank::new(&REGISTERS),
            is_unlocked: false,
            since: None,
            updated_at: [0; 2],
            feeds: Vec::new(),
        }
    }

    /// Whether it was started.
    pub fn is_running(&self) -> bool {
        self.since.is_some()
    }

    /// Timeout without a feed.
    pub fn period(&self) -> Picos {
        let divider = 4_u64 << self.bank.get(PR).min(6);
        divider * Picos::from(self.bank.get(RLR) + 1) * cycle(LSI)
    }

    /// When it resets the chip.
    pub fn expires_at(&self) -> Option<Picos> {
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

    fn read(&mut self, offset: u32, at: &Context<'_>) -> Result<u32, Refusal> {
        let busy = |index: usize| u32::from(at.now < self.updated_at[index]) << index;
        match offset {
            KR => refuse("can only be written"),
            SR => Ok(busy(0) | busy(1)),
            _ => self.bank.read(offset),
        }
    }

    fn write(&mut self, offset: u32, value: u32, at: &Context<'_>) -> Result<(), Refusal> {
        match (offset, value) {
            (KR, START) => {
                self.is_unlocked = false;
                let _ = self.since.get_or_insert(at.now);
                Ok(())
            }
            (KR, FEED) => {
                self.is_unlocked = false;
                if self.is_running() {
                    self.since = Some(at.now);
                    self.feeds.push(at.now);
                }
                Ok(())
            }
            (KR, UNLOCK) => {
                self.is_unlocked = true;
                Ok(())
            }
            (KR, _) => refuse("an unknown key"),
            (WINR, _) => refuse("the window is not modelled"),
            (PR | RLR, _) if !self.is_unlocked => refuse("written without the key 5555"),
            (PR | RLR, _) => {
                let index = usize::from(offset == RLR);
                if at.now < self.updated_at[index] {
                    return refuse("an earlier write has not taken effect (PVU, RVU)");
                }
                self.updated_at[index] = at.now + 6 * cycle(LSI);
                self.bank.write(offset, value)
            }
            _ => self.bank.write(offset, value),
        }
    }

    fn deadline(&self, _: &Context<'_>) -> Option<Picos> {
        self.expires_at()
    }

    fn reset(&mut self) {
        let feeds = std::mem::take(&mut self.feeds);
        *self = Self { feeds, ..Self::new() };
    }
}

const LSI: u32 = 32_000;
const START: u32 = 0xCCCC;
const FEED: u32 = 0xAAAA;
const UNLOCK: u32 = 0x5555;
