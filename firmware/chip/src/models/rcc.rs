//! RCC: oscillators, PLL1, the clock tree, clock gates and resets. RM0433, "Reset and clock
//! control".
//!
//! Strict: writes that the hardware ignores are ignored here too (PLLSRC and DIVM1 while a PLL runs,
//! at PLLCKSELR); the system clock is switched only to a clock that is ready (at CFGR.SW). A peripheral may
//! be used when its clock is on and its reset is not; and not right behind the write that switched it on,
//! which takes two cycles of its bus ("Peripheral clock gating"): something has to be read in between.

use crate::device::*;

const CR: u32 = 0x00;
const CFGR: u32 = 0x10;
const D1CFGR: u32 = 0x18;
const D2CFGR: u32 = 0x1C;
const PLLCKSELR: u32 = 0x28;
const PLLCFGR: u32 = 0x2C;
const PLL1DIVR: u32 = 0x30;
const D2CCIP1R: u32 = 0x50;
const D2CCIP2R: u32 = 0x54;
const BDCR: u32 = 0x70;
const CSR: u32 = 0x74;
const RSR: u32 = 0xD0;
const RESETS: std::ops::RangeInclusive<u32> = 0x7C..=0x9C;
const ENABLES: std::ops::RangeInclusive<u32> = 0xD4..=0xF4;

