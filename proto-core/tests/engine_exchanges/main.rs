//! Ports whose recipe has exchanges: requests, replies, and devices that do not answer.

mod frames;
mod line;
#[path = "../rig/mod.rs"]
mod rig;
mod rtu;
mod slave;
