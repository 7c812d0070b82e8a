//! `proto-core/fuzz/run engine`
#![no_main]

libfuzzer_sys::fuzz_target!(|input: &[u8]| (recipe_fuzz::target("engine").run)(input));
