//! `proto-core/fuzz/run engine`
#![no_main]

libfuzzer_sys::fuzz_target!(|input: &[u8]| (proto_core_fuzz::target("engine").run)(input));
