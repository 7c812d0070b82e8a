//! The Modbus registers (proto-core/docs/wire/modbus.md sections 7 and 8, D10-D12).
//!
//! Places of system variables come from their table; only other items are listed here.

use std::sync::LazyLock;

use proto_core::modbus::map::{self, COILS, HOLDING, Space, scaled};
use proto_core::modbus::server::RegisterBank;
use proto_core::modbus::{Coils, Exception, Registers as Words};
use proto_core::sysvar::{ModbusPlace, SysVar};

use super::Registers;

/// Eight coils. Every group of the map begins at a multiple of eight.
#[derive(Debug, Clone, Copy, Default)]
struct CoilByte {
    /// Offset in the image; `None` for the tool's buttons.
    offset: Option<usize>,
    valid_bits: u8,
}

#[derive(Debug, Clone, Copy, Default)]
enum Word {
    #[default]
    Reserved,
    /// Operation mode, robot, program and safety state.
    Mode,
    Robot,
    Program,
    Safety,
    /// A word variable at this offset of the image.
    Image {
        offset: usize,
    },
    /// A float variable at this offset of the image, scaled.
    Scaled {
        offset: usize,
        per_unit: u16,
    },
    AnalogIn(usize),
    AnalogOut(usize),
    ToolIn(usize),
    ToolOut(usize),
    JointVelocity(usize),
    TcpVelocity(usize),
}

struct Map {
    coils: [CoilByte; COIL_BYTES],
    words: [Word; WORDS],
}

static MAP: LazyLock<Map> = LazyLock::new(|| {
    let mut coils = [CoilByte::default(); COIL_BYTES];
    let mut words = [Word::Reserved; WORDS];
    for var in SysVar::all() {
        let offset = var.image_offset();
        match var.modbus() {
            // Inputs come first, so an output's status does not replace its command, which can be written.
            Some(ModbusPlace::Coils { first, .. }) => {
                let byte = &mut coils[usize::from(first / 8)];
                if byte.offset.is_none() {
                    *byte = CoilByte { offset: Some(offset), valid_bits: var.valid_bits() };
                }
            }
            Some(ModbusPlace::Register { address }) => {
                words[usize::from(address)] = Word::Image { offset };
            }
            Some(ModbusPlace::Scaled { address, per_unit }) => {
                words[usize::from(address)] = Word::Scaled { offset, per_unit };
            }
            None => {}
        }
    }
    words[..4].copy_from_slice(&[Word::Mode, Word::Robot, Word::Program, Word::Safety]);
    for nth in 0..8 {
        words[72 + nth] = Word::AnalogIn(nth);
        words[80 + nth] = Word::AnalogOut(nth);
    }
    for nth in 0..2 {
        words[88 + nth] = Word::ToolIn(nth);
        words[90 + nth] = Word::ToolOut(nth);
    }
    for nth in 0..7 {
        words[99 + nth] = Word::JointVelocity(nth);
    }
    for nth in 0..6 {
        words[112 + nth] = Word::TcpVelocity(nth);
    }
    Map { coils, words }
});

impl Registers {
    fn coil_byte(&self, nth: usize) -> u8 {
        match MAP.coils.get(nth) {
            Some(CoilByte { offset: Some(offset), .. }) => self.image.get(*offset).copied().unwrap_or(0),
            Some(CoilByte { offset: None, .. }) => self.buttons,
            None => 0,
        }
    }

