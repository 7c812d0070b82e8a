//! I/O for the tasks of one thread: the devices that a configured port can be bound to (pseudoterminals, serial
//! devices, byte streams over TCP, a CAN bus in user space, CAN interfaces of the kernel), sockets, timers and
//! scheduling.
//!
//! In and out: bytes and frames. Does not know recipes, the controller or the engine, except the engine's
//! type for the error state of a CAN controller.

#[cfg(not(target_os = "linux"))]
compile_error!(
    "recipe-io needs Linux: pseudoterminals, SocketCAN, timerfd, CLOCK_BOOTTIME and SIOCOUTQ; recipe-config and \
     recipe-controller do not"
);

pub mod backoff;
pub mod bind;
mod can_bus;
pub mod clock;
pub mod connect;
pub mod exchange;
pub mod fairness;
pub mod files;
pub mod handover;
pub mod log_limit;
pub mod port;
mod pty;
pub mod random;
mod reactor;
pub mod realtime;
mod serial;
mod socketcan;
mod stream;
mod symlink;
pub mod tcp_options;
#[cfg(test)]
mod test_kit;
pub mod timer;
mod tty;
mod wire;
