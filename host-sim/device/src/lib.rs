//! Devices that a configured port can be bound to: pseudoterminals, serial devices, byte streams over
//! TCP, a CAN bus in user space, and CAN interfaces of the kernel.
//!
//! In and out: bytes and frames. Does not know recipes, the controller or the engine, except the engine's
//! type for the error state of a CAN controller.

#[cfg(not(target_os = "linux"))]
compile_error!(
    "recipe-device needs Linux: pseudoterminals and SocketCAN; recipe-config and recipe-controller do not"
);

pub mod bind;
pub mod can_bus;
pub mod exchange;
pub mod files;
pub mod kept;
pub mod port;
pub mod pty;
pub mod random;
mod serial;
mod socketcan;
mod stream;
mod symlink;
#[cfg(test)]
mod test_kit;
pub mod wire;
