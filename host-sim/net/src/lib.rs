//! Sockets, timers and scheduling of this host, for tasks that share one thread.
//!
//! Bytes and instants go in and out; no device, no recipe, no controller and no engine is known here.

#[cfg(not(target_os = "linux"))]
compile_error!(
    "recipe-net needs Linux: timerfd, CLOCK_BOOTTIME and SIOCOUTQ; recipe-config and recipe-controller do not"
);

pub mod backoff;
pub mod connect;
pub mod peer;
pub mod quota;
pub mod reactor;
pub mod realtime;
pub mod timer;
pub mod turns;
