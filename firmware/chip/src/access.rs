//! What is noted of the program's accesses to registers, and the one that it may not do.

use std::fmt;

use crate::device::Picos;

/// An access to a register.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Access {
    /// When.
    pub at: Picos,
    /// The beginning of the block of instructions that it is in.
    pub pc: u32,
    /// The peripheral's name.
    pub peripheral: &'static str,
    /// The register's.
    pub register: String,
    /// What was read or written.
    pub value: u32,
    /// It was written.
    pub is_write: bool,
    /// How often the same in a row; 0 for what the peripheral does by itself.
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

/// What the program may not do.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Violation {
    /// The access that shows it.
    pub access: Access,
    /// Why not.
    pub reason: String,
}

impl fmt::Display for Violation {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}: {}", self.access, self.reason)
    }
}
