//! Registers and coils of a slave.

use proto_core::modbus::server::RegisterBank;
use proto_core::modbus::{Coils, Exception, Registers};
use proto_core::time::Duration;

pub(crate) const MS: fn(u64) -> Duration = Duration::from_millis;

/// Registers that name their slave and their address until they are written.
#[derive(Debug, Clone)]
pub(crate) struct Bank {
    pub(crate) words: Vec<u16>,
    pub(crate) coils: Vec<bool>,
}

pub(crate) fn original(slave: u8, address: u16) -> u16 {
    u16::from(slave) << 8 | address
}

impl Bank {
    pub(crate) fn new(slave: u8) -> Self {
        Self { words: (0..200).map(|at| original(slave, at)).collect(), coils: vec![false; 200] }
    }
}

impl RegisterBank for Bank {
    fn read_coils(&self, address: u16, count: u16, packed: &mut [u8]) -> Result<(), Exception> {
        let at = usize::from(address);
        let coils = self.coils.get(at..at + usize::from(count)).ok_or(Exception::IllegalDataAddress)?;
        coils.iter().enumerate().for_each(|(nth, on)| packed[nth / 8] |= u8::from(*on) << (nth % 8));
        Ok(())
    }

    fn write_coils(&mut self, address: u16, coils: Coils<'_>) -> Result<(), Exception> {
        let at = usize::from(address);
        let target = self.coils.get_mut(at..at + usize::from(coils.count()));
        let target = target.ok_or(Exception::IllegalDataAddress)?;
        target.iter_mut().zip(coils.iter()).for_each(|(coil, on)| *coil = on);
        Ok(())
    }

    fn read_holding(&self, address: u16, words: &mut [[u8; 2]]) -> Result<(), Exception> {
        let at = usize::from(address);
        let values = self.words.get(at..at + words.len()).ok_or(Exception::IllegalDataAddress)?;
        words.iter_mut().zip(values).for_each(|(word, value)| *word = value.to_be_bytes());
        Ok(())
    }

    fn write_holding(&mut self, address: u16, registers: Registers<'_>) -> Result<(), Exception> {
        let at = usize::from(address);
        let target = self.words.get_mut(at..at + usize::from(registers.count()));
        let target = target.ok_or(Exception::IllegalDataAddress)?;
        target.iter_mut().zip(registers.iter()).for_each(|(word, value)| *word = value);
        Ok(())
    }
}
