//! `proto-core/fuzz/run state`
#![no_main]

libfuzzer_sys::fuzz_target!(|input: &[u8]| (recipe_fuzz::target("state").run)(input));
