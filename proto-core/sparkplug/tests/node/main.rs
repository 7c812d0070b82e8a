//! An edge node in virtual time, against the statements of Sparkplug 3.0. docs/fleet.md says which test is for which.

mod any;
mod births;
mod data;
mod gateway;
mod host;
mod kit;
mod session;
