//! The console of the firmware in QEMU: the page, each endpoint, the claim, other configurations, and clients that mean
//! no good.
//!
//! They need QEMU (`apt-get install qemu-system-arm`), the firmware for `mps2-an500` and `host-sim`:
//! `FIRMWARE_ELF=... HOST_SIM=target/debug/host-sim cargo test -p firmware --test console -- --ignored`

mod attack;
mod board;
mod changes;
mod claim;
mod hostile;
mod page;
mod reading;
mod stream;
