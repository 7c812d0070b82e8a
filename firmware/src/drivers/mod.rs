//! What moves bytes and frames: the traits that the tasks ask of a device, and drivers for some.
//!
//! A driver knows its registers, through a trait, and neither a board nor a task.

pub mod can_port;
pub mod lan9118;
pub mod line;
pub mod mcan;
pub mod slcan;
pub mod usart;

#[cfg(test)]
mod test_chip;
