//! `proto-core/fuzz/run inventory`
#![no_main]

libfuzzer_sys::fuzz_target!(|input: &[u8]| (host_sim_fuzz::target("inventory").run)(input));
