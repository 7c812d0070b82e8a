//! Devices that a configured port can be bound to: pseudoterminals, serial lines, byte streams over
//! TCP and a CAN bus in user space, CAN interfaces of the kernel.
//!
//! In and out: bytes and frames. Does not know recipes, controller or engine, except the engine's
//! type for a CAN controller's error state.

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
