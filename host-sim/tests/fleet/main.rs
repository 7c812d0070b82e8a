//! Edge nodes against Debian's mosquitto, read by programs that others wrote (docs/fleet.md).
//!
//! `apt-get install mosquitto mosquitto-clients openssl`, then
//! `cargo test -p host-sim --test fleet -- --include-ignored`

mod broker;
mod cell;
mod many;
mod reader;
mod wrong;
