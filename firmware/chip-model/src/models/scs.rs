//! The core's own registers: NVIC, SysTick, fault status, MPU. Armv7-M ARM sections B3.2 (system control),
//! B3.3 (SysTick), B3.4 (NVIC), B3.5 (MPU); priorities by B1.5.4, with the chip's four bits.
//!
//! The only MPU region modelled is one without access rights: the stack guard.

use std::borrow::Cow;

use crate::device::*;

const CSR: u32 = 0x010;
const RVR: u32 = 0x014;
const CVR: u32 = 0x018;
const ICSR: u32 = 0xD04;
const VTOR: u32 = 0xD08;
const AIRCR: u32 = 0xD0C;
const CCR: u32 = 0xD14;
const CFSR: u32 = 0xD28;
const HFSR: u32 = 0xD2C;
const MMFAR: u32 = 0xD34;
const BFAR: u32 = 0xD38;
const MPU_CTRL: u32 = 0xD94;
const MPU_RBAR: u32 = 0xD9C;
const MPU_RASR: u32 = 0xDA0;
const NVIC: std::ops::Range<u32> = 0x100..0x300;
const PRIORITIES: std::ops::Range<u32> = 0x400..0x400 + LINES as u32;
const SYSTEM_PRIORITIES: std::ops::Range<u32> = 0xD18..0xD24;

static REGISTERS: [Register; 25] = [
    read_write(CSR, "SYST_CSR", 0, 7),
    read_write(RVR, "SYST_RVR", 0, 0xFF_FFFF),
    read_write(CVR, "SYST_CVR", 0, !0),
    read_only(0xD00, "CPUID", 0x411F_C271),
    command(ICSR, "ICSR", 0x9E00_0000),
    read_write(VTOR, "VTOR", 0x0800_0000, 0xFFFF_FF80),
    read_write(AIRCR, "AIRCR", 0xFA05_0000, 0xFFFF_0707),
    read_write(0xD10, "SCR", 0, 0x16),
    read_write(CCR, "CCR", 0x4_0200, 0x7_031B),
    read_write(0xD24, "SHCSR", 0, 0x7_FD8B),
    command(CFSR, "CFSR", 0x30F_BFBB),
    command(HFSR, "HFSR", 0xC000_0002),
    read_write(MMFAR, "MMFAR", 0, !0),
    read_write(BFAR, "BFAR", 0, !0),
    read_only(0xD78, "CLIDR", 0x0900_0003),
    read_only(0xD80, "CCSIDR", 0xF007_E019),
    read_write(0xD84, "CSSELR", 0, 0xF),
    read_write(0xD88, "CPACR", 0, 0x00F0_0000),
    read_only(0xD90, "MPU_TYPE", 0x1000),
    read_write(MPU_CTRL, "MPU_CTRL", 0, 7),
    read_write(0xD98, "MPU_RNR", 0, 0xF),
    read_write(MPU_RBAR, "MPU_RBAR", 0, !0),
    read_write(MPU_RASR, "MPU_RASR", 0, 0x173F_FF3F),
    read_write(0xF34, "FPCCR", 0xC000_0000, 0xC000_0001),
    command(0xF50, "ICIALLU", !0),
];

/// Number of interrupt lines.
pub const LINES: usize = 160;
/// The number of the HardFault exception.
pub const HARD_FAULT: u16 = 3;
const SYSTICK: u16 = 15;
const SYSRESETREQ: u32 = 1 << 2;
const FIRST_LINE: u16 = 16;

/// The core's mask registers.
#[derive(Debug, Clone, Copy, Default)]
pub struct Masks {
    /// PRIMASK.
    pub primask: bool,
    /// FAULTMASK.
    pub faultmask: bool,
    /// BASEPRI.
    pub basepri: u8,
}

/// The model.
#[derive(Debug)]
pub struct Scs {
    bank: Bank,
    enabled: [u32; LINES / 32],
    pending: [u32; LINES / 32],
    /// Level of each interrupt line.
    lines: [u32; LINES / 32],
    priorities: [u8; LINES],
    system_priorities: [u8; 12],
    systick_pends: bool,
    /// The program asked for a reset (AIRCR.SYSRESETREQ).
    wants_reset: bool,
    ticks: Option<Picos>,
    /// Active exceptions, the outermost first.
    active: Vec<u16>,
    /// The event register (B1.5.18).
    pub event: bool,
    /// How often each exception was taken, by number.
    pub taken: Vec<u64>,
}

impl Scs {
    /// The state after a reset.
    pub fn new() -> Self {
        Self {
            bank: Bank::new(&REGISTERS),
            enabled: [0; LINES / 32],
            pending: [0; LINES / 32],
            lines: [0; LINES / 32],
            priorities: [0; LINES],
            system_priorities: [0; 12],
            systick_pends: false,
            wants_reset: false,
            ticks: None,
            active: Vec::new(),
            event: false,
            taken: vec![0; LINES + usize::from(FIRST_LINE)],
        }
    }

