//! `proto-core/fuzz/run update`
#![no_main]

libfuzzer_sys::fuzz_target!(|input: &[u8]| (recipe_fuzz::target("update").run)(input));
