//! Small ones, after the chapters of RM0433: "Power control", "System configuration controller", "Debug
//! infrastructure" (DBGMCU), "Extended interrupt and event controller", "AXI interconnect",
//! "True random number generator".

use crate::device::*;

/// PWR: the supply and the core's voltage. VOSRDY comes some time after the range was chosen, in which the
/// clocks must not get faster.
#[derive(Debug)]
pub struct Pwr {
    bank: Bank,
    ready: Picos,
}

const PWR_CR3: u32 = 0x0C;
const PWR_CSR1: u32 = 0x04;
const PWR_D3CR: u32 = 0x18;
static PWR: [Register; 6] = [
    keeps(0x00, "CR1", 0xF000_C000, 0x7_C3F1),
    reads(PWR_CSR1, "CSR1", 0x4000),
    keeps(0x08, "CR2", 0, 0x11),
    keeps(PWR_CR3, "CR3", 0x46, 0x0300_0307),
    keeps(0x10, "CPUCR", 0, 0xA07),
    keeps(PWR_D3CR, "D3CR", 0x4000, 0xC000),
];

impl Pwr {
    /// As after power came.
    pub fn new() -> Self {
        Self { bank: Bank::new(&PWR), ready: 0 }
    }

    /// The fastest that the core may be by the voltage (datasheet DS12110, "General operating conditions"), in Hz.
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

    fn read(&mut self, offset: u32, at: &Moment<'_>) -> Result<u32, Refusal> {
        let ready = u32::from(at.now >= self.ready) << 13;
        Ok(self.bank.read(offset)? | if matches!(offset, PWR_CSR1 | PWR_D3CR) { ready } else { 0 })
    }

    fn write(&mut self, offset: u32, value: u32, at: &Moment<'_>) -> Result<(), Refusal> {
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

/// SYSCFG: of it only the choice of MII or RMII matters, which is made before the MAC leaves its reset.
#[derive(Debug)]
pub struct Syscfg(Bank);

const PMCR: u32 = 0x04;
static SYSCFG: [Register; 2] =
    [keeps(PMCR, "PMCR", 0x0F00_0000, 0x0FE0_03FF), keeps(0x20, "CCCSR", 0, 0x1_0003)];

impl Syscfg {
    /// As after power came.
    pub fn new() -> Self {
        Self(Bank::new(&SYSCFG))
    }

    /// RMII is chosen.
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

    fn read(&mut self, offset: u32, _: &Moment<'_>) -> Result<u32, Refusal> {
        self.0.read(offset)
    }

    fn write(&mut self, offset: u32, value: u32, _: &Moment<'_>) -> Result<(), Refusal> {
        self.0.write(offset, value)
    }

    fn reset(&mut self) {
        *self = Self::new();
    }
}

/// Registers that only keep what is written.
#[derive(Debug)]
pub struct Plain(Bank, &'static [Register]);

/// DBGMCU: an STM32H743 of revision V.
pub static DBGMCU: [Register; 3] = [
    reads(0x00, "IDC", 0x2003_6450),
    keeps(0x04, "CR", 0, 0x1060_01BF),
    keeps(0x54, "APB4FZR1", 0, 0x5_7E00),
];

/// EXTI: the board uses none of its lines.
pub static EXTI: [Register; 2] =
    [keeps(0x00, "RTSR1", 0, 0x3F_FFFF), keeps(0x80, "CPUIMR1", 0xFFC0_0000, !0)];

/// The AXI interconnect: how the SRAM is read, for chips of revision Y (errata ES0392).
pub static AXI: [Register; 1] = [keeps(0x108, "TARG7_FN_MOD", 0, 3)];

impl Plain {
    /// What a register holds.
    pub fn get(&self, offset: u32) -> u32 {
        self.0.get(offset)
    }

    /// Another chip: the register holds something else, until a reset.
    pub fn put(&mut self, offset: u32, value: u32) {
        self.0.set(offset, value);
    }

    /// As after power came.
    pub fn new(registers: &'static [Register]) -> Self {
        Self(Bank::new(registers), registers)
    }
}

impl Peripheral for Plain {
    fn registers(&self) -> &'static [Register] {
        self.1
    }

    fn read(&mut self, offset: u32, _: &Moment<'_>) -> Result<u32, Refusal> {
        self.0.read(offset)
    }

    fn write(&mut self, offset: u32, value: u32, _: &Moment<'_>) -> Result<(), Refusal> {
        self.0.write(offset, value)
    }

    fn reset(&mut self) {
        self.0 = Bank::new(self.1);
    }
}

/// The random number generator: a word takes 40 cycles of its clock after the first, which takes longer.
/// Its numbers are the same in every run. DR must not be read before DRDY says that there is one.
#[derive(Debug)]
pub struct Rng {
    bank: Bank,
    ready: Option<Picos>,
    word: u32,
}

const RNG_CR: u32 = 0x00;
const RNG_SR: u32 = 0x04;
const RNG_DR: u32 = 0x08;
static RNG: [Register; 3] = [keeps(RNG_CR, "CR", 0, 0x2C), does(RNG_SR, "SR", 0x60), reads(RNG_DR, "DR", 0)];

impl Rng {
    /// As after power came.
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

    fn read(&mut self, offset: u32, at: &Moment<'_>) -> Result<u32, Refusal> {
        let is_ready = self.ready.is_some_and(|ready| at.now >= ready);
        match offset {
            RNG_SR => Ok(u32::from(is_ready)),
            RNG_DR if !is_ready => refuse("there is no number yet (SR.DRDY)"),
            RNG_DR => {
                self.word = self.word.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
                self.ready = Some(at.now + 40 * cycle(at.clocks.rng));
                Ok(self.word)
            }
            _ => self.bank.read(offset),
        }
    }

    fn write(&mut self, offset: u32, value: u32, at: &Moment<'_>) -> Result<(), Refusal> {
        self.bank.write(offset, value)?;
        if offset == RNG_CR {
            self.ready = match (value & 4 != 0, at.clocks.rng) {
                (true, 0) => return refuse("it has no clock of its own"),
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
