//! `proto-core/fuzz/run edge`
#![no_main]

libfuzzer_sys::fuzz_target!(|input: &[u8]| (recipe_fuzz::target("edge").run)(input));
