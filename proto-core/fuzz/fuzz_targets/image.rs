//! `proto-core/fuzz/run image`
#![no_main]

libfuzzer_sys::fuzz_target!(|input: &[u8]| (recipe_fuzz::target("image").run)(input));
