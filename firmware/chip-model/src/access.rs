//! The record of the program's register accesses, and the violation that ends a run.

use std::borrow::Cow;
use std::fmt;

use crate::device::Picos;

/// An access to a register.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Access {
    /// Virtual time.
    pub at: Picos,
    /// Start of the basic block that contains the instruction.
    pub pc: u32,
    /// The peripheral's name.
    pub peripheral: &'static str,
    /// The register's name.
    pub register: Cow<'static, str>,
    /// The value read or written.
    pub value: u32,
    /// Whether it was a write.
    pub is_write: bool,
    /// Number of identical accesses in a row; 0 for an action of the peripheral itself.
    pub times: u32,
}

impl fmt::Display for Access {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { at, pc, peripheral, register, value, is_write, times } = self;
        if *times == 0 {
            return write!(f, "{:12.3} us  {pc:08X}  {peripheral} by itself", *at as f64 / 1e6);
        }
        let arrow = if *is_write { "<-" } else { "->" };
        write!(f, "{:12.3} us  {pc:08X}  {peripheral}.{register} {arrow} {value:08X}", *at as f64 / 1e6)?;
        if *times > 1 { write!(f, "  {times} times") } else { Ok(()) }
    }
}

/// Something that the program must not do.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Violation {
    /// The access at fault.
    pub access: Access,
    /// Why it is not allowed.
    pub reason: String,
}

impl fmt::Display for Violation {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}: {}", self.access, self.reason)
    }
}
