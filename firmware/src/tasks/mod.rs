//! The tasks: each moves data between a device or socket and the engine. They are generic over the traits of
//! [`crate::drivers`] and over the network stack.

pub mod can;
pub mod console;
pub(crate) mod control;
pub mod edge;
pub mod fair;
pub mod gateway;
pub mod led;
pub mod link;
mod notify;
pub mod serial;
pub mod status;
pub mod store;
pub mod time;
pub mod watchdog;

#[cfg(test)]
mod test_clock;
#[cfg(test)]
mod test_executor;
