//! `proto-core/fuzz/run timeline`
#![no_main]

libfuzzer_sys::fuzz_target!(|input: &[u8]| (host_sim_fuzz::target("timeline").run)(input));
