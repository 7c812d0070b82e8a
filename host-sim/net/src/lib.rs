//! Sockets, timers and scheduling of this host, for tasks that share one thread.
//!
//! Does not know devices, recipes, the controller or the engine.

#[cfg(not(target_os = "linux"))]
compile_error!(
    "recipe-net needs Linux: timerfd, CLOCK_BOOTTIME and SIOCOUTQ; recipe-config and recipe-controller do not"
);

pub mod backoff;
pub mod clock;
pub mod connect;
pub mod fairness;
pub mod log_limit;
pub mod reactor;
pub mod realtime;
pub mod tcp_options;
pub mod timer;
