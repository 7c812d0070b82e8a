//! The controller's address map (docs/wire/modbus.md sections 7 and 8).
//!
//! Addresses of system variables come from the table in [`crate::sysvar`]; the others are listed here. The build fails
//! if there is a gap between rows.

use super::exception::Exception;

mod rows;

/// The address spaces of the controller.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum Space {
    /// FC 1, 5 and 15.
    Coils,
    /// FC 3, 6 and 16.
    Holding,
}

/// What a client may do with an item.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum Access {
    /// A write is refused with exception 02.
    ReadOnly,
    /// Reads and writes are allowed.
    ReadWrite,
}

/// A run of consecutive coils or registers of one kind.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct MapRun {
    /// Which address space.
    pub space: Space,
    /// First address.
    pub first: u16,
    /// Number of addresses, at least 1.
    pub count: u16,
    /// Whether a client may write.
    pub access: Access,
    /// What the addresses hold.
    pub content: &'static str,
    /// Counts per unit of a quantity; 0 for coils, codes and plain words.
    pub per_unit: u16,
}

/// Number of coils, from address 0.
pub const COILS: u16 = rows::end(Space::Coils);
/// Number of holding registers, from address 0.
pub const HOLDING: u16 = rows::end(Space::Holding);

/// The map in address order, coils first.
pub static MAP: [MapRun; 27] = rows::ROWS;

impl MapRun {
    /// The first address after the run.
    pub const fn end(&self) -> u16 {
        self.first.saturating_add(self.count)
    }
}

/// Checks that all `count` items from `address` on can be read.
///
/// # Errors
/// [`Exception::IllegalDataAddress`] if one of them is outside the map.
pub fn check_read(space: Space, address: u16, count: u16) -> Result<(), Exception> {
    let end = match space {
        Space::Coils => COILS,
        Space::Holding => HOLDING,
    };
    let past = u32::from(address).wrapping_add(u32::from(count));
    if past <= u32::from(end) { Ok(()) } else { Err(Exception::IllegalDataAddress) }
}

/// Checks that all `count` items from `address` on can be written (D10).
///
/// # Errors
/// [`Exception::IllegalDataAddress`] if one of them is outside the map or read-only.
pub fn check_write(space: Space, address: u16, count: u16) -> Result<(), Exception> {
    let run_end = match space {
        Space::Coils => COIL_RUNS.get(usize::from(address)),
        Space::Holding => HOLDING_RUNS.get(usize::from(address)),
    };
    let past = u32::from(address).wrapping_add(u32::from(count));
    match run_end {
        Some(run_end) if past <= u32::from(*run_end) => Ok(()),
        _ => Err(Exception::IllegalDataAddress),
    }
}

/// Converts `value` to a register of `per_unit` counts per unit: rounded to the nearest count, two's complement,
/// saturated at ±32767, and 0 for NaN (D11).
pub fn scaled(value: f32, per_unit: u16) -> u16 {
    let counts = f64::from(value) * f64::from(per_unit);
    // The cast saturates infinities to the limits of i32 and turns NaN into 0.
    let nearest = (counts + 0.5_f64.copysign(counts)) as i32;
    nearest.clamp(-MAX_COUNTS, MAX_COUNTS) as i16 as u16
}

/// Converts a register of `per_unit` counts per unit to its value.
pub fn unscaled(register: u16, per_unit: u16) -> f32 {
    f32::from(register as i16) / f32::from(per_unit.max(1))
}

const MAX_COUNTS: i32 = 32_767;

/// For each coil: one past the end of the writable run that contains it, or 0 if it is read-only.
static COIL_RUNS: [u16; COILS as usize] = rows::runs(Space::Coils);
/// For each holding register: one past the end of its writable run, or 0.
static HOLDING_RUNS: [u16; HOLDING as usize] = rows::runs(Space::Holding);

#[cfg(test)]
mod tests;