    /// Resets all but the counters.
    pub fn reset(&mut self) {
        let taken = std::mem::take(&mut self.taken);
        *self = Self { taken, ..Self::new() };
    }

    /// Address of the vector table.
    pub fn vectors(&self) -> u32 {
        self.bank.get(VTOR)
    }

    /// Start and size of the guard region, if the MPU enforces it now.
    pub fn guard(&self) -> Option<(u32, u32)> {
        let (control, region) = (self.bank.get(MPU_CTRL), self.bank.get(MPU_RASR));
        let is_off = control & 1 == 0 || region & 1 == 0;
        // In the HardFault handler the MPU is off, unless HFNMIENA is set.
        if is_off || control & 2 == 0 && self.active.contains(&HARD_FAULT) {
            return None;
        }
        Some((self.bank.get(MPU_RBAR) & !0x1F, 2 << (region >> 1 & 31)))
    }

    /// Whether bus faults are ignored (CCR.BFHFNMIGN): in the HardFault handler, or with FAULTMASK.
    pub fn ignores_bus_faults(&self, masks: Masks) -> bool {
        self.bank.get(CCR) & 1 << 8 != 0 && self.priority(masks) < 0
    }

    /// Sets the fault registers: CFSR, and the fault address if `status` declares it valid. All faults escalate to
    /// HardFault, since the configurable ones are disabled.
    pub fn record_fault(&mut self, status: u32, address: u32, is_single_step: bool) {
        self.bank.set(CFSR, self.bank.get(CFSR) | status);
        if status & 1 << 7 != 0 {
            self.bank.set(MMFAR, address);
        }
        if status & 1 << 15 != 0 {
            self.bank.set(BFAR, address);
        }
        if is_single_step {
            self.bank.set(HFSR, self.bank.get(HFSR) | 1 << 30);
        }
    }

    /// Sets the level of an interrupt line.
    pub fn set_line(&mut self, line: u16, level: bool) {
        let (word, bit) = (usize::from(line / 32), 1 << (line % 32));
        if level {
            self.lines[word] |= bit;
        } else {
            self.lines[word] &= !bit;
        }
    }

    fn is_active(&self, line: u16) -> bool {
        self.active.contains(&(line + FIRST_LINE))
    }

    fn priority_of(&self, number: u16) -> i16 {
        match number {
            HARD_FAULT => -1,
            4..=15 => i16::from(self.system_priorities[usize::from(number - 4)] >> 4),
            _ => i16::from(self.priorities[usize::from(number - FIRST_LINE)] >> 4),
        }
    }

    /// The execution priority.
    fn priority(&self, masks: Masks) -> i16 {
        let mut priority = self.active.iter().map(|number| self.priority_of(*number)).min().unwrap_or(256);
        if masks.basepri != 0 {
            priority = priority.min(i16::from(masks.basepri >> 4));
        }
        if masks.primask {
            priority = priority.min(0);
        }
        if masks.faultmask { priority.min(-1) } else { priority }
    }

    /// The pending and enabled exception of the highest priority.
    pub fn most_urgent(&self) -> Option<u16> {
        let systick = self.systick_pends.then_some(SYSTICK);
        let lines = (0..LINES / 32).flat_map(|word| {
            let mut bits = (self.pending[word] | self.lines[word]) & self.enabled[word];
            std::iter::from_fn(move || {
                let bit = (bits != 0).then(|| bits.trailing_zeros())?;
                bits &= bits - 1;
                Some(32 * word as u16 + bit as u16)
            })
        });
        let lines = lines.filter(|line| !self.is_active(*line)).map(|line| line + FIRST_LINE);
        systick.into_iter().chain(lines).min_by_key(|number| (self.priority_of(*number), *number))
    }

    /// The exception to be taken now.
    pub fn due(&self, masks: Masks) -> Option<u16> {
        self.most_urgent().filter(|number| self.priority_of(*number) < self.priority(masks))
    }

    /// An exception is taken.
    pub fn enter(&mut self, number: u16) {
        if number == SYSTICK {
            self.systick_pends = false;
        }
        if let Some(line) = number.checked_sub(FIRST_LINE) {
            self.pending[usize::from(line / 32)] &= !(1 << (line % 32));
        }
        self.active.push(number);
        self.taken[usize::from(number)] += 1;
        self.event = true;
    }

    /// The handler of the innermost exception returns.
    pub fn leave(&mut self) {
        self.active.pop();
        self.event = true;
    }

    /// Whether a fault now locks up the core.
    pub fn would_lock_up(&self) -> bool {
        self.active.contains(&HARD_FAULT)
    }

    /// Whether the program has asked for a reset of the chip.
    pub fn wants_reset(&self) -> bool {
        self.wants_reset
    }

    /// Lets SysTick do what is due.
    pub fn advance(&mut self, at: &Context<'_>) {
        while let Some(next) = self.ticks
            && at.now >= next
        {
            self.systick_pends |= self.bank.get(CSR) & 2 != 0;
            self.ticks = Some(next + self.tick_period(at));
        }
    }

