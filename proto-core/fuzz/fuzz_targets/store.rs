//! `proto-core/fuzz/run store`
#![no_main]

libfuzzer_sys::fuzz_target!(|input: &[u8]| (recipe_fuzz::target("store").run)(input));