    fn word(&self, word: Word) -> u16 {
        match word {
            Word::Reserved => 0,
            Word::Mode => self.status.mode_register,
            Word::Robot => self.status.robot.into(),
            Word::Program => self.status.program.into(),
            Word::Safety => self.status.safety.into(),
            Word::Image { offset } => {
                let bytes = self.image.get(offset..).and_then(|bytes| bytes.first_chunk());
                bytes.map_or(0, |bytes| u16::from_le_bytes(*bytes))
            }
            Word::Scaled { offset, per_unit } => {
                let bytes = self.image.get(offset..).and_then(|bytes| bytes.first_chunk());
                bytes.map_or(0, |bytes| scaled(f32::from_le_bytes(*bytes), per_unit))
            }
            Word::AnalogIn(nth) => {
                scaled(self.analog_in[nth], if nth < 4 { COUNTS_PER_MA } else { COUNTS_PER_V })
            }
            Word::AnalogOut(nth) => self.analog_out[nth],
            Word::ToolIn(nth) => scaled(self.tool_in[nth], COUNTS_PER_V),
            Word::ToolOut(nth) => self.tool_out[nth],
            Word::JointVelocity(nth) => scaled(self.arm.velocity[nth], 1_000),
            Word::TcpVelocity(nth) => scaled(self.arm.tcp_velocity[nth], 10_000),
        }
    }
}

impl Registers {
    /// Counts a read. After several reads without a change, the encoded registers are cached until the next change.
    pub(crate) fn were_read(&mut self) {
        if self.shown.is_worth_keeping() {
            self.shown.keep(MAP.words.map(|word| self.word(word).to_be_bytes()));
        }
    }
}

impl RegisterBank for Registers {
    fn read_coils(&self, address: u16, count: u16, packed: &mut [u8]) -> Result<(), Exception> {
        map::check_read(Space::Coils, address, count)?;
        let (mut byte, shift) = (usize::from(address / 8), address % 8);
        for target in packed {
            let pair = u16::from_le_bytes([self.coil_byte(byte), self.coil_byte(byte + 1)]);
            *target = (pair >> shift) as u8;
            byte += 1;
        }
        Ok(())
    }

    fn write_coils(&mut self, address: u16, coils: Coils<'_>) -> Result<(), Exception> {
        map::check_write(Space::Coils, address, coils.count())?;
        let first = usize::from(address);
        self.write_inputs(|image| {
            for (nth, on) in coils.iter().enumerate() {
                let byte = MAP.coils[(first + nth) / 8];
                let bit = 1 << ((first + nth) % 8) & byte.valid_bits;
                if let Some(target) = byte.offset.and_then(|offset| image.get_mut(offset)) {
                    *target = if on { *target | bit } else { *target & !bit };
                }
            }
        });
        Ok(())
    }

    fn read_holding(&self, address: u16, words: &mut [[u8; 2]]) -> Result<(), Exception> {
        let first = usize::from(address);
        let run = first..first + words.len();
        if let Some(shown) = self.shown.get() {
            words.copy_from_slice(shown.get(run.clone()).ok_or(Exception::IllegalDataAddress)?);
            debug_assert!(
                run.zip(words).all(|(nth, shown)| *shown == self.word(MAP.words[nth]).to_be_bytes()),
                "a register has changed unseen"
            );
            return Ok(());
        }
        let map = MAP.words.get(run).ok_or(Exception::IllegalDataAddress)?;
        for (target, &word) in words.iter_mut().zip(map) {
            *target = self.word(word).to_be_bytes();
        }
        Ok(())
    }

    fn write_holding(&mut self, address: u16, registers: Words<'_>) -> Result<(), Exception> {
        map::check_write(Space::Holding, address, registers.count())?;
        self.shown.forget();
        let words = MAP.words.get(usize::from(address)..).unwrap_or(&[]);
        for (&word, value) in words.iter().zip(registers.iter()) {
            match word {
                Word::Image { offset } => {
                    if let Some(place) = self.image.get_mut(offset..offset + 2) {
                        place.copy_from_slice(&value.to_le_bytes());
                    }
                }
                Word::AnalogOut(nth) => self.analog_out[nth] = value,
                Word::ToolOut(nth) => self.tool_out[nth] = value,
                _ => {}
            }
        }
        Ok(())
    }
}

/// Counts of current inputs: 0.01 mA each.
pub(super) const COUNTS_PER_MA: u16 = 100;
/// Counts of voltage inputs: 1 mV each.
pub(super) const COUNTS_PER_V: u16 = 1_000;
const COIL_BYTES: usize = (COILS / 8) as usize;
pub(super) const WORDS: usize = HOLDING as usize;
