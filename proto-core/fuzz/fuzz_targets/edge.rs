//! `proto-core/fuzz/run edge`
#![no_main]

libfuzzer_sys::fuzz_target!(|input: &[u8]| (proto_core_fuzz::target("edge").run)(input));
