//! `proto-core/fuzz/run store`
#![no_main]

libfuzzer_sys::fuzz_target!(|input: &[u8]| (proto_core_fuzz::target("store").run)(input));
