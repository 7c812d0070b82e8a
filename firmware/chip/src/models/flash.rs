//! Flash's interface: wait states. RM0433, "Embedded Flash memory", at
//! the recommended number of wait states. The program only reads flash.

use crate::device::*;

const ACR: u32 = 0x00;
static REGISTERS: [Register; 1] = [keeps(ACR, "ACR", 0x37, 0x3F)];

/// The model.
#[derive(Debug)]
pub struct Flash(Bank);

impl Flash {
    /// As after power came.
    pub fn new() -> Self {
        Self(Bank::new(&REGISTERS))
    }

    /// Whether its wait states are enough for this bus clock, at the highest voltage but one (VOS1).
    ///
    /// # Errors
    /// They are not.
    pub fn check_speed(&self, hclk: u32) -> Result<(), Refusal> {
        let (latency, delay) = (self.0.get(ACR) & 0xF, self.0.get(ACR) >> 4 & 3);
        let needed = match hclk {
            ..=70_000_000 => (0, 0),
            70_000_001..=140_000_000 => (1, 1),
            140_000_001..=185_000_000 => (2, 1),
            185_000_001..=210_000_000 => (2, 2),
            _ => (3, 2),
        };
        if latency < needed.0 || delay < needed.1 {
            return refuse(format!(
                "flash has {latency} wait states for {hclk} Hz; the manual asks for {}",
                needed.0
            ));
        }
        Ok(())
    }
}

impl Default for Flash {
    fn default() -> Self {
        Self::new()
    }
}

impl Peripheral for Flash {
    fn registers(&self) -> &'static [Register] {
        &REGISTERS
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
