//! RCC: oscillators, PLL1, the clock tree, clock gates and resets. RM0433, "Reset and clock
//! control".
//!
//! Strict: writes that the hardware ignores are ignored here too (PLLSRC and DIVM1 while a PLL runs,
//! at PLLCKSELR); the system clock is switched only to a clock that is ready (at CFGR.SW). A peripheral may
//! be used when its clock is on and its reset is not; and not right behind the write that switched it on,
//! which takes two cycles of its bus ("Peripheral clock gating"): something has to be read in between.

mod registers;
mod tree;

use self::registers::*;
use crate::device::*;

/// What has to be on before a peripheral may be used: the enable register's offset, and the bits.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Gate {
    /// RCC's register.
    pub enable: u32,
    /// All of them.
    pub bits: u32,
}

impl Gate {
    /// The reset register has the peripheral at the same bit.
    fn reset(self) -> u32 {
        self.enable - 0x58
    }
}

/// The model.
#[derive(Debug)]
pub struct Rcc {
    bank: Bank,
    /// The board's 8 MHz arrive.
    pub has_external: bool,
    /// When each oscillator is ready; by the place of its ready flag.
    ready: [(u32, Picos); 5],
    low_speed: Option<Picos>,
    /// Just switched on, with nothing read since.
    fresh: Option<Gate>,
}

/// The bits of oscillators in CR: on, ready, and how long it takes (datasheet DS12110, 6.3.9 to 6.3.11).
const OSCILLATORS: [(u32, u32, Picos); 5] =
    [(0, 2, 2 * MICRO), (7, 8, 3 * MICRO), (12, 13, 4 * MICRO), (16, 17, 2 * MICRO), (24, 25, 100 * MICRO)];
/// HSEBYP.
const BYPASS: u32 = 1 << 18;
/// LSI, longest.
const LOW_SPEED: Picos = 130 * MICRO;

impl Rcc {
    /// As after power came.
    pub fn new() -> Self {
        let mut rcc = Self {
            bank: Bank::new(&REGISTERS),
            has_external: true,
            ready: OSCILLATORS.map(|(_, ready, _)| (ready, Picos::MAX)),
            low_speed: None,
            fresh: None,
        };
        rcc.reset();
        rcc
    }

    /// The watchdog's reset: its flag is set (RSR).
    pub fn reset_by_watchdog(&mut self) {
        let causes = self.bank.get(RSR) | 1 << 26;
        self.reset();
        self.bank.set(RSR, causes);
    }

    /// Whether a peripheral may be used now.
    ///
    /// # Errors
    /// Why not.
    pub fn check(&self, gate: Gate) -> Result<(), Refusal> {
        if self.bank.get(gate.enable) & gate.bits != gate.bits {
            return refuse("its clock is off");
        }
        if self.bank.get(gate.reset()) & gate.bits != 0 {
            return refuse("it is held in reset");
        }
        if self.fresh.is_some_and(|fresh| fresh.enable == gate.enable && fresh.bits & gate.bits != 0) {
            return refuse("its clock was switched on right before: read something back first");
        }
        Ok(())
    }

    /// Something was read: a clock that was switched on before runs.
    pub fn settle(&mut self) {
        self.fresh = None;
    }

    /// Whether LSI runs, which the watchdog needs.
    pub fn low_speed_runs(&self, now: Picos) -> bool {
        self.low_speed.is_some_and(|ready| now >= ready)
    }

    /// Whether the peripheral is held in reset.
    pub fn is_held(&self, gate: Gate) -> bool {
        self.bank.get(gate.reset()) & gate.bits != 0
    }

    /// The watchdog switches LSI on.
    pub fn start_low_speed(&mut self, now: Picos) {
        let _ = self.low_speed.get_or_insert(now + LOW_SPEED);
    }

    fn is_ready(&self, flag: u32, now: Picos) -> bool {
        self.ready.iter().any(|&(ready, from)| ready == flag && now >= from)
    }

