//! `proto-core/fuzz/run state`
#![no_main]

libfuzzer_sys::fuzz_target!(|input: &[u8]| (proto_core_fuzz::target("state").run)(input));
