//! `proto-core/fuzz/run operations`
#![no_main]

libfuzzer_sys::fuzz_target!(|input: &[u8]| (host_sim_fuzz::target("operations").run)(input));
