//! A 16-bit general-purpose timer that counts up: TIM12, the program's time base. RM0433, "General-purpose
//! timers (TIM12/TIM13/TIM14)".
//!
//! Flags are cleared by writing zeros. The counter may be written only while it is stopped, which is all that the
//! program does.

use crate::device::*;

const CR1: u32 = 0x00;
const DIER: u32 = 0x0C;
const SR: u32 = 0x10;
const EGR: u32 = 0x14;
const CNT: u32 = 0x24;
const PSC: u32 = 0x28;
const ARR: u32 = 0x2C;
const CCR: [u32; 2] = [0x34, 0x38];

static REGISTERS: [Register; 10] = [
    read_write(CR1, "CR1", 0, 0xB8F),
    read_write(DIER, "DIER", 0, 0x47),
    read_write(SR, "SR", 0, 0x647),
    command(EGR, "EGR", 0x47),
    read_write(0x18, "CCMR1", 0, 0x0101_7F7F),
    read_write(CNT, "CNT", 0, 0xFFFF),
    read_write(PSC, "PSC", 0, 0xFFFF),
    read_write(ARR, "ARR", 0xFFFF, 0xFFFF),
    read_write(CCR[0], "CCR1", 0, 0xFFFF),
    read_write(CCR[1], "CCR2", 0, 0xFFFF),
];

/// The model.
#[derive(Debug)]
pub struct Timer {
    bank: Bank,
    /// When the counter was 0 for the first time.
    zero: Picos,
    /// Number of ticks since `zero` whose events have been handled.
    seen: u64,
    tick: Picos,
    /// The prescaler in effect: PSC is loaded at an update event.
    prescaler: u32,
}

impl Timer {
    /// The state after power-on.
    pub fn new() -> Self {
        Self { bank: Bank::new(&REGISTERS), zero: 0, seen: 0, tick: 1, prescaler: 0 }
    }

    fn runs(&self) -> bool {
        self.bank.get(CR1) & 1 != 0
    }

    fn ticks(&self, now: Picos) -> u64 {
        now.saturating_sub(self.zero) / self.tick
    }

    /// Counts that set a flag, with the flag: overflow and the compare channels.
    fn events(&self) -> [(u64, u32); 3] {
        let compare = |channel: usize| u64::from(self.bank.get(CCR[channel]));
        [(0, 1), (compare(0), 2), (compare(1), 4)]
    }

    fn update(&mut self, now: Picos) {
        if !self.runs() {
            return;
        }
        let (from, to) = (self.seen, self.ticks(now));
        // The number of times that the counter has reached `count`.
        let often = |ticks: u64, count: u64| (ticks + ROUND - count) / ROUND;
        let mut flags = self.bank.get(SR);
        for (count, flag) in self.events() {
            if often(to, count) > often(from, count) {
                flags |= flag;
            }
        }
        self.bank.set(SR, flags);
        self.seen = to;
    }
}

impl Default for Timer {
    fn default() -> Self {
        Self::new()
    }
}

impl Peripheral for Timer {
    fn registers(&self) -> &'static [Register] {
        &REGISTERS
    }

    fn read(&mut self, offset: u32, at: &Context<'_>) -> Result<u32, Refusal> {
        self.update(at.now);
        match offset {
            CNT if self.runs() => Ok((self.ticks(at.now) % ROUND) as u32),
            _ => self.bank.read(offset),
        }
    }

    fn write(&mut self, offset: u32, value: u32, at: &Context<'_>) -> Result<(), Refusal> {
        self.update(at.now);
        match offset {
            // Reserved bits may be written as ones.
            SR => {
                self.bank.set(SR, self.bank.get(SR) & value);
                return Ok(());
            }
            EGR => {
                self.bank.check(EGR, value)?;
                if value & 1 != 0 {
                    self.prescaler = self.bank.get(PSC);
                    self.bank.set(CNT, 0);
                    if self.bank.get(CR1) & 4 == 0 {
                        self.bank.set(SR, self.bank.get(SR) | 1);
                    }
                }
                return Ok(());
            }
            CNT if self.runs() => return refuse("writing a running counter is not modelled"),
            ARR if value != 0xFFFF => return refuse("only a period of 65536 is modelled"),
            CR1 if value & !5 != 0 => return refuse("modes other than counting up are not modelled"),
            CR1 if value & 1 != 0 && !self.runs() => {
                if at.clocks.timers == 0 {
                    return refuse("it has no clock");
                }
                self.tick = cycle(at.clocks.timers) * Picos::from(self.prescaler + 1);
                self.zero = at.now - self.tick * Picos::from(self.bank.get(CNT));
                self.seen = self.ticks(at.now);
            }
            CR1 if value & 1 == 0 && self.runs() => {
                let count = (self.ticks(at.now) % ROUND) as u32;
                self.bank.set(CNT, count);
            }
            _ => {}
        }
        self.bank.write(offset, value)
    }

    fn advance(&mut self, at: &Context<'_>) -> Result<(), Refusal> {
        self.update(at.now);
        Ok(())
    }

    fn deadline(&self, at: &Context<'_>) -> Option<Picos> {
        let wanted = self.bank.get(DIER) & !self.bank.get(SR);
        if !self.runs() {
            return None;
        }
        let ticks = self.ticks(at.now);
        let next = self.events().into_iter().filter(|(_, flag)| wanted & flag != 0).map(|(count, _)| {
            let to_go = (count + ROUND - ticks % ROUND) % ROUND;
            self.zero + self.tick * (ticks + if to_go == 0 { ROUND } else { to_go })
        });
        next.min()
    }

    fn accepts_halfwords(&self) -> bool {
        true
    }

    fn interrupt_line(&self) -> bool {
        self.bank.get(SR) & self.bank.get(DIER) & 7 != 0
    }

    fn reset(&mut self) {
        *self = Self::new();
    }
}

const ROUND: u64 = 0x1_0000;

#[cfg(test)]
mod tests {
    use super::*;

    fn context(now: Picos) -> Context<'static> {
        static NONE: Functions = [[None; 16]; 11];
        let clocks = Clocks { timers: 200_000_000, ..Clocks::default() };
        Context { now, clocks, functions: &NONE, is_rmii: false }
    }

    #[test]
    fn a_compare_match_is_due_at_its_count_and_once_a_round() {
        let mut timer = Timer::new();
        for (register, value) in [(PSC, 199), (EGR, 1), (SR, 0), (CCR[0], 300), (DIER, 2), (CR1, 1)] {
            timer.write(register, value, &context(0)).expect("allowed");
        }
        assert_eq!(timer.deadline(&context(0)), Some(300 * MICRO));
        timer.advance(&context(300 * MICRO - 1)).expect("nothing is due");
        assert!(!timer.interrupt_line());
        timer.advance(&context(300 * MICRO)).expect("it is due");
        assert!(timer.interrupt_line());
        timer.write(SR, !2, &context(300 * MICRO)).expect("allowed");
        assert_eq!(timer.deadline(&context(300 * MICRO)), Some((65_536 + 300) * MICRO));
    }
}
