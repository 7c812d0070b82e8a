//! `proto-core/fuzz/run framer`
#![no_main]

libfuzzer_sys::fuzz_target!(|input: &[u8]| (recipe_fuzz::target("framer").run)(input));