static REGISTERS: [Register; 34] = [
    keeps(CR, "CR", 0x83, 0x150D_129B),
    keeps(CFGR, "CFGR", 0, 0xFFFC_FFC7),
    keeps(D1CFGR, "D1CFGR", 0, 0xF7F),
    keeps(D2CFGR, "D2CFGR", 0, 0x770),
    keeps(0x20, "D3CFGR", 0, 0x70),
    keeps(PLLCKSELR, "PLLCKSELR", 0x0202_0200, 0x03F3_F3F3),
    keeps(PLLCFGR, "PLLCFGR", 0x01FF_0000, 0x01FF_0FFF),
    keeps(PLL1DIVR, "PLL1DIVR", 0x0101_0280, 0x7F7F_FFFF),
    keeps(0x38, "PLL2DIVR", 0x0101_0280, 0x7F7F_FFFF),
    keeps(0x40, "PLL3DIVR", 0x0101_0280, 0x7F7F_FFFF),
    keeps(0x4C, "D1CCIPR", 0, 0x3001_0033),
    keeps(D2CCIP1R, "D2CCIP1R", 0, 0xB137_71C7),
    keeps(D2CCIP2R, "D2CCIP2R", 0, 0x70F0_333F),
    keeps(0x58, "D3CCIPR", 0, 0x77E3_FF07),
    keeps(BDCR, "BDCR", 0, 0x1_837D),
    keeps(CSR, "CSR", 0, 1),
    keeps(0x7C, "AHB3RSTR", 0, 0x8001_5031),
    keeps(0x80, "AHB1RSTR", 0, 0x0A00_8023),
    keeps(0x84, "AHB2RSTR", 0, 0x271),
    keeps(0x88, "AHB4RSTR", 0, 0x0328_07FF),
    keeps(0x8C, "APB3RSTR", 0, 0x8),
    keeps(0x90, "APB1LRSTR", 0, 0xE8FF_C3FF),
    keeps(0x94, "APB1HRSTR", 0, 0x136),
    keeps(0x98, "APB2RSTR", 0, 0x31D7_3033),
    keeps(0x9C, "APB4RSTR", 0, 0x0020_DEAA),
    keeps(RSR, "RSR", 0x00FE_0000, 1 << 16),
    keeps(0xD4, "AHB3ENR", 0, 0x0001_5031),
    keeps(0xD8, "AHB1ENR", 0, 0x1E03_8023),
    keeps(0xDC, "AHB2ENR", 0, 0xE000_0271),
    keeps(0xE0, "AHB4ENR", 0, 0x1328_07FF),
    keeps(0xE4, "APB3ENR", 0, 0x48),
    keeps(0xE8, "APB1LENR", 0, 0xE8FF_CBFF),
    keeps(0xEC, "APB1HENR", 0, 0x136),
    keeps(0xF4, "APB4ENR", 0, 0x0021_DEAA),
];

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

    /// HSI, by its divider.
    fn internal(&self) -> u32 {
        64_000_000 >> (self.bank.get(CR) >> 3 & 3)
    }

    fn pll_input(&self) -> u32 {
        let select = self.bank.get(PLLCKSELR);
        let source = match select & 3 {
            0 => self.internal(),
            1 => 4_000_000,
            2 => 8_000_000,
            _ => 0,
        };
        source.checked_div(select >> 4 & 0x3F).unwrap_or(0)
    }

    /// PLL1's outputs P and Q.
    fn pll(&self) -> (u32, u32) {
        let (config, dividers) = (self.bank.get(PLLCFGR), self.bank.get(PLL1DIVR));
        let vco = u64::from(self.pll_input()) * u64::from((dividers & 0x1FF) + 1);
        let output = |enabled: u32, place: u32| {
            if config >> enabled & 1 == 0 {
                0
            } else {
                (vco / u64::from((dividers >> place & 0x7F) + 1)) as u32
            }
        };
        (output(16, 9), output(17, 16))
    }

    /// What runs how fast ("Core and bus clock generation").
    pub fn clocks(&self) -> Clocks {
        let (p, q) = self.pll();
        let system = match self.bank.get(CFGR) >> 3 & 7 {
            0 => self.internal(),
            1 => 4_000_000,
            2 => 8_000_000,
            _ => p,
        };
        let halves = |code: u32| if code & 8 == 0 { 0 } else { [1, 2, 3, 4, 6, 7, 8, 9][code as usize & 7] };
        let domain1 = self.bank.get(D1CFGR);
        let core = system >> halves(domain1 >> 8 & 0xF);
        let hclk = core >> halves(domain1 & 0xF);
        let apb1 = match self.bank.get(D2CFGR) >> 4 & 7 {
            code if code & 4 == 0 => 0,
            code => (code & 3) + 1,
        };
        let pclk1 = hclk >> apb1;
        let usart = match self.bank.get(D2CCIP2R) & 7 {
            0 => pclk1,
            3 => self.internal(),
            4 => 4_000_000,
            _ => 0,
        };
        let fdcan = match self.bank.get(D2CCIP1R) >> 28 & 3 {
            0 => 8_000_000,
            1 => q,
            _ => 0,
        };
        let rng = match self.bank.get(D2CCIP2R) >> 8 & 3 {
            0 if self.bank.get(CR) & 1 << 12 != 0 => 48_000_000,
            1 => q,
            _ => 0,
        };
        Clocks {
            core,
            hclk,
            timers: if apb1 < 2 { hclk } else { 2 * pclk1 },
            usart,
            fdcan,
            rng,
            is_external: self.has_external,
        }
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

    /// What the datasheet asks of PLL1 ("PLL characteristics") before it is switched on.
    fn check_pll(&self, now: Picos) -> Result<(), Refusal> {
        let (source, flag) = match self.bank.get(PLLCKSELR) & 3 {
            0 => ("HSI", 2),
            1 => ("CSI", 8),
            2 => ("HSE", 17),
            _ => return refuse("PLL1 has no source"),
        };
        if !self.is_ready(flag, now) {
            return refuse(format!("PLL1 is switched on before {source} is ready"));
        }
        let (input, config) = (self.pll_input(), self.bank.get(PLLCFGR));
        let range = match config >> 2 & 3 {
            0 => 1_000_000..=2_000_000,
            1 => 2_000_000..=4_000_000,
            2 => 4_000_000..=8_000_000,
            _ => 8_000_000..=16_000_000,
        };
        if !range.contains(&input) {
            return refuse(format!("PLL1's input of {input} Hz is not in the range of PLL1RGE"));
        }
        let vco = u64::from(input) * u64::from((self.bank.get(PLL1DIVR) & 0x1FF) + 1);
        let range = if config & 2 == 0 { 192_000_000..=836_000_000 } else { 150_000_000..=420_000_000 };
        if !range.contains(&vco) {
            return refuse(format!("PLL1's VCO would run at {vco} Hz"));
        }
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
