//! The values that inputs take when their port times out.
//!
//! Plain data: nothing here has been checked.

use crate::sysvar::{SysVar, VarBit};
use crate::wire::scalar::Scalar;

/// The value that an input variable takes when its port times out.
#[derive(Debug, Clone, Copy, PartialEq)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
pub struct SafeValue {
    /// An input variable that the port owns, as a whole or some of its bits.
    pub var: SysVar,
    /// Its safe value.
    pub value: Scalar,
    /// The bits that the value is for: [`u8::MAX`] for a variable as a whole.
    pub mask: u8,
}

impl SafeValue {
    /// The safe value of a whole variable.
    pub const fn new(var: SysVar, value: Scalar) -> Self {
        Self { var, value, mask: u8::MAX }
    }

    /// The safe value of one bit; of a bit that the variable does not have, the mask is 0.
    pub fn bit(bit: VarBit, on: bool) -> Self {
        let mask = bit.mask().unwrap_or(0);
        Self { var: bit.var, value: Scalar::Byte(if on { mask } else { 0 }), mask }
    }

    /// Whether it is for a variable as a whole.
    pub const fn is_whole(&self) -> bool {
        self.mask == u8::MAX
    }
}
