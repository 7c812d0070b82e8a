//! GPIO ports A to K. RM0433, "General-purpose I/Os".
//!
//! Changes of outputs are recorded with their times. An input reads the level from outside, or that of its pull
//! resistor, or 1 without either; an output reads its own level, an analog pin 0. Other models check the alternate
//! functions of their pins.

use crate::device::*;

const MODER: u32 = 0x00;
const PUPDR: u32 = 0x0C;
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
    read_write(PUPDR, "PUPDR", 0, !0),
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
    /// Levels from outside: from when, pin, level.
    outside: Vec<(Picos, u8, bool)>,
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
        bank.set(PUPDR, pull);
        Self { bank, changes: Vec::new(), modes: Vec::new(), outside: Vec::new() }
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

    /// Something outside drives a pin from this time on, which must not be before those of earlier calls for this pin.
    pub fn drive(&mut self, from: Picos, pin: u8, level: bool) {
        self.outside.push((from, pin, level));
    }

    /// The level of a pin.
    fn level(&self, pin: u8, now: Picos) -> bool {
        match self.mode(pin) {
            Mode::Analog => false,
            Mode::Output => self.bank.get(ODR) >> pin & 1 != 0,
            Mode::Input | Mode::Function(_) => {
                let driven = self.outside.iter().rev().find(|(from, of, _)| *of == pin && *from <= now);
                let is_pulled_down = self.bank.get(PUPDR) >> (2 * pin) & 3 == 2;
                driven.map_or(!is_pulled_down, |(.., level)| *level)
            }
        }
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

    fn read(&mut self, offset: u32, at: &Context<'_>) -> Result<u32, Refusal> {
        match offset {
            IDR => Ok((0..16).fold(0, |bits, pin| bits | u32::from(self.level(pin, at.now)) << pin)),
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

#[cfg(test)]
mod tests {
    use super::*;

    static NONE: Functions = [[None; 16]; 11];

    fn read(port: &mut Port, now: Picos) -> u32 {
        let at = Context { now, clocks: Clocks::default(), functions: &NONE, is_rmii: false };
        port.read(IDR, &at).expect("it can be read")
    }

    #[test]
    fn a_pin_reads_what_drives_it() {
        let mut port = Port::new('C');
        port.drive(0, 13, false);
        port.drive(MILLI, 13, true);
        port.drive(3 * MILLI, 13, false);
        assert_eq!(read(&mut port, 2 * MILLI), 0, "all pins are analog");
        port.bank.set(MODER, !(3 << 26) & !(3 << 4) & !(3 << 6) & !(3 << 8) | 1 << 8);
        port.bank.set(PUPDR, 2 << 6);
        port.bank.set(ODR, 1 << 4);
        // PC2 floats, PC3 is pulled down, PC4 is an output.
        assert_eq!(read(&mut port, 0), 1 << 2 | 1 << 4);
        assert_eq!(read(&mut port, 2 * MILLI), 1 << 2 | 1 << 4 | 1 << 13);
        port.reset();
        port.bank.set(MODER, !(3 << 26));
        assert_eq!(read(&mut port, 3 * MILLI - 1), 1 << 13, "a reset ends nothing outside");
        assert_eq!(read(&mut port, 3 * MILLI), 0);
    }
}
