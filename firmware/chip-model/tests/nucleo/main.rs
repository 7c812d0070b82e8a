//! The NUCLEO-H743ZI2's binary, unchanged, on the modelled chip. Each test needs the emulator's library and the
//! firmware (`CHIP_UNICORN`, `CHIP_ELF`; docs/chip.md); `.ci/run nucleo` provides both and runs all tests.

mod attack;
mod bench;
mod boot;
mod broker;
mod can;
mod cell;
mod client;
mod cuts;
mod edge;
mod faults;
mod flash;
mod load;
mod page;
mod realtime;
mod robot;
mod serial;
mod slots;
mod store;
mod trials;
mod update;

use bench::Bench;
