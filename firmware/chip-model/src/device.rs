//! What all models share: register tables with access rules, and the trait of a model.
//!
//! A model refuses what its manual forbids or leaves undefined, and what is not modelled. A refused access
//! ends the run, and the test fails with its address.

use std::fmt;

/// Virtual time in picoseconds since power-on. One cycle at 400 MHz is 2500.
pub type Picos = u64;
/// A microsecond.
pub const MICRO: Picos = 1_000_000;
/// A millisecond.
pub const MILLI: Picos = 1_000 * MICRO;
/// A second.
pub const SECOND: Picos = 1_000 * MILLI;

/// The period of a clock.
pub fn cycle(hertz: u32) -> Picos {
    SECOND / Picos::from(hertz.max(1))
}

/// Why an access is refused.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Refusal(pub String);

/// Refuses an access.
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
    /// Offset from the peripheral's base.
    pub offset: u32,
    /// Name in the manual.
    pub name: &'static str,
    /// Value after a reset.
    pub reset: u32,
    /// Bits that a program may change; all others must be written as they read.
    pub writable: u32,
    /// Writing ones acts, as on flags and commands: a write is not compared with the present value.
    pub is_command: bool,
}

/// A register that holds what is written.
pub const fn read_write(offset: u32, name: &'static str, reset: u32, writable: u32) -> Register {
    Register { offset, name, reset, writable, is_command: false }
}

/// A read-only register.
pub const fn read_only(offset: u32, name: &'static str, reset: u32) -> Register {
    Register { offset, name, reset, writable: 0, is_command: false }
}

/// A register in which writing ones acts; other bits must be zero.
pub const fn command(offset: u32, name: &'static str, bits: u32) -> Register {
    Register { offset, name, reset: 0, writable: bits, is_command: true }
}

/// The registers of a peripheral and their values.
#[derive(Debug, Clone)]
pub struct Bank {
    registers: &'static [Register],
    values: Vec<u32>,
}

impl Bank {
    /// All registers with their reset values.
    pub fn new(registers: &'static [Register]) -> Self {
        Self { registers, values: registers.iter().map(|register| register.reset).collect() }
    }

    fn index(&self, offset: u32) -> Option<usize> {
        self.registers.iter().position(|register| register.offset == offset)
    }

    /// The value of the register at `offset`.
    ///
    /// # Panics
    /// The table has no such register.
    #[track_caller]
    pub fn get(&self, offset: u32) -> u32 {
        self.values[self.index(offset).expect("in the table")]
    }

    /// Sets the value, without checks.
    ///
    /// # Panics
    /// The table has no such register.
    #[track_caller]
    pub fn set(&mut self, offset: u32, value: u32) {
        let index = self.index(offset).expect("in the table");
        self.values[index] = value;
    }

    /// A read by the program.
    ///
    /// # Errors
    /// The register is not modelled.
    pub fn read(&self, offset: u32) -> Result<u32, Refusal> {
        match self.index(offset) {
            Some(index) => Ok(self.values[index]),
            None => refuse("this register is not modelled"),
        }
    }

    /// Whether the program may write `value`.
    ///
    /// # Errors
    /// The register is not modelled or read-only, or a reserved bit is changed.
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

    /// A write by the program.
    ///
    /// # Errors
    /// As [`Bank::check`].
    pub fn write(&mut self, offset: u32, value: u32) -> Result<(), Refusal> {
        self.check(offset, value)?;
        self.set(offset, value);
        Ok(())
    }
}

/// Frequencies of the clock tree, in Hz; 0 for a clock that is off.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct Clocks {
    /// Core clock.
    pub core: u32,
    /// AHB clock.
    pub hclk: u32,
    /// Clock of the timers on APB1.
    pub timers: u32,
    /// Kernel clock of USART2 and UART7.
    pub usart: u32,
    /// Kernel clock of FDCAN.
    pub fdcan: u32,
    /// Kernel clock of the random number generator.
    pub rng: u32,
    /// Whether the external clock is present.
    pub is_external: bool,
}

/// The alternate function of each pin, by port and number; `None` for a pin in another mode.
pub type Functions = [[Option<u8>; 16]; 11];

/// What a model can see of the rest of the chip during an access.
#[derive(Debug, Clone, Copy)]
pub struct Context<'a> {
    /// Present time.
    pub now: Picos,
    /// Present frequencies.
    pub clocks: Clocks,
    /// Alternate functions of the pins.
    pub functions: &'a Functions,
    /// Whether SYSCFG selects RMII.
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

    /// Whether the pin has this alternate function.
    pub fn is(self, functions: &Functions, function: u8) -> bool {
        functions[self.port()][usize::from(self.1)] == Some(function)
    }
}

/// The model of a peripheral.
pub trait Peripheral {
    /// Its register table.
    fn registers(&self) -> &'static [Register];
    /// A read of 32 bits.
    ///
    /// # Errors
    /// The manual forbids it in this state, or it is not modelled.
    fn read(&mut self, offset: u32, at: &Context<'_>) -> Result<u32, Refusal>;
    /// A write of 32 bits.
    ///
    /// # Errors
    /// As above.
    fn write(&mut self, offset: u32, value: u32, at: &Context<'_>) -> Result<(), Refusal>;
    /// Does everything due up to now.
    ///
    /// # Errors
    /// The program's settings make it impossible.
    fn advance(&mut self, _at: &Context<'_>) -> Result<(), Refusal> {
        Ok(())
    }
    /// Time of the next event.
    fn deadline(&self, _at: &Context<'_>) -> Option<Picos> {
        None
    }
    /// Whether 16-bit writes are allowed; otherwise only 32-bit writes are.
    fn accepts_halfwords(&self) -> bool {
        false
    }
    /// Level of its interrupt line.
    fn interrupt_line(&self) -> bool {
        false
    }
    /// Resets the peripheral; what is outside the chip stays as it is.
    fn reset(&mut self);
}