    fn tick_period(&self, at: &Context<'_>) -> Picos {
        let divider = if self.bank.get(CSR) & 4 != 0 { 1 } else { 8 };
        Picos::from(self.bank.get(RVR) + 1) * cycle(at.clocks.core / divider)
    }

    /// When SysTick reaches zero next.
    pub fn deadline(&self) -> Option<Picos> {
        self.ticks
    }

    /// The name of a register.
    pub fn name(offset: u32) -> Cow<'static, str> {
        match REGISTERS.iter().find(|register| register.offset == offset) {
            Some(register) => register.name.into(),
            None if PRIORITIES.contains(&offset) => format!("NVIC_IPR[{}]", offset - PRIORITIES.start).into(),
            None if SYSTEM_PRIORITIES.contains(&offset) => "SHPR".into(),
            None if NVIC.contains(&offset) => {
                let kind = ["ISER", "ICER", "ISPR", "ICPR"][((offset - NVIC.start) / 0x80) as usize];
                format!("NVIC_{kind}{}", offset % 0x80 / 4).into()
            }
            None => format!("+{offset:03X}").into(),
        }
    }

    /// A read.
    ///
    /// # Errors
    /// The register is not modelled.
    pub fn read(&mut self, offset: u32, _: u32, _: &Context<'_>) -> Result<u32, Refusal> {
        if NVIC.contains(&offset) {
            let word = (offset % 0x80 / 4) as usize;
            let table = if offset < 0x200 { &self.enabled } else { &self.pending };
            return table.get(word).copied().ok_or_else(|| Refusal("no such line".into()));
        }
        if PRIORITIES.contains(&offset) {
            let first = (offset - PRIORITIES.start) as usize & !3;
            let bytes = self.priorities[first..first + 4].try_into().expect("four");
            return Ok(u32::from_le_bytes(bytes) >> (8 * (offset & 3)));
        }
        if SYSTEM_PRIORITIES.contains(&offset) {
            let first = (offset - SYSTEM_PRIORITIES.start) as usize & !3;
            let bytes = self.system_priorities[first..first + 4].try_into().expect("four");
            return Ok(u32::from_le_bytes(bytes) >> (8 * (offset & 3)));
        }
        match offset {
            ICSR => {
                let active = self.active.last().copied().unwrap_or(0);
                Ok(u32::from(active) | u32::from(self.most_urgent().unwrap_or(0)) << 12)
            }
            CVR => refuse("the present count is not modelled"),
            _ => self.bank.read(offset),
        }
    }

    /// A write of `size` bytes.
    ///
    /// # Errors
    /// The register or the value is not modelled, or it is forbidden.
    pub fn write(&mut self, offset: u32, value: u32, size: u32, at: &Context<'_>) -> Result<(), Refusal> {
        if NVIC.contains(&offset) {
            let Some(word) = Some((offset % 0x80 / 4) as usize).filter(|word| *word < LINES / 32) else {
                return refuse("no such line");
            };
            match (offset - NVIC.start) / 0x80 {
                0 => self.enabled[word] |= value,
                1 => self.enabled[word] &= !value,
                2 => self.pending[word] |= value,
                _ => self.pending[word] &= !value,
            }
            return Ok(());
        }
        let bytes = &value.to_le_bytes()[..size as usize];
        if PRIORITIES.contains(&offset) {
            let first = (offset - PRIORITIES.start) as usize;
            self.priorities[first..first + bytes.len()].copy_from_slice(bytes);
            return Ok(());
        }
        if SYSTEM_PRIORITIES.contains(&offset) {
            let first = (offset - SYSTEM_PRIORITIES.start) as usize;
            self.system_priorities[first..first + bytes.len()].copy_from_slice(bytes);
            return Ok(());
        }
        if size != 4 {
            return refuse("32 bits at a time");
        }
        self.bank.check(offset, value)?;
        match offset {
            CFSR | HFSR => self.bank.set(offset, self.bank.get(offset) & !value),
            CVR => self.bank.set(CVR, 0),
            ICSR if value & !(1 << 25 | 1 << 26) != 0 => return refuse("PendSV and NMI are not modelled"),
            ICSR => self.systick_pends = value & 1 << 26 != 0,
            AIRCR if value >> 16 != 0x05FA => return refuse("without the key"),
            // B3.2.6: for a debugger that halts the core.
            AIRCR if value & 3 != 0 => return refuse("VECTRESET and VECTCLRACTIVE are not modelled"),
            AIRCR => {
                self.bank.set(AIRCR, 0xFA05_0000 | value & 0x700);
                self.wants_reset |= value & SYSRESETREQ != 0;
            }
            MPU_RASR if value & 1 != 0 && value >> 24 & 7 != 0 => {
                return refuse("a region that somebody may use is not modelled");
            }
            CSR => {
                self.bank.set(CSR, value);
                self.ticks = (value & 1 != 0).then(|| at.now + self.tick_period(at));
            }
            0xF50 => {}
            _ => self.bank.set(offset, value),
        }
        Ok(())
    }
}

impl Default for Scs {
    fn default() -> Self {
        Self::new()
    }
}
