//! What all models share: registers with names and rules, and the trait of a model.
//!
//! A model refuses what its manual forbids or leaves open, and what it does not model. A refused access
//! ends the run: the test fails with the place.

use std::fmt;

/// Virtual time in picoseconds, since power came. One cycle at 400 MHz is 2500.
pub type Picos = u64;
/// A microsecond.
pub const MICRO: Picos = 1_000_000;
/// A millisecond.
pub const MILLI: Picos = 1_000 * MICRO;
/// A second.
pub const SECOND: Picos = 1_000 * MILLI;

/// One cycle of a clock.
pub fn cycle(hertz: u32) -> Picos {
    SECOND / Picos::from(hertz.max(1))
}

/// Why an access is refused.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Refusal(pub String);

/// Refuses, with the reason.
pub fn refuse<T>(reason: impl Into<String>) -> Result<T, Refusal> {
    Err(Refusal(reason.into()))
}

impl fmt::Display for Refusal {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&self.0)
    }
}

/// A register of 32 bits.
#[derive(Debug, Clone, Copy)]
pub struct Register {
    /// From the peripheral's base.
    pub offset: u32,
    /// As the manual has it.
    pub name: &'static str,
    /// What it holds after a reset.
    pub reset: u32,
    /// The bits that a program may change; all others are to be written as they read.
    pub writable: u32,
    /// A register of flags or commands: what is written is not compared with what it reads.
    pub is_command: bool,
}

/// A register that keeps what is written.
pub const fn keeps(offset: u32, name: &'static str, reset: u32, writable: u32) -> Register {
    Register { offset, name, reset, writable, is_command: false }
}

/// A register that can only be read.
pub const fn reads(offset: u32, name: &'static str, reset: u32) -> Register {
    Register { offset, name, reset, writable: 0, is_command: false }
}

/// A register where ones do something; other bits are to be zero.
pub const fn does(offset: u32, name: &'static str, bits: u32) -> Register {
    Register { offset, name, reset: 0, writable: bits, is_command: true }
}

/// The registers of a peripheral and what they hold.
#[derive(Debug, Clone)]
pub struct Bank {
    registers: &'static [Register],
    values: Vec<u32>,
}

impl Bank {
    /// As after a reset.
    pub fn new(registers: &'static [Register]) -> Self {
        Self { registers, values: registers.iter().map(|register| register.reset).collect() }
    }

    fn index(&self, offset: u32) -> Option<usize> {
        self.registers.iter().position(|register| register.offset == offset)
    }

    /// What the register at `offset` holds.
    ///
    /// # Panics
    /// The table has no such register.
    #[track_caller]
    pub fn get(&self, offset: u32) -> u32 {
        self.values[self.index(offset).expect("in the table")]
    }

    /// Sets it, whatever the rules.
    ///
    /// # Panics
    /// The table has no such register.
    #[track_caller]
    pub fn set(&mut self, offset: u32, value: u32) {
        let index = self.index(offset).expect("in the table");
        self.values[index] = value;
    }

    /// What a program reads.
    ///
    /// # Errors
    /// The register is not modelled.
    pub fn read(&self, offset: u32) -> Result<u32, Refusal> {
        match self.index(offset) {
            Some(index) => Ok(self.values[index]),
            None => refuse("this register is not modelled"),
        }
    }

    /// What a program may write.
    ///
    /// # Errors
    /// The register is not modelled, can only be read, or a reserved bit is changed.
    pub fn check(&self, offset: u32, value: u32) -> Result<(), Refusal> {
        let Some(index) = self.index(offset) else { return refuse("this register is not modelled") };
        let register = self.registers[index];
        let changed = if register.is_command { value } else { value ^ self.values[index] };
        match changed & !register.writable {
            _ if register.writable == 0 => refuse("can only be read"),
            0 => Ok(()),
            bits => refuse(format!("bits {bits:08X} are reserved or can only be read")),
        }
    }

    /// Checks and keeps.
    ///
    /// # Errors
    /// As [`Bank::check`].
    pub fn write(&mut self, offset: u32, value: u32) -> Result<(), Refusal> {
        self.check(offset, value)?;
        self.set(offset, value);
        Ok(())
    }
}

/// The frequencies that the clock tree makes, in Hz; 0 where there is none.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct Clocks {
    /// Of the core.
    pub core: u32,
    /// Of the AHB buses.
    pub hclk: u32,
    /// Of the timers on APB1.
    pub timers: u32,
    /// What drives USART2 and UART7.
    pub usart: u32,
    /// What drives FDCAN.
    pub fdcan: u32,
    /// What drives the random number generator.
    pub rng: u32,
    /// The external clock may be used.
    pub is_external: bool,
}

/// Which alternate function each pin has, by port and number; `None` for a pin without.
pub type Functions = [[Option<u8>; 16]; 11];

/// What a model can know of the rest of the chip at an access.
#[derive(Debug, Clone, Copy)]
pub struct Moment<'a> {
    /// The present.
    pub now: Picos,
    /// The clock tree.
    pub clocks: Clocks,
    /// The pins.
    pub functions: &'a Functions,
    /// SYSCFG says RMII.
    pub is_rmii: bool,
}

/// A pin.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Pin(pub char, pub u8);

impl Pin {
    /// The index of its port.
    pub fn port(self) -> usize {
        usize::from(self.0 as u8 - b'A')
    }

    /// Whether it has this alternate function.
    pub fn is(self, functions: &Functions, function: u8) -> bool {
        functions[self.port()][usize::from(self.1)] == Some(function)
    }
}

/// A model.
pub trait Peripheral {
    /// The table of its registers.
    fn registers(&self) -> &'static [Register];
    /// A read of 32 bits.
    ///
    /// # Errors
    /// The manual forbids it here, or it is not modelled.
    fn read(&mut self, offset: u32, at: &Moment<'_>) -> Result<u32, Refusal>;
    /// A write of 32 bits.
    ///
    /// # Errors
    /// As above.
    fn write(&mut self, offset: u32, value: u32, at: &Moment<'_>) -> Result<(), Refusal>;
    /// Does what is due by now.
    ///
    /// # Errors
    /// What is due cannot be done as the program has set it up.
    fn advance(&mut self, _at: &Moment<'_>) -> Result<(), Refusal> {
        Ok(())
    }
    /// When something is due next.
    fn deadline(&self, _at: &Moment<'_>) -> Option<Picos> {
        None
    }
    /// Whether writes of 16 bits are taken; without this only 32 are.
    fn takes_halves(&self) -> bool {
        false
    }
    /// Whether its interrupt is asked for.
    fn interrupts(&self) -> bool {
        false
    }
    /// As after a reset; what is outside of the chip stays.
    fn reset(&mut self);
}
