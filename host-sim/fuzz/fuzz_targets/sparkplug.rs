//! `proto-core/fuzz/run sparkplug`
#![no_main]

libfuzzer_sys::fuzz_target!(|input: &[u8]| (host_sim_fuzz::target("sparkplug").run)(input));
