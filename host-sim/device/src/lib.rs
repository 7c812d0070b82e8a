//! Devices a configured port can be tied to: pseudoterminals, serial lines, byte streams over TCP and
//! a CAN bus in user space, CAN interfaces of the kernel.
//!
//! Bytes and frames go in and out; no recipe, no controller and no engine is known here, but for the
//! engine's word for a CAN controller's error state.

#[cfg(not(target_os = "linux"))]
compile_error!(
    "recipe-device needs Linux: pseudoterminals and SocketCAN; recipe-config and recipe-controller do not"
);

pub mod bind;
pub mod can_bus;
pub mod exchange;
pub mod files;
mod line;
pub mod port;
pub mod pty;
mod pty_link;
mod socketcan;
mod stream;
#[cfg(test)]
mod test_kit;
pub mod wire;
