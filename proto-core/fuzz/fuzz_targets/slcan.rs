//! `proto-core/fuzz/run slcan`
#![no_main]

libfuzzer_sys::fuzz_target!(|input: &[u8]| (recipe_fuzz::target("slcan").run)(input));
