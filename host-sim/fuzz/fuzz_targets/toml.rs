//! `proto-core/fuzz/run toml`
#![no_main]

libfuzzer_sys::fuzz_target!(|input: &[u8]| (host_sim_fuzz::target("toml").run)(input));
