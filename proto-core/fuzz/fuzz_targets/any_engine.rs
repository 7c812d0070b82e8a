//! `proto-core/fuzz/run any_engine`
#![no_main]

libfuzzer_sys::fuzz_target!(|input: &[u8]| (proto_core_fuzz::target("any_engine").run)(input));
