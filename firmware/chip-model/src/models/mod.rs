//! The models of the peripherals, and of what is connected to the pins.

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
