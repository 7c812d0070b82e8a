//! The traits of devices that the tasks use, and drivers that implement them.
//!
//! A driver accesses its registers through a trait. It does not know boards or tasks.

pub mod can_port;
pub mod lan9118;
pub mod line;
pub mod mcan;
pub mod slcan;
pub mod usart;

#[cfg(test)]
mod test_chip;
