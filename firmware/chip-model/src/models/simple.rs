//! Small models. RM0433, "Power control", "System configuration controller", "Debug infrastructure"
//! (DBGMCU), "AXI interconnect", "True random number generator".

use crate::device::*;

/// PWR: the supply and the core voltage. VOSRDY is set some time after a voltage range was selected; until then
/// the clocks must not get faster.
#[derive(Debug)]
pub struct Pwr {
    bank: Bank,
    ready: Picos,
}

const PWR_CR3: u32 = 0x0C;
const PWR_CSR1: u32 = 0x04;
const PWR_D3CR: u32 = 0x18;
static PWR: [Register; 6] = [
    read_write(0x00, "CR1", 0xF000_C000, 0x7_C3F1),
    read_only(PWR_CSR1, "CSR1", 0x4000),
    read_write(0x08, "CR2", 0, 0x11),
    read_write(PWR_CR3, "CR3", 0x46, 0x0300_0307),
    read_write(0x10, "CPUCR", 0, 0xA07),
    read_write(PWR_D3CR, "D3CR", 0x4000, 0xC000),
];

impl Pwr {
    /// The state after power-on.
    pub fn new() -> Self {
        Self { bank: Bank::new(&PWR), ready: 0 }
    }

    /// The highest core clock for the core voltage (datasheet DS12110, "General operating conditions"), in Hz.
    pub fn fastest(&self, now: Picos) -> u32 {
        let range = if now >= self.ready { self.bank.get(PWR_D3CR) >> 14 } else { 1 };
        [0, 200_000_000, 300_000_000, 400_000_000][range as usize & 3]
    }
}

impl Default for Pwr {
    fn default() -> Self {
        Self::new()
    }
}

impl Peripheral for Pwr {
    fn registers(&self) -> &'static [Register] {
        &PWR
    }

    fn read(&mut self, offset: u32, at: &Context<'_>) -> Result<u32, Refusal> {
        let ready = u32::from(at.now >= self.ready) << 13;
        Ok(self.bank.read(offset)? | if matches!(offset, PWR_CSR1 | PWR_D3CR) { ready } else { 0 })
    }

    fn write(&mut self, offset: u32, value: u32, at: &Context<'_>) -> Result<(), Refusal> {
        if offset == PWR_D3CR {
            if value >> 14 & 3 == 0 {
                return refuse("VOS 00 is reserved");
            }
            self.bank.write(offset, value & !(1 << 13))?;
            self.ready = at.now + 20 * MICRO;
            return Ok(());
        }
        self.bank.write(offset, value)
    }

    fn reset(&mut self) {
        *self = Self::new();
    }
}

/// SYSCFG: only the selection of MII or RMII has an effect; it must precede the MAC's software reset.
#[derive(Debug)]
pub struct Syscfg(Bank);

const PMCR: u32 = 0x04;
static SYSCFG: [Register; 2] =
    [read_write(PMCR, "PMCR", 0x0F00_0000, 0x0FE0_03FF), read_write(0x20, "CCCSR", 0, 0x1_0003)];

impl Syscfg {
    /// The state after power-on.
    pub fn new() -> Self {
        Self(Bank::new(&SYSCFG))
    }

    /// Whether RMII is selected.
    pub fn is_rmii(&self) -> bool {
        self.0.get(PMCR) >> 21 & 7 == 4
    }
}

impl Default for Syscfg {
    fn default() -> Self {
        Self::new()
    }
}

impl Peripheral for Syscfg {
    fn registers(&self) -> &'static [Register] {
        &SYSCFG
    }

    fn read(&mut self, offset: u32, _: &Context<'_>) -> Result<u32, Refusal> {
        self.0.read(offset)
    }

    fn write(&mut self, offset: u32, value: u32, _: &Context<'_>) -> Result<(), Refusal> {
        self.0.write(offset, value)
    }

    fn reset(&mut self) {
        *self = Self::new();
    }
}

/// Registers that hold what is written, without effect.
#[derive(Debug)]
pub struct Plain(Bank, &'static [Register]);

/// DBGMCU: an STM32H743 of revision V.
pub static DBGMCU: [Register; 3] = [
    read_only(0x00, "IDC", 0x2003_6450),
    read_write(0x04, "CR", 0, 0x1060_01BF),
    read_write(0x54, "APB4FZR1", 0, 0x5_7E00),
];

/// The AXI interconnect: the read issuing capability of the SRAM's port, for revision Y (errata ES0392).
pub static AXI: [Register; 1] = [read_write(0x108, "TARG7_FN_MOD", 0, 3)];

impl Plain {
    /// The value of a register.
    pub fn get(&self, offset: u32) -> u32 {
        self.0.get(offset)
    }

    /// Sets a register until the next reset, to model another chip.
    pub fn put(&mut self, offset: u32, value: u32) {
        self.0.set(offset, value);
    }

    /// The state after power-on.
    pub fn new(registers: &'static [Register]) -> Self {
        Self(Bank::new(registers), registers)
    }
}

impl Peripheral for Plain {
    fn registers(&self) -> &'static [Register] {
        self.1
    }

    fn read(&mut self, offset: u32, _: &Context<'_>) -> Result<u32, Refusal> {
        self.0.read(offset)
    }

    fn write(&mut self, offset: u32, value: u32, _: &Context<'_>) -> Result<(), Refusal> {
        self.0.write(offset, value)
    }

    fn reset(&mut self) {
        self.0 = Bank::new(self.1);
    }
}

/// The random number generator. A word takes 40 cycles of its clock, the first one longer. The numbers are the
/// same in every run. DR must not be read before DRDY is set.
#[derive(Debug)]
pub struct Rng {
    bank: Bank,
    ready: Option<Picos>,
    word: u32,
}

const RNG_CR: u32 = 0x00;
const RNG_SR: u32 = 0x04;
const RNG_DR: u32 = 0x08;
static RNG: [Register; 3] =
    [read_write(RNG_CR, "CR", 0, 0x2C), command(RNG_SR, "SR", 0x60), read_only(RNG_DR, "DR", 0)];

impl Rng {
    /// The state after power-on.
    pub fn new() -> Self {
        Self { bank: Bank::new(&RNG), ready: None, word: 0x1234_5678 }
    }
}

impl Default for Rng {
    fn default() -> Self {
        Self::new()
    }
}

impl Peripheral for Rng {
    fn registers(&self) -> &'static [Register] {
        &RNG
    }

    fn read(&mut self, offset: u32, at: &Context<'_>) -> Result<u32, Refusal> {
        let is_ready = self.ready.is_some_and(|ready| at.now >= ready);
        match offset {
            RNG_SR => Ok(u32::from(is_ready)),
            RNG_DR if !is_ready => refuse("no number is ready (SR.DRDY)"),
            RNG_DR => {
                self.word = self.word.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
                self.ready = Some(at.now + 40 * cycle(at.clocks.rng));
                Ok(self.word)
            }
            _ => self.bank.read(offset),
        }
    }

    fn write(&mut self, offset: u32, value: u32, at: &Context<'_>) -> Result<(), Refusal> {
        self.bank.write(offset, value)?;
        if offset == RNG_CR {
            self.ready = match (value & 4 != 0, at.clocks.rng) {
                (true, 0) => return refuse("its kernel clock is off"),
                (true, clock) => Some(at.now + 412 * cycle(clock)),
                (false, _) => None,
            };
        }
        Ok(())
    }

    fn reset(&mut self) {
        let word = self.word;
        *self = Self::new();
        self.word = word;
    }
}
