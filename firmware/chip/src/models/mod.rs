//! The models, one file each.

pub mod can_bus;
pub mod ethernet;
pub mod fdcan;
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