    fn write_oscillators(&mut self, value: u32, now: Picos) -> Result<(), Refusal> {
        let before = self.bank.get(CR);
        let changed = before ^ value;
        let in_use = self.bank.get(CFGR) >> 3 & 7;
        for (index, &(on, flag, time)) in OSCILLATORS.iter().enumerate() {
            if changed >> on & 1 == 0 {
                continue;
            }
            if value >> on & 1 == 0 {
                let of_system = [0, 1, 9, 2, 3][index];
                if in_use == of_system {
                    return refuse("the system clock's source is switched off");
                }
                self.ready[index].1 = Picos::MAX;
                continue;
            }
            let runs = match flag {
                // What arrives is a clock and no crystal.
                17 => self.has_external && value & BYPASS != 0,
                25 => self.check_pll(now).map(|()| true)?,
                _ => true,
            };
            if runs {
                self.ready[index].1 = now + time;
            }
        }
        if changed & BYPASS != 0 && before & 1 << 16 != 0 && value & 1 << 16 != 0 {
            return refuse("HSEBYP is changed while HSE is on");
        }
        if value & (1 << 26 | 1 << 28) != 0 {
            return refuse("PLL2 and PLL3 are not modelled");
        }
        self.bank.set(CR, value);
        Ok(())
    }

    fn ready_flags(&self, now: Picos) -> u32 {
        let ready = self.ready.iter().filter(|(_, from)| now >= *from);
        // The clocks of both domains run as soon as there is one.
        ready.fold(1 << 14 | 1 << 15, |flags, (flag, _)| flags | 1 << flag)
    }
}

impl Default for Rcc {
    fn default() -> Self {
        Self::new()
    }
}

impl Peripheral for Rcc {
    fn registers(&self) -> &'static [Register] {
        &REGISTERS
    }

    fn read(&mut self, offset: u32, at: &Moment<'_>) -> Result<u32, Refusal> {
        let value = self.bank.read(offset)?;
        Ok(match offset {
            CR => value | self.ready_flags(at.now),
            CSR => value | u32::from(self.low_speed_runs(at.now)) << 1,
            BDCR => value | (value & 1) << 1,
            _ => value,
        })
    }

    fn write(&mut self, offset: u32, value: u32, at: &Moment<'_>) -> Result<(), Refusal> {
        match offset {
            CR => {
                let value = value & !0x2A02_E124;
                self.bank.check(CR, value)?;
                self.write_oscillators(value, at.now)
            }
            CFGR => {
                let value = value & !0x38 | self.bank.get(CFGR) & 0x38;
                self.bank.check(CFGR, value)?;
                let (name, flag) = [("HSI", 2), ("CSI", 8), ("HSE", 17), ("PLL1", 25)]
                    .get(value as usize & 7)
                    .copied()
                    .ok_or_else(|| Refusal("SW names no clock".into()))?;
                if !self.is_ready(flag, at.now) {
                    return refuse(format!("the system clock is switched to {name}, which is not ready"));
                }
                self.bank.set(CFGR, value & !0x38 | (value & 7) << 3);
                Ok(())
            }
            PLLCKSELR => {
                // What is locked while PLL1 is on stays as it is (PLLSRC, DIVM1).
                let locked = if self.bank.get(CR) & 1 << 24 != 0 { 0x3F3 } else { 0 };
                let value = value & !locked | self.bank.get(PLLCKSELR) & locked;
                self.bank.write(PLLCKSELR, value)
            }
            PLLCFGR | PLL1DIVR if self.bank.get(CR) & 1 << 24 != 0 => {
                // Only what belongs to PLL2 and PLL3 may change.
                let changed = value ^ self.bank.get(offset);
                if offset == PLL1DIVR || changed & 0x7_000F != 0 {
                    return refuse("PLL1 is on");
                }
                self.bank.write(offset, value)
            }
            CSR => {
                let value = value & !2;
                self.bank.write(CSR, value)?;
                if value & 1 != 0 {
                    self.start_low_speed(at.now);
                }
                Ok(())
            }
            BDCR => self.bank.write(BDCR, value & !2),
            RSR => {
                if value & 1 << 16 != 0 {
                    self.bank.set(RSR, 0);
                }
                Ok(())
            }
            _ => {
                let before = self.bank.read(offset)?;
                self.bank.write(offset, value)?;
                if ENABLES.contains(&offset) && value & !before != 0 {
                    self.fresh = Some(Gate { enable: offset, bits: value & !before });
                }
                debug_assert!(!RESETS.contains(&offset) || !ENABLES.contains(&offset));
                Ok(())
            }
        }
    }

    fn reset(&mut self) {
        self.bank = Bank::new(&REGISTERS);
        self.ready = OSCILLATORS.map(|(_, ready, _)| (ready, Picos::MAX));
        self.ready[0].1 = 0;
        self.low_speed = None;
        self.fresh = None;
    }
}
