//! The clock tree: its frequencies, and the limits of PLL1.

use super::Rcc;
use super::registers::*;
use crate::device::*;

impl Rcc {
    /// The present frequencies (RM0433, "Core and bus clock generation").
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

    /// Checks the settings of PLL1 when it is enabled (datasheet DS12110, "PLL characteristics").
    pub(super) fn check_pll(&self, now: Picos) -> Result<(), Refusal> {
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

    /// HSI after its divider.
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
}
