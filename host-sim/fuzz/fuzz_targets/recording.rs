//! `proto-core/fuzz/run recording`
#![no_main]

libfuzzer_sys::fuzz_target!(|input: &[u8]| (host_sim_fuzz::target("recording").run)(input));
