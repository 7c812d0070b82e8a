//! The models, one file each.

pub mod can_bus;
mod can_filters;
pub mod ethernet;
pub mod fdcan;
mod fdcan_registers;
pub mod flash;
pub mod gpio;
pub mod iwdg;
pub mod line;
pub mod phy;
pub mod rcc;
pub mod scs;
pub mod simple;
pub mod timer;
pub mod usart;
