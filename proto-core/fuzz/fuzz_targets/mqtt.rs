//! `proto-core/fuzz/run mqtt`
#![no_main]

libfuzzer_sys::fuzz_target!(|input: &[u8]| (recipe_fuzz::target("mqtt").run)(input));
