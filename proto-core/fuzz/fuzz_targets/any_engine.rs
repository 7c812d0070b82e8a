//! `proto-core/fuzz/run any_engine`
#![no_main]

libfuzzer_sys::fuzz_target!(|input: &[u8]| (recipe_fuzz::target("any_engine").run)(input));
