//! GPIO ports A to K. RM0433, "General-purpose I/Os".
//!
//! Outputs are kept with the time at which they changed; inputs read 1, as nothing drives them. What
//! function a pin has is what other models ask.

use crate::device::*;

const MODER: u32 = 0x00;
const IDR: u32 = 0x10;
const ODR: u32 = 0x14;
const BSRR: u32 = 0x18;
const LCKR: u32 = 0x1C;
const AFRL: u32 = 0x20;
const AFRH: u32 = 0x24;

static REGISTERS: [Register; 9] = [
    keeps(MODER, "MODER", !0, !0),
    keeps(0x04, "OTYPER", 0, 0xFFFF),
    keeps(0x08, "OSPEEDR", 0, !0),
    keeps(0x0C, "PUPDR", 0, !0),
    reads(IDR, "IDR", 0xFFFF),
    keeps(ODR, "ODR", 0, 0xFFFF),
    does(BSRR, "BSRR", !0),
    keeps(AFRL, "AFRL", 0, !0),
    keeps(AFRH, "AFRH", 0, !0),
];

/// One port.
#[derive(Debug)]
pub struct Port {
    bank: Bank,
    /// Each change of an output: when, which pin, to what.
    pub changes: Vec<(Picos, u8, bool)>,
    /// Each time that a pin got another mode: when, which pin, the mode.
    pub modes: Vec<(Picos, u8, Mode)>,
}

/// What a pin is.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Mode {
    /// Read by the program.
    Input,
    /// Set by it.
    Output,
    /// A peripheral's.
    Function(u8),
    /// Not connected to anything digital.
    Analog,
}

impl Port {
    /// As after power came. Port A and B have debug pins.
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

    /// What a pin is now.
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

    /// What an output shows.
    pub fn output(&self, pin: u8) -> Option<bool> {
        (self.mode(pin) == Mode::Output).then(|| self.bank.get(ODR) >> pin & 1 != 0)
    }

    /// Which alternate function each pin has.
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

    fn read(&mut self, offset: u32, _: &Moment<'_>) -> Result<u32, Refusal> {
        match offset {
            BSRR => refuse("can only be written"),
            LCKR => refuse("locks are not modelled"),
            _ => self.bank.read(offset),
        }
    }

    fn write(&mut self, offset: u32, value: u32, at: &Moment<'_>) -> Result<(), Refusal> {
        let outputs = self.bank.get(ODR);
        let modes: [Mode; 16] = std::array::from_fn(|pin| self.mode(pin as u8));
        if offset == BSRR {
            // Setting comes before resetting (BSRR).
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
        // Debug pins included: nobody asks for them.
        self.bank.set(MODER, !0);
    }
}
