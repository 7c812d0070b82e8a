//! The control socket of the simulated controller, and its clock, over real sockets and devices
//! (docs/control.md).

mod clock;
mod kit;
mod socket;
