//! RCC: oscillators, PLL1, the clock tree, clock gates and resets. RM0433, "Reset and clock control".
//!
//! Writes that the hardware ignores are ignored (PLLSRC and DIVM1 while PLL1 is on). Refused: a switch of the
//! system clock to a clock that is not ready, and accesses to a peripheral whose clock is off or that is held
//! in reset. Enabling a clock takes two bus cycles ("Peripheral clock gating"), so a read must come between
//! that and the first access.

mod registers;
mod tree;

use self::registers::*;
use crate::device::*;

/// The clock enable of a peripheral.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Gate {
    /// Offset of the enable register.
    pub enable: u32,
    /// Its bits, of which all must be set.
    pub bits: u32,
}

impl Gate {
    /// Offset of the reset register, in which the peripheral has the same bits.
    fn reset(self) -> u32 {
        self.enable - 0x58
    }
}

/// Why the chip is reset while its supply stays on.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Cause {
    /// The independent watchdog was not fed.
    Watchdog,
    /// The program asked for it (SYSRESETREQ).
    Program,
}

/// The model.
#[derive(Debug)]
pub struct Rcc {
    bank: Bank,
    /// Whether the board provides the external 8 MHz clock.
    pub has_external: bool,
    /// Ready flag of each oscillator, and when it is set.
    ready: [(u32, Picos); 5],
    low_speed: Option<Picos>,
    /// Clocks that were enabled, with no read since.
    fresh: Option<Gate>,
}

/// Oscillators in CR: enable bit, ready flag, start-up time (datasheet DS12110).
const OSCILLATORS: [(u32, u32, Picos); 5] =
    [(0, 2, 2 * MICRO), (7, 8, 3 * MICRO), (12, 13, 4 * MICRO), (16, 17, 2 * MICRO), (24, 25, 100 * MICRO)];
/// PINRSTF and CPURSTF: each reset of the system pulls the pin NRST.
const PIN_AND_CPU: u32 = 1 << 22 | 1 << 17;
/// HSEBYP.
const BYPASS: u32 = 1 << 18;
/// Longest start-up time of LSI.
const LOW_SPEED: Picos = 130 * MICRO;

impl Rcc {
    /// The state after power-on.
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

    /// A reset while the supply stays on: its flags join those in RSR that were not cleared ("Reset source
    /// identification").
    pub fn reset_by(&mut self, cause: Cause) {
        let flag = match cause {
            Cause::Watchdog => 1 << 26,
            Cause::Program => 1 << 24,
        };
        let causes = self.bank.get(RSR) | flag | PIN_AND_CPU;
        self.reset();
        self.bank.set(RSR, causes);
    }

    /// Checks that a peripheral may be accessed.
    ///
    /// # Errors
    /// Its clock is off or was enabled just now, or it is held in reset.
    pub fn check(&self, gate: Gate) -> Result<(), Refusal> {
        if self.bank.get(gate.enable) & gate.bits != gate.bits {
            return refuse("its clock is off");
        }
        if self.bank.get(gate.reset()) & gate.bits != 0 {
            return refuse("it is held in reset");
        }
        if self.fresh.is_some_and(|fresh| fresh.enable == gate.enable && fresh.bits & gate.bits != 0) {
            return refuse("its clock was enabled just before: a read must come first");
        }
        Ok(())
    }

    /// Notes a read: clocks that were enabled before it are running now.
    pub fn settle(&mut self) {
        self.fresh = None;
    }

    /// Whether LSI is ready.
    pub fn low_speed_runs(&self, now: Picos) -> bool {
        self.low_speed.is_some_and(|ready| now >= ready)
    }

    /// Whether a peripheral is held in reset.
    pub fn is_held(&self, gate: Gate) -> bool {
        self.bank.get(gate.reset()) & gate.bits != 0
    }

    /// Starts LSI, unless it runs.
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
                // The board has an external clock, not a crystal.
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
        // D1CKRDY and D2CKRDY.
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

    fn read(&mut self, offset: u32, at: &Context<'_>) -> Result<u32, Refusal> {
        let value = self.bank.read(offset)?;
        Ok(match offset {
            CR => value | self.ready_flags(at.now),
            CSR => value | u32::from(self.low_speed_runs(at.now)) << 1,
            BDCR => value | (value & 1) << 1,
            _ => value,
        })
    }

    fn write(&mut self, offset: u32, value: u32, at: &Context<'_>) -> Result<(), Refusal> {
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
                // PLLSRC and DIVM1 are locked while PLL1 is on.
                let locked = if self.bank.get(CR) & 1 << 24 != 0 { 0x3F3 } else { 0 };
                let value = value & !locked | self.bank.get(PLLCKSELR) & locked;
                self.bank.write(PLLCKSELR, value)
            }
            PLLCFGR | PLL1DIVR if self.bank.get(CR) & 1 << 24 != 0 => {
                // Only fields of PLL2 and PLL3 may change.
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
