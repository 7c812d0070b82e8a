//! Ports whose recipe has exchanges: requests, replies, and devices that do not answer.

mod frames;
mod line;
mod properties;
#[path = "../rig/mod.rs"]
mod rig;
mod rtu;
mod slave;
mod stops;
mod unconfirmed;
