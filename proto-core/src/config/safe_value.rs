//! The values that inputs take if their port times out.
//!
//! Plain data: nothing here is checked.

use crate::sysvar::{SysVar, VarBit};
use crate::wire::scalar::Scalar;

/// The value that an input variable takes if its port times out.
#[derive(Debug, Clone, Copy, PartialEq)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
pub struct SafeValue {
    /// An input variable of which the port owns the whole or some bits.
    pub var: SysVar,
    /// The safe value.
    pub value: Scalar,
    /// Mask of the bits that the value is for; [`u8::MAX`] for a whole variable.
    pub mask: u8,
}

impl SafeValue {
    /// The safe value of a whole variable.
    pub const fn new(var: SysVar, value: Scalar) -> Self {
        Self { var, value, mask: u8::MAX }
    }

    /// The safe value of one bit. The mask is 0 if the variable does not have the bit.
    pub fn bit(bit: VarBit, on: bool) -> Self {
        let mask = bit.mask().unwrap_or(0);
        Self { var: bit.var, value: Scalar::Byte(if on { mask } else { 0 }), mask }
    }

    /// Whether it is for a whole variable.
    pub const fn is_whole(&self) -> bool {
        self.mask == u8::MAX
    }
}
