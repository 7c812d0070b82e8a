//! GPIO ports A to K. RM0433, "General-purpose I/Os".
//!
//! Changes of outputs are recorded with their times. Inputs read 1, as nothing drives them. Other models
//! check the alternate functions of their pins.

use crate::device::*;

const MODER: u32 = 0x00;
const IDR: u32 = 0x10;
const ODR: u32 = 0x14;
const BSRR: u32 = 0x18;
const LCKR: u32 = 0x1C;
const AFRL: u32 = 0x20;
const AFRH: u32 = 0x24;

static REGISTERS: [Register; 9] = [
    read_write(MODER, "MODER", !0, !0),
    read_write(0x04, "OTYPER", 0, 0xFFFF),
    read_write(0x08, "OSPEEDR", 0, !0),
    read_write(0x0C, "PUPDR", 0, !0),
    read_only(IDR, "IDR", 0xFFFF),
    read_write(ODR, "ODR", 0, 0xFFFF),
    command(BSRR, "BSRR", !0),
    read_write(AFRL, "AFRL", 0, !0),
    read_write(AFRH, "AFRH", 0, !0),
];

/// One port.
#[derive(Debug)]
pub struct Port {
    bank: Bank,
    /// Changes of outputs: time, pin, level.
    pub changes: Vec<(Picos, u8, bool)>,
    /// Changes of modes: time, pin, mode.
    pub modes: Vec<(Picos, u8, Mode)>,
}

/// The mode of a pin.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Mode {
    /// Input.
    Input,
    /// General-purpose output.
    Output,
    /// Alternate function.
    Function(u8),
    /// Analog.
    Analog,
}

impl Port {
    /// The state after power-on: ports A and B have debug pins.
    pub fn new(letter: char) -> Self {
        let mut bank = Bank::new(&REGISTERS);
        let (mode, speed, pull) = match letter {
            'A' => (0xABFF_FFFF, 0x0C00_0000, 0x6400_0000),
            'B' => (0xFFFF_FEBF, 0x0000_00C0, 0x0000_0100),
            _ => (!0, 0, 0),
        };
        bank.set(MODER, mode);
        bank.set(0x08, speed);
        bank.set(0x0C, pull);
        Self { bank, changes: Vec::new(), modes: Vec::new() }
    }

    /// The mode of a pin.
    pub fn mode(&self, pin: u8) -> Mode {
        match self.bank.get(MODER) >> (2 * pin) & 3 {
            0 => Mode::Input,
            1 => Mode::Output,
            2 => {
                let register = if pin < 8 { AFRL } else { AFRH };
                Mode::Function((self.bank.get(register) >> (4 * (pin % 8)) & 0xF) as u8)
            }
            _ => Mode::Analog,
        }
    }

    /// The level of an output; `None` in other modes.
    pub fn output(&self, pin: u8) -> Option<bool> {
        (self.mode(pin) == Mode::Output).then(|| self.bank.get(ODR) >> pin & 1 != 0)
    }

    /// The alternate function of each pin.
    pub fn functions(&self) -> [Option<u8>; 16] {
        std::array::from_fn(|pin| match self.mode(pin as u8) {
            Mode::Function(function) => Some(function),
            _ => None,
        })
    }
}

impl Peripheral for Port {
    fn registers(&self) -> &'static [Register] {
        &REGISTERS
    }

    fn read(&mut self, offset: u32, _: &Context<'_>) -> Result<u32, Refusal> {
        match offset {
            BSRR => refuse("can only be written"),
            LCKR => refuse("locks are not modelled"),
            _ => self.bank.read(offset),
        }
    }

    fn write(&mut self, offset: u32, value: u32, at: &Context<'_>) -> Result<(), Refusal> {
        let outputs = self.bank.get(ODR);
        let modes: [Mode; 16] = std::array::from_fn(|pin| self.mode(pin as u8));
        if offset == BSRR {
            // If both bits of a pin are written, set wins (BSRR).
            self.bank.set(ODR, outputs & !(value >> 16) | value & 0xFFFF);
        } else {
            self.bank.write(offset, value)?;
        }
        let after = self.bank.get(ODR);
        for pin in 0..16_u8 {
            if (outputs ^ after) >> pin & 1 != 0 {
                self.changes.push((at.now, pin, after >> pin & 1 != 0));
            }
            if modes[usize::from(pin)] != self.mode(pin) {
                self.modes.push((at.now, pin, self.mode(pin)));
            }
        }
        Ok(())
    }

    fn reset(&mut self) {
        for (offset, value) in [(ODR, 0), (AFRL, 0), (AFRH, 0), (0x04, 0)] {
            self.bank.set(offset, value);
        }
        // Also the debug pins, which no model uses.
        self.bank.set(MODER, !0);
    }
}
