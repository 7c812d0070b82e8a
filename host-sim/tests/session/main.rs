//! The session of a person who puts a cell into service with `host-sim ctl`, with real processes.
//!
//! It is written over [`target::Target`], so that it is the same for every kind of gateway: one on this host, the
//! firmware in QEMU (Debian: qemu-system-arm; the ELF: firmware/README.md), and the NUCLEO's on its modelled chip, of
//! which `cargo build -p recipe-chip-model` is the emulator (docs/chip.md has the other variables):
//!
//! `HOST_SIM_FIRMWARE=ELF cargo test -p host-sim --test session -- --include-ignored on_a_board`
//! `HOST_SIM_NUCLEO=ELF cargo test -p host-sim --test session -- --include-ignored on_a_nucleo`
//!
//! And of boards that get another firmware ([`plant`]), in QEMU with what `.ci/run loader firmware-qemu` has made:
//!
//! `QEMU_LOADER=ELF QEMU_SLOT_A=ELF QEMU_SLOT_B=ELF \
//!     cargo test -p host-sim --test session -- --include-ignored plant::qemu`

mod board;
mod commands;
mod ctl;
mod host;
mod nucleo;
mod panel;
mod plant;
mod qemu;
mod robot;
mod script;
mod target;

use recipe_test_kit::Binary;

pub(crate) const BINARY: Binary = Binary(env!("CARGO_BIN_EXE_host-sim"));

#[test]
fn on_a_host() {
    script::session(&mut host::Host::new());
}

#[test]
#[ignore = "needs HOST_SIM_FIRMWARE and qemu-system-arm"]
fn on_a_board_in_qemu() {
    script::session(&mut qemu::Qemu::new());
}

#[test]
#[ignore = "needs HOST_SIM_NUCLEO, CHIP_UNICORN and qemu-system-arm"]
fn on_a_nucleo_on_its_modelled_chip() {
    script::session(&mut nucleo::Nucleo::new());
}
