//! Devices a configured port can be tied to: pseudoterminals, serial lines, byte streams over TCP and
//! a CAN bus in user space, CAN interfaces of the kernel; and the timer that paces them.
//!
//! Bytes and frames go in and out; no recipe, no controller and no engine is known here, but for the
//! engine's word for a CAN controller's error state.

pub mod backoff;
pub mod bind;
pub mod can_bus;
pub(crate) mod connect;
mod line;
pub(crate) mod peer;
pub mod port;
pub mod pty;
mod pty_link;
pub(crate) mod quota;
mod reactor;
pub mod realtime;
mod socketcan;
#[cfg(test)]
mod test_kit;
pub mod timer;
pub(crate) mod turns;
pub mod wire;
